"""Solvers compute with the shapes of a boundary. Nodes that say something else are refused, because models read the nodes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.solvers import supported
from gpe_pl.solvers.supported import check_surroundings
from gpe_pl.trajectory.boundary import Boundary
from tests.particles import block

WALLS = domain_walls(((0.0, 1.0), (0.0, 1.0)), {"x_low": 0.0, "x_high": 0.5, "y_low": 0.9, "y_high": 0.0})


def checked(boundary: Boundary) -> None:
    check_surroundings(block([0.3, 0.3], [0.2, 0.2], 0.05, boundary=boundary), "MPM")


def test_nodes_of_the_shapes_are_accepted_also_in_corners() -> None:
    sampled = Boundary.sample(WALLS, 0.05, 2)
    checked(sampled)
    checked(Boundary.from_numpy(sampled.pos, sampled.normal, friction=sampled.friction, shapes=WALLS))
    checked(Boundary.empty(2))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda b: replace(b, friction=np.full(len(b.pos), 0.3)),
            r"its boundary_node 0 has the friction 0.3, the shape there .*; give both the same",
        ),
        (
            lambda b: replace(b, friction=np.where(b.pos[:, 1] == 0, 0.5, b.friction)),
            r"its boundary_node \d+ has the friction 0.5, the shape there",
        ),
        (lambda b: replace(b, shapes=tuple(replace(shape, restitution=0.8) for shape in b.shapes)), "a shape has restitution"),
        (lambda b: replace(b, shapes=b.shapes[:3]), "some of its nodes are on none of them; pass a shape for each"),
    ],
)
def test_nodes_that_are_not_those_of_the_shapes_are_refused(change, message: str) -> None:
    wrong = change(Boundary.sample(WALLS, 0.05, 2))
    for _ in range(2):  # also where the answer is remembered
        with pytest.raises(
            SimulationError, match=f"MPM takes walls and obstacles from the shapes of the boundary, and {message}"
        ) as raised:
            checked(wrong)
    assert raised.value.reason == "input"


def test_few_boundaries_are_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supported, "MOST_CHECKED", 3)
    for _ in range(10):
        checked(Boundary.sample(WALLS, 0.2, 2))
    assert len(supported._checked) <= 3
