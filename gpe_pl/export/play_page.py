"""The page to play with: a folder that any file server can serve, in which a learned model runs in the browser.

The folder needs neither Python nor a network. It contains ``index.html``, ``play.css``, ``play.js`` and a file per model, ``model_0.js`` and so on. The parts
are in ``play/``: modules that Node runs as they are, and that ``bundled`` joins into one script, so that the page also opens from a disk. The network runs in
WebAssembly that the script writes itself (``play/kernels.mjs``), so no binary is shipped.
"""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.errors import GpeError
from gpe_pl.export.play_model import PageError, model_for_page
from gpe_pl.export.play_scene import check_boundary, state_for_page
from gpe_pl.files.atomic import replace_text
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

PARTS = Path(__file__).parent / "play"
MODULES = ("kernels", "network", "shapes", "step", "world", "view", "play")
"""Modules of the page; each imports from those before it."""
LEVELS = 65535
"""Largest value of the 16-bit integers that store the positions of a film over the domain."""


class PageFolderError(GpeError, ValueError):
    """Raised when a page has no model."""


@dataclass(frozen=True)
class SolverFilm:
    """A trajectory of a solver, which the page shows beside the model from the same start.

    Attributes:
        name: name of the scene on the page.
        trajectory: ground truth with as many frames before the start as the model needs.
    """

    name: str
    trajectory: Trajectory


def write_page(
    folder: Path | str, simulators: Mapping[str, LearnedSimulator], films: Mapping[str, Sequence[SolverFilm]] | None = None
) -> Path:
    """Write a page into a folder and return the path of its ``index.html``.

    Args:
        folder: folder of the page; made if it is missing.
        simulators: models by name; the page begins with the first.
        films: films of the solver by name of the model.

    Raises:
        PageFolderError: there is no model.
        PageError: the page cannot compute a model or a film's walls, or a film has another gravity or domain than its model.
        SceneError: a film does not fit its model.
    """
    if not simulators:
        raise PageFolderError("a page needs at least one model")
    folder = Path(folder)
    texts = {"play.js": bundled(), "play.css": (PARTS / "play.css").read_text(encoding="utf-8")}
    scripts = [
        f"model_{number}.js" for number in range(len(simulators))
    ]  # names may have # or %, which browsers read as parts of an address
    for script, (name, simulator) in zip(scripts, simulators.items(), strict=True):
        texts[script] = _model_script(name, simulator, (films or {}).get(name, ()))
    materials = dict.fromkeys(simulator.builder.spec.materials[0] for simulator in simulators.values())
    parts = {
        "materials": html.escape(", ".join(materials)),
        "models": "\n".join(f'<script src="{script}"></script>' for script in scripts),
    }
    page = (PARTS / "index.html").read_text(encoding="utf-8")
    texts["index.html"] = re.sub(r"\{\{(\w+)\}\}", lambda slot: parts[slot[1]], page)
    for name, text in texts.items():
        replace_text(folder / name, text)
    return folder / "index.html"


def _model_script(name: str, simulator: LearnedSimulator, films: Sequence[SolverFilm]) -> str:
    about, numbers = model_for_page(simulator)
    about |= {"name": name, "weights": _base64(numbers), "scenes": [_scene(simulator, film) for film in films]}
    return f"(window.gpeModels ||= []).push({json.dumps(about, allow_nan=False)});\n"


def check_film(metadata: Metadata, trajectory: Trajectory) -> None:
    """Raise ``PageError`` for a scene that a page cannot show beside a model with these metadata."""
    for name, own, other in (
        ("gravity", metadata.gravity, trajectory.metadata.gravity),
        ("bounds", metadata.bounds, trajectory.metadata.bounds),
    ):
        if not np.allclose(own, other):
            raise PageError(
                f"the scene has {name}={list(other)}, a page has that of the model, {list(own)}; leave this scene, or the page, out"
            )
    check_boundary(trajectory.boundary, metadata.spacing)


def _scene(simulator: LearnedSimulator, film: SolverFilm) -> dict[str, Any]:
    """Return the start of a film, and its positions from there on, rounded to 16 bits over the domain."""
    builder, first = simulator.builder, simulator.builder.config.history
    trajectory = film.trajectory
    check_film(builder.metadata, trajectory)
    columns = builder.metadata.columns_of(builder.spec.materials[0])
    start = state_for_page(simulator.initial_state(trajectory, first), columns, builder.metadata.spacing)
    low, high = np.asarray(builder.metadata.bounds, float).T
    place = (trajectory.pos[first:].astype(np.float64) - low) / (high - low)
    levels = np.round(LEVELS * np.clip(place, 0, 1)).astype("<u2")
    return {"name": film.name, "numFrames": len(levels), "film": _base64(levels), **start}


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


def bundled() -> str:
    """Return the modules of the page as one script. Each becomes a function that returns what it exports."""
    return '"use strict";\n' + "\n".join(_as_function(name, (PARTS / f"{name}.mjs").read_text(encoding="utf-8")) for name in MODULES)


def _as_function(name: str, text: str) -> str:
    text = re.sub(r'^import (\{[^}]*\}) from "\./(\w+)\.mjs";$', r"const \1 = gpe_\2;", text, flags=re.MULTILINE)
    exported = re.findall(r"^export (?:const|class|function) (\w+)", text, flags=re.MULTILINE)
    text = re.sub(r"^export ", "", text, flags=re.MULTILINE)
    return f"const gpe_{name} = (() => {{\n{text}\nreturn {{ {', '.join(exported)} }};\n}})();\n"
