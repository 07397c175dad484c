"""Text is UTF-8 with any locale of the machine."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.architecture.test_imports import MODULES, ROOT, dotted, syntax


def without_encoding(tree: ast.Module) -> Iterator[int]:
    """Return lines that read or write text in the encoding of the locale."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or any(keyword.arg == "encoding" for keyword in node.keywords):
            continue
        name = node.func.id if isinstance(node.func, ast.Name) else node.func.attr if isinstance(node.func, ast.Attribute) else ""
        values = [value.value for value in [*node.args, *(k.value for k in node.keywords)] if isinstance(value, ast.Constant)]
        is_text = name in ("open", "fdopen") and isinstance(node.func, ast.Name) and not any("b" in v for v in values if isinstance(v, str))
        is_method = name in ("read_text", "write_text") and isinstance(node.func, ast.Attribute)
        if is_text or is_method or any(keyword.arg in ("text", "universal_newlines") for keyword in node.keywords):
            yield node.lineno


NAMES = ("open(", "read_text", "write_text", "text=", "universal_newlines")
"""What ``without_encoding`` looks for. Other files are not parsed, which takes seconds."""


def test_text_has_an_encoding() -> None:
    read = [path for path in MODULES if any(name in path.read_text(encoding="utf-8") for name in NAMES)]
    assert not [f"{dotted(path)}:{line}" for path in read for line in without_encoding(syntax(path))]


def test_lines_without_an_encoding_are_found() -> None:
    source = "open(a)\nopen(a, 'rb')\np.read_text()\np.write_text(t, encoding='utf-8')\nrun(c, text=True)\nopen(a, mode='w')"
    assert list(without_encoding(ast.parse(source))) == [1, 3, 5, 6]


@pytest.mark.slow
def test_a_command_prints_utf8_in_a_latin_locale(tmp_path: Path) -> None:
    """The line has characters that Latin-1 lacks, and a name that is not UTF-8."""
    environment = {**os.environ, "PYTHONIOENCODING": "latin-1", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C"}
    command = [sys.executable, "-m", "gpe_pl.data.validate", str(tmp_path / "größe … 数")]
    child = subprocess.run(command, capture_output=True, cwd=ROOT, env=environment, check=False)
    assert child.returncode == 1 and "größe … 数" in child.stdout.decode("utf-8"), child.stderr
