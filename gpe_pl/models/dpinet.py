"""DPI-Net, dynamic particle interaction networks [Li et al. 2019, "Learning Particle Dynamics for Manipulating Rigid Bodies, Deformable Objects, and Fluids",
ICLR, section 3; code: github.com/YunzhuLi/DPI-Net, ``models.py`` and ``data.py``].

Effects spread through the graph in stages. Each stage has separate networks, encodes once, and repeats L times, starting from the last stage's effects::

    c_i  = Enc_p(x_i)                                   c_ij = Enc_r([x_i, x_j, relation])
    e_ij = ReLU(P_r [c_ij, h_i, h_j])                   h_i  = ReLU(P_p [c_i, Σ_j e_ij] + h_i)           for the stage's receivers i

Enc_p has two and Enc_r three linear layers, each followed by a ReLU. Three linear layers predict the motion from the last effects. The stages are:

1. between leaves: ``radius`` and ``cell`` edges, into materials only (boundary nodes send, as the paper's walls do), L times;
2. per level of virtual nodes, lowest first: from the children ``up``, once, then among the ``same`` level, L times;
3. per level, highest first: ``down`` to the children, once.

A graph without virtual nodes has only the first stage, like the paper's fluids.

Differences from the paper, because all models here share graphs, inputs and targets:

- The model predicts the acceleration without gravity. The model of the paper predicts the velocity, and for rigid bodies a rigid motion.
- Particles have the standardised features of the graph and a one-hot type; relations have the edge features of the graph. They replace the absolute positions
  and the flag of the paper, so that the result does not depend on the position of the scene. There are no edges from a particle to itself.
- Virtual nodes are those of the multi-scale graph instead of clusters from k-means. Virtual nodes of one level have edges to their neighbours, in the paper to
  all others. All levels use the same weights of a stage, so a mesh may have more levels than in training.
"""

from typing import Annotated, cast

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional
from torch_geometric.data import HeteroData

from gpe_pl.models.base import Model, Prediction
from gpe_pl.nn.blocks import EdgeLinear, ReluMLP
from gpe_pl.nn.homogeneous import Edges, Homogeneous, MaterialEmbeddingKind, first_rows, present
from gpe_pl.schema import BOUNDARY, CELL, DOWN, RADIUS, SAME, EdgeType, FeatureSpec

Relations = list[EdgeType]


class Stage(nn.Module):
    """Networks of one kind of stage: the encoders Enc_p and Enc_r, and the propagators P_p and P_r."""

    def __init__(self, node_channels: int, edge_channels: int, hidden_channels: int) -> None:
        super().__init__()
        hidden = hidden_channels
        relation = 3 * hidden // 2
        self.particle_encoder = nn.Sequential(*ReluMLP(node_channels, hidden, hidden, 1), nn.ReLU())
        self.relation_encoder_in = EdgeLinear(edge_channels, node_channels, relation)
        self.relation_encoder_out = nn.Sequential(nn.ReLU(), *ReluMLP(relation, relation, relation, 1), nn.ReLU())
        self.relation_propagator = EdgeLinear(relation, hidden, hidden)
        self.particle_propagator = nn.Linear(2 * hidden, hidden)

    def forward(self, x: Tensor, h: Tensor, index: Tensor, features: Tensor, receivers: slice, num_steps: int) -> Tensor:
        """Return the effects [node, hidden] after ``num_steps`` propagations along directed edges. Only the rows ``receivers`` change.

        Args:
            x: features of nodes [node, channel].
            h: effects before the stage [node, hidden].
            index: source (row 0) and target (row 1) of each edge [2, edge]; targets are among the receivers.
            features: features of edges [edge, channel].
            receivers: rows of the receiving nodes.
            num_steps: number of propagations. Products with encoded inputs are the same in all of them and are computed once.
        """
        codes = self.relation_encoder_out(self.relation_encoder_in(features, x, index))
        of_relation = self.relation_propagator.edges(codes)
        weight_code, weight_effect = self.particle_propagator.weight.chunk(2, dim=1)
        of_particle = functional.linear(self.particle_encoder(x[receivers]), weight_code, self.particle_propagator.bias)
        into = index[1] - receivers.start
        for _ in range(num_steps):
            effects = functional.relu(self.relation_propagator.nodes(h, index).add_(of_relation))
            total = torch.zeros_like(h[receivers]).index_add(0, into, effects)
            received = functional.relu(of_particle + functional.linear(total, weight_effect) + h[receivers])
            h = torch.cat([h[: receivers.start], received, h[receivers.stop :]])
        return h


def _at_targets(new: Tensor, old: Tensor, index: Tensor) -> Tensor:
    """Return the new effects of nodes into which an edge leads, and the old ones of others.

    Roots of small bodies have no parent at levels that only other bodies have, so these bodies do not change them.
    """
    has_edge = torch.zeros(old.shape[0], dtype=torch.bool, device=old.device).index_fill(0, index[1], True)
    return torch.where(has_edge[:, None], new, old)


class DPINet(Model):
    """Model of Li et al. 2019; see the module's docstring for equations and differences.

    Args:
        spec: channels of the graphs.
        num_propagation_steps: L; 2 in the authors' code.
        hidden_channels: width of particle codes and effects; relation codes are 1.5 times as wide; 200 and 300 in the authors' code.
        material_embedding: ``feature`` makes material parameters features of nodes like the others; ``none`` leaves them out, as a control.
    """

    def __init__(
        self,
        spec: FeatureSpec,
        num_propagation_steps: Annotated[int, Field(ge=1, le=64)] = 2,
        hidden_channels: Annotated[int, Field(ge=2, le=4096)] = 200,
        material_embedding: MaterialEmbeddingKind = "feature",
    ) -> None:
        super().__init__(
            spec, num_propagation_steps=num_propagation_steps, hidden_channels=hidden_channels, material_embedding=material_embedding
        )
        self.num_propagation_steps, self.hidden_channels = num_propagation_steps, hidden_channels
        self.graph = Homogeneous(spec, spec.node_types, material_embedding)
        names = ("leaves", "up", "same", "down") if spec.num_levels else ("leaves",)
        node_channels = self.graph.node_channels + self.graph.num_kinds
        self.stages = nn.ModuleDict({name: Stage(node_channels, self.graph.edge_channels, hidden_channels) for name in names})
        self.predictor = ReluMLP(hidden_channels, hidden_channels, spec.dim, 2)

    @property
    def num_hops(self) -> int:
        return self.num_propagation_steps

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
        features = torch.cat([features, functional.one_hot(kind, self.graph.num_kinds).to(features.dtype)], dim=1)
        h = features.new_zeros(features.shape[0], self.hidden_channels)
        for name, forward, backward, receivers, num_steps in self._plan(x, params, edges):
            index, edge_features = self.graph.edges(x, edges, forward, backward)
            new = cast(Stage, self.stages[name])(features, h, index, edge_features, receivers, num_steps)
            h = _at_targets(new, h, index) if name == "down" else new
        sizes = [x[m].shape[0] for m in params]
        return dict(zip(params, self.predictor(h[: sum(sizes)]).split(sizes), strict=True))

    def _plan(self, x: dict[str, Tensor], params: dict[str, Tensor], edges: Edges) -> list[tuple[str, Relations, Relations, slice, int]]:
        """Return the stages in order: name, relations as stored, relations reversed, rows that receive, propagation steps."""
        start, steps = first_rows(x), self.num_propagation_steps
        rows = {t: slice(start[t], start[t] + x[t].shape[0]) for t in x}
        levels = [t for t in x if t not in (*params, BOUNDARY)]
        to_children = {level: [r for r in edges if r[:2] == (level, DOWN)] for level in levels}
        between_leaves = [r for r in edges if r[1] in (RADIUS, CELL)]
        leaves = slice(0, sum(x[m].shape[0] for m in params))

        plan = [("leaves", between_leaves, [r for r in between_leaves if r[0] != BOUNDARY], leaves, steps)]
        for level in levels:
            same = [(level, SAME, level)]
            plan.append(("up", [], to_children[level], rows[level], 1))
            plan.append(("same", same, same, rows[level], steps))
        for level in reversed(levels):
            plan += [("down", [relation], [], rows[relation[2]], 1) for relation in to_children[level]]
        return plan
