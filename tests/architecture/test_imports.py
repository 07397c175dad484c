"""Import rules: the contracts in pyproject.toml, and modules that a reader of data must not load."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.conftest import pytest_configure

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MODULES = sorted((ROOT / "gpe_pl").rglob("*.py"))

# Where the name of a distribution is not the name that one imports.
IMPORT_NAMES = {
    "hydra-core": "hydra",
    "pillow": "PIL",
    "array-api-compat": "array_api_compat",
    "torch-geometric": "torch_geometric",
    "pyyaml": "yaml",
}
PARTS_OF_OTHERS = {"mpl_toolkits": "matplotlib"}


def dotted(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def syntax(path: Path) -> ast.Module:
    """Return the syntax tree of a file; tests share it and must not change it."""
    return ast.parse(path.read_text(encoding="utf-8"))


def loaded_by(*modules: str) -> set[str]:
    """Return the top-level names in ``sys.modules`` of a fresh interpreter that imports these modules."""
    script = f"import json, sys, {', '.join(modules)}; print(json.dumps(sorted({{m.partition('.')[0] for m in sys.modules}})))"
    child = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=False)
    assert child.returncode == 0, child.stderr
    return set(json.loads(child.stdout.splitlines()[-1]))


def test_import_contracts() -> None:
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    child = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert child.returncode == 0, child.stdout + child.stderr


@pytest.mark.slow
def test_data_can_be_read_and_made_without_torch() -> None:
    solvers = [dotted(path) for path in MODULES if "solvers" in path.parts]
    without = (
        "gpe_pl.schema",
        "gpe_pl.geometry.shapes",
        "gpe_pl.trajectory.trajectory",
        "gpe_pl.trajectory.store",
        "gpe_pl.rollout.loop",
        "gpe_pl.rollout.containment",
        "gpe_pl.data.validate",
        "gpe_pl.data.importers",
    )
    assert {"torch", "torch_geometric", "lightning", "hydra", "matplotlib", "wandb"} & loaded_by(*without, *solvers) == set()


HEAVY = {"torch", "torch_geometric", "lightning", "torchmetrics", "numba", "scipy", "h5py", "matplotlib", "pandas", "rich", "wandb"}


@pytest.mark.slow
@pytest.mark.parametrize("command", ["fit", "evaluate"])
def test_help_of_a_command_loads_nothing_heavy(command: str) -> None:
    """So that it takes what Hydra takes to compose a configuration, about a second, and no more."""
    child = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", f"gpe_pl.{command}", "--help"], capture_output=True, text=True, cwd=ROOT
    )
    assert child.returncode == 0 and "--cfg job" in child.stdout
    loaded = {line.rpartition("|")[2].strip().partition(".")[0] for line in child.stderr.splitlines()}
    assert "hydra" in loaded and loaded & HEAVY == set()


def test_commands_load_nothing_heavy_before_they_run() -> None:
    assert HEAVY & loaded_by(*(f"gpe_pl.{command}" for command in ("fit", "simulate", "evaluate", "benchmark"))) == set()


def test_the_package_alone_loads_only_the_standard_library() -> None:
    assert loaded_by("gpe_pl") - set(sys.stdlib_module_names) <= loaded_by("json") | {"gpe_pl"}


def test_every_public_name_is_there_and_known_to_type_checkers() -> None:
    import gpe_pl

    tree = syntax(ROOT / "gpe_pl" / "__init__.py")
    imported = {
        str(alias.asname): f"{node.module}.{alias.name}"
        for block in tree.body
        if isinstance(block, ast.If)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert set(imported) == set(gpe_pl.__all__) <= set(dir(gpe_pl))
    for name, place in imported.items():
        value = getattr(gpe_pl, name)
        assert f"{value.__module__}.{value.__qualname__}" == place
    assert not {path.stem for path in (ROOT / "gpe_pl").iterdir()} & set(imported)  # importing such a module would replace the name
    with pytest.raises(AttributeError, match="has no attribute 'Simulator'; it has Boundary, Circle, Contained, "):
        _ = gpe_pl.Simulator


def test_schema_imports_only_the_standard_library() -> None:
    assert top_level_imports(syntax(ROOT / "gpe_pl" / "schema.py")) <= set(sys.stdlib_module_names)


def top_level_imports(tree: ast.Module) -> set[str]:
    """Return the top-level packages that a module imports at import time, without imports for type checkers."""
    names: set[str] = set()
    pending: list[ast.AST] = [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.Import):
            names.update(alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names.add((node.module or "").partition(".")[0])
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            pending.extend(node.orelse)
        elif not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            pending.extend(ast.iter_child_nodes(node))
    return names


@pytest.mark.slow
def test_no_optional_dependency_at_module_level() -> None:
    """Whoever installs the package without extras can import all of it."""
    required = {re.split(r"[<>=!~\[; ]", text, maxsplit=1)[0] for text in PROJECT["dependencies"]}
    allowed = {IMPORT_NAMES.get(name, name) for name in required} | set(sys.stdlib_module_names) | {"gpe_pl"}
    used = {dotted(path): {PARTS_OF_OTHERS.get(name, name) for name in top_level_imports(syntax(path))} for path in MODULES}
    not_required = {module: names - allowed for module, names in used.items() if names - allowed}
    assert not not_required, "pyproject.toml does not require what these modules import"


NOT_ON_WINDOWS = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}


def test_every_module_can_be_imported_on_windows() -> None:
    assert not [dotted(path) for path in MODULES if NOT_ON_WINDOWS & top_level_imports(syntax(path))]


def test_ci_skips_nothing_for_a_missing_package(monkeypatch: pytest.MonkeyPatch) -> None:
    extras = PROJECT["optional-dependencies"]
    assert f"gpe_pl[{','.join(sorted(set(extras) - {'dev', 'docs', 'notebooks'}))}]" in extras["dev"]
    for file in (".ci/run", ".github/workflows/ci.yml"):
        assert re.search(r"PYTEST_ADDOPTS\W.*--all-extras", (ROOT / file).read_text())
    own = Path(__file__)
    assert not [p for p in (ROOT / "tests").rglob("*.py") if p != own and "find_spec" in p.read_text()], "skip by pytest.importorskip"
    monkeypatch.setattr(pytest, "importorskip", pytest.importorskip)  # restored afterwards
    pytest_configure(SimpleNamespace(getoption=lambda name: name == "--all-extras"))  # type: ignore[arg-type]
    assert pytest.importorskip("json") is json
    with pytest.raises(ModuleNotFoundError):
        pytest.importorskip("no_such_package", reason="not installed")


@pytest.mark.slow
def test_imports_are_absolute_and_explicit() -> None:
    imports = [(dotted(path), node) for path in MODULES for node in ast.walk(syntax(path)) if isinstance(node, ast.ImportFrom)]
    assert imports
    assert not [f"{module}:{node.lineno}" for module, node in imports if node.level > 0], "relative import"
    assert not [f"{module}:{node.lineno}" for module, node in imports if any(alias.name == "*" for alias in node.names)], "import *"


def test_top_level_imports_sees_what_runs_at_import() -> None:
    source = """
import a.b
from c import d
from typing import TYPE_CHECKING
if TYPE_CHECKING:
    import e
try:
    import f
except ImportError:
    import g
class X:
    import h
def later():
    import i
"""
    assert top_level_imports(ast.parse(source)) == {"a", "c", "typing", "f", "g", "h"}


@pytest.mark.slow
def test_the_import_test_can_fail() -> None:
    assert "numpy" in loaded_by("gpe_pl.geometry.shapes")
