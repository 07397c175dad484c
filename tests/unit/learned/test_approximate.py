"""Approximate levels: resting nodes sleep and wake, moving nodes are predicted as before, and a prediction can serve several frames."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.approximate import Repeating, Sleeping, _Repeated, _Rest, approximate
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.cconv import ContinuousConvNet
from gpe_pl.models.dpinet import DPINet
from gpe_pl.models.gns import GNS
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import SimulationError, Start, rollout, rollouts
from gpe_pl.rollout.skips import Skips
from gpe_pl.trajectory.state import State
from tests import scenes

RADIUS = 0.12
MODELS: dict[str, Any] = {
    "gpe": lambda spec: GPE(spec, num_message_passing_steps=3, hidden_channels=8, island_momentum="angular"),
    "gpe-pair": lambda spec: GPE(spec, decoder="pair", num_message_passing_steps=2, hidden_channels=8),
    "gns": lambda spec: GNS(spec, num_message_passing_steps=3, hidden_channels=8),
    "dpinet": lambda spec: DPINet(spec, num_propagation_steps=3, hidden_channels=8),
    "cconv": lambda spec: ContinuousConvNet(spec, num_convolutions=3, hidden_channels=8),
}


def simulator(build: GraphBuilder, model: str = "gpe", sleep_after: int | None = 2, **skips: Any) -> LearnedSimulator:
    torch.manual_seed(0)
    simulated = LearnedSimulator(MODELS[model](build.spec), build).eval()
    simulated.skips = Skips(sleep_after=sleep_after, **skips)
    return simulated


def two_heaps(gap: float = 0.13, speed: float = 1.0) -> State:
    """Return twenty nodes at rest beside twenty that move, on the floor; without gravity, a network that predicts zero keeps them so."""
    s = scenes.state(40, low=0.02, high=0.3)
    right = np.arange(40) >= 20
    pos, vel = s.pos.copy(), s.vel.copy()
    pos[:, 1] *= 0.2  # on the floor, whose nodes both heaps touch
    pos[right, 0] += pos[~right, 0].max() - pos[right, 0].min() + gap
    vel[~right], vel[right] = 0.0, speed * vel[right]
    return replace(s, pos=pos, vel=vel, velocity_history=vel[:, None], gravity=np.zeros(2))


def silenced(simulated: LearnedSimulator) -> LearnedSimulator:
    with torch.no_grad():
        for p in simulated.model.parameters():
            p.zero_()
    return simulated


def after_rest(sleeping: Any, state: State, count: int = 2) -> State:
    """Return the state as if its resting nodes had been at rest for ``count`` predictions."""
    still = silenced(simulator(sleeping.simulator.builder))
    for _ in range(count):
        moved = Sleeping(still).step(replace(state, pos=state.pos))
        state = replace(state, internal=moved.internal)
    return state


@pytest.mark.parametrize("model", MODELS)
def test_what_moves_is_predicted_as_if_nothing_slept(model: str) -> None:
    simulated = simulator(scenes.builder(), model)
    simulated.acceleration_std.fill_(1e4)
    start = after_rest(sleeping := Sleeping(simulated), two_heaps().to_torch())
    after, full = sleeping.step(start), simulated.step(start)
    assert after.num_asleep == 20
    assert torch.equal(after.pos[:20], start.pos[:20]) and not after.vel[:20].any()
    torch.testing.assert_close(after.vel[20:], full.vel[20:], rtol=0, atol=1e-6 * float(full.vel.abs().max()))
    assert not torch.equal(full.pos[:20], start.pos[:20])


def test_the_surroundings_of_what_moves_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    simulated = simulator(scenes.builder())
    simulated.acceleration_std.fill_(1e4)
    start = after_rest(sleeping := Sleeping(simulated), two_heaps().to_torch())
    full = simulated.step(start)
    monkeypatch.setattr(GPE, "num_hops", 0)
    assert float((sleeping.step(start).vel[20:] - full.vel[20:]).abs().max()) > 1e-4 * float(full.vel.abs().max())


def test_far_from_what_moves_nothing_is_computed() -> None:
    simulated = simulator(scenes.builder())
    start = after_rest(sleeping := Sleeping(simulated), two_heaps(gap=3.0).to_torch())
    seen: list[int] = []
    simulated.model.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]["sand"].num_nodes))
    sleeping.step(start)
    assert seen == [20]


def test_where_all_sleeps_the_model_is_not_asked() -> None:
    simulated = simulator(scenes.builder())
    start = after_rest(sleeping := Sleeping(simulated), two_heaps(speed=0.0).to_torch())
    simulated.model.register_forward_pre_hook(lambda *_: pytest.fail("asked"))
    after = sleeping.step(start)
    assert after.num_asleep == 40 and torch.equal(after.pos, start.pos)
    assert after.time == pytest.approx(start.time + simulated.builder.metadata.frame_dt)


def test_an_island_sleeps_after_so_many_frames_at_rest_and_wakes_as_a_whole_by_contact() -> None:
    simulated = silenced(simulator(scenes.builder(), sleep_after=3))
    state = two_heaps(gap=0.2).to_torch()
    vel = state.vel.clone()
    vel[20:] = torch.tensor([-2.0, 0.0], dtype=torch.float64)  # 1 cm per frame, so in reach after 8
    state = replace(state, vel=vel, velocity_history=vel[:, None])
    sleeping, asleep = Sleeping(simulated), []
    for _ in range(12):
        gap = float(torch.cdist(state.pos[:20], state.pos[20:]).min())
        state = sleeping.step(state)
        asleep.append((state.num_asleep, gap > RADIUS))
    assert [n for n, _ in asleep[:3]] == [0, 0, 0]
    assert all(n == (20 if apart else 0) for n, apart in asleep[3:])
    assert {apart for _, apart in asleep[3:]} == {True, False}


def test_a_single_restless_node_keeps_its_island_awake() -> None:
    simulated = simulator(scenes.builder())
    state = two_heaps(speed=0.0)
    vel = state.vel.copy()
    vel[3] = 1.0
    start = after_rest(sleeping := Sleeping(simulated), replace(state, vel=vel, velocity_history=vel[:, None]).to_torch())
    assert sleeping.step(start).num_asleep == 20  # the other island


def asleep_on_the_floor() -> tuple[Sleeping, State]:
    """Return two heaps that sleep, far from each other, and what lets them."""
    sleeping, state = Sleeping(silenced(simulator(scenes.builder()))), two_heaps(gap=1.0, speed=0.0).to_torch()
    for _ in range(3):
        state = sleeping.step(state)
    assert state.num_asleep == 40
    return sleeping, state


def test_another_gravity_wakes_everything() -> None:
    sleeping, state = asleep_on_the_floor()
    tilted = replace(state, gravity=torch.tensor([9.81, 0.0], dtype=torch.float64))
    after = sleeping.step(tilted)
    assert after.num_asleep == 0
    torch.testing.assert_close(after.vel, sleeping.simulator.step(tilted).vel)
    assert sleeping.step(after).num_asleep == 0  # counts from the start
    assert sleeping.step(replace(state, gravity=state.gravity.clone())).num_asleep == 40


def test_another_boundary_wakes_everything() -> None:
    sleeping, state = asleep_on_the_floor()
    walls = state.boundary
    for other in (replace(walls, pos=walls.pos - 5.0), replace(walls, friction=0.5 * walls.friction), walls.take(torch.arange(3))):
        assert sleeping.step(replace(state, boundary=other)).num_asleep == 0
    assert sleeping.step(replace(state, boundary=replace(walls, pos=walls.pos.clone()))).num_asleep == 40


def test_a_node_that_is_given_a_velocity_wakes_its_island() -> None:
    sleeping, state = asleep_on_the_floor()
    vel = state.vel.clone()
    vel[3] = 1.0
    kicked = state.corrected(state.pos, vel)
    after = sleeping.step(kicked)
    assert after.num_asleep == 20
    torch.testing.assert_close(after.vel, sleeping.simulator.step(kicked).vel)


@pytest.mark.parametrize("name", ["pos", "mass", "material_params"])
def test_a_node_that_is_edited_wakes_its_island(name: str) -> None:
    sleeping, state = asleep_on_the_floor()
    edited = getattr(state, name).clone()
    edited[3] += 0.01
    changed = replace(state, **{name: edited})
    after = sleeping.step(changed)
    assert after.num_asleep == 20
    torch.testing.assert_close(after.vel, sleeping.simulator.step(changed).vel)
    assert sleeping.step(replace(state, **{name: getattr(state, name).clone()})).num_asleep == 40
    getattr(state, name)[3] += 0.01  # in place
    assert sleeping.step(state).num_asleep == 20


def test_momentum_is_lost_once_and_counted() -> None:
    simulated = silenced(simulator(scenes.builder(), rest_step_spacings=0.01))
    state = two_heaps(gap=1.0).to_torch()
    vel = state.vel.clone()
    vel[:20] = 0.05 * torch.nn.functional.normalize(torch.randn(20, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
    state, sleeping, lost = replace(state, vel=vel, velocity_history=vel[:, None]), Sleeping(simulated), []
    for _ in range(5):
        state = sleeping.step(state)
        lost.append(state.lost_impulse)
    assert lost == [0, 0, pytest.approx(0.05 * float(state.mass[:20].sum())), 0, 0]


@pytest.mark.parametrize(("length", "time"), [(1.0, 1.0), (2.0**10, 1.0), (2.0**-20, 2.0**-12)])
def test_what_is_at_rest_sleeps_in_any_unit(length: float, time: float) -> None:
    """The left heap creeps by 0.01 spacings within a frame, the right one moves."""
    usual = scenes.metadata()
    scaled = replace(
        usual,
        spacing=length * usual.spacing,
        connectivity_radius=length * usual.connectivity_radius,
        frame_dt=time * usual.frame_dt,
        bounds=((0.0, length),) * 2,
    )
    simulated = silenced(simulator(GraphBuilder(scenes.builder().config, scaled)))
    state = two_heaps(gap=1.0)
    vel = np.where(np.arange(40)[:, None] < 20, [0.1, 0.0], [2.0, 0.0]) * length / time
    boundary = replace(state.boundary, pos=length * state.boundary.pos)
    state = replace(state, pos=length * state.pos, vel=vel, velocity_history=vel[:, None], boundary=boundary).to_torch()
    sleeping, asleep = Sleeping(simulated), []
    for _ in range(4):
        state = sleeping.step(state)
        asleep.append(state.num_asleep)
    assert asleep == [0, 0, 20, 20]


@pytest.mark.parametrize(("longer", "slower"), [(1.0, 1.0), (0.5, 1.0), (1.0, 2.0), (2.0, 0.5)])
def test_a_model_of_several_scales_has_the_limits_of_its_scene(longer: float, slower: float) -> None:
    """The left heap creeps by 0.02 spacings within a frame and sleeps, the right one by 0.05 and does not."""
    usual = scenes.metadata()
    whole = silenced(simulator(scenes.builder(("sand",), history=1, scales="dimensionless"), rest_step_spacings=0.03))
    simulated = whole.at(spacing=longer * usual.spacing, frame_dt=slower * usual.frame_dt)
    own = simulated.builder.metadata
    step = np.where(np.arange(40)[:, None] < 20, [0.02, 0.0], [0.05, 0.0]) * own.spacing / own.frame_dt
    state = two_heaps(gap=1.0)
    boundary = replace(state.boundary, pos=longer * state.boundary.pos, shapes=())
    state = replace(state, pos=longer * state.pos, vel=step, velocity_history=step[:, None], boundary=boundary).to_torch()
    for _ in range(4):
        state = Sleeping(simulated).step(state)
    assert state.num_asleep == 20


def test_a_rigid_body_of_two_parts_sleeps_as_a_whole() -> None:
    simulated = simulator(scenes.builder())
    start = after_rest(sleeping := Sleeping(simulated), two_heaps(gap=1.0).to_torch())
    assert sleeping.step(start).num_asleep == 20
    body = torch.full((40,), -1)
    body[15:25] = 0  # of both heaps
    assert sleeping.step(replace(start, rigid_body=body)).num_asleep == 0


def test_a_rollout_that_is_taken_up_again_is_the_same() -> None:
    simulated = simulator(scenes.builder(), repeat_frames=2, rest_step_spacings=0.05, rest_step_change_spacings=5.0)
    runner, state = approximate(simulated), two_heaps(speed=0.3).to_torch()
    assert isinstance(runner, Repeating)
    through = state
    for _ in range(6):
        through = runner.step(through)
    for _ in range(6):
        state = approximate(simulated).step(state)
    assert through.num_asleep > 0 and torch.equal(through.pos, state.pos)


@pytest.mark.parametrize("kind", ["triangles", "lattice"])
def test_meshes_sleep_and_are_seen_whole(kind: str) -> None:
    build = scenes.builder(("elastomer",), mesh=True)
    simulated = simulator(build)
    s = scenes.mesh_state(kind, num_bodies=3, gap=6.0, walls=False)
    vel = np.where((s.pos[:, :1] < np.median(s.pos[:, 0]) - 4 * scenes.SPACING), 1.0, 0.0) * np.ones(2)
    s = replace(s, vel=vel, velocity_history=vel[:, None], gravity=np.zeros(2))
    start = after_rest(sleeping := Sleeping(simulated), s.to_torch())
    after, full = sleeping.step(start), simulated.step(start)
    awake = torch.from_numpy(vel[:, 0] > 0)
    assert 0 < after.num_asleep == int((~awake).sum())
    torch.testing.assert_close(after.vel[awake], full.vel[awake], rtol=0, atol=1e-6 * float(full.vel.abs().max()))


def test_a_held_prediction_is_asked_for_once_and_moves_nodes_as_its_acceleration_says() -> None:
    build = scenes.builder()
    simulated = simulator(build, sleep_after=None, repeat_frames=3)
    runner, state, dt = approximate(simulated), scenes.state().to_torch(), build.metadata.frame_dt
    asked: list[int] = []
    simulated.model.register_forward_pre_hook(lambda *_: asked.append(1))
    states = [state]
    for _ in range(7):
        states.append(runner.step(states[-1]))
    assert len(asked) == 3
    acc = [(b.vel - a.vel) / dt for a, b in itertools.pairwise(states)]
    for first in (0, 3):
        torch.testing.assert_close(acc[first + 1], acc[first], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(acc[first + 2], acc[first], rtol=1e-9, atol=1e-9)
    assert (acc[3] - acc[2]).abs().max() > 1e-6 * acc[2].abs().max()
    assert states[7].velocity_history is not None and torch.equal(states[7].velocity_history[:, -1], states[7].vel)


def test_without_approximate_levels_the_simulator_is_itself() -> None:
    simulated = simulator(scenes.builder(), sleep_after=None)
    assert approximate(simulated) is simulated


def test_scenes_side_by_side_are_as_alone_and_containment_works_around() -> None:
    build = scenes.builder()
    simulated = simulator(build, repeat_frames=2, rest_step_spacings=0.05, rest_step_change_spacings=5.0)
    runner = Contained(approximate(simulated), build.metadata.frame_dt)
    states = [two_heaps(gap, speed=0.3).to_torch() for gap in (0.2, 0.6)]
    together = rollouts(runner, [Start(s, 5, build.metadata, Guard(bounds=build.metadata.bounds, margin=1.0)) for s in states])
    for s, t in zip(states, together, strict=True):
        np.testing.assert_allclose(rollout(runner, s, 5, build.metadata).pos, t.pos, rtol=0, atol=1e-6 * scenes.SPACING)


@pytest.mark.parametrize("repeat_frames", [1, 2])
def test_periodic_scenes_sleep_and_are_repeated_across_the_seam(repeat_frames: int) -> None:
    space = replace(scenes.metadata(), periodic=(True, False))
    simulated = simulator(GraphBuilder(GraphConfig(history=1, islands=True), space), repeat_frames=repeat_frames)
    simulated.acceleration_std.fill_(1e4)
    s = two_heaps()
    shifted = (s.pos + np.array([0.8, 0.0])) % [1.0, 10.0]  # one heap lies across the seam
    start = after_rest(Sleeping(simulated), replace(s, pos=shifted, periodicity=space.periodicity).to_torch())
    after, full = approximate(simulated).step(start), simulated.step(start)
    assert after.num_asleep == 20
    torch.testing.assert_close(after.vel[20:], full.vel[20:], rtol=0, atol=1e-6 * float(full.vel.abs().max()))
    assert float(approximate(simulated).step(after).pos[:, 0].max()) < 1.0


def test_predictions_are_not_repeated_for_rigid_bodies() -> None:
    """Accelerations of the nodes of a body that turns would deform it."""
    simulated = simulator(scenes.builder(), sleep_after=None, repeat_frames=2)
    start = scenes.state().to_torch()
    body = replace(start, rigid_body=torch.zeros(start.num_nodes, dtype=torch.int64))
    with pytest.raises(SimulationError, match="rollout.repeat_frames: cannot be more than 1 in scenes with rigid bodies"):
        approximate(simulated).step(body)


def test_what_is_repeated_follows_nodes_that_enter_and_leave() -> None:
    inner = _Rest(torch.tensor([3, 1, 2]))
    repeated = _Repeated(torch.tensor([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]), 2, inner)
    found = repeated.of_rows(np.array([2, -1, 0]))
    assert found.acceleration.tolist() == [[3.0, 0.0], [0.0, 0.0], [1.0, 0.0]] and found.frames == 2
    assert found.inner.count.tolist() == [2, 0, 3]
    assert replace(repeated, inner="of a solver").of_rows(np.array([0])).inner is None
