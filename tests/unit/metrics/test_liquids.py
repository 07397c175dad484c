"""Metrics of liquids: each sees its own fault, and none depends on which node is where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.metrics.liquids import UNITS, liquid_metrics, volume
from gpe_pl.metrics.rollouts import rollout_metrics
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

SPACING = 0.1
POOL = SPACING * (0.5 + np.stack(np.meshgrid(np.arange(20), np.arange(6)), axis=-1).reshape(-1, 2))
MASS = np.ones(len(POOL))
METADATA = Metadata("pool", ("fluid",), ("kinematic_viscosity",), 0.01, SPACING, 2 * SPACING, ((0.0, 3.0), (0.0, 3.0)), (0.0, -9.81))


def measured(pos: np.ndarray, metadata: Metadata = METADATA) -> dict[str, float]:
    return liquid_metrics(pos, POOL, MASS, metadata)


def test_exchanged_nodes_are_no_error() -> None:
    order = np.random.default_rng(0).permutation(len(POOL))
    assert max(measured(POOL[order]).values()) < 1e-12


def test_nodes_that_coincide_as_in_the_ground_truth_are_no_error() -> None:
    pos = np.repeat(POOL[:1], 3, axis=0)
    assert set(liquid_metrics(pos, pos, np.ones(3), METADATA).values()) == {0.0}
    assert liquid_metrics(POOL[:3], pos, np.ones(3), METADATA)["spacing_error"] == np.inf


def test_clusters_are_an_error_of_spacing_and_density_but_not_of_the_centre() -> None:
    clustered = POOL.copy()
    clustered[1::2, 0] -= 0.06  # pairs along each row
    found = measured(clustered)
    assert found["spacing_error"] == pytest.approx(0.6, rel=1e-6)
    assert found["density_error"] > 0.15
    assert found["spread_error"] < 0.03 and found["centre_error"] == pytest.approx(0.03)


def test_a_compressed_pool_has_less_volume_and_more_density() -> None:
    found = measured(POOL * [1.0, 0.5])
    assert found["volume_error"] == pytest.approx(1 - 3.5 / 6, abs=0.02)  # half a spacing around the nodes belongs to the liquid
    assert found["density_error"] > 0.3


@pytest.mark.parametrize("place", [0.0, 0.25, 0.5])
def test_moves_of_any_size_leave_the_volume_as_it_is(place: float) -> None:
    """Also where nodes are at the faces of boxes of a grid that begins at the origin."""
    lattice = POOL + place * SPACING
    moved = lattice + np.random.default_rng(1).normal(scale=1e-6 * SPACING, size=lattice.shape)
    assert liquid_metrics(moved, lattice, MASS, METADATA)["volume_error"] < 1e-9


def test_a_pool_elsewhere_differs_in_its_centre_only() -> None:
    found = measured(POOL + np.array([SPACING, 2 * SPACING]))
    assert found["centre_error"] == pytest.approx(np.sqrt(5) * SPACING)
    assert max(value for name, value in found.items() if name != "centre_error") < 1e-9


def test_in_periodic_domains_there_is_no_centre_and_the_seam_is_no_gap() -> None:
    around = replace(METADATA, bounds=((0.0, 2.0), (0.0, 3.0)), periodic=(True, False))
    shifted = around.periodicity.wrapped(POOL + np.array([0.5, 0.0]))
    assert measured(shifted, around) == pytest.approx({"spacing_error": 0.0, "density_error": 0.0, "volume_error": 0.0}, abs=1e-9)


def test_rollouts_of_liquids_have_them_and_others_do_not() -> None:
    pos = np.repeat(POOL[None], 4, axis=0) + 0.01 * np.arange(4)[:, None, None]
    wet = Trajectory.from_numpy(pos, 0.01, ["fluid"] * 60 + ["sand"] * 60, {"fluid": 1e-3, "sand": 30.0}, spacing=SPACING)
    records = rollout_metrics(replace(wet, pos=wet.pos + np.where(np.arange(4) > 0, 0.1, 0.0)[:, None, None]), wet, [2])
    found = {r.metric: r.value for r in records}
    assert {*UNITS} <= {*found}
    assert found["centre_error"] == pytest.approx(0.1 * np.sqrt(2))
    dry = Trajectory.from_numpy(pos, 0.01, "sand", {"sand": 30.0}, spacing=SPACING)
    assert not {*UNITS} & {r.metric for r in rollout_metrics(dry, dry, [2])}
    broken = replace(wet, pos=np.where(np.arange(4)[:, None, None] > 1, np.nan, wet.pos))
    assert all(np.isinf(r.value) for r in rollout_metrics(broken, wet, [2]) if r.metric in UNITS)


@pytest.mark.parametrize("dim", [2, 3])
def test_moves_of_the_whole_liquid_by_parts_of_a_spacing_leave_its_volume(dim: int) -> None:
    axes = np.meshgrid(*[np.arange(20), np.arange(8), np.arange(8)][:dim], indexing="ij")
    pool = SPACING * (0.5 + np.stack(axes, axis=-1).reshape(-1, dim))
    pool = pool + np.random.default_rng(0).uniform(-0.25, 0.25, pool.shape) * SPACING
    metadata = replace(METADATA, bounds=((0.0, 3.0),) * dim, gravity=(0.0,) * (dim - 1) + (-9.81,))
    found = [volume(pool + shift * SPACING, metadata) for shift in (0.0, 0.1, 0.25, 0.4, 0.5, 0.7)]
    assert np.ptp(found) < 0.02 * np.mean(found)


def test_nodes_that_flew_far_apart_have_a_volume() -> None:
    metadata = replace(METADATA, bounds=((0.0, 3.0),) * 3, gravity=(0.0, 0.0, -9.81))
    assert volume(np.array([[0.0, 0.0, 0.0], [1e9, -1e9, 1e9]]), metadata) == pytest.approx(2 * SPACING**3)
