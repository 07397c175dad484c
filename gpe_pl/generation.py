"""Parallel, resumable generation of data sets.

Every trajectory is a pure function of ``(spec, split, index)`` and every shard appears atomically, so a run that was killed resumes where it stopped and
leaves the same bytes as one that was not. Layout::

    {root}/{name}/{size}/dataset.json            the spec and its hash, written first
    {root}/{name}/{size}/{split}/shard-00000.h5
    {root}/{name}/{size}/statistics.json         of the train split, written last
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import multiprocessing
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from gpe_pl import integrators
from gpe_pl.errors import GpeError
from gpe_pl.rollout import Guard, rollout
from gpe_pl.schema import MATERIALS, SPLITS, ParameterGroup
from gpe_pl.solvers import mpm
from gpe_pl.solvers.mpm import MPM
from gpe_pl.solvers.scenes import SceneConfig, describe, sample_scene
from gpe_pl.trajectory import Metadata, StoreError, Trajectory, read_trajectory, trajectory_names, write_shard

SPEC_FILE = "dataset.json"
STATISTICS_FILE = "statistics.json"

Count = Annotated[int, Field(ge=0)]
PathPart = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
Progress = Callable[[int, int], Any]
"""Called with the number of trajectories that are done and their total."""


class GenerationError(GpeError):
    """Data could not be generated. Names split, index and seed of the trajectory that failed, where there is one."""

    def __init__(self, message: str, split: str = "", index: int = -1, seed: int = -1) -> None:
        super().__init__(message)
        self.split, self.index, self.seed = split, index, seed

    def __reduce__(self) -> tuple[Any, ...]:  # crosses process boundaries
        return type(self), (str(self), self.split, self.index, self.seed)


@dataclass(frozen=True, config={"extra": "forbid"})
class DatasetSpec:
    """Everything that determines the bytes of a data set.

    Attributes:
        name, size: folder names.
        material: of all particles.
        seen_values: values of its material parameter in ``train``, ``val`` and ``test``, dealt in turn.
        interpolated_values, extrapolated_values: values of even and of odd trajectories of ``test_unseen``.
        num_train, num_val, num_test, num_test_unseen: trajectories per split.
        num_frames: stored frames per trajectory, the initial one included.
        trajectories_per_shard: the unit of work and of resuming.
        seed: of the data set.
        scene: distribution of scenes.
        solver: what simulates them.
    """

    name: PathPart
    size: PathPart
    material: str
    seen_values: Annotated[tuple[float, ...], Field(min_length=1)]
    scene: SceneConfig
    solver: MPM
    num_train: Annotated[int, Field(ge=1)]
    num_frames: Annotated[int, Field(ge=3)]
    interpolated_values: tuple[float, ...] = ()
    extrapolated_values: tuple[float, ...] = ()
    num_val: Count = 0
    num_test: Count = 0
    num_test_unseen: Count = 0
    trajectories_per_shard: Annotated[int, Field(ge=1)] = 8
    seed: Annotated[int, Field(ge=0)] = 0

    def __post_init__(self) -> None:
        scene, solver = asdict(self.scene), asdict(self.solver)  # type: ignore[call-overload]
        for key in sorted(scene.keys() & solver.keys()):
            if scene[key] != solver[key]:
                raise ValueError(f"scene.{key} = {scene[key]} and solver.{key} = {solver[key]} must be equal")
        if tuple(self.solver.materials) != (self.material,):
            raise ValueError(f"solver.materials = {self.solver.materials} must be ({self.material!r},)")
        parameter = MATERIALS[self.material]
        for key in ("seen_values", "interpolated_values", "extrapolated_values"):
            for value in getattr(self, key):
                if not parameter.low <= value <= parameter.high:
                    raise ValueError(
                        f"{key}: {parameter.name} = {value} is outside [{parameter.low:g}, {parameter.high:g}] {parameter.unit}"
                    )
        unseen = {*self.interpolated_values, *self.extrapolated_values}
        if unseen & set(self.seen_values):
            raise ValueError(f"unseen values {sorted(unseen & set(self.seen_values))} are among seen_values")
        low, high = min(self.seen_values), max(self.seen_values)
        if any(not low < v < high for v in self.interpolated_values) or any(low <= v <= high for v in self.extrapolated_values):
            raise ValueError(
                f"interpolated_values must lie inside and extrapolated_values outside the range [{low}, {high}] of seen_values"
            )
        if self.num_test_unseen and not (self.interpolated_values and self.extrapolated_values):
            raise ValueError("num_test_unseen > 0 needs interpolated_values and extrapolated_values")

    @property
    def counts(self) -> dict[str, int]:
        """Trajectories per split."""
        return dict(zip(SPLITS, (self.num_train, self.num_val, self.num_test, self.num_test_unseen), strict=True))

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON values; includes the solver's name and version, on which the bytes depend too."""
        values = asdict(self)  # type: ignore[call-overload]
        values["solver"] |= {"name": self.solver.name, "version": self.solver.version}
        return json.loads(json.dumps(values))


# --- one trajectory ------------------------------------------------------------------------------------------------------------------------


def scene_seed(spec: DatasetSpec, split: str, index: int) -> int:
    """Seed of one scene: different for every data set seed, split and index."""
    words = np.random.SeedSequence((spec.seed, SPLITS.index(split), index)).generate_state(2, np.uint32)
    return int(words[0]) << 32 | int(words[1])


def parameter_value(spec: DatasetSpec, split: str, index: int) -> tuple[float, ParameterGroup]:
    """Value of the material parameter of one trajectory and the group that it belongs to."""
    if split != "test_unseen":
        return spec.seen_values[index % len(spec.seen_values)], "seen"
    if index % 2 == 0:
        return spec.interpolated_values[index // 2 % len(spec.interpolated_values)], "interpolated"
    return spec.extrapolated_values[index // 2 % len(spec.extrapolated_values)], "extrapolated"


def trajectory_metadata(spec: DatasetSpec, split: str, index: int) -> Metadata:
    """Metadata of one trajectory."""
    values = spec.as_dict()
    return describe(
        spec.scene,
        spec.material,
        spec.solver.frame_dt,
        dataset=spec.name,
        solver_dt=spec.solver.solver_dt,
        seed=scene_seed(spec, split, index),
        split=split,
        parameter_group=parameter_value(spec, split, index)[1],
        solver=spec.solver.name,
        solver_version=spec.solver.version,
        config=json.dumps({"scene": values["scene"], "solver": values["solver"]}, sort_keys=True),
    )


def generate_trajectory(spec: DatasetSpec, split: str, index: int) -> Trajectory:
    """Simulate one trajectory; raises ``GenerationError`` if the scene is impossible or the solver gives up."""
    metadata = trajectory_metadata(spec, split, index)
    label = f"split {split}, index {index}, seed {metadata.seed}"
    try:
        state = sample_scene(spec.scene, spec.material, parameter_value(spec, split, index)[0], metadata.seed)
    except ValueError as error:
        raise GenerationError(f"{label}: {error}", split, index, metadata.seed) from None
    guard = Guard(bounds=spec.scene.bounds, margin=1e-6)
    trajectory = rollout(spec.solver, state, spec.num_frames - 1, metadata, guard)
    if trajectory.termination is not None:
        raise GenerationError(
            f"{label}: {trajectory.termination.reason}: {trajectory.termination.message}; lower solver.cfl or scene.max_speed",
            split,
            index,
            metadata.seed,
        )
    return trajectory


# --- shards --------------------------------------------------------------------------------------------------------------------------------


def shard_path(folder: Path, split: str, shard: int) -> Path:
    """Path of a shard inside the folder of a data set."""
    return folder / split / f"shard-{shard:05d}.h5"


def _shard_indices(spec: DatasetSpec, split: str, shard: int) -> range:
    start = shard * spec.trajectories_per_shard
    return range(start, min(start + spec.trajectories_per_shard, spec.counts[split]))


def _shards(spec: DatasetSpec) -> list[tuple[str, int]]:
    return [(split, k) for split, count in spec.counts.items() for k in range(math.ceil(count / spec.trajectories_per_shard))]


def _is_complete(spec: DatasetSpec, folder: Path, split: str, shard: int) -> bool:
    """A shard that is there and readable is complete, because it is written atomically."""
    try:
        return trajectory_names(shard_path(folder, split, shard)) == [f"{i:05d}" for i in _shard_indices(spec, split, shard)]
    except StoreError:
        return False


def _write_shard(spec: DatasetSpec, folder: Path, split: str, shard: int) -> int:
    """Generate one shard; returns the number of its trajectories."""
    indices = _shard_indices(spec, split, shard)
    write_shard(shard_path(folder, split, shard), (generate_trajectory(spec, split, i) for i in indices), (f"{i:05d}" for i in indices))
    return len(indices)


def _bytes_per_trajectory(spec: DatasetSpec) -> int:
    dim = len(spec.scene.bounds)
    node_frames = 2 * 4 * dim * spec.scene.num_particles * spec.num_frames
    boundary = 64 * sum(math.ceil((high - low) / spec.scene.spacing) for low, high in spec.scene.bounds) * 2
    return node_frames + boundary + 2**13


def dataset_bytes(spec: DatasetSpec) -> int:
    """Estimate of what a complete data set takes on disk."""
    return sum(spec.counts.values()) * _bytes_per_trajectory(spec)


# --- the data set --------------------------------------------------------------------------------------------------------------------------


def generate(root: Path | str, spec: DatasetSpec, num_workers: int = 1, on_progress: Progress | None = None) -> Path:
    """Generate what is missing of a data set.

    Args:
        root: folder of all data sets.
        spec: the data set.
        num_workers: processes; 1 simulates in this process.
        on_progress: called with the trajectories done and their total, once at the start and after each shard.

    Returns:
        The folder of the data set, ``root/name/size``.

    Raises:
        GenerationError: the folder holds a data set of another spec, the disk is too small, or a trajectory failed.
    """
    if num_workers < 1:
        raise ValueError(f"num_workers must be at least 1, got {num_workers}")
    folder = Path(root) / spec.name / spec.size
    folder.mkdir(parents=True, exist_ok=True)
    _claim(folder, spec)
    for leftover in folder.glob("*/.shard-*.part"):
        leftover.unlink(missing_ok=True)
    missing = [(split, k) for split, k in _shards(spec) if not _is_complete(spec, folder, split, k)]
    total = sum(spec.counts.values())
    to_do = sum(len(_shard_indices(spec, split, k)) for split, k in missing)
    needed, free = to_do * _bytes_per_trajectory(spec), shutil.disk_usage(folder).free
    if needed > 0.95 * free:
        raise GenerationError(
            f"{folder}: {to_do} trajectories need about {needed / 2**30:.3g} GiB, the disk has {free / 2**30:.3g} GiB free; "
            "choose another folder with paths.data, or a smaller size"
        )
    statistics = folder / STATISTICS_FILE
    if any(split == "train" for split, _ in missing):
        statistics.unlink(missing_ok=True)
    if not missing and statistics.is_file():
        if on_progress is not None:
            on_progress(total, total)
        return folder
    done = total - to_do
    if on_progress is not None:
        on_progress(done, total)
    if missing and num_workers > 1:
        mpm.compile_kernels()  # once, here: the workers load the compiled kernels from disk
    with _pool(num_workers) as pool:
        for count in _run(pool, _write_shard, [(spec, folder, split, k) for split, k in missing]):
            done += count
            if on_progress is not None:
                on_progress(done, total)
        train = [shard_path(folder, split, k) for split, k in _shards(spec) if split == "train"]
        moments = {str(path): sums for path, sums in _run(pool, _moments, [(path,) for path in train])}
    _write_json(statistics, _statistics(spec, [moments[str(path)] for path in train]))
    return folder


@contextlib.contextmanager
def progress_bar(description: str) -> Iterator[Progress]:
    """A bar with the remaining time in the terminal; yields what ``generate`` takes as ``on_progress``."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Bar(*columns) as bar:
        task = bar.add_task(description, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _claim(folder: Path, spec: DatasetSpec) -> None:
    """Write the spec into the folder, or check that the one there is the same."""
    path, values = folder / SPEC_FILE, spec.as_dict()
    sha256 = hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
    if not path.is_file():
        if any(folder.glob("*/shard-*.h5")):
            raise GenerationError(f"{folder}: holds shards but no {SPEC_FILE}; delete the folder, or choose another name or size")
        _write_json(path, {"spec": values, "sha256": sha256})
        return
    try:
        stored = json.loads(path.read_text())["spec"]
    except (json.JSONDecodeError, KeyError, TypeError):
        raise GenerationError(f"{path}: unreadable; delete the folder {folder} and run simulate again") from None
    differing = _differences(stored, values)
    if differing:
        raise GenerationError(
            f"{folder}: holds a data set with other settings: {'; '.join(differing[:5])}. Delete the folder, choose another data set name or size, "
            "or restore these settings"
        )


def _differences(stored: Any, wanted: Any, key: str = "") -> list[str]:
    """Leaves in which two nested mappings differ, as ``key: stored, now wanted``."""
    if isinstance(stored, dict) and isinstance(wanted, dict):
        names = sorted(stored.keys() | wanted.keys())
        return [d for n in names for d in _differences(stored.get(n), wanted.get(n), f"{key}.{n}" if key else n)]
    return [] if stored == wanted else [f"{key} is {json.dumps(stored)}, now {json.dumps(wanted)}"]


def _write_json(path: Path, values: dict[str, Any]) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    temporary.write_text(json.dumps(values, indent=2, sort_keys=True) + "\n")
    os.replace(temporary, path)


# --- processes -----------------------------------------------------------------------------------------------------------------------------


def _exit_with_parent() -> None:
    """A worker whose parent was killed must not stay behind."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _pool(num_workers: int) -> Iterator[Executor | None]:
    if num_workers == 1:
        yield None
        return
    before = os.environ.get("NUMBA_NUM_THREADS")
    os.environ["NUMBA_NUM_THREADS"] = "1"  # inherited by the workers: one process per core, one thread per process
    pool = ProcessPoolExecutor(num_workers, multiprocessing.get_context("spawn"), _exit_with_parent)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)
        if before is None:
            del os.environ["NUMBA_NUM_THREADS"]
        else:
            os.environ["NUMBA_NUM_THREADS"] = before


def _run(pool: Executor | None, function: Callable[..., Any], arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
    """Results of ``function`` as they complete."""
    if pool is None:
        for values in arguments:
            yield function(*values)
        return
    futures: list[Future[Any]] = [pool.submit(function, *values) for values in arguments]
    try:
        for future in as_completed(futures):
            yield future.result()
    except BrokenProcessPool:
        raise GenerationError(
            "a worker process died (killed, or out of memory); run simulate again to resume, with fewer workers"
        ) from None
    finally:
        for future in futures:
            future.cancel()


# --- statistics ----------------------------------------------------------------------------------------------------------------------------


def _moments(path: Path) -> tuple[str, dict[str, Any]]:
    """Sums over one shard from which the statistics follow."""
    sums: dict[str, Any] = {"velocity": [0, 0.0], "acceleration": [0, 0.0], "params": None, "nodes": 0, "frames": 0, "trajectories": 0}
    for name in trajectory_names(path):
        trajectory = read_trajectory(path, name)
        dt = trajectory.metadata.frame_dt
        vel = integrators.velocities(trajectory.pos.astype(np.float64), dt)
        acc = integrators.acceleration(vel[1:], vel[:-1], dt) - np.asarray(trajectory.metadata.gravity)
        for key, values in (("velocity", vel), ("acceleration", acc)):
            sums[key][0] += values.size
            sums[key][1] += float(np.sum(values * values))
        params = _scaled(trajectory)
        finite = np.isfinite(params)
        values = np.where(finite, params, 0.0)
        triple = np.stack([finite.sum(axis=0), values.sum(axis=0), (values * values).sum(axis=0)])
        sums["params"] = triple if sums["params"] is None else sums["params"] + triple
        sums["nodes"] += trajectory.num_nodes
        sums["frames"] += trajectory.num_frames
        sums["trajectories"] += 1
    return str(path), sums


def _scaled(trajectory: Trajectory) -> np.ndarray:
    """Material parameters [node, param], those on a logarithmic scale as natural logarithms."""
    scale = {p.name: p.scale for p in MATERIALS.values()}
    columns = trajectory.material_params.astype(np.float64).T
    return np.stack([np.log(c) if scale[n] == "log" else c for n, c in zip(trajectory.metadata.param_names, columns, strict=True)], axis=-1)


def _statistics(spec: DatasetSpec, moments: list[dict[str, Any]]) -> dict[str, Any]:
    """Root mean squares per component, and mean and standard deviation of the material parameters on the scale that ``schema`` gives them."""
    rms = {}
    for key in ("velocity", "acceleration"):
        rms[key] = math.sqrt(math.fsum(m[key][1] for m in moments) / sum(m[key][0] for m in moments))
    count, total, square = np.sum([m["params"] for m in moments], axis=0)
    mean = total / np.maximum(count, 1)
    std = np.sqrt(np.maximum(square / np.maximum(count, 1) - mean * mean, 0.0))
    parameters = {p.name: p for p in MATERIALS.values()}
    names = trajectory_metadata(spec, "train", 0).param_names
    return {
        "velocity_std": rms["velocity"],
        "acceleration_std": rms["acceleration"],
        "material_params": {
            n: {"mean": float(m), "std": float(s), "scale": parameters[n].scale} for n, m, s in zip(names, mean, std, strict=True)
        },
        **{f"num_{key}": sum(m[key] for m in moments) for key in ("trajectories", "frames", "nodes")},
    }
