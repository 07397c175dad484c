"""Opens a page in the browser of the user's desktop, if there is one."""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path


def has_desktop() -> bool:
    """Tell whether a browser with a window can be expected. Browsers in a terminal do not draw the viewer."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_page(path: Path) -> bool:
    """Open a page in a browser; returns whether one was found."""
    return open_address(path.resolve().as_uri())


def open_address(address: str) -> bool:
    """Open an address in a browser; returns whether one was found."""
    return has_desktop() and webbrowser.open(address)
