"""Checks, before long work begins, that its results can be written."""

from __future__ import annotations

import os
from pathlib import Path


def folder_fault(folder: Path) -> str:
    """Return why files cannot be written into a folder, which may not exist yet; empty if they can."""
    existing = next(part for part in (folder.absolute(), *folder.absolute().parents) if part.exists())
    if not existing.is_dir():
        return f"{existing} is a file and no folder"
    return "" if os.access(existing, os.W_OK | os.X_OK) else f"the folder {existing} does not let you write"


def file_fault(path: Path) -> str:
    """Return why a file cannot be written; empty if it can."""
    return f"{path} is a folder" if path.is_dir() else folder_fault(path.parent)
