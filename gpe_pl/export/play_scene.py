"""Scenes of the page as plain values: nodes, walls and obstacles."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from gpe_pl.export.play_model import PageError
from gpe_pl.export.program import refuse_loads, refuse_openings, refuse_rigid_bodies
from gpe_pl.geometry.shapes import Shape
from gpe_pl.solvers.supported import boundary_conflict
from gpe_pl.trajectory.boundary import Boundary, as_numpy
from gpe_pl.trajectory.state import State

KINDS = ("wall", "sphere", "bowl", "box", "polygon")
"""Kinds of walls and obstacles that the page knows."""
NEAR = 1e-3
"""Largest difference between boundary nodes of the page and of a scene, which files store in single precision: in spacings, or of one of their values."""


def shape_for_page(shape: Shape) -> dict[str, Any]:
    """Return a wall or obstacle as plain values.

    Raises:
        PageError: the page does not know this kind.
    """
    if shape.kind not in KINDS:
        raise PageError(f"the page knows walls and obstacles of the kinds {', '.join(KINDS)}, and not {shape.kind}; leave this scene out")
    return {"kind": shape.kind, **asdict(shape)}  # type: ignore[call-overload]


def check_boundary(boundary: Boundary, spacing: float) -> None:
    """Raise ``PageError`` for walls and obstacles that move, or whose points are not those that the page takes from their shapes.

    Args:
        boundary: walls and obstacles of a scene.
        spacing: spacing of the model [m], at which the page places points on shapes.
    """
    if boundary.motion is not None or bool((as_numpy(boundary.vel) != 0).any()):
        raise PageError("pages have walls and obstacles that stand still; leave out scenes in which they move")
    if len(boundary.pos) and not boundary.shapes:
        raise PageError("pages compute walls and obstacles from their shapes; leave out scenes whose boundary has points only")
    if (conflict := boundary_conflict(boundary)) is not None:
        raise PageError(f"pages compute walls and obstacles from their shapes, and {conflict}")
    if not _is_sampled(boundary, spacing):
        raise PageError(
            f"pages have boundary nodes {spacing:g} m apart on all walls and obstacles, and this scene has others; "
            "take those of Boundary.sample, or leave the scene out"
        )


def _is_sampled(boundary: Boundary, spacing: float) -> bool:
    """Tell whether boundary nodes are those of ``Boundary.sample``, in any order."""
    own, sampled = (_values(b, spacing) for b in (boundary, Boundary.sample(boundary.shapes, spacing, boundary.pos.shape[-1])))
    if len(own) != len(sampled) or not len(own):
        return len(own) == len(sampled)
    farthest = max(KDTree(a).query(b, p=np.inf)[0].max() for a, b in ((own, sampled), (sampled, own)))
    return bool(farthest <= NEAR)


def _values(boundary: Boundary, spacing: float) -> np.ndarray:
    """Return what a model reads of boundary nodes at rest [boundary_node, value], with positions in spacings and friction as an angle."""
    arrays = boundary.pos, boundary.normal, boundary.friction, boundary.restitution
    pos, normal, friction, restitution = (np.asarray(as_numpy(x), np.float64) for x in arrays)
    return np.column_stack([pos / spacing, normal, np.arctan(friction), restitution])


def state_for_page(state: State, columns: list[int], spacing: float) -> dict[str, Any]:
    """Return a state with velocity history as plain values.

    Args:
        state: state whose nodes all have one material.
        columns: columns of the material's parameters.
        spacing: spacing of the model [m].

    Raises:
        PageError: the page does not know a wall or obstacle, walls move, or have other points than the page.
        RigidBodyError: the state has rigid bodies.
        OpenSceneError: the state has inlets or outlets.
        NodeLoadError: the state has prescribed nodes or forces.
    """
    refuse_rigid_bodies(state.rigid_body)
    refuse_openings(state)
    refuse_loads(state)
    check_boundary(state.boundary, spacing)
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
