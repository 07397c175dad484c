"""Importer of dynamic computations of CalculiX: input decks of Abaqus or CalculiX with the results that CalculiX writes.

``source`` is a folder with ``train/``, ``val/``, ``test/`` and ``test_unseen/``, or a folder of files. Each trajectory is a deck ``NAME.inp`` and its results
``NAME.frd``. The deck has one ``*STEP`` with ``*DYNAMIC, DIRECT``, ``*NODE FILE`` with ``U`` and, for stresses, ``*EL FILE`` with ``S``, each for every frame.

What becomes of the deck and the results:

- Nodes and displacements ``U`` become positions. The undeformed positions are those before the step.
- Velocities ``V`` become velocities at the frames. Without them, velocities are differences of positions.
- ``S`` becomes the stress at nodes.
- Linear solid elements C3D4, C3D6 and C3D8 become cells, and their nodes are ``solid``, or as ``materials={1: elastomer}`` says by number of the material.
- ``*ELASTIC`` and ``*DENSITY`` become Young's modulus, Poisson's ratio and masses of nodes. A cell gives each corner an equal part of its mass.
- ``*BOUNDARY``, with or without a motion, becomes nodes whose motion is given along these axes.
- ``*CLOAD`` with its amplitude becomes forces on nodes. The force of a frame is the mean of the forces at its two ends.
- ``*DLOAD`` and ``*DSLOAD`` of pressures on faces become forces on nodes, too. With ``NLGEOM``, pressures follow the deformation: forces are those on the faces
  as they are in the results. Without it, they are those on undeformed faces.
- ``*DLOAD`` with ``GRAV`` becomes gravity, which must be the same for all elements at all times.

Units are those of the deck, which have to be SI units. The first frame is the time before the first result, in which everything is at rest and free of stress.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from gpe_pl.data.importers import deck, frd
from gpe_pl.data.importers.meshes import add_to_nodes, between_frames, check_intervals, sizes
from gpe_pl.data.importers.source import (
    Facts,
    ImportFailure,
    ImportSettings,
    Item,
    Loaded,
    Refusal,
    Source,
    build,
    natural,
    typed,
)
from gpe_pl.data.importers.split_places import split_folders
from gpe_pl.schema import BOUNDARY, MATERIALS

COMPONENTS = [0, 3, 5, 1, 4, 2]
"""Columns SXX, SYY, SZZ, SXY, SYZ, SZX of the results in the order xx, xy, xz, yy, yz, zz."""
SOLIDS = ("tetrahedron", "wedge", "hexahedron")
"""Kinds of cells that are read."""


def open_source(path: Path, settings: ImportSettings) -> Source:
    """Return the computations at ``path``.

    Raises:
        ImportFailure: there are no decks.
    """
    folders, warnings = split_folders(path, ".inp")
    splits = {}
    for split, folder in (folders or {"train": path}).items():
        files = sorted(folder.glob("*.inp"), key=lambda file: natural(file.name))
        splits[split] = [Item(file.stem, partial(_load, file, settings)) for file in files]
    if not any(splits.values()):
        raise ImportFailure(f"{path}: {'no such folder' if not path.is_dir() else 'holds no *.inp'}")
    return Source(Facts(frame_dt=_first_interval(splits, path, folders)).overridden(settings), splits, warnings)


def _first_interval(splits: dict[str, list[Item]], path: Path, folders: dict[str, Path]) -> float | None:
    """Return the time between frames of the first computation that can be read; None if there is none."""
    for split, items in splits.items():
        for item in items:
            try:
                times = frd.read(folders.get(split, path) / f"{item.name}.frd").times
            except Refusal:
                continue
            if times:
                return times[0]
    return None


def _load(path: Path, settings: ImportSettings, facts: Facts) -> Loaded:
    conditions, results = deck.read(path), frd.read(path.with_suffix(".frd"))
    times = np.array([0.0, *results.times])
    if len(times) < 3:
        raise Refusal(f"has {len(times) - 1} results; write every frame with *NODE FILE, FREQUENCY=1")
    check_intervals(times, facts, "use *DYNAMIC, DIRECT")
    count = len(results.times)
    moved = _frames(results, "DISP", count)
    if moved is None:
        raise Refusal("has no displacements; write them with *NODE FILE and U")
    others = [kind for kind in results.cells if kind not in SOLIDS]
    if others:
        raise Refusal(f"has cells of kind {others[0]}; only solid elements C3D4, C3D6 and C3D8 are read")
    number, mass, elastic, notes = _nodes(results, conditions)
    pos = results.rest_pos + np.concatenate([np.zeros((1, *results.rest_pos.shape)), moved])
    nodes = typed(pos, number, dict.fromkeys(np.unique(number).tolist(), "solid"), settings, cells=results.cells, rest_pos=results.rest_pos)
    nodes.notes.extend(notes)
    nodes.mass = mass
    for material in {*nodes.kind.tolist()} - {BOUNDARY}:
        if elastic is not None:
            nodes.parameters = {**nodes.parameters, material: dict(zip((p.name for p in MATERIALS[material]), elastic, strict=False))}
    held = [conditions.held.get(int(node), set()) for node in results.node_ids]
    prescribed = np.array([[axis in axes for axis in (1, 2, 3)] for axes in held])
    nodes.prescribed = prescribed if prescribed.any() else None
    force = conditions.force(results.node_ids, times, results.rest_pos, pos)
    nodes.force = None if force is None else between_frames(force)
    if (velocity := _frames(results, "VELO", count)) is not None:
        nodes.vel = np.concatenate([np.zeros((1, *velocity.shape[1:])), velocity])
    stress = _frames(results, "STRESS", count)
    if stress is not None:
        nodes.stress = np.concatenate([np.zeros((1, *stress.shape[1:])), stress])[..., COMPONENTS]
    nodes.gravity = None if conditions.gravity is None else tuple(conditions.gravity.tolist())
    return build(nodes, facts)


def _frames(results: frd.Results, name: str, count: int) -> np.ndarray | None:
    """Return a result of all frames [frame, node, component]; None if there is none."""
    found = results.fields.get(name)
    if found is None:
        return None
    if len(found) != count:
        raise Refusal(f"has {name} in {len(found)} of {count} frames; write all results with the same FREQUENCY")
    if name in results.partial:
        raise Refusal(f"has no {name} at node {results.partial[name]}; write results of all nodes, without NSET")
    return np.stack(found)


def _nodes(results: frd.Results, conditions: deck.Deck) -> tuple[np.ndarray, np.ndarray, list[np.ndarray] | None, list[str]]:
    """Return number of the material, mass [kg], Young's modulus [Pa] and Poisson's ratio of each node, and notes.

    At the border of materials, a node has the number of one of them and the means of their constants, weighted by mass.
    """
    count = len(results.node_ids)
    number, mass, constants = np.zeros(count, int), np.zeros(count), np.zeros((2, count))
    notes, is_elastic = [], True
    for kind, cells in results.cells.items():
        volume = sizes(results.rest_pos, kind, cells)
        for material in np.unique(results.material[kind]).tolist():
            name, own = results.material_names.get(material, "").upper(), results.material[kind] == material
            if name not in conditions.density:
                raise Refusal(f"material {name or material} has no *DENSITY, from which masses follow")
            is_elastic &= name in conditions.elastic
            share = conditions.density[name] * volume[own] / cells.shape[1]
            number[cells[own]] = material
            add_to_nodes(mass, cells[own], share)
            for k, value in enumerate(conditions.elastic.get(name, (0.0, 0.0))):
                add_to_nodes(constants[k], cells[own], share * value)
    if (mass == 0).any():
        raise Refusal(f"node {results.node_ids[int((mass == 0).argmax())]} belongs to no cell; leave it out of the deck")
    if conditions.damped:
        notes.append("materials have *DAMPING, which is not stored; models have to learn it (model.viscous=true with law=elastic)")
    if not is_elastic:
        notes.append("materials without *ELASTIC have no Young's modulus (parameters={solid: …})")
    return number, mass, [*(constants / mass)] if is_elastic else None, notes
