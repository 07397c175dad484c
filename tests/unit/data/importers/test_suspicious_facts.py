"""Facts of own arrays that look wrong or cannot be used are named, with what to do: spacings, walls, objects and names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.data.importers import ImportFailure, ImportSettings, Report, import_dataset, save_dataset
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.store import StoreError, shards
from gpe_pl.trajectory.trajectory import Trajectory

DT, SPACING, NUM_FRAMES = 0.005, 0.05, 30
FLOOR = np.stack([np.arange(-2, 2, SPACING), np.full(80, -0.5)], axis=1)
UP = np.tile([0.0, 1.0], (80, 1))


def pulsating(seed: int, scale: float = 1.0) -> np.ndarray:
    """Return the positions [frame, node, dim] of a block that is thrown and pulsates near y = 0."""
    rng, time = np.random.default_rng(seed), DT * np.arange(NUM_FRAMES)[:, None, None]
    block = scale * SPACING * (np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), axis=-1).reshape(-1, 2) - 2.5)
    return np.asarray(block * (1 + 0.1 * np.sin(rng.uniform(20, 40) * time)) + rng.uniform(-1, 1, 2) * time)


def saved(folder: Path, each: list[dict[str, Any]], scales: tuple[float, ...] = (1.0,) * 4) -> Report:
    trajectories = [
        Trajectory.from_numpy(pulsating(k, scale), DT, "fluid", {"fluid": 1e-3}, **own)
        for k, (own, scale) in enumerate(zip(each, scales, strict=True))
    ]
    return save_dataset(folder, "mine", holdout=0.0, train=trajectories)


def about(report: Report, word: str) -> list[str]:
    return [warning for warning in report.warnings if word in warning]


def test_spacings_and_radii_that_differ(tmp_path: Path) -> None:
    same = saved(tmp_path / "same", [{}] * 4)
    assert not about(same, "is stored for all")
    (what,) = about(saved(tmp_path / "spacing", [{}] * 4, (1.0, 2.0, 1.0, 2.0)), "is stored for all")
    assert what.startswith("spacing is 0.05 … 0.1 m in the trajectories, and 0.075 m is stored for all; choose spacing=…")
    (what,) = about(saved(tmp_path / "given", [{"spacing": s} for s in (0.05, 0.06, 0.05, 0.06)]), "is stored for all")
    assert what.startswith("spacing is 0.05 … 0.06 m")
    (what,) = about(saved(tmp_path / "radius", [{"connectivity_radius": r} for r in (0.075, 0.2, 0.075, 0.2)]), "is stored for all")
    assert what.startswith("connectivity_radius is 0.075 … 0.2 m in the trajectories, and 0.1375 m is stored for all")


def test_a_radius_that_some_trajectories_give_is_that_of_all(tmp_path: Path) -> None:
    report = saved(tmp_path, [{"connectivity_radius": 0.12}, {}, {}, {}])
    assert report.connectivity_radius == 0.12
    assert not about(report, "is stored for all")


def test_walls_that_no_node_sees(tmp_path: Path) -> None:
    near = Boundary.from_numpy(FLOOR + np.array([0.0, 0.3]), UP)
    assert not about(saved(tmp_path / "near", [{"boundary": near}] * 4), "boundary node")
    far = Boundary.from_numpy(FLOOR - np.array([0.0, 5.0]), UP)
    (what,) = about(saved(tmp_path / "far", [{"boundary": far}] * 4), "boundary node")
    assert what.startswith("no node of the first trajectories comes nearer to a boundary node than 5.")
    assert not about(saved(tmp_path / "one_near", [{"boundary": far}] * 3 + [{"boundary": near}]), "boundary node")
    coarse = Boundary.from_numpy(FLOOR[::10] + np.array([0.0, 0.45]), UP[::10])
    (what,) = about(saved(tmp_path / "coarse", [{"boundary": coarse}] * 4), "sample walls")
    assert what.startswith("boundary nodes are 0.5 m from the nearest one (median), farther than the connectivity radius 0.1 m")


def written(folder: Path, **arrays: Any) -> Report:
    (folder / "raw").mkdir(parents=True)
    for k in range(4):
        np.savez(folder / "raw" / f"{k}.npz", **{"pos": pulsating(k), "frame_dt": DT, "materials": "fluid", "params_fluid": 1e-3, **arrays})
    return import_dataset(folder / "sets", ImportSettings("arrays", str(folder / "raw"), name="mine"))


def test_objects_in_own_arrays_are_refused_once_with_what_to_save_instead(tmp_path: Path) -> None:
    with pytest.raises(ImportFailure) as failure:
        written(tmp_path, materials=np.array(["fluid"] * 36, dtype=object))
    message = str(failure.value)
    assert message.count("is an array of Python objects") == 1
    assert "and 3 more alike" in message
    assert "allow_pickle" not in message
    assert "np.array(names, dtype=str)" in message


def test_materials_as_bytes(tmp_path: Path) -> None:
    assert [*written(tmp_path, materials=np.array([b"fluid"] * 36)).materials] == ["fluid"]


def test_whole_numbers_are_named_as_such(tmp_path: Path) -> None:
    trajectories = [
        Trajectory.from_numpy(np.rint(20 * pulsating(k)).astype(int), DT, "fluid", {"fluid": 1e-3}, spacing=1.0) for k in range(4)
    ]
    report = save_dataset(tmp_path, "whole", holdout=0.0, train=trajectories)
    assert not about(report, "float16")
    assert about(report, "in steps of 1 m")


def test_names_that_are_no_material() -> None:
    for name, hint in (("boundary", "give walls as boundary"), ("Fluid", "did you mean 'fluid'?")):
        with pytest.raises(ArrayError) as error:
            Trajectory.from_numpy(pulsating(0), DT, name, {name: 1e-3})
        assert hint in str(error.value)


def test_tensors_that_require_a_gradient() -> None:
    with pytest.raises(ArrayError, match="pos: not an array of numbers"):
        Trajectory.from_numpy(torch.tensor(pulsating(0), requires_grad=True), DT, "fluid", {"fluid": 1e-3})


def test_a_missing_split_of_imported_data_is_not_generated(tmp_path: Path) -> None:
    with pytest.raises(StoreError) as error:
        shards(tmp_path / "imported", "val")
    assert "gpe_pl.simulate" not in str(error.value)


def test_a_source_whose_name_is_no_name_of_a_data_set(tmp_path: Path) -> None:
    with pytest.raises(ImportFailure, match="; pass name=…"):
        import_dataset(tmp_path, ImportSettings("arrays", str(tmp_path / "my data")))


def test_free_groups_that_do_not_fall(tmp_path: Path) -> None:
    report = saved(tmp_path, [{"gravity": [0.0, -9.81]}] * 4)
    assert report.disturbed_groups == report.free_groups > 0
    assert f"{report.free_groups} of them not with gravity" in report.text()


def test_rest_positions_that_are_not_where_the_scene_begins(tmp_path: Path) -> None:
    row = np.arange(36).reshape(6, 6)[:-1, :-1].ravel()
    cells = np.stack([row, row + 1, row + 7, row + 6], axis=1)
    for shift, is_told in ((0.0, False), (3.0, True)):
        each = []
        for k in range(4):
            pos = pulsating(k)
            each.append(Trajectory.from_numpy(pos, DT, "solid", {"solid": 1e5}, cells=cells, rest_pos=pos[0] + shift * (k == 2)))
        report = save_dataset(tmp_path / str(shift), "mine", holdout=0.0, train=each)
        if not is_told:  # nor is there a place of cells that a mesh does not have
            save_dataset(tmp_path / "none", "mine", holdout=0.0, train=[replace(t, cells=t.cells[:0]) for t in each])  # type: ignore[index]
        assert any("is rest_pos in the coordinates of the scene?" in str(event) for event in report.warnings) == is_told
