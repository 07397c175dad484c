"""Modules and functions that can be read in one go."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
MOST_LINES = 600
"""Of a file."""
MOST_FUNCTION_LINES = 80
MOST_ENTRIES = 30
"""Of ``gpe_pl``."""
SHORT_FUNCTIONS = ("fit.py", "evaluate.py", "training", "evaluation", "reports")
"""Files and rooms whose functions tell how a run goes. Kernels and tables of arguments elsewhere may be longer."""


def _functions(path: str) -> Iterator[tuple[str, int]]:
    place = ROOT / "gpe_pl" / path
    for file in [place] if place.is_file() else sorted(place.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.FunctionDef) and node.end_lineno is not None:
                yield f"{file.relative_to(ROOT)}: {node.name}", node.end_lineno - node.lineno + 1


def test_files_are_short() -> None:
    files = [file for folder in ("gpe_pl", "tests", "docs") for file in (ROOT / folder).rglob("*.py")]
    assert len(files) > 400
    assert not [str(file.relative_to(ROOT)) for file in files if len(file.read_text().splitlines()) > MOST_LINES]


def test_functions_that_tell_how_a_run_goes_are_short() -> None:
    functions = [function for path in SHORT_FUNCTIONS for function in _functions(path)]
    assert len(functions) > 100
    assert not [function for function in functions if function[1] > MOST_FUNCTION_LINES]


def test_the_package_has_few_entries() -> None:
    entries = [entry for entry in (ROOT / "gpe_pl").iterdir() if entry.name != "__pycache__"]
    assert 10 < len(entries) <= MOST_ENTRIES
