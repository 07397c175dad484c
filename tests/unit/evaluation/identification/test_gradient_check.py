"""The check of gradients by finite differences refuses gradients that point elsewhere or have another size."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from gpe_pl.evaluation.identification.gradient_check import GradientCheck, gradient_check


def test_the_check_refuses_gradients_of_the_wrong_sign_or_size() -> None:
    assert GradientCheck((1.0,), (1.5,)).is_trusted
    assert GradientCheck((1.0, 0.05, -0.06), (1.0, -0.08, 0.0)).is_trusted  # slopes that hardly turn the search
    pairs: list[tuple[tuple[float, ...], tuple[float, ...]]] = [
        ((-1.0,), (1.0,)),
        ((3.0,), (1.0,)),
        ((math.nan,), (1.0,)),
        ((1.0,), (0.0,)),
        ((0.0,), (1.0,)),
    ]
    pairs += (((1.0, -0.5), (1.0, 0.6)), ((1.0, 1.5), (1.0, 0.05)), ((2.0, 1.0), (0.8, 0.5)), ((1.0, math.nan), (1.0, 0.5)))
    for wrong in (GradientCheck(*pair) for pair in pairs):
        assert not wrong.is_trusted
        assert "cannot be trusted" in str(wrong)


@dataclass
class Wrong:
    """A misfit whose gradient has the wrong sign along its second unknown. Along one of the two diagonals it is right."""

    number: int
    simulator: None = None

    @property
    def unknowns(self) -> range:
        return range(self.number)

    def misfit(self, z: Any) -> float:
        return float(np.sum(z))

    def misfit_and_gradient(self, z: Any) -> tuple[float, np.ndarray]:
        return self.misfit(z), np.where(np.arange(self.number) == 1, -1.0, 1.0)


@pytest.mark.parametrize(("number", "directions"), [(2, 2), (3, 3), (6, 6), (7, 1)])
def test_each_of_few_unknowns_is_checked(number: int, directions: int) -> None:
    found = gradient_check(Wrong(number), np.full(number, 0.5))
    assert len(found.gradient) == len(found.difference) == directions
    if directions > 1:
        np.testing.assert_allclose(found.difference, 1.0)
        assert not found.is_trusted and found.gradient == tuple(Wrong(number).misfit_and_gradient(np.zeros(number))[1])
