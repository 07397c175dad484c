"""Small building blocks that several models use."""

from collections.abc import Iterable
from typing import cast

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from gpe_pl.nn.fused import works_on
from gpe_pl.nn.fused_mlp import fused_mlp

NORM_EPS = 1e-5
"""ε of the LayerNorm in ``MLP``."""


class MLP(nn.Sequential):
    """Two linear layers with a PReLU between them, then an optional LayerNorm. All functions of GPE have this form (paper, section 3.2).

    Args:
        is_fused: on a CPU, use ``nn.fused_mlp``, which computes the same function of the same parameters.
    """

    def __init__(self, in_channels: int, hidden_channels: int, out_channels: int, norm: bool = False, is_fused: bool = False) -> None:
        layers = [nn.Linear(in_channels, hidden_channels), nn.PReLU(), nn.Linear(hidden_channels, out_channels)]
        super().__init__(*layers, *([nn.LayerNorm(out_channels, NORM_EPS)] if norm else []))
        self.is_fused = is_fused

    def forward(self, x: Float[Tensor, "*row in"], residual: Float[Tensor, "*row out"] | None = None) -> Float[Tensor, "*row out"]:
        """Apply the function to every row, and add ``residual``."""
        first, act, last, *norm = self
        first, act, last = cast(nn.Linear, first), cast(nn.PReLU, act), cast(nn.Linear, last)
        if not (self.is_fused and x.dim() == 2 and works_on(x, first.weight)):
            y = super().forward(x)
            return y if residual is None else residual + y
        y = fused_mlp(x, first.weight, first.bias, act.weight, last.weight, last.bias, None if norm else residual)
        for layer in norm:
            y = layer(y) if residual is None else residual + layer(y)
        return y


class ReluMLP(nn.Sequential):
    """Hidden linear layers with a ReLU after each, a linear layer, then an optional LayerNorm. The functions of GNS and DPI-Net have this form."""

    def __init__(self, in_channels: int, hidden_channels: int, out_channels: int, num_hidden_layers: int, norm: bool = False) -> None:
        layers: list[nn.Module] = []
        for k in range(num_hidden_layers):
            layers += [nn.Linear(hidden_channels if k else in_channels, hidden_channels), nn.ReLU()]
        layers.append(nn.Linear(hidden_channels if num_hidden_layers else in_channels, out_channels))
        super().__init__(*layers, *([nn.LayerNorm(out_channels)] if norm else []))


class EdgeLinear(nn.Module):
    """Linear map of (edge, target, source) that multiplies nodes before it gathers them to edges.

    With target i and source j it computes

        W [e, h_i, h_j] + b = W_e e + (W_i h + b)_i + (W_j h)_j
    """

    def __init__(self, edge_channels: int, node_channels: int, out_channels: int) -> None:
        super().__init__()
        self.widths = [edge_channels, node_channels, node_channels]
        self.linear = nn.Linear(sum(self.widths), out_channels)

    def forward(self, e: Float[Tensor, "edge state"], h: Float[Tensor, "node hidden"], edge_index: Int64[Tensor, "2 edge"]) -> Tensor:
        return self.nodes(h, edge_index).add_(self.edges(e))

    def edges(self, e: Float[Tensor, "edge state"]) -> Float[Tensor, "edge out"]:
        """Return W_e e, which a loop with constant edge states computes once."""
        return functional.linear(e, self.linear.weight[:, : self.widths[0]])

    def nodes(self, h: Float[Tensor, "node hidden"], edge_index: Int64[Tensor, "2 edge"]) -> Float[Tensor, "edge out"]:
        """Return (W_i h + b)_i + (W_j h)_j."""
        _, target, source = self.linear.weight.split(self.widths, dim=1)
        j, i = edge_index
        at_target = functional.linear(h, target, self.linear.bias).index_select(0, i)  # its gradient sums faster than the gradient of [i]
        return at_target.add_(functional.linear(h, source).index_select(0, j))


class Standardize(nn.Module):
    """Standardisation (x − mean) / std with stored statistics.

    With ``centered=False`` the mean stays zero and the scale is the root mean square, so that odd channels stay odd. Constant channels keep scale 1.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, channels: int, centered: bool = True) -> None:
        super().__init__()
        self.centered = centered
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("std", torch.ones(channels))

    @property
    def is_identity(self) -> bool:
        """Whether no statistics are set; statistics of varying features never equal the identity."""
        return bool((self.mean == 0).all()) and bool((self.std == 1).all())

    def fit(self, batches: Iterable[Float[Tensor, "row channel"]]) -> bool:
        """Set the statistics from data, computed in float64. Return whether there were any finite rows; without any, the identity is kept."""
        rows = [b.double() for b in batches if b.shape[0]]
        if not rows:
            return False
        x = torch.cat(rows)
        x = x[torch.isfinite(x).all(dim=1)]
        if x.shape[0] == 0:
            return False
        mean = x.mean(dim=0) if self.centered else torch.zeros(x.shape[1], dtype=x.dtype)
        std = (x - mean).square().mean(dim=0).sqrt()
        constant = std <= 1e-6 * (1e-6 + mean.abs())
        self.mean.copy_(mean)
        self.std.copy_(torch.where(constant, torch.ones_like(std), std))
        return True

    def forward(self, x: Float[Tensor, "row channel"]) -> Float[Tensor, "row channel"]:
        return (x - self.mean) / self.std if self.centered else x / self.std
