"""Scenes of one meshed solid: pure functions of the seed, in free space, and valid for the finite element solver."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.geometry.shapes import Sphere, signed_distance
from gpe_pl.rollout.loop import rollout
from gpe_pl.schema import MATERIALS, STICKY, node_code
from gpe_pl.solvers.fem import FEM
from gpe_pl.solvers.scenes import SceneDistribution, describe
from gpe_pl.solvers.solid_scenes import SolidScene

SQUARE = ((0.0, 1.0), (0.0, 1.0))
CONFIGS = {
    "triangle": SolidScene(bounds=SQUARE, cell="triangle", num_cells=230),
    "quad": SolidScene(bounds=SQUARE, cell="quad", num_cells=230),
    "tetrahedron": SolidScene(bounds=(*SQUARE, (0.0, 1.0)), cell="tetrahedron", num_cells=300, gravity=(0.0, 0.0, -9.81)),
}
VALUES = {"solid": 2e6}


@pytest.fixture(params=CONFIGS)
def config(request):
    return CONFIGS[request.param]


@functools.cache
def drawn(kind, seed):
    return CONFIGS[kind].sample(VALUES, seed)


def test_is_a_scene(config):
    assert config.materials == ("solid",) and config.dim == len(config.bounds)
    assert isinstance(config, SceneDistribution)


@pytest.mark.slow
def test_same_seed_gives_same_bytes(config):
    a, b, other = config.sample(VALUES, 5), drawn(config.cell, 5), drawn(config.cell, 4)
    for name in ("pos", "vel", "node_type", "mass", "material_params", "gravity", "rest_pos", "cells"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name
    assert a.boundary.pos.tobytes() == b.boundary.pos.tobytes() and a.boundary.shapes == b.boundary.shapes
    assert a.pos.tobytes() != other.pos.tobytes()


@pytest.mark.slow
def test_stiffness_changes_nothing_else(config):
    soft, stiff = config.sample({"solid": 5e5}, 1), config.sample({"solid": 1e7}, 1)
    assert soft.pos.tobytes() == stiff.pos.tobytes() and soft.vel.tobytes() == stiff.vel.tobytes()
    assert np.all(soft.material_params == 5e5) and np.all(stiff.material_params == 1e7)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_body_is_at_rest_inside_and_free(config, seed):
    state = drawn(config.cell, seed)
    assert state.pos.dtype == state.vel.dtype == np.float64
    assert np.all(state.node_type == node_code("solid")) and MATERIALS["solid"][0].name == "youngs_modulus"
    np.testing.assert_array_equal(state.rest_pos, state.pos)
    assert not np.any(state.stress.node) and not np.any(state.stress.cell)
    components = 4 if config.dim == 2 else 6
    assert state.stress.node.shape == (state.num_nodes, components) and state.stress.cell.shape == (len(state.cells), components)
    low, high = np.array(config.bounds).T
    assert np.all(state.pos > low) and np.all(state.pos < high)
    assert signed_distance(state.boundary.shapes, state.pos).min() > 0.4 * config.spacing
    assert state.pos[:, -1].min() >= low[-1] + config.drop_height[0] - 1e-12
    assert state.num_nodes <= config.max_nodes and len(state.cells) <= config.max_cells
    assert state.num_nodes > 0.5 * config.max_nodes and len(state.cells) > 0.5 * config.max_cells


def test_mass_is_density_times_volume(config):
    masses = [drawn(config.cell, seed).mass for seed in range(4)]
    assert all(np.all(m > 0) for m in masses)
    expected = config.density * config.body_size**config.dim
    np.testing.assert_allclose([m.sum() for m in masses], expected, rtol=0.05 if config.dim == 2 else 0.35)
    heavy = replace(config, density=3 * config.density).sample(VALUES, 0)
    np.testing.assert_allclose(heavy.mass, 3 * masses[0], rtol=1e-12)


def test_spacing_is_the_mean_edge(config):
    for seed in range(4):
        state = drawn(config.cell, seed)
        corners = state.cells.shape[1]
        pairs = [(a, b) for a in range(corners) for b in range(a)] if config.cell == "tetrahedron" else [(k, k - 1) for k in range(corners)]
        edges = np.concatenate([state.pos[state.cells[:, a]] - state.pos[state.cells[:, b]] for a, b in pairs])
        assert np.mean(np.linalg.norm(edges, axis=1)) == pytest.approx(config.spacing, rel=0.12)


def test_motion_is_rigid(config):
    state = drawn(config.cell, 2)
    a, b = np.random.default_rng(0).integers(state.num_nodes, size=(2, 50))
    np.testing.assert_allclose(np.sum((state.pos[a] - state.pos[b]) * (state.vel[a] - state.vel[b]), axis=1), 0.0, atol=1e-12)
    middle = state.mass @ state.vel / state.mass.sum()
    assert np.all(np.abs(middle) <= config.max_speed) and middle[-1] <= 0.25 * config.max_speed
    still = replace(config, max_speed=0.0, max_spin=0.0).sample(VALUES, 2)
    assert not np.any(still.vel)


def test_obstacles_vary(config):
    shapes = [drawn(config.cell, seed).boundary.shapes[2 * config.dim :] for seed in range(6)]
    assert {len(s) for s in shapes} <= {0, 1, 2, 3} and sum(len(s) for s in shapes) > 3
    kinds = {shape.kind for s in shapes for shape in s}
    assert kinds <= ({"box", "sphere", "polygon"} if config.dim == 2 else {"box", "sphere"}) and len(kinds) > 1
    friction = {shape.friction for s in shapes for shape in s}
    low, high = config.coulomb_friction
    assert len(friction) > 2 and all(f in (0.0, STICKY) or low <= f <= high for f in friction)
    radii = [shape.radius for s in shapes for shape in s if isinstance(shape, Sphere)]
    assert all(config.obstacle_radius[0] <= r <= config.obstacle_radius[1] for r in radii)


def test_rolls_out_with_stress_in_every_frame(config):
    scene = replace(config, max_speed=3.0)
    fem = FEM(bounds=scene.bounds)
    trajectory = rollout(fem, scene.sample(VALUES, 0), 5, describe(scene, fem.frame_dt))
    assert trajectory.termination is None and trajectory.stress is not None
    assert trajectory.stress.cell.shape[0] == 6 and not np.any(trajectory.stress.cell[0])
    assert trajectory.metadata.spacing == scene.spacing and trajectory.metadata.connectivity_radius == 2 * scene.spacing


@pytest.mark.parametrize(
    "change",
    [
        {"bounds": (*SQUARE, (0.0, 1.0))},
        {"cell": "tetrahedron"},
        {"cell": "hexahedron"},
        {"bounds": ((1.0, 0.0), (0.0, 1.0))},
        {"gravity": (0.0, 0.0, -9.81)},
        {"num_cells": 10},
        {"body_size": 0.0},
        {"density": -1.0},
        {"num_obstacles": (3, 1)},
        {"drop_height": (0.2, 0.1)},
        {"coulomb_friction": (0.8, 0.1)},
        {"sticky_probability": 0.7, "slip_probability": 0.7},
        {"misspelt": 1},
    ],
)
def test_invalid_settings_are_refused(change):
    with pytest.raises(ValueError):
        SolidScene(**{"bounds": SQUARE, "cell": "triangle", "num_cells": 100, **change})


def test_body_too_large_for_the_domain():
    with pytest.raises(ValueError, match="no room for a body"):
        SolidScene(bounds=SQUARE, cell="triangle", num_cells=100, body_size=2.0).sample(VALUES, 0)


def test_body_is_as_large_as_configured():
    state = SolidScene(bounds=SQUARE, cell="triangle", num_cells=230, body_size=0.3).sample(VALUES, 0)
    edges = state.pos[state.cells][:, 1:] - state.pos[state.cells][:, :1]
    assert np.sum(np.linalg.det(edges)) / 2 == pytest.approx(0.09, rel=0.04)
    assert math.dist(state.pos.min(axis=0), state.pos.max(axis=0)) > 0.3
