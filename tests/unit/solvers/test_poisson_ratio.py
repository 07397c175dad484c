"""Poisson's ratio per element of the finite element solver, against formulas of linear elasticity."""

from __future__ import annotations

import numpy as np
import pytest

from gpe_pl.schema import node_code
from gpe_pl.solvers.fem import FEM
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

MODULUS, STRAIN = 1e6, 1e-6


def bodies(ratios: list[float], dim: int) -> State:
    """Return one triangle or tetrahedron per ratio, side by side, stretched along x and fixed across."""
    corners = 0.1 * np.concatenate([np.zeros((1, dim)), np.eye(dim)])
    rest = np.concatenate([corners + 0.1 + 0.2 * k * np.eye(dim)[0] for k in range(len(ratios))])
    stretch = np.ones(dim)
    stretch[0] += STRAIN
    count = len(rest)
    return State(
        rest * stretch, np.zeros_like(rest), np.full(count, node_code("solid"), np.uint8), np.ones(count),
        np.stack([np.full(count, MODULUS), np.repeat(ratios, dim + 1)], axis=1), Boundary.empty(dim), np.zeros(dim), rest_pos=rest,
        cells=np.arange(count).reshape(-1, dim + 1), param_names=("youngs_modulus", "poisson_ratio"),
    )  # fmt: skip


@pytest.mark.parametrize("dim", [2, 3])
def test_each_body_has_its_own_ratio(dim: int) -> None:
    """Uniaxial strain: σ_xx = E (1 - ν) / ((1 + ν)(1 - 2ν)) ε, and σ_yy / σ_xx = ν / (1 - ν)."""
    ratios = [0.0, 0.2, 0.45]
    after = FEM(bounds=((0.0, 1.0),) * dim, frame_dt=1e-12).step(bodies(ratios, dim))
    assert after.stress is not None
    for stress, ratio in zip(after.stress.cell, ratios, strict=True):
        axial, lateral = stress[0], stress[2 if dim == 2 else 3]
        assert axial == pytest.approx(MODULUS * (1 - ratio) / ((1 + ratio) * (1 - 2 * ratio)) * STRAIN, rel=1e-4)
        assert lateral / axial == pytest.approx(ratio / (1 - ratio), abs=1e-4)


def test_a_larger_ratio_has_shorter_substeps() -> None:
    """The speed of pressure waves grows with the ratio: c² ∝ (1 - ν) / ((1 + ν)(1 - 2ν))."""
    fem = FEM(bounds=((0.0, 1.0),) * 2, frame_dt=10.0, damping=0.0)
    assert fem.substep(bodies([0.0, 0.45], 2)) < 0.8 * fem.substep(bodies([0.0, 0.0], 2))
