"""Location of the folder ``conf/``."""

from __future__ import annotations

from pathlib import Path


def conf_folder(package: Path) -> Path:
    """Return the copy of ``conf/`` in an installed package, or the folder at the root of a clone."""
    copy = package / "conf"
    return copy if copy.is_dir() else package.parent / "conf"


CONF = conf_folder(Path(__file__).resolve().parents[1])
