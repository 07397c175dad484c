"""``Loads``: what is given of the nodes of a scene, as boundary conditions of a finite-element model are: the motion of some nodes, and forces on nodes.

A prescribed node belongs to its body and to the cells of its mesh. Its positions are given for all frames, so no simulator computes them: ``State.later`` puts
every prescribed node where it has to be. A clamped node is one whose given position never changes. The motion of a node can be given along some axes only, as
at a plane of symmetry or on rollers; along the others, simulators compute it.

A nodal force f acts on a node of mass m with the acceleration f/m, besides gravity and the forces of neighbours. Tractions and pressures act as nodal forces
that are integrated over the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from array_api_compat import array_namespace, device

Array = Any


@dataclass(frozen=True)
class Loads:
    """Given motion and forces from the present frame on, as NumPy arrays. After their last frame, prescribed nodes stay in place and forces act on.

    Attributes:
        prescribed: whether the motion of each node along each axis is given [node, dim].
        path: positions of the prescribed nodes [frame, prescribed_node, dim] in m. The first frame is the present one. Components that are not given are
            those of the present frame.
        force: forces on all nodes [frame, node, dim] in N, each from its frame to the next; None if there are none.
    """

    prescribed: np.ndarray
    path: np.ndarray
    force: np.ndarray | None = None

    @property
    def rows(self) -> np.ndarray:
        """Row numbers of the nodes whose motion is given along some axis."""
        return np.flatnonzero(self.prescribed.any(axis=1))

    def at(self, frame: int) -> Loads:
        """Return the loads ``frame`` frames later."""
        force = None if self.force is None else self.force[min(frame, len(self.force) - 1) :]
        return replace(self, path=self.path[min(frame, len(self.path) - 1) :], force=force)

    def take(self, nodes: Array) -> Loads:
        """Return the loads of some nodes, given by row numbers [chosen]."""
        chosen = np.asarray(nodes if isinstance(nodes, np.ndarray) else nodes.cpu())
        is_held = np.asarray(self.prescribed.any(axis=1))
        column = np.cumsum(is_held) - 1
        kept = chosen[is_held[chosen]]
        return Loads(self.prescribed[chosen], self.path[:, column[kept]], None if self.force is None else self.force[:, chosen])

    @staticmethod
    def joined(parts: Sequence[Loads | None], num_nodes: Sequence[int]) -> Loads | None:
        """Return the loads of the nodes of several scenes as one; None if no scene has any."""
        own = [part for part in parts if part is not None]
        if not own:
            return None
        dim, dtype = own[0].path.shape[2], own[0].path.dtype
        whole = [
            Loads(np.zeros((count, dim), bool), np.zeros((1, 0, dim), dtype)) if part is None else part
            for part, count in zip(parts, num_nodes, strict=True)
        ]
        force = None
        if any(part.force is not None for part in whole):
            forces = [np.zeros((1, len(p.prescribed), dim)) if p.force is None else p.force for p in whole]
            force = _side_by_side(forces)
        return Loads(np.concatenate([part.prescribed for part in whole]), _side_by_side([part.path for part in whole]), force)

    def next_positions(self) -> np.ndarray:
        """Return the positions of the prescribed nodes in the next frame [prescribed_node, dim] in m."""
        return np.asarray(self.path[min(1, len(self.path) - 1)], np.float64)

    def at_prescribed(self, given: Array, values: Array) -> Array:
        """Return vectors [node, …, dim] whose given components are replaced by those of ``given`` [node, …, dim]; arrays or tensors."""
        xp = array_namespace(values)
        mask = xp.asarray(self.prescribed, device=device(values))
        return xp.where(mask.reshape(len(self.prescribed), *[1] * (values.ndim - 2), values.shape[-1]), given, values)

    def moved(self, start: Array) -> Array:
        """Return positions [node, dim] in m in which prescribed nodes are where they have to be in the next frame, and others where they are in ``start``.

        Along axes that are not given, prescribed nodes are also where they are in ``start``.
        """
        xp = array_namespace(start)
        target = np.zeros(start.shape)
        target[self.rows] = self.next_positions()
        return self.at_prescribed(xp.asarray(target, dtype=start.dtype, device=device(start)), start)


def _side_by_side(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return arrays [frame, node, dim] joined along nodes. Shorter ones repeat their last frame."""
    longest = max(len(part) for part in parts)
    padded = [np.concatenate([part, np.repeat(part[-1:], longest - len(part), axis=0)]) for part in parts]
    return np.concatenate(padded, axis=1)
