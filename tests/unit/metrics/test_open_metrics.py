"""Accounts and metrics of open scenes, their pictures and their VTK files."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gpe_pl.export.trajectories import write_vtk
from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.metrics.open_scenes import entering, leaving, ledger, level
from gpe_pl.metrics.quantities import quantities
from gpe_pl.metrics.rollouts import per_frame_mse, rollout_metrics
from gpe_pl.rollout.baselines import ConstantVelocity
from gpe_pl.rollout.loop import rollout
from gpe_pl.schema import node_code
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.state import State, Stress
from gpe_pl.trajectory.trajectory import Metadata, Termination, Trajectory
from gpe_pl.viz.viewer import write_viewer

DT, BOUNDS = 0.05, ((0.0, 1.0), (0.0, 1.0))
INLET = Opening((0.0, 0.0), (0.2, 0.3), "x_low", 1.0, 0.1, node_code("sand"), 2.0, (30.0,))


@pytest.fixture
def channel() -> Trajectory:
    """Return a flow of 1 m/s with three layers that fills a channel, and steady thereafter."""
    pos = INLET.nodes_at_start()
    count = len(pos)
    state = State(
        pos, np.tile(INLET.velocity_at(0.0), (count, 1)), np.full(count, INLET.node_type, np.uint8), np.full(count, 2.0), np.full((count, 1), 30.0),
        Boundary.sample(domain_walls(BOUNDS, 0.0), 0.1, 2), np.zeros(2), param_names=("friction_angle",),
    )  # fmt: skip
    metadata = Metadata("channel", ("sand",), ("friction_angle",), DT, 0.1, 0.2, BOUNDS, (0.0, 0.0), split="test")
    return rollout(ConstantVelocity(DT), state.opened([INLET, Opening((0.8, -0.1), (1.0, 1.0), "x_high")]), 40, metadata)


def test_mass_and_momentum_are_accounted_for(channel: Trajectory) -> None:
    book = ledger(channel)
    np.testing.assert_allclose(book.mass[1:], book.mass[:-1] + book.entered_mass[1:] - book.left_mass[1:])
    assert book.entered_mass.sum() == pytest.approx(2.0 * entering(channel).sum()) == pytest.approx(2.0 * 3 * 40 * DT / 0.1)
    assert leaving(channel).sum() > 0
    np.testing.assert_allclose(book.forces, 0.0, atol=1e-4)  # nothing accelerates
    np.testing.assert_allclose(book.momentum[:, 0], book.mass, rtol=1e-5)


def test_the_level_is_that_of_the_layers(channel: Trajectory) -> None:
    depth = level(channel, 0, 0.2, 0.6)
    assert depth[0] == 0
    np.testing.assert_allclose(depth[20:], 0.3, rtol=1e-6)


def test_errors_count_living_nodes_only(channel: Trajectory) -> None:
    assert channel.alive is not None
    records = {r.metric: r.value for r in rollout_metrics(channel, channel, ["full"])}
    assert records == dict.fromkeys(["rollout_mse", "final_mse", "mass_error", "outflow_error", "energy_distance", "fraction_outside"], 0.0)
    parked = replace(channel, pos=np.where(channel.alive[..., None], channel.pos, 7.0))
    assert {r.metric: r.value for r in rollout_metrics(parked, channel, ["full"])} == records
    moved = replace(channel, pos=channel.pos + np.where(np.arange(41)[:, None, None] > 0, 0.1, 0.0))
    np.testing.assert_allclose(per_frame_mse(moved, channel)[1:], 0.01, rtol=1e-4)


def test_materials_that_swap_places_are_a_distance_in_open_scenes(channel: Trajectory) -> None:
    """The upper layers are of another material, and the prediction has them below."""
    names = ("friction_angle", "hardening_coefficient")
    metadata = replace(channel.metadata, materials=("sand", "snow"), param_names=names)
    snow = channel.pos[20, :, 1] > 0.15
    types = np.where(snow, node_code("snow"), node_code("sand")).astype(np.uint8)
    mixed = replace(channel, metadata=metadata, node_type=types, material_params=np.ones((channel.num_nodes, 2), np.float32))
    flipped = mixed.pos.copy()
    flipped[1:, :, 1] = 0.3 - flipped[1:, :, 1]
    values = [
        {r.metric: r.value for r in rollout_metrics(replace(own, pos=flipped), own, ["full"])}["energy_distance"]
        for own in (channel, mixed)
    ]
    assert values[0] < 1e-4 < 0.02 < values[1] < np.inf


def test_an_exact_rollout_that_ends_empty_has_no_error(channel: Trajectory) -> None:
    assert channel.alive is not None
    empty = replace(channel, alive=channel.alive & (np.arange(41) < 40)[:, None])
    assert {r.value for r in rollout_metrics(empty, empty, ["full"])} == {0.0}
    errors = {r.metric: r.value for r in rollout_metrics(empty, channel, ["full"])}
    assert errors["mass_error"] == 1.0 and errors["energy_distance"] == float("inf")


def test_losing_nodes_is_an_error(channel: Trajectory) -> None:
    """A node that is lost counts where it was last, so a rollout without nodes is not a perfect one."""
    assert channel.alive is not None
    frames = np.arange(41)[:, None]
    lost = replace(channel, alive=channel.alive & (frames < 20))
    error = per_frame_mse(lost, channel)
    assert not error[:20].any()
    stayed = channel.alive[19] & channel.alive[20]
    never = ~channel.alive[:20].any(axis=0)  # these have no place in the rollout that lost all
    counted = channel.alive[20] & ~never
    np.testing.assert_allclose(error[20], stayed[counted].sum() * (DT * 1.0) ** 2 / 2 / counted.sum(), rtol=1e-3)
    assert (np.diff(error[20:25]) > 0).all()
    half = replace(channel, alive=channel.alive & ((frames < 20) | (np.arange(channel.num_nodes) % 2 == 0)))
    assert 0 < per_frame_mse(half, channel)[22] < error[22]


def test_a_flow_that_stays_has_errors(channel: Trajectory) -> None:
    assert channel.alive is not None
    stays = replace(channel, alive=np.logical_or.accumulate(channel.alive, axis=0))
    values = {r.metric: r.value for r in rollout_metrics(stays, channel, [40])}
    assert values["outflow_error"] == 1.0
    assert values["mass_error"] == pytest.approx(leaving(channel).sum() / channel.alive[-1].sum())
    assert values["rollout_mse"] == 0.0  # what should have left has not moved since


def test_quantities_are_those_of_what_is_in_the_scene(channel: Trajectory) -> None:
    assert channel.alive is not None
    found, count = quantities(channel), channel.alive[1:].sum(axis=1)
    np.testing.assert_allclose(found["kinetic energy"].over_time, 0.5 * 2.0 * count, rtol=1e-4)
    np.testing.assert_allclose(found["momentum"].over_time, 2.0 * count, rtol=1e-4)
    np.testing.assert_allclose(found["mass"].over_time, 2.0 * count)
    assert found["mass"].value == 2.0 * count[-1]
    assert found["outflow"].value == 2.0 * leaving(channel).sum() > 0
    parked = replace(channel, pos=np.where(channel.alive[..., None], channel.pos, 7.0))
    assert {name: own.over_time.tolist() for name, own in quantities(parked).items()} == {
        name: own.over_time.tolist() for name, own in found.items()
    }


def test_a_rollout_that_stopped_early_compares_with_a_longer_one(channel: Trajectory, tmp_path: Path) -> None:
    short = replace(channel.frames(0, 10), termination=Termination("nan", 10, 0, "frame 10: node 0 …"), is_prediction=True)
    assert short.num_nodes < channel.num_nodes
    values = {(r.metric, r.horizon): r.value for r in rollout_metrics(short, channel, [5, 20])}
    assert values["rollout_mse", 5] == 0.0
    assert values["rollout_mse", 20] == float("inf")
    write_viewer(tmp_path / "short.html", channel, {"short": short})
    write_vtk(tmp_path / "short.pvd", short, channel)


def test_the_viewer_hides_nodes_that_are_not_there(channel: Trajectory, tmp_path: Path) -> None:
    from gpe_pl.viz import viewer

    shown: dict[str, np.ndarray] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(viewer, "_element", lambda name, kind, values: shown.setdefault(name, values) is None or "")
        write_viewer(tmp_path / "channel.html", channel)
    assert channel.alive is not None
    np.testing.assert_array_equal((shown["t0_pos"] != 65535).all(axis=-1), channel.alive)
    assert np.isfinite(shown["all_height"]).all()


def test_vtk_has_the_nodes_that_are_there(channel: Trajectory, tmp_path: Path) -> None:
    write_vtk(tmp_path / "channel.pvd", channel, channel)
    assert channel.alive is not None
    for frame in (0, 40):
        text = (tmp_path / "channel" / f"frame_{frame:05d}.vtu").read_text()
        count = int(re.findall(r'NumberOfPoints="(\d+)"', text)[0])
        assert count == channel.alive[frame].sum()
        assert 'Name="node"' in text


def test_nodes_that_the_ground_truth_does_not_have_have_no_error(channel: Trajectory, tmp_path: Path) -> None:
    meshio = pytest.importorskip("meshio")
    assert channel.alive is not None
    lost = int(np.flatnonzero(channel.alive[40])[0])
    alive = channel.alive.copy()
    alive[40:, lost] = False
    write_vtk(tmp_path / "channel.pvd", channel, replace(channel, alive=alive))
    found = meshio.read(tmp_path / "channel" / "frame_00040.vtu").point_data
    assert np.flatnonzero(np.isnan(found["error"])).tolist() == np.flatnonzero(found["node"] == lost).tolist()


def test_vtk_has_the_stress_of_particles_at_points_only(channel: Trajectory, tmp_path: Path) -> None:
    frames, nodes = channel.pos.shape[:2]
    write_vtk(tmp_path / "channel.pvd", replace(channel, stress=Stress(np.ones((frames, nodes, 4)), np.ones((frames, 0, 4)))))
    grid = (tmp_path / "channel" / "frame_00040.vtu").read_text()
    points, cells = (grid[grid.index(f"<{part}>") : grid.index(f"</{part}>")] for part in ("PointData", "CellData"))
    assert 'Name="von_mises"' in points and "von_mises" not in cells
