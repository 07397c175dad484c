"""Checks that a solver supports the surroundings of a scene: walls and obstacles at rest, given by shapes, in a domain that is not periodic."""

from __future__ import annotations

import numpy as np

from gpe_pl.geometry.shape_values import shape_fault
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.trajectory.boundary import Boundary, has_nodes_beside_shapes
from gpe_pl.trajectory.state import State

NEAR = 0.01
"""Distance from a shape up to which a node may be of it rather than of the nearest one, as a fraction of the size of the boundary."""
MOST_CHECKED = 256
"""Number of boundaries whose comparison with their shapes is remembered. Every step of a scene has the same one."""
_checked: dict[int, tuple[Boundary, str | None]] = {}


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
    if any(shape.restitution != 0 for shape in b.shapes):
        raise SimulationError(
            f"{solver} takes walls and obstacles from the shapes of the boundary, and a shape has restitution, which it does not compute",
            reason="input",
        )
    if (conflict := boundary_conflict(b)) is not None:
        raise SimulationError(f"{solver} takes walls and obstacles from the shapes of the boundary, and {conflict}", reason="input")


def boundary_conflict(boundary: Boundary) -> str | None:
    """Return in which way the nodes of a boundary are not those of its shapes; None if they are. Models read the nodes."""
    if (known := _checked.get(id(boundary))) is not None and known[0] is boundary:
        return known[1]
    found = _compared(boundary) if len(boundary.pos) else None
    while len(_checked) >= MOST_CHECKED:
        _checked.pop(next(iter(_checked)))
    _checked[id(boundary)] = boundary, found
    return found


def _compared(boundary: Boundary) -> str | None:
    shapes, dim = boundary.shapes, boundary.pos.shape[-1]
    if any(shape_fault(shape, dim) for shape in shapes):
        return None  # solvers name these
    if has_nodes_beside_shapes(boundary):
        return "some of its nodes are on none of them; pass a shape for each, or use Boundary.sample"
    pos, friction = np.asarray(boundary.pos, np.float64), np.asarray(boundary.friction, np.float64)
    distance = np.abs([shape.signed_distance(pos) for shape in shapes])
    near = distance <= distance.min(axis=0) + NEAR * float(np.ptp(pos, axis=0).max())  # a node in a corner is on two walls
    alike = np.isclose(np.array([[shape.friction] for shape in shapes]), friction, rtol=1e-5, atol=1e-6)
    wrong = np.flatnonzero(~(near & alike).any(axis=0))
    if len(wrong):
        own = shapes[int(distance[:, wrong[0]].argmin())].friction
        return f"its boundary_node {wrong[0]} has the friction {friction[wrong[0]]:g}, the shape there {own:g}; give both the same"
    return None


def _moves(boundary: Boundary) -> bool:
    """Tell whether any boundary node moves, now or later."""
    motion = boundary.motion
    later = motion is not None and bool(np.any(motion.vel != 0) or np.any(motion.pos != motion.pos[:1]))
    return later or bool(np.any(np.asarray(boundary.vel) != 0))
