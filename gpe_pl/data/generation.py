"""Parallel, resumable generation of data sets.

Every trajectory depends only on its specification (see ``ground_truth``), and every shard is written atomically. A killed run therefore resumes where it
stopped, and its files equal those of an uninterrupted run. A shard that can be opened and is of its data set, split and number counts as complete;
``discard_damaged`` checks every byte. Layout::

    {root}/{name}/{size}/dataset.json            the spec and its checksum, written first
    {root}/{name}/{size}/{split}/shard-00000.h5
    {root}/{name}/{size}/chosen_scenes.json      numbers of training scenes that models chose, if they did (see ``chosen_scenes``)
    {root}/{name}/{size}/statistics.json         statistics of the train split, written when all its shards exist
    {root}/{name}/{size}/contact_sheet.png       one scene with several parameter values, for inspection
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import threading
import time
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.data.checksum import split_checksum
from gpe_pl.data.chosen_scenes import SPEC_FILE, scene_numbers
from gpe_pl.data.ground_truth import DatasetSpec, GenerationError, generate_trajectory, initial_state, trajectory_metadata
from gpe_pl.data.position_rounding import ROUNDING_FRACTION, rounding_fault, rounding_of
from gpe_pl.data.statistics import STATISTICS_FILE, acceleration_std, combined, shard_moments
from gpe_pl.files import sealed
from gpe_pl.files.atomic import free_bytes, replace_text
from gpe_pl.files.run_folder import refuse_links, without_orphans
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.solvers.caution import unresolved
from gpe_pl.system.locks import locked
from gpe_pl.system.progress import Progress
from gpe_pl.system.workers import pool, results
from gpe_pl.trajectory.store import StoreError, read_metadata, read_trajectory, trajectory_names, write_shard
from gpe_pl.trajectory.trajectory import Trajectory

log = logging.getLogger(__name__)

CONTACT_SHEET_FILE = "contact_sheet.png"
SHEET_ROWS = 5
OF_ONE_SCENE = ("dataset", "split", "seed", "parameter_group", "config")
"""Metadata by which a shard is that of a data set, split and number."""

SCENES_LOOKED_AT = 8
"""Number of training scenes whose meshes are checked for thin parts. Bodies of one data set differ, so one scene is not enough."""

ROUNDING_REFUSED = 0.5
"""Maximum rounding error of accelerations due to stored positions, as a fraction of the accelerations. Above ``ROUNDING_FRACTION`` a warning is logged."""

# --- shards --------------------------------------------------------------------------------------------------------------------------------


def shard_path(folder: Path, split: str, shard: int) -> Path:
    """Return the path of a shard inside the folder of a data set."""
    return folder / split / f"shard-{shard:05d}.h5"


def _shard_indices(spec: DatasetSpec, split: str, shard: int) -> range:
    start = shard * spec.trajectories_per_shard
    return range(start, min(start + spec.trajectories_per_shard, spec.counts[split]))


def _shards(spec: DatasetSpec, part: tuple[int, int] = (0, 1)) -> list[tuple[str, int]]:
    """Return split and number of each shard. With ``part = (k, n)``, return those of every n-th shard from the k-th on."""
    if not 0 <= part[0] < part[1]:
        raise ValueError(f"part must be (k, n) with 0 <= k < n, got {part}")
    every = [(split, k) for split, count in spec.counts.items() for k in range(math.ceil(count / spec.trajectories_per_shard))]
    return every[part[0] :: part[1]]


def _is_complete(spec: DatasetSpec, folder: Path, split: str, shard: int) -> bool:
    """Whether a shard exists, is readable, and is that of this data set, split and number. It is then complete, because it is written atomically."""
    path, indices = shard_path(folder, split, shard), _shard_indices(spec, split, shard)
    try:
        if trajectory_names(path) != [f"{i:05d}" for i in indices]:
            return False
        own, wanted = read_metadata(path, f"{indices[0]:05d}"), trajectory_metadata(spec, split, indices[0])
    except StoreError:
        return False
    return all(getattr(own, key) == getattr(wanted, key) for key in OF_ONE_SCENE)


def _fault(path: Path) -> tuple[Path, str]:
    """Return the path of a shard, and the reason why it cannot be used. The reason is empty if its content agrees with its checksums."""
    try:
        for name in trajectory_names(path):
            read_trajectory(path, name, verify=True)
    except StoreError as error:
        return path, str(error).partition("; ")[0]  # without the advice: the caller follows it now
    return path, ""


def _write_shard(spec: DatasetSpec, folder: Path, split: str, shard: int) -> int:
    """Generate one shard, and return the number of its trajectories."""
    indices = _shard_indices(spec, split, shard)
    write_shard(shard_path(folder, split, shard), (generate_trajectory(spec, split, i) for i in indices), (f"{i:05d}" for i in indices))
    return len(indices)


def _bytes_per_trajectory(spec: DatasetSpec) -> int:
    """Estimate the uncompressed size of a trajectory [bytes].

    The estimate takes the largest number of nodes and cells of a scene, and the number of boundary nodes of the first scene.
    """
    dim = len(spec.scene.bounds)
    per_frame = 2 * dim * spec.scene.max_nodes
    if spec.solver.stores_stress:
        per_frame += (5 if dim == 2 else 7) * (spec.scene.max_nodes + spec.scene.max_cells)
    boundary = initial_state(spec, "train", 0).boundary
    return 4 * per_frame * spec.num_frames + 16 * (dim + 1) * len(boundary.pos) + 2**13


def dataset_bytes(spec: DatasetSpec) -> int:
    """Estimate the maximum size of a complete data set on disk [bytes]. Compression reduces it."""
    return sum(spec.counts.values()) * _bytes_per_trajectory(spec)


# --- the data set --------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plan:
    """The missing part of a data set, and the disk space that it needs.

    Attributes:
        missing: split and number of each missing shard.
        num_done, num_missing: numbers of existing and of missing trajectories.
        bytes_needed: maximum size of the missing shards on disk.
        bytes_free: free bytes on the disk.
    """

    missing: tuple[tuple[str, int], ...]
    num_done: int
    num_missing: int
    bytes_needed: int
    bytes_free: int

    @property
    def fits(self) -> bool:
        """Whether the missing shards take at most 95 % of the free space."""
        return self.bytes_needed <= 0.95 * self.bytes_free


def plan(root: Path | str, spec: DatasetSpec, part: tuple[int, int] = (0, 1)) -> Plan:
    """Return the plan that ``generate`` follows with the same arguments."""
    folder = Path(root) / spec.name / spec.size
    own = _shards(spec, part)
    missing = tuple((split, k) for split, k in own if not _is_complete(spec, folder, split, k))
    total, num_missing = (sum(len(_shard_indices(spec, split, k)) for split, k in shards) for shards in (own, missing))
    return Plan(missing, total - num_missing, num_missing, num_missing * _bytes_per_trajectory(spec), free_bytes(folder))


def discard_damaged(root: Path | str, spec: DatasetSpec, num_workers: int = 1, part: tuple[int, int] = (0, 1)) -> None:
    """Delete shards and statistics that do not agree with their checksums, so that ``generate`` creates them again. Arguments and errors are those of
    ``generate``.

    Each deleted file is logged. If nothing is damaged, nothing is written. Reading a data set takes about a twentieth of the time to generate it.
    """
    folder = Path(root) / spec.name / spec.size
    paths = [path for shard in _shards(spec, part) if (path := shard_path(folder, *shard)).is_file()]
    if not paths:
        return
    _claim(folder, spec)
    damaged = []
    with pool(num_workers) as workers:
        for path, fault in results(workers, _fault, [(path,) for path in paths]):
            if fault:
                log.warning("generating a shard again: %s", fault)
                damaged.append(path)
    statistics = folder / STATISTICS_FILE
    if statistics.is_file() and not _has_intact_statistics(statistics):
        log.warning("computing the statistics again: %s is damaged", statistics)
        damaged.append(statistics)
    if damaged:
        with written(root, spec, part):
            for path in damaged:
                path.unlink(missing_ok=True)


def is_complete(root: Path | str, spec: DatasetSpec, part: tuple[int, int] = (0, 1)) -> bool:
    """Whether ``generate`` with the same arguments would have nothing to write."""
    return not plan(root, spec, part).missing and _is_described(Path(root) / spec.name / spec.size, part)


def _is_described(folder: Path, part: tuple[int, int]) -> bool:
    needed = [SPEC_FILE, *([] if part[0] else [CONTACT_SHEET_FILE])]
    return all((folder / name).is_file() for name in needed) and _has_statistics(folder)


def _has_intact_statistics(path: Path) -> bool:
    try:
        sealed.read(path, "")
    except sealed.SealError:
        return False
    return True


def _has_statistics(folder: Path) -> bool:
    """Whether the statistics in a folder belong to its current training shards."""
    try:
        return bool(sealed.read(folder / STATISTICS_FILE, "")["data_sha256"] == split_checksum(folder, "train"))
    except (OSError, ValueError, KeyError):
        return False


def _compile(spec: DatasetSpec) -> None:
    """Compile the solver, or load it from the cache. A log line appears only if this takes more than 3 s."""
    notice = threading.Timer(3.0, log.info, ["compiling the solver, once on this machine: about a minute"])
    notice.daemon = True
    notice.start()
    try:
        with contextlib.suppress(SimulationError):  # the first trajectory reports impossible settings with its seed
            spec.label_solver.compile_kernels()
    finally:
        notice.cancel()


def seconds_per_trajectory(spec: DatasetSpec, budget: float = 10.0) -> float:
    """Estimate the time to generate a trajectory on one core [s]: the mean over random training trajectories.

    Trajectories are generated until ``budget`` [s] is used up, and at least one.
    """
    _compile(spec)
    order = np.random.default_rng(0).permutation(spec.num_train).tolist()
    started, count = time.perf_counter(), 0
    while count == 0 or (count < len(order) and time.perf_counter() - started < budget):
        generate_trajectory(spec, "train", order[count])
        count += 1
    return (time.perf_counter() - started) / count


def check_rounding(spec: DatasetSpec) -> None:
    """Check that the frame interval is long enough for stored accelerations to be precise; warn if it is nearly too short.

    Positions are stored in single precision. The error of an acceleration due to rounding grows with the inverse square of the frame interval.

    If the error at the bounds of the domain is not small compared with gravity, the accelerations of a simulated training trajectory are measured.

    Raises:
        GenerationError: rounding of float32 positions is more than a fraction ``ROUNDING_REFUSED`` of the accelerations, or the trajectory failed.
    """
    dt = spec.solver.frame_dt
    rounding = float(rounding_of(np.abs(np.array(spec.scene.bounds)).max(axis=1), dt).max())
    if rounding <= ROUNDING_FRACTION * float(np.linalg.norm(spec.scene.gravity)):  # nodes that meet a wall accelerate at least as much
        return
    trajectory = generate_trajectory(spec, "train", 0)
    acceleration = acceleration_std([trajectory])
    if fault := rounding_fault(rounding, acceleration):
        message = f"frame_dt = {dt:g} s: {fault}; choose a longer frame_dt (data.solver.frame_dt=…), or bounds nearer to 0"
        if rounding > ROUNDING_REFUSED * acceleration:
            raise GenerationError(message)
        log.warning(message)


def generate(
    root: Path | str, spec: DatasetSpec, num_workers: int = 1, on_progress: Progress | None = None, part: tuple[int, int] = (0, 1)
) -> Path:
    """Generate the missing part of a data set.

    It waits while another process generates the same data. A complete data set is only read.

    Args:
        root: folder of all data sets.
        spec: the data set.
        num_workers: number of processes; 1 simulates in this process.
        on_progress: called with the number of finished trajectories and their total, at the start and after each shard.
        part: ``(k, n)`` generates every n-th shard from the k-th on, so that n machines with one disk share the work. The process that finds all training
            shards complete writes the statistics.

    Returns:
        The folder of the data set, ``root/name/size``.

    Raises:
        GenerationError: the folder holds a data set of another spec, the disk is too small, rounding is too large (``check_rounding``), or a trajectory failed.
        WorkerError: a process died.
        FolderError: the folder cannot be created or written.
    """
    if num_workers < 1:
        raise ValueError(f"num_workers must be at least 1, got {num_workers}")
    folder = Path(root) / spec.name / spec.size
    to_do = plan(root, spec, part)
    if not to_do.missing and _is_described(folder, part):
        _claim(folder, spec)
        if on_progress is not None:
            on_progress(to_do.num_done, to_do.num_done)
        return folder
    if to_do.missing:
        check_rounding(spec)
        every = {name: sorted({*v.seen, *v.interpolated, *v.extrapolated}) for name, v in spec.parameters.items()}
        for caution in unresolved(
            spec.label_solver, every, (initial_state(spec, "train", k) for k in range(min(SCENES_LOOKED_AT, spec.num_train)))
        ):
            log.warning("%s %s: %s", spec.name, spec.size, caution)
    with written(root, spec, part, waits=True):
        _generate(folder, plan(root, spec, part), spec, num_workers, on_progress, part)
    return folder


def written(root: Path | str, spec: DatasetSpec, part: tuple[int, int] = (0, 1), waits: bool = False) -> AbstractContextManager[None]:
    """Keep other processes from writing the data set, or the same part of it, inside the block. Errors are those of ``locks.locked``."""
    folder = Path(root) / spec.name / spec.size
    if part[1] == 1:
        return locked(folder, "paths.data", waits)
    return locked(folder.with_name(f"{spec.size}-part-{part[0]}-of-{part[1]}"), "paths.data", waits, makes=False)


def _generate(folder: Path, to_do: Plan, spec: DatasetSpec, num_workers: int, on_progress: Progress | None, part: tuple[int, int]) -> None:
    with locked(folder, "paths.data", waits=True):  # of parts generated at the same time, one writes the spec
        _claim(folder, spec)
    if not to_do.fits:
        raise GenerationError(
            f"{folder}: {to_do.num_missing} trajectories need up to {to_do.bytes_needed / 2**30:.3g} GiB, the disk has "
            f"{to_do.bytes_free / 2**30:.3g} GiB free; choose another folder with paths.data, or a smaller size"
        )
    statistics, sheet = folder / STATISTICS_FILE, folder / CONTACT_SHEET_FILE
    if any(split == "train" for split, _ in to_do.missing):
        statistics.unlink(missing_ok=True)
    done, total = to_do.num_done, to_do.num_done + to_do.num_missing
    if on_progress is not None:
        on_progress(done, total)
    draws_sheet = part[0] == 0 and not sheet.is_file()
    if to_do.missing or draws_sheet:
        _compile(spec)  # once, here: the workers load the compiled kernels from disk
    with without_orphans(folder, SPEC_FILE), pool(num_workers) as workers:
        if draws_sheet:  # first, so that hours of wrong data are seen within a minute
            _draw_contact_sheet(spec, sheet, workers)
        for count in results(workers, _write_shard, [(spec, folder, split, k) for split, k in to_do.missing]):
            done += count
            if on_progress is not None:
                on_progress(done, total)
        train = [(split, k) for split, k in _shards(spec) if split == "train"]
        if all(_is_complete(spec, folder, *shard) for shard in train) and not _has_statistics(folder):
            paths = [shard_path(folder, *shard) for shard in train]
            moments = {str(path): sums for path, sums in results(workers, shard_moments, [(path,) for path in paths])}
            sealed.write(statistics, {**combined([moments[str(path)] for path in paths]), "data_sha256": split_checksum(folder, "train")})


def _draw_contact_sheet(spec: DatasetSpec, path: Path, workers: Executor | None) -> None:
    """Draw a training scene with as many materials as possible, for parameter values from the smallest to the largest."""
    from gpe_pl.viz.captions import row_label
    from gpe_pl.viz.contact_sheet import contact_sheet
    from gpe_pl.viz.saving import save_figure

    rows: dict[str, dict[str, dict[str, float]]] = {}
    for fraction in np.linspace(0.0, 1.0, SHEET_ROWS):
        values: dict[str, dict[str, float]] = {material: {} for material in spec.parameters}
        for material, design in spec.parameters.items():
            for parameter, _, choices in design.of(material):
                every = sorted({*choices.seen, *choices.interpolated, *choices.extrapolated})
                values[material][parameter.name] = every[round(fraction * (len(every) - 1))]
        rows[row_label(values)] = values
    index = _most_varied_scene(spec)
    arguments = [(spec, index, label, values) for label, values in rows.items()]
    trajectories = dict(results(workers, _labelled_trajectory, arguments))
    save_figure(contact_sheet({label: trajectories[label] for label in rows}), path)


def _most_varied_scene(spec: DatasetSpec) -> int:
    """Return the index of the scene with the most materials among the first 32 training scenes."""
    best, most = 0, 1
    for index in range(min(spec.num_train, 32)):
        if most == len(spec.scene.materials):  # also if the data set has only one
            break
        number = len(np.unique(initial_state(spec, "train", index).node_type))
        if number > most:
            best, most = index, number
    return best


def _labelled_trajectory(spec: DatasetSpec, index: int, label: str, values: dict[str, dict[str, float]]) -> tuple[str, Trajectory]:
    return label, generate_trajectory(spec, "train", index, values)


def _claim(folder: Path, spec: DatasetSpec) -> None:
    """Write the spec into the folder, or check that the existing one is the same or has fewer chosen scenes; check that no link leads out of the folder."""
    refuse_links(folder)
    path, values = folder / SPEC_FILE, spec.as_dict()
    if not path.is_file() and any(folder.glob("*/shard-*.h5")):
        raise GenerationError(f"{folder}: holds shards but no {SPEC_FILE}; delete the folder, or choose another name or size")
    if not path.is_file() or _stored(folder, values) != values:
        _write_json(path, {"spec": values, "sha256": sealed.checksum(values)})


def stored_scenes(root: Path | str, spec: DatasetSpec) -> list[int]:
    """Return the numbers of the training scenes of the stored data set; none if there is no data set.

    Raises:
        GenerationError: the folder holds a data set that differs from ``spec`` in more than its training scenes.
    """
    folder = Path(root) / spec.name / spec.size
    return scene_numbers(_stored(folder, spec.as_dict(), any_scenes=True)) if (folder / SPEC_FILE).is_file() else []


def _stored(folder: Path, wanted: dict[str, Any], any_scenes: bool = False) -> dict[str, Any]:
    """Return the stored spec of a folder. It equals ``wanted``, apart from training scenes that were chosen later, or apart from all training scenes."""
    path, advice = folder / SPEC_FILE, f"delete the folder {folder} and run simulate again"
    try:
        stored = sealed.parsed(path, advice)
    except sealed.SealError as error:
        raise GenerationError(str(error)) from None
    if not (isinstance(stored, dict) and isinstance(stored.get("spec"), dict)):
        raise GenerationError(f"{path}: unreadable, it does not describe a data set; {advice}")
    spec: dict[str, Any] = stored["spec"]
    known, chosen = scene_numbers(spec), wanted.get("train_scenes")
    has_grown = any_scenes or (chosen is not None and chosen[: len(known)] == known)
    ignored = ("num_train", "train_scenes") if has_grown else ()
    before, now = ({key: value for key, value in own.items() if key not in ignored} for own in (spec, wanted))
    differing = _differences(before, now)
    if not differing and stored.get("sha256") != sealed.checksum(spec):
        raise GenerationError(f"{path}: was changed or damaged since it was written (checksum mismatch); {advice}")
    made_by, solver = (own["solver"] if isinstance(own.get("solver"), dict) else {} for own in (spec, wanted))
    if made_by.get("name") == solver.get("name") and made_by.get("version") != solver.get("version"):
        raise GenerationError(
            f"{folder}: holds data of version {made_by.get('version')} of the solver {solver['name']}; this is version {solver['version']}, whose trajectories "
            "differ. Delete the folder to generate the data again, or choose another data set name"
        )
    if differing:
        raise GenerationError(
            f"{folder}: holds a data set with other settings: {'; '.join(differing[:5])}. Delete the folder, choose another data set name or size, "
            "or restore these settings"
        )
    return spec


def _differences(stored: Any, wanted: Any, key: str = "") -> list[str]:
    """List the values in which two nested mappings differ, as ``key is stored, now wanted``."""
    if isinstance(stored, dict) and isinstance(wanted, dict):
        names = sorted(stored.keys() | wanted.keys())
        return [d for n in names for d in _differences(stored.get(n), wanted.get(n), f"{key}.{n}" if key else n)]
    return [] if stored == wanted else [f"{key} is {json.dumps(stored)}, now {json.dumps(wanted)}"]


def _write_json(path: Path, values: dict[str, Any]) -> None:
    replace_text(path, json.dumps(values, indent=2, sort_keys=True) + "\n")
