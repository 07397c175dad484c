"""Conversions of sources, and checks of their refusals."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpe_pl.data.importers import ImportFailure, ImportSettings, Refusal, Report, import_dataset
from gpe_pl.data.importers.report import Event
from gpe_pl.trajectory.arrays import ArrayError
from tests import sources
from tests.sources import motion

WATER = np.full(20, 5)


def convert(tmp_path: Path, format: Any, **settings: Any) -> Report:
    return import_dataset(tmp_path / "data", ImportSettings(format, str(tmp_path / "raw"), "set", **{"holdout": 0.0, **settings}))


def refused(tmp_path: Path, format: Any, message: str, **settings: Any) -> None:
    """Check that the conversion as a whole fails with this message, and leaves nothing."""
    with pytest.raises(ImportFailure, match=message) as caught:
        convert(tmp_path, format, **settings)
    assert len(str(caught.value)) < 1000
    assert not list((tmp_path / "data").rglob("*.h5"))
    assert not list((tmp_path / "data").rglob(".*"))


def only_refusal(report: Report) -> str:
    (event,) = report.refusals
    return str(event)


def unreadable(tmp_path: Path, format: Any) -> str:
    """Return the refusal of the only unreadable trajectory, without writing the others."""
    settings = ImportSettings(format, str(tmp_path / "raw"))
    source = importlib.import_module(f"gpe_pl.data.importers.{format}").open_source(tmp_path / "raw", settings)
    found = []
    for split, items in source.splits.items():
        for item in items:
            try:
                item.load(source.facts)
            except (Refusal, ArrayError) as refusal:
                found.append(str(Event(split, item.name, refusal.frame, str(refusal))))
    (text,) = found
    return text


def write(tmp_path: Path, *parts: bytes) -> None:
    (tmp_path / "raw" / "train.tfrecord").write_bytes(b"".join(parts))


def frames(seed: int = 9) -> list[dict[str, Any]]:
    pos = motion(dim=3, seed=seed)
    return sources.dmcf_frames(pos, np.gradient(pos, 0.02, axis=0))


def with_frame(number: int, **changes: Any) -> list[dict[str, Any]]:
    found = frames()
    found[number] = {k: v for k, v in (found[number] | changes).items() if v is not None}
    return found
