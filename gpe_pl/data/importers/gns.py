"""Importer of the particles of "Learning to Simulate" (GNS) and of its PyTorch successor.

``source`` is a folder with ``metadata.json`` and ``train``, ``valid`` and ``test`` as one of

- ``.tfrecord``: a ``SequenceExample`` per trajectory with ``particle_type`` (int64 [node]) in its context and ``position`` (float32 [node × dim]) per frame;
- ``.npz``: an object array ``(position [frame, node, dim], particle_type [node] or scalar[, material_property])`` per trajectory, or one array of such
  tuples. These are pickles, which are read only with ``allow_pickle=true``;
- ``.h5``: a group per trajectory with ``positions``, ``particle_type`` and ``material_property``.

``metadata.json`` has ``bounds``, ``dt``, ``default_connectivity_radius``, ``dim`` and ``sequence_length``, which is the number of frames, or one less. The
number of frames is taken from the positions. Statistics such as ``vel_mean`` are per frame and not used; gpe_pl computes its own from the train split.

Types are 0 rigid, 3 boundary, 5 water, 6 sand and 7 goop, which is plastic and becomes ``snow``. Bounds are walls. The property of sand is tan φ.
Gravity is not in these files.

Sources: Sanchez-Gonzalez et al. 2020, and the layout of github.com/google-deepmind/deepmind-research, learning_to_simulate; github.com/geoelements/gns.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.data.importers import hdf5, npz, tfrecord
from gpe_pl.data.importers.source import (
    ASSUMED_FRICTION,
    SMALLEST,
    Facts,
    ImportFailure,
    ImportSettings,
    Item,
    Loaded,
    Refusal,
    Source,
    bounds_in,
    build,
    count_in,
    length_warning,
    number,
    read_json,
    typed,
)
from gpe_pl.data.importers.split_places import split_files
from gpe_pl.files.hdf5_arrays import is_named

TYPES = {0: "solid", 3: "boundary", 5: "fluid", 6: "sand", 7: "snow"}
PACKED = "gns_data"
"""Name of the array in an archive whose only array contains all trajectories."""


def open_source(path: Path, settings: ImportSettings) -> Source:
    """Return the data set at ``path`` in the format of this module.

    Raises:
        ImportFailure: there are no such files, one is damaged, or ``metadata.json`` lacks a value.
    """
    files, warnings = split_files(path, (".tfrecord", ".npz", ".h5"))
    described = (path if path.is_dir() else path.parent) / "metadata.json"
    values = read_json(described)
    if "bounds" not in values and isinstance(values.get("train"), dict):  # newer files have separate values for training and rollout
        values = values["train"]
    bounds = bounds_in(values, described)
    walls = {f"{axis}_{side}": ASSUMED_FRICTION for axis in "xyz"[: len(bounds)] for side in ("low", "high")}
    notes = [f"walls at the bounds with friction {ASSUMED_FRICTION:g}, an assumed value (walls={{x_low: …}}, or {{}} for none)"]
    if settings.gravity is None:
        notes.append("gravity is not in the source; 0 is stored, and models learn it as any other force (gravity=[…])")
    if "context_mean" in values:
        notes.append("step_context, a global input per frame, has no place in the store and was left out")
    facts = Facts(
        number(values, "dt", described, low=SMALLEST),
        bounds,
        connectivity_radius=number(values, "default_connectivity_radius", described, low=SMALLEST),
        walls=walls,
        notes=tuple(notes),
    ).overridden(settings)
    length, dim = (count_in(values, key, described) for key in ("sequence_length", "dim"))
    warnings += (
        () if dim in (None, len(bounds)) else (f"dim = {dim} in {described.name}, but bounds have {len(bounds)} axes, which were taken",)
    )
    readers = {".tfrecord": _in_records, ".npz": _in_archive, ".h5": _in_hdf5}
    return Source(facts, {split: readers[file.suffix](file, len(bounds), length, settings) for split, file in files.items()}, warnings)


def _loaded(
    pos: np.ndarray, types: np.ndarray, value: np.ndarray | None, length: int | None, settings: ImportSettings, facts: Facts
) -> Loaded:
    if types.size == 1:
        types = np.full(pos.shape[1], types.item())
    if types.shape != (pos.shape[1],):
        raise Refusal(f"particle_type has shape {list(types.shape)} for {pos.shape[1]} nodes")
    nodes = typed(pos, types, TYPES, settings, warnings=length_warning(len(pos), "sequence_length", length))
    if value is not None:
        if value.size != 1 and value.shape != types.shape:
            raise Refusal(f"material_property has shape {list(value.shape)} for {pos.shape[1]} nodes")
        if "sand" in set(nodes.kind.tolist()):
            nodes.parameters = {"sand": np.degrees(np.arctan(np.broadcast_to(np.asarray(value, np.float64).ravel(), pos.shape[1])))}
        else:
            nodes.notes.append("material_property is tan φ of sand, but no particle is sand: left out")
    return build(nodes, facts)


# --- containers ----------------------------------------------------------------------------------------------------------------------------


def _in_records(path: Path, dim: int, length: int | None, settings: ImportSettings) -> list[Item]:
    def load(record: tfrecord.Record, facts: Facts) -> Loaded:
        context, lists = tfrecord.sequence_example(record.read())
        types = _buffer(context.get("particle_type"), "particle_type", "<i8")
        frames, count = lists.get("position"), dim * types.size
        if not frames:
            raise Refusal(f"there is no position, expected {dim} for each of the {types.size} particle types")
        strings = frames.strings(4 * count)
        if len(strings) < len(frames) or count == 0:
            wrong = 0 if count == 0 else len(strings)
            found = _buffer(frames[wrong], "position", "<f4").size
            raise Refusal(f"position has {found} numbers, expected {dim} for each of the {types.size} particle types", wrong)
        return _loaded(strings.view("<f4").reshape(len(frames), -1, dim), types, None, length, settings, facts)

    return [Item(f"record {k}", partial(load, record)) for k, record in enumerate(tfrecord.records(path))]


def _buffer(feature: tfrecord.Feature | None, name: str, dtype: str) -> np.ndarray:
    """Return the numbers that a feature stores as one string of bytes."""
    if not isinstance(feature, list) or len(feature) != 1 or len(feature[0]) % np.dtype(dtype).itemsize:
        found = "missing" if feature is None else f"{len(feature)} values of {'bytes' if isinstance(feature, list) else feature.dtype}"
        raise Refusal(f"{name} is {found}, expected one string of bytes of {np.dtype(dtype)}")
    return np.frombuffer(feature[0], dtype)


def _in_archive(path: Path, dim: int, length: int | None, settings: ImportSettings) -> list[Item]:
    names = npz.names(path)
    if names == [PACKED]:
        try:
            packed = npz.read(path, PACKED, settings.allow_pickle)
        except Refusal as refusal:
            raise ImportFailure(f"{path}: {refusal}") from None
        if packed.ndim == 0:
            raise ImportFailure(f"{path}: {PACKED} is a single {type(packed.item()).__name__}, expected an array of trajectories")
        return [Item(f"{PACKED}[{k}]", partial(_from_parts, part, dim, length, settings)) for k, part in enumerate(packed)]

    def load(name: str, facts: Facts) -> Loaded:
        return _from_parts(npz.read(path, name, settings.allow_pickle), dim, length, settings, facts)

    return [Item(name, partial(load, name)) for name in names]


def _from_parts(parts: Any, dim: int, length: int | None, settings: ImportSettings, facts: Facts) -> Loaded:
    if not isinstance(parts, (np.ndarray, tuple, list)) or len(parts) not in (2, 3):
        raise Refusal("is not (position, particle_type[, material_property])")
    arrays = []
    for name, part in zip(("position", "particle_type", "material_property"), parts, strict=False):
        array = np.asarray(part)
        if array.dtype.kind not in "fiu":
            raise Refusal(f"{name} has type {array.dtype}, expected numbers")
        arrays.append(array)
    pos, types = arrays[:2]
    if pos.ndim != 3 or pos.shape[2] != dim:
        raise Refusal(f"position has shape {list(pos.shape)}, expected [frame, node, {dim}]")
    return _loaded(pos, types, arrays[2] if len(arrays) == 3 else None, length, settings, facts)


def _in_hdf5(path: Path, dim: int, length: int | None, settings: ImportSettings) -> list[Item]:
    def load(name: str, facts: Facts) -> Loaded:
        with hdf5.opened(path) as file:
            group = file[name]
            pos = hdf5.array(group, "positions", "frame, node, dim", "f")
            types = hdf5.array(group, "particle_type", "node", "iu")
            value = hdf5.array(group, "material_property", "node") if is_named(group, "material_property") else None
        if pos.shape[2] != dim:
            raise Refusal(f"positions have {pos.shape[2]} components, bounds have {dim}")
        return _loaded(pos, types, value, length, settings, facts)

    return [Item(name, partial(load, name)) for name in hdf5.groups(path)]
