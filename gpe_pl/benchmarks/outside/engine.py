"""What the modules of other engines share: what they return, how their programs run, and the error if one fails."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpe_pl.errors import GpeError
from gpe_pl.trajectory.state import Stress


class EngineError(GpeError, RuntimeError):
    """Raised when another engine fails; the message has its last lines."""


@dataclass(frozen=True)
class Motion:
    """What an engine did with a scene.

    Attributes:
        pos: positions [frame, node, dim] in m; the first frame is the initial state.
        vel: velocities at the frames [frame, node, dim] in m/s; None if the engine does not tell.
        stress: Cauchy stress in Pa with a leading axis of frames; None if the engine has none at nodes of a mesh.
    """

    pos: np.ndarray
    vel: np.ndarray | None = None
    stress: Stress | None = None


def last_lines(text: str, count: int = 4) -> str:
    """Return the last lines of a text that are not empty, on one line."""
    return " / ".join([line.strip() for line in text.splitlines() if line.strip()][-count:])


def output_of(engine: str, command: Sequence[str], folder: Path, seconds: int) -> str:
    """Run the program of an engine in a folder, and return what it printed and how it ended.

    Raises:
        EngineError: the program took longer than ``seconds``.
    """
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, encoding="utf-8", errors="replace", timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        raise EngineError(f"{engine}: took longer than {seconds} s") from None
    return f"{done.stdout}{done.stderr}\nended with status {done.returncode}"


def frames_of(engine: str, module: str, folder: Path, num_frames: int, seconds: int) -> np.ndarray:
    """Return the array that a module of this package stores as ``frames.npy`` in a folder, when it runs as a program of its own.

    Raises:
        EngineError: the program stored nothing, or took longer than ``seconds``.
    """
    said = output_of(engine, [sys.executable, "-m", module, str(folder), str(num_frames)], Path.cwd(), seconds)
    stored = folder / "frames.npy"
    if not stored.is_file():
        raise EngineError(f"{engine}: stored no frames; its last lines are: {last_lines(said)}")
    return np.asarray(np.load(stored))
