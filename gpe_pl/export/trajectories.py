"""Export of trajectories to other programs: VTK series for ParaView, and NumPy archives.

A series is a file ``NAME.pvd``, which the user opens, and a folder ``NAME`` with an unstructured grid per frame (``.vtu``, zlib-compressed, base64). Mesh nodes
belong to the cells of the mesh. Every other node is a cell of its own, so particles appear as points. The format is the XML part of the VTK file formats
[Kitware, docs.vtk.org].
"""

from __future__ import annotations

import base64
import contextlib
import math
import re
import shutil
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import Float

from gpe_pl.files.atomic import replace_text, replacing
from gpe_pl.graphs.islands import unwrapped
from gpe_pl.metrics import displacement
from gpe_pl.schema import CELL_KINDS
from gpe_pl.trajectory.cells import cell_edges, is_corner, kinds_of
from gpe_pl.trajectory.source_origin import KEY, origin_of
from gpe_pl.trajectory.state import von_mises
from gpe_pl.trajectory.store import PREDICTION, stored_arrays, stored_attributes
from gpe_pl.trajectory.trajectory import Trajectory

BOUNDARY = "boundary.vtu"
OWN_FILE = re.compile(r"frame_\d{5,}\.vtu|" + re.escape(BOUNDARY))
"""Names of the files in the folder of a series."""
VERTEX = 1
CELL_TYPES = {"line": 3, "triangle": 5, "quadrilateral": 9, "tetrahedron": 10, "wedge": 13, "hexahedron": 12}
"""VTK's codes for kinds of cells."""

SYMMETRIC = {4: (0, 2, 3, 1), 6: (0, 3, 5, 1, 4, 2)}
"""Positions of VTK's components XX, YY, ZZ, XY, YZ, XZ in a stress with this number of components; in plane strain the last two are zero."""

VTK_TYPES = {"float32": "Float32", "float64": "Float64", "int32": "Int32", "int64": "Int64", "uint8": "UInt8"}


def write_npz(path: Path | str, trajectory: Trajectory) -> None:
    """Write a trajectory as arrays that ``numpy.load`` reads, in the precision of the store. The file is written atomically.

    Names, shapes and units are those of ``schema.FIELDS``; ``metadata``, ``shapes`` and ``node_types`` are JSON. Rollouts of models also have
    ``prediction``. If an import moved the origin, ``origin`` [dim] in m is where it is in the coordinates of the source: add it to positions and bounds.
    ``convert format=arrays`` imports such files, other than rollouts of models.

    Raises:
        ValueError: ``path`` does not end in ``.npz``.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise ValueError(f"{path}: a NumPy archive ends in .npz")
    texts = {key: np.array(text) for key, text in stored_attributes(trajectory).items()}
    texts |= {PREDICTION: np.array("")} if trajectory.is_prediction else {}
    origin = origin_of(trajectory.metadata)
    moved = {} if origin is None else {KEY: origin}
    with replacing(path) as part:
        np.savez_compressed(part, allow_pickle=False, **stored_arrays(trajectory), **texts, **moved)


def write_vtk(path: Path | str, trajectory: Trajectory, ground_truth: Trajectory | None = None, stride: int = 1) -> None:
    """Write a series for ParaView: ``path`` (``.pvd``), and a folder of the same name with a file per frame and the boundary.

    Points have ``velocity`` [m/s], ``material`` (index into ``schema.NODE_TYPES``), ``mass`` [kg] and the material parameters by name. If available, they also
    have ``displacement`` from rest [m], ``error`` (distance from the ground truth [m], NaN for nodes that it does not have in that frame), ``stress`` [Pa] and
    ``von_mises`` [Pa]. Cells have the last two as well, NaN on particles. Moving boundary nodes are points like others; ``boundary.vtu`` has the rest, with
    ``normal``, ``friction`` and ``restitution``.

    Positions are in the coordinates of the source. If an import moved the origin, they are written in double precision.

    An earlier series at this path is replaced: those of its files that the new one does not have are removed.

    In an open scene, each file has the nodes that are in the scene in its frame, with their numbers as ``node``.

    In a periodic domain, connected nodes of a mesh are written as images that lie beside each other. Cells then stay whole at the seam, unless the mesh reaches
    around the domain. ``displacement`` follows the path of the nodes across seams.

    Args:
        path: file that ends in ``.pvd``.
        trajectory: ground truth or prediction.
        ground_truth: ground truth with the same frames and nodes, for ``error``; its later frames are ignored.
        stride: step between written frames.

    Raises:
        ValueError: the file type is wrong, the stride is not positive, the ground truth has other nodes, fewer frames or another start, a cell has no known
            kind, or an open scene has a mesh.
        FullDiskError: the disk is full; the written part of a new series is removed.
    """
    path = Path(path)
    if path.suffix != ".pvd":
        raise ValueError(f"{path}: a VTK series ends in .pvd")
    if stride < 1:
        raise ValueError(f"stride must be positive, got {stride}")
    if ground_truth is not None:
        trajectory = trajectory.with_nodes_of(ground_truth)  # a rollout of an open scene that stopped early has fewer
    if ground_truth is not None and (ground_truth.num_nodes != trajectory.num_nodes or ground_truth.num_frames < trajectory.num_frames):
        raise ValueError(
            f"{path}: the ground truth has {ground_truth.pos.shape[:2]} frames and nodes, the trajectory {trajectory.pos.shape[:2]}"
        )
    if ground_truth is not None and not math.isclose(trajectory.metadata.frame_dt, ground_truth.metadata.frame_dt, rel_tol=1e-6):
        raise ValueError(
            f"{path}: frames are {trajectory.metadata.frame_dt:g} s long, those of the ground truth {ground_truth.metadata.frame_dt:g} s"
        )
    if ground_truth is not None and abs(trajectory.start_time - ground_truth.start_time) > 0.5 * ground_truth.metadata.frame_dt:
        raise ValueError(
            f"{path}: the trajectory begins at {trajectory.start_time:g} s, the ground truth at {ground_truth.start_time:g} s; "
            "cut one of them (Trajectory.frames)"
        )
    if trajectory.alive is not None and trajectory.cells is not None:
        raise ValueError(f"{path}: meshes of open scenes are not written; write a NumPy archive")
    trajectory = trajectory.with_moving_boundary()
    ground_truth = None if ground_truth is None else ground_truth.with_moving_boundary()
    folder = path.with_suffix("")
    cells, num_particles = _cells(trajectory)
    mesh = np.empty((0, 3), np.int64) if trajectory.cells is None else trajectory.cells.astype(np.int64)
    edges = cell_edges(mesh, trajectory.num_nodes)
    moved = _displacements(trajectory, edges)
    entries, written = [], set[str]()
    with _whole(folder):
        for frame in range(0, trajectory.num_frames, stride):
            name = f"frame_{frame:05d}.vtu"
            points, in_cells = _point_data(trajectory, frame, ground_truth), _cell_data(trajectory, frame, num_particles)
            if moved is not None:
                points["displacement"] = _in_3d(moved[frame])
            pos, _ = unwrapped(trajectory.pos[frame].astype(np.float64), edges, trajectory.metadata.periodicity)
            pos = _in_source(pos.astype(trajectory.pos.dtype), trajectory)
            if trajectory.alive is not None:
                pos, cells, points = _living(trajectory, frame, pos, points)
            replace_text(folder / name, _grid(pos, cells, points, in_cells))
            written.add(name)
            time = frame * trajectory.metadata.frame_dt
            entries.append(f'<DataSet timestep="{time:.9g}" part="0" file={quoteattr(f"{folder.name}/{name}")}/>')
        boundary = trajectory.boundary
        if len(boundary.pos):
            data = {"normal": _in_3d(boundary.normal), "friction": boundary.friction, "restitution": boundary.restitution}
            replace_text(folder / BOUNDARY, _grid(_in_source(boundary.pos, trajectory), _vertices(np.arange(len(boundary.pos))), data, {}))
            written.add(BOUNDARY)
        replace_text(path, _document("Collection", "<Collection>\n" + "\n".join(entries) + "\n</Collection>"))
    for old in folder.glob("*.vtu"):
        if OWN_FILE.fullmatch(old.name) and old.name not in written:
            old.unlink()


@contextlib.contextmanager
def _whole(folder: Path) -> Iterator[None]:
    """Keep a new folder if the block succeeds, and remove it otherwise."""
    is_new = not folder.exists()
    try:
        yield
    except BaseException:
        if is_new:
            shutil.rmtree(folder, ignore_errors=True)
        raise


def _in_source(pos: np.ndarray, trajectory: Trajectory) -> np.ndarray:
    """Return positions [node, dim] in m in the coordinates of the source of the data."""
    origin = origin_of(trajectory.metadata)
    return pos if origin is None else pos.astype(np.float64) + origin


class _Cells(NamedTuple):
    """Cells in VTK's layout: nodes of one cell after the other, and the number of corners and VTK type of each [cell]."""

    nodes: np.ndarray
    corners: np.ndarray
    types: np.ndarray


def _vertices(nodes: np.ndarray) -> _Cells:
    """Return a cell for each particle."""
    return _Cells(nodes, np.ones(len(nodes), int), np.full(len(nodes), VERTEX))


def _cells(trajectory: Trajectory) -> tuple[_Cells, int]:
    """Return all cells, those of the mesh first, and the number of particles, which come last."""
    loose = _vertices(np.arange(trajectory.num_nodes))
    if trajectory.cells is None or len(trajectory.cells) == 0:
        return loose, len(loose.nodes)
    cells = trajectory.cells
    kinds, own = kinds_of(cells, trajectory.cell_dim, trajectory.metadata.dim), is_corner(cells)
    if (kinds < 0).any():
        cell = int(kinds.argmin())
        raise ValueError(f"cell {cell} has the nodes {cells[cell].tolist()}, which form none of {', '.join(CELL_KINDS)}")
    loose = _vertices(np.setdiff1d(np.arange(trajectory.num_nodes), cells))
    mesh = _Cells(cells[own], own.sum(axis=1), np.array([CELL_TYPES[kind] for kind in CELL_KINDS])[kinds])
    return _Cells(*(np.concatenate(parts) for parts in zip(mesh, loose, strict=True))), len(loose.nodes)


def _displacements(trajectory: Trajectory, edges: np.ndarray) -> np.ndarray | None:
    """Return displacements from rest [frame, node, dim] in m; None if there are no rest positions.

    In a periodic domain they are sums of the shortest steps between frames. All nodes of a mesh have a common start.
    """
    if trajectory.rest_pos is None:
        return None
    where = trajectory.metadata.periodicity
    moved = trajectory.pos.astype(np.float64) - trajectory.rest_pos
    moved[0] = unwrapped(where.shortest(moved[0]), edges, where)[0]
    for axis in where.axes:
        moved[..., axis] = np.unwrap(moved[..., axis], axis=0, period=where.period[axis])
    return moved.astype(trajectory.pos.dtype)


def _point_data(trajectory: Trajectory, frame: int, ground_truth: Trajectory | None) -> dict[str, np.ndarray]:
    data = {
        "velocity": _in_3d(trajectory.vel[frame]),
        "material": trajectory.node_type,
        "mass": trajectory.mass,
        **{name: trajectory.material_params[:, k] for k, name in enumerate(trajectory.metadata.param_names)},
    }
    if ground_truth is not None:
        data["error"] = np.linalg.norm(displacement(trajectory.pos[frame], ground_truth.pos[frame], trajectory.metadata), axis=-1)
        if ground_truth.alive is not None:
            data["error"] = np.where(ground_truth.alive[frame], data["error"], np.nan)
    if trajectory.stress is not None:
        data |= _stress(trajectory.stress.node[frame])
    return data


def _living(
    trajectory: Trajectory, frame: int, pos: np.ndarray, points: dict[str, np.ndarray]
) -> tuple[np.ndarray, _Cells, dict[str, np.ndarray]]:
    """Return positions, cells and data of the nodes that are in an open scene in a frame; ``node`` are their numbers."""
    assert trajectory.alive is not None
    there = np.flatnonzero(trajectory.alive[frame])
    return pos[there], _vertices(np.arange(len(there))), {"node": there, **{name: values[there] for name, values in points.items()}}


def _cell_data(trajectory: Trajectory, frame: int, num_particles: int) -> dict[str, np.ndarray]:
    if trajectory.stress is None or trajectory.cells is None:
        return {}  # the stress of particles is that of points
    stress = trajectory.stress.cell[frame]
    return _stress(np.concatenate([stress, np.full((num_particles, stress.shape[1]), np.nan, stress.dtype)]))


def _stress(stress: Float[np.ndarray, "item component"]) -> dict[str, np.ndarray]:
    ordered = np.zeros((len(stress), 6), stress.dtype)
    order = SYMMETRIC[stress.shape[1]]
    ordered[:, : len(order)] = stress[:, order]
    return {"stress": ordered, "von_mises": von_mises(stress)}


def _in_3d(values: Float[np.ndarray, "row dim"]) -> Float[np.ndarray, "row 3"]:
    return np.pad(values, ((0, 0), (0, 3 - values.shape[1])))


def _grid(pos: np.ndarray, cells: _Cells, points: Mapping[str, np.ndarray], in_cells: Mapping[str, np.ndarray]) -> str:
    """Return a ``.vtu`` document."""
    parts = [
        _array("Points", _in_3d(pos)).join(("<Points>", "</Points>")),
        "<Cells>",
        _array("connectivity", cells.nodes.astype(np.int64)),
        _array("offsets", np.cumsum(cells.corners).astype(np.int64)),
        _array("types", cells.types.astype(np.uint8)),
        "</Cells>",
        "<PointData>",
        *(_array(name, values) for name, values in points.items()),
        "</PointData>",
        "<CellData>",
        *(_array(name, values) for name, values in in_cells.items()),
        "</CellData>",
    ]
    piece = f'<Piece NumberOfPoints="{len(pos)}" NumberOfCells="{len(cells.types)}">\n' + "\n".join(parts) + "\n</Piece>"
    return _document("UnstructuredGrid", f"<UnstructuredGrid>\n{piece}\n</UnstructuredGrid>")


def _array(name: str, values: np.ndarray) -> str:
    """Return values as one compressed block after a header of four numbers: blocks, block size, size of a last partial block, compressed size."""
    values = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    data = zlib.compress(values.tobytes(), 1)
    header = np.array([1, values.nbytes, 0, len(data)] if values.nbytes else [0, 0, 0], "<u8").tobytes()
    text = base64.b64encode(header).decode() + (base64.b64encode(data).decode() if values.nbytes else "")
    components = f' NumberOfComponents="{values.shape[1]}"' if values.ndim == 2 else ""
    labels = {"stress": ("XX", "YY", "ZZ", "XY", "YZ", "XZ")}.get(name, ())
    components += "".join(f' ComponentName{k}="{label}"' for k, label in enumerate(labels))
    return f'<DataArray type="{VTK_TYPES[values.dtype.name]}" Name={quoteattr(name)}{components} format="binary">{text}</DataArray>'


def _document(kind: str, content: str) -> str:
    attributes = 'version="1.0" byte_order="LittleEndian" header_type="UInt64" compressor="vtkZLibDataCompressor"'
    return f'<?xml version="1.0"?>\n<VTKFile type="{kind}" {attributes}>\n{content}\n</VTKFile>\n'
