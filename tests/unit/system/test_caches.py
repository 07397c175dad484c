"""Compiled code finds a cache folder also on systems where nearly nothing is writable."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numba
import pytest

from gpe_pl.system import caches
from tests.architecture.test_imports import MODULES, ROOT, dotted

VARIABLES = ("NUMBA_CACHE_DIR", "MPLCONFIGDIR", "TRITON_CACHE_DIR")


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for variable in (*VARIABLES, "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (tmp_path / "package" / "solvers").mkdir(parents=True)
    (tmp_path / "package" / "solvers" / "contact.py").write_text("HARD = 1\n", encoding="utf-8")
    monkeypatch.setattr(caches, "PACKAGE", tmp_path / "package")
    monkeypatch.setattr("numba.config.CACHE_DIR", "")  # is put back


def unwritable(monkeypatch: pytest.MonkeyPatch, *places: Path) -> None:
    """Make a folder unwritable, also for root, whom permissions do not restrict."""
    access = os.access
    monkeypatch.setattr(
        os, "access", lambda path, mode: not any(Path(path).is_relative_to(place) for place in places) and access(path, mode)
    )


def compiled() -> Path:
    """Return the folder of compiled functions of a newly started process."""
    caches.prepare()
    return Path(os.environ["NUMBA_CACHE_DIR"])


def test_only_the_folder_of_compiled_functions_is_set_where_the_usual_ones_can_be_written(tmp_path: Path) -> None:
    assert compiled().parent == tmp_path / "package" / "__pycache__"
    assert not [variable for variable in VARIABLES[1:] if variable in os.environ]


def test_other_sources_have_another_folder(tmp_path: Path) -> None:
    source = tmp_path / "package" / "solvers" / "contact.py"
    first = compiled()
    assert compiled() == first
    source.write_text("HARD = 2\n", encoding="utf-8")
    second = compiled()
    assert second != first and second.parent == first.parent  # also where the folder of the process before is inherited
    source.rename(source.with_name("touch.py"))
    assert compiled() not in (first, second)
    (tmp_path / "package" / "page.py").write_text("nothing compiled", encoding="utf-8")
    source.with_name("touch.py").rename(source)
    source.write_text("HARD = 1\n", encoding="utf-8")
    assert compiled() == first


def test_a_folder_that_the_user_chose_holds_those_of_all_versions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "chosen"))
    assert compiled().parent == compiled().parent == tmp_path / "chosen"


def test_what_was_compiled_long_ago_from_other_sources_is_removed(tmp_path: Path) -> None:
    old, recent = (tmp_path / "package" / "__pycache__" / f"{caches.NAME}{name}" for name in ("old", "recent"))
    for folder in (old, recent):
        folder.mkdir(parents=True)
    os.utime(old, (0, 0))
    assert compiled().exists() and recent.exists() and not old.exists()


def test_a_numba_that_is_imported_already_takes_the_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    import numba

    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    folder = compiled()
    assert vars(numba.config)["CACHE_DIR"] == str(folder)


def compiled_functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(decorator) for decorator in node.decorator_list):
            yield node


@pytest.mark.parametrize("path", [path for path in MODULES if "njit" in path.read_text(encoding="utf-8")], ids=dotted)
def test_what_compiled_functions_are_made_of_counts(path: Path) -> None:
    """``caches.COMPILED`` covers the file of each compiled function and every file of the package from which the function takes a name."""
    sources = {source for pattern in caches.COMPILED for source in (ROOT / "gpe_pl").glob(pattern)}
    tree = ast.parse(path.read_text(encoding="utf-8"))
    functions = [*compiled_functions(tree)]
    assert not functions or path in sources
    used = {node.id for function in functions for node in ast.walk(function) if isinstance(node, ast.Name)}
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.ImportFrom)
            and node.module
            and node.module.startswith("gpe_pl")
            and used & {n.asname or n.name for n in node.names}
        ):
            module = ROOT / node.module.replace(".", "/")
            assert {module.with_suffix(".py"), module / "__init__.py"} & sources, node.module


def test_a_read_only_package_and_home_have_a_fallback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "home").mkdir()
    unwritable(monkeypatch, caches.PACKAGE, tmp_path / "home")
    monkeypatch.setenv("MPLCONFIGDIR", "mine")
    caches.prepare()
    folder = tmp_path / f"gpe_pl-{os.getuid()}"
    assert Path(os.environ["NUMBA_CACHE_DIR"]).parent == folder / "numba"
    assert {variable: os.environ[variable] for variable in VARIABLES[1:]} == {
        "MPLCONFIGDIR": "mine",
        "TRITON_CACHE_DIR": str(folder / "triton"),
    }
    assert folder.stat().st_mode & 0o777 == 0o700


def test_numba_takes_the_package_before_home_and_home_before_the_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unwritable(monkeypatch, tmp_path / "package")
    assert compiled().parent == tmp_path / "home" / ".cache" / "numba"
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    shutil.rmtree(tmp_path / "home")
    (tmp_path / "home").write_text("a file in the way", encoding="utf-8")
    assert compiled().parent == tmp_path / f"gpe_pl-{os.getuid()}" / "numba"
    assert "MPLCONFIGDIR" in os.environ


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


@pytest.mark.slow
def test_compiled_functions_are_kept_in_the_fallback(tmp_path: Path) -> None:
    """The process cannot write to the folders of the package and home."""
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


@pytest.mark.parametrize("given", [None, "/dev/null/cache"])
def test_without_any_place_functions_compile_without_a_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str | None) -> None:
    """For example, a container may have read-only package, home and temporary folders."""
    from numba.core.dispatcher import Dispatcher

    def refuse(_: object) -> None:
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(Dispatcher, "enable_caching", refuse)  # is put back, and what Numba does
    monkeypatch.setattr(caches, "_is_writable", lambda _: False)
    monkeypatch.setattr(caches, "_own_folder", lambda: None)
    if given:
        monkeypatch.setenv("NUMBA_CACHE_DIR", given)
    caches.prepare()
    assert numba.njit(cache=True)(lambda x: x + 1)(1) == 2
