"""What is known of a scene: gaps, noise, seams of periodic domains, bodies and tilts; and misfits with valleys."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from gpe_pl.evaluation.identification.observations import ObservationError, Observations, ObservationSettings
from gpe_pl.evaluation.identification.profile import Profile
from gpe_pl.evaluation.identification.scene import identify_parameters
from gpe_pl.evaluation.identification.search import SearchSettings, search
from gpe_pl.evaluation.identification.shooting import ShootingError, ShootingSettings, shooting
from gpe_pl.evaluation.identification.unknowns import Unknowns, scene_bodies, unknowns_of
from gpe_pl.trajectory.trajectory import Trajectory
from tests.drag import ANGLE, BOUNDS, Drag, thrown


@pytest.mark.parametrize("settings", [{"nodes": 0.3}, {"every": 3}, {"added_noise": 3e-4}])
def test_parts_of_the_motion_are_enough(settings: dict[str, float]) -> None:
    observed = Observations.of(thrown(), ObservationSettings(**settings))  # type: ignore[arg-type]
    answer = identify_parameters(Drag(), observed, bounds=BOUNDS)
    assert answer["sand.friction_angle"].estimate == pytest.approx(ANGLE, abs=3.0)
    assert (answer.num_windows == 1) == ("nodes" in settings)


def test_values_that_were_not_observed_are_not_used() -> None:
    seen = thrown()
    observed = Observations.of(seen, ObservationSettings(every=3))
    wrong = np.where(observed.seen[..., None], seen.pos, np.float32(7.0))
    assert np.abs(Observations(replace(seen, pos=wrong), observed.seen).completed.pos[:39] - seen.pos[:39]).max() < 1e-3


def test_noise_is_smoothed_on_each_side_of_a_gap() -> None:
    """A filter that took the frames beside a gap for neighbours would move them by decimetres."""
    seen = thrown(num_frames=100)
    flags = np.ones(seen.pos.shape[:2], dtype=bool)
    flags[30:60] = False
    found = Observations(seen, flags, noise=1e-4).completed
    assert np.abs(found.pos - seen.pos).max() < 1e-3
    whole = Observations(seen, np.ones_like(flags), noise=1e-4).completed
    np.testing.assert_array_equal(found.pos[:25], whole.pos[:25])
    starts = shooting(Drag(), Observations(seen, flags), unknowns_of(seen, None, BOUNDS)).starts
    assert len(starts) > 2 and all(flags[frame].all() for frame in starts)


def test_scenes_have_hidden_nodes_and_noise_of_their_own() -> None:
    settings = ObservationSettings(nodes=0.5, added_noise=1e-3)
    first, second = (replace(thrown(angle), pos=thrown(angle).pos.astype(np.float64)) for angle in (25.0, 26.0))
    a, again, b = (Observations.of(own, settings) for own in (first, first, second))
    assert a.digest == again.digest
    assert (a.seen != b.seen).any()
    noise = [(own.trajectory.pos - true.pos).ravel() for own, true in ((a, first), (b, second))]
    assert abs(np.corrcoef(noise)[0, 1]) < 0.1
    np.testing.assert_allclose(np.std(noise, axis=1), 1e-3, rtol=0.1)


def test_short_runs_of_frames_are_not_smoothed(caplog: pytest.LogCaptureFixture) -> None:
    seen = thrown()
    flags = np.ones(seen.pos.shape[:2], dtype=bool)
    flags[8:12] = False
    found = Observations(seen, flags, noise=1e-4).completed
    np.testing.assert_array_equal(found.pos[:8], seen.pos[:8])
    assert "fewer than 12 frames are observed in a row without a gap" in caplog.text


def test_nodes_that_cross_a_seam_have_the_velocity_and_the_body_of_their_motion() -> None:
    seen = thrown()
    wrapped = replace(
        seen, pos=(seen.pos + 2.9) % 3.0, metadata=replace(seen.metadata, bounds=((0.0, 3.0), (0.0, 3.0)), periodic=(True, True))
    )
    assert np.abs(np.diff(wrapped.pos, axis=0)).max() > 1.0
    plain, across = (unknowns_of(own, ["velocity"], {}).items for own in (seen, wrapped))
    assert [unknown.high for unknown in across] == pytest.approx([unknown.high for unknown in plain], rel=1e-3)
    first = replace(seen, pos=seen.pos - seen.pos[:, 4:5])  # the first body lies across both seams
    around = replace(wrapped, pos=first.pos % 3.0)
    assert np.ptp(around.pos[0, :9]) > 1.0
    assert sorted(map(len, scene_bodies(around))) == [9, 9]


@pytest.mark.slow
def test_bodies_are_those_of_the_first_observed_frame() -> None:
    seen = thrown(np.repeat([24.0, 38.0], 9))
    flags, hidden = np.ones(seen.pos.shape[:2], dtype=bool), seen.pos.copy()
    flags[:5], hidden[:5] = False, 0.0
    answer = identify_parameters(Drag(), Observations(replace(seen, pos=hidden), flags), per_body=True, bounds=BOUNDS)
    assert [value.name for value in answer.values] == ["sand.friction_angle#1", "sand.friction_angle#2"]


def test_nodes_without_cells_belong_to_the_mesh_beside_them() -> None:
    """Two blocks of a mesh, a node beside the second one, and one that is alone."""
    square = 0.1 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    rest = np.concatenate([square + 0.2, square + np.array([1.0, 0.2]), [[1.0, 0.4]], [[2.0, 2.0]]])
    pos = np.repeat(rest[None], 4, axis=0)
    cells = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    scene = Trajectory.from_numpy(pos, 0.01, "elastomer", {"elastomer": 1e5}, bounds=((0.0, 3.0),) * 2, spacing=0.1, cells=cells)
    assert [nodes.tolist() for nodes in scene_bodies(scene)] == [[0, 1, 2, 3], [4, 5, 6, 7, 8], [9]]


@pytest.mark.parametrize("settings", [{}, {"every": 4}, {"added_noise": 2e-4}])
def test_the_stored_velocity_is_the_true_one_whatever_is_observed(settings: dict[str, float]) -> None:
    seen = thrown()
    observed = Observations.of(seen, ObservationSettings(**settings))  # type: ignore[arg-type]
    items = unknowns_of(observed.completed, ["velocity"], {}, stored=observed.trajectory).items
    assert [unknown.truth for unknown in items] == pytest.approx(seen.vel[0].mean(axis=0).tolist(), rel=1e-5, nan_ok=True)
    turning = replace(seen, vel=seen.vel + np.linspace(-1, 1, seen.num_nodes, dtype=np.float32)[:, None])
    assert all(math.isnan(unknown.truth) for unknown in unknowns_of(turning, ["velocity"], {}).items), "bodies have different ones"


def test_open_scenes_are_refused() -> None:
    seen = thrown()
    with pytest.raises(ObservationError, match="nodes enter or leave the scene"):
        Observations.of(replace(seen, alive=np.ones(seen.pos.shape[:2], dtype=bool)))


@pytest.mark.parametrize("down", [(0.0, -9.81), (4.905, -8.496)])
@pytest.mark.parametrize("tilt", [-30.0, 10.0, 45.0])
def test_the_tilt_of_gravity_is_an_angle(down: tuple[float, float], tilt: float) -> None:
    seen = thrown()
    seen = replace(seen, metadata=replace(seen.metadata, gravity=down))
    (unknown,) = unknowns_of(seen, ["gravity"], {}).items
    z = (tilt - unknown.low) / (unknown.high - unknown.low)
    found = Unknowns((unknown,)).applied(seen.state(0), np.array([z])).gravity
    assert np.linalg.norm(found) == pytest.approx(np.linalg.norm(down))
    turn = math.degrees(math.atan2(down[0] * found[1] - down[1] * found[0], np.dot(down, found)))
    assert turn == pytest.approx(tilt, abs=1e-6)  # counter-clockwise is towards +x


@dataclass
class Valley:
    """A misfit that is nearly the same along a diagonal, where one unknown makes up for the other."""

    number: int = 2
    simulator: None = None

    @property
    def unknowns(self) -> range:
        return range(self.number)

    def misfit(self, z: Sequence[float] | np.ndarray) -> float:
        along, across = z[0] - 0.55, z[0] + z[1] - 1.0
        rest = float(((np.asarray(z)[2:] - 0.4) ** 2).sum())
        return math.log(1e-4 * (1 + 0.3 * along**2) + 0.5 * across**2 + 0.1 * rest)

    def misfit_and_gradient(self, z: Sequence[float] | np.ndarray) -> tuple[float, np.ndarray]:
        raise AssertionError


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 3])
def test_intervals_follow_valleys_of_the_misfit(number: int) -> None:
    """The smallest misfit over the other unknown rises by less than 0.1 over the whole range."""

    def interval(evaluations: int, k: int) -> tuple[float, float]:
        found = search(Valley(number), SearchSettings(profile_evaluations=evaluations))
        return Profile.of(((float(z[k]), misfit) for z, misfit in found.tried), (0.0, 1.0)).within(0.2)

    for k in (0, 1):
        low, high = interval(12, k)
        assert low < 0.05 and high > 0.95
        low, high = interval(0, k)
        assert high - low < 0.2
    planned: list[tuple[int, int]] = []
    search(Valley(number), on_progress=lambda done, total: planned.append((done, total)))
    assert len(planned) > 100 and [done for done, _ in planned] == [*range(1, len(planned) + 1)], "the bar moves to the end"
    if number == 3:  # the third is well known
        low, high = interval(12, 2)
        assert 0.3 < low < 0.4 < high < 0.5


def test_frames_before_the_first_observed_one_are_not_used() -> None:
    seen = thrown()
    flags = np.ones(seen.pos.shape[:2], dtype=bool)
    flags[:12] = False
    hidden = seen.pos.copy()
    hidden[:12] = np.nan
    answers = [identify_parameters(Drag(), Observations(replace(seen, pos=pos), flags), bounds=BOUNDS) for pos in (seen.pos, hidden)]
    assert answers[0].values == answers[1].values
    assert answers[0]["sand.friction_angle"].estimate == pytest.approx(ANGLE, abs=3.0), "velocities at the start follow from positions"


def test_windows_without_an_observed_frame_are_refused() -> None:
    with pytest.raises(ShootingError, match=r"no frame within shooting\.horizon=1 of the starts \[0\] is observed"):
        settings = ShootingSettings(horizon=1, num_windows=1)
        identify_parameters(Drag(), Observations.of(thrown(), ObservationSettings(every=4)), bounds=BOUNDS, shooting_settings=settings)
