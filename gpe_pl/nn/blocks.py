"""Small building blocks shared by all models."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor, nn


class MLP(nn.Sequential):
    """Two linear layers with a PReLU between them: every function of the paper (section 3.2)."""

    def __init__(self, in_channels: int, hidden_channels: int, out_channels: int) -> None:
        super().__init__(nn.Linear(in_channels, hidden_channels), nn.PReLU(), nn.Linear(hidden_channels, out_channels))


class Standardize(nn.Module):
    """(x − mean) / std with stored statistics.

    With ``centered=False`` the mean stays zero and the scale is the root mean square, which keeps odd channels odd. Channels that do not vary keep
    scale 1.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, channels: int, centered: bool = True) -> None:
        super().__init__()
        self.centered = centered
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("std", torch.ones(channels))

    def fit(self, batches: Iterable[Float[Tensor, "row channel"]]) -> None:
        """Set the statistics from data, in float64; rows that are not finite are ignored, no rows leave the identity."""
        rows = [b.double() for b in batches if b.shape[0]]
        if not rows:
            return
        x = torch.cat(rows)
        x = x[torch.isfinite(x).all(dim=1)]
        if x.shape[0] == 0:
            return
        mean = x.mean(dim=0) if self.centered else torch.zeros(x.shape[1], dtype=x.dtype)
        std = (x - mean).square().mean(dim=0).sqrt()
        constant = std <= 1e-6 * (1e-6 + mean.abs())
        self.mean.copy_(mean)
        self.std.copy_(torch.where(constant, torch.ones_like(std), std))

    def forward(self, x: Float[Tensor, "row channel"]) -> Float[Tensor, "row channel"]:
        return (x - self.mean) / self.std if self.centered else x / self.std
