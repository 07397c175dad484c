"""Least distance of liquid nodes: nodes that come nearer to each other in a step are pushed apart.

A network that was trained briefly, or on few trajectories of a liquid, may not resist slow compression, so that nodes of a settled pool cluster. Here pairs of
nodes that are too near move apart along their connecting line, each by its share of the gap. Both get opposite impulses, so momentum and angular momentum
do not change.
Source of the constraint: Müller et al. 2007, "Position based dynamics", section 3.3.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch

from gpe_pl.errors import GpeError
from gpe_pl.graphs.neighbors import radius_pairs
from gpe_pl.metrics.liquids import MATERIAL, liquid_nodes
from gpe_pl.schema import node_code
from gpe_pl.trajectory.arrays import nearest_distances
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory

NUM_PASSES = 10
"""Number of passes over all pairs."""
RELAXATION = 0.3
"""Fraction of a gap that one pass closes. A node has up to twelve near neighbours, whose pushes add up, so larger fractions overshoot."""
MARGIN = 1.3
"""Pairs up to this factor times the least distance are looked at, since pushes bring nodes nearer to others."""
MOST_FRAMES = 50
"""Largest number of frames of a trajectory from which the distance is taken."""


class LeastDistanceError(GpeError, ValueError):
    """Raised when a least distance is asked for but the data set has no liquid, or when its value is impossible."""


def checked(distance: Any) -> float:
    """Return a least distance [m].

    Raises:
        LeastDistanceError: it is no finite number of at least 0.
    """
    if isinstance(distance, bool) or not isinstance(distance, int | float) or not 0 <= distance < float("inf"):
        raise LeastDistanceError(f"least_distance={distance!r}: must be a finite number of at least 0, in m; 0 turns it off")
    return float(distance)


def distance_in(trajectories: Iterable[Trajectory], quantile: float) -> float:
    """Return a quantile of the distances [m] of liquid nodes to their nearest ones, over trajectories and evenly spread frames.

    Raises:
        LeastDistanceError: no trajectory has a liquid.
    """
    found: list[np.ndarray] = []
    for trajectory in trajectories:
        fluid = liquid_nodes(trajectory)
        if fluid.any():
            frames = np.unique(np.linspace(0, trajectory.num_frames - 1, MOST_FRAMES).round().astype(np.int64))
            for frame in frames:
                own = fluid if trajectory.alive is None else fluid & trajectory.alive[frame]
                if own.sum() > 1:
                    found.append(nearest_distances(trajectory.pos[frame][own].astype(np.float64), trajectory.metadata.periodicity))
    if not found:
        raise LeastDistanceError("training.least_distance: the training data have no liquid; set training.least_distance=null")
    return float(np.quantile(np.concatenate(found), quantile))


def kept_apart(state: State, distance: float, dt: float) -> State:
    """Return a state whose liquid nodes are hardly nearer to each other than a distance. Velocities change by displacement / ``dt``.

    Nodes of rigid bodies stay where they are. Along axes of a given motion, nodes have an infinite mass. Nodes that move apart may come too near to others, so
    a small part of a gap can remain.

    Args:
        state: state after a step, as tensors.
        distance: least distance [m].
        dt: frame interval [s].

    Returns:
        The same object if no pair is too near.
    """
    is_liquid = state.node_type == node_code(MATERIAL)
    if state.rigid_body is not None:
        is_liquid = is_liquid & (state.rigid_body < 0)
    rows = torch.nonzero(is_liquid)[:, 0]
    start = state.pos[rows]
    pairs = radius_pairs(np.ascontiguousarray(start.detach().cpu().numpy()), MARGIN * distance, state.periodicity)
    i, j = torch.from_numpy(pairs).to(rows.device)
    mass = state.mass[rows].to(start)
    weight = (torch.stack([mass[j], mass[i]]) / (mass[i] + mass[j]))[..., None]
    if state.loads is not None:
        given = torch.from_numpy(state.loads.prescribed).to(rows.device)[rows]
        own, other = torch.stack([given[i], given[j]]), torch.stack([given[j], given[i]])
        weight = torch.where(own, 0.0, torch.where(other, 1.0, weight))
    pos, has_moved = start, False
    for _ in range(NUM_PASSES):
        way = state.periodicity.shortest(pos[i] - pos[j])
        way[..., 0] = torch.where((way == 0).all(dim=1), 1e-12 * distance, way[..., 0])  # nodes at one place part along the first axis
        length = torch.linalg.vector_norm(way, dim=1).clamp(min=1e-12 * distance)
        gap = distance - length
        if not bool((gap > 0).any()):
            break
        push = (RELAXATION * gap.clamp(min=0) / length)[:, None] * way
        pos = pos.index_add(0, i, weight[0] * push).index_add(0, j, weight[1] * push, alpha=-1)
        has_moved = True
    if not has_moved:
        return state
    moved = pos - start
    return state.corrected(
        state.pos.index_copy(0, rows, state.periodicity.wrapped(pos)), state.vel.index_copy(0, rows, state.vel[rows] + moved / dt)
    )
