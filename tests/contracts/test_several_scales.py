"""A model of several spacings and frame intervals sees similar scenes alike, is told the scale, and warns outside the range of its training."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch

from gpe_pl.data.checksum import split_checksum
from gpe_pl.data.datamodule import TrajectoryDataModule
from gpe_pl.data.dataset import StartKey
from gpe_pl.data.noise import Noise
from gpe_pl.data.sampling import BatchSize
from gpe_pl.data.statistics import acceleration_std
from gpe_pl.evaluation.identification.answer import read_answers
from gpe_pl.evaluation.identification.observations import ObservationSettings
from gpe_pl.evaluation.identification.results import Task
from gpe_pl.evaluation.identification.scene import identify_parameters
from gpe_pl.evaluation.identification.search import SearchSettings
from gpe_pl.evaluation.identification.shooting import ShootingSettings
from gpe_pl.files import sealed
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.graphs.topology import GraphError
from gpe_pl.identify import identify_all
from gpe_pl.learned.simulator import CheckpointError, LearnedSimulator, SceneError
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.blocks import Standardize
from gpe_pl.rollout.loop import rollout
from gpe_pl.system.compiled import unfused
from gpe_pl.training.push_forward import Excursions
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import StoreError, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests import scenes

LONGER, SLOWER = 1.7, 1.7**0.5
"""Factors of lengths and times between similar scenes with the same gravity."""


def built(use: str = "dimensionless", **config: Any) -> GraphBuilder:
    return scenes.builder(("sand",), **{"history": 2, "islands": True, "scales": use, **config})


def learned(build: GraphBuilder) -> LearnedSimulator:
    torch.manual_seed(0)
    return LearnedSimulator(GPE(build.spec, num_message_passing_steps=2, hidden_channels=8, island_momentum="angular"), build).eval()


def similar(s: State) -> State:
    """Return a scene that is larger and slower than another one."""
    walls, velocity = s.boundary, LONGER / SLOWER
    return replace(
        s,
        pos=LONGER * s.pos,
        vel=velocity * s.vel,
        velocity_history=velocity * s.velocity_history,
        mass=LONGER**2 * s.mass,
        boundary=replace(walls, pos=LONGER * walls.pos, vel=velocity * walls.vel, shapes=()),
    )


@pytest.mark.parametrize("compiled", [True, False])
def test_similar_scenes_have_the_same_graph_except_for_the_stiffness(compiled: bool) -> None:
    build, s = built(), scenes.state(40, history=2)
    other = build.at(LONGER * build.metadata.spacing, SLOWER * build.metadata.frame_dt)
    if compiled:
        graph, there = build(s.to_torch()), other(similar(s).to_torch())
    else:
        with unfused():
            graph, there = build(s.to_torch()), other(similar(s).to_torch())
    for relation in build.spec.relations:
        for key in ("edge_index", "odd", "even", "offset"):
            assert torch.allclose(graph[relation][key], there[relation][key], atol=1e-5), (relation, key)
    assert torch.allclose(graph["sand"].x[:, :-1], there["sand"].x[:, :-1], atol=1e-5)
    assert torch.allclose(graph["sand"].mass, there["sand"].mass)
    assert graph["sand"].x[0, -2:].tolist() == [0.0, 0.0]
    assert there["sand"].x[0, -1].item() == pytest.approx(np.log2(SLOWER / LONGER))


def test_skips_of_a_copy_for_another_scale_leave_the_original_alone() -> None:
    original = learned(built())
    kept, model = original.skips, original.model
    copied = original.at(spacing=LONGER * original.spacing)
    copied.skips = replace(kept, absent_types=False, sleep_after=3)
    assert original.skips == kept == original.model.skips and original.model is model
    assert copied.skips == copied.model.skips != kept
    assert all(own is there for own, there in zip(original.parameters(), copied.parameters(), strict=True))
    copied.step(similar(scenes.state(40, history=2)).to_torch())
    assert isinstance(model, GPE) and model._program[0] is not None  # the compiled network is written once for all copies


def test_a_model_steps_similar_scenes_alike() -> None:
    build, s = built(), scenes.state(40, history=2)
    simulator = learned(build)
    cast(Standardize, simulator.standardizer.node["sand"]).std[-1] = 1e30  # the stiffness of the material is the one thing that differs
    there = simulator.at(LONGER * build.metadata.spacing, SLOWER * build.metadata.frame_dt)
    after, other = simulator.step(s.to_torch()), there.step(similar(s).to_torch())
    moved = (after.pos.numpy() - s.pos).max()
    assert moved > 0.01 * scenes.SPACING
    assert torch.allclose(LONGER * after.pos, other.pos, atol=1e-5 * LONGER * moved)
    assert torch.allclose(LONGER / SLOWER * after.vel, other.vel, rtol=1e-4, atol=1e-5)


def test_only_told_models_tell_frame_intervals_apart() -> None:
    """The control of the experiment gets the same features whatever the frame interval is."""
    s = scenes.state(40, history=2).to_torch()
    same = {}
    for use in ("dimensional", "dimensionless"):
        build = built(use)
        graph, other = build(s), build.at(build.metadata.spacing, 2 * build.metadata.frame_dt)(s)
        same[use] = torch.equal(graph["sand"].x, other["sand"].x)
    assert same == {"dimensional": True, "dimensionless": False}


def test_a_scale_of_the_reference_changes_nothing_but_the_added_channels() -> None:
    one, several, s = built("one"), built(), scenes.state(40, history=2).to_torch()
    graph, more = one(s), several(s)
    assert torch.equal(graph["sand"].x, more["sand"].x[:, :-2])
    for relation in one.spec.relations:
        assert torch.equal(graph[relation].odd, more[relation].odd)
        assert torch.equal(graph[relation].even, more[relation].even[:, :-2])


def test_the_added_edge_features_are_the_gaps_one_frame_later() -> None:
    build, s = built(), scenes.state(2, history=2, walls=False).to_torch()
    h, dt = 0.7 * scenes.SPACING, 0.004
    pos, vel = torch.tensor([[0.1, 0.1], [0.1 + 1.3 * h, 0.1]]), torch.tensor([[0.0, 0.0], [-0.2 * h / dt, 0.0]])
    s = replace(s, pos=pos.double(), vel=vel.double(), velocity_history=vel.double()[:, None].repeat(1, 2, 1))
    even = build.at(h, dt)(s)["sand", "radius", "sand"].even
    assert even[0, 0].item() == pytest.approx(0.3 / 0.2, abs=1e-5)
    assert even[0, 4].item() == pytest.approx(0.1 / 0.2, abs=1e-5)


def test_unknowns_of_a_scene_of_another_scale_are_found(tmp_path: Path) -> None:
    model = learned(built())
    larger = model.at(LONGER * model.builder.metadata.spacing, SLOWER * model.builder.metadata.frame_dt)
    own = larger.builder.metadata
    seen = rollout(larger, similar(scenes.state(20, materials=("sand",), history=2)).to_torch(), 6, own)
    seen = replace(seen, material_params=np.full_like(seen.material_params, 30.0), is_prediction=False)
    shots, few = ShootingSettings(horizon=2, num_windows=1), SearchSettings(num_scanned=3, max_evaluations=1)
    task = Task(model, None, False, {"sand.friction_angle": (1.0, 60.0)}, ("model",), ObservationSettings(), shots, few, {})
    assert identify_all(task, [("larger", seen)], tmp_path) == []
    answer = identify_parameters(model, seen, bounds=task.bounds, shooting_settings=shots, search_settings=few)
    assert answer.values == read_answers(tmp_path, "model")[0].values


def test_models_of_one_scale_refuse_others_as_before() -> None:
    simulator = learned(built("one"))
    with pytest.raises(SceneError, match=r"trained with frame_dt=0.005 s and spacing=0.05 m"):
        simulator.at(frame_dt=0.01)
    assert simulator.on(simulator.builder.metadata) is simulator
    assert "trained_scales" not in simulator.state_dict()


def test_a_range_has_warnings_outside_and_ends_at_twice_its_limits(caplog: pytest.LogCaptureFixture) -> None:
    simulator, s = learned(built()), scenes.state(10, history=2)
    simulator.trained_scales.copy_(torch.tensor([[0.05, 0.005], [0.1, 0.02]]))
    own = simulator.builder.metadata
    with caplog.at_level(logging.WARNING):
        inside = simulator.at(0.08, 0.01)
        inside.standing(s, inside.builder.metadata)
        assert "spacing is" not in caplog.text and "frame interval is" not in caplog.text
        outside = simulator.at(0.15, 0.004)
        outside.standing(s, outside.builder.metadata)
    assert "spacing is 0.15 m, trained were 0.05 to 0.1 m" in caplog.text
    assert "frame interval is 0.004 s, trained were 0.005 to 0.02 s" in caplog.text
    assert not simulator.fits(replace(own, spacing=0.21)) and simulator.fits(replace(own, frame_dt=0.0025))
    with pytest.raises(
        SceneError, match=r"spacing 0.05 to 0.1 m and frame interval 0.005 to 0.02 s in 2D .* scales at most 2 times outside these"
    ):
        simulator.at(frame_dt=0.05)
    with pytest.raises(SceneError, match=r"this copy of the model is for frame_dt=0.005 s .*; take simulator.on\(trajectory.metadata\)"):
        simulator.standing(s, replace(own, frame_dt=0.01))


def test_a_copy_at_another_scale_is_saved_as_the_model_itself(tmp_path: Path) -> None:
    simulator = learned(built())
    simulator.trained_scales.copy_(torch.tensor([[0.05, 0.005], [0.1, 0.02]]))
    simulator.at(0.08, 0.01).save(tmp_path / "model.ckpt")
    loaded, s = LearnedSimulator.from_checkpoint(tmp_path / "model.ckpt"), scenes.state(20, history=2).to_torch()
    assert loaded.builder.metadata == simulator.builder.metadata
    assert dict(loaded.described_training())["spacing"] == "0.05 to 0.1 m"
    assert torch.equal(loaded.at(0.08, 0.01).step(s).pos, simulator.at(0.08, 0.01).step(s).pos)


def test_a_copy_at_another_scale_stores_the_least_distance_of_the_model_itself(tmp_path: Path) -> None:
    simulator = learned(built())
    simulator.trained_scales.copy_(torch.tensor([[0.05, 0.005], [0.1, 0.02]]))
    simulator.least_distance = 0.02
    copied = simulator.at(0.1, 0.01)
    assert copied.least_distance == 0.04
    copied.save(tmp_path / "model.ckpt")
    loaded = LearnedSimulator.from_checkpoint(tmp_path / "model.ckpt")
    assert loaded.least_distance == 0.02 and loaded.at(0.1, 0.01).least_distance == 0.04


@pytest.mark.parametrize("column", [0, 1])
def test_a_checkpoint_with_a_reversed_range_of_scales_is_refused(tmp_path: Path, column: int) -> None:
    simulator = learned(built())
    simulator.trained_scales[:, column] = simulator.trained_scales[:, column] * torch.tensor([2.0, 1.0])
    simulator.save(tmp_path / "model.ckpt")
    with pytest.raises(CheckpointError, match="the lowest value of trained_scales is above the highest"):
        LearnedSimulator.from_checkpoint(tmp_path / "model.ckpt")


def test_meshes_are_refused() -> None:
    with pytest.raises(GraphError, match="graph.scales=dimensionless: works with particles only"):
        _ = scenes.builder(("elastomer",), mesh=True, scales="dimensionless").spec


# --- training -----------------------------------------------------------------------------------------------------------------------------


@pytest.fixture
def module(tmp_path: Path, new_trajectory: Callable[..., Trajectory]) -> TrajectoryDataModule:
    """Return windows of two data sets, the second of which has twice the spacing and is taken with two strides."""
    roots = []
    for factor in (1.0, 2.0):
        root = tmp_path / f"{factor:g}"
        for split, seeds in (("train", (0, 1)), ("val", (2,))):
            made = [new_trajectory(seed, num_frames=16, num_nodes=12, split=split) for seed in seeds]
            spaced = [
                replace(t.metadata, spacing=factor * t.metadata.spacing, connectivity_radius=factor * t.metadata.connectivity_radius)
                for t in made
            ]
            calm = [
                replace(t, metadata=m, pos=t.pos[:1] + np.float32(0.05) * (t.pos - t.pos[:1])) for t, m in zip(made, spaced, strict=True)
            ]
            write_shard(root / split / "shard-00000.h5", calm)
            if split == "train":
                std = acceleration_std(calm)
        sealed.write(root / "statistics.json", {"acceleration_std": std, "data_sha256": split_checksum(root, "train")})
        roots.append(root)
    graph = GraphConfig(history=2, scales="dimensionless", connectivity_spacings=3.0, islands=True)
    return TrajectoryDataModule(roots[0], graph, Noise(0.0, 0.1), BatchSize(2), seed=1, others=[(roots[1], 1), (roots[1], 2)])


def test_batches_have_one_scale_and_all_scales_take_part(module: TrajectoryDataModule) -> None:
    batches = module.batch_size.batches(module.train_set, 0, 0)
    found = [{module.train_set.scale(window) for _, window in next(batches)} for _ in range(40)]
    assert all(len(scales) == 1 for scales in found)
    assert set.union(*found) == {part.scale for part in module.parts} and len(module.parts) == 3
    later = module.batch_size.batches(module.train_set, 0, 7)
    again = module.batch_size.batches(module.train_set, 0, 0)
    for _ in range(7):
        next(again)
    assert [next(later) for _ in range(5)] == [next(again) for _ in range(5)]


def test_the_range_of_training_covers_all_parts(module: TrajectoryDataModule) -> None:
    spacing, dt = module.metadata.spacing, module.metadata.frame_dt
    assert module.trained_scales().tolist() == [[spacing, dt], [2 * spacing, 2 * dt]]
    assert len(module.val_trajectories(3)) == 3 and len({t.metadata.frame_dt for t in module.val_trajectories(3)}) == 2


@pytest.mark.slow
def test_unrolls_continue_with_the_frame_interval_of_their_scene(module: TrajectoryDataModule) -> None:
    simulator = learned(module.builder)
    simulator.fit_statistics(module.statistics_sample(), None, None, module.trained_scales())
    for p in simulator.model.parameters():
        p.data.zero_()  # free flight
    data, excursions = module.train_set, Excursions()
    for lane, window in enumerate((0, int(data.ends[-2]))):
        start = data[StartKey(lane, window, 2, lane)]
        graph = excursions.graphs(simulator, [start])
        excursions.move_on(simulator, lane, simulator(graph))
        reached = excursions._lanes[lane].states[0]
        assert start.scale is not None
        dt = start.scale[1]
        assert reached.time - start.state.time == pytest.approx(3 * dt)
        assert torch.allclose(reached.vel - start.state.vel, start.state.gravity * (reached.time - start.state.time), atol=1e-9)
    assert data.scale(0) != data.scale(int(data.ends[-2]))


def test_numbers_of_nodes_do_not_limit_batches_of_several_scales(module: TrajectoryDataModule) -> None:
    from gpe_pl.data.sampling import BatchSampler

    with pytest.raises(StoreError, match=r"batching.max_nodes=50: not for data of several scales; choose batching=by_number"):
        BatchSampler(module.train_set, BatchSize(2, 50), 0, lambda: 0)


@pytest.mark.slow
def test_a_scene_of_your_own_and_its_solver_take_the_scale_of_the_model(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from gpe_pl.scenes.scene import Scene

    shipped = LearnedSimulator.from_checkpoint("sand").builder
    several = learned(GraphBuilder(replace(shipped.config, scales="dimensionless", islands=True), shipped.metadata))
    several.get_buffer("trained_sand").copy_(torch.tensor([[20.0], [40.0]]))
    own = several.builder.metadata
    several.save(tmp_path / "several.ckpt")
    scene = Scene(box=(0.5, 0.4), spacing=1.5 * own.spacing, frame_dt=0.5 * own.frame_dt).block("sand", at=(0.1, 0.0), size=(0.1, 0.1))
    film = scene.predict(str(tmp_path / "several.ckpt"), 0.02)
    found = film.first.metadata
    assert (found.spacing, found.frame_dt) == (1.5 * own.spacing, 0.5 * own.frame_dt)
    solver = scene.solver_of(several.at(found.spacing, found.frame_dt))
    assert (solver.grid_spacing, solver.frame_dt) == (pytest.approx(1.5 * own.spacing), found.frame_dt)
    assert scene.solver_of(several).frame_dt == own.frame_dt
    with pytest.raises(SceneError, match="was trained with"):
        replace(scene, spacing=5 * own.spacing).predict(str(tmp_path / "several.ckpt"), 0.02)
