"""Unrolls with gradients: gradients pass through all steps, each step has its error in the loss, and one step is the usual loss."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch_geometric.data import HeteroData

from gpe_pl.data.dataset import Unroll, UnrollKey, WindowDataset, collated, open_split
from gpe_pl.data.noise import Noise
from gpe_pl.data.sampling import BatchSampler, BatchSize
from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.graphs.mesh_topology import _parts
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.base import Model
from gpe_pl.models.cconv import ContinuousConvNet
from gpe_pl.models.dpinet import DPINet
from gpe_pl.models.gns import GNS
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.training.module import TrainingModule
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import StoreError, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests import scenes
from tests.ranks import on_ranks
from tests.scenes import assert_equal_graphs

MOTION = 0.02
"""Size of the random motion per frame [m]; the connectivity radius is 0.12 m."""


class Double(GraphBuilder):
    """Builder of graphs in double precision."""

    precision = torch.float64


def unroll(builder: GraphBuilder, state: State, num_steps: int, seed: int = 0, stress: bool = False) -> Unroll:
    """Return an unroll of a state along random reference positions."""
    rng, start = np.random.default_rng(seed), state.to_torch()
    way = rng.normal(scale=MOTION, size=(num_steps, *state.pos.shape)).cumsum(axis=0)
    reference = start.periodicity.wrapped(start.pos + torch.from_numpy(way))
    components = 4 if builder.spec.dim == 2 else 6
    values = torch.from_numpy(rng.normal(size=(num_steps, state.num_nodes, components))) if stress else None
    first = Unroll(HeteroData(), start, reference, values, {})
    return replace(first, graph=first.graph_after(builder, start, 0))


def simulator_of(model: type[Model], builder: GraphBuilder, graphs: Sequence[Any], **settings: Any) -> LearnedSimulator:
    torch.manual_seed(0)
    simulator = LearnedSimulator(model(builder.spec, **settings), builder).double()
    simulator.fit_statistics(graphs)
    with torch.no_grad():
        for parameter in simulator.parameters():  # biases of zero put nodes without neighbours on the kink of ReLU
            parameter.add_(torch.randn_like(parameter), alpha=0.1)
    return simulator


def slow(scene: State) -> State:
    """Return the scene at velocities that fit ``MOTION``."""
    assert scene.velocity_history is not None
    past = scene.velocity_history * MOTION / 0.005
    return replace(scene, vel=past[:, -1], velocity_history=past)


def moving_floor() -> Boundary:
    floor = np.stack([np.arange(0.0, 0.5, 0.05), np.zeros(10)], axis=1)
    return Boundary.moving(floor + 0.01 * np.arange(4)[:, None, None] * np.array([1.0, 0.5]), np.tile([0.0, 1.0], (10, 1)), 0.005)


def case(name: str) -> tuple[type[Model], dict[str, Any], GraphBuilder, State]:
    small = {"hidden_channels": 6}
    steps = {"num_message_passing_steps": 2}
    config: dict[str, Any] = {"history": 2}
    meta, scene = scenes.metadata(), slow(scenes.state(20, history=2, high=0.3))
    if name == "gns":
        return GNS, small | steps, Double(GraphConfig(**config), meta), scene
    if name == "two materials":
        pair = ("sand", "snow")
        return GPE, small | steps, Double(GraphConfig(**config), scenes.metadata(pair)), slow(scenes.state(20, pair, 2, high=0.3))
    if name == "cconv in 3D":
        cloud = slow(scenes.state(30, history=2, dim=3, high=0.3))
        return ContinuousConvNet, small | {"num_convolutions": 3}, Double(GraphConfig(**config), scenes.metadata(dim=3)), cloud
    if name == "dpinet on meshes":
        meta = scenes.metadata(("elastomer",))
        return DPINet, small, Double(GraphConfig(mesh=True, **config), meta), slow(scenes.mesh_state("lattice", history=2))
    if name == "gpe on meshes with stress":
        settings = {**small, **steps, "stress": True, "decoder": "contact", "island_momentum": "angular", "interaction": "negated"}
        builder = Double(GraphConfig(mesh=True, islands=True, **config), scenes.metadata(("solid",)))
        return GPE, settings, builder, slow(scenes.mesh_state("triangles", ("solid",), history=2))
    if name == "elastic law":
        law = {"elastic": True, "wall_layer": 2.0, "decoder": "contact", "island_momentum": "angular", "interaction": "negated"}
        builder = Double(GraphConfig(mesh=True, islands=True, cells=True, **config), scenes.metadata(("solid",)))
        scene = slow(scenes.mesh_state("lattice", ("solid",), history=2))  # without slivers, which would be softened without a derivative
        return GPE, {**small, **steps, **law}, builder, scene
    if name == "periodic, with islands":
        space = Periodicity(meta.bounds, (True, False))
        meta = replace(meta, periodic=(True, False))
        scene = slow(scenes.state(20, history=2, high=0.3, walls=False))  # a free island: its angular momentum depends on lever arms
        at_seam = (scene.pos - [0.15, 0.0]) % 1.0
        settings = {**small, **steps, "island_momentum": "angular"}
        return GPE, settings, Double(GraphConfig(islands=True, **config), meta), replace(scene, pos=at_seam, periodicity=space)
    assert name == "moving walls"
    settings = {**small, **steps, "edge_state": "geometry", "interaction": "negated"}
    return GPE, settings, Double(GraphConfig(**config), meta), replace(scene, boundary=moving_floor())


CASES = (
    "gns",
    "two materials",
    "cconv in 3D",
    "dpinet on meshes",
    "gpe on meshes with stress",
    "elastic law",
    "periodic, with islands",
    "moving walls",
)


def test_a_rollout_may_be_the_first_to_see_a_mesh() -> None:
    model, settings, builder, scene = case("dpinet on meshes")
    _parts.cache_clear()
    with torch.inference_mode():
        unroll(builder, scene, 2, 0, bool(settings.get("stress")))
    unrolls = [unroll(builder, scene, 2, 0, bool(settings.get("stress")))]
    loss = TrainingModule(simulator_of(model, builder, [unrolls[0].graph], **settings), num_steps=10).loss(unrolls)
    loss.backward()
    assert math.isfinite(float(loss))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_gradients_of_three_steps_equal_finite_differences(name: str) -> None:
    model, settings, builder, scene = case(name)
    has_stress = bool(settings.get("stress"))
    unrolls = [unroll(builder, scene, 3, seed, has_stress) for seed in (0, 1)]
    module = TrainingModule(simulator_of(model, builder, [u.graph for u in unrolls], **settings), num_steps=10)
    parameters = [p for p in module.simulator.parameters() if p.requires_grad]
    generator = torch.Generator().manual_seed(0)
    direction = [torch.randn(p.shape, generator=generator, dtype=p.dtype) for p in parameters]
    module.loss(unrolls).backward()
    slope = sum(float((p.grad * d).sum()) for p, d in zip(parameters, direction, strict=True) if p.grad is not None)

    def at(length: float) -> float:
        with torch.no_grad():
            for p, d in zip(parameters, direction, strict=True):
                p.add_(d, alpha=length)
            value = float(module.loss(unrolls))
            for p, d in zip(parameters, direction, strict=True):
                p.sub_(d, alpha=length)
        return value

    h = 1e-7
    assert slope == pytest.approx((at(h) - at(-h)) / (2 * h), rel=1e-4)
    without = [replace(u, reference=u.reference[:1], stress=None if u.stress is None else u.stress[:1]) for u in unrolls]
    assert module.loss(without).item() != pytest.approx(module.loss(unrolls).item(), rel=1e-3)


def windows(store: Path, steps: int, noise: Noise | None = None) -> WindowDataset:
    stored = open_split(store, "train")
    builder = GraphBuilder(GraphConfig(history=2), stored[0].window(0, 1).metadata)
    return WindowDataset(stored, builder, noise, 0.05, seed=3, unroll_steps=steps)


def module_of(data: WindowDataset, **settings: Any) -> TrainingModule:
    torch.manual_seed(0)
    simulator = LearnedSimulator(GPE(data.builder.spec, num_message_passing_steps=1, hidden_channels=8), data.builder)
    simulator.acceleration_std.fill_(40.0)
    return TrainingModule(simulator, num_steps=10, **settings)


@pytest.mark.parametrize("noise", [None, Noise(0.01, 0.5, 0.25)])
def test_one_step_is_the_usual_loss_bit_for_bit(store: Path, noise: Noise | None) -> None:
    data = windows(store, 1, noise)
    plain = collated([data[5, 0], data[6, 3]])
    unrolls = collated([data[UnrollKey(5, 0)], data[UnrollKey(6, 3)]])
    assert isinstance(plain, HeteroData) and isinstance(unrolls, list)
    results = []
    for samples in (plain, unrolls):
        module = module_of(data)
        loss = module.loss(samples)
        loss.backward()
        results.append([loss.detach(), *(p.grad for p in module.parameters() if p.grad is not None)])
    assert len(results[0]) > 5 and all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_the_reference_is_the_truth_and_what_is_left_of_the_noise(store: Path, new_trajectory: Callable[..., Trajectory]) -> None:
    correction = 0.25
    data, clean = windows(store, 3, Noise(0.01, 0.5, correction)), windows(store, 3)
    for window in range(len(data)):
        number, frame = data.locate(window)
        truth = new_trajectory(number).pos[frame : frame + 4].astype(np.float64)
        exact, noisy = clean[UnrollKey(9, window)], data[UnrollKey(9, window)]
        assert torch.equal(exact.reference, torch.from_numpy(truth[1:])) and torch.equal(exact.state.pos, torch.from_numpy(truth[0]))
        offset = noisy.state.pos.numpy() - truth[0]
        assert np.abs(offset).max() > 1e-3
        for k in (1, 2, 3):
            left = (1 - correction) ** k * offset
            assert np.allclose(noisy.reference[k - 1].numpy(), truth[k] + left, rtol=0, atol=1e-12)


def test_the_loss_is_the_mean_error_of_positions_after_each_step(store: Path) -> None:
    data = windows(store, 3)
    unrolls = [data[UnrollKey(0, 0)], data[UnrollKey(1, 1)]]
    module = module_of(data)
    dt, unit = data.builder.metadata.frame_dt, 40.0
    states, errors = [u.state for u in unrolls], []
    for step in range(3):
        states = [s for s in module.simulator.next_states(states) if isinstance(s, State)]
        errors += [(s.pos - u.reference[step]) / (dt**2 * unit) for s, u in zip(states, unrolls, strict=True)]
    assert module.loss(unrolls).item() == pytest.approx(float(torch.stack(errors).square().mean()), rel=1e-4)
    root = module_of(data, loss="root")
    norms = torch.stack(errors).norm(dim=-1)
    assert root.loss(unrolls).item() == pytest.approx(float(norms.sqrt().mean()), rel=1e-4)
    assert module._windows == [data.locate(0), data.locate(1)]


def test_a_scene_that_falls_apart_has_no_further_errors(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = windows(store, 2)
    unrolls, module = [data[UnrollKey(0, 0)], data[UnrollKey(1, 2)]], module_of(data)
    usual = Unroll.graph_after
    first = [replace(u, reference=u.reference[:1]) for u in unrolls]
    expected = {2: module.loss(unrolls).item(), 0: module.loss(first).item() / 2}
    expected[1] = expected[0] + (module.loss(unrolls[:1]).item() - module.loss([first[0]]).item() / 2)

    for num_sound in (0, 1, 2):

        def fails(self: Unroll, builder: GraphBuilder, state: State, step: int, sound: int = num_sound) -> HeteroData:
            if not any(self is one for one in unrolls[:sound]):
                raise SimulationError("no")
            return usual(self, builder, state, step)

        with monkeypatch.context() as patch:
            patch.setattr(Unroll, "graph_after", fails)
            assert module.loss(unrolls).item() == pytest.approx(expected[num_sound], rel=1e-6)


def test_windows_end_where_the_truth_does(store: Path, tmp_path: Path, new_trajectory: Callable[..., Trajectory]) -> None:
    counts = [len(windows(store, steps)) for steps in (1, 2, 3)]  # two trajectories of six frames, history 2
    assert counts == [6, 4, 2]
    data = windows(store, 3)
    assert len(data.activity()) == len(data)
    assert [data[UnrollKey(0, k)].num_steps for k in range(len(data))] == [3, 3]
    with pytest.raises(
        StoreError, match=r"no trajectory has the 7 frames that a start at frame 2 needs \(graph.history, training.unroll_steps\)"
    ):
        windows(store, 4)
    write_shard(tmp_path / "short" / "train" / "shard-00000.h5", [new_trajectory(0, num_frames=4), new_trajectory(1)])
    mixed = windows(tmp_path / "short", 2)
    assert len(mixed) == len(mixed.activity()) == 2 and {mixed.locate(k)[0] for k in range(2)} == {1}


def test_batches_hold_unrolls_of_the_same_windows(store: Path) -> None:
    data = windows(store, 2)
    batches = iter(BatchSampler(data, BatchSize(2), 0, lambda: 0))
    drawn = next(BatchSize(2).batches(data, 0, 0))
    assert next(batches) == [UnrollKey(*pair) for pair in drawn]
    assert_equal_graphs(data[UnrollKey(*drawn[0])].graph, data[drawn[0]])


def test_several_processes_share_the_loss_of_each_step(store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The only scene of one process falls apart after its first step."""
    data = windows(store, 3)
    parts = [[data[UnrollKey(0, 0)], data[UnrollKey(1, 1)]], [replace(data[UnrollKey(2, 0)], about={"trajectory": 9, "frame": 0})]]
    usual = Unroll.graph_after

    def fails(self: Unroll, builder: GraphBuilder, state: State, step: int) -> HeteroData:
        if self.about["trajectory"] == 9:
            raise SimulationError("no")
        return usual(self, builder, state, step)

    monkeypatch.setattr(Unroll, "graph_after", fails)
    losses = on_ranks(tmp_path, lambda rank: float(module_of(data).loss(parts[rank])))
    assert sum(losses) == pytest.approx(module_of(data).loss([*parts[0], *parts[1]]).item(), rel=1e-6)
