"""Checks of the state from which a trained simulator starts."""

from __future__ import annotations

import torch

from gpe_pl.errors import GpeError
from gpe_pl.graphs.features import history_of
from gpe_pl.schema import node_code
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata


class SceneError(GpeError, ValueError):
    """Raised when a scene does not fit a trained simulator, or has invalid values."""


def check_start(state: State, metadata: Metadata, where: str) -> None:
    """Check that positions, velocities, masses and material parameters can be rolled out.

    Args:
        state: state of the scene, as tensors.
        metadata: metadata of the training data.
        where: frame of the state, for messages.

    Raises:
        SceneError: a value is not finite or breaks its rule; the message names the node.
    """
    at_frame = state.vel if state.frame_velocity is None else state.frame_velocity
    for name, values in (("pos", state.pos), ("velocity", history_of(state)), ("velocity at the frame", at_frame)):
        bad = ~torch.isfinite(values).flatten(1).all(dim=1)
        if bad.any():
            raise SceneError(
                f"{where}: node {int(bad.nonzero()[0])} has a {name} that is not finite; correct it, or start at another frame"
            )
    bad = ~(torch.isfinite(state.mass) & (state.mass > 0))
    if bad.any():
        node = int(bad.nonzero()[0])
        raise SceneError(f"node {node} has a mass of {float(state.mass[node]):g} kg; give every node a positive and finite mass")
    for material in metadata.materials:
        rows = torch.nonzero(state.node_type == node_code(material)).flatten()
        for spec, number in zip(metadata.parameters_of(material), metadata.columns_of(material), strict=True):
            column = state.material_params[rows, number]
            wrong = ~spec.accepts(column)
            if wrong.any():
                node, value = int(rows[wrong][0]), float(column[wrong][0])
                raise SceneError(f"node {node} ({material}): {spec.name} is {spec.quantity(value)}, must be {spec.rule}")
