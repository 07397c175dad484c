"""Names that notebooks import from the package exist. The notebooks themselves run among the slow tests."""

from __future__ import annotations

import ast
import importlib
import json
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))


def imported(path: Path) -> list[tuple[str, str]]:
    """Modules and names in ``from gpe_pl… import …`` of a notebook's code."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    lines = [line for cell in cells if cell["cell_type"] == "code" for line in cell["source"] if not line.startswith(("%", "!"))]
    code = "".join(line if line.endswith("\n") else f"{line}\n" for line in lines)
    nodes = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.ImportFrom)]
    return [(node.module, name.name) for node in nodes if node.module and node.module.startswith("gpe_pl") for name in node.names]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_imported_names_exist(path: Path) -> None:
    names = imported(path)
    assert names
    for module, name in names:
        assert hasattr(importlib.import_module(module), name), f"{module}: {name}"
