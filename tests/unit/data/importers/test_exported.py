"""Import of trajectories that this package exported: they come back as they were."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gpe_pl.data.importers import ImportFailure, ImportSettings, import_dataset, save_dataset
from gpe_pl.export.trajectories import write_npz
from gpe_pl.trajectory.store import iter_trajectories, stored_arrays, stored_attributes
from gpe_pl.trajectory.trajectory import Trajectory
from tests.unit.data.importers.test_formats import imported

Make = Callable[..., Trajectory]


@pytest.fixture
def scenes(new_trajectory: Make) -> list[Trajectory]:
    """Make two trajectories, whose nodes move."""
    made = [new_trajectory(seed, num_frames=8, num_nodes=12) for seed in range(2)]
    steps = [np.random.default_rng(t.metadata.seed).normal(scale=3e-3, size=t.pos.shape) for t in made]
    return [replace(t, pos=(t.pos[0] + np.cumsum(s, axis=0)).astype(np.float32)) for t, s in zip(made, steps, strict=True)]


def exported(folder: Path, scenes: list[Trajectory]) -> Path:
    folder.mkdir()
    for number, trajectory in enumerate(scenes):
        write_npz(folder / f"{number}.npz", trajectory)
    return folder


def test_exported_trajectories_come_back(tmp_path: Path, scenes: list[Trajectory]) -> None:
    report, stored = imported(tmp_path, exported(tmp_path / "raw", scenes), "arrays", holdout=0.0)
    assert not report.refusals
    for before, after in zip(scenes, stored["train"], strict=True):
        own, found = stored_arrays(before), stored_arrays(after)
        assert own.keys() == found.keys()
        for name, array in own.items():
            np.testing.assert_array_equal(found[name], array, err_msg=name)
        assert stored_attributes(after)["shapes"] == stored_attributes(before)["shapes"]
        assert after.metadata.param_names == before.metadata.param_names
        assert (after.metadata.bounds, after.metadata.gravity) == (before.metadata.bounds, before.metadata.gravity)


def test_a_moved_origin_comes_back_too(tmp_path: Path) -> None:
    """The archive says where the origin is, so what is imported from it again is in the coordinates of the first source."""
    offset, random = np.array([500000.0, 5800000.0]), np.random.default_rng(0)
    start = offset + 0.1 * np.stack(np.meshgrid(np.arange(3), np.arange(3)), axis=-1).reshape(-1, 2)
    far = [start + np.cumsum(random.normal(scale=1e-3, size=(8, 9, 2)), axis=0) for _ in range(3)]
    made = [Trajectory.from_numpy(pos, 0.01, "elastomer", {"elastomer": 1e5}, cells=[[0, 1, 4, 3]]) for pos in far]
    report = save_dataset(tmp_path / "data", "first", holdout=0.0, train=made)
    near = [*iter_trajectories(report.folder, "train")]
    again, stored = imported(tmp_path, exported(tmp_path / "raw", near), "arrays", holdout=0.0)
    assert not again.refusals and again.origin == report.origin and np.any(report.origin)
    for before, after in zip(near, stored["train"], strict=True):
        np.testing.assert_allclose(after.pos, before.pos, atol=1e-7)
        np.testing.assert_allclose(after.rest_pos, before.rest_pos, atol=1e-7)  # type: ignore[arg-type]


@pytest.mark.slow
def test_rollouts_of_models_are_no_ground_truth(tmp_path: Path, scenes: list[Trajectory]) -> None:
    """Evaluations write them beside the ground truth, and a holdout would take them as validation and test."""
    folder = exported(tmp_path / "raw", scenes)
    write_npz(folder / "rollout_test_00.npz", replace(scenes[0], pos=scenes[0].pos + np.float32(1e-3), is_prediction=True))
    write_npz(folder / "rollout_test_01.npz", replace(scenes[1], pos=scenes[1].pos + np.float32(1e-3)))  # as earlier versions wrote them
    report, stored = imported(tmp_path, folder, "arrays", holdout=0.0)
    (event,) = report.refusals
    assert str(event).endswith("rollout_test_00.npz: is a rollout of a model and no ground truth; leave the file out")
    assert len(stored["train"]) == 3
    assert any("rollout_test_01.npz: its name is that of a rollout of a model" in warning for warning in report.warnings)


def refusal(folder: Path, **settings: object) -> str:
    with pytest.raises(ImportFailure) as failure:
        import_dataset(folder.parent / "data", ImportSettings("arrays", str(folder), "set", **settings))  # type: ignore[arg-type]
    return str(failure.value)


def test_a_setting_that_the_archive_states_is_refused(tmp_path: Path, scenes: list[Trajectory]) -> None:
    folder = exported(tmp_path / "raw", scenes)
    assert "states gravity itself; leave gravity out of the command" in refusal(folder, gravity=[0.0, -1.0])


def changed(folder: Path, **arrays: np.ndarray) -> Path:
    """Replace arrays of the only archive of a folder."""
    path = folder / "0.npz"
    with np.load(path) as archive:
        values = {name: archive[name] for name in archive.files}
    np.savez(path, allow_pickle=False, **{**values, **arrays})
    return folder


def test_damage_is_named(tmp_path: Path, scenes: list[Trajectory]) -> None:
    pos = scenes[0].pos.copy()
    pos[3, 5] = np.nan
    for name, array, message in (
        ("pos", pos, "frame 3, node 5"),
        ("pos", scenes[0].pos.astype(np.float64), "field 'pos' is float64[8, 12, 2], expected float32"),
        ("metadata", np.array("{}"), "metadata unreadable"),
        ("metadata", np.array([1.0]), "metadata is float64[1], expected text"),
        ("origin", np.array([1.0]), "origin: has shape [1], expected [dim 2]"),
        ("colour", np.array([1.0]), "has an unknown key 'colour'"),
    ):
        folder = tmp_path / f"{name}_{array.dtype}_{array.size}"
        assert message in refusal(changed(exported(folder, scenes[:1]), **{name: array})), name
        assert not list(tmp_path.glob("**/trajectory"))
