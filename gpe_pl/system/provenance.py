"""Where results come from: ``provenance.json`` beside them, which commands write."""

from __future__ import annotations

import contextlib
import importlib.metadata
import logging
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
"""Begin overrides that say where files lie, which results do not depend on."""


RESULTS = ("*.json", "*.csv", "*.md", "*/**/config.json")
"""Patterns of which a folder has one where there are results."""


@contextlib.contextmanager
def recorded(folder: Path, command: str, arguments: Sequence[str], runs: str) -> Iterator[None]:
    """Note in a folder how a command came to the results in it: a session more in ``provenance.json``, however the command ends.

    A session that is killed is not noted, so the seconds of a resumed command may lack some. Where the file cannot be written, a warning says so.

    Args:
        folder: of the results.
        command: ``fit`` and so on.
        arguments: of its command line.
        runs: the folder of all results, which is written as ``paths.runs``.
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
                log.warning("how these results were made is not noted: %s", error)


def sessions(folder: Path) -> list[dict[str, Any]]:
    """What is noted in a folder; raises ``SealError`` where that is damaged."""
    path = folder / PROVENANCE
    return list(sealed.read(path, ADVICE)["sessions"]) if path.exists() else []


def shown(command: str, arguments: Sequence[str], runs: str) -> str:
    """A command as one would type it, without the folders of one machine."""
    kept = [argument.replace(runs, "paths.runs") for argument in arguments if not argument.lstrip("+").startswith(LOCAL)]
    return shlex.join(["python", "-m", f"gpe_pl.{command}", *kept])
