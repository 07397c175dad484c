"""Checks that a solver supports the surroundings of a scene: walls and obstacles at rest, given by shapes, in a domain that is not periodic."""

from __future__ import annotations

import numpy as np

from gpe_pl.rollout.loop import SimulationError
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State


def check_surroundings(state: State, solver: str, computes_open_scenes: bool = False) -> None:
    """Raise an error for surroundings that a solver would otherwise ignore silently.

    Args:
        state: state of the scene.
        solver: name of the solver.
        computes_open_scenes: whether it computes scenes with inlets and outlets.

    Raises:
        SimulationError: with reason ``input``. The message names the solver and what it does not compute.
    """
    if state.periodicity:
        axes = ", ".join("xyz"[axis] for axis in state.periodicity.axes)
        raise SimulationError(f"{solver} does not compute periodic domains; the scene repeats along {axes}", reason="input")
    if state.openings and not computes_open_scenes:
        raise SimulationError(f"{solver} does not compute scenes with inlets and outlets; FLIP and MPM do", reason="input")
    if state.loads is not None:
        raise SimulationError(f"{solver} computes neither prescribed nodes nor nodal forces; the scene has some", reason="input")
    if state.rigid_body is not None and np.any(np.asarray(state.rigid_body) >= 0):
        raise SimulationError(f"{solver} does not compute rigid bodies; the scene has some", reason="input")
    b = state.boundary
    if _moves(b) or np.any(np.asarray(b.restitution) != 0):
        raise SimulationError(f"{solver} supports only boundaries at rest and without restitution", reason="input")
    if len(b.pos) and not b.shapes:
        raise SimulationError(
            f"{solver} takes walls and obstacles from the shapes of the boundary, and its {len(b.pos)} nodes have none; pass shapes to Boundary.from_numpy, "
            "or use Boundary.sample",
            reason="input",
        )


def _moves(boundary: Boundary) -> bool:
    """Tell whether any boundary node moves, now or later."""
    motion = boundary.motion
    later = motion is not None and bool(np.any(motion.vel != 0) or np.any(motion.pos != motion.pos[:1]))
    return later or bool(np.any(np.asarray(boundary.vel) != 0))
