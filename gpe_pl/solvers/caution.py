"""Warnings about scenes and parameters that a solver does not resolve, before data are generated. ``docs/results/convergence.md`` has measurements."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import sparse

from gpe_pl.schema import MATERIALS
from gpe_pl.trajectory.state import State

CELLS_ACROSS = 4
"""Smallest thickness [cells] of a body that is not called thin. A body two triangles thick is about 1.5 times as stiff in bending as it should be."""

THIN_FRACTION = 0.1
"""Fraction of the nodes of a mesh that may be thin without a warning."""


def unresolved(solver: Any, parameters: Mapping[str, Sequence[float]], scenes: Iterable[State]) -> Iterator[str]:
    """Yield warnings about what the solver does not resolve: one for each material with such values, and one for initial states with thin meshes.

    Args:
        solver: solver of the data set.
        parameters: values of the first parameter of each material.
        scenes: some initial states.
    """
    for material, smallest in getattr(solver, "smallest_resolved", {}).items():
        name, unit = MATERIALS[material][0].name, MATERIALS[material][0].unit
        values = [value for value in parameters.get(material, ()) if value < smallest]
        if values:
            yield (
                f"{name} = {', '.join(f'{value:g}' for value in values)} {unit} is below {smallest:.3g} {unit}, which the grid of the solver {solver.name} "
                "adds, so such trajectories differ little; choose a smaller grid_spacing, or leave these values out"
            )
    if getattr(solver, "has_mesh", False):
        fractions = [float(np.mean(thin_nodes(np.asarray(s.cells), s.num_nodes, s.dim))) for s in scenes if s.cells is not None]
        thin = [fraction for fraction in fractions if fraction > THIN_FRACTION]
        if thin:
            yield (
                f"in {len(thin)} of the first {len(fractions)} scenes, up to {100 * max(thin):.0f} % of the nodes lie where the mesh has fewer than "
                f"{CELLS_ACROSS} cells across and is too stiff in bending; choose more cells (data.scene.num_cells=…)"
            )


def thin_nodes(cells: np.ndarray, num_nodes: int, dim: int) -> np.ndarray:
    """Return a mask [node] of the nodes in thin parts of a mesh, which are fewer than ``CELLS_ACROSS`` cells thick; cells [cell, corner] are of one kind.

    This is a morphological opening on the graph of mesh edges. It removes half of ``CELLS_ACROSS`` layers of nodes from the surface, then grows what is left by
    as many layers. Nodes that are not reached again are thin.
    """
    corners = cells.shape[1]
    pairs = np.repeat(cells, corners, axis=1).ravel(), np.tile(cells, (1, corners)).ravel()
    near = sparse.csr_array((np.ones(len(pairs[0]), dtype=np.int64), pairs), shape=(num_nodes, num_nodes))
    facets = [np.delete(np.arange(corners), k) for k in range(corners)]
    if dim == 2:
        facets = [np.array([k, (k + 1) % corners]) for k in range(corners)]
    sides, count = np.unique(np.sort(np.concatenate([cells[:, facet] for facet in facets]), axis=1), axis=0, return_counts=True)
    outer = np.zeros(num_nodes, dtype=bool)
    outer[np.unique(sides[count == 1])] = True
    for _ in range(CELLS_ACROSS // 2 - 1):
        outer |= near @ outer > 0
    thick = ~outer
    for _ in range(CELLS_ACROSS // 2):
        thick |= near @ thick > 0
    return ~thick
