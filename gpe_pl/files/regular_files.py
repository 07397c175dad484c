"""What is read from a path that others chose is a regular file: a pipe or a device in its place never ends."""

from __future__ import annotations

import errno
from pathlib import Path


def check(path: Path) -> None:
    """Raise ``OSError`` where something else than a regular file, or a link to one, lies at a path; where nothing does, whoever opens it says so."""
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "is no file", str(path))
