"""Trajectories that differ from the others of their source are named: unit of length, length, gravity, and bodies that are not rigid."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpe_pl.data.importers import ImportFailure, save_dataset
from gpe_pl.data.importers.report import Report
from gpe_pl.data.importers.trained_parameters import MOST_VALUES, TrainedParameters
from gpe_pl.trajectory.arrays import ArrayError, checked_bodies
from gpe_pl.trajectory.store import iter_trajectories
from gpe_pl.trajectory.trajectory import Termination, Trajectory
from tests.unit.data.importers.test_formats import imported

DT, GRAVITY, NUM_FRAMES, LANDS = 0.01, -9.81, 30, 24
BLOCK = 0.05 * np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), axis=-1).reshape(-1, 2)


def flying(seed: int, **changes: Any) -> dict[str, Any]:
    """Return the arrays of a block that flies and stops in one frame, as an obstacle would stop it."""
    rng = np.random.default_rng(seed)
    time = DT * np.arange(NUM_FRAMES)[:, None, None]
    pos = BLOCK + np.array([0.0, 3.0]) + rng.uniform(-1, 1, 2) * time + np.array([0.0, GRAVITY / 2]) * time**2
    pos[LANDS:] = pos[LANDS - 1]
    return {"pos": pos, "frame_dt": DT, "materials": "solid", "params_solid": 1e6, "gravity": [0.0, GRAVITY], **changes}


def warnings(folder: Path, trajectories: list[dict[str, Any]]) -> list[str]:
    return report(folder, trajectories).warnings


def report(folder: Path, trajectories: list[dict[str, Any]], **settings: Any) -> Report:
    (folder / "raw" / "train").mkdir(parents=True)
    for k, arrays in enumerate(trajectories):
        np.savez(folder / "raw" / "train" / f"{k}.npz", **arrays)
    return imported(folder / "sets", folder / "raw", "arrays", **settings)[0]


@pytest.mark.slow
def test_alike_trajectories_are_not_suspects(tmp_path: Path) -> None:
    assert not warnings(tmp_path, [flying(k) for k in range(6)])


@pytest.mark.slow
def test_another_unit_of_length(tmp_path: Path) -> None:
    said = warnings(tmp_path, [flying(k, **({"pos": 1000 * flying(k)["pos"]} if k == 2 else {})) for k in range(6)])
    assert any(
        w.startswith("train, 2.npz, frame 0: nodes are 50 m from the nearest one, in the median of all trajectories 0.05 m") for w in said
    )


@pytest.mark.slow
def test_a_trajectory_that_was_cut_off(tmp_path: Path) -> None:
    said = warnings(tmp_path, [flying(k, **({"pos": flying(k)["pos"][:26]} if k == 1 else {})) for k in range(6)])
    assert said == ["train, 1.npz: has 26 frames, most trajectories have 30: was it cut off?"]


def test_a_frame_that_was_written_twice(tmp_path: Path) -> None:
    doubled = np.insert(flying(1)["pos"], 15, flying(1)["pos"][14], axis=0)[:NUM_FRAMES]
    said = warnings(tmp_path, [flying(0), flying(1, pos=doubled), *map(flying, range(2, 5))])
    assert said == ["train, 1.npz, frame 15: is equal to frame 14, and nodes move before and after: was it written twice?"]


def test_the_top_of_a_throw_is_no_frame_that_was_written_twice(tmp_path: Path) -> None:
    height = 0.05 - 4.9 * (DT * (np.arange(NUM_FRAMES) - 10.5)) ** 2  # frames 10 and 11 are equal
    said = warnings(tmp_path, [flying(k, pos=BLOCK + np.array([k, 3.0]) + height[:, None, None] * np.array([0.0, 1.0])) for k in range(2)])
    assert not any("written twice" in warning for warning in said)


def test_lengths_that_all_differ_are_no_fault(tmp_path: Path) -> None:
    assert not warnings(tmp_path, [flying(k, pos=flying(k)["pos"][: 30 - k]) for k in range(5)])


@pytest.mark.slow
def test_gravity_with_the_wrong_sign_in_one_trajectory(tmp_path: Path) -> None:
    said = warnings(tmp_path, [flying(k, **({"gravity": [0.0, -GRAVITY]} if k == 1 else {})) for k in range(6)])
    (what,) = said
    assert what.startswith("train, 1.npz: gravity is stored as (0, 9.81) m/s², but 2")
    assert "groups in free flight agree on (0, -9.8" in what


@pytest.mark.slow
def test_a_body_that_pulsates_is_not_rigid(tmp_path: Path) -> None:
    body = np.zeros(36, int)
    sound = [flying(k, rigid_body=body) for k in range(4)]
    swings = 1 + 0.3 * np.sin(np.arange(NUM_FRAMES))[:, None, None]
    pulsating = flying(4, rigid_body=body, pos=flying(4)["pos"] + (swings - 1) * BLOCK)
    found = report(tmp_path / "some", [*sound, pulsating])
    (refusal,) = found.refusals
    assert str(refusal).startswith("train, 4.npz: rigid_body: distances in a body change by 0.")
    with pytest.raises(ImportFailure, match="so it is not rigid; leave rigid_body out"):
        report(tmp_path / "all", [pulsating])
    nearly = flying(4, rigid_body=body, pos=flying(4)["pos"] + 0.02 * (swings - 1) * BLOCK)
    (what,) = warnings(tmp_path / "nearly", [*sound, nearly])
    assert what.startswith("val, 4.npz: distances in a rigid body change by 0.00")


def test_the_same_scene_with_its_nodes_in_another_order_is_there_twice(tmp_path: Path) -> None:
    again = flying(0)
    order = np.random.default_rng(0).permutation(36)
    found = report(tmp_path, [flying(0), flying(1), flying(2), {**again, "pos": again["pos"][:, order]}])
    assert [str(event) for event in found.refusals] == ["train, 3.npz: has exactly the positions of train, 0.npz: the same scene twice"]


def test_the_same_scene_in_another_precision_is_there_twice(tmp_path: Path) -> None:
    again = flying(0)
    found = report(tmp_path, [flying(0), flying(1), flying(2), {**again, "pos": again["pos"].astype(np.float32).astype(np.float64)}])
    assert [str(event) for event in found.refusals] == ["train, 3.npz: has exactly the positions of train, 0.npz: the same scene twice"]


def test_a_wall_along_an_axis_that_data_lack_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ImportFailure, match=r"no training trajectory can be used: train, 0\.npz: has 2 axes, so there is no wall z_low; walls are"
    ):
        report(tmp_path, [flying(0), flying(1), flying(2)], walls={"z_low": 0.5})


@pytest.mark.parametrize("number", [2**31, 2**32, -(2**33)])
def test_numbers_of_bodies_that_do_not_fit_are_refused(number: int) -> None:
    with pytest.raises(ArrayError, match=rf"rigid_body: node 2 is {number}, must be -1 or the number of a body, up to 2147483647"):
        checked_bodies(np.array([0, 0, number]), 3)
    np.testing.assert_array_equal(checked_bodies(np.array([2**31 - 1, -1]), 2), [2**31 - 1, -1])
    np.testing.assert_array_equal(checked_bodies(np.array([3], np.uint8), 1), [3])


@pytest.mark.slow
def test_a_trajectory_of_one_node_has_no_spacing_to_suspect(tmp_path: Path) -> None:
    lonely = {**flying(5), "pos": flying(5)["pos"][:, :1]}
    assert not any("unit of length" in w for w in warnings(tmp_path, [*(flying(k) for k in range(5)), lonely]))


@pytest.mark.slow
def test_wrong_motion_is_noticed_in_late_trajectories_too(tmp_path: Path) -> None:
    time = DT * np.arange(LANDS)[:, None, None]
    fast = flying(9)
    fast["pos"][:LANDS] += np.array([0.0, 1.5 * GRAVITY]) * time**2
    (what,) = [w for w in warnings(tmp_path, [*(flying(k) for k in range(12)), fast]) if "gravity" in w]
    assert ", 12.npz: gravity is stored as (0, -9.81) m/s², but" in what


def liquid(seed: int, viscosity: float = 1e-3, **changes: Any) -> Trajectory:
    arrays = flying(seed)
    return replace(Trajectory.from_numpy(arrays["pos"], DT, "fluid", {"fluid": viscosity}, gravity=(0.0, GRAVITY)), **changes)


@pytest.mark.parametrize(
    ("split", "viscosity", "group", "warning"),
    [
        ("test", 2e-3, "seen", None),
        ("test", 0.5, "seen", "test has values of kinematic_viscosity of fluid outside those of train, and counts as seen"),
        ("test_unseen", 2e-3, "interpolated", None),
        ("test_unseen", 0.5, "extrapolated", None),
        ("test_unseen", 3e-3, "interpolated", "test_unseen has trajectories whose parameters all occur in train, and counts as unseen"),
    ],
)
def test_parameters_that_do_not_belong_into_their_split_are_told(
    tmp_path: Path, split: str, viscosity: float, group: str, warning: str | None
) -> None:
    train = [liquid(k, 1e-3 if k % 2 else 3e-3) for k in range(4)]
    said = save_dataset(tmp_path, "liquids", train=train, val=[liquid(8)], **{split: [liquid(9, viscosity)]}).warnings  # type: ignore[arg-type]
    stored = next(iter_trajectories(tmp_path / "liquids" / "imported", split))
    assert stored.metadata.parameter_group == group
    told = [text for text in said if "occur" in text or "outside those" in text]
    assert told == [] if warning is None else len(told) == 1 and told[0].startswith(warning)


def test_a_material_that_shares_a_parameter_with_a_trained_one_is_told(tmp_path: Path) -> None:
    def body(seed: int, material: str) -> Trajectory:
        return Trajectory.from_numpy(flying(seed)["pos"], DT, material, {material: 1e5}, gravity=(0.0, GRAVITY))

    said = save_dataset(
        tmp_path, "bodies", train=[body(k, "elastomer") for k in range(4)], val=[body(8, "elastomer")], test=[body(9, "solid")]
    )
    assert "solid occurs in test but not in train: no model will know it" in said.warnings


def test_many_values_of_a_parameter_leave_their_range() -> None:
    trained = TrainedParameters()
    for k in range(MOST_VALUES + 10):
        trained.add(replace(liquid(0), material_params=np.full((36, 1), 1e-3 * (k + 1), np.float32)))
    assert len(trained.values["fluid", "kinematic_viscosity"]) == MOST_VALUES
    top = 1e-3 * (MOST_VALUES + 10)
    groups = [[group for *_, group in trained.groups(liquid(0, value))] for value in (1e-3, 0.5 * top, top, 1.001 * top, 0.9e-3)]
    assert groups == [["seen"], ["seen"], ["seen"], ["extrapolated"], ["extrapolated"]]


def test_rollouts_of_models_and_positions_outside_are_refused(tmp_path: Path) -> None:
    train = [liquid(k) for k in range(3)]
    with pytest.raises(ImportFailure, match="is a rollout of a model and no ground truth"):
        save_dataset(tmp_path, "a", train=train, val=[liquid(8, is_prediction=True)])
    low = liquid(8)
    low = replace(low, metadata=replace(low.metadata, bounds=((-9.0, 9.0), (3.0, 9.0))))
    with pytest.raises(ImportFailure, match=r"pos: frame \d+.*: y = \S+ m is outside the bounds 3 … 9 m"):
        save_dataset(tmp_path, "b", train=train, val=[low])
    stopped = liquid(8, termination=Termination("nan", NUM_FRAMES, 0, "node 0 is not finite"))
    said = save_dataset(tmp_path, "c", train=train, val=[stopped]).warnings
    assert any("val[0]: stopped after 30 frames (nan: node 0 is not finite): are its last frames right?" in text for text in said)
