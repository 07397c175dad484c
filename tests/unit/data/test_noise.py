"""Noise moves inputs as its definition says, in the stated unit, and leaves the stored window alone."""

from __future__ import annotations

import numpy as np
import pytest

from gpe_pl import integrators
from gpe_pl.data.noise import Noise

DT, UNIT = 0.01, 0.3


def window(history: int, num_nodes: int = 5, dim: int = 2, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=(history + 2, num_nodes, dim))


def noisy(noise: Noise, clean: np.ndarray, seed: int = 1) -> np.ndarray:
    return noise.apply(clean, UNIT, DT, np.random.default_rng(seed))


@pytest.mark.parametrize("history", [1, 2, 5])
@pytest.mark.parametrize("kind", ["paper", "velocity"])
def test_the_window_is_left_as_it_is(kind: str, history: int) -> None:
    clean = window(history)
    clean.setflags(write=False)
    before = clean.tobytes()
    result = noisy(Noise(kind, 0.5), clean)  # type: ignore[arg-type]
    assert clean.tobytes() == before
    assert not np.shares_memory(result, clean)
    assert (result[1:] != clean[1:]).all()


@pytest.mark.parametrize("kind", ["paper", "velocity"])
def test_no_noise(kind: str) -> None:
    clean = window(2)
    np.testing.assert_array_equal(noisy(Noise(kind, 0.0), clean), clean)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["paper", "velocity"])
def test_equal_seeds_give_equal_noise(kind: str) -> None:
    noise, clean = Noise(kind, 0.5), window(2)  # type: ignore[arg-type]
    np.testing.assert_array_equal(noisy(noise, clean, 3), noisy(noise, clean, 3))
    assert not np.array_equal(noisy(noise, clean, 3), noisy(noise, clean, 4))


@pytest.mark.parametrize("history", [1, 4])
def test_paper_noise_keeps_velocities_and_target(history: int) -> None:
    clean = window(history)
    result = noisy(Noise("paper", 1e-3), clean)
    np.testing.assert_allclose(integrators.velocities(result, DT), integrators.velocities(clean, DT), rtol=0, atol=1e-12)
    shift = result - clean
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=1e-15)
    assert len(np.unique(shift[0].round(15))) == shift[0].size  # every node and axis has its own


def test_paper_noise_is_in_metres() -> None:
    clean = window(1, num_nodes=20000)
    assert np.std(noisy(Noise("paper", 2e-3), clean)[1] - clean[1]) == pytest.approx(2e-3, rel=0.02)


@pytest.mark.parametrize("history", [1, 2, 5])
def test_the_target_corrects_velocity_noise_exactly(history: int) -> None:
    """The noisy velocity, advanced by the noisy target, is the true next velocity."""
    clean = window(history)
    result = noisy(Noise("velocity", 0.5), clean)
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
    error = integrators.velocities(noisy(Noise("velocity", 0.4), clean), DT) - integrators.velocities(clean, DT)
    for k in range(history):  # a random walk: variance grows linearly and ends at the stated value
        assert np.std(error[k]) == pytest.approx(0.4 * UNIT * np.sqrt((k + 1) / history), rel=0.02)
    np.testing.assert_allclose(error[history], 0.0, atol=1e-11)


@pytest.mark.parametrize("correction", [0.25, 1.0])
def test_the_target_takes_back_a_share_of_the_position_noise(correction: float) -> None:
    clean = window(3)
    plain, result = noisy(Noise("velocity", 0.5), clean), noisy(Noise("velocity", 0.5, correction), clean)
    np.testing.assert_array_equal(result[:-1], plain[:-1])  # inputs are the same
    position_error = result[-2] - clean[-2]
    assert np.abs(position_error).min() > 0
    np.testing.assert_allclose(result[-1] - clean[-1], (1 - correction) * position_error, atol=1e-15)
