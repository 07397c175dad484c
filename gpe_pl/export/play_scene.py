"""Scenes of the page as plain values: nodes, walls and obstacles."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from gpe_pl.export.play_model import PageError
from gpe_pl.export.program import refuse_loads, refuse_openings, refuse_rigid_bodies
from gpe_pl.geometry.shapes import Shape
from gpe_pl.solvers.supported import boundary_conflict
from gpe_pl.trajectory.boundary import Boundary, as_numpy
from gpe_pl.trajectory.state import State

KINDS = ("wall", "sphere", "bowl", "box", "polygon")
"""Kinds of walls and obstacles that the page knows."""


def shape_for_page(shape: Shape) -> dict[str, Any]:
    """Return a wall or obstacle as plain values.

    Raises:
        PageError: the page does not know this kind.
    """
    if shape.kind not in KINDS:
        raise PageError(f"the page knows walls and obstacles of the kinds {', '.join(KINDS)}, and not {shape.kind}; leave this scene out")
    return {"kind": shape.kind, **asdict(shape)}  # type: ignore[call-overload]


def check_boundary(boundary: Boundary) -> None:
    """Raise ``PageError`` for walls and obstacles that move, or whose points are not those of their shapes."""
    if boundary.motion is not None or bool((as_numpy(boundary.vel) != 0).any()):
        raise PageError("pages have walls and obstacles that stand still; leave out scenes in which they move")
    if len(boundary.pos) and not boundary.shapes:
        raise PageError("pages compute walls and obstacles from their shapes; leave out scenes whose boundary has points only")
    if (conflict := boundary_conflict(boundary)) is not None:
        raise PageError(f"pages compute walls and obstacles from their shapes, and {conflict}")


def state_for_page(state: State, columns: list[int]) -> dict[str, Any]:
    """Return a state with velocity history as plain values.

    Args:
        state: state whose nodes all have one material.
        columns: columns of the material's parameters.

    Raises:
        PageError: the page does not know a wall or obstacle, walls move, or have points only.
        RigidBodyError: the state has rigid bodies.
        OpenSceneError: the state has inlets or outlets.
        NodeLoadError: the state has prescribed nodes or forces.
    """
    refuse_rigid_bodies(state.rigid_body)
    refuse_openings(state)
    refuse_loads(state)
    check_boundary(state.boundary)
    history = state.vel[:, None] if state.velocity_history is None else state.velocity_history
    return {
        "count": state.num_nodes,
        "pos": _listed(state.pos),
        "vel": _listed(state.vel),
        "history": _listed(history),
        "mass": _listed(state.mass),
        "params": _listed(as_numpy(state.material_params)[:, columns]),
        "shapes": [shape_for_page(shape) for shape in state.boundary.shapes],
    }


def _listed(values: Any) -> list[float]:
    return np.asarray(as_numpy(values), np.float64).ravel().tolist()
