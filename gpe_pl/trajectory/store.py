"""The store: writes and reads trajectories on disk.

A shard is an HDF5 file with one group per trajectory. It is written under a temporary name and renamed, so a reader never sees an incomplete one. Every array
is chunked with a fletcher32 checksum, and each group has a SHA-256 digest of its arrays and of the attributes that describe them. Text is stored with a fixed
length, because HDF5 keeps text of variable length outside its checksums, where one flipped bit can hang the library.

All functions that read raise ``StoreError`` where something is missing, damaged or not of this schema.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from pydantic import TypeAdapter, ValidationError

from gpe_pl.errors import GpeError
from gpe_pl.files.atomic import replacing
from gpe_pl.files.hdf5_arrays import attribute, dataset_in, is_named, is_own, obstacle
from gpe_pl.files.json_text import MAX_DIGITS, parsed
from gpe_pl.files.late_failure import LateFailure
from gpe_pl.geometry.shape_values import shape_from_dict, shape_to_dict, shapes_fault
from gpe_pl.geometry.shapes import Shape
from gpe_pl.schema import FIELDS, MOTION, NODE_TYPES, SCHEMA_VERSION, node_code
from gpe_pl.trajectory.boundary import Boundary, BoundaryMotion
from gpe_pl.trajectory.openings import Opening, openings_fault, openings_from_json, openings_to_json
from gpe_pl.trajectory.state import Stress
from gpe_pl.trajectory.trajectory import Metadata, Termination, Trajectory
from gpe_pl.trajectory.values import faults, size_conflicts

log = logging.getLogger(__name__)

ROUNDING_SPACINGS = 1e-3
"""Rounding error of stored positions above which a warning is logged [spacings]. Accelerations are often a hundredth of a spacing per frame squared."""


class StoreError(GpeError, ValueError):
    """Raised when a file of the store is missing, damaged or of another schema; the message names file, trajectory and field."""


class ReadError(GpeError):
    """Raised when the machine keeps a file of the store from being read. The file itself can be sound, so nobody should delete it for this."""


OF_THE_MACHINE = {
    *(errno.EACCES, errno.EPERM, errno.EAGAIN, errno.EBUSY, errno.EINTR, errno.EIO, errno.EMFILE, errno.ENFILE),
    *(errno.ENOLCK, errno.ENOMEM, errno.ESTALE, errno.ETIMEDOUT),
}
"""Error numbers that say nothing about the content of a file."""
WITHOUT_A_LOCK = {errno.EACCES, errno.EAGAIN, errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP}
"""Error numbers of files that another program has locked, and of disks without locks."""


class UnsoundError(StoreError):
    """Raised when a stored trajectory can be read but has invalid values.

    Attributes:
        fault: the fault, without file and trajectory.
    """

    def __init__(self, where: str, fault: str) -> None:
        super().__init__(f"{where}: {fault}; see `python -m gpe_pl.data.validate`")
        self.fault = fault


def stored_arrays(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Return the arrays of a trajectory with the names and types of ``schema.FIELDS``.

    Raises:
        StoreError: an array of integers has a value that its type cannot hold; the message names field and value.
    """
    b = trajectory.boundary
    arrays: dict[str, Any] = {
        "pos": trajectory.pos,
        "vel": trajectory.vel,
        "node_type": trajectory.node_type,
        "mass": trajectory.mass,
        "material_params": trajectory.material_params,
        "boundary_pos": b.pos[None] if b.motion is None else b.motion.pos,
        "boundary_vel": b.vel[None] if b.motion is None else b.motion.vel,
        "boundary_normal": b.normal[None] if b.motion is None else b.motion.normal,
        "boundary_friction": b.friction,
        "boundary_restitution": b.restitution,
        "rest_pos": trajectory.rest_pos,
        "alive": trajectory.alive,
        "rigid_body": trajectory.rigid_body,
        **_stored_prescribed(trajectory.prescribed),
        "force": trajectory.force,
        "cells": trajectory.cells,
        "cell_dim": None if trajectory.cells is None or trajectory.cell_dim is None else [trajectory.cell_dim],
    }
    if trajectory.stress is not None:
        for part in ("node", "cell"):
            arrays[f"{part}_stress"] = getattr(trajectory.stress, part)
            arrays[f"{part}_von_mises"] = getattr(trajectory.stress, f"{part}_von_mises")
    return {key: _of_stored_type(key, np.asarray(values)) for key, values in arrays.items() if values is not None}


def _of_stored_type(key: str, values: np.ndarray) -> np.ndarray:
    stored = np.ascontiguousarray(values, dtype=FIELDS[key].dtype)
    if stored.dtype.kind in "iu" and (wrong := stored != values).any():
        raise StoreError(
            f"field {key!r}: {values[wrong][0]} cannot be stored as {stored.dtype}; give whole numbers up to {np.iinfo(stored.dtype).max}"
        )
    return stored


def _stored_prescribed(prescribed: np.ndarray | None) -> dict[str, np.ndarray]:
    """Return the mask [node, dim] of given motion as a field: one value per node where that says all."""
    if prescribed is None:
        return {}
    is_per_node = (prescribed == prescribed[:, :1]).all()
    return {"prescribed": prescribed[:, 0]} if is_per_node else {"prescribed_axes": prescribed}


def _read_prescribed(arrays: dict[str, np.ndarray], dim: int) -> np.ndarray | None:
    """Return the mask [node, dim] of given motion; None if no motion is given."""
    if "prescribed_axes" in arrays:
        return arrays["prescribed_axes"].astype(bool)
    return np.repeat(arrays["prescribed"].astype(bool)[:, None], dim, axis=1) if "prescribed" in arrays else None


def array_bytes(trajectory: Trajectory) -> int:
    """Return the uncompressed size of a trajectory's stored arrays [bytes]."""
    return sum(array.nbytes for array in stored_arrays(trajectory).values())


ADVICE = "delete the shard and generate or import the data again"

PREDICTION = "prediction"
"""Name of an attribute that only predictions have."""
START_TIME = "start_time"
"""Name of the attribute with the time of the first frame [s]. Only trajectories that start later than their scene have it: solvers do not assume that their
first frame is undeformed."""
OPENINGS = "openings"
"""Name of the attribute with the inlets and outlets of an open scene."""
TERMINATION = "termination"
"""Name of the attribute with the reason why a rollout stopped early."""
ATTRIBUTES = ("metadata", "shapes", "node_types")
"""Attributes of every trajectory's group, besides the digest."""
FURTHER = (START_TIME, OPENINGS, TERMINATION)
"""Attributes that some trajectories have, and that the digest covers."""


OPTIONAL = ("stress_materials", "loads")
"""Metadata that are stored only if they are not None."""


def stored_attributes(trajectory: Trajectory) -> dict[str, str]:
    """Return the attributes of a trajectory as JSON: metadata, shapes of its boundary, names of the ``node_type`` codes, and, if there are some, a start time
    other than 0, openings, and the reason why a rollout stopped.
    """
    m = trajectory.metadata
    values = {name: value for name, value in asdict(m).items() if name not in OPTIONAL or value is not None}
    meta = json.dumps(values, sort_keys=True)
    shapes = json.dumps([shape_to_dict(s) for s in trajectory.boundary.shapes], sort_keys=True)
    begins = {START_TIME: repr(float(trajectory.start_time))} if trajectory.start_time else {}
    opens = {OPENINGS: openings_to_json(trajectory.openings)} if trajectory.openings else {}
    ends = {TERMINATION: json.dumps(asdict(trajectory.termination), sort_keys=True)} if trajectory.termination else {}
    return {"metadata": meta, "shapes": shapes, "node_types": json.dumps(NODE_TYPES), **begins, **opens, **ends}


def digested_attributes(group: h5py.Group) -> dict[str, str]:
    """Return the attributes of a trajectory's group that its digest covers."""
    return {key: read_text(group, key) for key in (*ATTRIBUTES, *(key for key in FURTHER if key in group.attrs))}


def digest(arrays: Mapping[str, np.ndarray], attributes: Mapping[str, str]) -> str:
    """Return the SHA-256 digest of names, shapes, types and bytes of all arrays and attributes of a trajectory."""
    sha = hashlib.sha256()
    for name, text in sorted(attributes.items()):
        sha.update(f"{name}={text};".encode())
    for name, array in sorted(arrays.items()):
        sha.update(f"{name}:{array.dtype.str}:{array.shape};".encode())
        sha.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return sha.hexdigest()


COMPRESSION = {"shuffle": True, "compression": "gzip", "compression_opts": 1}
"""Lossless compression. It saves a quarter of the disk space for particles, and more for meshes. Higher levels save one per cent."""


def _chunks(array: np.ndarray, dims: tuple[str, ...]) -> tuple[int, ...]:
    """Return the shape of chunks: arrays with frames are cut into chunks of about 256 kB, others are one chunk."""
    if dims[0] != "frame" and not (dims[0] == MOTION and len(array) > 1):
        return tuple(max(1, n) for n in array.shape)
    frame_bytes = max(1, array[:1].nbytes)
    return (max(1, min(array.shape[0], 2**18 // frame_bytes)), *(max(1, n) for n in array.shape[1:]))


def write_shard(path: Path | str, trajectories: Iterable[Trajectory], names: Iterable[str] | None = None) -> None:
    """Write trajectories into one file, atomically: the file appears complete or not at all.

    Args:
        path: target file; an existing one is replaced.
        trajectories: consumed one by one.
        names: group names; by default ``00000, 00001, …``.

    Raises:
        ValueError: there are fewer ``names`` than trajectories.
        StoreError: a name, an integer, the seed or the start time could not be read again; the message names it.
        FullDiskError: there is no room for the file.
    """
    path = Path(path)
    name_of = iter(names) if names is not None else (f"{k:05d}" for k in range(10**9))
    is_warned = False
    # track_times off and the libver pinned: equal content gives equal bytes
    with replacing(path) as part, LateFailure(part) as place:
        with h5py.File(place, "w", libver=("v110", "v110"), track_order=False) as file:
            file.attrs["schema_version"] = SCHEMA_VERSION
            _write_text(file, "units", json.dumps({k: f.unit for k, f in FIELDS.items()}, sort_keys=True))
            count = 0
            for trajectory in trajectories:
                name = next(name_of, None)
                if name is None:
                    raise ValueError(f"{path}: {count} names for more than {count} trajectories")
                _check_writable(path, name, trajectory)
                is_warned = is_warned or _warn_of_rounding(f"{path}:{name}", trajectory)
                try:
                    arrays = stored_arrays(trajectory)
                except StoreError as error:
                    raise StoreError(f"{path}:{name}: {error}") from None
                group = file.create_group(name)
                fill_group(group, arrays, stored_attributes(trajectory))
                if trajectory.is_prediction:
                    _write_text(group, PREDICTION, "")
                place.check()
                count += 1
            file.attrs["num_trajectories"] = count
        place.check()


def _check_writable(path: Path, name: str, trajectory: Trajectory) -> None:
    """Raise ``StoreError`` for a name, a seed or a start time that could not be read again."""
    if name in ("", ".") or {"/", "\0"} & {*name}:
        raise StoreError(f"{path}: {name!r} cannot name a trajectory; choose a name that is not empty, not '.', and without '/' and NUL")
    if not math.isfinite(trajectory.start_time):
        raise StoreError(f"{path}:{name}: start_time is {trajectory.start_time}; give a number of seconds")
    if abs(trajectory.metadata.seed) >= 10**MAX_DIGITS:
        raise StoreError(f"{path}:{name}: the seed in the metadata has more than {MAX_DIGITS} digits; choose a smaller one")


def _warn_of_rounding(where: str, trajectory: Trajectory) -> bool:
    """Warn if float32 rounds positions by more than ``ROUNDING_SPACINGS``. Return whether it does."""
    if trajectory.pos.dtype == np.float32:
        return False
    lost = max((float(np.abs(frame - frame.astype(np.float32)).max(initial=0.0)) for frame in trajectory.pos), default=0.0)
    if not lost > ROUNDING_SPACINGS * trajectory.metadata.spacing:
        return False
    log.warning(
        "%s: positions are stored in float32, which rounds them by up to %.3g m so far from 0; the spacing is %.3g m. Move the origin nearer to the scene",
        where, lost, trajectory.metadata.spacing,
    )  # fmt: skip
    return True


def fill_group(group: h5py.Group, arrays: Mapping[str, np.ndarray], attributes: Mapping[str, str]) -> None:
    """Write what ``stored_arrays`` and ``stored_attributes`` return into the empty group of a trajectory, with their digest."""
    for key, text in attributes.items():
        _write_text(group, key, text)
    _write_text(group, "sha256", digest(arrays, attributes))
    for key, array in arrays.items():
        empty = array.size == 0
        options = {} if empty else {"chunks": _chunks(array, FIELDS[key].dims), "fletcher32": True, **COMPRESSION}
        dataset = group.create_dataset(key, data=array, track_times=False, **options)
        _write_text(dataset, "unit", FIELDS[key].unit)


def _write_text(owner: h5py.HLObject, key: str, text: str) -> None:
    owner.attrs.create(key, np.bytes_(text.encode()))


@contextmanager
def open_shard(path: Path | str) -> Iterator[h5py.File]:
    """Open a shard of this schema version for reading.

    Errors of the types that HDF5 raises on damaged files, such as ``OSError`` and ``ValueError``, become ``StoreError``. This includes errors in the block.

    Raises:
        StoreError: the file is missing, damaged, or of another schema.
        ReadError: the machine cannot read it: no permission, no memory, too many open files.
    """
    path = Path(path)
    if not path.is_file():
        raise StoreError(f"{path}: no such file; generate data with `python -m gpe_pl.simulate`")
    try:
        with _opened(path) as file:
            version = attribute(file, "schema_version")
            if not isinstance(version, np.integer) or version != SCHEMA_VERSION:
                raise StoreError(
                    f"{path}: schema version {version}, this version of gpe_pl reads {SCHEMA_VERSION}; regenerate or convert the data"
                )
            yield file
    except StoreError:
        raise
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, MemoryError) as error:  # HDF5 and h5py raise all of these
        _require_machine(path, error)
        raise StoreError(
            f"{path}: not a readable HDF5 file (damaged or truncated: {error}); delete it and generate or import the data again"
        ) from error


def _opened(path: Path) -> h5py.File:
    """Open a file, without a lock if it cannot be locked: shards are complete when they get their names."""
    try:
        return h5py.File(path, "r")
    except OSError as error:
        if error.errno not in WITHOUT_A_LOCK:
            raise
    return h5py.File(path, "r", locking=False)


def _require_machine(path: Path | str, error: Exception) -> None:
    """Raise ``ReadError`` if an error comes from the machine, not from the content of a file."""
    if isinstance(error, MemoryError):
        raise ReadError(f"{path}: cannot be read, there is no memory left ({error}); close other programs, or use fewer workers") from error
    if isinstance(error, OSError) and error.errno in OF_THE_MACHINE:
        raise ReadError(f"{path}: cannot be read ({os.strerror(error.errno)}); the file may be sound, so do not delete it") from error


def _where(group: h5py.Group) -> str:
    return f"{group.file.filename}:{group.name.lstrip('/')}"


def open_group(file: h5py.File, name: str) -> h5py.Group:
    """Return the group of one trajectory."""
    if not is_named(file, name):
        raise StoreError(f"{file.filename}: no trajectory {name!r}; it has {len(file)} trajectories")
    if not is_own(file, name) or not isinstance(file[name], h5py.Group):
        raise StoreError(f"{file.filename}: {name!r} is not a trajectory of this file; {ADVICE}")
    return file[name]


def read_text(group: h5py.Group, key: str) -> str:
    """Return a text attribute of a trajectory."""
    if key not in group.attrs:
        raise StoreError(f"{_where(group)}: attribute {key!r} is missing; {ADVICE}")
    text = attribute(group, key)
    if not isinstance(text, bytes):  # reading text of variable length from a damaged file is not safe
        stored = group.attrs.get_id(key)
        raise StoreError(
            f"{_where(group)}: attribute {key!r} is {stored.dtype}{list(stored.shape)}, expected text of fixed length; {ADVICE}"
        )
    return text.decode()


def open_field(group: h5py.Group, key: str) -> h5py.Dataset:
    """Return a stored array after comparing its type and shape with ``schema.FIELDS``; none of its values is read yet."""
    spec, where = FIELDS[key], f"{_where(group)}: field {key!r}"
    if not is_named(group, key):
        raise StoreError(f"{where} is missing; {ADVICE}")
    dataset = dataset_in(group, key)
    if dataset is None:
        raise StoreError(f"{where} is not an array inside this file; a shard must not refer to other files; {ADVICE}")
    if dataset.shape is None or len(dataset.shape) != len(spec.dims) or dataset.dtype != np.dtype(spec.dtype):
        raise StoreError(f"{where} is {dataset.dtype}{list(dataset.shape or ())}, expected {spec.dtype} [{', '.join(spec.dims)}]; {ADVICE}")
    if (reason := obstacle(dataset)) is not None:
        raise StoreError(f"{where} {reason}; {ADVICE}")
    return dataset


def read_field(group: h5py.Group, key: str, frames: slice | None = None) -> np.ndarray:
    """Return the values of a stored array; only those of ``frames`` if it has frames."""
    spec, dataset = FIELDS[key], open_field(group, key)
    try:
        has_frames = spec.dims[0] == "frame" or (spec.dims[0] == MOTION and dataset.shape[0] > 1)
        return dataset[frames] if frames is not None and has_frames else dataset[()]
    except (OSError, RuntimeError) as error:
        _require_machine(group.file.filename, error)
        where = f"{_where(group)}: field {key!r}"
        raise StoreError(f"{where} is damaged (checksum mismatch); {ADVICE}") from None


def trajectory_names(path: Path | str) -> list[str]:
    """Return the group names of a shard, in order."""
    with open_shard(path) as file:
        return sorted(file)


def read_metadata(path: Path | str, name: str) -> Metadata:
    """Return the metadata of one trajectory, without reading its arrays."""
    with open_shard(path) as file:
        return metadata_of(open_group(file, name))


def metadata_of(group: h5py.Group) -> Metadata:
    """Return the metadata of a trajectory's group.

    Raises:
        StoreError: a key is missing, unknown or of another type.
    """
    try:
        text = read_text(group, "metadata")
        values = parsed(text)
        known = {f.name for f in fields(Metadata)}
        if not isinstance(values, dict) or {*values, *OPTIONAL} != known:
            raise ValueError(f"keys {sorted(set(values) ^ known)} missing or unknown")
        return TypeAdapter(Metadata).validate_json(text, strict=True)
    except StoreError:
        raise
    except ValidationError as error:
        wrong = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors(include_url=False)[:5])
        raise StoreError(f"{_where(group)}: metadata unreadable: {wrong}; {ADVICE}") from None
    except (ValueError, TypeError) as error:
        raise StoreError(f"{_where(group)}: metadata unreadable: {error}; {ADVICE}") from None


def _parsed_list(group: h5py.Group, key: str) -> list[Any]:
    values = parsed(read_text(group, key))
    if not isinstance(values, list):
        raise ValueError(f"is a {type(values).__name__}, must be a list")
    return values


def shapes_of(group: h5py.Group) -> tuple[Shape, ...]:
    """Return the shapes of walls and obstacles of a trajectory's group."""
    try:
        return tuple(shape_from_dict(values) for values in _parsed_list(group, "shapes"))
    except StoreError:
        raise
    except (ValueError, TypeError, AttributeError, ArithmeticError, LookupError) as error:
        raise StoreError(f"{_where(group)}: attribute 'shapes' is unreadable: {error}; {ADVICE}") from None


def start_time_of(group: h5py.Group) -> float:
    """Return the time of the first frame of a trajectory's group since the start of its scene [s]."""
    if START_TIME not in group.attrs:
        return 0.0
    try:
        seconds = parsed(read_text(group, START_TIME))
        if type(seconds) not in (int, float) or not math.isfinite(seconds):
            raise ValueError("must be a number of seconds")
    except StoreError:
        raise
    except ValueError as error:
        raise StoreError(f"{_where(group)}: attribute {START_TIME!r} is unreadable: {error}; {ADVICE}") from None
    return float(seconds)


def termination_of(group: h5py.Group) -> Termination | None:
    """Return the reason why the rollout in a trajectory's group stopped; None if it did not."""
    if TERMINATION not in group.attrs:
        return None
    try:
        values = parsed(read_text(group, TERMINATION))
        kinds = {"reason": str, "frame": int, "node": int, "message": str}
        if not isinstance(values, dict) or {key: type(value) for key, value in values.items()} != kinds:
            raise ValueError(f"must have {', '.join(kinds)}")
    except StoreError:
        raise
    except ValueError as error:
        raise StoreError(f"{_where(group)}: attribute {TERMINATION!r} is unreadable: {error}; {ADVICE}") from None
    return Termination(**values)


def openings_of(group: h5py.Group) -> tuple[Opening, ...]:
    """Return the inlets and outlets of a trajectory's group; their values are not checked."""
    if OPENINGS not in group.attrs:
        return ()
    try:
        return openings_from_json(read_text(group, OPENINGS))
    except StoreError:
        raise
    except (ValueError, TypeError) as error:
        raise StoreError(f"{_where(group)}: attribute {OPENINGS!r} is unreadable: {error}; {ADVICE}") from None


def node_types_of(group: h5py.Group) -> tuple[str, ...]:
    """Return the names of the ``node_type`` codes in a trajectory's group; all of them are in ``schema.NODE_TYPES``."""
    try:
        names = tuple(_parsed_list(group, "node_types"))
    except StoreError:
        raise
    except (ValueError, TypeError) as error:
        raise StoreError(f"{_where(group)}: attribute 'node_types' is unreadable: {error}; {ADVICE}") from None
    unknown = [name for name in names if name not in NODE_TYPES]
    if unknown:
        raise StoreError(f"{_where(group)}: attribute 'node_types' names {unknown}; known: {', '.join(NODE_TYPES)}; {ADVICE}")
    return names


def read_trajectory(path: Path | str, name: str, verify: bool = False, frames: slice | None = None) -> Trajectory:
    """Read one trajectory.

    Args:
        path: shard.
        name: group name.
        verify: recompute the SHA-256 digest. HDF5's checksums are always verified.
        frames: read these frames only; not together with ``verify``. ``Trajectory.every`` takes every so many frames.

    Raises:
        StoreError: a file, group, field or frame is missing, has the wrong shape or type, or does not match its checksum.
        UnsoundError: metadata, shapes or values break their rules (``Metadata.violations``, ``shape_values.shapes_fault``, ``schema.FIELDS``). The message
            names field, frame and node.
        ValueError: ``verify`` and ``frames`` are given together, or ``frames`` has a step.
    """
    if verify and frames is not None:
        raise ValueError("the digest covers all frames: pass verify or frames, not both")
    if frames is not None and frames.step not in (None, 1):
        raise ValueError(f"{frames} must not have a step; take every so many frames with Trajectory.every")
    with open_shard(path) as file:
        return trajectory_in(open_group(file, name), verify, frames)


def trajectory_in(group: h5py.Group, verify: bool = False, frames: slice | None = None) -> Trajectory:
    """Return the trajectory of an open group; arguments and errors are those of ``read_trajectory``."""
    metadata, where = metadata_of(group), _where(group)
    arrays = {key: read_field(group, key, frames) for key, spec in FIELDS.items() if spec.required or is_named(group, key)}
    num_frames = open_field(group, "pos").shape[0]
    first_frame, last_frame, _ = slice(None).indices(num_frames) if frames is None else frames.indices(num_frames)
    if first_frame >= last_frame and num_frames:
        raise StoreError(f"{where}: has {num_frames} frames, and none of {frames}")
    if verify and digest(arrays, digested_attributes(group)) != read_text(group, "sha256"):
        raise StoreError(f"{where}: SHA-256 digest does not match the content; {ADVICE}")
    if ("node_stress" in arrays) != ("cell_stress" in arrays):
        raise StoreError(f"{where}: has only one of the fields 'node_stress' and 'cell_stress'; {ADVICE}")
    for conflict in size_conflicts(arrays, metadata.dim, len(metadata.param_names)):
        raise StoreError(f"{where}: {conflict}; {ADVICE}")
    shapes, names, is_prediction, begins = shapes_of(group), node_types_of(group), PREDICTION in group.attrs, start_time_of(group)
    openings, end = openings_of(group), termination_of(group)
    for key, violation in metadata.violations():
        raise UnsoundError(where, f"{key} {violation}")
    if (wrong := shapes_fault(shapes, metadata.periodicity)) is not None:
        raise UnsoundError(where, wrong)
    if (wrong := openings_fault(openings, metadata.dim, len(metadata.param_names), len(names))) is not None:
        raise UnsoundError(where, wrong)
    for fault in faults(arrays, names, metadata.materials, metadata.param_names, first_frame):
        raise UnsoundError(where, str(fault))
    motion = BoundaryMotion(arrays["boundary_pos"], arrays["boundary_vel"], arrays["boundary_normal"])
    moves = open_field(group, "boundary_pos").shape[0] > 1  # a window of one frame still belongs to a motion
    boundary = Boundary(
        motion.pos[0],
        motion.vel[0],
        motion.normal[0],
        arrays["boundary_friction"],
        arrays["boundary_restitution"],
        shapes,
        motion if moves else None,
    )
    found = Trajectory(
        metadata,
        arrays["pos"],
        arrays["vel"],
        np.array([node_code(n) for n in names], dtype=np.uint8)[arrays["node_type"]],
        arrays["mass"],
        arrays["material_params"],
        boundary,
        rest_pos=arrays.get("rest_pos"),
        rigid_body=arrays.get("rigid_body"),
        prescribed=_read_prescribed(arrays, metadata.dim),
        force=arrays.get("force"),
        cells=arrays.get("cells"),
        cell_dim=int(arrays["cell_dim"][0]) if "cell_dim" in arrays else None,
        stress=Stress(arrays["node_stress"], arrays["cell_stress"]) if "node_stress" in arrays else None,
        alive=arrays["alive"].astype(bool) if "alive" in arrays else None,
        openings=openings,
        start_time=begins + metadata.frame_dt * first_frame,
        is_prediction=is_prediction,
        termination=None if end is None or last_frame < num_frames else replace(end, frame=end.frame - first_frame),
    )
    return found.present()


def shards(root: Path | str, split: str) -> list[Path]:
    """Return the shard files of a split in a data set's folder, in order.

    Raises:
        StoreError: there is none.
    """
    found = sorted((Path(root) / split).glob("shard-*.h5"))
    if not found:
        others = sorted({path.parent.name for path in Path(root).glob("*/shard-*.h5")})
        lacks = f"has no split {split!r} but {', '.join(others)}" if others else "has no trajectories of any split"
        is_imported = Path(root).name == "imported"
        remedy = "import data" if is_imported else "generate it with `python -m gpe_pl.simulate`, import data"
        raise StoreError(f"{root}: {lacks}; {remedy} that have it, or choose another split")
    return found


def iter_trajectories(root: Path | str, split: str) -> Iterator[Trajectory]:
    """Yield all trajectories of a split, one at a time."""
    for path in shards(root, split):
        for name in trajectory_names(path):
            yield read_trajectory(path, name)
