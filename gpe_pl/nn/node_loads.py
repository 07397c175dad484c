"""Forces on nodes in a model: accelerations f/m in the unit of the model's accelerations, by material. Graphs of data sets without forces have none."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import torch
from jaxtyping import Int64
from torch import Tensor
from torch_geometric.data import HeteroData


def scaled(data: HeteroData, materials: Sequence[str], unit: Tensor) -> HeteroData:
    """Divide the accelerations by forces in a graph by a unit [m/s²], in place, and return the graph."""
    for material in materials:
        if "load" in data[material]:
            data[material].load = data[material].load / unit.to(data[material].load)
    return data


def loads_of(data: HeteroData, materials: Collection[str], by_law: Collection[str]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return the accelerations by forces of the materials outside ``by_law``, and of those in it [node, dim]."""
    load = {m: data[m].load for m in materials if "load" in data[m]}
    return {m: values for m, values in load.items() if m not in by_law}, {m: values for m, values in load.items() if m in by_law}


def plus(acceleration: Mapping[str, Tensor], load: Mapping[str, Tensor], factor: float = 1.0) -> dict[str, Tensor]:
    """Return accelerations with those by forces added, multiplied by a factor."""
    return {m: a + factor * load[m] if m in load else a for m, a in acceleration.items()}


def without_held_bodies(data: HeteroData, materials: Sequence[str], body: Int64[Tensor, " node"], count: int) -> Int64[Tensor, " node"]:
    """Return the body of each node of these materials, −1 also for bodies with a node whose motion is given: contacts alone do not move those.

    Args:
        data: graph.
        materials: materials of the nodes, in their order.
        body: body of each node; −1 stands for none.
        count: number of bodies, or an upper bound of it.
    """
    if not any("prescribed" in data[m] for m in materials):
        return body
    is_held = body.new_zeros(count + 1, dtype=torch.bool)
    is_held[body[torch.cat([data[m].prescribed.any(dim=1) for m in materials])]] = True  # the last entry is that of −1
    return torch.where(is_held[body], -1, body)
