"""GNS, the Graph Network-based Simulator [Sanchez-Gonzalez et al. 2020, "Learning to Simulate Complex Physics with Graph Networks", section 4 and
supplement B; code: github.com/google-deepmind/deepmind-research, ``learning_to_simulate``].

The model has an encoder, a processor and a decoder on one graph of all particles. All types use the same functions. MLPs have two hidden layers with ReLU, and
a LayerNorm after each MLP except the decoder::

    h_i  = MLP([features, embedding of the type])       e_ij = MLP([displacement, its length])       both directions of every edge
    e'   = MLP([e_ij, h_i, h_j])                        h'   = MLP([h_i, Σ_j e'])
    e_ij += e',  h_i += h'                              M times, each time with separate weights
    a_i  = MLP(h_i)

Differences from the paper, because all models here share graphs, inputs and targets:

- Edges have the channels that ``graph.features`` selects, and the length of the standardised displacement. Edges of meshes have their own features
  (``graph.mesh=false`` gives the topology of the paper).
- Walls are boundary nodes with velocity, normal and boundary condition, as in the other models. The paper has distances to the box instead. Boundary nodes have
  no edges among themselves.
- Gravity and the material parameter are inputs, and the target is the acceleration without gravity.
"""

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn
from torch_geometric.data import HeteroData

from gpe_pl.models.base import Model, Prediction
from gpe_pl.nn.blocks import EdgeLinear, ReluMLP
from gpe_pl.nn.homogeneous import Edges, Homogeneous, MaterialEmbeddingKind, present
from gpe_pl.schema import FeatureSpec

TINY = 1e-12


class InteractionNetwork(nn.Module):
    """Network of one processor step. It computes e' and h' of the module's equations."""

    def __init__(self, hidden_channels: int, num_hidden_layers: int) -> None:
        super().__init__()
        hidden = hidden_channels
        self.edge_in = EdgeLinear(hidden, hidden, hidden)
        self.edge_out = nn.Sequential(nn.ReLU(), *ReluMLP(hidden, hidden, hidden, num_hidden_layers - 1, norm=True))
        self.node = ReluMLP(2 * hidden, hidden, hidden, num_hidden_layers, norm=True)

    def forward(self, h: Tensor, e: Tensor, edge_index: Tensor) -> tuple[Tensor, Tensor]:
        messages = self.edge_out(self.edge_in(e, h, edge_index))
        total = torch.zeros_like(h).index_add(0, edge_index[1], messages)
        return self.node(torch.cat([h, total], dim=1)), messages


class GNS(Model):
    """Model of Sanchez-Gonzalez et al. 2020 ("the paper"); see the module's docstring for equations and differences.

    Args:
        spec: channels of the graphs.
        num_message_passing_steps: M; 10 in the paper.
        hidden_channels: width of all hidden states and layers; 128 in the paper.
        num_hidden_layers: number of hidden layers of every MLP; 2 in the paper, 1 in LagrangeBench's GNS-10-128.
        type_channels: width of the embedding of the particle type; 16 in the paper.
        material_embedding: ``feature`` makes material parameters features of nodes like the others; ``none`` leaves them out, as a control.
    """

    def __init__(
        self,
        spec: FeatureSpec,
        num_message_passing_steps: Annotated[int, Field(ge=1, le=64)] = 10,
        hidden_channels: Annotated[int, Field(ge=1, le=4096)] = 128,
        num_hidden_layers: Annotated[int, Field(ge=1, le=8)] = 2,
        type_channels: Annotated[int, Field(ge=1, le=1024)] = 16,
        material_embedding: MaterialEmbeddingKind = "feature",
    ) -> None:
        super().__init__(
            spec,
            num_message_passing_steps=num_message_passing_steps,
            hidden_channels=hidden_channels,
            num_hidden_layers=num_hidden_layers,
            type_channels=type_channels,
            material_embedding=material_embedding,
        )
        self.graph = Homogeneous(spec, spec.node_types, material_embedding)
        hidden, layers = hidden_channels, num_hidden_layers
        self.type_embedding = nn.Embedding(self.graph.num_kinds, type_channels)
        self.node_encoder = ReluMLP(self.graph.node_channels + type_channels, hidden, hidden, layers, norm=True)
        self.edge_encoder = ReluMLP(self.graph.edge_channels + 1, hidden, hidden, layers, norm=True)
        self.processor = nn.ModuleList([InteractionNetwork(hidden, layers) for _ in range(num_message_passing_steps)])
        self.decoder = ReluMLP(hidden, hidden, spec.dim, layers)

    def early_layers(self, num_steps: int) -> list[nn.Module]:
        return [self.type_embedding, self.node_encoder, self.edge_encoder, *self.processor[:num_steps]]

    @property
    def num_hops(self) -> int:
        return len(self.processor)

    def forward(self, data: HeteroData) -> Prediction:
        """Return accelerations without gravity per material [node, dim], in units of the data set's acceleration scale."""
        x, params, edges = present(data, self.spec)
        return Prediction(self.compute(x, params, edges) if params else {})

    def compute(self, x: dict[str, Tensor], params: dict[str, Tensor], edges: Edges) -> dict[str, Tensor]:
        """Do the computation of ``forward`` on plain tensors. ``torch.compile`` compiles this method.

        Args:
            x: features of nodes by node type [node, channel].
            params: standardised material parameters by material [node, param].
            edges: edges by relation.
        """
        features, kind = self.graph.nodes(x, params)
        edge_index, edge_features = self.graph.edges(x, edges, edges, edges)
        length = self._lengths(edges, edge_features)
        h = self.node_encoder(torch.cat([features, self.type_embedding(kind)], dim=1))
        e = self.edge_encoder(torch.cat([edge_features, length], dim=1))
        for step in self.processor:
            update, messages = step(h, e, edge_index)
            h, e = h + update, e + messages
        sizes = [x[m].shape[0] for m in params]
        return dict(zip(params, self.decoder(h[: sum(sizes)]).split(sizes), strict=True))

    def _lengths(self, edges: Edges, like: Tensor) -> Tensor:
        """Return the length of the displacement (the first odd channels) per directed edge."""
        lengths = [(odd[:, : self.spec.dim].square().sum(dim=1, keepdim=True) + TINY**2).sqrt() for _, odd, _ in edges.values()]
        return torch.cat([*lengths, *lengths]) if lengths else like.new_empty((0, 1))
