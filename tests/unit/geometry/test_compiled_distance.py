"""The compiled distance to several shapes is that of their own methods."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.geometry.repeated_shapes import repeated
from gpe_pl.geometry.shapes import Bowl, Box, DistanceGrid, Polygon, Sphere, domain_walls, signed_distance

HEIGHTS = np.random.default_rng(0).normal(size=(5, 7, 4))
UNIT = ((0.0, 1.0),) * 3
IN_2D: tuple[Any, ...] = (
    *domain_walls(UNIT[:2], 0.3),
    Sphere((0.3, 0.4), 0.2, 0.1),
    Box((0.1, 0.2), (0.3, 0.9), 0.1),
    Polygon(((0.2, 0.2), (0.6, 0.25), (0.5, 0.7), (0.4, 0.4)), 0.2),
    Bowl((0.5, 0.5), 0.6, 0.1),
    DistanceGrid.from_values((0.1, 0.1), 0.1, HEIGHTS[..., 0], 0.3),
    *repeated((Sphere((0.1, 0.5), 0.2, 0.1),), Periodicity(UNIT[:2], (True, False))),
)
IN_3D: tuple[Any, ...] = (
    *domain_walls(UNIT, 0.3),
    Sphere((0.3, 0.4, 0.5), 0.2, 0.1),
    Box((0.1, 0.2, 0.3), (0.3, 0.9, 0.4), 0.1),
    Bowl((0.5, 0.5, 0.5), 0.6, 0.1),
    DistanceGrid.from_values((0.1, 0.1, 0.2), 0.1, HEIGHTS, 0.3),
)


@pytest.mark.parametrize("shapes", [*((shape,) for shape in IN_2D), IN_2D, *((shape,) for shape in IN_3D), IN_3D, ()])
@pytest.mark.parametrize("array", [np.asarray, torch.as_tensor])
def test_the_compiled_distance_is_that_of_the_shapes(shapes: tuple[Any, ...], array: Any) -> None:
    dim = 3 if shapes and shapes[0] in IN_3D else 2
    points = np.random.default_rng(1).uniform(-1.0, 2.0, (400, dim))
    points[::7] = np.round(10 * points[::7]) / 10  # on corners and nodes of the grid
    points[5, 1] = np.nan
    expected = functools.reduce(np.minimum, (shape.signed_distance(points) for shape in shapes), np.full(400, np.inf))
    found = signed_distance(shapes, array(points))
    assert type(found) is type(array(points))
    np.testing.assert_allclose(np.asarray(found), expected, rtol=1e-14, atol=1e-15)
