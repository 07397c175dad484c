"""``Trajectory`` and its ``Metadata``. These two classes and ``State`` are the only interface between solvers and learned simulators."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from gpe_pl.geometry.periodicity import Periodicity, PeriodicityError
from gpe_pl.geometry.shape_values import moved
from gpe_pl.schema import BOUNDARY, LOADS, MATERIALS, MaterialParameter, node_code, param_names, stored_parameters
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.arrays import (
    RADIUS_SPACINGS,
    ArrayError,
    checked_bodies,
    checked_bounds,
    checked_cells,
    checked_force,
    checked_mass,
    checked_materials,
    checked_prescribed,
    flags,
    numbers,
    positive,
    typical_spacing,
    velocities_of,
)
from gpe_pl.trajectory.boundary import Array, Boundary, check_steps, has_nodes_beside_shapes
from gpe_pl.trajectory.cells import mean_over_corners
from gpe_pl.trajectory.cells_at_rest import check_at_rest
from gpe_pl.trajectory.living import held, living, order_of_entry
from gpe_pl.trajectory.loads import Loads
from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.rest_positions import near_origin
from gpe_pl.trajectory.state import State, Stress, check_frame

log = logging.getLogger(__name__)


@cache
def _warn_of_missing_shapes() -> None:
    """Warn, once in a process, of boundaries whose shapes are not all there."""
    log.warning(
        "boundary: some nodes are on none of the shapes; containment and the elastic law see shapes only; give the shapes of all walls, or none"
    )


@dataclass(frozen=True)
class Metadata:
    """Properties of a trajectory other than its arrays. Lengths in m, times in s.

    Attributes:
        dataset: name of the data set.
        materials: every material that occurs anywhere in the data set (fixes the node types of all its graphs).
        param_names: column names of ``material_params``: the first parameter of each material, and further ones that the data set stores.
        frame_dt: time between stored frames.
        solver_dt: largest solver substep, 0 if there is none.
        spacing: rest spacing of neighbouring nodes.
        connectivity_radius: radius of the edges between nodes; nodes that act on each other in the solver should be within it.
        bounds: ``(low, high)`` per axis of the domain.
        periodic: whether space repeats, per axis.
        gravity: external acceleration [m/s²].
        seed: seed of the scene, -1 if unknown.
        split: split that the trajectory belongs to.
        parameter_group: ``seen`` if all material parameters have trained values, ``extrapolated`` if any lies outside the trained range, otherwise
            ``interpolated``.
        solver, solver_version, config: provenance; ``config`` is JSON.
        stress_materials: materials whose nodes have a stress; None stands for ``solid``, the material of the FEM solver.
        loads: loads that occur anywhere in the data set, names of ``schema.LOADS``; they fix features of its graphs. None stands for none.
    """

    dataset: str
    materials: tuple[str, ...]
    param_names: tuple[str, ...]
    frame_dt: float
    spacing: float
    connectivity_radius: float
    bounds: tuple[tuple[float, float], ...]
    gravity: tuple[float, ...]
    periodic: tuple[bool, ...] = ()
    solver_dt: float = 0.0
    seed: int = -1
    split: str = ""
    parameter_group: str = "seen"
    solver: str = ""
    solver_version: str = ""
    config: str = "{}"
    stress_materials: tuple[str, ...] | None = None
    loads: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "materials", tuple(self.materials))
        object.__setattr__(self, "param_names", tuple(self.param_names))
        if self.stress_materials is not None:
            object.__setattr__(self, "stress_materials", tuple(self.stress_materials))
        object.__setattr__(self, "loads", tuple(self.loads or ()) or None)
        object.__setattr__(self, "bounds", tuple((float(a), float(b)) for a, b in self.bounds))
        object.__setattr__(self, "gravity", tuple(float(g) for g in self.gravity))
        object.__setattr__(self, "periodic", tuple(bool(p) for p in self.periodic) or (False,) * len(self.bounds))

    @property
    def dim(self) -> int:
        return len(self.bounds)

    @property
    def with_stress(self) -> tuple[str, ...]:
        """Materials of the data set whose nodes have a stress."""
        return tuple(m for m in self.materials if m in (self.stress_materials if self.stress_materials is not None else ("solid",)))

    @property
    def longest_side(self) -> float:
        """Extent of the domain [m] along its longest axis."""
        return max(high - low for low, high in self.bounds)

    @cached_property
    def periodicity(self) -> Periodicity:
        return Periodicity(self.bounds, self.periodic)

    def parameters_of(self, material: str) -> tuple[MaterialParameter, ...]:
        """Return the stored parameters of a material."""
        return stored_parameters(material, self.param_names)

    def columns_of(self, material: str) -> list[int]:
        """Return the columns of ``material_params`` that hold the parameters of a material, in the order of ``parameters_of``."""
        return [self.param_names.index(p.name) for p in self.parameters_of(material)]

    def every(self, stride: int) -> Metadata:
        """Return the metadata of a trajectory that has every ``stride``-th frame of this one."""
        return self if stride == 1 else replace(self, frame_dt=stride * self.frame_dt)

    def violations(self) -> Iterator[tuple[str, str]]:
        """Yield the invalid fields, each with its fault. Call it for metadata from files, which may hold any values."""
        unknown = [name for name in self.materials if name not in MATERIALS]
        if unknown or not self.materials:
            yield "materials", f"names {unknown or 'nothing'}; known: {', '.join(MATERIALS)}"
        elif len(set(self.materials)) < len(self.materials):
            yield "materials", "names a material twice"
        elif not {*(self.stress_materials or ())} <= {*self.materials}:
            yield "stress_materials", f"names {self.stress_materials}, the materials are {self.materials}"
        elif self.param_names != param_names(self.materials, self.param_names):
            first, every = param_names(self.materials), param_names(self.materials, (p.name for m in self.materials for p in MATERIALS[m]))
            also = f" and possibly more, in the order {every}" if every != first else ""
            yield "param_names", f"is {self.param_names}, expected {first} for {self.materials}{also}"
        if self.loads is not None and self.loads != tuple(name for name in LOADS if name in self.loads):
            yield "loads", f"is {self.loads}, expected names among {', '.join(LOADS)} in this order"
        for key in ("frame_dt", "spacing", "connectivity_radius"):
            if not 0 < getattr(self, key) < math.inf:
                yield key, f"is {getattr(self, key)}, must be positive"
        if not 0 <= self.solver_dt <= self.frame_dt * (1 + 1e-9):
            yield "solver_dt", f"is {self.solver_dt} s, must lie between 0 and frame_dt = {self.frame_dt} s"
        if self.dim not in (2, 3):
            yield "bounds", f"has {self.dim} axes, must have 2 or 3"
        for axis, (low, high) in enumerate(self.bounds):
            if not -math.inf < low < high < math.inf:
                yield "bounds", f"axis {axis}: low {low} must be below high {high}, both finite"
        for key in ("gravity", "periodic"):
            if len(getattr(self, key)) != self.dim:
                yield key, f"has {len(getattr(self, key))} components in {self.dim}D"
        if len(self.periodic) == self.dim:
            try:
                self.periodicity.check_radius(self.connectivity_radius)
            except PeriodicityError as error:
                yield "connectivity_radius", str(error)
        if not all(map(math.isfinite, self.gravity)):
            yield "gravity", f"is {self.gravity}, must be finite"


def checked_stress(stress: Array, pos: np.ndarray, cells: np.ndarray | None) -> Stress:
    """Return the stress of a trajectory in single precision. Stresses of cells are means over their corners.

    Args:
        stress: Cauchy stress at nodes [frame, node, component] in Pa.
        pos: positions [frame, node, dim] in m.
        cells: nodes of each cell [cell, corner]; None without a mesh.

    Raises:
        ArrayError: the array has another shape, or a number is not finite.
    """
    components = 4 if pos.shape[2] == 2 else 6
    node = numbers("stress", stress, {"frame": pos.shape[0], "node": pos.shape[1], "component": components}).astype(np.float32)
    if cells is None:
        return Stress(node, np.zeros((len(node), 0, components), np.float32))
    return Stress(node, np.stack([mean_over_corners(frame, cells) for frame in node]))


@dataclass(frozen=True)
class Termination:
    """Reason why a rollout stopped early.

    Attributes:
        reason: reason code, such as ``nan``.
        frame: first frame that failed.
        node: node that shows the failure, or -1 if no single node does.
        message: explanation for a reader.
    """

    reason: str
    frame: int
    node: int
    message: str


@dataclass(frozen=True)
class Trajectory:
    """Frames of one scene, as NumPy arrays.

    Attributes:
        metadata: provenance and physical constants.
        pos: positions [frame, node, dim] in m.
        vel: velocities at the frames [frame, node, dim] in m/s. Rollouts of models that do not know them have the mean velocity over the last frame.
        node_type, mass: as in ``State`` [node].
        material_params: as in ``State`` [node, param].
        boundary: boundary in the first frame; if it moves, its motion has as many frames as the trajectory.
        rest_pos, cells, cell_dim: reference configuration of meshes, as in ``State``.
        stress: stress in every frame.
        rigid_body: number of the rigid body of each node, as in ``State``.
        alive: mask [frame, node] of the nodes that are in an open scene; None if all are in it in every frame. A node enters and leaves at most once, so its
            number is its identity. Before and after, its position and velocity are those of the nearest frame in which it is in the scene.
        openings: inlets and outlets of an open scene.
        prescribed: whether the motion of each node along each axis is given [node, dim]; ``pos`` has it. None if no motion is given.
        force: forces on nodes from each frame to the next [frame, node, dim] in N; None if there are none.
        termination: reason why a rollout stopped early; None if it did not.
        start_time: time of the first frame since the start of the scene [s].
        is_prediction: whether the trajectory is a rollout of a simulator other than a ground-truth solver.
    """

    metadata: Metadata
    pos: np.ndarray
    vel: np.ndarray
    node_type: np.ndarray
    mass: np.ndarray
    material_params: np.ndarray
    boundary: Boundary
    rest_pos: np.ndarray | None = None
    cells: np.ndarray | None = None
    stress: Stress | None = None
    cell_dim: int | None = None
    rigid_body: np.ndarray | None = None
    alive: np.ndarray | None = None
    openings: tuple[Opening, ...] = ()
    prescribed: np.ndarray | None = None
    force: np.ndarray | None = None
    termination: Termination | None = field(default=None, compare=False)
    start_time: float = field(default=0.0, compare=False)
    is_prediction: bool = field(default=False, compare=False)

    @classmethod
    def from_numpy(
        cls,
        pos: Array,
        frame_dt: float | int,
        materials: str | Sequence[str],
        params: Mapping[str, Array | Mapping[str, Array]],
        *,
        vel: Array | None = None,
        mass: Array | None = None,
        bounds: Array | None = None,
        periodic: Array | None = None,
        gravity: Array | None = None,
        spacing: float | int | None = None,
        connectivity_radius: float | int | None = None,
        boundary: Boundary | None = None,
        cells: Array | Mapping[str, Array] | None = None,
        rest_pos: Array | None = None,
        rigid_body: Array | None = None,
        stress: Array | None = None,
        prescribed: Array | None = None,
        force: Array | None = None,
        dataset: str = "arrays",
        split: str = "train",
    ) -> Trajectory:
        """Return a trajectory made from your own arrays, which are checked.

        ``data.importers.save_dataset`` writes several such trajectories as a data set, on which ``python -m gpe_pl.fit data=imported`` trains.

        Args:
            pos: positions [frame, node, dim] in m of at least 3 frames. Along periodic axes they are wrapped into the domain. Arrays of float32 and float16 are
                kept as float32, all others in double precision until they are stored.
            frame_dt: time between frames [s].
            materials: material of all nodes, or of each node; names of ``schema.MATERIALS``.
            params: parameters of each material that occurs, in the units of ``schema.MATERIALS``: one value, or one per node of the trajectory. A material
                has its first parameter, or several by name, ``{"elastomer": {"youngs_modulus": 1e5, "poisson_ratio": 0.3}}``.
            vel: velocities at the frames [frame, node, dim] in m/s, which the elastic law needs; None takes means over the frame before each.
            mass: mass of all nodes, or of each node [kg]; required with forces. None stands for 1 kg, because only ratios matter to a model without forces.
            bounds: ``(low, high)`` of the domain per axis [m]; None takes the extremes of all positions. Periodic axes need bounds.
            periodic: whether space repeats, per axis; None stands for no axis.
            gravity: external acceleration [dim] in m/s²; None stands for zero. Models then learn gravity like any other force.
            spacing: rest spacing of neighbours [m]; None takes the median distance to the nearest node in the first frame.
            connectivity_radius: radius of the edges between nodes [m]; nodes that act on each other should be within it. None takes
                ``arrays.RADIUS_SPACINGS`` spacings.
            boundary: walls and obstacles, for example ``Boundary.sample(domain_walls(bounds, friction), spacing, dim)`` or ``Boundary.from_numpy(…)``. In
                periodic domains, its nodes are wrapped into the domain, nodes that coincide at a seam become one, and shapes get their images.
            cells: nodes of each cell [cell, corner] in meshes of elastomers and solids, or such arrays by kind, ``{"quadrilateral": …, "triangle": …}``. Give
                them by kind if there are several kinds, or if cells in 3D have four corners, because both quadrilaterals and tetrahedra do. Kinds are those of
                ``schema.CELL_KINDS``; the order of corners is that of VTK.
            rest_pos: undeformed positions [node, dim] of meshes in m; None takes those of the first frame.
            rigid_body: number of the rigid body that each node belongs to [node], −1 for none. Simulators move the nodes of a body by one rigid motion.
            stress: Cauchy stress at the nodes [frame, node, component] in Pa, with the components of ``State.stress``. Models can learn it
                (``model.stress=true``). Give a material without a stress zeros; it counts as having none.
            prescribed: whether the motion of each node is given [node], as that of clamped nodes and of nodes that a machine moves; or along which axes it
                is [node, dim], as on rollers and at planes of symmetry. ``pos`` has it in all frames. Simulators take it, and compute the rest.
            force: forces on nodes from each frame to the next [frame, node, dim] in N, or forces that never change [node, dim]. Distribute tractions to the
                nodes as your finite-element program does. Gravity is not among them, and forces on prescribed nodes have no effect.
            dataset, split: names of data set and split; ``save_dataset`` overrides both.

        Raises:
            ArrayError: an argument does not fit. The message names it, with frame and node if there is one.
            PeriodicityError: the connectivity radius is not below half a period.
        """
        pos = numbers("pos", pos, {"frame": None, "node": None, "dim": None})
        pos = pos.astype(np.float32 if pos.dtype in (np.float16, np.float32) else np.float64)  # a copy: the caller may use its array again
        num_frames, num_nodes, dim = pos.shape
        if num_frames < 3 or num_nodes < 1 or dim not in (2, 3):
            raise ArrayError(f"pos [frame, node, dim] is {list(pos.shape)}: at least 3 frames, 1 node, and 2 or 3 dimensions are needed")
        frame_dt = positive("frame_dt", frame_dt, "seconds")
        boundary = Boundary.empty(dim) if boundary is None else boundary
        if boundary.pos.shape[1:] != (dim,):
            raise ArrayError(f"boundary: its positions are {list(boundary.pos.shape)}, expected [boundary_node, {dim}]")
        if boundary.motion is not None and boundary.motion.num_frames != num_frames:
            raise ArrayError(f"boundary: its motion has {boundary.motion.num_frames} frames, pos has {num_frames}")
        way = boundary.pos if boundary.motion is None else boundary.motion.pos.reshape(-1, dim)
        repeats = flags("periodic", periodic, dim)
        bounds = checked_bounds(bounds, repeats, pos, way)
        periodicity = Periodicity(bounds, repeats)
        check_steps(boundary, frame_dt, periodicity)
        boundary = boundary.inside(periodicity)
        if has_nodes_beside_shapes(boundary):
            _warn_of_missing_shapes()
        if periodicity:
            pos = np.stack([periodicity.wrapped(frame.astype(np.float64)).astype(pos.dtype) for frame in pos])
        codes, columns, names, stored = checked_materials(materials, params, num_nodes)
        spacing = positive("spacing", typical_spacing(pos[0].astype(np.float64), periodicity) if spacing is None else spacing, "m")
        radius = positive("connectivity_radius", RADIUS_SPACINGS * spacing if connectivity_radius is None else connectivity_radius, "m")
        periodicity.check_radius(radius)
        vel = velocities_of(pos, frame_dt, periodicity) if vel is None else vel
        shape = {"frame": num_frames, "node": num_nodes, "dim": dim}
        gravity = numbers("gravity", np.zeros(dim) if gravity is None else gravity, {"dim": dim})
        cell_dim = None
        if cells is not None:
            cells, cell_dim = checked_cells(cells, codes, dim)
            rest_pos = numbers("rest_pos", pos[0] if rest_pos is None else rest_pos, {"node": num_nodes, "dim": dim})
            check_at_rest(cells, cell_dim, rest_pos, periodicity)
            rest_pos = near_origin(rest_pos, pos, periodicity).astype(pos.dtype)
        elif rest_pos is not None:
            raise ArrayError("rest_pos: only meshes have rest positions; pass cells too, or leave it out")
        known = None if stress is None else checked_stress(stress, pos, cells)
        if rigid_body is not None:
            rigid_body = checked_bodies(rigid_body, num_nodes)
        if prescribed is not None:
            prescribed = checked_prescribed(prescribed, num_nodes, dim, rigid_body)
        if force is not None:
            force = checked_force(force, pos.shape)
        sliding = None if prescribed is None else prescribed.any(axis=1) & ~prescribed.all(axis=1)
        loads = tuple(name for name, given in zip(LOADS, (prescribed, sliding, force), strict=True) if given is not None and given.any())
        return cls(
            Metadata(
                dataset, names, stored, frame_dt, spacing, radius, bounds, tuple(map(float, gravity)),
                periodicity.periodic, split=split, solver="import", solver_version="1",
                stress_materials=() if known is None else tuple(m for m in names if known.node[:, codes == node_code(m)].any()),
                loads=loads,
            ),
            pos,
            numbers("vel", vel, shape).astype(np.float32),
            codes,
            checked_mass(mass, num_nodes, force),
            columns,
            boundary,
            rest_pos=rest_pos,
            cells=cells,
            stress=known,
            cell_dim=cell_dim,
            rigid_body=rigid_body,
            prescribed=prescribed if "motion" in loads else None,
            force=force if "force" in loads else None,
        )  # fmt: skip

    @property
    def num_frames(self) -> int:
        return self.pos.shape[0]

    @property
    def num_nodes(self) -> int:
        return self.pos.shape[1]

    @property
    def is_predicted(self) -> np.ndarray:
        """Mask of the nodes that simulators compute, whose motion is not given along all axes [node]."""
        return np.ones(self.num_nodes, bool) if self.prescribed is None else np.asarray(~self.prescribed.all(axis=1))

    def loads_at(self, frame: int) -> Loads | None:
        """Return the loads from a frame on; None if there are none."""
        if self.prescribed is None and self.force is None:
            return None
        prescribed = np.zeros(self.pos.shape[1:], bool) if self.prescribed is None else self.prescribed
        rows = prescribed.any(axis=1)
        path = self.pos[frame:, rows]
        if not prescribed[rows].all():
            path = np.where(prescribed[rows], path, path[:1])  # what is not given is nothing that a simulator may know
        return Loads(prescribed, path, None if self.force is None else self.force[frame:])

    def state(self, frame: int, history: int = 0) -> State:
        """Return the state at a frame.

        In an open scene, it has the nodes that are in the scene at this frame. Before a node entered, its history has the velocity with which it entered.

        Without ``history``, the velocities are the stored ones. With ``history`` > 0, they are differences of the last ``history + 1`` stored positions in
        float64, as a learned simulator needs them, and the stored ones become ``State.frame_velocity``.

        Raises:
            FrameError: ``frame`` is out of range, or has fewer than ``history`` frames before it.
        """
        check_frame(frame, history, self.num_frames)
        gravity = np.asarray(self.metadata.gravity)
        pos, vel, past = self.pos[frame].astype(np.float64), self.vel[frame].astype(np.float64), None
        at_frame = vel if history else None
        if history:
            window = self.pos[frame - history : frame + 1].astype(np.float64)
            past = np.ascontiguousarray(integrators.velocities(window, self.metadata.frame_dt, self.metadata.periodicity).swapaxes(0, 1))
            vel = past[:, -1]
        rest_pos = None if self.rest_pos is None else self.rest_pos.astype(np.float64)
        stress = None if self.stress is None else Stress(self.stress.node[frame], self.stress.cell[frame])
        state = State(
            pos, vel, self.node_type, self.mass, self.material_params, self.boundary.at(frame), gravity, past,
            self.start_time + frame * self.metadata.frame_dt, rest_pos, self.cells, stress, self.cell_dim, periodicity=self.metadata.periodicity,
            param_names=self.metadata.param_names, frame_velocity=at_frame, rigid_body=self.rigid_body,
            loads=self.loads_at(frame),
        )  # fmt: skip
        return state if self.alive is None else living(state, self.alive[: frame + 1], self.vel[: frame + 1], self.openings)

    def seen_from(self, origin: np.ndarray) -> Trajectory:
        """Return the trajectory in coordinates whose origin is at ``origin`` [dim] in m.

        Choose an origin near the positions before you store them: stored positions are float32, which is most precise near 0. Rest positions move along an axis
        only if that brings them nearer to 0.
        """
        b, m = self.boundary, self.metadata
        rest_pos = self.rest_pos
        if rest_pos is not None:  # only their differences matter, so their origin may be another one
            rest_pos = np.where(np.abs(rest_pos - origin).max(axis=0) < np.abs(rest_pos).max(axis=0), rest_pos - origin, rest_pos)
        bounds = tuple((low - x, high - x) for (low, high), x in zip(m.bounds, origin.tolist(), strict=True))
        motion = None if b.motion is None else replace(b.motion, pos=b.motion.pos - origin)
        boundary = replace(b, pos=b.pos - origin, shapes=tuple(moved(shape, -origin) for shape in b.shapes), motion=motion)
        openings = tuple(opening.moved(-origin) for opening in self.openings)
        return replace(
            self, metadata=replace(m, bounds=bounds), pos=self.pos - origin, boundary=boundary, rest_pos=rest_pos, openings=openings
        )

    def frames(self, start: int, stop: int | None = None) -> Trajectory:
        """Return the frames ``start:stop`` as a trajectory. Nodes that are in none of them are left out.

        The reason why a rollout stopped belongs to its end. Frames that leave out the end have none.

        Raises:
            ValueError: there is no such frame.
        """
        first, last, _ = slice(start, stop).indices(self.num_frames)
        if first == 0 and last == self.num_frames:
            return self
        if first >= last:
            raise ValueError(f"frames({start}, {stop}): has no frame; the trajectory has {self.num_frames} frames")
        stress = None if self.stress is None else Stress(self.stress.node[start:stop], self.stress.cell[start:stop])
        end = self.termination
        return replace(
            self,
            pos=self.pos[start:stop],
            vel=self.vel[start:stop],
            boundary=self.boundary.at(start, stop),
            stress=stress,
            termination=None if end is None or last < self.num_frames else replace(end, frame=end.frame - first),
            alive=None if self.alive is None else self.alive[start:stop],
            force=None if self.force is None else self.force[start:stop],
            start_time=self.start_time + first * self.metadata.frame_dt,
        ).present()

    def every(self, stride: int) -> Trajectory:
        """Return every ``stride``-th frame, from the first on, as a trajectory whose frames are ``stride`` times as long.

        Velocities of nodes stay those at the frames. Boundary nodes get their mean velocities over the longer frames, and forces are averaged, too. Nodes
        that enter are numbered as a rollout with the longer frames numbers them.

        Raises:
            ValueError: ``stride`` is not a positive whole number.
        """
        if not isinstance(stride, int | np.integer) or stride < 1:
            raise ValueError(f"stride={stride!r}: must be a positive whole number of frames")
        if stride == 1:
            return self
        stop = self.termination
        pos, vel = (
            values[::stride] if self.alive is None else held(values[::stride], self.alive[::stride]) for values in (self.pos, self.vel)
        )
        longer = replace(
            self,
            metadata=self.metadata.every(stride),
            pos=pos,
            vel=vel,
            boundary=self.boundary.every(stride),
            stress=None if self.stress is None else Stress(self.stress.node[::stride], self.stress.cell[::stride]),
            alive=None if self.alive is None else self.alive[::stride],
            force=None if self.force is None else _mean_over(self.force, stride),
            termination=None if stop is None else replace(stop, frame=-(-stop.frame // stride)),
        )
        if self.alive is not None and sum(opening.enters for opening in self.openings) > 1:
            longer = longer.of_nodes(order_of_entry(self.alive, self.pos, stride, self.openings))
        return longer.present()

    def present(self) -> Trajectory:
        """Return the trajectory without nodes that are in the scene in no frame; the same object if there are none."""
        if self.alive is None:
            return self
        some = np.asarray(self.alive.any(axis=0))
        return self if some.all() else self.of_nodes(some)

    def of_nodes(self, nodes: np.ndarray) -> Trajectory:
        """Return some of the nodes, given by a mask [node] or by their numbers in a new order, of a trajectory without mesh."""
        names = ("node_type", "mass", "material_params", "rigid_body", "prescribed")
        per_node = {name: getattr(self, name) for name in names}
        return replace(
            self,
            pos=self.pos[:, nodes],
            vel=self.vel[:, nodes],
            alive=None if self.alive is None else self.alive[:, nodes],
            force=None if self.force is None else self.force[:, nodes],
            **{name: values[nodes] for name, values in per_node.items() if values is not None},
        )

    def with_nodes_of(self, other: Trajectory) -> Trajectory:
        """Return the trajectory with the further nodes of a longer rollout of the same open scene, which are in this one in no frame."""
        more = np.arange(other.num_nodes) >= self.num_nodes
        if self.alive is None or not more.any():
            return self

        def extended(values: np.ndarray, others: np.ndarray) -> np.ndarray:
            return np.concatenate([values, others[more].astype(values.dtype)])

        first = other.pos[0, more].astype(self.pos.dtype)
        return replace(
            self,
            pos=np.concatenate([self.pos, np.broadcast_to(first, (self.num_frames, *first.shape))], axis=1),
            vel=np.pad(self.vel, ((0, 0), (0, int(more.sum())), (0, 0))),
            alive=np.pad(self.alive, ((0, 0), (0, int(more.sum())))),
            node_type=extended(self.node_type, other.node_type),
            mass=extended(self.mass, other.mass),
            material_params=extended(self.material_params, other.material_params),
        )

    def with_absent_hidden(self) -> Trajectory:
        """Return the trajectory for pictures: where a node is not in an open scene, its position and velocity are NaN."""
        if self.alive is None:
            return self
        return replace(self, pos=np.where(self.alive[..., None], self.pos, np.nan), vel=np.where(self.alive[..., None], self.vel, np.nan))

    def with_moving_boundary(self) -> Trajectory:
        """Return the trajectory with moving boundary nodes as additional nodes of type ``boundary``, for pictures and other programs.

        The additional nodes follow the others. If no boundary node moves, the result is the same object.
        """
        motion = self.boundary.motion
        if motion is None:
            return self
        moves = (motion.pos != motion.pos[0]).any(axis=(0, 2))
        count, still = int(moves.sum()), ~moves

        def extended(values: np.ndarray, more: Any) -> np.ndarray:
            return np.concatenate([values, np.broadcast_to(more, (count, *values.shape[1:])).astype(values.dtype)])

        way, stress = motion.frames(0, self.num_frames), self.stress
        if stress is not None:
            stress = Stress(np.pad(stress.node, ((0, 0), (0, count), (0, 0))), stress.cell)
        return replace(
            self,
            pos=np.concatenate([self.pos, way.pos[:, moves].astype(self.pos.dtype)], axis=1),
            vel=np.concatenate([self.vel, way.vel[:, moves].astype(self.vel.dtype)], axis=1),
            node_type=extended(self.node_type, node_code(BOUNDARY)),
            mass=extended(self.mass, 0.0),
            material_params=extended(self.material_params, np.nan),
            boundary=replace(self.boundary.take(still), motion=None),
            rest_pos=None if self.rest_pos is None else np.concatenate([self.rest_pos, motion.pos[0, moves].astype(self.rest_pos.dtype)]),
            stress=stress,
            rigid_body=None if self.rigid_body is None else extended(self.rigid_body, -1),
            alive=None if self.alive is None else np.pad(self.alive, ((0, 0), (0, count)), constant_values=True),
            prescribed=None if self.prescribed is None else extended(self.prescribed, True),
            force=None if self.force is None else np.pad(self.force, ((0, 0), (0, count), (0, 0))),
        )


def _mean_over(values: np.ndarray, stride: int) -> np.ndarray:
    """Return the means of values [frame, …] over ``stride`` frames each; the last mean may be over fewer."""
    first = np.arange(0, len(values), stride)
    count = np.minimum(first + stride, len(values)) - first
    total = np.add.reduceat(values.astype(np.float64), first, axis=0)
    return (total / count.reshape(-1, *[1] * (values.ndim - 1))).astype(values.dtype)
