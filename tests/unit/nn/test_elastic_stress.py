"""The stress that follows from a learned law equals that of the solver with the same constants."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch

from gpe_pl.nn.elastic_motion import Cells, cauchy_stress
from gpe_pl.solvers.fem import elements


@pytest.mark.parametrize("dim", [2, 3])
def test_it_equals_the_solvers(dim: int) -> None:
    rng, size = np.random.default_rng(2), (3,) * dim
    number = np.arange(math.prod(size)).reshape(size)
    rest = np.argwhere(number >= 0) + rng.uniform(-0.1, 0.1, (number.size, dim))
    cells = np.concatenate(
        [
            np.stack([number[tuple(slice(k, 2 + k) for k in c)].ravel() for c in path], axis=1)
            for order in itertools.permutations(range(dim))
            for path in [np.cumsum([np.zeros(dim, int), *np.eye(dim, dtype=int)[list(order)]], axis=0)]
        ]
    )
    edges = rest[cells[:, 1:]] - rest[cells[:, :1]]
    flipped = np.linalg.det(edges) < 0
    cells[flipped, :2] = cells[flipped, 1::-1]
    pos = rest @ (np.eye(dim) + 0.2 * rng.normal(size=(dim, dim))) + 0.05 * rng.normal(size=rest.shape)
    pos[cells[0, 0]] = pos[cells[0, 1]] + 0.05  # a crushed cell
    lam, mu = rng.uniform(1.0, 3.0, len(cells)), rng.uniform(0.5, 1.0, len(cells))
    mass = np.ones(len(rest))
    expected = elements.cauchy_stress(elements.build_mesh(rest, cells, mass), pos, lam, mu).node
    prepared = Cells.of(torch.from_numpy(cells), torch.from_numpy(rest), torch.from_numpy(mass), None)
    found = cauchy_stress(torch.from_numpy(pos), (torch.from_numpy(lam), torch.from_numpy(mu), torch.from_numpy(mu)), prepared)
    assert found.shape[1] == (4 if dim == 2 else 6)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-9, atol=1e-9)


def test_the_stress_of_bending_is_largest_at_the_surface_of_hexahedra() -> None:
    """One layer of cubes under a small pure bending: the stress at the corners is that of the surface, not zero as the mean over the layer."""
    number = np.arange(4 * 3 * 2).reshape(4, 3, 2)
    rest = np.argwhere(number >= 0) - [0.0, 0.0, 0.5]
    low, high = slice(None, -1), slice(1, None)
    cells = np.stack(
        [number[x, y, z].ravel() for z in (low, high) for x, y in ((low, low), (high, low), (high, high), (low, high))], axis=1
    )
    curvature = 1e-4
    pos = rest + curvature * np.stack([rest[:, 0] * rest[:, 2], 0 * rest[:, 0], -(rest[:, 0] ** 2) / 2], axis=1)
    lam, mu = np.full(len(cells), 2.0), np.full(len(cells), 1.0)
    law = torch.from_numpy(lam), torch.from_numpy(mu), torch.from_numpy(mu)
    prepared = Cells.of(torch.from_numpy(cells), torch.from_numpy(rest), torch.ones(len(rest), dtype=torch.float64), None)
    stress = cauchy_stress(torch.from_numpy(pos), law, prepared).numpy()
    np.testing.assert_allclose(stress[:, 0], (2.0 + 2 * 1.0) * curvature * rest[:, 2], rtol=5e-3)
