"""Parts of one recording in two splits are named, and scenes that only start alike are not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpe_pl.data.importers.recordings import Part
from gpe_pl.trajectory.trajectory import Trajectory
from tests.unit.data.importers.test_formats import imported

DT, NUM_FRAMES, LANDS = 0.01, 40, 20
START = 0.05 * np.stack(np.meshgrid(np.arange(9.0), np.arange(9.0)), axis=-1).reshape(-1, 2)


def recording(seed: int, same_start: bool = False) -> np.ndarray:
    """Return positions [frame, node, dim] of a block that falls and lands, from then on in another way for each seed."""
    rng = np.random.default_rng(seed)
    time = DT * np.arange(NUM_FRAMES)[:, None, None]
    start = START + np.array([0.0, 3.0]) + (0.0 if same_start else rng.uniform(-1, 1, 2))
    pos = start + np.array([1.0, 0.0]) * time + np.array([0.0, -9.81 / 2]) * time**2
    after = time[LANDS:] - time[LANDS]
    pos[LANDS:] = pos[LANDS] + rng.uniform(-1, 1, (len(START), 2)) * np.sin(20 * after) / 10
    return pos


def warnings(folder: Path, settings: dict[str, Any] | None = None, **splits: list[np.ndarray]) -> list[str]:
    for split, scenes in splits.items():
        (folder / "raw" / split).mkdir(parents=True)
        for k, pos in enumerate(scenes):
            arrays: dict[str, Any] = {"pos": pos, "frame_dt": DT, "materials": "solid", "params_solid": 1e6, "gravity": [0.0, -9.81]}
            np.savez(folder / "raw" / split / f"{split}{k}.npz", **arrays)
    report, _ = imported(folder / "sets", folder / "raw", "arrays", **(settings or {}))
    return [w for w in report.warnings if "recording" in w]


def swinging(frequency: float) -> np.ndarray:
    """Return positions [frame, node, dim] of a clamped body that swings through the place where it started, and is close to it at the end."""
    phase = np.linspace(0, 2 * np.pi * frequency, NUM_FRAMES)[:, None, None]
    return START + 0.02 * np.sin(phase) * START[:, :1] * np.array([0.0, 1.0])


A, B, C = (recording(seed) for seed in range(3))
PART = "1 of 1 trajectories is of a recording that is also in another split, the first is "


@pytest.mark.slow
@pytest.mark.parametrize(
    ("train", "val", "said"),
    [
        pytest.param(A[:25], A[15:], "val0.npz, which has frames of train, train0.npz", id="overlap"),
        pytest.param(A[15:], A[:25], "val0.npz, which has frames of train, train0.npz", id="overlap, later first"),
        pytest.param(A[:25], A[15:, ::-1], "val0.npz, which has frames of train, train0.npz", id="overlap, other order of nodes"),
        pytest.param(A, A[:30], "val0.npz, which has frames of train, train0.npz", id="beginning"),
        pytest.param(A[:30], A, "val0.npz, which has frames of train, train0.npz", id="longer"),
        pytest.param(A[:18], A[18:], "val0.npz, which goes on after train, train0.npz", id="next"),
        pytest.param(A[18:], A[:18], "val0.npz, which goes on before train, train0.npz", id="previous"),
        pytest.param(A[:33], A[33:], "val0.npz, which goes on after train, train0.npz", id="next, while it swings"),
        pytest.param(A, B, None, id="two scenes"),
        pytest.param(recording(4, same_start=True), recording(5, same_start=True), None, id="same start"),
        pytest.param(swinging(1.9713), swinging(2.9587), None, id="back at the start"),
        pytest.param(recording(4, same_start=True)[:30], recording(5, same_start=True), None, id="same start, other lengths"),
    ],
)
def test_parts_of_one_recording(tmp_path: Path, train: np.ndarray, val: np.ndarray, said: str | None) -> None:
    found = warnings(tmp_path, train=[train], val=[val], test=[C])
    assert [w.split(": errors there")[0] for w in found] == ([] if said is None else [f"val: {PART}{said}"])


def test_scenes_far_from_0_differ_by_less_than_their_rounding_there() -> None:
    def digests(pos: np.ndarray) -> np.ndarray:
        return Part.of(Trajectory.from_numpy(pos, DT, "sand", {"sand": 30.0})).digests

    there = np.array([500_000.3, 4_649_776.4])
    first, second = (digests(START + there + 1e-3 * np.sin(0.3 * seed + np.arange(5.0)[:, None, None])) for seed in (0, 1))
    assert not {*first.tolist()} & {*second.tolist()} and len({*first.tolist()}) == 5
    np.testing.assert_array_equal(
        digests(START[None, ::-1] + there + np.zeros((3, 1, 1))), digests(START[None] + there + np.zeros((3, 1, 1)))
    )
    assert (
        digests(START[None] + there + np.zeros((3, 1, 1)))[0]
        != digests(START[None] + there + np.array([1.0, 0.0]) + np.zeros((3, 1, 1)))[0]
    )


@pytest.mark.slow
def test_parts_may_be_in_one_split(tmp_path: Path) -> None:
    assert not warnings(tmp_path, train=[A[:20], A[20:]], val=[B], test=[C])


@pytest.mark.slow
def test_splits_that_the_import_chooses_count(tmp_path: Path) -> None:
    """The last training trajectories become val and test."""
    (what,) = warnings(tmp_path, train=[B, C, A[:20], A[20:]])
    assert what.startswith(f"test: {PART}train2.npz, which goes on before val, train3.npz: ")


@pytest.mark.slow
def test_every_part_is_counted(tmp_path: Path) -> None:
    (what,) = warnings(tmp_path, train=[A[:20], B[:20]], val=[A[20:], C, B[10:]], test=[recording(7)])
    assert what.startswith(
        "val: 2 of 3 trajectories are of a recording that is also in another split, the first is val0.npz, which goes on after"
    )
