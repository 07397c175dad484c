"""Planes of the nearest walls, and corners of obstacles near edges of bodies."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gpe_pl.geometry.periodicity import NOWHERE
from gpe_pl.geometry.shapes import Box, Polygon, Shape, Sphere, domain_walls
from gpe_pl.graphs.contacts import convex_corners, corners_near_edges, nearest_walls, oriented_edges, surface_edges
from gpe_pl.learned.testing.scenes import mesh
from gpe_pl.nn.elastic_motion import _in_rounds
from gpe_pl.trajectory.boundary import Boundary

SPACING = 0.02
BOX = Box((0.4, 0.1), (0.6, 0.3), friction=0.5)
TRIANGLE = Polygon(((0.2, 0.2), (0.3, 0.2), (0.25, 0.28)), friction=0.2)
DISC = Sphere((0.7, 0.6), 3 * SPACING, friction=0.3)


def boundary(*shapes: Shape) -> Boundary:
    return Boundary.sample(shapes, SPACING, 2)


@pytest.mark.parametrize(
    ("shapes", "corners"),
    [((BOX,), [(0.4, 0.1), (0.4, 0.3), (0.6, 0.1), (0.6, 0.3)]), ((TRIANGLE,), list(TRIANGLE.vertices)), ((DISC,), [])],
    ids=["box", "polygon", "disc"],
)
def test_corners_are_those_of_the_shape(shapes: tuple[Shape, ...], corners: list[tuple[float, float]]) -> None:
    around = boundary(*domain_walls(((0.0, 1.0), (0.0, 1.0)), 0.0), *shapes)
    found = np.asarray(around.pos)[convex_corners(around, SPACING)]
    assert sorted(map(tuple, found.round(9).tolist())) == sorted(corners)


def test_walls_of_shapes_are_exact() -> None:
    around = boundary(BOX, DISC)
    directions = np.stack([np.cos(np.arange(7.0)), np.sin(np.arange(7.0))], axis=1)
    beside = np.asarray(DISC.center) + (DISC.radius + 0.3 * SPACING) * directions
    pos = torch.from_numpy(np.concatenate([beside, [[0.5, 0.31], [0.9, 0.9]]]))
    edges = torch.stack([torch.zeros(8, dtype=torch.int64), torch.arange(8)])
    wall = nearest_walls(pos, around, (BOX, DISC), edges, SPACING, NOWHERE)
    assert torch.allclose(wall[:7, :2], torch.from_numpy(directions), atol=1e-6)
    assert torch.allclose(wall[:7, 2], torch.full((7,), 0.3 * SPACING).double(), atol=1e-9)
    assert wall[:7, 3].tolist() == [0.3] * 7
    assert torch.allclose(wall[7], torch.tensor([0.0, 1.0, 0.01, 0.5]).double(), atol=1e-9)
    assert not wall[8].any()


def test_walls_of_nodes_are_planes_in_front_of_which_a_node_is() -> None:
    around = boundary(BOX)
    points = {name: torch.as_tensor(getattr(around, name)).double() for name in ("pos", "vel", "normal", "friction", "restitution")}
    nodes = Boundary(points["pos"], points["vel"], points["normal"], points["friction"], points["restitution"])
    pos = torch.tensor([[0.5, 0.305], [0.395, 0.2], [0.38, 0.305]], dtype=torch.float64)
    count = len(points["pos"])
    edges = torch.stack([torch.arange(count).repeat(3), torch.arange(3).repeat_interleave(count)])
    wall = nearest_walls(pos, nodes, (), edges, SPACING, NOWHERE)
    assert torch.allclose(wall[0, :3], torch.tensor([0.0, 1.0, 0.005]).double())
    assert torch.allclose(wall[1, :3], torch.tensor([-1.0, 0.0, 0.005]).double())
    assert float(wall[2, 2]) > 0


@pytest.mark.parametrize("is_mirrored", [False, True], ids=["as it is", "mirrored"])
def test_edges_have_the_body_on_their_left(is_mirrored: bool) -> None:
    rest = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], dtype=torch.float64) * SPACING
    cells = torch.tensor([[0, 1, 2, 3]])
    if is_mirrored:
        rest = rest * torch.tensor([-1.0, 1.0])
    pos = rest + torch.tensor([0.5, 0.3]) + 0.1 * SPACING
    edges = oriented_edges(rest, cells)
    ends, _ = corners_near_edges(pos, edges, boundary(BOX), SPACING, 2 * SPACING)
    assert not len(ends)  # no corner within reach
    ends, corner = corners_near_edges(pos - torch.tensor([0.1, 0.0]), edges, boundary(BOX), SPACING, 2 * SPACING)
    assert len(ends)
    centre = rest.mean(dim=0)
    first, second = rest[ends[:, 0]], rest[ends[:, 1]]
    along, inwards = second - first, centre - first
    assert bool((along[:, 0] * inwards[:, 1] - along[:, 1] * inwards[:, 0] > 0).all())
    assert corner[:, 2].tolist() == [0.5] * len(corner)


def test_surface_edges_belong_to_one_cell() -> None:
    assert {tuple(sorted(e)) for e in surface_edges(np.array([[0, 1, 2], [1, 3, 2]])).tolist()} == {(0, 1), (0, 2), (1, 3), (2, 3)}


def test_surface_edges_that_share_a_node_are_apart() -> None:
    """Contacts with all edges then take as few rounds as a loop of edges allows."""
    for kind in ("lattice", "triangles"):
        edges = surface_edges(mesh(kind)[1])
        assert len([*_in_rounds(torch.tensor(edges.copy()), int(edges.max()) + 1)]) <= 3
