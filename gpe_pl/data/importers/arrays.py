"""Importer of your own arrays in NumPy archives.

``source`` is a folder with ``train/``, ``val/``, ``test/`` and ``test_unseen/``, or a folder of files. Files are ``.npz`` archives with one trajectory each::

    np.savez("train/00.npz", pos=pos, frame_dt=0.01, materials="fluid", params_fluid=1e-3, bounds=bounds, periodic=[True, False])

Keys are the arguments of ``Trajectory.from_numpy``, which documents them. ``params_{material}`` stands for ``params[material]``, and
``params_{material}_{name}`` for one of several parameters, such as ``params_elastomer_poisson_ratio``. ``cells_{kind}`` stands for ``cells[kind]``.
``boundary_pos``, ``boundary_normal``, ``boundary_vel``, ``boundary_friction`` and ``boundary_restitution`` are arguments of ``Boundary.from_numpy``, or of
``Boundary.moving`` if ``boundary_pos`` is [frame, boundary_node, dim]. Then ``boundary_vel`` is ignored, and ``boundary_normal`` has either every frame or only
the first. Without ``boundary_normal``, normals are estimated. Required keys are ``pos``, ``frame_dt``, ``materials`` and ``params_…``, and ``mass`` with
forces. Settings of the command override the files, except for the parameters that a file has. Trajectories that this package exported as ``.npz`` are read
too (``exported``).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.data.importers import exported, npz
from gpe_pl.data.importers.given_values import merged, replaced
from gpe_pl.data.importers.source import (
    Facts,
    ImportFailure,
    ImportSettings,
    Item,
    Loaded,
    Refusal,
    Source,
    joined,
    natural,
    walls_at_bounds,
)
from gpe_pl.data.importers.split_places import split_folders
from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.schema import MATERIALS
from gpe_pl.trajectory.arrays import estimated_normals, flags, numbers
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.trajectory import Trajectory

KEYS = (
    *(
        "pos",
        "frame_dt",
        "materials",
        "vel",
        "mass",
        "bounds",
        "periodic",
        "gravity",
        "spacing",
        "connectivity_radius",
        "cells",
        "rest_pos",
        "rigid_body",
        "stress",
        "prescribed",
        "force",
    ),
    *(f"boundary_{name}" for name in ("pos", "normal", "vel", "friction", "restitution")),
)
PREFIXES = ("params_", "cells_")
"""Prefixes of keys, followed by a material or a kind of cells."""
PER_NODE = ("frame_dt", "materials", "mass", "bounds", "periodic", "gravity", "spacing", "connectivity_radius")
"""Keys with at most one value per node, or ``FEW`` values for the scene. Keys that begin with ``params_`` belong to them too."""
AS_NUMBERS = "names as text, np.array(names, dtype=str), and frames of equal shape as one array, np.stack(frames)"
FEW = 6
"""Maximum number of values that describe a scene."""
SCALARS = ("frame_dt", "spacing", "connectivity_radius")
"""Keys with one value."""


def open_source(path: Path, settings: ImportSettings) -> Source:
    """Return the data set at ``path`` in the format of this module.

    Raises:
        ImportFailure: there are no such files.
    """
    folders, warnings = split_folders(path, ".npz")
    files = {
        split: sorted(folder.glob("*.npz"), key=lambda file: natural(file.name)) for split, folder in (folders or {"train": path}).items()
    }
    given = Facts().overridden(settings)
    splits = {split: [Item(file.name, partial(_load, file, given)) for file in found] for split, found in files.items()}
    splits = {split: items for split, items in splits.items() if items}
    if not splits:
        raise ImportFailure(f"{path}: {'no such folder' if not path.is_dir() else 'holds no *.npz'}")
    return Source(given, splits, warnings)


def _load(path: Path, stated: Facts, facts: Facts) -> Loaded:
    try:
        names = npz.names(path)
        if exported.KEY in names:
            return exported.load(path, names, stated)
        values: dict[str, Any] = {}
        for name in sorted(names, key="pos".__ne__):  # "pos" first, because it determines the number of nodes
            if name in KEYS or name.startswith(PREFIXES):
                pos = values.get("pos")
                few = pos is not None and pos.ndim > 1 and (name in PER_NODE or name.startswith("params_"))
                values[name] = npz.read(path, name, most_values=max(pos.shape[1], FEW) if few and pos is not None else None)
    except npz.ObjectsRefused as refused:
        raise Refusal(f"{refused.fault}; it is never read. Save {AS_NUMBERS}") from None
    except ImportFailure as failure:
        raise Refusal(str(failure).removeprefix(f"{path}: ")) from None
    wrong = [name for name in names if name not in KEYS and not name.startswith(PREFIXES)]
    missing = [name for name in ("pos", "frame_dt", "materials") if name not in names]
    if wrong or missing:
        raise Refusal(
            f"has {f'an unknown key {wrong[0]!r}' if wrong else f'no {missing[0]!r}'}; keys are params_MATERIAL, params_MATERIAL_NAME, cells_KIND, "
            f"{', '.join(KEYS)}"
        )
    for name in SCALARS:
        if name in values:
            if values[name].size != 1:
                raise Refusal(f"{name} has shape {list(values[name].shape)}, expected one number")
            values[name] = values[name].item()
    materials = values["materials"]
    if materials.dtype.kind == "S":  # as HDF5 files store text
        materials = np.char.decode(materials, "utf-8", "replace")
    if materials.dtype.kind != "U":
        raise Refusal(f"materials is {materials.dtype}, expected text")
    values["materials"] = materials.item() if materials.ndim == 0 else materials.tolist()
    own: dict[str, Any] = {}
    for name in names:
        if name.startswith("params_"):
            material, _, parameter = name.removeprefix("params_").partition("_")
            if not parameter and material in MATERIALS:
                parameter = MATERIALS[material][0].name
            own.setdefault(material, {})[parameter] = values.pop(name)
    if by_kind := {name.removeprefix("cells_"): values.pop(name) for name in names if name.startswith("cells_")}:
        if "cells" in values:
            raise Refusal(f"has cells and cells_{next(iter(by_kind))}; give all of them by kind")
        values["cells"] = by_kind
    own_bounds = None if stated.bounds is not None else values.get("bounds")  # later, all files have the bounds that enclose theirs
    given = {"frame_dt", "bounds", "periodic", "gravity", "spacing", "connectivity_radius"}
    values |= {name: value for name in given if (value := getattr(facts, name)) is not None}
    given_values = {m: v for m, v in facts.parameters.items() if m in np.unique(values["materials"])}
    values["params"] = merged(given_values, own)
    space = _periodicity(values)
    wall = {name.removeprefix("boundary_"): values.pop(name) for name in names if name.startswith("boundary_")}
    notes = [*replaced(given_values, own)]
    if wall:
        if "pos" not in wall:
            raise Refusal("has boundary arrays but no 'boundary_pos'")
        moves, dim = wall["pos"].ndim == 3, values["pos"].shape[-1] if values["pos"].ndim == 3 else None
        wall["pos"] = numbers("boundary_pos", wall["pos"], {**({"frame": None} if moves else {}), "boundary_node": None, "dim": dim})
        if "normal" not in wall:
            points, visited = (wall["pos"][0], values["pos"][0]) if moves else (wall["pos"], values["pos"])
            wall["normal"] = estimated_normals(points, visited, space)
            notes.append("normals of boundary nodes are estimated: they point to where the other nodes have been")
        if moves:
            wall.pop("vel", None)  # velocities follow from the positions
            wall |= {"frame_dt": values["frame_dt"], "periodicity": space}
        make = Boundary.moving if moves else Boundary.from_numpy
        values["boundary"] = make(wall.pop("pos"), wall.pop("normal"), **wall)
    if facts.walls:
        dim = numbers("pos", values["pos"], {"frame": None, "node": None, "dim": None}).shape[2]
        rows = values.get("bounds") if own_bounds is None else own_bounds
        bounds = None if rows is None else tuple((float(low), float(high)) for low, high in rows)
        here = replace(facts, bounds=bounds, periodic=space.periodic or None)
        values["boundary"] = joined(dim, values.get("boundary", Boundary.empty(dim)), walls_at_bounds(here, dim))
    return Loaded(Trajectory.from_numpy(**values), notes=tuple(notes))


def _periodicity(values: dict[str, Any]) -> Periodicity:
    """Return the periodicity of a file, after the settings have overridden it."""
    if "bounds" not in values:
        return NOWHERE  # a periodic axis without bounds is refused later, with the trajectory
    dim = numbers("pos", values["pos"], {"frame": None, "node": None, "dim": None}).shape[2]
    rows = numbers("bounds", values["bounds"], {"axis": dim, "low and high": 2})
    return Periodicity(tuple((float(low), float(high)) for low, high in rows), flags("periodic", values.get("periodic"), dim))
