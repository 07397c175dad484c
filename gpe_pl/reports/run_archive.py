"""Archive of many runs: two small files from which tables can be made again after the folders of the runs are deleted.

``runs.json`` has the configurations and validation curves. Values that all or several runs have are said once.
``rollouts.csv.xz`` has one line per run, model, split and trajectory, and one column per metric and horizon, such as ``rollout_mse@full``. Values have five
significant digits; tables and intervals print three.
"""

from __future__ import annotations

import hashlib
import io
import json
import lzma
from pathlib import Path
from typing import Any

import pandas as pd

from gpe_pl.errors import GpeError
from gpe_pl.files import sealed
from gpe_pl.files.atomic import replacing

RUNS, ROLLOUTS = "runs.json", "rollouts.csv.xz"
NUMBER = "{:.5g}"
KEYS = ["model", "split", "trajectory", "parameter_group", "parameter"]
COLUMNS = [*KEYS, "metric", "horizon", "value"]
"""Columns of a run's rows, as in ``metrics.csv``."""
MOST_BYTES = 2**28
"""Maximum size of the unpacked ``rollouts.csv.xz`` [bytes]."""
MOST_MEMORY = 2**28
"""Maximum memory of the unpacker [bytes]."""
CONTENT = "rollouts_sha256"


class ArchiveError(GpeError, ValueError):
    """Raised for a damaged archive; the message names the file."""


def write_archive(folder: Path, runs: dict[str, dict[str, Any]], rows: dict[str, pd.DataFrame]) -> None:
    """Write both files.

    Args:
        folder: existing folder.
        runs: plain values about each run, by name of the run and key.
        rows: rows of each run, with ``COLUMNS``.
    """
    together = pd.concat([table.assign(run=name) for name, table in rows.items()], ignore_index=True)
    together["column"] = together["metric"] + "@" + together["horizon"]
    together["value"] = together["value"].map(NUMBER.format)  # "nan" is a value that is not a number; empty is a missing value
    wide = together.pivot(index=["run", *KEYS], columns="column", values="value").reset_index()
    content = lzma.compress(wide.to_csv(index=False, lineterminator="\n").encode())
    with replacing(folder / ROLLOUTS) as part:
        part.write_bytes(content)
    sealed.write(folder / RUNS, {**_said_once(runs), CONTENT: hashlib.sha256(content).hexdigest()})


def read_archive(folder: Path) -> tuple[dict[str, dict[str, Any]], dict[str, pd.DataFrame]]:
    """Read an archive. Returns the arguments ``runs`` and ``rows`` of ``write_archive``, with values to five digits.

    Raises:
        ArchiveError: a file is damaged or does not belong to the other.
    """
    advice = f"take {RUNS} and {ROLLOUTS} again from where they come from"
    try:
        about = sealed.read(folder / RUNS, advice)
        content = (folder / ROLLOUTS).read_bytes()
    except sealed.SealError as error:
        raise ArchiveError(str(error)) from None
    except OSError as error:
        raise ArchiveError(f"{folder / ROLLOUTS}: {error.strerror}; {advice}") from None
    if hashlib.sha256(content).hexdigest() != about.get(CONTENT):
        raise ArchiveError(f"{folder / ROLLOUTS}: damaged, or of other runs than {RUNS} (checksum mismatch); {advice}")
    unpacker = lzma.LZMADecompressor(memlimit=MOST_MEMORY)
    unpacked = unpacker.decompress(content, MOST_BYTES)
    if not unpacker.eof:
        raise ArchiveError(f"{folder / ROLLOUTS}: unpacks to more than {MOST_BYTES} bytes; {advice}")
    wide = pd.read_csv(io.BytesIO(unpacked), dtype=str, keep_default_na=False)
    runs = {name: {**about["common"], **own} for name, own in about["runs"].items()}
    for group in about.get("shared", []):  # earlier archives have none
        for name in group["runs"]:
            runs[name].update(group["values"])
    return runs, {name: _long(table) for name, table in wide.groupby("run")}


def _said_once(runs: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return ``common`` values of all runs, ``shared`` ones with the names of the runs that have them, and each run's own ones."""
    owners: dict[tuple[str, str], list[str]] = {}
    values: dict[tuple[str, str], Any] = {}
    for name, run in runs.items():
        for key, value in run.items():
            entry = key, json.dumps(value, sort_keys=True)
            owners.setdefault(entry, []).append(name)
            values[entry] = value
    groups: dict[tuple[str, ...], dict[str, Any]] = {}
    for entry, names in owners.items():
        groups.setdefault(tuple(names), {})[entry[0]] = values[entry]
    common = groups.pop(tuple(runs), {})
    own = {name: groups.pop((name,), {}) for name in runs}
    return {"common": common, "shared": [{"runs": list(names), "values": group} for names, group in groups.items()], "runs": own}


def _long(wide: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of one run with ``COLUMNS``, made from its lines of the archive. Empty cells are left out."""
    long = wide.melt(id_vars=KEYS, value_vars=[name for name in wide.columns if "@" in name], var_name="column")
    long = long[long["value"] != ""]
    long[["metric", "horizon"]] = long.pop("column").str.rsplit("@", n=1, expand=True)
    kinds = {"trajectory": int, "parameter": float, "value": float}
    long = long.assign(parameter=long["parameter"].replace("", "nan")).astype(kinds)
    return long.sort_values(["split", "trajectory"], kind="stable").reset_index(drop=True)[COLUMNS]
