"""Deviatoric stress of neo-Hookean cells with a learned shear modulus, for models whose network moves the bodies.

Small strains are small differences of positions, which a network resolves badly. The deviatoric stress of cells follows from positions with the shear modulus
alone. The pressure does not: in nearly incompressible bodies it hangs on changes of the volume that are smaller than the errors of predicted positions. So the
network decodes the stress that is left.
"""

from __future__ import annotations

from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch_geometric.data import HeteroData

from gpe_pl.nn.elastic_bodies import CellError, cells_at_rest
from gpe_pl.nn.elastic_motion import Constants, cauchy_stress


class DeviatorOfCells(nn.Module):
    """Deviatoric Cauchy stress of the cells of each material, at the positions that a network predicts.

    No gradient passes to these positions.

    Args:
        param_channels: number of material parameters of each material with cells.
        dim: dimension of space.
    """

    acceleration_unit: Tensor
    modulus_unit: Tensor

    def __init__(self, param_channels: dict[str, int], dim: int) -> None:
        super().__init__()
        self.dim = dim
        self.constants = nn.ModuleDict({m: Constants(count, viscous=False) for m, count in param_channels.items()})
        self.register_buffer("acceleration_unit", torch.ones((), dtype=torch.float64))
        self.register_buffer("modulus_unit", torch.ones((), dtype=torch.float64))

    def set_units(self, acceleration: float, spacing: float, stress: float) -> None:
        """Set the units of a data set; arguments as in ``ElasticBodies.set_units``."""
        self.acceleration_unit.fill_(acceleration)
        self.modulus_unit.fill_(spacing ** (2 - self.dim) / stress)

    def forward(
        self, data: HeteroData, acceleration: dict[str, Tensor], params: dict[str, Tensor]
    ) -> dict[str, Float[Tensor, "node component"]]:
        """Return the stresses after the step, in the unit of stresses, per material; zero at nodes without a cell.

        Args:
            data: graph.
            acceleration: predicted accelerations without gravity, per material [node, dim], in the unit of accelerations.
            params: standardised material parameters [node, param].

        Raises:
            CellError: PyTorch Geometric joined the graphs.
        """
        return {m: self._deviator(m, data, acceleration[m], params.get(m)) for m in self.constants if m in acceleration}

    def _deviator(self, m: str, data: HeteroData, acceleration: Tensor, params: Tensor | None) -> Tensor:
        store = data[m]
        if "ptr" in store:
            raise CellError("PyTorch Geometric's Batch does not renumber cells; join graphs with gpe_pl.graphs.batching.batched")
        mean = store.velocity[:, : self.dim].double()
        scene = store.batch if "batch" in store else None
        gravity = data.gravity.double() if scene is None else data.gravity.double()[scene]
        way = mean + acceleration.detach().double() * self.acceleration_unit + gravity
        if "prescribed" in store:
            way = torch.where(store.prescribed, mean, way)
        cells = cells_at_rest(m, store.cell_index, store.rest_pos, store.mass, scene)
        own = store.body_pos.new_empty(len(way), 0) if params is None else params
        moduli = [(value * self.modulus_unit)[cells.nodes].mean(dim=1) for value in cast(Constants, self.constants[m])(own)]
        whole = cauchy_stress(store.body_pos.double() + way, (moduli[0], moduli[1], moduli[2]), cells)
        normal = [0, 2, 3] if self.dim == 2 else [0, 3, 5]  # xx, yy, zz in the order of schema.STRESS_COMPONENTS
        pressure = torch.zeros_like(whole)
        pressure[:, normal] = whole[:, normal].mean(dim=1, keepdim=True)
        return (whole - pressure).to(acceleration)
