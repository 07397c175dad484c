"""The map in CONTRIBUTING names every room of the package and nothing else."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_map_names_every_room_and_nothing_else() -> None:
    section = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").split("\n## Where things are\n")[1].split("\n## ")[0]
    drawing = re.search(r"```\n(.*?)```", section, re.DOTALL)
    assert drawing is not None
    named = [name for line in drawing[1].splitlines() for name in re.split(r" {3,}", line.strip())[0].split()]
    rooms = {path.stem for path in (ROOT / "gpe_pl").iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert sorted(named) == sorted(rooms - {"__init__", "__main__"})
