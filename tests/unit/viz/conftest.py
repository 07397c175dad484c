from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.geometry import Box, Polygon, Shape, Sphere, domain_walls
from gpe_pl.trajectory import Boundary, Metadata, Termination, Trajectory


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
def prediction(dim) -> Trajectory:
    return falling(dim, noise=0.3)


@pytest.fixture
def stopped(prediction) -> Trajectory:
    return replace(prediction.frames(0, 7), termination=Termination("explosion", 7, 0, "frame 7: too fast"))
