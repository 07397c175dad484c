"""Planes of the nearest walls, and corners of obstacles near edges of bodies."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gpe_pl.geometry.periodicity import NOWHERE
from gpe_pl.geometry.shapes import Box, Polygon, Shape, Sphere, domain_walls
from gpe_pl.graphs.contacts import convex_corners, corners_near_edges, nearest_walls, oriented_edges, surface_edges
from gpe_pl.graphs.elastic_cells_kernels import near_corners
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


def left_of(edges: np.ndarray, rest: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return whether the centre is on the left of each edge."""
    along, inwards = rest[edges[:, 1]] - rest[edges[:, 0]], centre - rest[edges[:, 0]]
    return along[:, 0] * inwards[:, 1] - along[:, 1] * inwards[:, 0] > 0


@pytest.mark.parametrize("kind", ["lattice", "triangles"])
def test_corners_of_cells_may_go_round_in_either_sense(kind: str) -> None:
    rest, cells = mesh(kind)
    edges = oriented_edges(torch.from_numpy(rest), torch.from_numpy(cells))
    turned = cells.copy()
    turned[::3] = turned[::3, ::-1]
    found = oriented_edges(torch.from_numpy(rest), torch.from_numpy(turned))
    assert {tuple(e) for e in found.tolist()} == {tuple(e) for e in edges.tolist()}
    if kind == "lattice":
        assert left_of(found, rest, rest.mean(axis=0)).all()


@pytest.mark.parametrize("thickness", [0.5, 0.7, 0.8, 1.0, 1.1, 1.2, 1.4, 2.0])
@pytest.mark.parametrize("angle", [0.0, 0.5])
def test_the_faces_of_a_plate_are_no_corners(thickness: float, angle: float) -> None:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    vertices = SPACING * np.array([[0.0, 0.0], [12.0, 0.0], [12.0, thickness], [0.0, thickness]]) @ turn.T + 0.5
    plate = boundary(Polygon(tuple(map(tuple, vertices.tolist())), 0.5))
    found = np.asarray(plate.pos)[convex_corners(plate, SPACING)]
    distance = np.linalg.norm(found[:, None] - vertices, axis=2)
    assert distance.min(axis=0).max() < 1e-9  # every corner is found
    assert distance.min(axis=1).max() < 1.1 * SPACING  # a node beside a corner of a plate of about one spacing may count, too


@pytest.mark.parametrize("angle", [15.0, 30.0, 60.0, 90.0, 120.0])
def test_tips_are_corners(angle: float) -> None:
    half = math.radians(angle) / 2
    width, height = 6 * SPACING * math.sin(half), 6 * SPACING * math.cos(half)
    vertices = ((0.5, 0.5), (0.5 - width, 0.5 - height), (0.5 + width, 0.5 - height))
    spike = boundary(Polygon(vertices, 0.5))
    found = np.asarray(spike.pos)[convex_corners(spike, SPACING)]
    assert np.linalg.norm(found - [0.5, 0.5], axis=1).min() < 1e-9
    assert np.linalg.norm(found[:, None] - np.array(vertices), axis=2).min(axis=1).max() < 1e-9


def test_corners_near_the_end_of_a_long_edge_are_found() -> None:
    """Plain and compiled search agree."""
    pos = np.array([[0.0, 0.0], [12.0, 0.0], [12.0, 2.0], [0.0, 2.0], [0.0, 0.0]]) * SPACING + 0.3
    edges, spike = np.array([[0, 1], [1, 2], [2, 3], [3, 0]]), Polygon(((0.3 + 11 * SPACING, 0.29), (0.35, 0.1), (0.5, 0.1)), 0.5)
    around = boundary(spike)
    corners = convex_corners(around, SPACING)
    ends, corner = corners_near_edges(torch.from_numpy(pos), edges, around, SPACING, 2 * SPACING)
    pairs = near_corners(pos, np.arange(5), edges, np.asarray(around.pos, np.float64), corners, (2 * SPACING) ** 2)
    assert edges[pairs[:, 0]].tolist() == ends.tolist()
    tip = {(0, 1): [11 * SPACING, -0.01], (1, 2): [-SPACING, -0.01]}
    assert {tuple(e) for e in ends.tolist()} == set(tip)
    for e, values in zip(ends.tolist(), corner.tolist(), strict=True):
        assert values[:2] == pytest.approx(tip[tuple(e)])


def test_surface_edges_belong_to_one_cell() -> None:
    assert {tuple(sorted(e)) for e in surface_edges(np.array([[0, 1, 2], [1, 3, 2]]))[0].tolist()} == {(0, 1), (0, 2), (1, 3), (2, 3)}


def test_surface_edges_that_share_a_node_are_apart() -> None:
    """Contacts with all edges then take as few rounds as a loop of edges allows."""
    for kind in ("lattice", "triangles"):
        edges, _ = surface_edges(mesh(kind)[1])
        assert len([*_in_rounds(torch.tensor(edges.copy()), int(edges.max()) + 1)]) <= 3
