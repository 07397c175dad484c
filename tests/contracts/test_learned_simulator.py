"""A learned model as a simulator: the oracle test of its integrator, the same graph as in training, and safe checkpoints."""

from __future__ import annotations

import functools
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from gpe_pl.data.dataset import WindowDataset, open_split
from gpe_pl.graphs.builder import GraphBuilder, GraphError
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import CHECKPOINT_FORMAT, CheckpointError, LearnedSimulator, SceneError
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import SimulationError, rollout
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import iter_trajectories, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests import scenes

HISTORIES = (1, 2, 5)


def builder_of(trajectory: Trajectory, history: int = 2, **config: Any) -> GraphBuilder:
    return GraphBuilder(GraphConfig(history=history, **config), trajectory.metadata)


def learned(build: GraphBuilder, seed: int = 0, **settings: Any) -> LearnedSimulator:
    torch.manual_seed(seed)
    return LearnedSimulator(GPE(build.spec, **{"num_message_passing_steps": 2, "hidden_channels": 8, **settings}), build).eval()


def silenced(simulator: LearnedSimulator) -> LearnedSimulator:
    """Return the simulator with a network that always predicts zero."""
    with torch.no_grad():
        for p in simulator.model.parameters():
            p.zero_()
    return simulator


def test_a_copy_with_other_settings_leaves_the_original_unchanged(new_trajectory: Callable[..., Trajectory]) -> None:
    simulator = learned(builder_of(new_trajectory(), islands=True))
    other = simulator.configured(skips=replace(simulator.skips, stress=True), clamps_parameters=False, static_friction=0.5)
    own, others = (s.model.skips.stress for s in (simulator, other))
    assert (other.skips.stress, others, other.clamps_parameters, other.static_friction) == (True, True, False, 0.5)
    assert (simulator.skips.stress, own, simulator.clamps_parameters, simulator.static_friction) == (
        False,
        False,
        True,
        0.0,
    )
    assert all(a is b for a, b in zip(simulator.parameters(), other.parameters(), strict=True))


@pytest.mark.parametrize("history", HISTORIES)
def test_oracle(new_trajectory: Callable[..., Trajectory], history: int) -> None:
    """Signature test: true accelerations through the learned simulator's integrator are the ground truth."""
    truth = new_trajectory(num_frames=120)
    simulator = learned(builder_of(truth, history))
    dt, pos = truth.metadata.frame_dt, truth.pos.astype(np.float64)
    vel = integrators.velocities(pos, dt)
    acc = integrators.acceleration(vel[1:], vel[:-1], dt)  # acc[k] takes frame k + 1 to k + 2

    class Oracle:
        def step(self, state: State) -> State:
            frame = round(state.time / dt)
            return simulator.advance(state, torch.from_numpy(acc[frame - 1]))

    start = simulator.initial_state(truth, history)
    result = rollout(Oracle(), start, truth.num_frames - 1 - history, truth.metadata)
    assert result.num_frames == truth.num_frames - history
    np.testing.assert_allclose(result.pos, pos[history:], rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.vel, vel[history - 1 :], rtol=0, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("features", ["paper", "contact"])
@pytest.mark.parametrize("history", HISTORIES)
def test_training_and_rollout_build_the_same_graph(
    tmp_path: Path, new_trajectory: Callable[..., Trajectory], history: int, features: Any
) -> None:
    """Signature test: all stores of a training item without noise equal, bit for bit, those that the rollout builds from the same frames."""
    write_shard(tmp_path / "long" / "train" / "shard-00000.h5", [new_trajectory(k, num_frames=history + 4) for k in range(2)])
    trajectories = list(iter_trajectories(tmp_path / "long", "train"))
    simulator = learned(builder_of(trajectories[0], history, features=features))
    seen: list[Any] = []
    simulator.model.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    windows = WindowDataset(open_split(tmp_path / "long", "train"), simulator.builder)
    for k in range(len(windows)):
        item = windows[k]
        state = simulator.initial_state(trajectories[item.trajectory], item.frame)
        built = simulator.builder(state)
        bare = item.clone()
        del bare.trajectory, bare.frame
        for material in simulator.builder.spec.materials:
            del bare[material].target
        scenes.assert_equal_graphs(bare, built)
        simulator.step(state)  # the graph that the model itself sees
        scenes.assert_equal_graphs(seen.pop(), simulator.standardizer(bare))
    assert len(windows) == 2 * 3


@pytest.mark.parametrize("history", HISTORIES)
def test_a_step_shifts_the_history(history: int) -> None:
    build = scenes.builder(history=history)
    simulator = learned(build)
    state = scenes.state(history=history).to_torch()
    after = simulator.step(state)
    assert after.velocity_history is not None
    assert state.velocity_history is not None
    assert after.velocity_history.shape == state.velocity_history.shape
    assert torch.equal(after.velocity_history[:, :-1], state.velocity_history[:, 1:])
    assert torch.equal(after.velocity_history[:, -1], after.vel)
    dt = build.metadata.frame_dt
    torch.testing.assert_close(after.pos, state.pos + dt * after.vel, rtol=0, atol=1e-15)
    assert after.time == pytest.approx(dt)
    assert not torch.equal(after.vel, state.vel + dt * state.gravity)  # the network answered


@pytest.mark.parametrize("materials", [("sand",), ("sand", "snow")])
def test_a_silent_network_falls_freely(materials: tuple[str, ...]) -> None:
    build = scenes.builder(materials, history=1)
    simulator = silenced(learned(build))
    simulator.acceleration_std.fill_(123.0)
    state = scenes.state(30, materials).to_torch()
    dt, steps = build.metadata.frame_dt, 20
    after = state
    for _ in range(steps):
        after = simulator.step(after)
    n = torch.tensor(steps, dtype=torch.float64)
    torch.testing.assert_close(after.vel, state.vel + n * dt * state.gravity, rtol=1e-12, atol=1e-12)
    expected = state.pos + n * dt * state.vel + dt**2 * state.gravity * n * (n + 1) / 2  # symplectic Euler
    torch.testing.assert_close(after.pos, expected, rtol=1e-12, atol=1e-12)


def test_the_networks_answer_is_in_units_of_the_acceleration_scale() -> None:
    build = scenes.builder(("sand", "snow"), history=1)
    simulator = learned(build)
    state = scenes.state(30, ("sand", "snow")).to_torch()
    weak = simulator.step(state).vel
    free = state.vel + build.metadata.frame_dt * state.gravity
    simulator.acceleration_std.fill_(10.0)
    torch.testing.assert_close(simulator.step(state).vel - free, 10 * (weak - free), rtol=1e-6, atol=1e-12)


def test_standardizing_leaves_the_graph_as_it_is() -> None:
    build = scenes.builder(("sand", "fluid"), history=1)
    graph = build(scenes.state(30, ("sand", "fluid")).to_torch())
    before = graph.clone()
    simulator = learned(build)
    simulator.standardizer.fit([graph])
    simulator(graph)
    scenes.assert_equal_graphs(graph, before)


def test_statistics_make_features_and_targets_of_order_one() -> None:
    build = scenes.builder(("sand", "fluid"), history=1)
    graphs = [build(scenes.state(60, ("sand", "fluid"), seed=k).to_torch()) for k in range(3)]
    for graph in graphs:
        for m in ("sand", "fluid"):
            graph[m].target = 7.0 * torch.randn(graph[m].x.shape[0], 2, generator=torch.Generator().manual_seed(0))
    simulator = learned(build)
    simulator.fit_statistics(graphs)
    targets = torch.cat([g[m].target for g in graphs for m in ("sand", "fluid")])
    assert float(simulator.acceleration_std) == pytest.approx(float(targets.square().mean().sqrt()), rel=1e-6)
    standard = [simulator.standardizer(g) for g in graphs]
    odd = torch.cat([g["sand", "radius", "fluid"].odd for g in standard])
    torch.testing.assert_close(odd.square().mean(0), torch.ones(6), rtol=1e-4, atol=1e-4)
    params = torch.cat([g["fluid"].material_params for g in standard])  # log scale
    assert float(params.mean()) == pytest.approx(0, abs=1e-4)
    assert float(params.std()) == pytest.approx(1, rel=0.02)
    assert float(torch.cat([g[m].mass for g in standard for m in ("sand", "fluid")]).mean()) == pytest.approx(1, rel=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: replace(t, pos=_with(t.pos, (3, 5, 0), np.nan)), "frame 3: node 5 has a pos that is not finite"),
        (lambda t: replace(t, pos=_with(t.pos, (2, 5, 0), np.inf)), "frame 3: node 5 has a velocity that is not finite"),
        (
            lambda t: replace(t, material_params=_with(t.material_params, (4, 0), np.nan)),
            r"node 4 \(sand\): friction_angle is nan deg, must be finite",
        ),
        (lambda t: replace(t, mass=_with(t.mass, (6,), 0.0)), "node 6 has a mass of 0 kg; give every node a positive and finite mass"),
        (
            lambda t: replace(t, vel=_with(t.vel, (3, 5, 0), 1e30)),
            "frame 3: node 5 has a velocity at the frame that is not finite or too large",
        ),
        (
            lambda t: replace(t, boundary=replace(t.boundary, pos=_with(t.boundary.pos, (2, 1), np.nan))),
            "frame 3: field 'boundary_pos': .*node 2",
        ),
        (lambda t: replace(t, mass=t.mass[:-1]), "frame 3: field 'mass' has size 11 along 'node', expected 12"),
        (lambda t: replace(t, node_type=t.node_type[:-1]), "frame 3: field 'mass' has size 12 along 'node', expected 11"),
    ],
)
def test_an_initial_state_that_cannot_be_rolled_out_names_the_place(
    trajectory: Trajectory, change: Callable[[Trajectory], Trajectory], message: str
) -> None:
    simulator = learned(builder_of(trajectory))
    with pytest.raises(ValueError, match=message):
        simulator.initial_state(change(trajectory), 3)
    with pytest.raises(IndexError):
        simulator.initial_state(trajectory, 1)


def _with(array: np.ndarray, index: tuple[int, ...], value: float) -> np.ndarray:
    array = array.copy()
    array[index] = value
    return array


def test_a_contained_rollout_ends_inside_and_a_guarded_one_with_a_reason(trajectory: Trajectory) -> None:
    simulator = silenced(learned(builder_of(trajectory)))
    start = simulator.initial_state(trajectory, 2)
    free = rollout(simulator, start, 200, trajectory.metadata, Guard(bounds=trajectory.metadata.bounds, margin=1.0))
    assert free.termination is not None
    assert free.termination.reason == "escape"
    contained = Contained(simulator, trajectory.metadata.frame_dt)
    counts: list[int | float] = []
    guard = Guard(bounds=trajectory.metadata.bounds, margin=1e-5)
    inside = rollout(contained, start, 50, trajectory.metadata, guard, lambda _, state: counts.append(state.num_corrected))
    assert inside.termination is None
    assert sum(counts) > 0


def test_scenes_stepped_together_equal_scenes_alone(trajectory: Trajectory) -> None:
    simulator = learned(builder_of(trajectory)).double()
    starts = [simulator.initial_state(trajectory, frame) for frame in (2, 4, 3)]
    together = simulator.step_all(starts)
    for start, result in zip(starts, together, strict=True):
        assert isinstance(result, State)
        assert torch.allclose(result.pos, simulator.step(start).pos, rtol=0, atol=1e-9)
        assert not torch.equal(result.pos, start.pos)


# --- checkpoints ---------------------------------------------------------------------------------------------------------------------------


def save(simulator: LearnedSimulator, path: Path, /, **changes: Any) -> Path:
    weights = {f"simulator.{k}": v for k, v in simulator.state_dict().items()}
    torch.save({"simulator": simulator.description(), "state_dict": weights, **changes}, path)
    return path


@pytest.fixture
def simulator() -> LearnedSimulator:
    build = scenes.builder(("sand", "snow"), history=2)
    simulator = learned(build, interaction="odd", decoder="pair")
    graph = build(scenes.state(40, ("sand", "snow"), history=2).to_torch())
    for m in ("sand", "snow"):
        graph[m].target = torch.full_like(graph[m].x[:, :2], 3.0)
    simulator.fit_statistics([graph])
    return simulator


def test_a_checkpoint_rebuilds_the_simulator(simulator: LearnedSimulator, tmp_path: Path) -> None:
    again = LearnedSimulator.from_checkpoint(save(simulator.train(), tmp_path / "a.ckpt"))
    assert not again.training
    assert again.builder == simulator.builder
    assert again.model.settings == simulator.model.settings
    assert again.description() == simulator.description()
    state = scenes.state(40, ("sand", "snow"), history=2).to_torch()
    a, b = simulator.eval().step(state), again.step(state)
    assert torch.equal(a.pos, b.pos)
    assert torch.equal(a.vel, b.vel)
    assert float(again.acceleration_std) == pytest.approx(3.0)


def test_a_checkpoint_keeps_the_scale_of_parameters_and_one_without_it_is_of_the_schemas(tmp_path: Path) -> None:
    states = [scenes.state(40, ("elastomer",), seed=k).to_torch() for k in range(2)]
    scales: dict[str | None, torch.Tensor] = {}
    for scale in ("linear", None):
        build = scenes.builder(("elastomer",), parameter_scale=scale)
        simulator = learned(build, material_embedding="affine")
        simulator.standardizer.fit([build(state) for state in states])
        description = simulator.description()
        if scale is None:
            del description["graph"]["parameter_scale"]
        again = LearnedSimulator.from_checkpoint(save(simulator, tmp_path / f"{scale}.ckpt", simulator=description))
        assert torch.equal(simulator.eval().step(states[0]).pos, again.step(states[0]).pos)
        scales[scale] = again.standardizer(build(states[0]))["elastomer"].material_params
    assert float((scales["linear"] - scales[None]).abs().max()) > 0.1


def test_a_saved_simulator_holds_itself_and_nothing_else(simulator: LearnedSimulator, tmp_path: Path) -> None:
    path = tmp_path / "models" / "a.ckpt"
    simulator.save(path)
    assert [p.name for p in path.parent.iterdir()] == ["a.ckpt"]
    again = LearnedSimulator.from_checkpoint(path)
    assert again.description() == simulator.description()
    for name, value in simulator.state_dict().items():
        assert torch.equal(again.state_dict()[name], value)
    weights = sum(value.nbytes for value in simulator.state_dict().values())
    assert path.stat().st_size < 2 * weights + 100_000


def test_a_description_is_plain_values(simulator: LearnedSimulator) -> None:
    def check(value: Any) -> None:
        if isinstance(value, dict):
            check([*value.keys(), *value.values()])
        elif isinstance(value, (list, tuple)):
            for item in value:
                check(item)
        else:
            assert value is None or type(value) in (str, int, float, bool)

    check(simulator.description())
    assert LearnedSimulator.from_description(simulator.description()).builder == simulator.builder


class Payload:
    """Object that creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("writer", [torch.save, lambda value, path: Path(path).write_bytes(pickle.dumps(value))], ids=["torch", "pickle"])
def test_code_in_a_checkpoint_does_not_run(simulator: LearnedSimulator, tmp_path: Path, writer: Callable[[Any, Path], Any]) -> None:
    trace, path = tmp_path / "trace", tmp_path / "evil.ckpt"
    writer({"simulator": Payload(trace), "state_dict": {}}, path)
    with pytest.raises(CheckpointError, match="evil.ckpt: not a safe, complete checkpoint"):
        LearnedSimulator.from_checkpoint(path)
    assert not trace.exists()
    torch.load(path, weights_only=False) if writer is torch.save else pickle.loads(path.read_bytes())
    assert trace.exists()  # the payload works


@pytest.mark.parametrize("case", ["missing", "folder", "text", "empty", "truncated", "flipped"])
def test_a_damaged_checkpoint_is_named(simulator: LearnedSimulator, tmp_path: Path, case: str) -> None:
    path = save(simulator, tmp_path / "a.ckpt")
    content = path.read_bytes()
    path.unlink()
    if case == "folder":
        path.mkdir()
    elif case != "missing":
        middle = content[:2000] + bytes(b ^ 0xFF for b in content[2000:2400]) + content[2400:]
        path.write_bytes({"text": b"hello\n", "empty": b"", "truncated": content[: len(content) // 2], "flipped": middle}[case])
    with pytest.raises(CheckpointError, match="a.ckpt(/checkpoints/best.ckpt)?: (no such|not a safe|not a) ") as caught:
        LearnedSimulator.from_checkpoint(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"simulator": 3}, "not a checkpoint of gpe_pl"),
        ({"simulator": {}}, f"format None, this version reads {CHECKPOINT_FORMAT}"),
        ({"simulator": {"format": CHECKPOINT_FORMAT + 1}}, f"format {CHECKPOINT_FORMAT + 1}, this version reads {CHECKPOINT_FORMAT}"),
        ({"simulator": {"format": CHECKPOINT_FORMAT}}, "KeyError: 'graph'"),
        ({"state_dict": {}}, "Missing key"),
    ],
)
def test_a_checkpoint_of_something_else_says_so(simulator: LearnedSimulator, tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        LearnedSimulator.from_checkpoint(save(simulator, tmp_path / "a.ckpt", **changes))


@pytest.mark.parametrize("content", [torch.zeros(3), [1, 2], {}, 5, "text", None])
def test_a_file_of_torch_that_is_no_checkpoint_says_so(tmp_path: Path, content: Any) -> None:
    torch.save(content, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match="not a checkpoint of gpe_pl"):
        LearnedSimulator.from_checkpoint(tmp_path / "a.ckpt")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("settings", {"hidden_channels": 16}, "size mismatch"),
        ("settings", {"hidden_channels": 4096, "num_message_passing_steps": 12}, "size mismatch"),  # 10 GB
        ("settings", {"width": 8}, "width Extra inputs are not permitted"),
        ("graph", {"history": 3}, "size mismatch"),
        ("metadata", {"dataset": "x"}, "materials Field required"),
        ("metadata", {"spacing": -0.1}, "spacing is -0.1, must be positive"),
        ("metadata", {"bounds": ((0.0, 1.0), (1.0, 0.0))}, "axis 1: low 1.0 must be below high 0.0"),
        ("metadata", {"gravity": (0.0,)}, "gravity has 1 components in 2D"),
        ("metadata", {"materials": ("honey",)}, "names \\['honey'\\]; known: "),
        ("model", "os.system", "not one of gpe_pl.models"),
        ("model", "gpe_pl.models.gpe.torch", "is not a model"),
        ("model", "gpe_pl.models.gpe.Nothing", "does not exist"),
        ("model", "gpe_pl.models.nothing.GPE", "does not exist"),
    ],
)
def test_a_description_of_another_model_is_refused(simulator: LearnedSimulator, tmp_path: Path, key: str, value: Any, message: str) -> None:
    description = simulator.description()
    if key in ("settings", "metadata") and "dataset" not in value:
        value = {**description[key], **value}
    with pytest.raises(CheckpointError, match=message):
        LearnedSimulator.from_checkpoint(save(simulator, tmp_path / "a.ckpt", simulator={**description, key: value}))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("acceleration_std", lambda x: -x, "acceleration_std has values that are not positive"),
        ("acceleration_std", lambda x: x * torch.nan, "acceleration_std has values that are not finite"),
        ("standardizer.node.sand.std", lambda x: 0 * x, "standardizer.node.sand.std has values that are not positive"),
        ("trained_sand", lambda x: torch.tensor([[40.0], [20.0]]), "the lowest value of trained_sand is above the highest"),
        ("trained_sand", lambda x: torch.tensor([[20], [40]]), "trained_sand is of type torch.int64"),
        (
            "trained_mass",
            lambda x: torch.tensor([[2.0], [1.0]]).to(x).expand_as(x).clone(),
            "the lowest value of trained_mass is above the highest",
        ),
        (
            "standardizer.node.sand.std",
            lambda x: x[:1].clone().expand_as(x),
            "has fewer values than its shape says",
        ),
    ],
)
def test_values_that_no_training_gives_are_refused(
    simulator: LearnedSimulator, tmp_path: Path, name: str, change: Callable[[torch.Tensor], torch.Tensor], message: str
) -> None:
    weights = {f"simulator.{key}": value for key, value in simulator.state_dict().items()}
    key = next(k for k in weights if k.removeprefix("simulator.") == name)
    with pytest.raises(CheckpointError, match=message):
        LearnedSimulator.from_checkpoint(save(simulator, tmp_path / "a.ckpt", state_dict={**weights, key: change(weights[key])}))


def test_a_model_may_hold_what_is_not_saved_and_look_at_its_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Scaled(GPE):
        __module__, __qualname__ = "gpe_pl.models.gpe", "Scaled"

        def __init__(self, *args: Any, **settings: Any) -> None:
            super().__init__(*args, **settings)
            self.register_buffer("kept", torch.tensor([2.0]), persistent=False)
            self.scale = torch.linspace(0, 1, 3).tolist()[1]

    monkeypatch.setattr("gpe_pl.models.gpe.Scaled", Scaled, raising=False)
    monkeypatch.setattr(Scaled, "__init__", functools.wraps(GPE.__init__)(Scaled.__init__))
    build = scenes.builder()
    made = LearnedSimulator(Scaled(build.spec, num_message_passing_steps=1, hidden_channels=8), build).eval()
    made.save(tmp_path / "a.ckpt")
    loaded: Any = LearnedSimulator.from_checkpoint(tmp_path / "a.ckpt").model
    assert (float(loaded.kept), loaded.scale) == (2.0, 0.5)


@pytest.mark.parametrize(("case", "reason"), [("collapsed", "clustering"), ("not finite", "nan")])
def test_a_scene_without_a_graph_is_named_and_the_others_go_on(case: str, reason: str) -> None:
    build = scenes.builder()
    simulator = learned(build)
    sound, bad = scenes.state(20).to_torch(), scenes.state(800).to_torch()
    pos = bad.pos.clone()
    if case == "collapsed":
        pos[:] = 0.3 + 1e-4 * pos
    else:
        pos[17] = torch.nan
    bad = replace(bad, pos=pos)
    first, stop, last = simulator.step_all([sound, bad, sound])
    assert isinstance(stop, SimulationError)
    assert stop.reason == reason
    assert f"node {stop.node}" in str(stop)
    alone = simulator.step(sound)
    for new in (first, last):
        assert isinstance(new, State)
        torch.testing.assert_close(new.pos, alone.pos)
    with pytest.raises(SimulationError):
        simulator.step(bad)


def test_pairs_are_counted_before_they_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    """States whose pairs would take gigabytes are refused. Dense but feasible ones are not."""
    build = scenes.builder()
    dense = scenes.state(400, low=0.3, high=0.4).to_torch()  # 14 times the density at rest
    build(dense)
    monkeypatch.setattr("gpe_pl.graphs.search.radius_pairs", lambda *_: pytest.fail("listed"))
    with pytest.raises(SimulationError, match="31996000 pairs of nodes within the radius of 0.12 m, most at node 0; .* would have 72382"):
        build(scenes.state(8000, low=0.3, high=0.31).to_torch())


def test_positions_that_are_not_float64_are_refused() -> None:
    state = scenes.state(5).to_torch()
    with pytest.raises(GraphError, match="positions are torch.int64; convert the state with State.to_torch"):
        scenes.builder()(replace(state, pos=(100 * state.pos).long()))


def test_gradients_reach_the_model_through_the_standardized_graph(simulator: LearnedSimulator) -> None:
    graph = simulator.builder(scenes.state(40, ("sand", "snow"), history=2).to_torch())
    loss: Tensor = sum(v.square().sum() for v in simulator(graph).acceleration.values())  # type: ignore[assignment]
    loss.backward()
    assert sum(float(p.grad.abs().sum()) for p in simulator.parameters() if p.grad is not None) > 0


@pytest.mark.parametrize(
    "change", [{"spacing": 0.06}, {"frame_dt": 0.01}, {"param_names": ("hardening_coefficient",)}, {"materials": ("sand", "snow")}]
)
def test_a_scene_of_other_scales_or_materials_is_refused(change: dict[str, Any]) -> None:
    build = scenes.builder()
    simulator = learned(build)
    pos = np.zeros((4, 3, 2), np.float32)
    s = scenes.state(3, walls=False)
    fitting = Trajectory(build.metadata, pos, pos, s.node_type, s.mass, s.material_params, s.boundary)
    assert simulator.initial_state(fitting, 1).num_nodes == 3
    with pytest.raises(SceneError, match=r"trained with frame_dt=0.005 s and spacing=0.05 m in 2D on sand; .* in Python give"):
        simulator.initial_state(replace(fitting, metadata=replace(build.metadata, **change)), 1)


def test_data_of_shorter_frames_are_refused_with_the_stride_that_fits() -> None:
    build = scenes.builder()
    long = replace(build, metadata=build.metadata.every(4))
    simulator = learned(long)
    simulator.stride = 4
    assert [simulator.stride_on(m) for m in (build.metadata, build.metadata.every(2), build.metadata.every(3))] == [4, 2, 0]
    assert simulator.stride_on(replace(build.metadata, spacing=0.06)) == 0
    with pytest.raises(
        SceneError,
        match=r"0.02 s \(data.stride=4\) .*; the scene has .*: Trajectory.every\(4\), or data.stride=4$",
    ):
        simulator.check_scene(build.metadata)
    simulator.check_scene(build.metadata.every(4))


def test_a_checkpoint_keeps_the_stride_of_its_training() -> None:
    described = learned(scenes.builder()).description()
    assert described["stride"] == 1
    assert LearnedSimulator.from_description({**described, "stride": 3}).stride == 3
    assert LearnedSimulator.from_description({k: v for k, v in described.items() if k != "stride"}).stride == 1  # of earlier versions
    for wrong in (0, -1, 2.0, True, None, "2"):
        with pytest.raises(ValueError, match="is no integer of at least 1"):
            LearnedSimulator.from_description({**described, "stride": wrong})


def test_material_parameters_outside_the_training_data_are_named(caplog: pytest.LogCaptureFixture) -> None:
    build = scenes.builder(("sand", "snow"), history=1)
    simulator = learned(build)
    state = scenes.state(40, ("sand", "snow")).to_torch()
    assert simulator.untrained_parameters(state) == []  # not fitted: no range is known
    graph = build(state)
    for material in ("sand", "snow"):
        graph[material].target = torch.ones(graph[material].num_nodes, 2)
    simulator.fit_statistics([graph])
    assert simulator.untrained_parameters(state) == []
    params = state.material_params.clone()
    sand = state.node_type == 0
    params[sand.nonzero()[0], 0] = 75.0
    (line,) = simulator.untrained_parameters(replace(state, material_params=params))
    assert line.startswith("friction_angle of sand is 75 deg, trained were ")
    again = LearnedSimulator.from_description(simulator.description())
    again.load_state_dict(simulator.state_dict())
    assert again.untrained_parameters(replace(state, material_params=params)) == [line]
    for _ in range(2):  # a rollout in Python has no other way to learn of it; once is enough
        again.standing(replace(state, material_params=params), build.metadata)
    assert [r.getMessage() for r in caplog.records] == [f"outside the training data: {line}; clamped to the nearest trained value"]


def test_the_trained_range_is_that_of_all_data_where_graphs_are_a_sample() -> None:
    build = scenes.builder(("sand",), history=1)
    simulator = learned(build)
    graph = build(scenes.state(40, ("sand",)).to_torch())
    graph["sand"].target = torch.ones(graph["sand"].num_nodes, 2)
    simulator.fit_statistics([graph], {"sand": torch.tensor([[-5.0], [95.0]])})
    ((material, trained),) = simulator.trained_ranges()
    assert (material, trained.tolist()) == ("sand", [[-5.0], [95.0]])


def test_material_parameters_outside_the_training_data_are_taken_for_the_nearest_trained_value() -> None:
    build = scenes.builder(("sand", "snow"), history=1)
    simulator = learned(build).eval()
    state = scenes.state(40, ("sand", "snow")).to_torch()
    graph = build(state)
    for material in ("sand", "snow"):
        graph[material].target = torch.ones(graph[material].num_nodes, 2)
    simulator.fit_statistics([graph])
    trained = graph["sand"].material_params
    sand = (state.node_type == 0).nonzero().flatten()

    def moved(friction_angle: float) -> torch.Tensor:
        params = state.material_params.clone()
        params[sand[0], 0] = friction_angle
        return simulator.step(replace(state, material_params=params)).pos

    for beyond, nearest in ((80.0, trained.max()), (1.0, trained.min())):
        assert torch.equal(moved(beyond), moved(float(nearest)))
    within = 0.5 * float(trained.min() + trained.max())
    assert not torch.equal(moved(within), moved(80.0))
    held = moved(80.0)
    simulator.clamps_parameters = False
    assert not torch.equal(held, moved(80.0))
    free = simulator.step(state).pos
    simulator.clamps_parameters = True
    assert torch.equal(simulator.step(state).pos, free)  # nothing in this scene lies beyond
