"""Faults of stored values. Values that break the rules of their fields enter by training, evaluation, validation, import and rollout.

The functions of these five ways have the same arguments. They take the first trajectory of ``shard``, put ``value`` at a random place (``seed``) into the array
``key``, write to the empty folder ``folder`` if they need files, and return the message that refuses the trajectory. It is empty if nothing refuses it.
"""

from __future__ import annotations

import logging
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gpe_pl.benchmarks.faults.scenes import small_model
from gpe_pl.benchmarks.faults.verdict import MAX_DETAIL, Fault, Verdict
from gpe_pl.data.dataset import long_enough, open_split, usable
from gpe_pl.data.generation import shard_path
from gpe_pl.data.ground_truth import DatasetSpec, generate_trajectory
from gpe_pl.data.importers import save_dataset
from gpe_pl.data.validate import validate
from gpe_pl.errors import GpeError
from gpe_pl.rollout.loop import rollout
from gpe_pl.schema import FIELDS, MOTION, NODE_TYPES, Values, node_code
from gpe_pl.trajectory.boundary import Boundary, BoundaryMotion
from gpe_pl.trajectory.store import digest, read_trajectory, stored_arrays, write_shard
from gpe_pl.trajectory.trajectory import Trajectory

NUM_FRAMES = 6
NOT_NUMBERS = (np.nan, np.inf, -np.inf, -1e30)
OFFENDERS: dict[Values, tuple[float, ...]] = {
    "finite": (*NOT_NUMBERS, 1e30),
    "positive": (*NOT_NUMBERS, -1.0, 0.0),
    "at least 0": (*NOT_NUMBERS, -1.0),
    "0 to 1": (*NOT_NUMBERS, -0.5, 1.5),
    "unit vectors": (*NOT_NUMBERS, 0.5, 3.0),
    "node types": (255, len(NODE_TYPES), node_code("boundary")),
    "parameters": NOT_NUMBERS,
    "nodes of cells": (-1, 2**31 - 1),
    "dimension of cells": (0, 1, 7),
}
"""Values that break each rule, in any element."""
Value = int | float | str
LONGER = "a row more"
FIRST = "00000"


def spoilt(arrays: dict[str, np.ndarray], key: str, value: Value, seed: int, first_frame: int = 0) -> dict[str, np.ndarray]:
    """Return the arrays with a wrong value at a random position in one of them, or with one row more than the others.

    In an array with an axis of frames, the position is at ``first_frame`` or later.
    """
    array = arrays[key].copy()
    if value == LONGER:
        axis = int(FIELDS[key].dims[0] in ("frame", MOTION))  # the axis of nodes or cells
        array = np.concatenate([array, array.take([0], axis)], axis)
    else:
        part = array[first_frame:] if FIELDS[key].dims[0] == "frame" else array
        part[np.unravel_index(int(np.random.default_rng(seed).integers(part.size)), part.shape)] = value
    return {**arrays, key: array}


# --- ways in --------------------------------------------------------------------------------------------------------------------------------


def train(shard: Path, key: str, value: Value, seed: int, folder: Path) -> str:
    """Read the changed trajectory as training does, and return the message about it or about the whole split."""
    _store(shard, key, value, seed, folder)
    return _left_out(lambda: [stored.name for stored in usable(open_split(folder, "train"))])


def evaluate(shard: Path, key: str, value: Value, seed: int, folder: Path) -> str:
    """Read the changed trajectory as evaluation does, and return the message."""
    _store(shard, key, value, seed, folder)
    return _left_out(lambda: [trajectory.metadata.dataset for _, trajectory in long_enough(folder, "train", 2)])


def check(shard: Path, key: str, value: Value, seed: int, folder: Path) -> str:
    """Validate the changed trajectory, and return the message."""
    found = validate([_store(shard, key, value, seed, folder)]).violations
    return "; ".join(str(v) for v in found if v.trajectory == FIRST)


def convert(shard: Path, key: str, value: Value, seed: int, folder: Path) -> str:
    """Convert a data set of the changed trajectory and a sound one, and return the message about the changed one."""
    sound, arrays = _sound(shard)
    report = save_dataset(folder, "own", train=[_trajectory(sound, spoilt(arrays, key, value, seed)), sound, sound, sound])
    return "; ".join(event.what for event in report.refusals if event.trajectory == "train[0]")


def roll_out(shard: Path, key: str, value: Value, seed: int, folder: Path) -> str:
    """Start a learned simulator from the last frame of the changed trajectory, and return the reason why it stops.

    The wrong value is in a frame that enters the state.
    """
    sound, arrays = _sound(shard)
    simulator, last = small_model(sound.metadata), sound.num_frames - 1
    first = last if key == "vel" else last - simulator.builder.config.history
    state = simulator.initial_state(_trajectory(sound, spoilt(arrays, key, value, seed, first)), last)
    result = rollout(simulator, state, 2, sound.metadata)
    return "" if result.termination is None else f"{result.termination.reason}: {result.termination.message}"


WAYS: dict[str, Callable[[Path, str, float | str, int, Path], str]] = {
    "training": train,
    "evaluation": evaluate,
    "validation": check,
    "conversion": convert,
    "rollout": roll_out,
}
OF_STATES = ("node_type", "mass", "material_params", "boundary_", "rest_pos", "cells")
"""Prefixes of the fields from which a rollout starts, besides positions, which it takes from several frames, and velocities."""


def brought_in(way: str, shard: Path, key: str, value: Value, seed: int, folder: Path) -> Verdict:
    """Let a wrong value enter by one of ``WAYS`` and return the verdict. The message must name the field; without a message, the value was accepted."""
    try:
        text = WAYS[way](shard, key, value, seed, folder)
    except GpeError as error:
        text = " ".join(str(error).split())
    except Exception as error:
        return Verdict("traceback", f"{type(error).__name__}: {error}")
    if not text:
        return Verdict("accepted", "no error, and nothing was left out")
    is_named = any(re.search(rf"\b{name}\b", text) for name in _names(shard, key, value))  # pos is no part of positions or rest_pos
    return Verdict("refused", text[:MAX_DETAIL]) if is_named else Verdict("accepted", f"does not name the field: {text}"[:MAX_DETAIL])


def _names(shard: Path, key: str, value: Value) -> tuple[str, ...]:
    """Return the names that a message may give to the wrong field.

    Messages name the column of a material parameter, and may name the velocity instead of the position. Messages about a wrong length contain ``has size`` or
    ``has the shape``.
    """
    if value == LONGER:
        return ("has size", "has the shape")
    velocities = ("vel", "velocity", "frame_velocity")
    others = {"material_params": read_trajectory(shard, FIRST).metadata.param_names, "pos": ("pos", *velocities), "vel": velocities}
    return others.get(key, (key,))


# --- how ------------------------------------------------------------------------------------------------------------------------------------


def _sound(shard: Path) -> tuple[Trajectory, dict[str, np.ndarray]]:
    trajectory = read_trajectory(shard, FIRST)
    return trajectory, stored_arrays(trajectory)


def _store(shard: Path, key: str, value: Value, seed: int, folder: Path) -> Path:
    """Make a data set whose first trajectory is spoilt, with matching checksums."""
    path = shard_path(folder, "train", 0)
    path.parent.mkdir()
    shutil.copy(shard, path)
    with h5py.File(path, "r+") as file:
        group = file[FIRST]
        arrays = spoilt({name: group[name][()] for name in group}, key, value, seed)
        del group[key]
        group[key] = arrays[key]
        texts = {name: group.attrs[name].decode() for name in ("metadata", "shapes", "node_types")}
        group.attrs["sha256"] = np.bytes_(digest(arrays, texts))
    return path


def _left_out(read: Callable[[], list[str]]) -> str:
    """Return the text of warnings and of the error while reading."""
    with _warnings() as said:
        try:
            read()
        except GpeError as error:
            said.append(" ".join(str(error).split()))
    return "; ".join(said)


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """Collect the warnings that are logged inside the block."""
    said: list[str] = []

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            said.append(record.getMessage())

    logger, listener = logging.getLogger("gpe_pl"), Listener(logging.WARNING)
    logger.addHandler(listener)
    try:
        yield said
    finally:
        logger.removeHandler(listener)


def _trajectory(sound: Trajectory, arrays: dict[str, np.ndarray]) -> Trajectory:
    """Return a trajectory of unchecked arrays."""
    wall: dict[str, Any] = {name: arrays[f"boundary_{name}"] for name in ("pos", "vel", "normal")}
    moves = sound.boundary.motion is not None
    fixed: dict[str, Any] = {name: arrays[f"boundary_{name}"] for name in ("friction", "restitution")}
    motion = BoundaryMotion(wall["pos"], wall["vel"], wall["normal"]) if moves else None
    boundary: Boundary = replace(sound.boundary, **({name: array[0] for name, array in wall.items()} | fixed), motion=motion)
    names = ("pos", "vel", "node_type", "mass", "material_params", "rest_pos", "cells")
    values: dict[str, Any] = {name: arrays[name] for name in names if name in arrays}
    return replace(sound, **values, boundary=boundary)


def _applies(way: str, key: str) -> bool:
    """Tell whether a field enters in one of the ways.

    Neither a rollout nor an import takes stresses and the dimension of cells.
    """
    if way == "rollout":
        return key.startswith(OF_STATES) or key in ("pos", "vel")
    return way != "conversion" or not ("stress" in key or "mises" in key or key == "cell_dim")


def shards(specs: dict[str, DatasetSpec], folder: Path) -> dict[str, Path]:
    """Make a shard of a few short trajectories of each data set."""
    folder.mkdir(parents=True, exist_ok=True)
    found = {}
    for name, spec in specs.items():
        found[name] = folder / f"{name}.h5"
        write_shard(found[name], [generate_trajectory(spec, "train", k, num_frames=NUM_FRAMES) for k in range(2)])
    return found


def faults(sound: dict[str, Path], seed: int = 0) -> list[Fault]:
    """Return a fault for every wrong value, field and way of entry, in one shard of each data set."""
    found = []
    for domain, shard in sound.items():
        fields = sorted(_sound(shard)[1])
        for way in WAYS:
            for key in fields:
                if not _applies(way, key):
                    continue
                values = (*OFFENDERS[FIELDS[key].values], *((LONGER,) if key not in ("cell_dim", "cells") else ()))
                for number, value in enumerate(values):
                    attack = partial(brought_in, way, shard, key, value, seed + number)
                    found.append(Fault(f"value, {way}", f"{domain}, {key}: {value}", attack))
    return found
