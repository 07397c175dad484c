"""Compiled code has a place on systems on which nearly nothing can be written."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from gpe_pl import caches

VARIABLES = ("NUMBA_CACHE_DIR", "MPLCONFIGDIR", "TRITON_CACHE_DIR")


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for variable in (*VARIABLES, "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def unwritable(monkeypatch: pytest.MonkeyPatch, *places: Path) -> None:
    """As permissions make them, which do not bind root."""
    access = os.access
    monkeypatch.setattr(
        os, "access", lambda path, mode: not any(Path(path).is_relative_to(place) for place in places) and access(path, mode)
    )


def test_nothing_is_set_where_the_usual_folders_can_be_written() -> None:
    caches.prepare()
    assert not [variable for variable in VARIABLES if variable in os.environ]


def test_a_read_only_package_and_home_have_a_fallback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "home").mkdir()
    unwritable(monkeypatch, caches.PACKAGE, tmp_path / "home")
    monkeypatch.setenv("MPLCONFIGDIR", "mine")
    caches.prepare()
    folder = tmp_path / f"gpe_pl-{os.getuid()}"
    assert {variable: os.environ[variable] for variable in VARIABLES} == {
        "NUMBA_CACHE_DIR": str(folder / "numba"),
        "MPLCONFIGDIR": "mine",
        "TRITON_CACHE_DIR": str(folder / "triton"),
    }
    assert folder.stat().st_mode & 0o777 == 0o700


def test_numba_needs_one_of_package_and_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "home").write_text("a file in the way", encoding="utf-8")
    caches.prepare()
    assert "NUMBA_CACHE_DIR" not in os.environ and "MPLCONFIGDIR" in os.environ


def test_what_others_have_prepared_is_not_run(tmp_path: Path) -> None:
    folder = tmp_path / f"gpe_pl-{os.getuid()}"
    folder.mkdir()
    folder.chmod(0o777)
    own = caches._own_folder()
    assert own is not None and own != folder and own.parent == tmp_path
    folder.rmdir()
    (tmp_path / "theirs").mkdir()
    folder.symlink_to(tmp_path / "theirs")
    own = caches._own_folder()
    assert own is not None and own != folder


def test_compiled_functions_are_kept_in_the_fallback(tmp_path: Path) -> None:
    """In a process whose package and home cannot be written."""
    code = """
import os
from pathlib import Path
access = os.access
os.access = lambda path, mode: str(path).startswith(os.environ["PLACE"]) and access(path, mode)
from gpe_pl.data.importers.tfrecord import _crc32c
import numpy as np
_crc32c(np.zeros(1, np.uint8), np.zeros(256, np.uint32))
"""
    environment = {**os.environ, "HOME": str(tmp_path / "home"), "TMPDIR": str(tmp_path / "tmp"), "PLACE": str(tmp_path / "tmp")}
    (tmp_path / "tmp").mkdir()
    child = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, encoding="utf-8", check=False)
    assert child.returncode == 0, child.stderr
    assert list((tmp_path / "tmp" / f"gpe_pl-{os.getuid()}").glob("numba/**"))
