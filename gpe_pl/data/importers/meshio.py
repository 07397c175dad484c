"""Importer of computations of finite-element programs as series of VTK, VTU, XDMF or Exodus files, which the package meshio reads.

``source`` is a folder with ``train/``, ``val/``, ``test/`` and ``test_unseen/``, or a folder of trajectories. A trajectory is

- ``NAME.pvd`` with the VTU files that it lists, as ParaView writes them,
- ``NAME.xdmf`` or ``NAME.xmf`` with a series in time,
- ``NAME.e``, ``NAME.ex2`` or ``NAME.exo``: Exodus with all times, which also needs the package netCDF4, or
- a folder ``NAME/`` with one file per frame, of any format that meshio reads. Their names differ in numbers that rise from frame to frame. ``frame_dt`` has to
  be given. A folder with files that a PVD or XDMF file beside it lists is none.

Arrays are found by their names. ``arrays={displacement: U, stress: S}`` names those that are called otherwise in the files:

- ``displacement`` of points [point, axis] in m. If the points of the file are the same in all frames, displacements are added to them. If they move, they
  are positions, and displacements lead back to the undeformed positions. Without displacements, points that move are positions.
- ``velocity`` of points [point, axis] in m/s. Without it, velocities are differences of positions.
- ``stress`` of points or cells: 6 components in VTK's order XX, YY, ZZ, XY, YZ, XZ, or 9. The stress of a cell goes to its nodes, as the mean by size of cells.
- ``prescribed`` of points: not 0 where the motion is given, or [point, axis] along which axes it is.
- ``force`` of points [point, axis] in N at the times of the frames. From a frame to the next, the mean of both acts.
- ``mass`` of points [kg], or ``density`` of points or cells [kg/m³] (in 2D kg/m²) in the first frame, with which cells of the highest dimension count.
  Otherwise all masses are 1 kg, which does not suit forces.
- ``material`` of points: numbers, which ``materials={1: elastomer}`` names. Without it, all have number 0, which is ``solid`` for meshes.
- Parameters of materials at points or in cells, such as ``youngs_modulus`` and ``poisson_ratio``.

``prescribed``, ``mass``, ``material`` and parameters are the same in all frames; a series in which they change is refused.
Points keep their rows in all frames. Where rows change, numbers of points such as ``id`` or ``GlobalNodeId`` say which is which, see ``same_mesh``.

Scenes whose points all have the third coordinate 0 are two-dimensional. Cells are lines, triangles, quadrilaterals, tetrahedra, wedges and hexahedra; others
are refused. Cells on the surface of others, such as the triangles that mesh generators write beside tetrahedra, are left out. The importer needs ``meshio``
(``pip install 'gpe_pl[import]'``).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.data.importers.mesh_files import ENDINGS, Frame, files_of, read_series, times_of
from gpe_pl.data.importers.meshes import (
    add_to_nodes,
    between_frames,
    check_intervals,
    interval,
    mean_at_nodes,
    of_highest_dimension,
    outward,
    sizes,
    without_faces,
)
from gpe_pl.data.importers.same_mesh import in_one_order
from gpe_pl.data.importers.source import (
    Facts,
    ImportFailure,
    ImportSettings,
    Item,
    Loaded,
    Nodes,
    Refusal,
    Source,
    build,
    check_axes,
    natural,
    typed,
)
from gpe_pl.data.importers.split_places import split_folders
from gpe_pl.errors.printable import did_you_mean
from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.schema import BOUNDARY, CELL_KINDS, MATERIALS

PARAMETERS = tuple(dict.fromkeys(p.name for own in MATERIALS.values() for p in own))
ROLES = ("displacement", "velocity", "stress", "prescribed", "force", "mass", "density", "material", *PARAMETERS)
"""What arrays can be."""
COMPONENTS = {
    (3, 6): [0, 3, 5, 1, 4, 2],
    (3, 9): [0, 1, 2, 4, 5, 8],
    (2, 6): [0, 3, 1, 2],
    (2, 9): [0, 1, 4, 8],
}
"""Columns of a stress of 6 or 9 components in the order of ``schema.STRESS_COMPONENTS``, by dimension of space and number of components."""

ROUNDING = 1e-5
"""Values of two frames are the same if they differ by less than this fraction, because files store rounded numbers."""

WHOLE = 1e-3
"""Numbers of materials are whole within this margin."""


def open_source(path: Path, settings: ImportSettings) -> Source:
    """Return the computations at ``path``.

    Raises:
        ImportFailure: there are none, ``arrays`` names an unknown role, or meshio is missing.
    """
    try:
        import meshio  # noqa: F401
    except ModuleNotFoundError as error:
        raise ImportFailure(f"format=meshio: needs the package {error.name}; install it with `pip install 'gpe_pl[import]'`") from None
    for role in settings.arrays or {}:
        if role not in ROLES:
            raise ImportFailure(f"arrays.{role}: unknown{did_you_mean(role, ROLES)}; arrays are {', '.join(ROLES)}")
    folders, warnings = split_folders(path, *ENDINGS)
    found = {split: _trajectories(folder) for split, folder in (folders or {"train": path}).items()}
    splits = {split: [Item(place.stem, partial(_load, place, settings)) for place in places] for split, places in found.items() if places}
    if not splits:
        wanted = ", ".join(f"*{ending}" for ending in ENDINGS)
        raise ImportFailure(
            f"{path}: {'no such folder' if not path.is_dir() else f'holds no {wanted} and no folders with a file per frame'}"
        )
    first = next(iter(splits.values()))[0].name
    times = next((t for places in found.values() for place in places if (t := times_of(place)) is not None and len(t) > 1), None)
    facts = Facts(frame_dt=None if times is None else interval(times)).overridden(settings)
    if facts.frame_dt is None:
        raise ImportFailure(f"frame_dt: {first} has no times; pass frame_dt=… [s]")
    return Source(facts, splits, warnings)


def _trajectories(folder: Path) -> list[Path]:
    """Return files and folders that are a trajectory each. A folder belongs to a file if it has the file's name, or holds what the file lists."""
    if not folder.is_dir():
        return []
    files = [entry for entry in folder.iterdir() if entry.is_file() and entry.suffix.lower() in ENDINGS]
    named = {file.stem for file in files}
    listed = {parent for file in files for own in files_of(file) for parent in own.parents}
    folders = [entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith(".")]
    folders = [entry for entry in folders if entry.name not in named and entry.resolve() not in listed]
    return sorted([*files, *folders], key=lambda place: natural(place.name))


def _load(path: Path, settings: ImportSettings, facts: Facts) -> Loaded:
    frames = read_series(path)
    if len(frames) < 3:
        raise Refusal(f"has {len(frames)} frames; a trajectory needs at least 3")
    if frames[0].time is not None:
        check_intervals(np.array([frame.time for frame in frames], float), facts, "write results at even intervals")
    frames = in_one_order(frames)
    arrays = _Arrays(frames, settings.arrays or {}, facts.periodicity)
    pos, rest = _positions(frames, arrays)
    planar = not pos[..., 2:].any() and not rest[..., 2:].any() and not {"tetrahedron", "wedge", "hexahedron"} & {*frames[0].cells}
    dim = 2 if planar else 3
    check_axes(facts, dim)
    pos, rest, cells = pos[..., :dim], rest[..., :dim], without_faces(frames[0].cells, pos.shape[1])
    if "wedge" in cells:
        cells["wedge"] = outward(rest, cells["wedge"], facts.periodicity)
    nodes = typed(pos, _types(arrays, pos.shape[1]), {0: "solid"} if cells else {}, settings, cells=cells or None, rest_pos=rest)
    for kind, corners in frames[0].cells.items():
        if len(cells.get(kind, ())) < len(corners):
            nodes.notes.append(f"cells of kind {kind} whose corners all belong to one other cell of a higher dimension are left out")
    nodes.vel = _vectors(arrays, "velocity", dim)
    force = _vectors(arrays, "force", dim)
    nodes.force = None if force is None else between_frames(force)
    nodes.prescribed = _prescribed(arrays, dim)
    stress = arrays.at_points("stress", rest)
    if stress is not None:
        stress = stress.reshape(*stress.shape[:2], -1)
        if (dim, stress.shape[2]) not in COMPONENTS:
            raise Refusal(f"{arrays.name('stress')!r} has {stress.shape[2]} components, expected 6 (XX, YY, ZZ, XY, YZ, XZ) or 9")
        nodes.stress = stress[..., COMPONENTS[dim, stress.shape[2]]]
    _add_masses(nodes, arrays, rest, cells)
    for material in {*nodes.kind.tolist()} - {BOUNDARY}:
        values = {p.name: arrays.constant(p.name, arrays.at_points(p.name, rest)) for p in MATERIALS[material]}
        own = {name: value.reshape(-1) for name, value in values.items() if value is not None}
        if own:
            nodes.parameters = {**nodes.parameters, material: own}
    return build(nodes, facts)


def _types(arrays: _Arrays, num_nodes: int) -> np.ndarray:
    """Return the number of the material of each point [point]; 0 without such numbers."""
    numbers = arrays.constant("material", arrays.of_points("material"))
    if numbers is None:
        return np.zeros(num_nodes, int)
    numbers = numbers.reshape(num_nodes)
    found = np.rint(numbers)
    wrong = ~(np.abs(numbers - found) <= WHOLE)  # also NaN
    if wrong.any():
        node = int(wrong.argmax())
        file, name = arrays.frames[0].file, arrays.name("material")
        raise Refusal(
            f"{file}: array {name!r} is {numbers[node]:g} at node {node}; numbers of materials are whole, also at the border of two"
        )
    return found.astype(int)


def _prescribed(arrays: _Arrays, dim: int) -> np.ndarray | None:
    """Return of which points the motion is given [point], or along which axes it is [point, dim]; None if it is of none."""
    values = arrays.of_points("prescribed")
    if values is None:
        return None
    if np.isnan(values).any():
        frame, node, *_ = np.argwhere(np.isnan(values))[0].tolist()
        file, name = arrays.frames[frame].file, arrays.name("prescribed")
        raise Refusal(f"{file}: array {name!r} is NaN at node {node}; write 0 where the motion is free", frame)
    given = arrays.constant("prescribed", values != 0)
    if given is None or not given.any():
        return None
    per_axis = given.reshape(len(given), -1)
    return per_axis[:, :dim] if per_axis.shape[1] > 1 else per_axis[:, 0]


def _positions(frames: list[Frame], arrays: _Arrays) -> tuple[np.ndarray, np.ndarray]:
    """Return positions [frame, point, 3] and rest positions [point, 3], see the module."""
    points = np.stack([_padded(frame.points) for frame in frames])
    moved = arrays.of_points("displacement")
    if moved is not None:
        if moved.ndim != 3 or moved.shape[2] not in (2, 3):
            raise Refusal(f"{arrays.name('displacement')!r} has shape {list(moved.shape[1:])}, expected [point, 2] or [point, 3]")
        moved = _padded(moved.reshape(*points.shape[:2], -1))
    if (points != points[:1]).any():
        return points, points[0] if moved is None else points[0] - moved[0]
    if moved is None:
        raise Refusal(
            f"{frames[0].file}: points do not move, and there are no displacements; name them with arrays={{displacement: …}} ({arrays.there()})"
        )
    return points + moved, points[0]


def _padded(values: np.ndarray) -> np.ndarray:
    """Return vectors [..., axis] with three axes, the missing ones 0."""
    return np.concatenate([values, np.zeros((*values.shape[:-1], 3 - values.shape[-1]))], axis=-1)


def _vectors(arrays: _Arrays, role: str, dim: int) -> np.ndarray | None:
    """Return an array of vectors of points [frame, point, dim]; None if there is none."""
    values = arrays.of_points(role)
    if values is None:
        return None
    if values.ndim != 3 or values.shape[2] < dim:
        raise Refusal(f"{arrays.name(role)!r} has shape {list(values.shape[1:])}, expected [point, {dim}]")
    return values[..., :dim]


def _add_masses(nodes: Nodes, arrays: _Arrays, rest: np.ndarray, cells: Mapping[str, np.ndarray]) -> None:
    mass, density = arrays.constant("mass", arrays.of_points("mass")), arrays.in_cells("density", rest, cells)
    if mass is not None:
        nodes.mass = mass.reshape(-1)
    elif density is not None and cells:
        total, filling = np.zeros(len(rest)), of_highest_dimension(cells)
        kind = next(iter(filling))
        if (has := CELL_KINDS[kind][0]) != rest.shape[1]:
            raise Refusal(
                f"has a density, from which masses follow, and its cells of kind {kind} have {has} dimensions in {rest.shape[1]}D, so their thickness is not "
                f"known; give masses of points as {arrays.name('mass')!r}"
            )
        for kind, rows in filling.items():
            add_to_nodes(total, rows, density[kind] * sizes(rest, kind, rows, arrays.periodicity) / rows.shape[1])
        if (total == 0).any():
            raise Refusal(
                f"point {int((total == 0).argmax())} belongs to no cell of {has} dimensions, so it has no mass; leave it out or give {arrays.name('mass')!r}"
            )
        nodes.mass = total
    else:
        nodes.notes.append("masses are not in the source; 1 kg is stored for every node (arrays={mass: …} or arrays={density: …})")
        if nodes.force is not None:
            raise Refusal("has forces but no masses, and a model reads f/m; name them with arrays={mass: …} or arrays={density: …}")


class _Arrays:
    """Arrays of a series by role.

    Args:
        frames: the frames.
        names: names in the files by role, where they differ.
        periodicity: periodic axes of the domain, over whose seam cells may go.
    """

    def __init__(self, frames: list[Frame], names: Mapping[str, str], periodicity: Periodicity) -> None:
        self.frames, self.names, self.periodicity = frames, names, periodicity

    def name(self, role: str) -> str:
        """Return the name of an array in the files."""
        return self.names.get(role, role)

    def there(self) -> str:
        """Say which arrays the first frame has."""
        points, cells = (", ".join(map(repr, found)) or "none" for found in (self.frames[0].point_data, self.frames[0].cell_data))
        return f"point data: {points}; cell data: {cells}"

    def of_points(self, role: str) -> np.ndarray | None:
        """Return values of points [frame, point, …]; None if there are none.

        Raises:
            Refusal: a frame lacks the array or has another shape of it, or the settings name an array that is not there.
        """
        name = self.name(role)
        if name in self.frames[0].cell_data and name not in self.frames[0].point_data:
            raise Refusal(f"{self.frames[0].file} has {name!r} in cells, and values of points are needed; write it as point data", 0)
        return self._stacked(role, [frame.point_data.get(name) for frame in self.frames])

    def at_points(self, role: str, rest: np.ndarray) -> np.ndarray | None:
        """Return values of points, or the means of the values of cells around them [frame, point, …]; None if there are none."""
        name = self.name(role)
        if name in self.frames[0].point_data or name not in self.frames[0].cell_data:
            return self.of_points(role)
        found: list[Any] = []
        for frame in self.frames:
            values = frame.cell_data.get(name)
            whole = values is not None and {*values} >= {*frame.cells}
            found.append(mean_at_nodes(rest, frame.cells, values, self.periodicity) if whole and values is not None else None)
            if found[-1] is not None and np.isnan(found[-1]).any():
                raise Refusal(f"{frame.file} has no {name!r} in some of its cells; write it in all blocks of cells")
        return self._stacked(role, found)

    def constant(self, role: str, values: np.ndarray | None) -> np.ndarray | None:
        """Return values [frame, point, …] of the first frame; None if there are none.

        Raises:
            Refusal: those of a later frame differ by more than rounding.
        """
        if values is None:
            return None
        for k, (frame, own) in enumerate(zip(self.frames, values, strict=True)):
            if not np.allclose(own, values[0], rtol=ROUNDING, atol=0.0, equal_nan=True):
                raise Refusal(
                    f"{frame.file}: array {self.name(role)!r} differs from {self.frames[0].file}; it changes with time, and a trajectory has one value of "
                    "it per node. Give it the values that hold throughout, or give only the frames in which it does not change",
                    k,
                )
        return np.asarray(values[0])

    def in_cells(self, role: str, rest: np.ndarray, cells: Mapping[str, np.ndarray]) -> dict[str, np.ndarray] | None:
        """Return values of the cells of the highest dimension in the first frame by kind [cell], or the means of the values of their corners; None if there are
        none. Means over the cells around nodes would be wrong where values jump.
        """
        first, name = self.frames[0], self.name(role)
        of_points = self.of_points(role) if name in first.point_data or name not in first.cell_data else None
        if of_points is not None:
            return {kind: of_points[0].reshape(-1)[rows].mean(axis=1) for kind, rows in of_highest_dimension(cells).items()}
        if name not in first.cell_data:
            return None
        self.at_points(role, rest)  # refuses frames without it
        return {kind: np.asarray(first.cell_data[name][kind], np.float64).reshape(-1) for kind in of_highest_dimension(cells)}

    def _stacked(self, role: str, found: list[Any]) -> np.ndarray | None:
        name = self.name(role)
        later = next((frame.file for frame in self.frames[1:] if name in frame.point_data or name in frame.cell_data), None)
        if found[0] is None and later is not None and not (name in self.frames[0].point_data or name in self.frames[0].cell_data):
            raise Refusal(
                f"{self.frames[0].file} has no array {name!r}, and {later} has one; write it in all frames, also where it is 0", 0
            )
        if found[0] is None:
            if role in self.names:
                raise Refusal(f"{self.frames[0].file} has no array {name!r} (arrays={{{role}: {name}}}); {self.there()}")
            return None
        for k, (frame, values) in enumerate(zip(self.frames, found, strict=True)):
            if values is None or values.shape != found[0].shape:
                wrong = "no array" if values is None else f"another shape {list(values.shape)} of"
                raise Refusal(f"{frame.file} has {wrong} {name!r}, {self.frames[0].file} has one of shape {list(found[0].shape)}", k)
        return np.stack(found).astype(np.float64)
