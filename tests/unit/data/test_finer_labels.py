"""Data sets of tracers of a finer solver: stored, resumed, validated and used like plain ones."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from gpe_pl.benchmarks.parameter_effect import scene_changes
from gpe_pl.config.datasets import dataset, dataset_spec
from gpe_pl.config.entry_point import ConfigError
from gpe_pl.data.control_runs import HIGHEST, LOWEST, NEAREST, ControlRuns, TrainedValues
from gpe_pl.data.generation import generate
from gpe_pl.data.ground_truth import DatasetSpec, GenerationError, generate_trajectory, initial_state
from gpe_pl.data.validate import validate
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.trajectory.store import iter_trajectories, read_trajectory, write_shard
from tests.runs import compose

SMALL = [
    "size=tiny",
    "data.num_train=2",
    "data.num_val=1",
    "data.num_test=0",
    "data.num_test_unseen=2",
    "data.num_frames=8",
    "data.trajectories_per_shard=1",
    "data.scene.num_particles=40",
]


@pytest.fixture(scope="module")
def spec() -> DatasetSpec:
    return dataset("data=sand", *SMALL, "data.fine=2")


@pytest.fixture(scope="module")
def folder(spec: DatasetSpec, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generate(tmp_path_factory.mktemp("data"), spec)


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.slow
def test_stored_tracers_begin_as_the_plain_scene(spec: DatasetSpec, folder: Path) -> None:
    plain = dataset("data=sand", *SMALL)
    assert (spec.name, plain.name) == ("sand_fine2", "sand")
    for index, stored in enumerate(iter_trajectories(folder, "train")):
        start = initial_state(plain, "train", index)
        np.testing.assert_array_equal(stored.pos[0], start.pos.astype(np.float32))
        np.testing.assert_array_equal(stored.vel[0], start.vel.astype(np.float32))
        np.testing.assert_array_equal(stored.mass, start.mass.astype(stored.mass.dtype))
        np.testing.assert_array_equal(stored.boundary.pos, start.boundary.pos.astype(np.float32))
        coarse = generate_trajectory(plain, "train", index)
        assert 1e-6 < np.abs(stored.pos[-1] - coarse.pos[-1]).max() < 0.1 * plain.scene.spacing * stored.num_frames
        assert stored.metadata.spacing == plain.scene.spacing and stored.metadata.solver_dt < plain.solver.solver_dt


@pytest.mark.slow
def test_an_interrupted_data_set_resumes_with_the_same_bytes(spec: DatasetSpec, folder: Path, tmp_path: Path) -> None:
    again = generate(tmp_path, spec)
    (again / "train" / "shard-00001.h5").unlink()
    reported: list[tuple[int, int]] = []
    generate(tmp_path, spec, on_progress=lambda done, total: reported.append((done, total)))
    assert files(again) == files(folder) and reported[0] == (4, 5) and reported[-1] == (5, 5)


def test_provenance_names_the_factor_and_the_finer_solver(spec: DatasetSpec, folder: Path) -> None:
    stored = json.loads((folder / "dataset.json").read_text())["spec"]
    assert stored["fine"] == 2
    assert stored["fine_solver"]["grid_spacing"] == stored["solver"]["grid_spacing"] / 2
    assert stored["fine_solver"]["spacing"] == spec.scene.spacing / 2
    config = json.loads(next(iter_trajectories(folder, "val")).metadata.config)
    assert (config["fine"], config["fine_solver"]) == (2, stored["fine_solver"])


def test_plain_data_are_specified_as_before() -> None:
    """Their files say nothing of finer labels, so stored data sets stay valid."""
    plain = dataset("data=sand", *SMALL)
    assert "fine" not in plain.as_dict() and set(plain.provenance) == {"scene", "solver"}
    assert plain.label_solver is plain.solver


def test_validation_checks_the_provenance(folder: Path, tmp_path: Path) -> None:
    found = validate([folder])
    assert not found.violations
    assert "moved by parts of particles that are not stored" in str(found.groups["sand_fine2", "train"])
    good = read_trajectory(folder / "val" / "shard-00000.h5", "00000")

    def messages(*trajectories: Any) -> list[str]:
        write_shard(tmp_path / "shard-00000.h5", trajectories)
        return [f"{v.field}: {v.message}" for v in validate([tmp_path]).violations if v.field == "config"]

    def changed(**values: Any) -> Any:
        settings = json.loads(good.metadata.config)
        for key, value in values.items():
            part, _, inner = key.partition("__")
            if inner:
                settings[part][inner] = value
            else:
                settings[part] = value
        return replace(good, metadata=replace(good.metadata, config=json.dumps({k: v for k, v in settings.items() if v is not None})))

    assert messages(good) == []
    assert messages(changed(fine=3)) == ["config: fine is 3, must be one of 2, 4"]
    assert messages(changed(fine=None)) == ["config: fine is None, must be one of 2, 4"]
    assert messages(changed(fine_solver=None)) == [
        "config: fine is 2, but fine_solver, the settings of the finer solver, is missing",
    ]
    assert messages(changed(fine=4)) == [
        "config: fine_solver.spacing is 0.010416666666666666, but fine = 4 and the metadata say 0.00520833"
    ]
    assert "config: fine_solver.solver_dt is 1, but" in messages(changed(fine_solver__solver_dt=1))[0]
    plain = replace(changed(fine=None, fine_solver=None), vel=2 * good.vel)
    assert any("config: fine is 1, but 2 in" in text for text in messages(good, plain))


def test_other_settings_are_refused_in_the_same_folder(spec: DatasetSpec, folder: Path) -> None:
    other = replace(spec, fine=4)
    with pytest.raises(GenerationError, match="fine is 2, now 4"):
        generate(folder.parents[1], other)


@pytest.mark.slow
@pytest.mark.parametrize("value", ["0", "1.5", "3", "-2", "two", "null"])
def test_other_factors_are_refused(value: str) -> None:
    with pytest.raises(ConfigError, match=r"data\.fine.*1, 2 or 4"):
        dataset_spec(compose("simulate", "data=sand", "size=tiny", f"data.fine={value}"))


def test_meshes_of_quadrilaterals_are_refused() -> None:
    quads = dataset("data=fem", "size=tiny", "data.scene.cell=quad", "data.fine=2")
    with pytest.raises(
        GenerationError, match=r"only meshes of triangles in 2D and of tetrahedra in 3D can be divided; choose data\.scene\.cell"
    ):
        generate_trajectory(quads, "train", 0, num_frames=3)


def test_imported_data_have_no_finer_labels() -> None:
    with pytest.raises(ConfigError, match=r"data\.fine: unknown key 'fine'"):
        from gpe_pl.config.entry_point import compose as composed

        composed("fit", ["data=imported", "data.name=own", "data.fine=2"])


@dataclass(frozen=True)
class Coarse(Ballistic):
    """A solver without a method ``finer``."""

    frame_dt: float = 0.005
    bounds: tuple[tuple[float, float], ...] = ((0.0, 1.0), (0.0, 1.0))
    materials: tuple[str, ...] = ("sand",)
    solver_dt: float = 0.005
    grid_spacing: float = 1 / 48
    name: ClassVar[str] = "coarse"
    version: ClassVar[str] = "1"
    stores_stress: ClassVar[bool] = False

    def compile_kernels(self) -> None:
        pass


def test_solvers_that_cannot_be_refined_are_refused(spec: DatasetSpec) -> None:
    solver: Any = Coarse(0.005)
    assert replace(spec, solver=solver, fine=1).label_solver is solver
    with pytest.raises(ValueError, match="fine = 2: the solver coarse has no solution at a finer spacing"):
        replace(spec, solver=solver)


def test_controls_branch_off_the_tracers(spec: DatasetSpec, folder: Path, tmp_path: Path) -> None:
    truth = generate_trajectory(spec, "test_unseen", 0).frames(3)
    runs = ControlRuns(tmp_path / "sand" / "tiny", spec, TrainedValues(spec), "test_unseen", 3)
    runs.generate([0])
    run = runs.read(0)
    assert {*run} == {NEAREST, LOWEST, HIGHEST}
    assert run[LOWEST].pos[0].tobytes() == truth.pos[0].astype(np.float32).tobytes()
    assert np.abs(run[LOWEST].pos[-1] - run[HIGHEST].pos[-1]).max() >= 0


@pytest.mark.slow
def test_effects_of_parameters_are_those_of_the_finer_solver() -> None:
    spec = dataset("data=elastomer", "size=tiny", "data.num_frames=40", "data.fine=2")
    changes = scene_changes(spec, 0)
    assert 0 < changes["half_step"][-1] < changes["range"][-1]
    assert changes["range"] != scene_changes(replace(spec, fine=1), 0)["range"]
