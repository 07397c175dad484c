"""Scenes and solvers rebuilt from the settings that metadata record."""

from __future__ import annotations

import json
from typing import Any

from pydantic import ValidationError

from gpe_pl.errors import GpeError
from gpe_pl.solvers.fem import FEM
from gpe_pl.solvers.flip import FLIP
from gpe_pl.solvers.fluid_scenes import FluidScene
from gpe_pl.solvers.mpm import MPM
from gpe_pl.solvers.scenes import BodyScene, SceneDistribution
from gpe_pl.solvers.solid_scenes import SolidScene
from gpe_pl.system.signatures import checked, parameters
from gpe_pl.trajectory.trajectory import Metadata

SOLVERS: dict[str, type] = {"mpm": MPM, "flip": FLIP, "fem": FEM}
SCENES: dict[str, type] = {kind.__name__: kind for kind in (BodyScene, FluidScene, SolidScene)}


class NotRecorded(GpeError, ValueError):
    """Raised when metadata do not have the settings of a scene or solver of this package."""


def recorded_scene(metadata: Metadata) -> SceneDistribution:
    """Return the distribution of scenes that trajectories with these metadata come from."""
    scene: SceneDistribution = _rebuilt(metadata, "scene", SCENES, "kind")
    return scene


def recorded_solver(metadata: Metadata, **replaced: Any) -> Any:
    """Return the solver that computed trajectories with these metadata. ``replaced`` are other values of its settings."""
    return _rebuilt(metadata, "solver", SOLVERS, "name", **replaced)


def settings(metadata: Metadata) -> dict[str, Any]:
    """Return the recorded settings of scene and solver; raises ``NotRecorded`` if there are none."""
    try:
        values = json.loads(metadata.config)
    except ValueError:
        values = None
    if not isinstance(values, dict) or not {"scene", "solver"} <= values.keys():
        raise NotRecorded(
            f"data set {metadata.dataset!r} comes from {metadata.solver or 'elsewhere'}, so its scenes and solver are not known here"
        )
    return values


def _rebuilt(metadata: Metadata, part: str, known: dict[str, type], name: str, **replaced: Any) -> Any:
    values = settings(metadata)[part]
    kind = known.get(values.get(name))
    if kind is None:
        raise NotRecorded(f"data set {metadata.dataset!r} has a {part} {values.get(name)!r}; known are {', '.join(known)}")
    own = {key: value for key, value in {**values, **replaced}.items() if key in parameters(kind)}
    try:
        return kind(**checked(kind, own))
    except (ValidationError, ValueError) as error:
        raise NotRecorded(
            f"data set {metadata.dataset!r}: the settings of its {part} do not fit this version ({str(error).splitlines()[0]})"
        ) from None
