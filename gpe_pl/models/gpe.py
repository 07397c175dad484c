"""GPE, the Graph-based Physics Engine [Yang et al. 2022, "Learning to Simulate Unseen Physical Systems with Graph Neural Networks", Algorithm 1].

Encoder, processor and decoder over typed nodes and relations, one parameter set per node type and per pair of types. A forward pass::

    h_i   = f_v0(x_i, Θ(material parameters))            e_ij = f_e0(edge features)
    m_ij  = f_e(h_i, h_j, e_ij),  m_ji = −m_ij           (nn.momentum_conv)
    h_i  += f_v(Σ_j m_ij)                                e_ij += m_ij
    a_i   = f_d(h_i)                                     or a sum of antisymmetric pair forces over the true mass
"""

from typing import Annotated, Literal, cast

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch_geometric.data import HeteroData

from gpe_pl.models.base import Prediction
from gpe_pl.nn.blocks import MLP
from gpe_pl.nn.momentum_conv import EdgeState, Implementation, Interaction, MomentumConv, orient
from gpe_pl.schema import BOUNDARY, EdgeType, FeatureSpec

Decoder = Literal["node", "pair"]
MaterialEmbeddingKind = Literal["affine", "mlp"]


class MaterialEmbedding(nn.Module):
    """Θ(v) of the paper, section 2.1: ``affine`` satisfies Θ(λv₁ + (1−λ)v₂) = λΘ(v₁) + (1−λ)Θ(v₂); ``mlp`` is the comparison."""

    def __init__(self, param_channels: int, hidden_channels: int, kind: MaterialEmbeddingKind) -> None:
        super().__init__()
        affine = kind == "affine"
        self.theta = nn.Linear(param_channels, hidden_channels) if affine else MLP(param_channels, hidden_channels, hidden_channels)

    def forward(self, params: Float[Tensor, "node param"]) -> Float[Tensor, "node hidden"]:
        return self.theta(params)


class OddEncoder(nn.Module):
    """The odd edge state: C (φ(W o + S s + b) − φ(−W o + S s + b)) of odd features o and even features s; without bias, so it stays odd."""

    def __init__(self, odd_channels: int, even_channels: int, hidden_channels: int) -> None:
        super().__init__()
        self.lin_odd = nn.Linear(odd_channels, hidden_channels, bias=False)
        self.lin_even = nn.Linear(even_channels, hidden_channels)
        self.act = nn.PReLU()
        self.lin_out = nn.Linear(hidden_channels, hidden_channels, bias=False)

    def hidden(self, odd: Tensor, even: Tensor) -> Tensor:
        w, s = self.lin_odd(odd), self.lin_even(even)
        return self.act(s + w) - self.act(s - w)

    def forward(self, odd: Float[Tensor, "edge odd"], even: Float[Tensor, "edge even"]) -> Float[Tensor, "edge hidden"]:
        return self.lin_out(self.hidden(odd, even))


class PairForce(nn.Module):
    """One force per edge from the final node states: antisymmetric within a type, negated across types, so Σ F = 0 to rounding.

    F_ij = C (φ(z_ij) − φ(z_ji)) with z_ij = A h_i + B h_j + W o_ij + S s_ij + b.
    """

    def __init__(self, spec: FeatureSpec, relation: EdgeType, hidden_channels: int) -> None:
        super().__init__()
        self.bipartite = relation[0] != relation[2]
        self.lin_target = nn.Linear(hidden_channels, hidden_channels, bias=False)
        self.lin_source = nn.Linear(hidden_channels, hidden_channels, bias=False)
        self.lin_odd = nn.Linear(spec.odd_channels[relation], hidden_channels, bias=False)
        self.lin_even = nn.Linear(spec.even_channels[relation], hidden_channels)
        self.act = nn.PReLU()
        self.lin_out = nn.Linear(hidden_channels, spec.dim, bias=self.bipartite)

    def forward(self, h_source: Tensor, h_target: Tensor, edge_index: Tensor, odd: Tensor, even: Tensor) -> Float[Tensor, "edge dim"]:
        """Force on the target of every edge; the source feels the opposite."""
        j, i = edge_index
        s, w = self.lin_even(even), self.lin_odd(odd)
        forward = self.act(self.lin_target(h_target)[i] + self.lin_source(h_source)[j] + s + w)
        if self.bipartite:
            return self.lin_out(forward)
        reverse = self.act(self.lin_target(h_source)[j] + self.lin_source(h_target)[i] + s - w)
        return self.lin_out(forward - reverse)


def _key(relation: EdgeType) -> str:
    return "__".join(relation)


class GPE(nn.Module):
    """The paper's model and its variants.

    Args:
        spec: channels of the graphs.
        interaction: how a message and its reverse relate; see ``nn.momentum_conv``.
        decoder: ``node`` decodes an acceleration per node (paper); ``pair`` an antisymmetric force per edge, divided by the node's mass.
        edge_state: ``latent`` updates a hidden state per edge (Algorithm 1); ``geometry`` feeds the raw edge features to every layer.
        material_embedding: ``affine`` (the paper's interpolation rule) or ``mlp``.
        num_message_passing_steps: processor layers; 12 in the paper.
        hidden_channels: width of everything; 128 in the paper.
        implementation: ``factored`` or ``plain``; the same function of the same parameters.
    """

    def __init__(
        self,
        spec: FeatureSpec,
        interaction: Interaction = "negated",
        decoder: Decoder = "node",
        edge_state: EdgeState = "latent",
        material_embedding: MaterialEmbeddingKind = "affine",
        num_message_passing_steps: Annotated[int, Field(ge=1, le=64)] = 12,
        hidden_channels: Annotated[int, Field(ge=1, le=4096)] = 128,
        implementation: Implementation = "factored",
    ) -> None:
        super().__init__()
        self.settings = {
            "interaction": interaction,
            "decoder": decoder,
            "edge_state": edge_state,
            "material_embedding": material_embedding,
            "num_message_passing_steps": num_message_passing_steps,
            "hidden_channels": hidden_channels,
            "implementation": implementation,
        }
        self.spec, self.interaction, self.decoder, self.edge_state = spec, interaction, decoder, edge_state
        self.num_message_passing_steps = num_message_passing_steps
        hidden = hidden_channels
        params = {m: c for m, c in spec.param_channels.items() if c}
        self.material_embedding = nn.ModuleDict({m: MaterialEmbedding(c, hidden, material_embedding) for m, c in params.items()})
        self.node_encoder = nn.ModuleDict(
            {t: MLP(spec.node_channels[t] + (hidden if t in params else 0), hidden, hidden) for t in spec.node_types}
        )
        self.edge_encoder = nn.ModuleDict()
        if edge_state == "latent":
            for relation in spec.relations:
                odd, even = spec.odd_channels[relation], spec.even_channels[relation]
                is_odd = self._interaction(relation) in ("odd", "odd_even")
                self.edge_encoder[_key(relation)] = OddEncoder(odd, even, hidden) if is_odd else MLP(odd + even, hidden, hidden)
        self.convs, self.updates = nn.ModuleList(), nn.ModuleList()
        for step in range(num_message_passing_steps):
            convs = nn.ModuleDict()
            for relation in spec.relations:
                kind = self._interaction(relation)
                odd, even = spec.odd_channels[relation], spec.even_channels[relation]
                raw_edge = odd if kind in ("odd", "odd_even") else odd + even
                edge_channels = hidden if edge_state == "latent" else raw_edge
                convs[_key(relation)] = MomentumConv(hidden, edge_channels, even, kind, implementation)
            self.convs.append(convs)
            last = step == num_message_passing_steps - 1  # nobody reads the boundary's state after the last step
            self.updates.append(nn.ModuleDict({t: MLP(hidden, hidden, hidden) for t in (spec.materials if last else spec.node_types)}))
        if decoder == "node":
            self.node_decoder = nn.ModuleDict({m: MLP(hidden, hidden, spec.dim) for m in spec.materials})
        else:
            self.pair_decoder = nn.ModuleDict({_key(r): PairForce(spec, r, hidden) for r in spec.relations})

    def _interaction(self, relation: EdgeType) -> Interaction:
        same = relation[0] == relation[2]
        return self.interaction if same or self.interaction == "directed" else "negated"

    def forward(self, data: HeteroData) -> Prediction:
        """Accelerations without gravity per material, in units of the data set's acceleration scale; types and relations without members are skipped."""
        x = {t: data[t].x for t in self.spec.node_types if data[t].x.shape[0]}
        params = {m: data[m].material_params for m in self.material_embedding if m in x}
        mass = {m: data[m].mass for m in self.spec.materials if m in x}
        edges = {r: (data[r].edge_index, data[r].odd, data[r].even) for r in self.spec.relations if data[r].edge_index.shape[1]}
        return Prediction(self.compute(x, params, mass, edges))

    def compute(
        self,
        x: dict[str, Tensor],
        params: dict[str, Tensor],
        mass: dict[str, Tensor],
        edges: dict[EdgeType, tuple[Tensor, Tensor, Tensor]],
    ) -> dict[str, Tensor]:
        """``forward`` on plain tensors: the part that ``torch.compile`` sees."""
        if self.interaction == "negated":
            edges = {r: (*orient(index, odd), even) if r[0] == r[2] else (index, odd, even) for r, (index, odd, even) in edges.items()}
        h = {t: self._encode_node(t, x[t], params.get(t)) for t in x}
        e = {r: self._encode_edge(r, odd, even) for r, (_, odd, even) in edges.items()}

        for step in range(self.num_message_passing_steps):
            last = step == self.num_message_passing_steps - 1
            with_messages = self.edge_state == "latent" and not last
            total: dict[str, Tensor] = {}
            for relation, (edge_index, _, even) in edges.items():
                source, _, target = relation
                conv = cast(nn.ModuleDict, self.convs[step])[_key(relation)]
                at_target, at_source, messages = conv(h[source], h[target], edge_index, e[relation], even, with_messages)
                total[target] = total[target] + at_target if target in total else at_target
                if not (last and source == BOUNDARY):
                    total[source] = total[source] + at_source if source in total else at_source
                if with_messages:
                    e[relation] = e[relation] + messages
            for node_type, update in cast(nn.ModuleDict, self.updates[step]).items():
                if node_type in h:
                    incoming = total[node_type] if node_type in total else torch.zeros_like(h[node_type])
                    h[node_type] = h[node_type] + update(incoming)

        if self.decoder == "node":
            return {m: self.node_decoder[m](h[m]) for m in mass}
        return self._pair_accelerations(h, mass, edges)

    def _encode_node(self, node_type: str, x: Tensor, params: Tensor | None) -> Tensor:
        if params is not None:
            x = torch.cat([x, self.material_embedding[node_type](params)], dim=1)
        return self.node_encoder[node_type](x)

    def _encode_edge(self, relation: EdgeType, odd: Tensor, even: Tensor) -> Tensor:
        kind = self._interaction(relation)
        encoder = self.edge_encoder[_key(relation)] if self.edge_state == "latent" else None
        if kind in ("odd", "odd_even"):
            return odd if encoder is None else encoder(odd, even)
        features = torch.cat([odd, even], dim=1)
        if kind == "directed":  # one state per direction, forward first
            features = torch.cat([features, torch.cat([-odd, even], dim=1)])
        return features if encoder is None else encoder(features)

    def _pair_accelerations(
        self, h: dict[str, Tensor], mass: dict[str, Tensor], edges: dict[EdgeType, tuple[Tensor, Tensor, Tensor]]
    ) -> dict[str, Tensor]:
        force = {m: h[m].new_zeros(h[m].shape[0], self.spec.dim) for m in mass}
        for relation, (edge_index, odd, even) in edges.items():
            source, _, target = relation
            f = self.pair_decoder[_key(relation)](h[source], h[target], edge_index, odd, even)
            force[target] = force[target].index_add(0, edge_index[1], f)
            if source in force:
                force[source] = force[source].index_add(0, edge_index[0], -f)
        return {m: force[m] / mass[m][:, None] for m in mass}
