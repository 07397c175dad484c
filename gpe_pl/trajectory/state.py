"""``State``: everything that a ``Simulator`` needs to know at one instant."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from array_api_compat import array_namespace

from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.trajectory.boundary import Array, Boundary


@dataclass(frozen=True)
class Stress:
    """Cauchy stress of a mesh in Pa; in a ``Trajectory`` with a leading axis of frames.

    Attributes:
        node: [node, component], averaged from the cells around each node; zero at nodes of no cell.
        cell: [cell, component]. Components are xx, xy, yy, zz in plane strain and xx, xy, xz, yy, yz, zz in 3D.
    """

    node: Array
    cell: Array

    @property
    def node_von_mises(self) -> Array:
        return von_mises(self.node)

    @property
    def cell_von_mises(self) -> Array:
        return von_mises(self.cell)


def von_mises(stress: Array) -> Array:
    """Von Mises stress √(3/2 s:s) [...] in Pa, with s the deviator of stresses [..., component] ordered as in ``Stress``."""
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
    """Everything a ``Simulator`` needs to know at one instant; arrays of one backend.

    Attributes:
        pos: positions of the dynamic nodes [node, dim] in m.
        vel: velocities [node, dim] in m/s.
        node_type: codes of ``schema.NODE_TYPES`` [node].
        mass: [node] in kg.
        material_params: [node, param], columns named by ``Metadata.param_names``, NaN where not applicable.
        boundary: boundary nodes and their conditions.
        gravity: external acceleration [dim] in m/s².
        velocity_history: the last velocities [node, history, dim], oldest first, the last one equal to ``vel``; None for solvers.
        time: seconds since the start.
        rest_pos: undeformed positions [node, dim] in m, where there is a mesh; nodes of no cell have their initial position.
        cells: nodes of each mesh cell [cell, corner]; one with fewer corners than others repeats its last.
        cell_dim: dimension of the cells, 2 for surfaces in 3D; None: that of space. See ``cells.kinds_of``.
        stress: of the mesh, where the solver computes it.
        num_substeps: that a solver took to come here from the frame before.
        num_corrected: nodes that containment put back in coming here from the frame before.
        num_asleep: nodes that a simulator left alone in coming here from the frame before.
        lost_impulse: momentum [kg m/s], in sum of magnitudes, that it took from them.
        internal: opaque part of a solver (deformation gradient, …), carried so that a restart equals a run-through. Stored frames lack it.
        periodicity: axes along which space repeats.
    """

    pos: Array
    vel: Array
    node_type: Array
    mass: Array
    material_params: Array
    boundary: Boundary
    gravity: Array
    velocity_history: Array | None = None
    time: float = 0.0
    rest_pos: Array | None = None
    cells: Array | None = None
    stress: Stress | None = None
    cell_dim: int | None = None
    num_substeps: int = 0
    num_corrected: int = 0
    num_asleep: int = 0
    lost_impulse: float = 0.0
    internal: Any = None
    periodicity: Periodicity = NOWHERE

    @property
    def num_nodes(self) -> int:
        return self.pos.shape[0]

    @property
    def dim(self) -> int:
        return self.pos.shape[1]

    def to_torch(self, device: Any = "cpu") -> State:
        """The same state as float64 tensors on a device (``internal`` is dropped: it belongs to a solver)."""
        import torch

        def tensor(x: Array) -> Any:
            if isinstance(x, np.ndarray):  # a copy: stored arrays may be read-only
                x = torch.from_numpy(x.astype(np.float64 if np.issubdtype(x.dtype, np.floating) else np.int64))
            return x.to(device, torch.float64 if x.is_floating_point() else torch.int64)

        b = self.boundary
        boundary = replace(b, **{name: tensor(getattr(b, name)) for name in ("pos", "vel", "normal", "friction", "restitution")})
        arrays = {name: tensor(getattr(self, name)) for name in ("pos", "vel", "node_type", "mass", "material_params", "gravity")}
        for name in ("velocity_history", "rest_pos", "cells"):
            value = getattr(self, name)
            arrays[name] = None if value is None else tensor(value)
        stress = None if self.stress is None else Stress(tensor(self.stress.node), tensor(self.stress.cell))
        return replace(self, **arrays, boundary=boundary, stress=stress, internal=None)
