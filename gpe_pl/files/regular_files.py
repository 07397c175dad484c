"""Check that a path from outside is a regular file. Reading a pipe or a device could never end."""

from __future__ import annotations

import errno
from pathlib import Path


def check(path: Path) -> None:
    """Check that a path is a regular file or a link to one. A missing file passes; opening it raises its own error.

    Raises:
        OSError: the path is a folder, pipe or device.
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "is no file", str(path))
