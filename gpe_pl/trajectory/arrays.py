"""Checks of users' arrays, with errors that name argument, frame and node, and properties derived from positions: velocities, spacing, normals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gpe_pl.errors import GpeError
from gpe_pl.errors.printable import did_you_mean
from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.geometry.shapes import check_bounds
from gpe_pl.schema import BOUNDARY, CELL_KINDS, LARGEST, MATERIALS, MESH_MATERIALS, NODE_TYPES, node_code, param_names, parameters_by_name
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.cells import fitting_kinds, stacked

RADIUS_SPACINGS = 2.0
"""Default connectivity radius in rest spacings: about 12 neighbours in the plane and 32 in space."""

FRAMES_AT_ONCE = 256
NEIGHBOURS = 16
MAX_VISITED = 50_000
"""Maximum number of points of free space from which normals are estimated."""


class ArrayError(GpeError, ValueError):
    """Raised when an array or value does not fit. The message names it, with frame and node if a single one is concerned.

    Attributes:
        frame: number of the frame, -1 if the fault is not in a single frame.
    """

    def __init__(self, message: str, frame: int = -1) -> None:
        super().__init__(message)
        self.frame = frame


def numbers(name: str, values: Any, axes: Mapping[str, int | None]) -> np.ndarray:
    """Return values as an array after checking its shape, and that all numbers are real, finite and at most ``LARGEST`` in magnitude.

    Args:
        name: name of the argument, for messages.
        values: anything that NumPy converts to an array.
        axes: name and size of each axis; a size of None allows any.

    Raises:
        ArrayError: values are masked, are not real numbers or have another shape, or a number is not finite or too large. The message names the first place.
    """
    if np.ma.is_masked(values):
        raise ArrayError(f"{name}: is a masked array with {np.ma.count_masked(values)} masked values; only whole arrays can be used")
    try:
        array = np.asarray(values)
    except (ValueError, TypeError, RuntimeError) as error:  # the last from tensors that require a gradient
        raise ArrayError(f"{name}: not an array of numbers ({error})") from None
    if array.dtype.kind not in "fiu":
        raise ArrayError(f"{name}: has type {array.dtype}, expected real numbers")
    array = array.astype(np.float32) if array.dtype == np.float16 else array  # half precision has no number as large as ``LARGEST``
    wanted = ", ".join(axis if size is None else f"{axis} {size}" for axis, size in axes.items())
    if array.ndim != len(axes) or any(size is not None and size != n for size, n in zip(axes.values(), array.shape, strict=True)):
        raise ArrayError(f"{name}: has shape {list(array.shape)}, expected [{wanted}]")
    for wrong, reason in ((~np.isfinite(array), ""), (np.abs(array) > LARGEST, f", too large to be stored (at most {LARGEST:.2g})")):
        if wrong.any():
            place = np.argwhere(wrong)[0]
            where = ", ".join(f"{axis} {i}" for axis, i in zip(axes, place, strict=True) if axis != "dim")
            frame = int(place[0]) if next(iter(axes)) == "frame" else -1
            raise ArrayError(f"{name}: {where or f'component {place[0]}'} is {array[tuple(place)]}{reason}", frame)
    return array


def per_node(name: str, values: Any, shape: tuple[int, ...], axis: str = "node", low: float = -np.inf, high: float = np.inf) -> np.ndarray:
    """Return float32 values of ``shape`` from a value for all nodes, or from one per node.

    Raises:
        ArrayError: the shape does not fit, or a value is not finite or outside ``low`` … ``high``. The message names the node.
    """
    array = np.asarray(values)
    if array.dtype.kind in "fiu" and array.ndim < len(shape) and array.shape == shape[len(shape) - array.ndim :]:
        array = np.broadcast_to(array, shape)
    array = numbers(name, array, dict(zip((axis, "dim"), shape, strict=False)))
    outside = (array < low) | (array > high)
    if outside.any():
        node = int(np.argwhere(outside)[0, 0])
        limits = f"between {low:g} and {high:g}" if np.isfinite(high) else "positive" if low > 0 else f"at least {low:g}"
        raise ArrayError(f"{name}: {axis} {node} is {array[outside].flat[0]:g}, must be {limits}")
    return array.astype(np.float32)


def positive(name: str, value: Any, unit: str) -> float:
    """Return a number; raise ``ArrayError`` if it is not positive and finite."""
    if isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool) and 0 < value < np.inf:
        return float(value)
    raise ArrayError(f"{name}={value!r}: must be a positive number of {unit}")


def flags(name: str, values: Any, count: int, each: str = "axes") -> tuple[bool, ...]:
    """Return ``count`` truth values, one for each axis or for each of what ``each`` names; None stands for all false. Raise ``ArrayError`` for other values."""
    if values is None:
        return (False,) * count
    array = np.asarray(values)
    if array.shape != (count,) or not (array.dtype == bool or (array.dtype.kind in "iu" and np.isin(array, (0, 1)).all())):
        raise ArrayError(f"{name}={array.tolist()!r:.80}: needs true or false for each of {count} {each}")
    return tuple(array.astype(bool).tolist())


def checked_bounds(bounds: Any, periodic: tuple[bool, ...], pos: np.ndarray, boundary_pos: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Return bounds ``(low, high)`` of the domain per axis [m]. Without ``bounds``, they are the extremes of all positions, widened along axes without extent.

    Args:
        bounds: given bounds, or None.
        periodic: whether space repeats, per axis.
        pos: positions of the nodes [frame, node, dim] in m.
        boundary_pos: positions of boundary nodes [boundary_node, dim] in m, which may be outside given bounds.

    Raises:
        ArrayError: the bounds are invalid, are missing for a periodic axis, or do not contain all nodes along an axis that is not periodic.
    """
    dim = pos.shape[2]
    if bounds is None:
        if any(periodic):
            raise ArrayError("bounds: a periodic axis needs bounds, since its period cannot be told from positions")
        points = [pos.min(axis=(0, 1)), pos.max(axis=(0, 1))]
        if len(boundary_pos):
            points += [boundary_pos.min(axis=0), boundary_pos.max(axis=0)]
        low, high = np.min(points, axis=0).astype(np.float64), np.max(points, axis=0).astype(np.float64)
        thin = np.where(high > low, 0.0, 0.5 * (float(np.max(high - low)) or 1.0))  # nodes in a row have no extent along an axis
        return tuple(zip((low - thin).tolist(), (high + thin).tolist(), strict=True))
    array = numbers("bounds", bounds, {"axis": dim, "low and high": 2}).astype(np.float64)
    checked = tuple((float(low), float(high)) for low, high in array)
    try:
        check_bounds(checked)
    except ValueError as error:
        raise ArrayError(str(error)) from None
    for axis, (low, high) in enumerate(checked):
        far = max(abs(low), abs(high)) if pos.dtype == np.float32 else 0.0  # rounding can move float32 positions out
        slack = 1e-5 * max(far, high - low)
        outside = (pos[..., axis] < low - slack) | (pos[..., axis] > high + slack)
        if not periodic[axis] and outside.any():
            frame, node = np.argwhere(outside)[0]
            raise ArrayError(
                f"pos: frame {frame}, node {node}: {'xyz'[axis]} = {pos[frame, node, axis]:.6g} m is outside the bounds {low:g} … {high:g} m",
                int(frame),
            )
    return checked


def checked_materials(
    materials: str | Sequence[str], params: Mapping[str, Any], num_nodes: int
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...], tuple[str, ...]]:
    """Return codes of ``node_type`` [node], ``material_params`` [node, param], the names of the materials that occur, and the names of the parameter columns.

    Raises:
        ArrayError: a material or parameter is unknown or missing, or a value breaks its rule. The message names it, and the node if there is one.
    """
    names = [materials] * num_nodes if isinstance(materials, str) else [str(name) for name in materials]
    if len(names) != num_nodes:
        raise ArrayError(f"materials: {len(names)} names for {num_nodes} nodes")
    present = tuple(m for m in MATERIALS if m in set(names))
    unknown = sorted(set(names) - set(MATERIALS))
    if unknown:
        raise ArrayError(
            f"materials: node {names.index(unknown[0])} is {unknown[0]!r}{_instead_of(unknown[0])}; known: {', '.join(MATERIALS)}"
        )
    if not isinstance(params, Mapping) or set(params) != set(present):
        wanted = ", ".join(f"{m}: {MATERIALS[m][0].name} [{MATERIALS[m][0].unit}]" for m in present)
        given = ", ".join(sorted(params)) if isinstance(params, Mapping) else "no names"
        raise ArrayError(f"params: has {given or 'nothing'}, needs {wanted}; give any constant for a parameter that never varies")
    codes = np.array([node_code(name) for name in names], np.uint8)
    by_name: dict[str, dict[str, Any]] = {}
    for material in present:
        try:
            by_name[material] = parameters_by_name(material, params[material])
        except ValueError as error:
            raise ArrayError(f"params[{material!r}]: {error}") from None
    stored = param_names(present, (name for own in by_name.values() for name in own))
    columns = np.full((num_nodes, len(stored)), np.nan, np.float32)
    for material in present:
        rows = codes == node_code(material)
        for spec in MATERIALS[material]:
            if spec.name not in stored:
                continue
            if spec.name not in by_name[material]:  # materials with the same parameter store it together
                raise ArrayError(f"params[{material!r}]: has no {spec.name}, which another material has; give it to both or to none")
            values = per_node(f"params[{material!r}]", by_name[material][spec.name], (num_nodes,))
            wrong = rows & ~spec.accepts(values)
            if wrong.any():
                node = int(wrong.argmax())
                raise ArrayError(f"params[{material!r}]: node {node} has {spec.name} = {spec.quantity(values[node])}, must be {spec.rule}")
            columns[rows, stored.index(spec.name)] = values[rows]
    return codes, columns, present, stored


def _instead_of(name: str) -> str:
    """Return what may be meant by a name that is no material, for messages."""
    if name == BOUNDARY:
        return ", which is no material (give walls as boundary, in files as boundary_pos)"
    return did_you_mean(name.lower(), MATERIALS) if name.lower() not in MATERIALS else f" (did you mean {name.lower()!r}?)"


def checked_bodies(rigid_body: Any, num_nodes: int) -> np.ndarray:
    """Return the number of the rigid body of each node [node], −1 for none.

    Raises:
        ArrayError: the array is not of integers, has another shape, or has a number below −1 or above 2³¹ − 1.
    """
    array = np.asarray(rigid_body)
    if array.dtype.kind not in "iu" or array.shape != (num_nodes,):
        raise ArrayError(
            f"rigid_body: is {array.dtype}{list(array.shape)}, expected integers [node {num_nodes}], -1 for nodes of no rigid body"
        )
    wrong = (array > np.iinfo(np.int32).max) | ((array < -1) if array.dtype.kind == "i" else False)
    if wrong.any():
        node = int(wrong.argmax())
        raise ArrayError(f"rigid_body: node {node} is {array[node]}, must be -1 or the number of a body, up to {np.iinfo(np.int32).max}")
    return array.astype(np.int32)


def checked_prescribed(prescribed: Any, num_nodes: int, dim: int, rigid_body: np.ndarray | None) -> np.ndarray:
    """Return a mask [node, dim] of the axes along which the motion of nodes is given.

    Args:
        prescribed: truth values, one per node or one per node and axis.
        num_nodes: number of nodes.
        dim: dimension of space.
        rigid_body: number of the rigid body of each node, −1 for none [node]; None if there are no rigid bodies.

    Raises:
        ArrayError: the values are no truth values, one per node or per node and axis; all nodes are prescribed; or a node of a rigid body is.
    """
    if np.shape(prescribed) == (num_nodes, dim):
        of_axes = flags("prescribed", np.asarray(prescribed).ravel(), num_nodes * dim, "nodes and axes")
        mask = np.array(of_axes).reshape(num_nodes, dim)
    else:
        mask = np.repeat(np.array(flags("prescribed", prescribed, num_nodes, "nodes"))[:, None], dim, axis=1)
    if mask.all():
        raise ArrayError("prescribed: the motion of all nodes is given, so there is nothing to compute; leave some nodes free")
    if rigid_body is not None and (is_wrong := mask.any(axis=1) & (rigid_body >= 0)).any():
        node = int(is_wrong.argmax())
        raise ArrayError(
            f"prescribed: node {node} belongs to rigid body {rigid_body[node]}, whose motion is computed as a whole; "
            "give a rigid body with known motion as boundary=Boundary.moving(…)"
        )
    return mask


def checked_force(force: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return forces on nodes [frame, node, dim] in N, given those of each frame, or forces that never change [node, dim].

    Args:
        force: the forces.
        shape: shape of the positions [frame, node, dim].

    Raises:
        ArrayError: the array has another shape, or a number is not finite.
    """
    if np.shape(force) == shape[1:]:
        force = np.broadcast_to(np.asarray(force), shape)
    return numbers("force", force, dict(zip(("frame", "node", "dim"), shape, strict=True))).astype(np.float32)


def checked_mass(mass: Any, num_nodes: int, force: np.ndarray | None) -> np.ndarray:
    """Return the mass of each node [node] in kg. None stands for 1 kg.

    Args:
        mass: mass of all nodes, or of each node, in kg; None if it is not known.
        num_nodes: number of nodes.
        force: forces on nodes [frame, node, dim] in N; None if there are none.

    Raises:
        ArrayError: the array has another shape, a mass is not positive, or there are forces and no masses.
    """
    if mass is None and force is not None and force.any():
        raise ArrayError("mass: there are forces and no masses, and a model reads force over mass; give the mass of each node [kg]")
    return per_node("mass", 1.0 if mass is None else mass, (num_nodes,), low=float(np.finfo(np.float32).tiny))


def checked_cells(cells: Any, codes: np.ndarray, dim: int) -> tuple[np.ndarray, int]:
    """Return all cells of a mesh in one array [cell, corner], and their largest dimension: 1 for lines, 2 for surfaces, 3 for volumes.

    Cells with fewer corners than others repeat their last corner. Kinds may be mixed, except for quadrilaterals beside volumes.

    Args:
        cells: nodes of each cell [cell, corner], or such arrays by kind of cell, a key of ``schema.CELL_KINDS``.
        codes: codes of ``node_type`` [node].
        dim: dimension of space.

    Raises:
        ArrayError: an array is not of integers or has another shape; a kind is unknown, or impossible in this dimension; the kind is missing for cells with
            four corners in 3D; quadrilaterals and volumes are mixed; or a cell repeats a node, has a node that does not exist, has nodes of several materials,
            or has nodes of a material that cannot have a mesh.
    """
    if not isinstance(cells, Mapping):
        array = _integers("cells", cells)
        kinds = fitting_kinds(array.shape[1], dim)
        if not kinds:
            known = ", ".join(f"{kind} {corners}" for kind, (own_dim, corners) in CELL_KINDS.items() if own_dim <= dim)
            raise ArrayError(f"cells: has shape {list(array.shape)}, expected [cell, corner] with the number of corners of a kind: {known}")
        if len(kinds) > 1:
            raise ArrayError(
                f"cells: with {array.shape[1]} corners in 3D they are {' or '.join(kinds)}; say which: cells={{{kinds[0]!r}: …}}"
            )
        groups = {kinds[0]: _checked_kind("cells", array, kinds[0], codes)}
    else:
        possible = [kind for kind, (own_dim, _) in CELL_KINDS.items() if own_dim <= dim]
        for kind in cells:
            if kind not in possible:
                raise ArrayError(f"cells: unknown kind {kind!r:.80}; in {dim}D there are {', '.join(possible)}")
        groups = {kind: _checked_kind(f"cells[{kind!r}]", _integers(f"cells[{kind!r}]", cells[kind]), kind, codes) for kind in cells}
    largest = max((CELL_KINDS[kind][0] for kind in groups), default=0)
    if largest == 0 or (largest == 3 and "quadrilateral" in groups):  # four corners would be a tetrahedron
        raise ArrayError(f"cells: has {', '.join(groups) or 'no kind'}; give triangles instead of quadrilaterals beside volumes")
    return stacked(groups), largest


def _integers(name: str, cells: Any) -> np.ndarray:
    try:
        array = np.asarray(cells)
    except ValueError:
        raise ArrayError(
            f"{name}: rows have different lengths; give cells by kind, such as {{'triangle': …, 'quadrilateral': …}}"
        ) from None
    if array.dtype.kind not in "iu" or array.ndim != 2:
        raise ArrayError(f"{name}: is {array.dtype}{list(array.shape)}, expected integers [cell, corner]")
    return array


def _checked_kind(name: str, array: np.ndarray, kind: str, codes: np.ndarray) -> np.ndarray:
    """Return cells [cell, corner] of one kind after checking them."""
    if array.shape[1] != CELL_KINDS[kind][1]:
        raise ArrayError(f"{name}: has shape {list(array.shape)}, expected [cell, {CELL_KINDS[kind][1]}]")
    wrong = ((array < 0) | (array >= len(codes))).any(axis=1) | (np.diff(np.sort(array, axis=1), axis=1) == 0).any(axis=1)
    if wrong.any():
        cell = int(wrong.argmax())
        raise ArrayError(f"{name}: cell {cell} has the nodes {array[cell].tolist()}; they must be different ones of the {len(codes)} nodes")
    types = codes[array]
    wrong = (types != types[:, :1]).any(axis=1) | ~np.isin(types[:, 0], [node_code(m) for m in MESH_MATERIALS])
    if wrong.any():
        cell = int(wrong.argmax())
        found = ", ".join(sorted({NODE_TYPES[code] for code in types[cell]}))
        raise ArrayError(
            f"{name}: cell {cell} has nodes of {found}; a cell is of one material, and meshes are of {', '.join(MESH_MATERIALS)}"
        )
    return array


def velocities_of(pos: np.ndarray, frame_dt: float, periodicity: Periodicity) -> np.ndarray:
    """Return mean velocities over the frame before each frame [frame, node, dim] in m/s; the first frame has those of the second."""
    vel = np.empty(pos.shape, np.float32)
    for start in range(1, len(pos), FRAMES_AT_ONCE):  # double precision of all frames at once would take too much memory
        window = pos[start - 1 : start + FRAMES_AT_ONCE].astype(np.float64)
        vel[start : start + FRAMES_AT_ONCE] = integrators.velocities(window, frame_dt, periodicity)
    vel[0] = vel[1]
    return vel


def nearest_distances(pos: np.ndarray, periodicity: Periodicity = NOWHERE) -> np.ndarray:
    """Return the distance [node] in m from each node [node, dim] to the nearest other one; infinite for a single node."""
    from scipy.spatial import cKDTree

    points, box = (periodicity.from_corner(pos), periodicity.period) if periodicity else (pos, None)
    return cKDTree(points, boxsize=box).query(points, k=2)[0][:, 1]


def typical_spacing(pos: np.ndarray, periodicity: Periodicity = NOWHERE) -> float:
    """Return the median distance [m] of nodes [node, dim] to their nearest neighbour.

    Raises:
        ArrayError: there is a single node, or half of the nodes coincide with others.
    """
    if len(pos) < 2:
        raise ArrayError("spacing: a single node has no neighbours; pass spacing")
    spacing = float(np.median(nearest_distances(pos, periodicity)))
    if spacing <= 0:
        raise ArrayError("spacing: half of the nodes coincide with another one, so it cannot be told from positions; pass spacing")
    return spacing


def estimated_normals(boundary_pos: np.ndarray, visited: np.ndarray, periodicity: Periodicity = NOWHERE) -> np.ndarray:
    """Return estimated unit normals [boundary_node, dim] of walls given by points: the mean direction to the ``NEIGHBOURS`` nearest positions of nodes.

    Args:
        boundary_pos: points on the walls [boundary_node, dim] in m.
        visited: positions of nodes [..., dim] in m, in one or several frames.
        periodicity: axes along which space repeats.
    """
    from scipy.spatial import cKDTree

    walls = np.asarray(boundary_pos, np.float64)
    points = np.asarray(visited).reshape(-1, walls.shape[1])
    if len(points) > MAX_VISITED:  # drawn at random: every so many points would be the same few nodes in all frames
        points = points[np.random.default_rng(0).choice(len(points), MAX_VISITED, replace=False)]
    points = points.astype(np.float64)
    count = min(NEIGHBOURS, len(points))
    if periodicity:
        tree = cKDTree(periodicity.from_corner(points), boxsize=periodicity.period)
        found = tree.query(periodicity.from_corner(walls), k=count)[1]
    else:
        found = cKDTree(points).query(walls, k=count)[1]
    away = periodicity.shortest(points[found.reshape(len(walls), count)] - walls[:, None])
    away /= np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), np.finfo(float).tiny)
    normal = away.mean(axis=1)
    for fallback in (
        away[:, 0],
        np.broadcast_to(np.eye(walls.shape[1])[-1], walls.shape),
    ):  # the first for points with nodes on all sides, the second for points that coincide with a node
        weak = np.linalg.norm(normal, axis=1) < 1e-3
        normal[weak] = fallback[weak]
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)
