"""ConvNet: continuous convolutions over particles [Ummenhofer et al. 2020, "Lagrangian Fluid Simulation with Continuous Convolutions", ICLR, section 4;
code: github.com/isl-org/DeepLagrangianFluids, ``models/default_torch.py``].

Layers of the paper, with features f of particles and g of boundary nodes, ReLU φ, and channels 32, 64, 64, d::

    f¹ = [conv([g, 1]), conv(f), dense(f)]       f^{k+1} = conv(φ(f^k)) + dense(φ(f^k)) (+ f^k where the widths agree)

Filters have 4^d points and the radius of the graph. A particle is not a neighbour of itself; the dense layers process its own features.

Differences from the paper, because all models here share graphs, inputs and targets:

- The output is the acceleration without gravity in units of its standard deviation. In the paper, the output divided by 128 corrects positions after a step
  with gravity.
- Particles have the standardised features of the graph (velocity history, gravity, material parameter) and one column per material. With one material this
  column is the constant 1 of the paper. Boundary nodes have velocity, normal and boundary condition; in the paper they have the normal only.
- Boundary nodes also have the constant 1. Standardised features of the most common wall are about 0, and this layer has no other term: without the constant, it
  would hardly see that wall, and not at all if features are the same for all walls.
- All materials use the same filters. Edges connect all pairs within the radius, which is 4.5 particle radii in the paper.
"""

import itertools
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional
from torch_geometric.data import HeteroData

from gpe_pl.errors import GpeError
from gpe_pl.models.base import Model, Prediction
from gpe_pl.nn.continuous_conv import ContinuousConv, interpolate
from gpe_pl.nn.homogeneous import Homogeneous, MaterialEmbeddingKind, first_rows
from gpe_pl.schema import BOUNDARY, RADIUS, EdgeType, FeatureSpec

Offsets = dict[EdgeType, tuple[Tensor, Tensor]]
"""``edge_index`` and (x_target − x_source) / R of each relation that has edges."""


class NotAParticleGraphError(GpeError, ValueError):
    """Raised for graphs with relations that have no convolution, such as those of meshes."""


class ContinuousConvNet(Model):
    """Network of Ummenhofer et al. 2020 ("the paper"); see the module's docstring for equations and differences.

    Args:
        spec: channels of the graphs, which have ``radius`` relations only.
        num_convolutions: number of layers, the first and the last included; 4 in the paper.
        hidden_channels: width between layers; 64 in the paper. Each of the three parts of the first layer has half this width.
        kernel_size: filter points per axis; 4 in the paper.
        material_embedding: ``feature`` makes material parameters features of nodes like the others; ``none`` leaves them out, as a control.

    Raises:
        NotAParticleGraphError: the graphs have relations of meshes.
    """

    def __init__(
        self,
        spec: FeatureSpec,
        num_convolutions: Annotated[int, Field(ge=2, le=64)] = 4,
        hidden_channels: Annotated[int, Field(ge=2, le=4096)] = 64,
        kernel_size: Annotated[int, Field(ge=2, le=16)] = 4,
        material_embedding: MaterialEmbeddingKind = "feature",
    ) -> None:
        super().__init__(
            spec,
            num_convolutions=num_convolutions,
            hidden_channels=hidden_channels,
            kernel_size=kernel_size,
            material_embedding=material_embedding,
        )
        others = sorted({r[1] for r in spec.relations} - {RADIUS})
        if others:
            raise NotAParticleGraphError(
                f"ContinuousConvNet convolves over {RADIUS} edges; the graph also has {', '.join(others)}: set graph.mesh=false"
            )
        self.kernel_size = kernel_size
        self.particles = Homogeneous(spec, spec.materials, material_embedding)
        in_channels, first = self.particles.node_channels + self.particles.num_kinds, hidden_channels // 2
        self.conv_boundary = ContinuousConv(spec.node_channels[BOUNDARY] + 1, first, spec.dim, kernel_size)
        self.conv_particles = ContinuousConv(in_channels, first, spec.dim, kernel_size)
        self.dense_particles = _dense(in_channels, first)
        widths = [3 * first, *[hidden_channels] * (num_convolutions - 2), spec.dim]
        pairs = list(itertools.pairwise(widths))
        self.convs = nn.ModuleList([ContinuousConv(a, b, spec.dim, kernel_size) for a, b in pairs])
        self.denses = nn.ModuleList([_dense(a, b) for a, b in pairs])

    def early_layers(self, num_steps: int) -> list[nn.Module]:
        first = [self.conv_boundary, self.conv_particles, self.dense_particles]
        return [*first, *self.convs[:num_steps], *self.denses[:num_steps]]

    @property
    def num_hops(self) -> int:
        return 1 + len(self.convs)

    def forward(self, data: HeteroData) -> Prediction:
        """Return accelerations without gravity per material [node, dim], in units of the data set's acceleration scale."""
        x = {t: data[t].x for t in self.spec.node_types if data[t].x.shape[0]}
        params = {m: data[m].material_params for m in self.spec.materials if m in x}
        edges = {r: (data[r].edge_index, data[r].offset) for r in self.spec.relations if data[r].edge_index.shape[1]}
        return Prediction(self.compute(x, params, edges) if params else {})

    def compute(self, x: dict[str, Tensor], params: dict[str, Tensor], edges: Offsets) -> dict[str, Tensor]:
        """Do the computation of ``forward`` on plain tensors. ``torch.compile`` compiles this method.

        Args:
            x: features of nodes by node type [node, channel].
            params: standardised material parameters by material [node, param].
            edges: edges by relation.
        """
        particles = {m: x[m] for m in params}
        features, kind = self.particles.nodes(particles, params)
        features = torch.cat([features, functional.one_hot(kind, self.particles.num_kinds).to(features.dtype)], dim=1)
        n, start = features.shape[0], first_rows(particles)

        index, offset = self._neighbors(edges, start, features)
        from_boundary, boundary_offset = self._boundary(edges, start, features)
        neighbors = (index, *interpolate(offset, self.kernel_size), n)
        at_boundary = (from_boundary, *interpolate(boundary_offset, self.kernel_size), n)
        boundary = x[BOUNDARY] if BOUNDARY in x else features.new_zeros(0, self.spec.node_channels[BOUNDARY])
        boundary = functional.pad(boundary, (0, 1), value=1.0)
        parts = [self.conv_boundary(boundary, *at_boundary), self.conv_particles(features, *neighbors), self.dense_particles(features)]
        f = torch.cat(parts, dim=1)
        for conv, dense in zip(self.convs, self.denses, strict=True):
            active = functional.relu(f)
            out = conv(active, *neighbors) + dense(active)
            f = out + f if out.shape[1] == f.shape[1] else out
        return dict(zip(params, f.split([x[m].shape[0] for m in params]), strict=True))

    def _neighbors(self, edges: Offsets, start: dict[str, int], like: Tensor) -> tuple[Tensor, Tensor]:
        """Return both directions of all edges between particles, and (x_source − x_target) / R."""
        indices, offsets = [torch.empty((2, 0), dtype=torch.int64, device=like.device)], [like.new_empty((0, self.spec.dim))]
        for (source, _, target), (edge_index, offset) in edges.items():
            if source != BOUNDARY:
                index = torch.stack([edge_index[0] + start[source], edge_index[1] + start[target]])
                indices += [index, index.flip(0)]
                offsets += [-offset, offset]
        return torch.cat(indices, dim=1), torch.cat(offsets)

    def _boundary(self, edges: Offsets, start: dict[str, int], like: Tensor) -> tuple[Tensor, Tensor]:
        """Return edges from boundary nodes to particles, and (x_source − x_target) / R."""
        indices, offsets = [torch.empty((2, 0), dtype=torch.int64, device=like.device)], [like.new_empty((0, self.spec.dim))]
        for (source, _, target), (edge_index, offset) in edges.items():
            if source == BOUNDARY:
                indices.append(torch.stack([edge_index[0], edge_index[1] + start[target]]))
                offsets.append(-offset)
        return torch.cat(indices, dim=1), torch.cat(offsets)


def _dense(in_channels: int, out_channels: int) -> nn.Linear:
    """Return a linear layer with the authors' initial values: Xavier-uniform weights and zero biases."""
    layer = nn.Linear(in_channels, out_channels)
    nn.init.xavier_uniform_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
