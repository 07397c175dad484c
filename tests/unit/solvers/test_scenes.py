"""Random scenes: pure, exact in number, free of overlap, and without order in the labels."""

import numpy as np
import pytest

from gpe_pl.geometry import signed_distance
from gpe_pl.schema import STICKY
from gpe_pl.solvers.scenes import SceneConfig, describe, sample_scene

CONFIG = SceneConfig(bounds=((0, 1), (0, 1)), grid_spacing=1 / 32, num_particles=320)
SEEDS = range(30)


@pytest.fixture(scope="module")
def scenes():
    return [sample_scene(CONFIG, "sand", 30.0, seed) for seed in SEEDS]


def test_is_a_pure_function(scenes):
    np.random.seed(1)  # noqa: NPY002 the global generator must not matter
    again = sample_scene(CONFIG, "sand", 30.0, SEEDS[3])
    assert again.pos.tobytes() == scenes[3].pos.tobytes() and again.vel.tobytes() == scenes[3].vel.tobytes()
    assert again.boundary.shapes == scenes[3].boundary.shapes
    assert len({s.pos.tobytes() for s in scenes}) == len(scenes)


def test_value_does_not_change_the_scene(scenes):
    other = sample_scene(CONFIG, "sand", 45.0, SEEDS[0])
    assert other.pos.tobytes() == scenes[0].pos.tobytes()
    assert np.all(other.material_params == 45.0)


@pytest.mark.parametrize("count", [1, 7, 150, 320])
def test_number_of_particles_is_exact(count):
    config = SceneConfig(bounds=((0, 1), (0, 1)), grid_spacing=1 / 32, num_particles=count)
    assert all(sample_scene(config, "sand", 30.0, seed).num_nodes == count for seed in range(5))


def test_no_overlap(scenes):
    for state in scenes:
        assert signed_distance(state.boundary.shapes, state.pos).min() > 0.4 * CONFIG.spacing
        gaps = np.linalg.norm(state.pos[:, None] - state.pos, axis=-1)
        np.fill_diagonal(gaps, np.inf)
        assert gaps.min() > 0.45 * CONFIG.spacing


def test_density_is_that_of_the_material(scenes):
    for state in scenes:
        assert state.mass.sum() == pytest.approx(CONFIG.density * CONFIG.num_particles * CONFIG.spacing**2)
        # as many neighbours within three spacings as an undisturbed lattice has, for an inner particle
        neighbours = np.sum(np.linalg.norm(state.pos[:, None] - state.pos, axis=-1) < 3 * CONFIG.spacing, axis=1) - 1
        assert np.percentile(neighbours, 90) == pytest.approx(np.pi * 9 - 1, abs=4)


def test_labels_carry_no_geometric_order(scenes):
    """Neighbours in label are as far apart as random pairs."""
    successive = np.mean([np.linalg.norm(np.diff(s.pos, axis=0), axis=-1).mean() for s in scenes])
    pairs = np.mean([np.linalg.norm(s.pos[:, None] - s.pos, axis=-1).mean() for s in scenes])
    assert successive == pytest.approx(pairs, rel=0.05)


def test_scenes_vary(scenes):
    frictions = {s.friction for state in scenes for s in state.boundary.shapes}
    assert 0.0 in frictions and STICKY in frictions and len(frictions) > 20
    assert {s.kind for state in scenes for s in state.boundary.shapes} == {"wall", "box", "sphere", "polygon"}
    assert len({len(np.unique(state.vel, axis=0)) for state in scenes}) == 3  # one to three bodies


def test_boundary_nodes_are_as_dense_as_particles(scenes):
    nodes = scenes[0].boundary.pos
    floor = np.sort(nodes[nodes[:, 1] == 0.0][:, 0])
    assert np.diff(np.unique(floor)).max() <= CONFIG.spacing * (1 + 1e-9)


def test_impossible_scene_says_what_to_change():
    config = SceneConfig(bounds=((0, 1), (0, 1)), grid_spacing=1 / 8, num_particles=256)
    with pytest.raises(ValueError, match="lower num_particles"):
        sample_scene(config, "sand", 30.0, 0)


@pytest.mark.parametrize(
    "change",
    [
        {"grid_spacing": 0.0},
        {"num_particles": 0},
        {"drop_height": (0.2, 0.1)},
        {"sticky_probability": 0.8, "slip_probability": 0.8},
        {"bounds": ((0, 1), (0, 1), (0, 1))},
        {"bounds": ((0, 1), (1, 1))},
        {"misspelt": 1},
    ],
)
def test_invalid_config_is_refused(change):
    with pytest.raises(ValueError):
        SceneConfig(**{"bounds": ((0, 1), (0, 1)), "grid_spacing": 1 / 32, "num_particles": 10, **change})


def test_metadata():
    metadata = describe(CONFIG, "sand", 5e-3, seed=7)
    assert metadata.param_names == ("friction_angle",) and metadata.seed == 7
    assert metadata.connectivity_radius == pytest.approx(3 * metadata.spacing)
