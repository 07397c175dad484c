"""The time loop: the oracle reproduces a trajectory, and a guard keeps the good frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.geometry.shapes import Box
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.ensemble import Ensemble
from gpe_pl.rollout.guard import Guard, _depth_through
from gpe_pl.rollout.loop import Replay, SimulationError, Simulator, Start, fraction_outside, frames, rollout, rollouts
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.state import State, Stress
from gpe_pl.trajectory.trajectory import Termination, Trajectory

New = Callable[..., Trajectory]


@dataclass(frozen=True)
class FreeFall:
    """Simulator with constant acceleration; it spoils one node of the frame ``spoil_frame``."""

    dt: float
    spoil_frame: int = -1
    spoil: Callable[[State], State] = lambda state: state

    def step(self, state: State) -> State:
        pos, vel = integrators.advance(state.pos, state.vel, state.gravity, self.dt)
        new = replace(state, pos=pos, vel=vel, time=state.time + self.dt)
        return self.spoil(new) if round(new.time / self.dt) == self.spoil_frame else new


def spoiled(key: str, node: int, value: float) -> Callable[[State], State]:
    def spoil(state: State) -> State:
        array = getattr(state, key).copy()
        array[node, 1] = value
        return replace(state, **{key: array})

    return spoil


@pytest.mark.parametrize(
    "wrap", [lambda dt: Contained(FreeFall(dt), 2 * dt), lambda dt: Contained(Ballistic(2 * dt), dt), lambda dt: Ballistic(2 * dt)]
)
def test_wrappers_and_baselines_have_the_frame_interval_of_the_scene(wrap: Callable[[float], Simulator], trajectory: Trajectory) -> None:
    dt = trajectory.metadata.frame_dt
    stop = rollout(wrap(dt), trajectory.state(0), 3, trajectory.metadata).termination
    assert stop is not None and stop.reason == "input"
    assert f"has frame_dt = {2 * dt:g} s, the scene {dt:g} s; both must be the same" in stop.message
    ensemble = Ensemble((Contained(FreeFall(dt), dt), Contained(FreeFall(dt), 2 * dt)))
    stop = rollout(ensemble, trajectory.state(0), 3, trajectory.metadata).termination
    assert stop is not None and stop.message.startswith("Contained has frame_dt")


def test_a_result_has_the_gravity_of_its_start(trajectory: Trajectory) -> None:
    start, metadata = trajectory.state(0), trajectory.metadata
    assert rollout(FreeFall(metadata.frame_dt), start, 2, metadata).metadata is metadata
    moon = np.asarray(metadata.gravity) / 6
    arrays = replace(start, gravity=moon)
    for first in (arrays, arrays.to_torch()):
        result = rollout(FreeFall(metadata.frame_dt), first, 2, metadata)
        assert result.metadata == replace(metadata, gravity=tuple(moon.tolist()))
    stop = rollout(FreeFall(metadata.frame_dt), replace(start, gravity=np.zeros(5)), 2, metadata).termination
    assert stop is not None and "gravity has the shape (5,)" in stop.message


def test_oracle(trajectory: Trajectory) -> None:
    replay = Replay(trajectory)
    assert isinstance(replay, Simulator)
    result = rollout(replay, trajectory.state(0), trajectory.num_frames - 1, trajectory.metadata, Guard(bounds=trajectory.metadata.bounds))
    for key in ("pos", "vel", "node_type", "mass", "material_params"):
        np.testing.assert_array_equal(getattr(result, key), getattr(trajectory, key), err_msg=key)
    for key in ("pos", "vel", "normal", "friction", "restitution"):
        np.testing.assert_array_equal(getattr(result.boundary, key), getattr(trajectory.boundary, key), err_msg=key)
    assert result.metadata == trajectory.metadata
    assert result.termination is None


class Paced(FreeFall):
    """A model that knows its frame interval."""

    @property
    def frame_dt(self) -> float:
        return self.dt


@pytest.mark.parametrize("wrapped", [lambda s: s, lambda s: Contained(s, s.dt), lambda s: Ensemble((Contained(s, s.dt), s))])
def test_a_model_of_other_frames_than_the_scene_is_refused(trajectory: Trajectory, wrapped: Callable[[Simulator], Simulator]) -> None:
    """The times of the result would be wrong."""
    dt = trajectory.metadata.frame_dt
    stop = rollout(wrapped(Paced(2 * dt)), trajectory.state(0), 2, trajectory.metadata).termination
    assert stop is not None and (stop.reason, stop.frame) == ("input", 0)
    assert f"the model has frame_dt = {2 * dt:g} s, the scene {dt:g} s" in stop.message
    assert rollout(wrapped(Paced(dt)), trajectory.state(0), 2, trajectory.metadata).num_frames == 3


@dataclass(frozen=True)
class Spaced(FreeFall):
    """A model that knows its spacing."""

    spacing: float = 0.0


def test_a_model_of_another_spacing_than_the_scene_is_refused(trajectory: Trajectory) -> None:
    dt, spacing = trajectory.metadata.frame_dt, trajectory.metadata.spacing
    stop = rollout(Contained(Spaced(dt, spacing=2 * spacing), dt), trajectory.state(0), 2, trajectory.metadata).termination
    assert stop is not None and (stop.reason, stop.frame) == ("input", 0)
    assert f"the model has spacing = {2 * spacing:g} m, the scene {spacing:g} m; both must be the same" in stop.message
    assert rollout(Spaced(dt, spacing=1.005 * spacing), trajectory.state(0), 2, trajectory.metadata).num_frames == 3


def test_oracle_survives_hundreds_of_inexact_time_steps(new_trajectory: New) -> None:
    long = new_trajectory(num_frames=700, num_nodes=1, frame_dt=1 / 3)
    np.testing.assert_array_equal(rollout(Replay(long), long.state(0), 699, long.metadata).pos, long.pos)


def test_part_of_a_trajectory_knows_when_it_begins(trajectory: Trajectory) -> None:
    """This also holds for a prediction that starts after the first frame."""
    dt, part = trajectory.metadata.frame_dt, trajectory.frames(2)
    assert [part.state(k).time for k in (0, 3)] == pytest.approx([2 * dt, 5 * dt])
    assert part.frames(-2).state(0).time == pytest.approx((trajectory.num_frames - 2) * dt)
    again = rollout(Replay(part), part.state(1), 2, part.metadata)
    np.testing.assert_array_equal(again.pos, trajectory.pos[3:6])
    assert again.state(2).time == pytest.approx(5 * dt)


def test_no_steps(trajectory: Trajectory) -> None:
    result = rollout(Replay(trajectory), trajectory.state(2), 0, trajectory.metadata)
    np.testing.assert_array_equal(result.pos, trajectory.pos[2:3])


def no_stress(state: State) -> State:
    node = np.zeros((12, 4))
    node[7, 2] = np.nan
    return replace(state, stress=Stress(node, np.zeros((0, 4))))


@pytest.mark.parametrize(
    ("reason", "spoil", "message"),
    [
        ("nan", spoiled("pos", 3, np.nan), "frame 4: node 3 has a position, velocity or stress that is not finite"),
        ("nan", no_stress, "frame 4: node 7 has a position, velocity or stress that is not finite"),
        ("nan", spoiled("vel", 0, -np.inf), "frame 4: node 0 "),
        ("escape", spoiled("pos", 5, -0.3), "frame 4: node 5 is 0.3 m outside"),
        ("escape", spoiled("pos", 6, 1.5), "frame 4: node 6 is 0.5 m outside"),
        ("explosion", spoiled("vel", 11, 80.0), "frame 4: node 11 moves at 80"),
    ],
)
def test_guard_keeps_the_good_frames(trajectory: Trajectory, reason: str, spoil: Callable[[State], State], message: str) -> None:
    stress = Stress(np.zeros((12, 4)), np.zeros((0, 4)))
    start = replace(trajectory.state(0), vel=np.zeros((12, 2)), stress=stress)
    guard = Guard(max_speed=50.0, bounds=trajectory.metadata.bounds, margin=0.1)
    sound = rollout(FreeFall(0.01), start, 8, trajectory.metadata, guard)
    assert sound.termination is None
    assert sound.num_frames == 9
    result = rollout(FreeFall(0.01, 4, spoil), start, 8, trajectory.metadata, guard)
    assert result.termination is not None
    assert (result.termination.reason, result.termination.frame) == (reason, 4)
    assert message in result.termination.message
    assert f"node {result.termination.node} " in result.termination.message
    np.testing.assert_array_equal(result.pos, sound.pos[:4])
    np.testing.assert_array_equal(result.vel, sound.vel[:4])


def test_solver_that_refuses_ends_the_rollout(trajectory: Trajectory) -> None:
    def refuse(state: State) -> State:
        raise SimulationError("element inverted", reason="inverted", node=7)

    result = rollout(FreeFall(0.01, 3, refuse), trajectory.state(0), 8, trajectory.metadata)
    assert result.termination == Termination("inverted", 3, 7, "frame 3: element inverted")
    assert result.num_frames == 3


def test_other_errors_are_not_hidden(trajectory: Trajectory) -> None:
    def fail(state: State) -> State:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        rollout(FreeFall(0.01, 3, fail), trajectory.state(0), 8, trajectory.metadata)


def test_guard_on_torch(trajectory: Trajectory) -> None:
    state = trajectory.state(0).to_torch()
    guard = Guard(max_speed=50.0, bounds=trajectory.metadata.bounds)
    assert guard.check(state, 1) is None
    pos = state.pos.clone()
    pos[4, 0] = torch.nan
    stop = guard.check(replace(state, pos=pos), 1)
    assert stop is not None
    assert (stop.reason, stop.node) == ("nan", 4)


def test_guard_of_no_nodes(new_trajectory: New) -> None:
    empty = new_trajectory(num_nodes=0)
    assert Guard(max_speed=1.0, bounds=empty.metadata.bounds).check(empty.state(0), 1) is None


def test_a_velocity_at_the_frame_that_is_not_finite_stops_a_rollout(trajectory: Trajectory) -> None:
    state = trajectory.state(0)
    at_frame = state.vel.copy()
    at_frame[2, 1] = np.inf
    stop = Guard().check(replace(state, frame_velocity=at_frame), 4)
    assert stop is not None and (stop.reason, stop.frame, stop.node) == ("nan", 4, 2)
    for value in (np.inf, 1e30):
        at_frame[2, 1] = value
        result = rollout(FreeFall(0.01), replace(state, frame_velocity=at_frame), 3, trajectory.metadata)
        assert result.termination is not None and result.termination.message == "frame_velocity is not finite or too large"
    assert Guard().check(replace(state, frame_velocity=state.vel), 4) is None


def slid(node: int, to: tuple[float, float]) -> Callable[[State], State]:
    def spoil(state: State) -> State:
        pos = state.pos.copy()
        pos[node] = to
        return replace(state, pos=pos)

    return spoil


@pytest.mark.parametrize(
    ("reason", "spoil", "node"),
    [
        ("tunnelling", slid(5, (0.62, 0.05)), 5),  # the obstacle reaches from 0.4 to 0.6 and up to 0.1
        ("clustering", lambda state: replace(state, pos=0.35 + 1e-3 * state.pos), 0),
    ],
)
def test_guard_sees_what_no_single_limit_shows(new_trajectory: New, reason: str, spoil: Callable[[State], State], node: int) -> None:
    many = new_trajectory(num_nodes=40, gravity=(0.0, 0.0))
    start = replace(many.state(0), vel=np.zeros((40, 2)))
    start.pos[5] = 0.38, 0.05
    guard = Guard(bounds=many.metadata.bounds, spacing=many.metadata.spacing)
    assert rollout(FreeFall(0.01), start, 8, many.metadata, guard).termination is None
    result = rollout(FreeFall(0.01, 4, spoil), start, 8, many.metadata, guard)
    assert result.termination is not None
    assert (result.termination.reason, result.termination.frame, result.termination.node) == (reason, 4, node)
    assert result.num_frames == 4


def test_a_cloud_that_is_fine_from_the_start_has_not_collapsed(new_trajectory: New) -> None:
    many = new_trajectory(num_nodes=80, gravity=(0.0, 0.0))
    fine = replace(many.state(0), vel=np.zeros((80, 2)), pos=0.35 + 0.5 * many.metadata.spacing * np.random.default_rng(0).random((80, 2)))
    guard = Guard(bounds=many.metadata.bounds, spacing=many.metadata.spacing)
    assert guard.check(fine, 1) is not None
    assert rollout(FreeFall(0.01), fine, 3, many.metadata, guard).termination is None
    with_far = replace(fine, pos=np.concatenate([fine.pos[:20], many.state(0).pos[20:]]))
    result = rollout(FreeFall(0.01, 2, lambda state: replace(state, pos=fine.pos)), with_far, 3, many.metadata, guard)
    assert result.termination is not None
    assert (result.termination.reason, result.termination.frame) == ("clustering", 2)


def test_a_cloud_that_lies_in_one_place_from_the_start_has_collapsed(new_trajectory: New) -> None:
    many = new_trajectory(num_nodes=80, gravity=(0.0, 0.0))
    start = replace(many.state(0), vel=np.zeros((80, 2)), pos=np.full((80, 2), 0.35))
    result = rollout(FreeFall(0.01), start, 3, many.metadata, Guard(spacing=many.metadata.spacing))
    assert result.termination is not None
    assert (result.termination.reason, result.termination.frame) == ("clustering", 0)


def test_a_path_around_an_obstacle_is_no_tunnel(new_trajectory: New) -> None:
    one = new_trajectory(num_nodes=1, gravity=(0.0, 0.0))
    before = replace(one.state(0), pos=np.array([[0.38, 0.2]]))
    guard = Guard(spacing=one.metadata.spacing)
    assert guard.check(replace(before, pos=np.array([[0.62, 0.2]])), 1, before) is None
    assert guard.check(replace(before, pos=np.array([[0.42, 0.08]])), 1, before) is None  # inside: containment's business


@pytest.mark.parametrize("way", [0.24, 0.6])
def test_a_thin_obstacle_is_seen_on_a_way_of_any_length(new_trajectory: New, way: float) -> None:
    """This also holds if another node is much faster."""
    two = new_trajectory(num_nodes=2, gravity=(0.0, 0.0))
    before = replace(two.state(0), pos=np.array([[0.38, 0.05], [0.5, 0.5]]))
    after = replace(before, pos=np.array([[0.38 + way, 0.05], [1e4, 0.5]]))
    stop = Guard(spacing=two.metadata.spacing).check(after, 7, before)
    assert stop is not None
    assert (stop.reason, stop.frame, stop.node) == ("tunnelling", 7, 0)


@pytest.mark.parametrize(("to", "goes_through"), [((0.5, 0.13), False), ((0.6, 0.23), False), ((0.66, 0.08), True), ((0.9, 0.16), True)])
def test_who_may_have_moved_around_a_corner_did_not_go_through(new_trajectory: New, to: tuple[float, float], goes_through: bool) -> None:
    one = new_trajectory(num_nodes=1, gravity=(0.0, 0.0))
    before = replace(one.state(0), pos=np.array([[0.38, 0.01]]))  # the straight line over the corner at (0.4, 0.1) is 0.035 m deep
    stop = Guard(spacing=one.metadata.spacing).check(replace(before, pos=np.array([to])), 1, before)
    assert (stop is not None) == goes_through


PLATE, BLOCK = Box((0.28, 0.2), (0.32, 0.8), 0.0), Box((0.5, 0.3), (0.7, 0.5), 0.0)


@pytest.mark.parametrize(("shapes", "goes_through"), [((PLATE,), True), ((BLOCK,), False), ((PLATE, BLOCK), True), ((BLOCK, PLATE), True)])
def test_each_obstacle_on_a_way_is_seen(shapes: tuple[Box, ...], goes_through: bool) -> None:
    start, way = (
        np.array([[0.1, 0.36], [0.1, 0.36]]),
        np.array([[0.65, 0.2], [0.1, 0.0]]),
    )  # through the plate and over a corner of the block; stops before
    depth = _depth_through(shapes, start, way, 200, 0.001)
    assert (depth > 0).tolist() == [goes_through, False]
    if goes_through:
        assert depth[0] == pytest.approx(0.02, abs=0.002)


def test_who_goes_through_an_obstacle_slowly_is_seen_inside(new_trajectory: New) -> None:
    one = new_trajectory(num_nodes=1, gravity=(0.0, 0.0))
    before = replace(one.state(0), pos=np.array([[0.41, 0.04]]))
    inside = replace(before, pos=np.array([[0.45, 0.04]]))  # 0.05 m deep
    assert Guard(spacing=one.metadata.spacing, margin=0.06).check(inside, 1, before) is None
    stop = Guard(spacing=one.metadata.spacing, margin=0.03).check(inside, 1, before)
    assert stop is not None
    assert (stop.reason, stop.frame, stop.node) == ("tunnelling", 1, 0)


def test_a_start_that_cannot_be_trusted_is_frame_0(trajectory: Trajectory) -> None:
    start = replace(trajectory.state(0), vel=trajectory.vel[0].copy())
    start.vel[2] = 1e3
    result = rollout(FreeFall(0.01), start, 5, trajectory.metadata, Guard(max_speed=50.0))
    assert result.termination is not None
    assert (result.termination.reason, result.termination.frame, result.termination.node) == ("explosion", 0, 2)
    assert result.num_frames == 1


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_impossible_material_ends_the_rollout_before_it_begins(trajectory: Trajectory, value: float) -> None:
    start = replace(trajectory.state(0), material_params=trajectory.material_params.copy())
    start.material_params[7] = value
    result = rollout(FreeFall(0.01), start, 8, trajectory.metadata, Guard())
    assert result.termination is not None
    assert (result.termination.reason, result.termination.frame, result.termination.node) == ("material", 0, 7)
    assert result.termination.message.startswith("field 'material_params': friction_angle: node 7: ")
    assert result.num_frames == 1
    assert rollout(FreeFall(0.01), start, 8, trajectory.metadata).num_frames == 1  # without a guard too


@pytest.mark.parametrize(
    "limits",
    [
        {"max_speed": 0.0},
        {"max_speed": -1.0},
        {"max_speed": math.nan},
        {"margin": -0.1},
        {"margin": math.nan},
        {"spacing": -0.1},
        {"spacing": math.inf},
        {"bounds": ((1.0, 0.0),)},
        {"bounds": ((math.nan, 1.0),)},
    ],
)
def test_guard_refuses_impossible_limits(limits: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        Guard(**limits)  # type: ignore[arg-type]


def test_on_frame_sees_every_new_state(trajectory: Trajectory) -> None:
    seen: list[int] = []

    def see(frame: int, state: State) -> None:
        np.testing.assert_array_equal(state.pos, trajectory.pos[frame])
        seen.append(frame)

    rollout(Replay(trajectory), trajectory.state(0), 5, trajectory.metadata, on_frame=see)
    assert seen == [1, 2, 3, 4, 5]


def test_frames_holds_one_state_at_a_time(trajectory: Trajectory) -> None:
    stream = frames(FreeFall(0.01), [Start(trajectory.state(0), 10**12, trajectory.metadata)])
    (_, _, first), (_, _, second) = next(stream), next(stream)
    assert isinstance(first, State)
    assert isinstance(second, State)
    assert second.time == pytest.approx(0.02)


def test_scenes_side_by_side_equal_scenes_alone(trajectory: Trajectory) -> None:
    """Different lengths, a guard that stops one of them, a refusal in another."""
    guard = Guard(bounds=((0.0, 1.0), (-0.3, 1.0)))

    def refuse(state: State) -> State:
        if state.pos[0, 0] > 0.5:
            raise SimulationError("too far right", reason="input", node=0)
        return state

    simulator = FreeFall(0.01, 4, refuse)
    left = replace(trajectory.state(0), pos=trajectory.pos[0] * 0.3)
    right = replace(left, pos=left.pos + np.array([0.6, 0.5]))
    starts = [Start(left, 30, trajectory.metadata, guard), Start(right, 10, trajectory.metadata), Start(left, 3, trajectory.metadata)]
    seen: list[tuple[int, int]] = []
    together = rollouts(simulator, starts, lambda scene, frame, _: seen.append((scene, frame)))
    for start, result in zip(starts, together, strict=True):
        alone = rollout(simulator, start.state, start.num_steps, start.metadata, start.guard)
        np.testing.assert_array_equal(result.pos, alone.pos)
        assert result.termination == alone.termination
    assert [t.num_frames for t in together][1:] == [4, 4]
    assert together[1].termination is not None and together[1].termination.reason == "input"
    assert together[0].termination is not None and together[0].termination.reason == "escape"
    assert seen[:4] == [(0, 1), (1, 1), (2, 1), (0, 2)]


def test_frames_do_not_share_memory_with_the_simulator(trajectory: Trajectory) -> None:
    """A simulator may reuse its arrays."""
    state = trajectory.state(0)

    class InPlace:
        def step(self, state: State) -> State:
            state.pos[...] += 1.0
            return state

    start = state.pos.copy()
    result = rollout(InPlace(), state, 3, trajectory.metadata)
    np.testing.assert_array_equal(result.pos, np.stack([start + k for k in range(4)]))


def test_fraction_outside(trajectory: Trajectory) -> None:
    pos = np.full_like(trajectory.pos, 0.3)
    pos[0, :3, 1] = -0.05  # 3 of 72 below the floor
    moved = replace(trajectory, pos=pos)
    assert fraction_outside(moved) == pytest.approx(3 / 72)
    assert fraction_outside(moved, tolerance=0.06) == 0.0
    assert fraction_outside(replace(moved, boundary=replace(moved.boundary, shapes=()))) == 0.0


@pytest.mark.parametrize("name", ["gravity", "velocity_history", "frame_velocity"])
def test_a_start_whose_array_has_another_shape_is_refused(trajectory: Trajectory, name: str) -> None:
    state = replace(trajectory.state(0), velocity_history=trajectory.vel[0][:, None], frame_velocity=trajectory.vel[0])
    assert rollout(FreeFall(0.01), state, 1, trajectory.metadata).termination is None
    short = replace(state, **{name: getattr(state, name)[:-1]})
    stopped = rollout(FreeFall(0.01), short, 1, trajectory.metadata).termination
    assert stopped is not None and stopped.message.startswith(f"{name} has the shape (")


@pytest.mark.parametrize("number", [-1, 2.5, 0.29 / 0.01])
def test_an_impossible_number_of_steps_is_refused(trajectory: Trajectory, number: Any) -> None:
    """0.29 / 0.01 is a little less than 29."""
    start = Start(trajectory.state(0), 3, trajectory.metadata)
    object.__setattr__(start, "num_steps", number)  # tests check types, users' programs do not
    with pytest.raises(ValueError, match=f"num_steps={number}: must be a whole number of at least 0"):
        next(frames(FreeFall(0.01), [start]))
