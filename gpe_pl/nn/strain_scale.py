"""Scale of a decoded stress: the strain of the bodies after the step.

The stress of a body that is hardly deformed is small. A network that decodes stress in one unit for all frames has an error there that fits large stresses.
Here the network decodes the stress per strain of its scene, which has the same size in all frames. The strain is taken at the positions that the network
predicts, because these are known far better than the stress. A scene without strain has no stress.
"""

from __future__ import annotations

from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch_geometric.data import HeteroData

from gpe_pl.nn.elastic_bodies import CellError, cells_at_rest
from gpe_pl.nn.elastic_motion import Cells

FIRST_GUESS = 0.03
"""Strain at which the scale is 1 before training."""


class StrainScale(nn.Module):
    """Strain of the bodies of each material after a step, per scene, over a learned one.

    No gradient passes to positions.

    Args:
        materials: materials with cells.
        dim: dimension of space.
    """

    acceleration_unit: Tensor

    def __init__(self, materials: tuple[str, ...], dim: int) -> None:
        super().__init__()
        self.dim = dim
        self.typical = nn.ParameterDict({m: nn.Parameter(torch.zeros(())) for m in materials})
        self.register_buffer("acceleration_unit", torch.ones((), dtype=torch.float64))

    def set_units(self, acceleration: float) -> None:
        """Set the unit of predicted accelerations [m/frame²]."""
        self.acceleration_unit.fill_(acceleration)

    def forward(
        self, data: HeteroData, acceleration: dict[str, Tensor], stress: dict[str, Tensor]
    ) -> dict[str, Float[Tensor, "node component"]]:
        """Return the stress of each material after the step.

        Args:
            data: graph.
            acceleration: predicted accelerations without gravity of each material [node, dim], in the unit of accelerations.
            stress: stress per strain of each material [node, component]; that of materials without cells stays as it is.

        Raises:
            CellError: PyTorch Geometric joined the graphs.
        """
        return {m: s * self._scale(data, m, acceleration[m]) if m in self.typical else s for m, s in stress.items()}

    def _scale(self, data: HeteroData, material: str, acceleration: Tensor) -> Float[Tensor, "node 1"]:
        store = data[material]
        if "ptr" in store:
            raise CellError("PyTorch Geometric's Batch does not renumber cells; join graphs with gpe_pl.graphs.batching.batched")
        (mean, at_frame), scene = store.velocity.double().split(self.dim, dim=1), store.batch if "batch" in store else None
        gravity = data.gravity.double() if scene is None else data.gravity.double()[scene]
        way = mean + acceleration.detach().double() * self.acceleration_unit + gravity
        if "prescribed" in store:
            way = torch.where(store.prescribed, at_frame, way)  # there it is the velocity of this frame, see ``graphs.load_features``
        cells = cells_at_rest(material, store.cell_index, store.rest_pos, store.mass, scene)
        strain = rms_strain(store.body_pos.double() + way, cells).to(acceleration)
        factor = strain / FIRST_GUESS * torch.exp(-cast(Tensor, self.typical[material]))
        return factor.expand(len(way))[:, None] if scene is None else factor[scene][:, None]


def rms_strain(pos: Float[Tensor, "node dim"], cells: Cells) -> Float[Tensor, " scene"]:
    """Return the root mean square of the Green strain ``(FᵀF − 1)/2`` over the volume of the cells of each scene; 0 without cells.

    Args:
        pos: positions [m].
        cells: the cells at rest.
    """
    corner = pos[cells.nodes]
    f = torch.einsum("cai,cqaj->cqij", corner - corner[:, :1], cells.gradient)
    strain = 0.5 * (f.transpose(2, 3) @ f - torch.eye(f.shape[-1], dtype=f.dtype, device=f.device))
    square = (strain.square().sum(dim=(2, 3)) * cells.volume).sum(dim=1)
    total, volume = (pos.new_zeros(cells.num_scenes).index_add_(0, cells.scene, x) for x in (square, cells.volume.sum(dim=1)))
    return (total / volume.clamp(min=torch.finfo(volume.dtype).tiny)).sqrt()
