"""An ensemble predicts the mean of its members' own rollouts, and knows how far they are apart."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.ensemble import Ensemble, mean_state, spread
from gpe_pl.rollout.loop import SimulationError, Simulator, Start, rollout, rollouts, steps
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory


@dataclass(frozen=True)
class Growing:
    """Multiplies velocities by a factor, so that members differ more and more; fails in a frame."""

    factor: float
    fails_at: float = np.inf

    def step(self, state: State) -> State:
        if state.time > self.fails_at:
            raise SimulationError("gave up", reason="test", node=3)
        vel = self.factor * state.vel
        return state.later(0.01, state.pos + 0.01 * vel, vel)


def test_members_follow_their_own_trajectories(trajectory: Trajectory) -> None:
    start, members = trajectory.state(0), (Growing(0.5), Growing(1.5))
    mean = rollout(Ensemble(members), start, 4, trajectory.metadata)
    own = [rollout(member, start, 4, trajectory.metadata) for member in members]
    np.testing.assert_allclose(mean.pos, (own[0].pos + own[1].pos) / 2, atol=1e-12)
    averaged = rollout(Growing(1.0), start, 4, trajectory.metadata)  # what a mean of both in every step would give
    assert np.abs(mean.pos - averaged.pos)[2:].max() > 1e-3


@dataclass(frozen=True)
class Turning:
    """Turns all nodes about the origin by an angle in each frame."""

    angle: float

    def step(self, state: State) -> State:
        c, s = np.cos(self.angle), np.sin(self.angle)
        pos = state.pos @ np.array([[c, s], [-s, c]])
        return state.later(0.01, pos, (pos - state.pos) / 0.01)


def test_the_mean_of_rigid_bodies_is_rigid(trajectory: Trajectory) -> None:
    """It is at the mean place, and turned by the mean angle."""
    start = trajectory.state(0)
    body = np.where(np.arange(start.num_nodes) < 8, 0, -1)
    angles = 0.02, 0.06
    after = Ensemble((Turning(angles[0]), Turning(angles[1]))).step(replace(start, rigid_body=body))
    before, now = start.pos[:8] - start.pos[:8].mean(axis=0), after.pos[:8] - after.pos[:8].mean(axis=0)
    np.testing.assert_allclose(np.linalg.norm(now, axis=1), np.linalg.norm(before, axis=1), rtol=1e-9)
    turned = np.angle((now[:, 0] + 1j * now[:, 1]) / (before[:, 0] + 1j * before[:, 1]))
    np.testing.assert_allclose(turned, np.mean(angles), rtol=1e-3)
    members = [Turning(angle).step(start).pos for angle in angles]
    np.testing.assert_allclose(after.pos[8:], np.mean(members, axis=0)[8:], atol=1e-12)
    weight = start.mass[:8] / start.mass[:8].sum()
    np.testing.assert_allclose(weight @ after.pos[:8], weight @ np.mean(members, axis=0)[:8], atol=1e-9)


def test_spread_is_the_distance_from_the_mean(trajectory: Trajectory) -> None:
    start, simulators = trajectory.state(0), [Growing(0.5), Growing(1.5), Growing(1.0)]
    assert spread(start) is None
    mean = list(steps(Ensemble(tuple(simulators)), start, 3))[-1]
    own = np.stack([list(steps(simulator, start, 3))[-1].pos for simulator in simulators])
    expected = np.sqrt(((own - own.mean(axis=0)) ** 2).sum(axis=-1).sum(axis=0) / 2)
    np.testing.assert_allclose(np.asarray(spread(mean)), expected, rtol=1e-9)
    same = list(steps(Ensemble((Growing(1.1), Growing(1.1))), start, 3))[-1]
    assert np.asarray(spread(same)).max() < 1e-12


def test_scenes_are_advanced_together_and_fail_alone(trajectory: Trajectory) -> None:
    ensemble: Simulator = Ensemble((Growing(0.5), Growing(1.5, fails_at=0.015)))
    late = replace(trajectory.state(0), time=-1.0)
    stopped, whole = rollouts(ensemble, [Start(s, 4, trajectory.metadata) for s in (trajectory.state(0), late)])
    assert stopped.termination is not None and stopped.termination.frame == 3 and stopped.termination.node == 3
    assert "member 2 of 2: gave up" in stopped.termination.message
    assert whole.termination is None and whole.num_frames == 5


def test_means_are_taken_across_a_periodic_seam(new_trajectory: object) -> None:
    trajectory = new_trajectory(periodic=(True, False), connectivity_radius=0.15)  # type: ignore[operator]
    state = trajectory.state(0)
    pos = np.tile([[0.98, 0.5]], (state.num_nodes, 1))
    left = replace(state, pos=pos)
    right = replace(state, pos=np.full_like(pos, 0.5) - np.array([0.46, 0.0]))
    np.testing.assert_allclose(mean_state([left, right]).pos[0], [0.01, 0.5], atol=1e-12)


def test_counts_of_an_ensemble_are_the_means_of_its_members(trajectory: Trajectory) -> None:
    state = trajectory.state(2, 2)
    members = [replace(state, num_corrected=count, num_asleep=2 * count) for count in (0, 0, 1)]
    mean = mean_state(members)
    assert mean.num_corrected == pytest.approx(1 / 3) and mean.num_asleep == pytest.approx(2 / 3)


def test_a_member_that_fails_in_a_single_step_raises(trajectory: Trajectory) -> None:
    with pytest.raises(SimulationError, match="member 1 of 2"):
        Ensemble((Growing(1.0, fails_at=-1.0), Growing(1.0))).step(trajectory.state(0))


def test_containment_of_the_mean_alone_is_refused(trajectory: Trajectory) -> None:
    """Members would go through walls, and the mean would jump to their other side."""
    ensemble = Ensemble((Growing(0.5), Growing(1.5)))
    with pytest.raises(ValueError, match="contain each member"):
        Contained(ensemble, 0.01)
    after = Ensemble(tuple(Contained(member, 0.01) for member in ensemble.members)).step(trajectory.state(0))
    again = replace(after, pos=after.pos.copy())
    np.testing.assert_array_equal(ensemble.step(again).pos, ensemble.step(after).pos)
    with pytest.raises(SimulationError, match="positions were changed after an ensemble"):
        ensemble.step(replace(after, pos=after.pos + 1e-3))
    assert isinstance(ensemble.step(replace(after, pos=after.pos + 1e-3, internal=None)), State)
