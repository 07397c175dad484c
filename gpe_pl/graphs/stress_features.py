"""The stress of the present frame as features of the nodes of materials that have one, with ``GraphConfig.stress``.

It is the true stress in training windows and at the start of a rollout, and the model's own prediction in the states that follow. Channels are the components
of the Cauchy stress in Pa. They follow those of motion and gravity in ``x``, and precede those of loads.
"""

from __future__ import annotations

import torch
from torch_geometric.data import HeteroData

from gpe_pl.graphs.standards import Standards
from gpe_pl.graphs.topology import Topology
from gpe_pl.schema import FeatureSpec
from gpe_pl.trajectory.state import State


def add_stress(
    data: HeteroData, topology: Topology, state: State, spec: FeatureSpec, standards: Standards | None, precision: torch.dtype
) -> None:
    """Append the stress of a state to ``x`` of each material that has one.

    Args:
        data: graph of the state, whose ``x`` has motion and gravity.
        topology: topology of the state.
        state: the state, as tensors; it must have a stress.
        spec: channels of the graph.
        standards: statistics with which features are standardised; None leaves them as they are.
        precision: precision of features.
    """
    assert state.stress is not None
    for material in spec.stress_channels:
        store = data[material]
        own, first = state.stress.node[topology.rows[material]].to(precision), store.x.shape[1]
        if standards is not None:
            mean, inverse = (torch.from_numpy(values[first : first + own.shape[1]]).to(own) for values in standards.node[material])
            own = (own - mean) * inverse
        store.x = torch.cat([store.x, own], dim=1)
