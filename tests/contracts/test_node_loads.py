"""Nodes whose motion is given and forces on nodes: in the store, in graphs, in steps of models, in training and in metrics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.data.dataset import WindowDataset, open_split
from gpe_pl.data.importers import save_dataset
from gpe_pl.data.noise import Noise
from gpe_pl.export.play_scene import state_for_page
from gpe_pl.export.program import NodeLoadError, export_model, scene_of
from gpe_pl.graphs.batching import batched
from gpe_pl.graphs.builder import GraphError
from gpe_pl.learned.approximate import Sleeping
from gpe_pl.learned.simulator import LearnedSimulator, SceneError
from gpe_pl.metrics.rollouts import rollout_metrics
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.loop import SimulationError, rollout
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import node_code
from gpe_pl.solvers.fem import FEM
from gpe_pl.system.compiled import unfused
from gpe_pl.training.module import TrainingModule
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import iter_trajectories, read_trajectory, stored_arrays, stored_attributes, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests.bodies import cells, lattice
from tests.contracts.test_learned_simulator import builder_of, learned

DT, SPACING, FRAMES = 0.01, 0.05, 10
CLAMPED, DRIVEN = slice(0, 3), slice(12, 15)
LAWS: dict[str, dict[str, Any]] = {
    "node": {},
    "pair": {"decoder": "pair", "interaction": "odd"},
    "contact": {"decoder": "contact"},
    "elastic": {"elastic": True, "decoder": "contact"},
}


def beam(
    forced: bool = True,
    held: bool = True,
    gravity: tuple[float, float] = (0.0, 0.0),
    amplitude: float = 0.02,
    sliding: bool = False,
) -> Trajectory:
    """Return a beam that is clamped at its left end and driven at its right end, with forces on its middle.

    If it slides, one node of the left end is clamped and the others are held along x, and the right end is driven along y only.
    """
    time, rest = DT * np.arange(FRAMES), lattice() + 0.3
    pos = np.repeat(rest[None], FRAMES, axis=0)
    way = amplitude * np.sin(20 * time)[:, None]
    pos[..., 1] += way * (rest[:, 0] - 0.3) / 0.2
    pos[:, DRIVEN, 1] = rest[DRIVEN, 1] + way + 1e-3 * np.cos(50 * time)[:, None]
    force = np.zeros(pos.shape)
    force[:, 6:9] = np.array([0.025, -0.1]) * (1 + np.arange(FRAMES))[:, None, None]
    mask = np.zeros((15, 2), bool)
    mask[CLAMPED] = mask[DRIVEN] = True
    if sliding:
        mask[1:3, 1] = mask[DRIVEN, 0] = False
    return Trajectory.from_numpy(
        pos, DT, "elastomer", {"elastomer": 1e5}, cells=cells(), mass=0.01 + 0.001 * np.arange(15), spacing=SPACING, gravity=gravity,
        bounds=((0.0, 1.0), (0.0, 1.0)), prescribed=mask if held else None, force=force if forced else None,
    )  # fmt: skip


def simulator(trajectory: Trajectory, law: str = "node", **settings: Any) -> LearnedSimulator:
    """Return a simulator with random weights for data like a trajectory."""
    build = builder_of(trajectory, mesh=True, islands=True, cells=law == "elastic")
    made = learned(build, **LAWS[law], **settings)
    torch.manual_seed(1)
    with torch.no_grad():
        for p in made.parameters():
            if not p.any():
                p.normal_(std=0.1)
    made.acceleration_std.fill_(100.0)
    made.standardizer.mass.fill_(0.015)
    made.set_units_of(made.model)
    return made


def start(trajectory: Trajectory, made: LearnedSimulator, frame: int = 2) -> State:
    return made.initial_state(trajectory, frame)


def held_of(trajectory: Trajectory) -> np.ndarray:
    """Return the mask of given motion [node, dim]."""
    assert trajectory.prescribed is not None
    return trajectory.prescribed


def forces_of(trajectory: Trajectory) -> np.ndarray:
    """Return the forces of all frames."""
    assert trajectory.force is not None
    return trajectory.force


# --- store --------------------------------------------------------------------------------------------------------------------------------


def test_loads_are_stored_and_files_without_them_stay_as_they_were(tmp_path: Path) -> None:
    write_shard(tmp_path / "a.h5", [beam()])
    found = read_trajectory(tmp_path / "a.h5", "00000", verify=True)
    assert found.metadata.loads == ("motion", "force")
    assert found.prescribed is not None and np.flatnonzero(found.prescribed.all(axis=1)).tolist() == [0, 1, 2, 12, 13, 14]
    assert found.prescribed.shape == (15, 2) and "prescribed_axes" not in stored_arrays(found)
    assert found.force is not None
    np.testing.assert_array_equal(found.force[3, 6], np.array([0.1, -0.4], np.float32))
    plain = beam(forced=False, held=False)
    assert plain.prescribed is None and plain.force is None and "loads" not in stored_attributes(plain)["metadata"]


def test_nodes_held_along_some_axes_are_stored_by_axis(tmp_path: Path) -> None:
    whole = beam(sliding=True)
    write_shard(tmp_path / "a.h5", [whole])
    found = read_trajectory(tmp_path / "a.h5", "00000", verify=True)
    assert found.metadata.loads == ("motion", "sliding", "force") and "prescribed" not in stored_arrays(found)
    np.testing.assert_array_equal(held_of(found), held_of(whole))
    assert found.is_predicted.tolist() == [False] + [True] * 14


def test_a_data_set_of_scenes_with_and_without_loads_has_the_loads_of_all(tmp_path: Path) -> None:
    scenes = [beam(), beam(forced=False, held=False, amplitude=0.03)], [beam(amplitude=0.04)], [beam(amplitude=0.05)]
    save_dataset(tmp_path, "beams", train=scenes[0], val=scenes[1], test=scenes[2])
    stored = [*iter_trajectories(tmp_path / "beams" / "imported", "train")]
    assert {t.metadata.loads for t in stored} == {("motion", "force")}
    assert sorted(t.prescribed is None for t in stored) == [False, True]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"prescribed": np.ones(15, bool)}, "prescribed: the motion of all nodes is given"),
        ({"prescribed": np.full(15, 0.5)}, "prescribed=.* needs true or false for each of 15 nodes"),
        ({"prescribed": np.ones((15, 3), bool)}, "prescribed=.* needs true or false for each of 15 nodes"),
        ({"prescribed": np.full((15, 2), 2)}, "prescribed=.* needs true or false for each of 30 nodes and axes"),
        ({"prescribed": np.arange(15) < 3, "rigid_body": np.zeros(15, int)}, "prescribed: node 0 belongs to rigid body 0"),
        ({"force": np.zeros((FRAMES, 14, 2))}, r"force: has shape \[10, 14, 2\], expected \[frame 10, node 15, dim 2\]"),
        ({"force": np.full((15, 2), np.nan)}, "force: frame 0, node 0 is nan"),
    ],
)
def test_wrong_loads_are_refused_by_name(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ArrayError, match=message):
        Trajectory.from_numpy(beam().pos, DT, "elastomer", {"elastomer": 1e5}, **arguments)


def test_parts_and_longer_frames_of_a_trajectory_keep_their_loads() -> None:
    whole = beam()
    assert whole.force is not None
    part, slow = whole.frames(2, 7), whole.every(2)
    assert part.force is not None and slow.force is not None
    np.testing.assert_array_equal(part.force, forces_of(whole)[2:7])
    np.testing.assert_allclose(slow.force[1], forces_of(whole)[2:4].mean(axis=0))
    loads = slow.state(0).loads
    assert loads is not None
    np.testing.assert_array_equal(loads.next_positions(), whole.pos[2, loads.rows])


# --- states -------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sliding", [False, True])
def test_a_later_state_puts_prescribed_nodes_where_they_have_to_be(sliding: bool) -> None:
    whole = beam(sliding=sliding)
    state = whole.state(3, history=2)
    for _ in range(3):
        state = state.later(DT, state.pos + 0.01, state.vel + 1.0)
    held = held_of(whole)
    np.testing.assert_array_equal(state.pos[held], whole.pos[6, held])
    np.testing.assert_allclose(state.pos[~held], whole.pos[3, ~held] + 0.03)
    np.testing.assert_allclose(state.vel[held], (whole.pos[6, held] - whole.pos[5, held]) / DT, atol=1e-12)
    assert state.velocity_history is not None and (state.velocity_history[:, -1] == state.vel).all()
    moved = state.corrected(state.pos + 1.0, state.vel + 1.0)
    assert (moved.pos == state.pos)[held].all() and (moved.pos == state.pos + 1.0)[~held].all()


def test_loads_do_not_know_the_future_along_axes_that_are_not_given() -> None:
    whole = beam(sliding=True)
    loads = whole.state(2).loads
    assert loads is not None
    held = held_of(whole)[loads.rows]
    assert not np.ptp(loads.path[:, ~held], axis=0).any()
    np.testing.assert_array_equal(loads.path[:, held], whole.pos[2:, loads.rows][:, held])


def test_after_its_last_frame_a_given_motion_stops() -> None:
    whole = beam()
    state = whole.state(FRAMES - 1)
    after = state.later(DT, state.pos + 0.01, state.vel)
    assert (after.pos == state.pos)[held_of(whole)].all() and not after.vel[held_of(whole)].any()
    assert after.loads is not None and after.loads.force is not None
    np.testing.assert_array_equal(after.loads.force[0], forces_of(whole)[-1])


@pytest.mark.parametrize("tensors", [False, True])
def test_loads_follow_their_nodes_into_parts_and_joined_states(tensors: bool) -> None:
    held, free = beam().state(1), beam(forced=False, held=False).state(1)
    if tensors:
        held, free = held.to_torch(), free.to_torch()
    part = held.take(held.pos[:, 0].argsort()[[13, 1, 7]]) if tensors else held.take(np.array([14, 1, 7]))
    assert part.loads is not None and part.loads.prescribed.tolist() == [[True, True]] * 2 + [[False, False]]
    after = part.later(DT, part.pos + 1, part.vel)
    wanted = held.later(DT, held.pos + 1, held.vel).take(np.array([14, 1, 7]) if not tensors else held.pos[:, 0].argsort()[[13, 1, 7]])
    np.testing.assert_array_equal(np.asarray(after.pos), np.asarray(wanted.pos))
    both = State.joined([free, held])
    assert both.loads is not None and both.loads.force is not None
    assert both.loads.rows.tolist() == [15, 16, 17, 27, 28, 29]
    np.testing.assert_array_equal(both.loads.force[0, 15:], held.loads.force[0])  # type: ignore[union-attr,index]
    np.testing.assert_array_equal(both.loads.force[2, :15], 0)


# --- models -------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("sliding", [False, True])
@pytest.mark.parametrize("law", list(LAWS))
def test_a_rollout_takes_the_given_motion_exactly_and_computes_the_rest(law: str, sliding: bool) -> None:
    whole = beam(gravity=(0.0, -9.81), sliding=sliding)
    made = simulator(whole, law)
    state = start(whole, made)
    found = rollout(Contained(made, DT), state, 6, whole.metadata)
    assert found.termination is None and found.prescribed is not None and found.force is not None
    held = found.prescribed
    np.testing.assert_array_equal(found.pos[:, held], whole.pos[2:9, held])
    np.testing.assert_array_equal(found.force, forces_of(whole)[2:9])
    assert np.abs(found.pos[-1, ~held] - whole.pos[8, ~held]).min() > 1e-6
    with unfused():
        plain = rollout(Contained(made, DT), state, 2, whole.metadata)
    np.testing.assert_allclose(plain.pos, found.pos[:3], atol=2e-6)


def test_baselines_take_the_given_motion_too() -> None:
    whole = beam()
    found = rollout(Ballistic(DT), whole.state(2), 4, whole.metadata)
    np.testing.assert_array_equal(found.pos[:, held_of(whole)], whole.pos[2:7, held_of(whole)])


@pytest.mark.parametrize("sliding", [False, True])
def test_mirror_averages_static_friction_and_sleeping_keep_the_given_motion(sliding: bool) -> None:
    whole = beam(gravity=(0.0, -9.81), sliding=sliding)
    made = simulator(whole)
    made.mirror_average, made.static_friction = True, 0.9
    made.skips = Skips(sleep_after=1, rest_step_spacings=1e3, rest_step_change_spacings=1e3)
    for stepper in (made, Sleeping(made)):
        found = rollout(stepper, start(whole, made), 4, whole.metadata)
        np.testing.assert_array_equal(found.pos[:, held_of(whole)], whole.pos[2:7, held_of(whole)])


@pytest.mark.parametrize("law", ["pair", "contact", "elastic", "node"])
def test_forces_change_the_momentum_of_a_free_body_by_what_they_transfer(law: str) -> None:
    whole = beam(held=False, gravity=(0.0, -9.81))
    made = simulator(whole, law, island_momentum="angular").double()
    state = start(whole, made)
    after = made.step(state)
    velocity = [s.vel if s.frame_velocity is None else s.frame_velocity for s in (state, after)]
    gained = (state.mass[:, None] * (velocity[1] - velocity[0])).sum(dim=0) / DT
    wanted = torch.from_numpy(forces_of(whole)[2].sum(axis=0)).double() + state.mass.sum() * state.gravity
    torch.testing.assert_close(gained, wanted, rtol=2e-4, atol=1e-5)


def test_the_law_of_cells_feels_a_clamp_as_a_fixed_end() -> None:
    """A bar that hangs from its clamp under its weight reaches the elongation ρ g L² / 2E of a bar, here with E of the untrained law."""
    whole = replace(beam(forced=False, gravity=(0.0, 0.0)), prescribed=np.repeat(np.arange(15)[:, None] < 3, 2, axis=1))
    made = simulator(whole, "elastic", only_contacts=True)
    state = start(whole, made)
    assert state.loads is not None
    state = replace(state, loads=replace(state.loads, path=np.repeat(state.loads.path[:1], 3, axis=0)))
    pulled = replace(state, gravity=torch.tensor([20.0, 0.0], dtype=torch.float64))
    ways = [made.step(s).pos[:, 0] - state.pos[:, 0] for s in (state, pulled)]
    grown = ways[1] - ways[0]
    assert not grown[CLAMPED].any() and (grown[3:6] < grown[6:9]).all() and (grown[6:9] < grown[12:15]).all()
    assert grown[12:15].max() < 20.0 * DT**2


def test_the_law_of_cells_feels_rollers_as_a_plane_of_symmetry() -> None:
    """A body that is held along x at its left end and pulled along x grows as the half of a body of twice the length, whose middle is free."""
    whole = beam(forced=False)
    half = replace(whole, prescribed=np.stack([np.arange(15) < 3, np.zeros(15, bool)], axis=1))
    made = simulator(half, "elastic", only_contacts=True)
    law: Any = made.model.elastic_bodies.constants["elastomer"]  # type: ignore[union-attr,index]
    with torch.no_grad():
        law.logarithm["weight"].zero_()  # constants in which a wave does not swing back within the frame
    state = start(half, made)
    pulled = replace(state, gravity=torch.tensor([20.0, 0.0], dtype=torch.float64))
    ways = [made.step(s).pos - state.pos for s in (state, pulled)]
    grown = ways[1] - ways[0]
    assert not grown[CLAMPED, 0].any() and (grown[12:15, 0] > 0).all()
    thinner = (grown[2::3, 1] - grown[0::3, 1]) / (state.pos[2::3, 1] - state.pos[0::3, 1])
    assert thinner[0] < -1e-3  # a clamp would not let it become thinner


@pytest.mark.parametrize("sliding", [False, True])
def test_gradients_of_the_law_stay_off_given_components(sliding: bool) -> None:
    whole = beam(sliding=sliding)
    made = simulator(whole, "elastic", only_contacts=True)
    graph = batched([made.builder(start(whole, made))])
    held = torch.from_numpy(held_of(whole))
    given = (whole.pos[3] - 2 * whole.pos[2] + whole.pos[1])[held]
    found = made(graph).acceleration["elastomer"] * made.acceleration_std * DT**2
    np.testing.assert_allclose(found[held].detach(), given, atol=1e-7)
    law = made.model.elastic_bodies.constants["elastomer"].logarithm["bias"]  # type: ignore[union-attr,index]
    for values, is_free in ((found[held], False), (found[~held], True)):
        (gradient,) = torch.autograd.grad(values.square().sum(), law, retain_graph=True)
        assert bool((gradient.abs() > 1e-12).any()) == is_free


def test_compiled_and_plain_graphs_have_the_same_features_of_loads() -> None:
    whole = beam()
    made = simulator(whole)
    state = start(whole, made)
    build, standards = made.builder, made.standardizer.standards()
    topology = build.topology(state)
    compiled, standardised = build.graph(topology, state), build.graph(topology, state, standards)
    with unfused():
        plain = build.graph(topology, state)
    x, motion = compiled["elastomer"].x, (build.config.history + 1) * 2
    assert x.shape[1] == motion + 5 == build.spec.node_channels["elastomer"]
    torch.testing.assert_close(x, plain["elastomer"].x, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(standardised["elastomer"].x, made.standardizer(compiled)["elastomer"].x, rtol=1e-5, atol=1e-5)
    held = torch.from_numpy(held_of(whole))
    assert torch.equal(x[:, motion], held.all(dim=1).float()) and torch.equal(compiled["elastomer"].prescribed, held)
    change = (whole.pos[3] - 2 * whole.pos[2] + whole.pos[1]) / SPACING
    np.testing.assert_allclose(x[:, motion + 1 : motion + 3], np.where(held_of(whole), change, 0), atol=1e-6)
    np.testing.assert_allclose(compiled["elastomer"].load, forces_of(whole)[2] / whole.mass[:, None], rtol=1e-6)


def test_features_of_rollers_tell_the_axes() -> None:
    whole = beam(sliding=True)
    made = simulator(whole)
    x, motion = made.builder(start(whole, made))["elastomer"].x, (made.builder.config.history + 1) * 2
    assert x.shape[1] == motion + 7 == made.builder.spec.node_channels["elastomer"]
    assert x[:, motion].tolist() == [1.0] + [0.0] * 14
    np.testing.assert_array_equal(x[:, motion + 3 : motion + 5], held_of(whole))


def test_an_island_with_a_held_node_is_held() -> None:
    for whole, is_held in ((beam(), True), (beam(sliding=True), True), (beam(held=False), False)):
        made = simulator(whole)
        graph = made.builder(start(whole, made))
        assert bool(graph.island_is_held.any()) == is_held


def test_a_model_refuses_loads_that_its_data_did_not_have() -> None:
    made = simulator(beam(held=False))
    with pytest.raises(SceneError, match="trained .* on elastomer with nodal forces; .* elastomer with prescribed nodes, nodal forces"):
        made.initial_state(beam(), 2)


def test_a_model_without_forces_refuses_states_with_forces() -> None:
    made, forced = simulator(beam(forced=False)), beam()
    state = forced.state(2, made.builder.config.history).to_torch()
    with pytest.raises(GraphError, match="state has nodal forces, and the data set has none, so that a model would ignore them"):
        made.step(state)
    made.step(beam(forced=False).state(2, made.builder.config.history).to_torch())


def test_exported_scenes_have_no_loads() -> None:
    """A program would leave prescribed nodes to the model."""
    made = simulator(beam(forced=False, held=False))
    state = beam(forced=False).state(2, made.builder.config.history).to_torch()
    for refuses in (lambda: scene_of(made, state), lambda: state_for_page(state, [0], 0.1)):
        with pytest.raises(NodeLoadError, match="no prescribed nodes and no forces"):
            refuses()


def test_a_model_of_clamps_refuses_rollers() -> None:
    made = simulator(beam())
    with pytest.raises(SceneError, match="prescribed nodes, nodes held along some axes, nodal forces"):
        made.initial_state(beam(sliding=True), 2)


def test_solvers_and_exported_programs_refuse_loads(tmp_path: Path) -> None:
    whole = beam()
    with pytest.raises(SimulationError, match="computes neither prescribed nodes nor nodal forces"):
        FEM(((0.0, 1.0), (0.0, 1.0)), DT).step(replace(whole.state(0), node_type=np.full(15, node_code("solid"), np.uint8)))
    with pytest.raises(NodeLoadError, match="neither prescribed nodes nor forces"):
        export_model(simulator(whole), tmp_path / "a.pt2")


# --- training and metrics -----------------------------------------------------------------------------------------------------------------


def stored(tmp_path: Path, whole: Trajectory) -> Any:
    (tmp_path / "train").mkdir(exist_ok=True)
    write_shard(tmp_path / "train" / "shard-00000.h5", [whole])
    return open_split(tmp_path, "train")


@pytest.mark.parametrize("sliding", [False, True])
def test_training_noise_leaves_prescribed_nodes_alone(tmp_path: Path, sliding: bool) -> None:
    whole = beam(sliding=sliding)
    build = builder_of(whole, mesh=True)
    trajectories = stored(tmp_path, whole)
    quiet = WindowDataset(trajectories, build)[0]["elastomer"].x
    noisy = WindowDataset(trajectories, build, Noise(0.001, 0.3), velocity_unit=1.0)[0]["elastomer"].x
    held = torch.from_numpy(held_of(whole))
    same = torch.isclose(quiet[:, :4], noisy[:, :4])
    assert torch.equal(same, held.repeat(1, 2))
    assert torch.equal(quiet[held.all(dim=1)], noisy[held.all(dim=1)])


@pytest.mark.parametrize("loss_kind", ["square", "root"])
@pytest.mark.parametrize("sliding", [False, True])
def test_loss_and_scale_do_not_count_given_motion(tmp_path: Path, sliding: bool, loss_kind: Any) -> None:
    whole = beam(sliding=sliding)
    made = simulator(whole)
    graph = batched([WindowDataset(stored(tmp_path, whole), made.builder)[0]])
    held = graph["elastomer"].prescribed
    if loss_kind == "root":  # is of whole vectors
        held = held.all(dim=1)
    module = TrainingModule(made, 1, loss=loss_kind)

    def loss(change: Callable[[], Any]) -> float:
        change()
        return float(module.loss(graph).detach())

    def to(rows: Any, value: float) -> Callable[[], Any]:
        return lambda: graph["elastomer"].target.__setitem__(rows, value)

    before = loss(lambda: None)
    assert loss(to(held, 1e6)) == before
    assert loss(to(~held, 1e6)) != before
    graph["elastomer"].target[~graph["elastomer"].prescribed] = 1e6
    made.fit_statistics([graph])
    assert float(made.acceleration_std) == pytest.approx(1e6)


def test_metrics_do_not_count_prescribed_nodes() -> None:
    whole = beam()
    wrong = whole.pos.copy()
    wrong[1:, ~whole.is_predicted] += 0.01
    for pos, is_perfect in ((wrong, True), (np.concatenate([whole.pos[:1], whole.pos[1:] + 0.01]), False)):
        found = {r.metric: r.value for r in rollout_metrics(replace(whole, pos=pos), whole, ["full"])}
        for name in ("rollout_mse", "displacement_error", "velocity_error", "energy_distance"):
            assert (found[name] == 0) == is_perfect, name
