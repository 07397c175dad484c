"""``Loads``: what is given of the nodes of a scene, as boundary conditions of a finite-element model are: the motion of some nodes, and forces on nodes.

A prescribed node belongs to its body and to the cells of its mesh. Its positions are given for all frames, so no simulator computes them: ``State.later`` puts
every prescribed node where it has to be. A clamped node is one whose given position never changes.

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
        prescribed: whether the motion of each node is given [node].
        path: positions of the prescribed nodes [frame, prescribed_node, dim] in m. The first frame is the present one.
        force: forces on all nodes [frame, node, dim] in N, each from its frame to the next; None if there are none.
    """

    prescribed: np.ndarray
    path: np.ndarray
    force: np.ndarray | None = None

    @property
    def rows(self) -> np.ndarray:
        """Row numbers of the prescribed nodes."""
        return np.flatnonzero(self.prescribed)

    def at(self, frame: int) -> Loads:
        """Return the loads ``frame`` frames later."""
        force = None if self.force is None else self.force[min(frame, len(self.force) - 1) :]
        return replace(self, path=self.path[min(frame, len(self.path) - 1) :], force=force)

    def take(self, nodes: Array) -> Loads:
        """Return the loads of some nodes, given by row numbers [chosen]."""
        chosen = np.asarray(nodes if isinstance(nodes, np.ndarray) else nodes.cpu())
        column = np.cumsum(self.prescribed) - 1
        kept = chosen[self.prescribed[chosen]]
        return Loads(self.prescribed[chosen], self.path[:, column[kept]], None if self.force is None else self.force[:, chosen])

    @staticmethod
    def joined(parts: Sequence[Loads | None], num_nodes: Sequence[int]) -> Loads | None:
        """Return the loads of the nodes of several scenes as one; None if no scene has any."""
        own = [part for part in parts if part is not None]
        if not own:
            return None
        dim, dtype = own[0].path.shape[2], own[0].path.dtype
        whole = [
            Loads(np.zeros(count, bool), np.zeros((1, 0, dim), dtype)) if part is None else part
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
        """Return values [node, …] that are replaced by those given [node, …] at prescribed nodes; arrays or tensors."""
        xp = array_namespace(values)
        mask = xp.asarray(self.prescribed, device=device(values))
        return xp.where(mask.reshape(-1, *[1] * (values.ndim - 1)), given, values)

    def moved(self, start: Array) -> Array:
        """Return positions [node, dim] in m in which prescribed nodes are where they have to be in the next frame, and others where they are in ``start``."""
        xp = array_namespace(start)
        target = np.zeros(start.shape)
        target[self.prescribed] = self.next_positions()
        return self.at_prescribed(xp.asarray(target, dtype=start.dtype, device=device(start)), start)


def _side_by_side(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return arrays [frame, node, dim] joined along nodes. Shorter ones repeat their last frame."""
    longest = max(len(part) for part in parts)
    padded = [np.concatenate([part, np.repeat(part[-1:], longest - len(part), axis=0)]) for part in parts]
    return np.concatenate(padded, axis=1)
