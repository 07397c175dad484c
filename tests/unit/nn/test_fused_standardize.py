"""The compiled pass standardises as plain operations do, bit for bit."""

from __future__ import annotations

import pytest
import torch

from gpe_pl.nn import blocks
from gpe_pl.nn.blocks import Standardize
from gpe_pl.system.compiled import unfused


def made(centered: bool, dtype: torch.dtype) -> Standardize:
    standardize = Standardize(5, centered)
    standardize.fit([3 * torch.randn(40, 5, generator=torch.Generator().manual_seed(0)) + 7])
    return standardize.to(dtype)


@pytest.mark.parametrize("centered", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_are_the_same(centered: bool, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    calls, compiled = list[int](), blocks.fused_standardize

    def counted(x: torch.Tensor, mean: torch.Tensor, std: torch.Tensor, is_centered: bool) -> torch.Tensor:
        calls.append(len(x))
        return compiled(x, mean, std, is_centered)

    monkeypatch.setattr(blocks, "fused_standardize", counted)
    standardize = made(centered, dtype)
    for x in (torch.randn(30, 5, dtype=dtype), torch.randn(5, 30, dtype=dtype).t(), torch.empty(0, 5, dtype=dtype)):
        found = standardize(x)
        with unfused():
            assert torch.equal(found, standardize(x)) and found.is_contiguous()
    assert calls == [30, 30, 0]


def test_values_with_gradients_keep_them() -> None:
    standardize = made(True, torch.float64)
    x = torch.randn(4, 5, dtype=torch.float64, requires_grad=True)
    standardize(x).sum().backward()
    torch.testing.assert_close(x.grad, (1 / standardize.std).expand(4, 5))
