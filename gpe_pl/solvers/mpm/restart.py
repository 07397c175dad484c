"""Deformation of elastic particles from their positions at rest and now.

The stress of an elastomer depends on its deformation only. Positions at rest and now determine the deformation, and velocities its rate. A restart loses the
part of the velocity that the grid does not represent (``smoothing``). A restarted run is therefore near the continued run, but not equal to it.
"""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial import cKDTree


def gradients(
    values: Float64[np.ndarray, "node dim"], at: Float64[np.ndarray, "node dim"], cells: Int[np.ndarray, "cell corner"]
) -> Float64[np.ndarray, "node dim dim"]:
    """Return the gradient of values at each node, by a least-squares fit to the differences from the nodes with which it shares cells.

    Nodes without a cell take the gradient of the nearest node that has one.

    Args:
        values: vectors at the nodes.
        at: positions of the nodes [m], with respect to which the vectors are differentiated.
        cells: nodes of each cell; at least one.
    """
    dim = at.shape[1]
    pairs = np.concatenate([cells[:, pair] for pair in itertools.permutations(range(cells.shape[1]), 2)])
    pairs = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
    i, j = pairs.T
    arm, change = at[j] - at[i], values[j] - values[i]
    moment, mixed = np.zeros((len(at), dim, dim)), np.zeros((len(at), dim, dim))
    np.add.at(moment, i, arm[:, :, None] * arm[:, None, :])
    np.add.at(mixed, i, change[:, :, None] * arm[:, None, :])
    result = mixed @ np.linalg.pinv(moment)
    used = np.zeros(len(at), dtype=bool)
    used[cells] = True
    if not used.all():
        nearest = cKDTree(at[used]).query(at[~used])[1]
        result[~used] = result[np.flatnonzero(used)[nearest]]
    return result
