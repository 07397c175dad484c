"""Interrupted conversions leave nothing, and the next conversion starts from the beginning."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from gpe_pl.data.importers import CONTACT_SHEET_FILE, ImportFailure, ImportSettings, Report, import_dataset, save_dataset
from gpe_pl.files.atomic import FullDiskError
from gpe_pl.trajectory.trajectory import Trajectory
from tests import sources
from tests.sources import motion


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    for k in range(3):
        sources.dmcf(tmp_path / "raw" / f"{k}.msgpack.zst", sources.dmcf_frames(motion(dim=3, seed=k), motion(dim=3, seed=k)))
    return tmp_path / "raw"


def converted(raw: Path) -> Report:
    return import_dataset(raw.parent / "data", ImportSettings("dmcf", str(raw), "set"), contact_sheet=True)


def left(raw: Path) -> list[str]:
    return sorted(path.name for path in (raw.parent / "data").rglob("*") if path.is_file() and not path.name.endswith((".lock", ".holder")))


@pytest.mark.slow
def test_one_that_ends_while_it_draws(raw: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Killed(BaseException):
        pass

    def killed(*_: object) -> None:
        raise Killed

    with monkeypatch.context() as patched:
        patched.setattr("gpe_pl.viz.contact_sheet.contact_sheet", killed)
        with pytest.raises(Killed):
            converted(raw)
    assert left(raw) == []
    report = converted(raw)
    assert (Path(report.folder) / CONTACT_SHEET_FILE).stat().st_size > 1000
    assert "shard-00000.h5" in left(raw)


def test_one_for_which_there_is_too_little_room(raw: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr("gpe_pl.data.importers.assemble.free_bytes", lambda _: 1000)
        with pytest.raises(
            ImportFailure, match=r"imported: the data need up to .* GiB, the disk has 9.31e-07 GiB free; choose another folder"
        ):
            converted(raw)
    assert left(raw) == []


def test_one_during_which_the_disk_fills(raw: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr("gpe_pl.files.late_failure.os.write", full)
        with pytest.raises(FullDiskError, match=r"data/set/imported: cannot be written, there is no room"):
            converted(raw)
    assert left(raw) == []
    assert converted(raw).splits["train"].trajectories == 1


def test_arrays_for_which_there_is_no_room(tmp_path: Path, trajectory: Trajectory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gpe_pl.data.importers.assemble.free_bytes", lambda _: 1000)
    with pytest.raises(ImportFailure, match="the disk has"):
        save_dataset(tmp_path, "own", train=[trajectory])
