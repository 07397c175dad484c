"""Standardisation of the rows of a matrix in one compiled pass (on a CPU)."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor


@njit(cache=True, error_model="numpy")
@no_type_check
def _write(x, mean, std, is_centered, out):
    for k in range(x.shape[0]):
        for c in range(x.shape[1]):
            out[k, c] = (x[k, c] - mean[c]) / std[c] if is_centered else x[k, c] / std[c]


def fused_standardize(
    x: Float[Tensor, "row channel"], mean: Float[Tensor, " channel"], std: Float[Tensor, " channel"], is_centered: bool
) -> Float[Tensor, "row channel"]:
    """Return (x − mean) / std, or x / std unless ``is_centered``; not differentiable. All are on the CPU and of one precision."""
    out = torch.empty(x.shape, dtype=x.dtype)
    _write(np.ascontiguousarray(x.detach().numpy()), mean.numpy(), std.numpy(), is_centered, out.numpy())
    return out
