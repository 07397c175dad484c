"""The message-passing layer of GPE, which computes each undirected edge once, adds its message at one end and subtracts it at the other.

The message is a two-layer MLP. Its first layer is linear in its parts, so it factors into products per node and per edge::

    z_ij = A h_i + B h_j + W e_ij + S s_ij + b                       (i target, j source, e odd or latent edge state, s even features)

- ``directed``: m_ij = C φ(z_ij) + c for both directions of every edge
- ``negated``: m_ij = C φ(z_ij) + c and m_ji = −m_ij, the paper's form (section 2.3); it depends on which end is i, see ``orient``
- ``odd``: m_ij = C (φ(z_ij) − φ(z_ji)), antisymmetric for either choice of i
- ``odd_even``: as ``odd``, and D (φ(z_ij) + φ(z_ji)) is added at both ends

A relation between two node types already has a direction. It is ``negated`` unless the layer is ``directed``.
"""

from typing import Any, Literal, Optional, cast

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional
from torch_geometric.nn import MessagePassing

from gpe_pl.nn.fused import works_on
from gpe_pl.nn.fused_latent import fused_latent
from gpe_pl.nn.fused_messages import fused_messages

Interaction = Literal["directed", "negated", "odd", "odd_even"]
EdgeState = Literal["latent", "geometry"]
Implementation = Literal["factored", "plain"]
RAW = 32
"""Maximum number of edge channels for ``fused_messages``, which computes W e edge by edge. With more channels, matrix products are faster."""
MaybeTensor = Optional[Tensor]  # noqa: UP045 - PyG's code generator reads the signatures below and does not understand unions written with |

Ends = tuple[Tensor, MaybeTensor]
"""Sums at targets and sums at sources. If both ends are nodes of one type, the first is the sum at all nodes and the second is None."""


def orient(edge_index: Int64[Tensor, "2 edge"], odd: Float[Tensor, "edge odd"]) -> tuple[Tensor, Tensor]:
    """Turn every edge so that its first non-zero odd channel is positive; this geometric rule does not depend on node labels.

    The first odd channels are the displacement x_i − x_j, so the target is the end with the larger x, then y, then z. Coincident nodes are distinguished by
    their relative velocity if it is a feature. Pairs without any difference keep their order.
    """
    first = torch.zeros_like(odd[:, 0])
    for channel in odd.unbind(dim=1):
        first = torch.where(first == 0, channel, first)
    negative = first < 0
    edge_index = torch.where(negative, edge_index.flip(0), edge_index)
    return edge_index, torch.where(negative[:, None], -odd, odd)


class MomentumConv(MessagePassing):
    """Messages of one relation, summed at both ends.

    Args:
        hidden_channels: node and message channels.
        edge_channels: channels of the edge state ``e``.
        even_channels: channels of ``s``; used only by ``odd`` and ``odd_even``.
        interaction: see the module's docstring; relations between two types accept only ``directed`` and ``negated``.
        implementation: ``factored`` multiplies per node before gathering; ``plain`` multiplies the concatenation per edge. Parameters and results are the same.
    """

    def __init__(
        self,
        hidden_channels: int,
        edge_channels: int,
        even_channels: int,
        interaction: Interaction,
        implementation: Implementation = "factored",
    ) -> None:
        super().__init__(aggr="sum", flow="source_to_target")
        self.is_odd = interaction in ("odd", "odd_even")
        self.interaction = interaction
        self.implementation = implementation
        self.widths = [hidden_channels, hidden_channels, edge_channels, even_channels if self.is_odd else 0]
        self.lin_in = nn.Linear(sum(self.widths), hidden_channels)
        self.act = nn.PReLU()
        self.lin_out = nn.Linear(hidden_channels, hidden_channels, bias=not self.is_odd)
        self.lin_even = nn.Linear(hidden_channels, hidden_channels, bias=False) if interaction == "odd_even" else None

    def forward(
        self,
        h_source: Float[Tensor, "source hidden"],
        h_target: Float[Tensor, "target hidden"],
        edge_index: Int64[Tensor, "2 edge"],
        e: Float[Tensor, "directed_edge state"],
        s: Float[Tensor, "edge even"],
        update_edges: bool = True,
        edges_at_once: int | None = None,
        overwrites: bool = False,
    ) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """Return the sums of messages at the target nodes and at the source nodes, and the new edge states e_ij + m_ij.

        In a relation of one type with itself, the first result contains the sums at both ends, and the second is None.

        Args:
            h_source, h_target: states of the nodes at both ends. Pass the same tensor twice in a relation of one type with itself.
            edge_index: source (row 0) and target (row 1) of each edge.
            e: states of the edges; for ``directed``, those of one direction after those of the other.
            s: even features of the edges.
            update_edges: return new edge states, which need as many channels as the messages. Otherwise they are None, and the last linear map is applied
                after the sum, once per node instead of once per edge (the two commute).
            edges_at_once: number of edges for which intermediate results exist at a time, to save memory in inference. None takes all at once.
            overwrites: in inference, new edge states may reuse the memory of ``e``.
        """
        size, is_joint = (h_source.shape[0], h_target.shape[0]), h_source is h_target
        if self._is_fused(h_source, h_target, e):
            return self._fused(h_source, h_target, edge_index, e, s, update_edges, overwrites)
        w = None
        if self.implementation == "plain":
            terms = {"a": (h_source, h_target), "b": (None, None), "s": s}
        else:
            a, b, w, _ = self.lin_in.weight.split(self.widths, dim=1)
            both = self.interaction != "negated"  # z_ji is needed too
            at = functional.linear(h_target, a, self.lin_in.bias)
            bs = functional.linear(h_source, b)
            as_ = (at if is_joint else functional.linear(h_source, a, self.lin_in.bias)) if both else None
            bt = (bs if is_joint else functional.linear(h_target, b)) if both else None
            terms = {
                "a": (as_, at),
                "b": (bs, bt),
                "s": s if self.is_odd and self.widths[3] else None,
            }
        if edges_at_once is not None and edges_at_once < edge_index.shape[1]:
            return self._in_parts(edge_index, e, w, terms, size, is_joint, update_edges, edges_at_once, overwrites)
        we = e if w is None else functional.linear(e, w)
        at_target, at_source, messages = self.propagate(  # PyG reads these names once for all layers
            edge_index, size=size, a=terms["a"], b=terms["b"], e=we, s=terms["s"], is_joint=is_joint, with_messages=update_edges
        )
        return at_target, at_source, e + messages if update_edges else None

    def _is_fused(self, h_source: Tensor, h_target: Tensor, e: Tensor) -> bool:
        """Tell whether the fused passes for CPUs can be used in the present context."""
        kind = self.interaction == "negated" or (self.interaction == "odd" and h_source is h_target)
        return self.implementation == "factored" and kind and works_on(h_source, h_target, e)

    def _fused(
        self, h_source: Tensor, h_target: Tensor, edge_index: Tensor, e: Tensor, s: Tensor, update_edges: bool, overwrites: bool
    ) -> tuple[Tensor, Tensor | None, Tensor | None]:
        is_joint = h_source is h_target
        a, b, w, v = self.lin_in.weight.split(self.widths, dim=1)
        at, bs = functional.linear(h_target, a, self.lin_in.bias), functional.linear(h_source, b)
        if update_edges or self.is_odd or self.widths[2] > RAW:
            out = (self.lin_out.weight, self.lin_out.bias) if update_edges else None
            even = s if self.is_odd else None
            at_target, at_source, state = fused_latent(at, bs, e, even, w, v, self.act.weight, out, edge_index, is_joint, overwrites)
        else:
            at_target, at_source = fused_messages(at, bs, e, w, self.act.weight, edge_index, is_joint)
            state = None
        if update_edges:
            return at_target, at_source, state
        j, i = edge_index
        return *self._to_messages((at_target, at_source), i, j, -1), None

    def _in_parts(
        self,
        edge_index: Tensor,
        e: Tensor,
        w: MaybeTensor,
        terms: dict[str, Any],
        size: tuple[int, int],
        is_joint: bool,
        update_edges: bool,
        chunk: int,
        overwrites: bool,
    ) -> tuple[Tensor, MaybeTensor, MaybeTensor]:
        """Compute everything after the products per node, for ``chunk`` edges at a time."""
        count, width = edge_index.shape[1], self.lin_out.in_features
        sums = _zeros(e, width, size[1], size[0], is_joint)
        evens = None if self.lin_even is None else _zeros(e, width, size[1], size[0], is_joint)
        directions, sign = e.split(count), 1  # two for ``directed``
        new = None if not update_edges else e if overwrites else torch.empty_like(e)
        for first in range(0, count, chunk):
            part = slice(first, first + chunk)
            j, i = edge_index[:, part]
            ends = {
                f"{name}_{end}": None if h is None else h[k] for name in "ab" for end, k, h in zip("ji", (j, i), terms[name], strict=True)
            }
            edge = torch.cat([d[part] for d in directions])
            s = None if terms["s"] is None else terms["s"][part]
            forward, reverse = cast(Any, self.message(**ends, e=edge if w is None else functional.linear(edge, w), s=s))
            x, y, sign = self._outgoing(forward, reverse, update_edges)
            _add(sums, x, y, i, j, sign)
            if new is not None:
                for updated, state, message in zip(new.split(count), directions, (x, y), strict=False):
                    torch.add(state[part], message, out=updated[part])
            if evens is not None:
                _add(evens, forward + reverse, forward + reverse, i, j, 1)
        return *self._finished(sums, evens, edge_index[1], edge_index[0], sign, update_edges), new

    def message(
        self, a_i: MaybeTensor, a_j: MaybeTensor, b_i: MaybeTensor, b_j: MaybeTensor, e: Tensor, s: MaybeTensor
    ) -> tuple[Tensor, MaybeTensor]:
        """Return φ(z_ij), and φ(z_ji) if the interaction needs it. PyG calls it with rows for each edge: A h + b as ``a``, B h as ``b``, W e as ``e``."""
        if self.implementation == "plain":
            return self._odd_plain(a_i, a_j, e, s) if self.is_odd else self._plain(a_i, a_j, e)
        if self.interaction == "negated":
            return self._factored(a_i, b_j, e, s), None
        if self.interaction == "directed":
            forward, reverse = e.chunk(2)
            return self._factored(a_i, b_j, forward, s), self._factored(a_j, b_i, reverse, s)
        return self._factored(a_i, b_j, e, s), self._factored(a_j, b_i, e, s, sign=-1)

    def _plain(self, h_i: Any, h_j: Any, e: Tensor) -> tuple[Tensor, Tensor | None]:
        if self.interaction == "negated":
            return self.act(self.lin_in(torch.cat([h_i, h_j, e], dim=1))), None
        forward, reverse = e.chunk(2)
        return self.act(self.lin_in(torch.cat([h_i, h_j, forward], dim=1))), self.act(self.lin_in(torch.cat([h_j, h_i, reverse], dim=1)))

    def _odd_plain(self, h_i: Any, h_j: Any, e: Tensor, s: Any) -> tuple[Tensor, Tensor]:
        """Return z_ij and z_ji as even part ± odd part, so that every edge is multiplied once even without factoring."""
        a, b, w, v = self.lin_in.weight.split(self.widths, dim=1)
        even = functional.linear(torch.cat([h_i + h_j, s], dim=1), torch.cat([(a + b) / 2, v], dim=1), self.lin_in.bias)
        odd = functional.linear(torch.cat([h_i - h_j, e], dim=1), torch.cat([(a - b) / 2, w], dim=1))
        return self.act(even + odd), self.act(even - odd)

    def _factored(self, a_self: Any, b_other: Any, e: Tensor, s: Tensor | None, sign: int = 1) -> Tensor:
        z = a_self + b_other
        z.add_(e, alpha=sign)  # in place: at these sizes a new buffer costs more than the sum
        if s is not None:
            v = self.lin_in.weight[:, -self.widths[3] :]
            z.addmm_(s.to(z.dtype), v.t().to(z.dtype))  # autocast does not cast in-place products
        return self.act(z)

    def aggregate(
        self,
        inputs: tuple[Tensor, Any],
        edge_index_i: Tensor,
        edge_index_j: Tensor,
        size_i: int,
        size_j: int,
        is_joint: bool,
        with_messages: bool,
    ) -> tuple[Tensor, MaybeTensor, MaybeTensor]:
        """Sum the results of ``message`` at targets and at sources: +m and −m, or for ``directed`` the message of each direction. PyG calls it."""
        forward, reverse = inputs
        x, y, sign = self._outgoing(forward, reverse, with_messages)
        messages = None if not with_messages else torch.cat([x, y]) if self.interaction == "directed" else x
        i, j, width = edge_index_i, edge_index_j, x.shape[1]
        sums = _add(_zeros(x, width, size_i, size_j, is_joint), x, y, i, j, sign)
        evens = None
        if self.lin_even is not None:
            even = forward + reverse
            evens = _add(_zeros(even, width, size_i, size_j, is_joint), even, even, i, j, 1)
        return *self._finished(sums, evens, i, j, sign, with_messages), messages

    def _outgoing(self, forward: Tensor, reverse: Any, with_messages: bool) -> tuple[Tensor, Tensor, int]:
        """Return what targets receive, what sources receive, and its sign: messages, or the activations before the last linear map."""
        x = forward - reverse if self.is_odd else forward
        y, sign = (reverse, 1) if self.interaction == "directed" else (x, -1)
        if not with_messages:
            return x, y, sign
        m = self.lin_out(x)
        return m, self.lin_out(y) if self.interaction == "directed" else m, sign

    def _finished(self, sums: Ends, evens: Ends | None, i: Tensor, j: Tensor, sign: int, are_messages: bool) -> Ends:
        """Return sums of messages from sums of messages or activations, and from sums of even activations, if any."""
        at_target, at_source = sums if are_messages else self._to_messages(sums, i, j, sign)
        if self.lin_even is None or evens is None:
            return at_target, at_source
        even_target, even_source = evens
        return at_target + self.lin_even(even_target), at_source if even_source is None else at_source + self.lin_even(even_source)

    def _to_messages(self, sums: Ends, i: Tensor, j: Tensor, sign: int) -> Ends:
        """Convert sums of activations to sums of messages, for edges with targets i and, with a sign, sources j."""
        at_target, at_source = sums
        if at_source is None:
            return self._last_linear(at_target, (i, 1), (j, sign)), None
        return self._last_linear(at_target, (i, 1)), self._last_linear(at_source, (j, sign))

    def _last_linear(self, total: Tensor, *ends: tuple[Tensor, int]) -> Tensor:
        """Apply the last linear map to a sum; its bias counts as often as the ends name a node."""
        y = functional.linear(total, self.lin_out.weight)
        if self.lin_out.bias is None:
            return y
        degree = total.new_zeros(total.shape[0])
        for index, sign in ends:
            degree.index_add_(0, index, total.new_ones(index.shape[0]), alpha=sign)
        return y.addr_(degree, self.lin_out.bias)


def _zeros(like: Tensor, width: int, num_target: int, num_source: int, is_joint: bool) -> Ends:
    """Return zeros for the sums at targets and sources, or one array for both."""
    return like.new_zeros(num_target, width), None if is_joint else like.new_zeros(num_source, width)


def _add(sums: Ends, x: Tensor, y: Tensor, i: Tensor, j: Tensor, sign: int) -> Ends:
    """Add x at the targets i, and ±y at the sources j, in place."""
    at_target, at_source = sums
    at_target.index_add_(0, i, x)
    (at_target if at_source is None else at_source).index_add_(0, j, y, alpha=sign)
    return sums
