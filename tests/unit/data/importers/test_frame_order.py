"""Missing, swapped and text-ordered frames are named, and impacts and vibrations are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gpe_pl.data.importers import save_dataset
from gpe_pl.data.importers.frame_order import wrong_frames
from gpe_pl.trajectory.trajectory import Trajectory

DT, NUM_FRAMES = 0.005, 42
BLOCK = 0.05 * (np.stack(np.meshgrid(np.arange(8.0), np.arange(8.0)), axis=-1).reshape(-1, 2) - 3.5)
GRAVITY = np.array([0.0, -9.81])


def pulsating(seed: int = 0) -> np.ndarray:
    """Return the positions [frame, node, dim] of a block that is thrown and pulsates."""
    rng = np.random.default_rng(seed)
    time = DT * np.arange(NUM_FRAMES)[:, None, None]
    velocity, rate = rng.uniform(-1, 1, 2), rng.uniform(20, 40)
    return np.asarray(BLOCK * (1 + 0.1 * np.sin(rate * time)) + velocity * time + 0.5 * GRAVITY * time**2)


def found(pos: np.ndarray, vel: np.ndarray | None = None) -> list[tuple[int, str]]:
    return [*wrong_frames(Trajectory.from_numpy(pos, DT, "fluid", {"fluid": 1e-3}, gravity=GRAVITY, vel=vel))]


def test_frames_in_their_order_are_no_suspects() -> None:
    for seed in range(20):
        pos = pulsating(seed)
        assert not found(pos)
        assert not found(pos, np.gradient(pos, DT, axis=0))


def test_missing_frames() -> None:
    ((frame, what),) = found(np.delete(pulsating(), [10, 25], axis=0))
    assert frame == 10
    assert what == "nodes move 2.0 times as far as in the frames before and after: is a frame missing before it (alike: frame 24)?"
    ((frame, what),) = found(np.delete(pulsating(), [20, 21], axis=0))
    assert (frame, what.split()[2]) == (20, "3.0")


def test_velocities_tell_of_a_frame_that_is_missing_at_the_end() -> None:
    pos = pulsating()
    pos, vel = (np.delete(values, NUM_FRAMES - 2, axis=0) for values in (pos, np.gradient(pos, DT, axis=0)))
    assert not found(pos)
    ((frame, what),) = found(pos, vel)
    assert frame == NUM_FRAMES - 2
    assert "times as far as their velocities say: is a frame missing before it?" in what


def test_swapped_frames() -> None:
    ((frame, what),) = found(pulsating()[[*range(10), 11, 10, *range(12, NUM_FRAMES)]])
    assert (frame, what) == (10, "nodes go forward, back and forward again: is it swapped with frame 11?")


@pytest.mark.parametrize("start", [0, 1])
def test_the_order_of_text(start: int) -> None:
    order = np.array(sorted(range(start, NUM_FRAMES + start), key=str)) - start
    ((frame, what),) = found(pulsating()[order])
    assert frame == np.flatnonzero(order != np.arange(NUM_FRAMES))[0]
    assert what.startswith("does not go on from the frame before: frames are in the order of text (1, 10, 11, …, 2)")


def bouncing(restitution: float, start: float, speed: float) -> np.ndarray:
    """Return heights [frame] of a stiff body on a floor."""
    heights, height = np.empty(NUM_FRAMES), start
    for frame in range(NUM_FRAMES):
        heights[frame] = height
        for _ in range(50):
            speed -= 9.81 * DT / 50
            height += speed * DT / 50
            if height < 0 and speed < 0:
                speed *= -restitution
    return heights


def test_impacts_of_all_nodes_at_once_are_no_suspects() -> None:
    rng = np.random.default_rng(0)
    along = rng.uniform(-1, 1, 2) * DT * np.arange(NUM_FRAMES)[:, None] * [1, 0]
    for _ in range(60):
        heights = bouncing(rng.uniform(0, 1), rng.uniform(0, 0.2), rng.uniform(-3, 3))
        pos = np.array([0.0, 1.0]) * heights[:, None, None] + BLOCK
        assert not found(pos)
        assert not found(pos + along[:, None])


def test_vibrations_of_any_frequency_are_no_suspects() -> None:
    rng, frames = np.random.default_rng(0), np.arange(NUM_FRAMES)[:, None, None]
    for _ in range(300):
        swing = np.cos(rng.uniform(0.01, np.pi) * frames + rng.uniform(0, 2 * np.pi))
        assert not found(BLOCK * (1 + 0.1 * swing))


def test_noise_is_no_fault_of_the_order() -> None:
    rng = np.random.default_rng(0)
    for seed in range(20):
        assert not found(BLOCK[:2] + rng.normal(scale=0.01, size=(NUM_FRAMES, 2, 2)))
        assert not found(pulsating(seed) + rng.normal(scale=0.01, size=(NUM_FRAMES, 64, 2)))


def test_the_report_names_trajectory_and_frame(tmp_path: Path) -> None:
    pos = [pulsating(k) for k in range(4)]
    pos[2] = np.delete(pos[2], 10, axis=0)
    trajectories = [Trajectory.from_numpy(p, DT, "fluid", {"fluid": 1e-3}, gravity=GRAVITY) for p in pos]
    said = save_dataset(tmp_path, "mine", holdout=0.0, train=trajectories).warnings
    assert any(warning.startswith("train, train[2], frame 10: nodes move 2.0 times as far") for warning in said)
