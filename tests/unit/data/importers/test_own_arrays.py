"""Import of arrays that a user has written, and rules for splits of all formats."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpe_pl.data.importers import ImportFailure, ImportSettings, import_dataset
from gpe_pl.trajectory.trajectory import Trajectory
from tests import sources
from tests.sources import DT, SPACING, motion
from tests.unit.data.importers.test_formats import assert_stored, drift, imported


def test_own_arrays(tmp_path: Path) -> None:
    for k, split in enumerate(("train", "val", "test")):
        (tmp_path / "raw" / split).mkdir(parents=True)
        names = np.array(["sand", "fluid"] * 10)
        np.savez(
            tmp_path / "raw" / split / "a.npz",
            pos=drift(seed=k), frame_dt=DT, materials=names, params_sand=30.0, params_fluid=np.linspace(0.1, 1, 20),
            bounds=[[0, 1], [0, 1]], periodic=[True, True], gravity=[0, -1], mass=np.arange(1.0, 21.0), spacing=SPACING, connectivity_radius=0.15,
            boundary_pos=[[0.5, 0.5]], boundary_normal=[[0, 2]], boundary_friction=0.4,
        )  # fmt: skip
    report, stored = imported(tmp_path, tmp_path / "raw", "arrays")
    for k, (trajectory,) in enumerate(stored.values()):
        m = trajectory.metadata
        np.testing.assert_array_equal(trajectory.pos, drift(seed=k))
        assert (m.periodic, m.gravity, m.spacing, m.connectivity_radius) == ((True, True), (0.0, -1.0), SPACING, 0.15)
        np.testing.assert_allclose(trajectory.material_params[1::2, 1], np.linspace(0.1, 1, 20)[1::2], rtol=1e-6)
        np.testing.assert_array_equal(trajectory.mass, np.arange(1.0, 21.0))
        np.testing.assert_array_equal(trajectory.boundary.normal, [[0, 1]])
        assert trajectory.boundary.friction == np.float32(0.4)
    assert report.format == "arrays"


def test_several_parameters_of_a_material(tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    values: dict[str, Any] = {"frame_dt": DT, "materials": "elastomer"}
    ratio = np.linspace(0.1, 0.4, motion().shape[1])
    np.savez(tmp_path / "raw" / "0.npz", pos=motion(seed=0), **values, params_elastomer=1e5, params_elastomer_poisson_ratio=ratio)
    np.savez(tmp_path / "raw" / "1.npz", pos=motion(seed=1), **values, params_elastomer_youngs_modulus=2e5)
    report, stored = imported(tmp_path, tmp_path / "raw", "arrays", holdout=0.0)
    (first,) = stored["train"]
    assert first.metadata.param_names == ("youngs_modulus", "poisson_ratio")
    np.testing.assert_allclose(first.material_params[:, 1], ratio, rtol=1e-6)
    (refusal,) = report.refusals
    assert "has no poisson_ratio of elastomer, which other trajectories have" in str(refusal)
    assert "youngs_modulus 100000 Pa, poisson_ratio 0.1 … 0.4" in report.text()

    report, stored = imported(
        tmp_path / "again",
        tmp_path / "raw",
        "arrays",
        holdout=0.0,
        parameters={"elastomer": {"youngs_modulus": 1.0, "poisson_ratio": 0.25}},
    )
    assert not report.refusals
    np.testing.assert_allclose(stored["train"][1].material_params, np.broadcast_to([2e5, 0.25], first.material_params.shape), rtol=1e-6)
    with pytest.raises(ValueError, match="parameters.elastomer: elastomer has no parameter 'cohesion'"):
        imported(tmp_path / "refused", tmp_path / "raw", "arrays", parameters={"elastomer": {"cohesion": 1.0}})


def test_own_cells_by_kind(tmp_path: Path) -> None:
    values: dict[str, Any] = {"frame_dt": DT, "materials": "elastomer", "params_elastomer": 1e5}
    cells: dict[str, Any] = {"cells_triangle": [[0, 1, 2]], "cells_quadrilateral": [[0, 3, 4, 5], [6, 7, 8, 9]]}
    rest, square = motion(dim=3)[0], [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.1, 0.0], [0.0, 0.1, 0.0]]
    rest[[0, 3, 4, 5]], rest[[6, 7, 8, 9]] = square, square
    values["rest_pos"] = rest
    (tmp_path / "raw").mkdir()
    for k in range(3):
        np.savez(
            tmp_path / "raw" / f"{k}.npz", pos=motion(dim=3, seed=k), **values, **(cells | {"cells": [[0, 1, 2]]} if k == 2 else cells)
        )
    report, stored = imported(tmp_path, tmp_path / "raw", "arrays", holdout=0.0)
    for trajectory in stored["train"]:
        assert trajectory.cells is not None and trajectory.cell_dim == 2
        assert trajectory.cells.tolist() == [[0, 1, 2, 2], [0, 3, 4, 5], [6, 7, 8, 9]]
    (refusal,) = report.refusals
    assert "has cells and cells_triangle; give all of them by kind" in str(refusal)


def write_arrays(folder: Path, seed: int, num_frames: int = 14, gravity: tuple[float, float] = (0.0, 0.0)) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    pos = motion(num_frames=num_frames, seed=seed)
    np.savez(folder / f"{seed}.npz", pos=pos, frame_dt=DT, materials="sand", params_sand=30.0, gravity=gravity)


def test_unseen_splits_and_folders_that_are_none(tmp_path: Path) -> None:
    for seed, split in enumerate(("train", "valid", "test", "test_unseen", "train_more")):
        write_arrays(tmp_path / "raw" / split, seed)
    report, stored = imported(tmp_path, tmp_path / "raw", "arrays")
    assert {split: len(found) for split, found in stored.items()} == {"train": 1, "val": 1, "test": 1, "test_unseen": 1}
    assert any(w.startswith("train_more/ was not read") for w in report.warnings)


def test_files_beside_the_folders_of_splits_are_named(tmp_path: Path) -> None:
    for seed, split in enumerate(("train", "val", "test", ".", ".")):
        write_arrays(tmp_path / "raw" / split, seed)
    (tmp_path / "raw" / "readme.txt").touch()
    report, _ = imported(tmp_path, tmp_path / "raw", "arrays")
    assert "2 files beside train/ were not read, the first is 3.npz: move them into the folder of a split" in report.warnings


@pytest.mark.slow
def test_a_scene_that_is_in_two_splits_stays_in_training(tmp_path: Path) -> None:
    for folder, seeds in {"train": (0, 1, 2), "test": (2, 3), "val": (4,)}.items():
        for seed in seeds:
            write_arrays(tmp_path / "raw" / folder, seed)
    report, stored = imported(tmp_path, tmp_path / "raw", "arrays")
    assert {split: len(trajectories) for split, trajectories in stored.items()} == {"train": 3, "val": 1, "test": 1}
    assert [(refusal.split, refusal.trajectory) for refusal in report.refusals] == [("test", "2.npz")]


def test_two_places_for_one_split_are_refused(tmp_path: Path) -> None:
    for seed, split in enumerate(("train", "val", "valid")):
        write_arrays(tmp_path / "raw" / split, seed)
    with pytest.raises(ImportFailure, match="valid and val are both the split val; move one of them"):
        imported(tmp_path, tmp_path / "raw", "arrays")
    sources.gns_metadata(tmp_path / "gns", motion())
    for name in ("train.tfrecord", "train.h5"):
        (tmp_path / "gns" / name).touch()
    with pytest.raises(ImportFailure, match="train.tfrecord and train.h5 are both the split train"):
        imported(tmp_path, tmp_path / "gns", "gns")


def test_the_report_spans_all_gravities_and_names_what_is_too_short(tmp_path: Path) -> None:
    for seed in range(4):
        write_arrays(tmp_path / "raw" / "train", seed, num_frames=5 if seed == 3 else 14, gravity=(0.0, -1.0 - seed))
    report, _ = imported(tmp_path, tmp_path / "raw", "arrays", holdout=0.0)
    assert report.gravity == [[0.0, 0.0], [-4.0, -1.0]]
    assert "(0, -4 … -1) m/s²" in report.text()
    assert any("3.npz" in w and "has 5 frames" in w for w in report.warnings)


def test_own_arrays_with_as_little_as_possible(tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    for k in range(3):
        np.savez(tmp_path / "raw" / f"{k}.npz", pos=motion(seed=k), frame_dt=DT, materials="sand", boundary_pos=[[0.5, 0.1], [0.6, 0.1]])
    report, stored = imported(tmp_path, tmp_path / "raw", "arrays", parameters={"sand": 35.0})
    (trajectory,) = stored["train"]
    assert_stored(trajectory, motion())
    assert (trajectory.material_params == 35.0).all()
    assert (trajectory.boundary.normal[:, 1] > 0.5).all()
    assert trajectory.metadata.bounds == stored["test"][0].metadata.bounds
    assert any("else the extremes of positions" in note for note in report.notes)


def test_walls_are_at_the_bounds_of_each_file(tmp_path: Path) -> None:
    """The data set has bounds that enclose those of all files."""
    (tmp_path / "raw").mkdir()
    for k, width in enumerate((1.0, 1.0, 2.0)):
        values: dict[str, Any] = {"bounds": [[0, width], [0, 1]], "spacing": SPACING}
        np.savez(tmp_path / "raw" / f"{k}.npz", pos=motion(seed=k), frame_dt=DT, materials="sand", params_sand=30.0, **values)
    _, stored = imported(tmp_path, tmp_path / "raw", "arrays", holdout=0.0, walls={"x_high": 0.5})
    for trajectory, width in zip(stored["train"], (1.0, 1.0, 2.0), strict=True):
        assert trajectory.metadata.bounds[0][1] - trajectory.metadata.bounds[0][0] == pytest.approx(2)
        assert len(trajectory.boundary.pos) and np.ptp(trajectory.boundary.pos[:, 0]) == 0
        assert trajectory.boundary.pos[0, 0] - trajectory.metadata.bounds[0][0] == pytest.approx(width, abs=1e-5)


@pytest.mark.parametrize(
    ("wall", "message"),
    [
        (np.zeros((4, 3)), r"boundary_pos: has shape \[4, 3\], expected \[boundary_node, dim 2\]"),
        (np.full((4, 2), np.nan), "boundary_pos: boundary_node 0 is nan"),
        (np.zeros(4), r"boundary_pos: has shape \[4\]"),
    ],
)
def test_walls_without_normals_are_checked_first(tmp_path: Path, wall: np.ndarray, message: str) -> None:
    (tmp_path / "raw" / "train").mkdir(parents=True)
    pos = np.random.default_rng(0).uniform(size=(12, 9, 2))
    np.savez(tmp_path / "raw" / "train" / "a.npz", pos=pos, frame_dt=0.01, materials="sand", params_sand=30.0, boundary_pos=wall)
    with pytest.raises(ImportFailure, match=message):
        import_dataset(tmp_path, ImportSettings(format="arrays", source=str(tmp_path / "raw")))


def test_half_precision_is_read(tmp_path: Path) -> None:
    pos = np.random.default_rng(0).uniform(size=(5, 9, 2)).astype(np.float16)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        trajectory = Trajectory.from_numpy(pos, 0.01, "sand", {"sand": 30.0})
    np.testing.assert_array_equal(trajectory.pos, pos)
