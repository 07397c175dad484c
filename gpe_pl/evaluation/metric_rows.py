"""The rows of ``metrics.csv``: written with a digest, and checked when read."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

from gpe_pl.errors import GpeError
from gpe_pl.evaluation.horizons import time_of
from gpe_pl.files import regular_files
from gpe_pl.files.atomic import replace_text, replacing
from gpe_pl.schema import SPLITS, ParameterGroup

LEARNED = "learned"
"""Label of a learned simulator."""
EXACT = "learned, exact"
"""Label of a second rollout of the learned simulator, without the approximate levels of ``Skips``. It is made if the first rollout has such levels."""
GROUPS = ("", *get_args(ParameterGroup))
"""Values of ``Row.parameter_group``: groups of the material parameter, and the empty text for metrics of a whole split."""


class MetricsError(GpeError, ValueError):
    """Raised for a damaged ``metrics.csv``. The message names the file, and the line if a line cannot be read."""


@dataclass(frozen=True)
class Row:
    """One number of ``metrics.csv``.

    Attributes:
        model: label of the model or baseline.
        split: split of the data set.
        trajectory: number of the trajectory in the split; -1 for a metric of the whole split.
        parameter_group: one of ``GROUPS``.
        parameter: first material parameter of the scene; NaN for a metric of the whole split, and for scenes whose nodes have several values.
        metric: name of the metric.
        horizon: label of the horizon; empty for metrics without one.
        value: value of the metric.
    """

    model: str
    split: str
    trajectory: int
    parameter_group: str
    parameter: float
    metric: str
    horizon: str
    value: float


About = tuple[str, int, str, float]
"""Split, number, parameter group and parameter of a scene, as in ``Row``."""


def write_rows(path: Path, rows: list[Row]) -> None:
    """Write rows as CSV, atomically, and their SHA-256 digest to ``{name}.sha256`` in the format of ``sha256sum``."""
    table = io.StringIO(newline="")
    writer = csv.DictWriter(table, fieldnames=list(Row.__dataclass_fields__))
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    content = table.getvalue().encode()
    replace_text(
        _digest_file(path), f"{hashlib.sha256(content).hexdigest()}  {path.name}\n"
    )  # first, as ``read_rows`` does not check a table without digest
    with replacing(path) as part:
        part.write_bytes(content)


def read_rows(path: Path) -> Iterator[Row]:
    """Yield the rows of a ``metrics.csv``.

    Raises:
        MetricsError: the file is not as ``write_rows`` wrote it. Without its digest, only the form of the rows is checked.
    """
    digest = _digest_file(path)
    try:
        regular_files.check(path)
        regular_files.check(digest)
    except OSError as error:
        raise MetricsError(f"{error.filename}: {error.strerror}; delete it to evaluate again") from None
    content = path.read_bytes()
    if digest.exists() and digest.read_bytes().split()[:1] != [hashlib.sha256(content).hexdigest().encode()]:
        raise MetricsError(
            f"{path}: damaged or changed (checksum mismatch); delete the file to evaluate again, or {digest.name} to use it unchecked"
        )
    reader = csv.DictReader(io.TextIOWrapper(io.BytesIO(content), "utf-8", newline=""), strict=True)
    try:
        for r in reader:
            if set(r) != set(Row.__dataclass_fields__) or None in r.values():
                raise ValueError(f"expected the columns {', '.join(Row.__dataclass_fields__)}")
            known: dict[str, Any] = {
                **r,
                "trajectory": int(r["trajectory"]),
                "parameter": float(r["parameter"]),
                "value": float(r["value"]),
            }
            if r["split"] not in SPLITS or r["parameter_group"] not in GROUPS:
                raise ValueError(f"split or parameter group is {r['split']}, {r['parameter_group']}")
            time_of(r["horizon"])
            if not (r["model"].isprintable() and r["metric"].isprintable()):
                raise ValueError("model or metric contains characters that are not printable")
            yield Row(**known)
    except (ValueError, csv.Error) as error:  # also a file that is not text
        raise MetricsError(f"{path}, line {reader.line_num}: damaged ({error}); delete the file to evaluate again") from None


def _digest_file(path: Path) -> Path:
    return path.with_name(f"{path.name}.sha256")
