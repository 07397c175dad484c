"""``State``: everything that a ``Simulator`` needs at one instant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import accumulate
from typing import Any

import numpy as np
from array_api_compat import array_namespace, device

from gpe_pl.errors import GpeError
from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.boundary import Array, Boundary
from gpe_pl.trajectory.cells import mean_over_corners
from gpe_pl.trajectory.kinds import CELL, GROUP, NODE, PARTS, SCENE, STEP, names_of
from gpe_pl.trajectory.loads import Loads
from gpe_pl.trajectory.openings import Opening


class FrameError(GpeError, IndexError):
    """Raised when a trajectory does not have a frame, or not the frames before it that a state with history needs."""


def check_frame(frame: int, history: int, num_frames: int) -> None:
    """Raise ``FrameError`` if a trajectory of ``num_frames`` frames lacks a frame, or ``history`` frames before it."""
    if not history <= frame < num_frames:
        first = (
            f", of which {history} to {num_frames - 1} have this history"
            if history < num_frames
            else "; give more, or start with LearnedSimulator.standing"
        )
        raise FrameError(f"frame {frame} with history {history} is outside the {num_frames} frames of this trajectory{first}")


@dataclass(frozen=True)
class Stress:
    """Cauchy stress in Pa. In a ``Trajectory`` the arrays have a leading axis of frames.

    Components are xx, xy, yy, zz in plane strain and xx, xy, xz, yy, yz, zz in 3D.

    Attributes:
        node: stress at nodes [node, component]. Where the solver computes it in cells, it is the mean over the cells around each node, and zero at nodes
            without a cell.
        cell: stress in cells [cell, component].
    """

    node: Array
    cell: Array

    @classmethod
    def of_nodes(cls, node: Array, cells: Array | None) -> Stress:
        """Return a stress that is known at nodes [node, component]. Stresses of cells are means over their corners. Without a mesh, ``cells`` is None."""
        return cls(node, node[:0] if cells is None else mean_over_corners(node, cells))

    @property
    def node_von_mises(self) -> Array:
        return von_mises(self.node)

    @property
    def cell_von_mises(self) -> Array:
        return von_mises(self.cell)


def von_mises(stress: Array) -> Array:
    """Return the von Mises stress √(3/2 s:s) [...] in Pa, where s is the deviator of stresses [..., component] in the order of ``Stress``."""
    xp = array_namespace(stress)
    zero = xp.zeros_like(stress[..., 0])
    if stress.shape[-1] == 4:
        (xx, xy, yy, zz), (xz, yz) = (stress[..., k] for k in range(4)), (zero, zero)
    else:
        xx, xy, xz, yy, yz, zz = (stress[..., k] for k in range(6))
    normal = ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) / 2
    return xp.sqrt(normal + 3 * (xy**2 + xz**2 + yz**2))


@dataclass(frozen=True)
class State:
    """Everything that a ``Simulator`` needs at one instant. All arrays are NumPy arrays, or all are tensors.

    Every field declares its kind (``kinds``). ``take``, ``joined`` and ``later`` follow from the kinds, so a new field is declared here only.

    Attributes:
        pos: positions of the dynamic nodes [node, dim] in m.
        vel: velocities [node, dim] in m/s.
        node_type: codes of ``schema.NODE_TYPES`` [node].
        mass: masses [node] in kg.
        material_params: material parameters [node, param] in the columns ``param_names``. NaN if the node's material lacks the parameter.
        boundary: boundary nodes and their conditions.
        gravity: external acceleration [dim] in m/s².
        velocity_history: the last velocities [node, history, dim] in m/s, oldest first; the last one equals ``vel``. None for solvers.
        frame_velocity: velocities at this instant [node, dim] in m/s, if ``vel`` is the mean over the last frame and they are known.
        time: time since the start [s].
        rest_pos: undeformed positions [node, dim] in m; None without a mesh. Nodes without a cell have their initial position.
        cells: nodes of each mesh cell [cell, corner]; a cell with fewer corners than others repeats its last corner.
        cell_dim: dimension of the cells, 2 for surfaces in 3D; None stands for the dimension of space. See ``cells.kinds_of``.
        stress: stress of the mesh or of particles; None if the simulator does not compute it.
        num_substeps: number of solver substeps in the last frame.
        num_corrected: number of nodes that containment put back in the last frame; of an ensemble, the mean over its members.
        num_asleep: number of sleeping nodes, which the simulator did not compute in the last frame; of an ensemble, the mean over its members.
        lost_impulse: momentum [kg m/s] that the sleeping nodes lost, as the sum of magnitudes.
        internal: private data of a solver or simulator, such as deformation gradients. With it, a rollout can continue from any state as if it had not been
            interrupted. It is not stored.
        periodicity: axes along which space repeats.
        rigid_body: number of the rigid body that each node belongs to, −1 for none [node]; None if the scene has no rigid bodies. See ``rigid_bodies``.
        param_names: names of the columns of ``material_params``; empty stands for the first parameter of each material of the data set. Solvers take the
            values of parameters without a column from their settings.
        openings: inlets and outlets. The arrays of a state have the nodes that are in the scene now, so their number changes in an open scene.
        node_id: identities of the nodes [node], ascending, which stay the same while nodes enter and leave; None in scenes that are not open.
        next_id: identity of the next node that enters.
        loads: nodes whose motion is given, and forces on nodes; None if the scene has neither.
    """

    pos: Array = field(metadata=NODE)
    vel: Array = field(metadata=NODE)
    node_type: Array = field(metadata=NODE)
    mass: Array = field(metadata=NODE)
    material_params: Array = field(metadata=NODE)
    boundary: Boundary = field(metadata=SCENE)
    gravity: Array = field(metadata=SCENE)
    velocity_history: Array | None = field(default=None, metadata=NODE)
    time: float = field(default=0.0, metadata=SCENE)
    rest_pos: Array | None = field(default=None, metadata=NODE)
    cells: Array | None = field(default=None, metadata=CELL)
    stress: Stress | None = field(default=None, metadata=STEP)
    cell_dim: int | None = field(default=None, metadata=SCENE)
    num_substeps: int = field(default=0, metadata=STEP)
    num_corrected: int | float = field(default=0, metadata=STEP)
    num_asleep: int | float = field(default=0, metadata=STEP)
    lost_impulse: float = field(default=0.0, metadata=STEP)
    internal: Any = field(default=None, metadata=STEP)
    frame_velocity: Array | None = field(default=None, metadata=NODE)
    periodicity: Periodicity = field(default=NOWHERE, metadata=SCENE)
    param_names: tuple[str, ...] = field(default=(), metadata=SCENE)
    rigid_body: Array | None = field(default=None, metadata=GROUP)
    openings: tuple[Opening, ...] = field(default=(), metadata=SCENE)
    node_id: Array | None = field(default=None, metadata=NODE)
    next_id: int = field(default=0, metadata=SCENE)
    loads: Loads | None = field(default=None, metadata=PARTS)

    @property
    def num_nodes(self) -> int:
        return self.pos.shape[0]

    @property
    def dim(self) -> int:
        return self.pos.shape[1]

    def identity(self, row: int) -> int:
        """Return the identity of the node in a row; the row itself in scenes that are not open."""
        return row if self.node_id is None else int(self.node_id[row])

    def opened(self, openings: Sequence[Opening]) -> State:
        """Return the state with openings. Nodes get their row numbers as identities, unless they have some."""
        if self.node_id is not None:
            return replace(self, openings=tuple(openings))
        xp = array_namespace(self.pos)
        node_id = xp.arange(self.num_nodes, dtype=xp.int64, device=device(self.pos))
        return replace(self, openings=tuple(openings), node_id=node_id, next_id=self.num_nodes)

    def take(self, nodes: Array) -> State:
        """Return some of the nodes, in the given order, and the cells that have all their corners among them.

        Fields of kind ``STEP`` get their defaults: they describe the nodes of the whole scene.

        Args:
            nodes: row numbers [chosen], or a mask [node]. The rows of a mesh do not repeat.
        """
        xp = array_namespace(self.pos)
        rows = xp.asarray(nodes, device=device(self.pos))
        rows = xp.nonzero(rows)[0] if rows.dtype == xp.bool else rows
        names = (*names_of(self, NODE), *names_of(self, GROUP))
        values = {name: value[rows] for name in names if (value := getattr(self, name)) is not None}
        for name in names_of(self, CELL):
            if (cells := getattr(self, name)) is not None:
                number = xp.full((self.num_nodes,), -1, dtype=xp.int64, device=device(self.pos))
                number[rows] = xp.arange(rows.shape[0], dtype=xp.int64, device=device(self.pos))
                cells = number[cells]
                values[name] = cells[xp.all(cells >= 0, axis=1)]
        for name in names_of(self, PARTS):
            if (part := getattr(self, name)) is not None:
                values[name] = part.take(rows)
        return replace(self, **values, **_nothing_known(self))

    @staticmethod
    def joined(states: Sequence[State]) -> State:
        """Return the nodes and cells of several states as one state, in the scene of the first.

        Fields of kind ``STEP`` get their defaults.

        Raises:
            ArrayError: some of the states have a field that others lack.
        """
        first, values = states[0], dict[str, Any]()
        xp = array_namespace(first.pos)
        starts = [0, *accumulate(state.num_nodes for state in states)]
        for name in (*names_of(first, NODE), *names_of(first, GROUP), *names_of(first, CELL)):
            parts = [getattr(state, name) for state in states]
            lacking = [k for k, part in enumerate(parts) if part is None]
            if len(lacking) == len(parts):
                continue
            if lacking:
                raise ArrayError(f"{name}: state {lacking[0]} has none, others have; give it to all states or to none")
            if name in names_of(first, CELL):
                parts = [part + start for part, start in zip(parts, starts, strict=False)]
            if name in names_of(first, GROUP):  # groups are numbered on
                parts = [xp.where(part >= 0, part + start, part) for part, start in zip(parts, _first_numbers(parts), strict=True)]
            values[name] = xp.concat(parts)
        for name in names_of(first, PARTS):
            values[name] = Loads.joined([getattr(state, name) for state in states], [state.num_nodes for state in states])
        return replace(first, **values, **_nothing_known(first))

    def later(self, dt: float, pos: Array, vel: Array, **values: Any) -> State:
        """Return the state one frame later.

        The new velocity is appended to the velocity history, if there is one, and the oldest is dropped. A moving boundary advances by a frame. Nodes whose
        motion is given (``loads``) get their given positions instead of those in ``pos``. Fields of kind ``STEP`` get their defaults.

        Args:
            dt: frame interval [s].
            pos: positions [node, dim] in m. They are wrapped into a periodic domain.
            vel: velocities [node, dim] in m/s.
            values: other fields, by name.
        """
        if self.loads is not None:
            pos, vel, values = self._with_given_motion(self.loads, dt, pos, vel, values)
        if self.velocity_history is not None and "velocity_history" not in values:
            xp = array_namespace(vel)
            values["velocity_history"] = xp.concat([self.velocity_history[:, 1:], vel[:, None]], axis=1)
        known: dict[str, Any] = {
            "time": self.time + dt,
            "boundary": self.boundary.at(1),
            "frame_velocity": None,
            **_nothing_known(self),
            **values,
        }
        return replace(self, pos=self.periodicity.wrapped(pos), vel=vel, **known)

    def _with_given_motion(
        self, loads: Loads, dt: float, pos: Array, vel: Array, values: dict[str, Any]
    ) -> tuple[Array, Array, dict[str, Any]]:
        """Return the arguments of ``later`` in which prescribed nodes move as given, and their loads advance by a frame."""
        pos = loads.moved(pos)
        given = self.periodicity.shortest(pos - self.pos) / dt
        vel, values = loads.at_prescribed(given, vel), {**values, "loads": loads.at(1)}
        if values.get("velocity_history") is not None:
            past = values["velocity_history"]
            values["velocity_history"] = array_namespace(past).concat([past[:, :-1], vel[:, None]], axis=1)
        if values.get("frame_velocity") is not None:
            values["frame_velocity"] = loads.at_prescribed(given, values["frame_velocity"])
        return pos, vel, values

    def corrected(self, pos: Array, vel: Array) -> State:
        """Return the same instant with other positions [m] and velocities [m/s]; the last velocity of the history changes with them.

        Nodes whose motion is given stay as they are.
        """
        history = self.velocity_history
        if self.loads is not None:
            pos, vel = self.loads.at_prescribed(self.pos, pos), self.loads.at_prescribed(self.vel, vel)
        if history is not None:
            history = array_namespace(vel).concat([history[:, :-1], vel[:, None]], axis=1)
        at_frame = None if self.frame_velocity is None else self.frame_velocity + (vel - self.vel)
        return replace(self, pos=pos, vel=vel, velocity_history=history, frame_velocity=at_frame)

    def to_torch(self, device: Any = "cpu") -> State:
        """Return the state with tensors of float64 and int64 on a device. ``internal`` is dropped, as it belongs to a solver."""
        import torch

        def tensor(x: Array) -> Any:
            if isinstance(x, np.ndarray):  # a copy: stored arrays may be read-only
                x = torch.from_numpy(x.astype(np.float64 if np.issubdtype(x.dtype, np.floating) else np.int64))
            return x.to(device, torch.float64 if x.is_floating_point() else torch.int64)

        def tensors(part: Any) -> dict[str, Any]:
            values = {declared.name: getattr(part, declared.name) for declared in fields(part)}
            return {name: tensor(value) for name, value in values.items() if isinstance(value, (np.ndarray, torch.Tensor))}

        boundary = replace(self.boundary, **tensors(self.boundary))
        stress = None if self.stress is None else replace(self.stress, **tensors(self.stress))
        return replace(self, **tensors(self) | {"boundary": boundary, "stress": stress, "internal": None})


def _first_numbers(parts: Sequence[Array]) -> list[int]:
    """Return the number that the first group of each array [node] gets when the arrays are joined."""
    counts = [int(array_namespace(part).max(part)) + 1 if part.shape[0] else 0 for part in parts]
    return [0, *accumulate(counts)][:-1]


_defaults: dict[Any, dict[str, Any]] = {}


def _nothing_known(state: State) -> dict[str, Any]:
    """Return the defaults of the fields of kind ``STEP``, found once per class of states."""
    kind = type(state)
    if kind not in _defaults:
        _defaults[kind] = {declared.name: declared.default for declared in fields(state) if declared.metadata == STEP}
    return _defaults[kind]
