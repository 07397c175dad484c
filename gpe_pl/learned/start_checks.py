"""Checks of the state from which a trained simulator starts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import torch

from gpe_pl.errors import GpeError
from gpe_pl.geometry.shapes import signed_distance
from gpe_pl.graphs.contacts import convex_corners
from gpe_pl.graphs.features import history_of
from gpe_pl.models.base import Model
from gpe_pl.rollout.guard import unsound
from gpe_pl.schema import LARGEST, node_code
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata

DEEPEST = 0.5
"""Depth in walls and obstacles from which a start is warned of [rest spacings]. Nodes of some solvers rest a little inside a surface."""


class SceneError(GpeError, ValueError):
    """Raised when a scene does not fit a trained simulator, or has invalid values."""


class DerivativeError(GpeError, ValueError):
    """Raised instead of gradients that would be wrong."""


def check_derivatives(model: Model, states: Iterable[State], spacing: float) -> None:
    """Check that gradients of a step are right with respect to boundary nodes. The elastic law takes walls from shapes, which have no gradients.

    Args:
        model: model of the step.
        states: states of the scenes, as tensors.
        spacing: rest spacing [m].

    Raises:
        DerivativeError: the model has the elastic law, boundary nodes need gradients, and the scene has shapes, corners, or normals that need gradients.
    """
    if not torch.is_grad_enabled() or not model.settings.get("elastic"):
        return
    for boundary in (state.boundary for state in states):
        sought = [name for name in ("pos", "normal", "friction") if getattr(boundary, name).requires_grad]
        if sought and (boundary.shapes or "normal" in sought or (boundary.pos.shape[1] == 2 and len(convex_corners(boundary, spacing)))):
            raise DerivativeError(
                f"boundary {', '.join(sought)}: models with model.elastic=true have no gradients with respect to walls and obstacles; "
                "use finite differences, or detach these tensors"
            )


def check_start(state: State, metadata: Metadata, where: str) -> None:
    """Check that a rollout can start from a state (``guard.unsound``). Positions, velocities, masses and material parameters have messages of their own.

    Args:
        state: state of the scene, as tensors.
        metadata: metadata of the scene.
        where: frame of the state, for messages.

    Raises:
        SceneError: a value is not finite or breaks its rule, and the message names the node; or an array or shape of the scene is wrong.
    """
    at_frame = state.vel if state.frame_velocity is None else state.frame_velocity
    for name, values in (("pos", state.pos), ("velocity", history_of(state)), ("velocity at the frame", at_frame)):
        bad = ~(values.abs() <= LARGEST).flatten(1).all(dim=1)  # also finds NaN
        if bad.any():
            raise SceneError(
                f"{where}: node {int(bad.nonzero()[0])} has a {name} that is not finite or too large; correct it, or start at another frame"
            )
    bad = ~(torch.isfinite(state.mass) & (state.mass > 0))
    if bad.any():
        node = int(bad.nonzero()[0])
        raise SceneError(f"node {node} has a mass of {float(state.mass[node]):g} kg; give every node a positive and finite mass")
    wrong = unsound(state, metadata)
    if wrong is not None and wrong.reason != "material":
        raise SceneError(f"{where}: {wrong.message}")
    for material in metadata.materials:
        rows = torch.nonzero(state.node_type == node_code(material)).flatten()
        for spec, number in zip(metadata.parameters_of(material), metadata.columns_of(material), strict=True):
            column = state.material_params[rows, number]
            bad = ~spec.accepts(column)
            if bad.any():
                node, value = int(rows[bad][0]), float(column[bad][0])
                raise SceneError(f"node {node} ({material}): {spec.name} is {spec.quantity(value)}, must be {spec.rule}")


def inside_obstacles(state: State, spacing: float) -> Iterator[tuple[str, str]]:
    """Yield a kind and a line that says how many nodes start inside walls and obstacles, if any. Containment moves such nodes out within a frame.

    Args:
        state: state of the scene, as tensors.
        spacing: rest spacing [m].
    """
    if not state.boundary.shapes:
        return
    depth = -signed_distance(state.boundary.shapes, state.pos)
    if state.loads is not None:  # clamped nodes may be inside what holds them
        depth[state.loads.rows] = 0.0
    deep = depth > DEEPEST * spacing
    if bool(deep.any()):
        yield (
            "nodes inside obstacles",
            f"{int(deep.sum())} of {state.num_nodes} nodes start inside walls or obstacles, up to {float(depth.max()):.3g} m deep",
        )
