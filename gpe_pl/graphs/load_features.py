"""Features of the loads of a scene: nodes whose motion is given, and forces on nodes. Data sets without loads have none of them.

Channels follow those of motion and gravity in ``x`` of each material. For given motion they are 1 at nodes that are prescribed along all axes and 0 elsewhere,
and by how much the velocity of a prescribed node will change to its next position, which is 0 along axes that are not given. Data sets with nodes that are
prescribed along some axes only also have 1 for each axis along which a node is. For forces they are f/m. Values are in the units of ``features.Scales``.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.graphs.features import Scales
from gpe_pl.graphs.standards import Standards
from gpe_pl.graphs.topology import Topology
from gpe_pl.schema import FeatureSpec
from gpe_pl.trajectory.loads import Loads
from gpe_pl.trajectory.state import State


def add_loads(
    data: HeteroData,
    topology: Topology,
    state: State,
    spec: FeatureSpec,
    scales: Scales,
    standards: Standards | None,
    precision: torch.dtype,
) -> None:
    """Append the features of loads to ``x`` of each material, and store what models need of the loads.

    Stores get ``prescribed`` [node, dim], true along axes along which the motion is given, and ``load`` [node, dim], the acceleration f/m in m/s². They have
    only the entries of the loads that the data set has.

    Args:
        data: graph of the state, whose ``x`` has motion and gravity.
        topology: topology of the state.
        state: the state, as tensors.
        spec: channels of the graph.
        scales: units of features.
        standards: statistics with which features are standardised; None leaves them as they are.
        precision: precision of features.
    """
    prescribed, change, load = _values(state, scales)
    columns = torch.cat([*_columns(spec.loads, prescribed, change / scales.velocity, load / scales.acceleration)], dim=1).to(precision)
    for material, rows in topology.rows.items():
        own, store = columns[rows], data[material]
        if standards is not None:
            mean, inverse = (torch.from_numpy(values[-own.shape[1] :]).to(own) for values in standards.node[material])
            own = (own - mean) * inverse
        store.x = torch.cat([store.x, own], dim=1)
        if "motion" in spec.loads:
            store.prescribed = prescribed[rows]
            if spec.cells and material in spec.meshes:  # the law keeps this velocity within the frame, and walls do not stop it
                held = store.prescribed
                given = (state.vel + change)[rows].to(store.velocity) * scales.frame_dt
                mean, at_frame = store.velocity.split(spec.dim, dim=1)
                store.velocity = torch.cat([mean, torch.where(held, given, at_frame)], dim=1)
                store.wall = torch.where(held.all(dim=1, keepdim=True), 0.0, store.wall)
        if "force" in spec.loads:
            store.load = load[rows].to(precision)


def _columns(loads: Iterable[str], prescribed: Tensor, change: Tensor, load: Tensor) -> Iterable[Tensor]:
    if "motion" in loads:
        yield from (prescribed.all(dim=1, keepdim=True).to(change.dtype), change)
    if "sliding" in loads:
        yield prescribed.to(change.dtype)
    if "force" in loads:
        yield load


def _values(state: State, scales: Scales) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mask of given motion [node, dim], the changes of these velocities [node, dim] in m/s, and f/m [node, dim] in m/s²."""
    loads, nothing = state.loads, torch.zeros_like(state.pos)
    if loads is None:
        return torch.zeros_like(nothing, dtype=torch.bool), nothing, nothing
    prescribed = torch.tensor(loads.prescribed, device=state.pos.device)  # a copy: stored arrays may be read-only
    change = next_velocity(loads, state, scales.frame_dt) - state.vel
    force = nothing if loads.force is None else torch.from_numpy(loads.force[0].astype("float64")).to(state.pos.device)
    return prescribed, torch.where(prescribed, change, 0.0), force / state.mass[:, None]


def next_velocity(loads: Loads, state: State, dt: float) -> Tensor:
    """Return the velocities [node, dim] in m/s that take prescribed nodes to their next positions within a frame of ``dt`` [s]; zero at other nodes."""
    return state.periodicity.shortest(loads.moved(state.pos) - state.pos) / dt
