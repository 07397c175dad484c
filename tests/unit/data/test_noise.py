"""Noise moves inputs according to its definition and unit, and does not change the stored window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.data.noise import Noise, NoiseError
from gpe_pl.trajectory import integrators
from tests import scenes

DT, UNIT, SIDE = 0.01, 0.3, 4.0
POSITION, VELOCITY = Noise(0.5, 0.0), Noise(0.0, 0.5)
BOTH = Noise(0.5, 0.5)


def window(history: int, num_nodes: int = 5, dim: int = 2, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=(history + 2, num_nodes, dim))


def noisy(noise: Noise, clean: np.ndarray, seed: int = 1) -> np.ndarray:
    return noise.apply(clean, SIDE, UNIT, DT, np.random.default_rng(seed))


@pytest.mark.parametrize("history", [1, 2, 5])
@pytest.mark.parametrize("noise", [POSITION, VELOCITY, BOTH])
def test_the_window_is_left_as_it_is(noise: Noise, history: int) -> None:
    clean = window(history)
    clean.setflags(write=False)
    before = clean.tobytes()
    result = noisy(noise, clean)
    assert clean.tobytes() == before
    assert not np.shares_memory(result, clean)
    assert (result[1:] != clean[1:]).all()


def test_no_noise() -> None:
    clean = window(2)
    np.testing.assert_array_equal(noisy(Noise(0.0, 0.0), clean), clean)


@pytest.mark.parametrize("noise", [POSITION, VELOCITY, BOTH])
def test_equal_seeds_give_equal_noise(noise: Noise) -> None:
    clean = window(2)
    np.testing.assert_array_equal(noisy(noise, clean, 3), noisy(noise, clean, 3))
    assert not np.array_equal(noisy(noise, clean, 3), noisy(noise, clean, 4))


@pytest.mark.parametrize("history", [1, 4])
def test_position_noise_keeps_velocities_and_target(history: int) -> None:
    clean = window(history)
    result = noisy(Noise(2.5e-4, 0.0), clean)
    np.testing.assert_allclose(integrators.velocities(result, DT), integrators.velocities(clean, DT), rtol=0, atol=1e-12)
    shift = result - clean
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=1e-15)
    assert len(np.unique(shift[0].round(15))) == shift[0].size  # every node and axis has its own


def test_position_noise_is_a_fraction_of_the_domains_longest_side() -> None:
    clean = window(1, num_nodes=20000)
    assert np.std(noisy(Noise(2e-3, 0.0), clean)[1] - clean[1]) == pytest.approx(2e-3 * SIDE, rel=0.02)
    assert replace(scenes.metadata(("sand",), 2), bounds=((-1.0, 2.0), (0.0, 5.0))).longest_side == 5.0


def test_both_noises_add_up() -> None:
    clean = window(3, num_nodes=20000)
    offset = noisy(Noise(1e-3, 0.5), clean) - clean
    walk = 0.5 * UNIT * DT * np.sqrt((1 + 4 + 9) / 3)
    np.testing.assert_allclose(np.std(offset[0]), 1e-3 * SIDE, rtol=0.02)
    np.testing.assert_allclose(np.std(offset[-2]), np.hypot(1e-3 * SIDE, walk), rtol=0.02)
    np.testing.assert_allclose(offset[-1], offset[-2], rtol=0, atol=1e-15)


def test_noise_beyond_half_a_spacing_is_refused() -> None:
    """The error names key, value and spacing, and the largest value that is allowed."""
    space = replace(scenes.metadata(("sand",), 2), bounds=((0.0, 2.0), (0.0, 1.0)), spacing=0.01, connectivity_radius=0.03, frame_dt=0.1)
    Noise(0.0025, 0.5).check(space, velocity_unit=0.1)  # half a spacing each
    with pytest.raises(NoiseError) as caught:
        Noise(0.3, 0.0).check(space)
    assert str(caught.value) == (
        "training.position_noise_of_domain=0.3 moves nodes by 0.6 m, which is 60 spacings of 0.01 m; "
        "more than 0.5 spacings are refused: choose at most 0.0025"
    )
    with pytest.raises(NoiseError, match=r"training.velocity_noise_of_change=0.51 moves nodes by 0.0051 m, .* choose at most 0.5$"):
        Noise(0.0, 0.51).check(space, velocity_unit=0.1)


@pytest.mark.parametrize("history", [1, 2, 5])
def test_the_target_corrects_velocity_noise_exactly(history: int) -> None:
    """The noisy velocity, advanced by the noisy target, is the true next velocity."""
    clean = window(history)
    result = noisy(VELOCITY, clean)
    vel, true = integrators.velocities(result, DT), integrators.velocities(clean, DT)
    target = integrators.acceleration(vel[-1], vel[-2], DT)
    assert np.abs(vel[-2] - true[-2]).min() > 0
    np.testing.assert_allclose(vel[-2] + target * DT, true[-1], rtol=0, atol=1e-11)
    position_error = result[-2] - clean[-2]
    np.testing.assert_allclose(result[-1] - clean[-1], position_error, atol=1e-15)  # position noise is not corrected
    np.testing.assert_array_equal(result[0], clean[0])


@pytest.mark.parametrize("history", [1, 2, 5])
def test_velocity_noise_is_in_units_of_one_frames_velocity_change(history: int) -> None:
    clean = window(history, num_nodes=20000)
    error = integrators.velocities(noisy(Noise(0.0, 0.4), clean), DT) - integrators.velocities(clean, DT)
    for k in range(history):  # a random walk: variance grows linearly and ends at the stated value
        assert np.std(error[k]) == pytest.approx(0.4 * UNIT * np.sqrt((k + 1) / history), rel=0.02)
    np.testing.assert_allclose(error[history], 0.0, atol=1e-11)


@pytest.mark.parametrize("correction", [0.25, 1.0])
def test_the_target_takes_back_a_fraction_of_the_position_noise(correction: float) -> None:
    clean = window(3)
    plain, result = noisy(VELOCITY, clean), noisy(Noise(0.0, 0.5, correction), clean)
    np.testing.assert_array_equal(result[:-1], plain[:-1])  # inputs are the same
    position_error = result[-2] - clean[-2]
    assert np.abs(position_error).min() > 0
    np.testing.assert_allclose(result[-1] - clean[-1], (1 - correction) * position_error, atol=1e-15)
