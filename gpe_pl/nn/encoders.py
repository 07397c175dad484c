"""Encoders of GPE beside its multi-layer perceptrons: of material parameters, and of odd edge states."""

from typing import Literal

from jaxtyping import Float
from torch import Tensor, nn

from gpe_pl.nn.blocks import MLP

MaterialEmbeddingKind = Literal["affine", "mlp", "none"]


class MaterialEmbedding(nn.Module):
    """Embedding Θ(v) of material parameters (paper, section 2.1).

    ``affine`` satisfies Θ(λv₁ + (1−λ)v₂) = λΘ(v₁) + (1−λ)Θ(v₂). ``mlp`` does not and serves for comparison. Here v are the values that graphs have:
    logarithms of some parameters, or physical values with ``graph.parameter_scale=linear``.
    """

    def __init__(self, param_channels: int, hidden_channels: int, kind: MaterialEmbeddingKind, is_fused: bool) -> None:
        super().__init__()
        if kind == "affine":
            self.theta: nn.Module = nn.Linear(param_channels, hidden_channels)
        else:
            self.theta = MLP(param_channels, hidden_channels, hidden_channels, is_fused=is_fused)

    def forward(self, params: Float[Tensor, "node param"]) -> Float[Tensor, "node hidden"]:
        return self.theta(params)


class OddEncoder(nn.Module):
    """Encoder of the odd edge state.

    It computes C (φ(W o + S s + b) − φ(−W o + S s + b)) from odd features o and even features s. C has no bias, so the result is odd.
    """

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
