"""Generation is resumable and reproducible, and refuses to mix data sets."""

import contextlib
import dataclasses
import hashlib
import json
import logging
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from gpe_pl.config.datasets import dataset, dataset_spec
from gpe_pl.config.entry_point import ConfigError
from gpe_pl.data import generation
from gpe_pl.data.generation import discard_damaged, generate, plan, seconds_per_trajectory
from gpe_pl.data.ground_truth import (
    DatasetSpec,
    GenerationError,
    ParameterValues,
    ValueGroups,
    generate_trajectory,
    initial_state,
    named_values,
    parameter_values,
    scene_seed,
)
from gpe_pl.data.validate import validate
from gpe_pl.files.atomic import machine_name
from gpe_pl.files.run_folder import RunError
from gpe_pl.schema import SPLITS
from gpe_pl.solvers.mpm import MPM
from gpe_pl.solvers.scenes import BodyScene
from gpe_pl.system.locks import FolderError
from gpe_pl.system.progress import progress_bar
from gpe_pl.trajectory.store import iter_trajectories, read_trajectory
from tests.runs import compose

DENSITY = {"sand": 1600.0, "snow": 400.0, "elastomer": 1000.0}
SCENE = BodyScene(bounds=((0, 1), (0, 1)), materials=("sand",), grid_spacing=1 / 16, num_particles=40, density=DENSITY)
SAND = {"seen": (20, 30, 40), "interpolated": (25, 35), "extrapolated": (15, 45)}
SOLVER = MPM(bounds=SCENE.bounds, grid_spacing=SCENE.grid_spacing)
SPEC = DatasetSpec(
    name="sand",
    size="smoke",
    parameters={"sand": ParameterValues(seen=(20, 30, 40), interpolated=(25, 35), extrapolated=(15, 45))},
    num_train=5,
    num_val=2,
    num_test=2,
    num_test_unseen=6,
    num_frames=10,
    trajectories_per_shard=2,
    seed=1,
    scene=SCENE,
    solver=SOLVER,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Generate the data set without interruption."""
    return generate(tmp_path_factory.mktemp("data"), SPEC)


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(Path(folder).rglob("*")) if p.is_file()}


@pytest.mark.slow
def test_layout(folder):
    names = set(contents(folder))
    assert {
        "contact_sheet.png",
        "dataset.json",
        "statistics.json",
        "train/shard-00000.h5",
        "train/shard-00002.h5",
        "test_unseen/shard-00002.h5",
    } <= names
    assert len(names) == 3 + 3 + 1 + 1 + 3
    for split, count in SPEC.counts.items():
        trajectories = list(iter_trajectories(folder, split))
        assert len(trajectories) == count
        assert all(t.num_frames == SPEC.num_frames and t.metadata.split == split for t in trajectories)


@pytest.mark.slow
@pytest.mark.parametrize("num_workers", [1, 2])
def test_resume_equals_uninterrupted(folder, tmp_path, num_workers):
    """Lose shards, damage one, leave a half-written file behind: the next run restores the same bytes."""
    again = generate(tmp_path, SPEC, num_workers)
    assert contents(again) == contents(folder)
    (again / "train" / "shard-00001.h5").unlink()
    (again / "statistics.json").unlink()
    damaged = again / "val" / "shard-00000.h5"
    damaged.write_bytes(damaged.read_bytes()[:100])
    half = again / "val" / f".shard-00000.{machine_name()}.{2**30}-00.part.h5"  # of a process that is gone
    half.write_bytes(b"half")
    kept = (again / "train" / "shard-00000.h5").stat().st_mtime_ns
    generate(tmp_path, SPEC, num_workers)
    assert contents(again) == contents(folder) and not half.exists()
    assert (again / "train" / "shard-00000.h5").stat().st_mtime_ns == kept


@pytest.mark.slow
def test_damage_in_place_is_found_and_repaired(folder, tmp_path, caplog):
    """A shard that opens but whose bytes have changed is generated again, with a line in the log; the others are left alone."""
    again = tmp_path / SPEC.name / SPEC.size
    shutil.copytree(folder, again)
    discard_damaged(tmp_path, SPEC)
    assert not caplog.records and contents(again) == contents(folder)
    array, text = again / "train" / "shard-00001.h5", again / "val" / "shard-00000.h5"
    with h5py.File(array) as file:
        place = file["00002/pos"].id.get_chunk_info(0).byte_offset
    for path, where in ((array, place + 40), (text, text.read_bytes().rindex(b'"frame_dt": ') + 15)):
        damaged = bytearray(path.read_bytes())
        damaged[where] ^= 1
        path.write_bytes(damaged)
    generate(tmp_path, SPEC)
    assert contents(again) != contents(folder)  # it opens, and nobody looked inside
    with caplog.at_level(logging.WARNING):
        discard_damaged(tmp_path, SPEC)
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 2 and all(str(path) in "".join(messages) for path in (array, text))
    assert not array.exists() and not text.exists()
    generate(tmp_path, SPEC)
    assert contents(again) == contents(folder)


def test_nothing_of_another_data_set_is_discarded(folder, tmp_path):
    again = tmp_path / SPEC.name / SPEC.size
    shutil.copytree(folder, again)
    shard = again / "train" / "shard-00000.h5"
    shard.write_bytes(b"damaged")
    with pytest.raises(GenerationError, match="seed is 1, now 2"):
        discard_damaged(tmp_path, replace(SPEC, seed=2))
    assert shard.exists()


@pytest.mark.slow
def test_killed_run_resumes(folder, tmp_path):
    """SIGKILL in the middle, then again: the same bytes as an uninterrupted run."""
    script = (
        "import sys, time\n"
        "from gpe_pl.data.generation import generate\n"
        "from tests.unit.data.test_generation import SPEC\n"
        "generate(sys.argv[1], SPEC, 1, lambda done, total: (print(done, flush=True), time.sleep(0.2)))\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(generation.__file__).parents[2])
    assert process.stdout is not None
    for line in process.stdout:
        if int(line) >= 4:
            os.kill(process.pid, signal.SIGKILL)
            break
    process.wait()
    partial = tmp_path / SPEC.name / SPEC.size
    assert process.returncode == -signal.SIGKILL
    assert 0 < len(list(partial.rglob("*.h5"))) < 8 and not (partial / "statistics.json").exists()
    seen = []
    generate(tmp_path, SPEC, on_progress=lambda done, total: seen.append((done, total)))
    assert contents(partial) == contents(folder)
    assert seen[0][0] >= 4 and seen[-1] == (15, 15)


@pytest.mark.long
@pytest.mark.parametrize("data", ["sand", "snow", "elastomer", "fluid", "fem"])
def test_killed_at_random_moments(tmp_path, data):
    """Four times SIGKILL (twenty over the five data sets) of the command with two workers, then to the end: every shard is sound and all bytes are those of
    an uninterrupted run.

    The first comes at a random moment, which mostly is while the contact sheet is drawn; the others after a random number of new shards.
    """
    counts = {"num_train": 12, "num_val": 2, "num_test": 2, "num_test_unseen": 2, "num_frames": 60, "trajectories_per_shard": 2}
    overrides = [f"data={data}", *(f"data.sizes.tiny.{key}={value}" for key, value in counts.items())]
    whole = generate(tmp_path / "whole", dataset_spec(compose("simulate", *overrides)), 2)
    num_shards = len(list(whole.rglob("shard-*.h5")))
    command = [sys.executable, "-m", "gpe_pl.simulate", *overrides, f"paths.data={tmp_path / 'killed'}", "num_workers=2"]
    killed = tmp_path / "killed" / whole.parent.name / whole.name
    rng = np.random.default_rng(list(data.encode()))
    left: list[int] = []  # shards that are there after each kill

    def shards() -> list[Path]:
        return sorted(killed.rglob("shard-*.h5"))

    while len(left) < 4:
        present = shards()
        for k in rng.permutation(len(present))[4:]:  # so that there is something to do
            present[k].unlink()
        goal = int(rng.integers(len(shards()) + 1, num_shards - 2)) if left else 0
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, cwd=Path(generation.__file__).parents[2])
        while process.poll() is None and not (killed.exists() and len(shards()) >= goal):  # imports take longer than the work
            time.sleep(0.01)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(rng.uniform(0.0, 0.1 if left else 4.0))
        if process.poll() is not None:  # it was faster: try again
            assert process.returncode == 0
            continue
        process.kill()
        process.wait()
        left.append(len(shards()))
    assert any(0 < number < num_shards for number in left), left
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=Path(generation.__file__).parents[2])
    assert contents(killed) == contents(whole)
    assert not validate([killed]).violations


@pytest.mark.slow
def test_a_data_set_that_is_deleted_meanwhile_can_be_made_again(tmp_path):
    def delete_once(done, total):
        if done == 2:
            shutil.rmtree(tmp_path / "sand", ignore_errors=True)

    with pytest.raises(FolderError, match="deleted or replaced"):
        generate(tmp_path, SPEC, 1, delete_once)
    assert not list(tmp_path.rglob("shard-*.h5"))
    folder = generate(tmp_path, SPEC)
    assert not validate([folder]).violations


def test_accelerations_that_would_be_rounding_are_refused_before_they_are_stored(tmp_path, caplog):
    """Between frames of 2e-5 s a fall is far below what float32 resolves; between frames of 4e-4 s it is near it, which is said."""
    short = replace(SPEC, solver=replace(SOLVER, frame_dt=2e-5))
    message = (
        r"frame_dt = 2e-05 s: positions in float32 round accelerations by 211 m/s², those of the data are .* rms; choose a longer frame_dt"
    )
    with pytest.raises(GenerationError, match=message):
        generate(tmp_path, short)
    assert not list(tmp_path.iterdir())


def test_jumps_of_nodes_that_enter_are_no_accelerations(tmp_path, monkeypatch):
    """A node that is held in place until it enters at 50 m/s would hide that rounding exceeds all accelerations of those in the scene."""
    truth = generate_trajectory(SPEC, "train", 0)
    still = np.repeat(truth.pos[:1], truth.num_frames, axis=0)
    still[10:, 0, 0] += 50.0 * SOLVER.frame_dt * np.arange(truth.num_frames - 10)
    alive = np.ones(still.shape[:2], bool)
    alive[:10, 0] = False
    gravity = replace(truth.metadata, gravity=(0.0, 0.0))
    monkeypatch.setattr(generation, "generate_trajectory", lambda *_: replace(truth, metadata=gravity, pos=still, alive=alive))
    with pytest.raises(GenerationError, match=r"round accelerations by .* those of the data are 0 m/s² rms"):
        generate(tmp_path, replace(SPEC, solver=replace(SOLVER, frame_dt=2e-5)))


def test_complete_data_set_is_left_alone(folder):
    before = {p: p.stat().st_mtime_ns for p in folder.rglob("*")}
    seen = []
    generate(folder.parents[1], SPEC, on_progress=lambda done, total: seen.append((done, total)))
    assert {p: p.stat().st_mtime_ns for p in folder.rglob("*")} == before
    assert seen == [(15, 15)]


def test_other_spec_is_refused_by_key(folder):
    other = replace(SPEC, seed=2, solver=replace(SOLVER, cfl=0.4))
    with pytest.raises(GenerationError, match=r"seed is 1, now 2; solver\.cfl is 0\.5, now 0\.4") as error:
        generate(folder.parents[1], other)
    assert "Delete the folder" in str(error.value)


@pytest.mark.slow
def test_data_of_another_version_of_the_solver_are_refused(tmp_path):
    """The error names the version, although settings differ, too. The time step is compared as well."""
    few = replace(SPEC, num_train=1, num_val=0, num_test=0, num_test_unseen=0, num_frames=3)
    made = generate(tmp_path, few) / "dataset.json"
    values = json.loads(made.read_text())
    assert values["spec"]["solver"]["solver_dt"] == SOLVER.solver_dt
    values["spec"]["solver"]["solver_dt"] /= 2
    made.write_text(json.dumps(values))
    with pytest.raises(GenerationError, match=r"solver\.solver_dt is .*, now .*Delete the folder"):
        generate(tmp_path, few)
    values["spec"]["solver"] |= {"version": "1", "cfl": 0.1}
    made.write_text(json.dumps(values))
    with pytest.raises(
        GenerationError, match=rf"holds data of version 1 of the solver mpm; this is version {SOLVER.version}, .*Delete the folder"
    ):
        generate(tmp_path, few)


@pytest.mark.slow
def test_what_the_solver_does_not_resolve_is_said(tmp_path, caplog):
    """Viscosities below the grid's own; where data are complete, nothing is said again."""
    spec = replace(dataset("data=fluid", "dimension=2", "size=tiny"), num_train=1, num_val=0, num_test=0, num_test_unseen=0, num_frames=3)
    generate(tmp_path, spec)
    (said,) = (record.message for record in caplog.records if record.levelname == "WARNING")
    assert "kinematic_viscosity = 0.001, 0.0015, 0.002 m^2/s is below 0.00214 m^2/s" in said
    caplog.clear()
    generate(tmp_path, spec)
    assert not caplog.records


def test_folder_with_foreign_shards_is_refused(tmp_path):
    shard = tmp_path / "sand" / "smoke" / "train" / "shard-00000.h5"
    shard.parent.mkdir(parents=True)
    shard.write_bytes(b"")
    with pytest.raises(GenerationError, match=r"holds shards but no dataset\.json"):
        generate(tmp_path, SPEC)


@pytest.mark.parametrize("split", ["train", "test_unseen"])
def test_nothing_is_written_through_a_link_in_the_folder(tmp_path, split):
    elsewhere, own = tmp_path / "elsewhere", tmp_path / "data" / SPEC.name / SPEC.size
    elsewhere.mkdir()
    own.mkdir(parents=True)
    (own / split).symlink_to(elsewhere)
    with pytest.raises(RunError, match=f"{split}: a link that leads out of its folder; remove it"):
        generate(tmp_path / "data", SPEC)
    assert not list(elsewhere.iterdir())


def test_the_folder_itself_may_be_a_link(folder, tmp_path):
    own = tmp_path / SPEC.name / SPEC.size
    own.parent.mkdir()
    own.symlink_to(folder)
    assert generate(tmp_path, SPEC) == own


@dataclasses.dataclass(frozen=True)
class SceneOfAFile:
    """The scene above, declaring a dependence on a file."""

    path: str

    @property
    def input_files(self) -> dict[str, str]:
        return {"terrain": self.path}

    def __getattr__(self, name):
        return getattr(SCENE, name)


def test_input_files_are_hashed_and_must_exist(tmp_path):
    terrain = tmp_path / "valley.obj"
    terrain.write_text("v 0 0 0")
    spec = replace(SPEC, scene=SceneOfAFile(str(terrain)))
    before = spec.as_dict()
    assert before["input_files"] == {str(terrain): hashlib.sha256(b"v 0 0 0").hexdigest()}
    terrain.write_text("v 0 0 1")
    assert spec.as_dict()["input_files"] != before["input_files"]
    terrain.unlink()
    with pytest.raises(ValueError, match=rf"scene\.terrain = {terrain}: No such file"):
        replace(SPEC, scene=SceneOfAFile(str(terrain)))


def test_trajectory_is_a_pure_function(folder):
    stored = read_trajectory(folder / "train" / "shard-00001.h5", "00003", verify=True)
    again = generate_trajectory(SPEC, "train", 3)
    np.testing.assert_array_equal(stored.pos, again.pos.astype(np.float32))
    assert stored.metadata == again.metadata and stored.metadata.seed == scene_seed(SPEC, "train", 3)


def test_seeds_differ():
    seeds = [scene_seed(replace(SPEC, seed=s), split, i) for s in range(3) for split in SPLITS for i in range(50)]
    assert len(set(seeds)) == len(seeds)


def test_parameter_groups_are_marked(folder):
    groups: dict[str, list[float]] = {}
    for trajectory in iter_trajectories(folder, "test_unseen"):
        groups.setdefault(trajectory.metadata.parameter_group, []).append(float(trajectory.material_params[0, 0]))
    assert groups == {"interpolated": [25.0, 35.0, 25.0], "extrapolated": [15.0, 45.0, 15.0]}
    for split in ("train", "val", "test"):
        for trajectory in iter_trajectories(folder, split):
            assert trajectory.metadata.parameter_group == "seen" and trajectory.material_params[0, 0] in SPEC.parameters["sand"].seen
    assert [parameter_values(SPEC, "train", i)[0]["sand"]["friction_angle"] for i in range(4)] == [20, 30, 40, 20]


def test_parameters_of_several_materials_are_dealt_independently():
    scene = replace(SCENE, materials=("sand", "snow"))
    parameters = {"sand": ParameterValues(seen=(20, 30, 40)), "snow": ParameterValues(seen=(5, 8, 11))}
    solver = replace(SOLVER, materials=scene.materials)
    spec = replace(SPEC, scene=scene, solver=solver, parameters=parameters, num_test_unseen=0)
    dealt = [{m: v for m, own in parameter_values(spec, "train", i)[0].items() for v in own.values()} for i in range(300)]
    assert {(v["sand"], v["snow"]) for v in dealt} == {(a, b) for a in (20, 30, 40) for b in (5, 8, 11)}
    assert abs(np.corrcoef([v["sand"] for v in dealt], [v["snow"] for v in dealt])[0, 1]) < 0.15
    for material in ("sand", "snow"):  # every round has every value once
        assert all(len({v[material] for v in dealt[k : k + 3]}) == 3 for k in range(0, 300, 3))


def further(**values):
    """Return the specification with values of the cohesion [Pa]."""
    sand = replace(SPEC.parameters["sand"], further={"cohesion": ValueGroups(**values)})
    return replace(SPEC, parameters={"sand": sand})


def test_several_parameters_of_a_material_are_dealt_independently():
    spec = further(seen=(0, 500, 1000), interpolated=(700,))
    assert spec.param_names == ("friction_angle", "cohesion")
    dealt = [parameter_values(spec, "train", i)[0]["sand"] for i in range(300)]
    assert [v["friction_angle"] for v in dealt[:4]] == [20, 30, 40, 20]
    assert {tuple(v.values()) for v in dealt} == {(a, c) for a in (20, 30, 40) for c in (0, 500, 1000)}
    assert abs(np.corrcoef([v["friction_angle"] for v in dealt], [v["cohesion"] for v in dealt])[0, 1]) < 0.15
    for k in range(0, 300, 3):  # each round is a Latin hypercube
        assert {v["cohesion"] for v in dealt[k : k + 3]} == {0, 500, 1000}
    interpolated, extrapolated = (parameter_values(spec, "test_unseen", i) for i in range(2))
    assert interpolated == ({"sand": {"friction_angle": 25, "cohesion": 700}}, "interpolated")
    assert extrapolated[1] == "extrapolated"
    assert extrapolated[0]["sand"]["friction_angle"] == 15 and extrapolated[0]["sand"]["cohesion"] in (0, 500, 1000)


def test_a_trajectory_stores_all_parameters_of_its_material():
    spec = further(seen=(500,), interpolated=(), extrapolated=())
    stored = generate_trajectory(spec, "train", 1, num_frames=3)
    assert stored.metadata.param_names == ("friction_angle", "cohesion")
    np.testing.assert_array_equal(stored.material_params, np.broadcast_to([30.0, 500.0], (40, 2)))
    other = generate_trajectory(spec, "train", 1, {"sand": {"friction_angle": 30.0, "cohesion": 0.0}}, num_frames=3)
    assert (other.material_params[:, 1] == 0).all()
    for values, message in (
        ({"sand": 30.0}, "values of sand are friction_angle; the data set stores friction_angle, cohesion"),
        ({"sand": {"friction_angle": 30.0, "density": 1.0}}, "sand has no parameter 'density'"),
        ({}, "values: sand is missing"),
    ):
        with pytest.raises(GenerationError if values else ValueError, match=message):
            initial_state(spec, "train", 1, values) if values else named_values(spec, values)


def test_the_specification_of_one_parameter_is_as_before():
    """Data sets that were generated before are found again, by the checksum of their specification."""
    assert SPEC.as_dict()["parameters"] == {"sand": {"seen": [20, 30, 40], "interpolated": [25, 35], "extrapolated": [15, 45]}}
    assert further(seen=(0, 500)).as_dict()["parameters"]["sand"]["further"]["cohesion"]["seen"] == [0, 500]


def test_statistics_are_of_the_train_split(folder):
    dt, gravity = SPEC.solver.frame_dt, np.array(SCENE.gravity)
    vel, acc, params = [], [], []
    for t in iter_trajectories(folder, "train"):
        v = np.diff(t.pos.astype(np.float64), axis=0) / dt
        vel.append(v.ravel())
        acc.append((np.diff(v, axis=0) / dt - gravity).ravel())
        params.append(t.material_params.astype(np.float64).ravel())
    statistics = json.loads((folder / "statistics.json").read_text())
    assert statistics["velocity_std"] == pytest.approx(np.sqrt(np.mean(np.concatenate(vel) ** 2)))
    assert statistics["acceleration_std"] == pytest.approx(np.sqrt(np.mean(np.concatenate(acc) ** 2)))
    angle = statistics["material_params"]["friction_angle"]
    assert angle["mean"] == pytest.approx(np.mean(np.concatenate(params)))
    assert angle["std"] == pytest.approx(np.std(np.concatenate(params)))
    assert (statistics["num_trajectories"], statistics["num_frames"], statistics["num_nodes"]) == (5, 50, 200)


@pytest.mark.parametrize("num_workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_failure_names_split_index_and_seed(tmp_path, num_workers):
    spec = replace(SPEC, solver=replace(SOLVER, max_substeps=1))
    with pytest.raises(GenerationError, match=r"split train, index \d, seed \d+: explosion: frame 1") as error:
        generate(tmp_path, spec, num_workers)
    assert (error.value.split, error.value.seed) == ("train", scene_seed(spec, "train", error.value.index))
    assert not list(tmp_path.rglob("*.h5")) and not list(tmp_path.rglob("*.part*"))


@pytest.mark.slow
def test_small_disk_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(GenerationError, match="GiB free"):
        generate(tmp_path, replace(SPEC, num_frames=10**6, num_train=10**4))
    assert not list(tmp_path.rglob("*.h5"))


@pytest.mark.parametrize("materials", [("sand",), ("sand", "snow", "elastomer")])
def test_sheet_shows_the_first_scene_with_all_materials(monkeypatch, materials):
    """The search is short: with one material it looks at no scene, else it stops at the first scene with all materials."""
    scene = replace(SCENE, materials=materials, max_bodies=3)
    values = {"sand": (20.0, 30.0), "snow": (5.0, 8.0), "elastomer": (5e4, 1e5)}
    parameters = {m: ParameterValues(seen=values[m]) for m in materials}
    spec = replace(SPEC, scene=scene, solver=replace(SOLVER, materials=materials), parameters=parameters, num_train=40, num_test_unseen=0)
    number = [len(np.unique(generation.initial_state(spec, "train", i).node_type)) for i in range(20)]
    expected, sampled = number.index(len(materials)), []

    def spy(spec, split, index):
        sampled.append(index)
        return initial_state(spec, split, index)

    monkeypatch.setattr(generation, "initial_state", spy)
    assert generation._most_varied_scene(spec) == expected
    assert sampled == ([] if len(materials) == 1 else list(range(expected + 1)))


def test_disk_estimate_is_near_the_truth(folder):
    written = sum(p.stat().st_size for p in folder.rglob("*.h5")) / sum(SPEC.counts.values())
    assert 0.7 * written < generation._bytes_per_trajectory(SPEC) < 2 * written


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": {"sand": {"seen": ()}}}, "seen"),
        ({"parameters": {"sand": {"seen": (20, 90)}}}, "parameters.sand.seen: friction_angle = 90.0 deg is outside"),
        ({"parameters": {"sand": {"seen": (20, 40), "interpolated": (50,)}}}, "inside"),
        ({"parameters": {"sand": {"seen": (20, 40), "extrapolated": (30.5,)}}}, "outside the range"),
        ({"parameters": {"sand": {"seen": (20, 30, 40), "interpolated": (30,)}}}, "among the seen ones"),
        ({"parameters": {"sand": {"seen": (20,), "extrapolated": (30,)}}}, "needs parameters.sand.interpolated"),
        ({"parameters": {"snow": {"seen": (20,)}}}, "parameters are for snow, the scene has sand"),
        (
            {"parameters": {"sand": SAND | {"further": {"density": {"seen": (1,)}}}}},
            "parameters.sand.further: sand has no parameter 'density'",
        ),
        (
            {"parameters": {"sand": SAND | {"further": {"cohesion": {"seen": (0, 1e6)}}}}},
            "parameters.sand.further.cohesion.seen: cohesion = 1000000.0",
        ),
        (
            {"parameters": {"sand": SAND | {"further": {"cohesion": {"seen": (0, 9), "interpolated": (10,)}}}}},
            "(?s)further.cohesion.*inside",
        ),
        (
            {"parameters": {"sand": SAND | {"further": {"friction_angle": {"seen": (20,)}}}}},
            "is the first parameter; give its values as parameters.sand.seen",
        ),
        ({"num_train": 0}, "num_train"),
        ({"name": "../evil"}, "name"),
        ({"solver": MPM(bounds=SCENE.bounds, grid_spacing=1 / 32)}, "scene.grid_spacing"),
    ],
)
def test_invalid_spec_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(SPEC, **change)


@pytest.mark.slow
def test_parts_share_the_work_and_give_the_same_bytes(folder, tmp_path):
    first = generate(tmp_path, SPEC, part=(0, 2))
    assert 0 < len(list(first.rglob("*.h5"))) < 8 and not (first / "statistics.json").exists()
    generate(tmp_path, SPEC, part=(1, 2))
    assert contents(first) == contents(folder)


def test_plan_counts_what_is_missing(folder, tmp_path):
    nothing = plan(tmp_path / "new", SPEC)
    assert nothing.missing == tuple(generation._shards(SPEC)) and nothing.fits
    assert (nothing.num_done, nothing.num_missing) == (0, 15) and nothing.bytes_needed == generation.dataset_bytes(SPEC)
    parts = [plan(tmp_path / "new", SPEC, (k, 3)) for k in range(3)]
    assert sorted(shard for p in parts for shard in p.missing) == sorted(nothing.missing)
    assert sum(p.num_missing for p in parts) == 15 and sum(p.bytes_needed for p in parts) == nothing.bytes_needed
    complete = plan(folder.parents[1], SPEC)
    assert (complete.missing, complete.num_done, complete.num_missing, complete.bytes_needed) == ((), 15, 0, 0)
    assert seconds_per_trajectory(SPEC, budget=0.01) > 0


def fraction_settled(trajectory, time):
    """Return the fraction of particles whose velocity differs from initial free flight by more than 0.1 m/s at ``time`` [s]."""
    frame = math.ceil(time / trajectory.metadata.frame_dt)
    elapsed = np.arange(frame + 1)[:, None, None] * trajectory.metadata.frame_dt
    ballistic = trajectory.vel[0] + elapsed * np.array(trajectory.metadata.gravity)
    return float(np.mean(np.any(np.linalg.norm(trajectory.vel[: frame + 1] - ballistic, axis=-1) > 0.1, axis=0)))


@pytest.mark.slow
def test_contact_is_not_rare():
    """By frame 50 most particles of the configured scenes have met a wall, an obstacle or others: half on average, and half in 90 % of the scenes."""
    spec = dataset_spec(compose("simulate", "size=small"))
    short = replace(spec, num_frames=52)
    time = 50 * spec.solver.frame_dt
    fractions = np.array([fraction_settled(generate_trajectory(short, "test", i), time) for i in range(spec.num_test)])
    assert fractions.mean() >= 0.5 and np.mean(fractions >= 0.5) >= 0.9, fractions


def test_start_is_free_flight():
    """The measure above is 0 while nothing touches, so it cannot pass by accident."""
    state_dt = SPEC.solver.frame_dt
    trajectories = [generate_trajectory(SPEC, "train", i) for i in range(5)]
    assert min(fraction_settled(t, 2 * state_dt) for t in trajectories) == 0.0


def test_progress_bar_reports(folder, capsys):
    with progress_bar("sand") as progress:
        progress(3, 4)
    assert "3/4" in capsys.readouterr().out


@pytest.mark.parametrize("content", [b"{", b"5", b"\xa1\xff", b'{"spec'])
def test_a_damaged_description_is_named(folder, tmp_path, content):
    again = tmp_path / "sand" / "smoke"
    shutil.copytree(folder, again)
    (again / "dataset.json").write_bytes(content)
    with pytest.raises(GenerationError, match=r"dataset.json: unreadable.*; delete the folder"):
        generate(tmp_path, SPEC, 1)


def test_a_description_whose_checksum_is_another_is_named(folder, tmp_path):
    again = tmp_path / "sand" / "smoke"
    shutil.copytree(folder, again)
    path = again / "dataset.json"
    stored = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**stored, "sha256": "0" * 64}), encoding="utf-8")
    with pytest.raises(
        GenerationError, match=r"dataset.json: was changed or damaged since it was written \(checksum mismatch\); delete the folder"
    ):
        generate(tmp_path, SPEC, 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["num_train", "num_val", "num_test", "num_test_unseen", "num_frames"])
def test_numbers_that_no_machine_can_list_are_refused(name):
    with pytest.raises(ConfigError, match=rf"data.{name}.*1000000"):
        dataset_spec(compose("simulate", "data=sand", "size=tiny", f"data.{name}={10**30}"))
