"""Importer of moving meshes of MeshGraphNets: cloth and deforming solids.

``source`` is a folder with ``meta.json`` and ``train``, ``valid`` and ``test`` as ``.tfrecord`` (an ``Example`` per trajectory, each field one string of
bytes) or ``.h5`` (a group per trajectory with a data set per field). ``meta.json`` gives ``field_names``, ``trajectory_length``, ``dt``, and for each of the
``features`` its ``type`` (``static`` has one frame, ``dynamic`` all frames, ``dynamic_varlen`` a varying number of nodes), ``dtype`` and ``shape``. The
importer reads ``world_pos`` [frame, node, 3], ``mesh_pos`` [1, node, 2 or 3], ``cells`` [1, cell, corner] and ``node_type`` [1, node, 1]. Cells of four corners
are quadrilaterals if ``mesh_pos`` has only two components, or lies in a plane normal to an axis. Otherwise they are tetrahedra.

Types are 0 normal, 1 obstacle, 3 handle and 6 wall. Normal nodes become an ``elastomer``. Handles become nodes of the same mesh whose motion is given.
Obstacles and walls become boundary nodes, still or moving as in the source, and cells with boundary nodes are left out. ``materials={3: boundary}`` makes
handles boundary nodes, too. Data without ``world_pos`` (``cylinder_flow``, ``airfoil``) are
fields on a still mesh and are refused, because their nodes have no trajectory. The ``stress`` of a source is the von Mises stress only. It does not determine
the stress tensor and is left out.

Source: Pfaff et al. 2021, and the layout of github.com/google-deepmind/deepmind-research, meshgraphnets.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.data.importers import hdf5, tfrecord
from gpe_pl.data.importers.source import (
    Facts,
    ImportFailure,
    ImportSettings,
    Item,
    Loaded,
    Refusal,
    Source,
    build,
    length_warning,
    number,
    read_json,
    typed,
)
from gpe_pl.data.importers.split_places import split_files
from gpe_pl.schema import BOUNDARY

NORMAL, HANDLE = 0, 3
TYPES = {NORMAL: "elastomer", 1: "boundary", HANDLE: "elastomer", 6: "boundary"}
NEEDED = ("world_pos", "mesh_pos", "cells", "node_type")
LENGTH_RATIO = 3.0
"""A warning is given if edges of cells are longer or shorter at rest than in the first frame by more than this factor."""


def open_source(path: Path, settings: ImportSettings) -> Source:
    """Return the data set at ``path`` in the format of this module.

    Raises:
        ImportFailure: there are no such files, one is damaged, ``meta.json`` lacks a value, or the meshes do not move or change their nodes.
    """
    files, warnings = split_files(path, (".tfrecord", ".h5"))
    described = (path if path.is_dir() else path.parent) / "meta.json"
    meta = read_json(described)
    features = meta.get("features")
    if not isinstance(features, dict) or not all(isinstance(f, dict) for f in features.values()):
        raise ImportFailure(f"{described}: features = {features!r}, expected an object with an object for each field")
    if "world_pos" not in features:
        raise ImportFailure(
            f"{described}: has no world_pos but {', '.join(sorted(features))}: a field on a still mesh, not nodes that move, which gpe_pl learns"
        )
    missing = [name for name in NEEDED if name not in features]
    if missing:
        raise ImportFailure(f"{described}: features lack {', '.join(missing)}")
    varying = [name for name in NEEDED if features[name].get("type") == "dynamic_varlen"]
    if varying or any(features[name].get("type") == "dynamic" for name in ("mesh_pos", "cells", "node_type")):
        raise ImportFailure(
            f"{described}: {', '.join(varying) or 'the mesh'} changes with time (remeshing); gpe_pl needs the same nodes in all frames"
        )
    length = meta.get("trajectory_length")
    if type(length) is not int or length < 3:
        raise ImportFailure(f"{described}: trajectory_length = {length!r}, expected an integer of at least 3")
    notes = []
    if settings.gravity is None:
        notes.append("gravity is not in the source; 0 is stored, and models learn it as any other force (gravity=[…])")
    if "stress" in features:
        notes.append("stress of the source is von Mises' only: left out")
    frame_dt = number(meta, "dt", described, low=0.0) if meta.get("dt") is not None else 0.0
    if frame_dt == 0 and settings.frame_dt is None:
        raise ImportFailure(f"{described}: dt = {meta.get('dt')!r} does not say how much time passes between frames; pass frame_dt=… [s]")
    facts = Facts(frame_dt or None, notes=tuple(notes)).overridden(settings)

    def from_record(record: tfrecord.Record, facts: Facts) -> Loaded:
        stored = tfrecord.example(record.read())
        fields = {name: _decoded(stored.get(name), name, features[name]) for name in NEEDED if name != "world_pos"}
        num_nodes = fields["node_type"].shape[1]
        fields["world_pos"] = _decoded(stored.get("world_pos"), "world_pos", features["world_pos"], num_nodes)
        if len(fields["world_pos"]) in (2 * length, length / 2):
            raise Refusal(
                f"world_pos has {len(fields['world_pos'])} frames of {features['world_pos']['dtype']}, trajectory_length = {length}: by a factor of 2 the "
                "type may be the wrong one; correct meta.json"
            )
        return _loaded(fields, length, settings, facts)

    def from_group(file: Path, name: str, facts: Facts) -> Loaded:
        with hdf5.opened(file) as opened:
            fields = {key: hdf5.array(opened[name], key, "frame, row, component") for key in NEEDED}
        return _loaded(fields, length, settings, facts)

    splits = {}
    for split, file in files.items():
        if file.suffix == ".h5":
            splits[split] = [Item(name, partial(from_group, file, name)) for name in hdf5.groups(file)]
        else:
            splits[split] = [Item(f"record {k}", partial(from_record, record)) for k, record in enumerate(tfrecord.records(file))]
    return Source(facts, splits, warnings)


def _decoded(stored: tfrecord.Feature | None, name: str, feature: Mapping[str, Any], num_nodes: int | None = None) -> np.ndarray:
    """Decode a field [frame, row, component] by the type and shape in ``meta.json``.

    With ``num_nodes`` the field has that many rows, and the number of frames follows from its size. Without it the field has one frame.
    """
    if not isinstance(stored, list) or len(stored) != 1:
        raise Refusal(f"{name} is {'missing' if stored is None else 'not one string of bytes'}")
    data = stored[0]
    kind, shape = feature.get("dtype"), feature.get("shape")
    if (
        kind not in ("float32", "float64", "int32", "int64")
        or not isinstance(shape, list)
        or not shape
        or type(shape[-1]) is not int
        or shape[-1] < 1
    ):
        raise Refusal(f"{name}: meta.json says dtype {kind!r} and shape {shape!r}")
    dtype = np.dtype(kind).newbyteorder("<")
    rows = num_nodes or 1
    if len(data) == 0 or len(data) % (rows * shape[-1] * dtype.itemsize):
        raise Refusal(f"{name} has {len(data)} bytes, which is no whole number of {rows} × {shape[-1]} × {dtype.itemsize} bytes")
    array = np.frombuffer(data, dtype).reshape(*((-1, rows) if num_nodes else (1, -1)), shape[-1])
    stated = shape[1] if len(shape) == 3 and type(shape[1]) is int else -1
    if stated > 0 and stated != array.shape[1]:
        raise Refusal(f"{name} is {kind}{list(array.shape)}, meta.json says {stated} in the place of {array.shape[1]}")
    return array


def _scale_warning(cells: np.ndarray, rest: np.ndarray, pos: np.ndarray) -> list[str]:
    """Return a warning if cells at rest have a length that is far from that in the first frame."""
    if not len(cells) or cells.dtype.kind not in "iu" or cells.min() < 0 or cells.max() >= len(pos):
        return []  # refused later
    at_rest, first = (float(np.median(np.linalg.norm(x[cells[:, 0]] - x[cells[:, 1]], axis=1))) for x in (rest, pos.astype(np.float64)))
    if first / LENGTH_RATIO <= at_rest <= first * LENGTH_RATIO:
        return []
    return [f"edges of cells are {at_rest:.3g} m long in mesh_pos and {first:.3g} m in frame 0 of world_pos: are their units different?"]


def _loaded(fields: Mapping[str, np.ndarray], length: int, settings: ImportSettings, facts: Facts) -> Loaded:
    pos, rest, cells, types = (fields[name] for name in NEEDED)
    for name in ("mesh_pos", "cells", "node_type"):
        if any(not np.array_equal(frame, fields[name][0]) for frame in fields[name][1:]):
            raise Refusal(f"{name} changes with time (remeshing); gpe_pl needs the same nodes in all frames")
    num_nodes, dim = pos.shape[1:]
    if rest.shape[1] != num_nodes or types.shape[1:] != (num_nodes, 1) or not 1 <= rest.shape[2] <= dim:
        raise Refusal(f"world_pos, mesh_pos and node_type are {list(pos.shape)}, {list(rest.shape)} and {list(types.shape)}")
    warnings = length_warning(len(pos), "trajectory_length", length)
    flat = np.zeros((num_nodes, dim), np.float64)  # the rest positions of a sheet lie in a plane
    flat[:, : rest.shape[2]] = rest[0]
    is_sheet = dim == 2 or cells.shape[2] == 3 or (np.ptp(flat, axis=0) == 0).any()
    kind = ({3: "triangle", 4: "quadrilateral"} if is_sheet else {4: "tetrahedron", 8: "hexahedron"}).get(cells.shape[2])
    if kind is None:
        raise Refusal(f"cells have {cells.shape[2]} corners, which no kind of cell {'of a sheet ' if is_sheet else ''}has")
    warnings += _scale_warning(cells[0], flat, pos[0])
    table = TYPES | {HANDLE: (settings.materials or {}).get(NORMAL, TYPES[NORMAL])}
    nodes = typed(pos, types[0, :, 0], table, settings, cells={kind: cells[0]}, rest_pos=flat, warnings=warnings)
    handles = (types[0, :, 0] == HANDLE) & (nodes.kind != BOUNDARY)
    if handles.any():
        nodes.prescribed = handles
        nodes.notes.append(f"the motion of nodes of type {HANDLE} is given (prescribed nodes)")
    return build(nodes, facts)
