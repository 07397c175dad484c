from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from gpe_pl.geometry.shapes import Box, Polygon, Shape, Sphere, domain_walls
from gpe_pl.schema import node_code
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import Stress
from gpe_pl.trajectory.trajectory import Metadata, Termination, Trajectory


def falling(dim: int, num_frames: int = 12, noise: float = 0.0) -> Trajectory:
    bounds = ((0.0, 1.0),) * dim
    shapes: tuple[Shape, ...] = domain_walls(bounds, 0.5)
    if dim == 2:
        shapes += (Sphere((0.5, 0.2), 0.1, 0.3), Box((0.8, 0.0), (0.9, 0.1), 0.3), Polygon(((0.0, 0.0), (0.2, 0.0), (0.0, 0.2)), 0.3))
    axis = 0.4 + 0.03 * np.arange(5)
    start = np.stack([m.ravel() for m in np.meshgrid(*[axis] * dim)], axis=-1)
    down = np.eye(dim)[-1]
    time = 0.02 * np.arange(num_frames)[:, None, None]
    jitter = noise * np.random.default_rng(0).normal(size=start.shape) * time
    pos = start + jitter - 4.9 * time**2 * down
    metadata = Metadata("test", ("sand",), ("friction_angle",), 0.02, 0.03, 0.075, bounds, tuple(-9.81 * down))
    nodes = len(start)
    return Trajectory(
        metadata,
        pos,
        np.zeros_like(pos),
        np.zeros(nodes, np.uint8),
        np.ones(nodes),
        np.zeros((nodes, 1)),
        Boundary.sample(shapes, 0.1, dim),
    )


@pytest.fixture(params=[2, 3], ids=["2d", "3d"])
def dim(request) -> int:
    return request.param


@pytest.fixture
def ground_truth(dim) -> Trajectory:
    return falling(dim)


@pytest.fixture
def falling_3d() -> Trajectory:
    return falling(3)


@pytest.fixture
def prediction(dim) -> Trajectory:
    return falling(dim, noise=0.3)


@pytest.fixture
def stopped(prediction) -> Trajectory:
    return replace(prediction.frames(0, 7), termination=Termination("explosion", 7, 0, "frame 7: too fast"))


def block(dim: int, side: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return positions [node, dim] of a grid, and cells: quadrilaterals, or six tetrahedra in each cube (Kuhn 1960)."""
    grid = np.stack(np.meshgrid(*[np.arange(side + 1)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    number = {tuple(p): k for k, p in enumerate(grid.tolist())}
    paths = [[(0, 0), (1, 0), (1, 1), (0, 1)]]
    if dim == 3:
        paths = []
        for order in permutations(range(3)):
            path = np.concatenate([np.zeros((1, 3), int), np.cumsum(np.eye(3, dtype=int)[list(order)], axis=0)])
            paths.append((path if np.linalg.det(path[1:]) > 0 else path[[0, 2, 1, 3]]).tolist())
    lowest = [p for p in grid if p.max() < side]
    return grid / side, np.array([[number[tuple(p + c)] for c in path] for p in lowest for path in paths])


@pytest.fixture
def mesh(dim) -> Trajectory:
    return falling_mesh(dim)


def falling_mesh(dim: int) -> Trajectory:
    """Return a falling block with growing stress, and two particles without cells."""
    base = falling(dim)
    rest, cells = block(dim)
    rest = np.concatenate([0.4 + 0.2 * rest, np.full((1, dim), 0.8), np.full((1, dim), 0.85)])
    pos = rest + base.pos[:, :1] - base.pos[0, :1]
    cell = np.zeros((len(pos), len(cells), 4 if dim == 2 else 6))
    cell[..., 0] = 1e5 * np.linspace(0, 1, len(pos))[:, None] * np.linspace(0.5, 1, len(cells))
    node = np.zeros((len(pos), len(rest), cell.shape[2]))
    nodes = len(rest)
    metadata = replace(base.metadata, materials=("solid",), param_names=("youngs_modulus",))
    types = np.full(nodes, node_code("solid"), np.uint8)
    return Trajectory(
        metadata,
        pos,
        0 * pos,
        types,
        np.ones(nodes),
        np.zeros((nodes, 1)),
        base.boundary,
        rest_pos=rest,
        cells=cells,
        stress=Stress(node, cell),
    )
