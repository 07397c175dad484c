"""Tables in the README show the runs in ``docs/results``, and every local link leads to a file."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_tables_are_the_stored_results() -> None:
    check = runpy.run_path(str(ROOT / "docs" / "embed_results.py"))["main"]
    assert check(["--check"]) == 0


def test_local_links_lead_somewhere() -> None:
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md"):
        links = [link for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()) if "://" not in link]
        assert links or page.name != "README.md"
        missing = [link for link in links if not (page.parent / link.partition("#")[0]).exists()]
        assert not missing, f"{page.name}: {missing}"
