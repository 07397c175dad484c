"""Random scenes: reproducible, with an exact number of particles, free of overlap, and with random node order."""

import itertools
import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.data.ground_truth import scene_settings
from gpe_pl.geometry.body_shapes import JITTER
from gpe_pl.geometry.shapes import signed_distance
from gpe_pl.schema import NODE_TYPES, STICKY, node_code
from gpe_pl.solvers.scenes import BodyScene, SceneDistribution, describe

DENSITY = {"sand": 1600.0, "snow": 400.0, "elastomer": 1000.0}


def make(**changes):
    return BodyScene(
        **{
            "bounds": ((0, 1), (0, 1)),
            "materials": ("sand",),
            "grid_spacing": 1 / 32,
            "particles_per_cell": 2,
            "num_particles": 320,
            "density": DENSITY,
            **changes,
        }
    )


CONFIG = make()
SEEDS = range(30)


def test_a_density_of_no_material_is_refused():
    with pytest.raises(ValueError, match="density of snwo: no material; materials are sand, snow"):
        make(density={**DENSITY, "snwo": 400.0})


@pytest.fixture(scope="module")
def scenes():
    return [CONFIG.sample({"sand": 30.0}, seed) for seed in SEEDS]


def test_is_a_pure_function(scenes):
    np.random.seed(1)  # noqa: NPY002 the global generator must not matter
    again = CONFIG.sample({"sand": 30.0}, SEEDS[3])
    assert again.pos.tobytes() == scenes[3].pos.tobytes() and again.vel.tobytes() == scenes[3].vel.tobytes()
    assert again.boundary.shapes == scenes[3].boundary.shapes
    assert len({s.pos.tobytes() for s in scenes}) == len(scenes)


def test_value_does_not_change_the_scene(scenes):
    other = CONFIG.sample({"sand": 45.0}, SEEDS[0])
    assert other.pos.tobytes() == scenes[0].pos.tobytes()
    assert np.all(other.material_params == 45.0)


@pytest.mark.parametrize("count", [1, 7, 150, 320])
def test_number_of_particles_is_exact(count):
    config = make(num_particles=count)
    assert all(config.sample({"sand": 30.0}, seed).num_nodes == count for seed in range(5))


def test_no_overlap(scenes):
    for state in scenes:
        assert signed_distance(state.boundary.shapes, state.pos).min() > 0.4 * CONFIG.spacing
        gaps = np.linalg.norm(state.pos[:, None] - state.pos, axis=-1)
        np.fill_diagonal(gaps, np.inf)
        assert gaps.min() > 0.45 * CONFIG.spacing


def test_density_is_that_of_the_material(scenes):
    for state in scenes:
        assert state.mass.sum() == pytest.approx(DENSITY["sand"] * CONFIG.num_particles * CONFIG.spacing**2)
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
    config = make(grid_spacing=1 / 8, num_particles=256)
    with pytest.raises(ValueError, match="lower num_particles"):
        config.sample({"sand": 30.0}, 0)


@pytest.mark.parametrize(
    "change",
    [
        {"grid_spacing": 0.0},
        {"num_particles": 0},
        {"drop_height": (0.2, 0.1)},
        {"sticky_probability": 0.8, "slip_probability": 0.8},
        {"bounds": ((0, 1), (0, 1), (0, 1))},
        {"bounds": ((0, 1), (1, 1))},
        {"bounds": ((0, 1), (0, math.inf))},
        {"gravity": (0.0, math.nan)},
        {"coulomb_friction": (0.8, 0.1)},
        {"misspelt": 1},
    ],
)
def test_invalid_config_is_refused(change):
    with pytest.raises(ValueError):
        make(**{"num_particles": 10, **change})


def test_metadata():
    metadata = describe(CONFIG, 5e-3, seed=7)
    assert metadata.param_names == ("friction_angle",) and metadata.seed == 7
    assert metadata.connectivity_radius == pytest.approx(3.75 / 32)


SPATIAL = make(bounds=((0, 1),) * 3, gravity=(0, 0, -9.81), grid_spacing=1 / 16, particles_per_cell=1, num_particles=300)


def test_scenes_in_3d():
    states = [SPATIAL.sample({"sand": 30.0}, seed) for seed in range(12)]
    for state in states:
        assert state.pos.shape == (300, 3) and signed_distance(state.boundary.shapes, state.pos).min() > 0.4 * SPATIAL.spacing
        assert state.mass.sum() == pytest.approx(1600 * 300 / 16**3)
    assert {s.kind for state in states for s in state.boundary.shapes} == {"wall", "box", "sphere"}


def test_bodies_of_several_materials():
    config = make(materials=("sand", "snow", "elastomer"))
    values = {"sand": 30.0, "snow": 8.0, "elastomer": 1e5}
    states = [config.sample(values, seed) for seed in range(30)]
    assert {NODE_TYPES[k] for state in states for k in state.node_type} == set(values)
    for state in states:
        for column, material in enumerate(("sand", "snow", "elastomer")):
            chosen = state.node_type == node_code(material)
            np.testing.assert_array_equal(state.material_params[chosen, column], values[material])
            assert np.isnan(state.material_params[~chosen, column]).all()
            np.testing.assert_allclose(state.mass[chosen], DENSITY[material] * config.spacing**2)
        assert set(state.node_type[np.unique(state.cells)]) <= {node_code("elastomer")}


@pytest.mark.parametrize("dim", [2, 3])
def test_cells_fill_the_lattice_of_an_elastomer(dim):
    """Every simplex has the volume of spacing^dim / dim!, together they fill whole lattice cells, and each face belongs to at most two."""
    config = replace(make() if dim == 2 else SPATIAL, materials=("elastomer",), max_bodies=1)
    state = config.sample({"elastomer": 1e5}, 4)
    edges = state.pos[state.cells[:, 1:]] - state.pos[state.cells[:, :1]]
    np.testing.assert_allclose(np.linalg.det(edges), config.spacing**dim, rtol=1e-9)
    faces = Counter(frozenset(c) for cell in state.cells for c in itertools.combinations(cell.tolist(), dim))
    assert max(faces.values()) == 2 and sum(n == 1 for n in faces.values()) < len(faces) / 2
    assert len(state.cells) % math.factorial(dim) == 0 and 0.5 * config.max_cells < len(state.cells) <= config.max_cells
    np.testing.assert_array_equal(state.rest_pos, state.pos)


def test_only_meshed_materials_have_cells(scenes):
    assert scenes[0].cells is None and scenes[0].rest_pos is None
    assert isinstance(CONFIG, SceneDistribution)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("material", ["snow", "elastomer"])
def test_resting_bodies_touch_a_wall_with_a_flat_side(dim, material):
    config = replace(make() if dim == 2 else SPATIAL, materials=(material,), resting_probability=1.0)
    touched: Counter[tuple[int, int]] = Counter()
    for seed in range(12):
        state = config.sample({material: 8.0}, seed)
        assert not state.vel.any()
        low, high = np.array(config.bounds).T
        for axis, side in itertools.product(range(dim), (0, 1)):
            gap = (state.pos[:, axis] - low[axis] if side == 0 else high[axis] - state.pos[:, axis]) / config.spacing
            first = gap < 0.5 + (JITTER if material == "snow" else 0.0) + 1e-9
            if np.mean(first) > 0.02:  # a layer, not a corner
                touched[axis, side] += 1
                assert gap.min() > 0.24
        assert signed_distance(state.boundary.shapes, state.pos).min() > 0.24 * config.spacing
        gaps = np.linalg.norm(state.pos[:, None] - state.pos, axis=-1)
        np.fill_diagonal(gaps, np.inf)
        assert gaps.min() > 0.45 * config.spacing
        if material == "elastomer":
            edges = state.pos[state.cells[:, 1:]] - state.pos[state.cells[:, :1]]
            np.testing.assert_allclose(np.linalg.det(edges), config.spacing**dim, rtol=1e-9)
    assert len(touched) == 2 * dim


def test_a_share_of_the_bodies_rests():
    config = replace(make(), resting_probability=0.3)
    scenes = [config.sample({"sand": 30.0}, seed) for seed in range(300)]
    at_rest = [float(np.mean(~s.vel.any(axis=1))) for s in scenes]
    assert 0.2 < np.mean(at_rest) < 0.4 and any(0 < share < 1 for share in at_rest)


def test_provenance_of_thrown_bodies_is_as_before_there_were_resting_ones():
    """So that data sets that were generated before are found again."""
    assert "resting_probability" not in scene_settings(CONFIG)
    assert scene_settings(replace(CONFIG, resting_probability=0.5))["resting_probability"] == 0.5
