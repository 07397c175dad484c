"""Pipes and devices are refused before they are read, because reading them never ends."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from gpe_pl.benchmarks.faults.side_files import raw_arrays
from gpe_pl.data.importers import ImportFailure, ImportSettings, import_dataset
from gpe_pl.evaluation.metric_rows import MetricsError, read_rows
from gpe_pl.files import regular_files, sealed

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes in folders")


def pipe(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    path.mkdir()


PLACED = pytest.mark.parametrize("place", [pipe, device, folder])


@PLACED
def test_nothing_else_than_a_file_is_read(tmp_path: Path, place: Callable[[Path], None]) -> None:
    place(tmp_path / "x")
    with pytest.raises(OSError, match="is no file"):
        regular_files.check(tmp_path / "x")
    with pytest.raises(sealed.SealError, match="x: is no file; delete it"):
        sealed.parsed(tmp_path / "x", "delete it")


def test_files_links_to_them_and_nothing_pass(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("1")
    (tmp_path / "link").symlink_to("file")
    for name in ("file", "link", "missing"):
        regular_files.check(tmp_path / name)


@PLACED
@pytest.mark.parametrize("name", ["metrics.csv", "metrics.csv.sha256"])
def test_metrics(tmp_path: Path, place: Callable[[Path], None], name: str) -> None:
    (tmp_path / "metrics.csv").write_text("a,b\n")
    (tmp_path / name).unlink(missing_ok=True)
    place(tmp_path / name)
    with pytest.raises(MetricsError, match=f"{name}: is no file; delete it"):
        list(read_rows(tmp_path / "metrics.csv"))


@pytest.mark.slow
@PLACED
def test_archives_of_a_source(tmp_path: Path, place: Callable[[Path], None]) -> None:
    raw_arrays(tmp_path / "raw")
    archive = tmp_path / "raw" / "train" / "00.npz"
    archive.unlink()
    place(archive)
    report = import_dataset(tmp_path, ImportSettings(format="arrays", source=str(tmp_path / "raw"), name="own"))
    assert ["00.npz" in str(event) and "is no file" in event.what for event in report.refusals] == [True]


@PLACED
@pytest.mark.parametrize(("form", "name"), [("gns", "metadata.json"), ("gns", "train.tfrecord"), ("dmcf", "train/0.msgpack.zst")])
def test_files_of_other_formats(tmp_path: Path, place: Callable[[Path], None], form: str, name: str) -> None:
    path = tmp_path / "raw" / name
    path.parent.mkdir(parents=True)
    if name != "metadata.json":
        (tmp_path / "raw" / "metadata.json").write_text(
            '{"bounds": [[0, 1], [0, 1]], "dim": 2, "dt": 0.1, "default_connectivity_radius": 0.1}'
        )
    place(path)
    with pytest.raises(ImportFailure):
        import_dataset(tmp_path, ImportSettings(format=form, source=str(tmp_path / "raw"), name="own"))  # type: ignore[arg-type]
