"""Decoder of GPE of forces on pairs of nodes."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gpe_pl.schema import EdgeType, FeatureSpec


class PairForce(nn.Module):
    """Decoder of one force per edge from the final node states.

    With z_ij = A h_i + B h_j + W o_ij + S s_ij + b, the force on the target i is

    F_ij = C (φ(z_ij) − φ(z_ji)) within a type, and F_ij = C φ(z_ij) + c between two types.

    The force on the source is −F_ij, so the sum of all forces is zero up to rounding.
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

    def forward(
        self, h_source: Tensor, h_target: Tensor, edge_index: Tensor, odd: Tensor, even: Tensor, chunk: int | None = None
    ) -> Float[Tensor, "edge dim"]:
        """Return the force on the target of every edge; the opposite force acts on the source.

        Args:
            h_source, h_target: final states of the nodes at both ends [node, hidden]; one tensor within a type.
            edge_index: source (row 0) and target (row 1) of each edge.
            odd, even: features of the edges [edge, channel].
            chunk: number of edges for which forces are computed at a time; None takes all at once.
        """
        a, b = self.lin_target(h_target), self.lin_source(h_source)
        if chunk is None:
            return self._force(a, b, edge_index, odd, even)
        parts = zip(edge_index.split(chunk, dim=1), odd.split(chunk), even.split(chunk), strict=True)
        return torch.cat([self._force(a, b, *part) for part in parts])

    def _force(self, a: Tensor, b: Tensor, edge_index: Tensor, odd: Tensor, even: Tensor) -> Tensor:
        j, i = edge_index
        s, w = self.lin_even(even), self.lin_odd(odd)
        forward = self.act(a[i] + b[j] + s + w)
        if self.bipartite:
            return self.lin_out(forward)
        reverse = self.act(a[j] + b[i] + s - w)  # both ends have one type, so they index the same rows
        return self.lin_out(forward - reverse)
