"""Provenance of results: commands write ``provenance.json`` into the results folder."""

from __future__ import annotations

import contextlib
import importlib.metadata
import logging
import re
import shlex
import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gpe_pl.files import sealed
from gpe_pl.system.machine import environment

log = logging.getLogger(__name__)

PROVENANCE = "provenance.json"
PACKAGES = ("torch", "torch-geometric", "lightning", "numpy", "numba")
ADVICE = "delete the file; only the record of how the results were made is lost"
LOCAL = ("paths.", "hydra.run.dir", "hydra.sweep.dir")
"""Prefixes of overrides that name folders. Results do not depend on them."""


RESULTS = ("*.json", "*.csv", "*.md", "*/**/config.json")
"""File patterns. A folder with at least one match contains results."""


@contextlib.contextmanager
def recorded(folder: Path, command: str, arguments: Sequence[str], runs: str) -> Iterator[None]:
    """Add a session to ``provenance.json`` in a results folder when the block ends, with or without an error.

    A folder without results (``RESULTS``) gets no file. A killed session is not recorded, so the total time of a resumed command may be too short. If the
    file cannot be written, or the present one is damaged, a warning is logged.

    Args:
        folder: folder of the results.
        command: name of the command, such as ``fit``, or path of a script, such as ``docs/active_curve.py``.
        arguments: arguments of its command line.
        runs: folder of all results; written as ``paths.runs``.
    """
    began, started = datetime.now(UTC), time.monotonic()
    try:
        yield
    finally:
        path = folder / PROVENANCE
        if any(found != path for pattern in RESULTS for found in folder.glob(pattern)):
            session = {
                "command": shown(command, arguments, runs),
                "began": began.isoformat(timespec="seconds"),
                "seconds": round(time.monotonic() - started, 1),
                **{key: value for key, value in environment().items() if key != "time"},
                "packages": {name: importlib.metadata.version(name) for name in PACKAGES},
            }
            try:
                sealed.write(path, {"sessions": [*sessions(folder), session]})
            except (OSError, sealed.SealError) as error:
                log.warning("provenance of these results was not recorded: %s", error)


def sessions(folder: Path) -> list[dict[str, Any]]:
    """Return the sessions recorded in a folder.

    Raises:
        SealError: the file is damaged.
    """
    path = folder / PROVENANCE
    return list(sealed.read(path, ADVICE)["sessions"]) if path.exists() else []


def shown(command: str, arguments: Sequence[str], runs: str) -> str:
    """Return a command line that repeats the command, without the overrides in ``LOCAL`` and with ``paths.runs`` in place of the folder ``runs``."""
    folder = re.compile(rf"(?<![^=,\[\"' ]){re.escape(runs)}(?![^/,\]\"' ])")  # as a whole path or the beginning of one
    kept = [folder.sub("paths.runs", argument) for argument in arguments if not argument.lstrip("+").startswith(LOCAL)]
    program = [command] if command.endswith(".py") else ["-m", f"gpe_pl.{command}"]
    return shlex.join(["python", *program, *kept])
