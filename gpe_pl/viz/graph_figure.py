"""The multi-scale graph of a mesh, level by level: the input of a model for a meshed body (paper, figure 1 b)."""

from __future__ import annotations

import textwrap

import numpy as np
from matplotlib.figure import Figure

from gpe_pl.graphs.islands import unwrapped
from gpe_pl.graphs.multiscale import levels_of, multiscale_graph
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.captions import describe
from gpe_pl.viz.coloring import PALETTE
from gpe_pl.viz.film_strip import CHARACTER, new_figure

PANEL = 1.8
"""Width and height [inch] of a panel."""


def multiscale_figure(trajectory: Trajectory, frame: int = 0) -> Figure:
    """Draw one panel for the cell edges and one for each level of virtual nodes, with its ``same`` edges and, faint, the ``down`` edges to its children.

    Materials and parameter values stand above the panels. A 3D scene is viewed along y.

    Raises:
        ValueError: the trajectory has no mesh.
    """
    if trajectory.rest_pos is None or trajectory.cells is None or len(trajectory.cells) == 0:
        raise ValueError(f"{trajectory.metadata.dataset}: the trajectory has no mesh to draw; choose one of data=elastomer or data=fem")
    m = trajectory.metadata
    graph = multiscale_graph(trajectory.rest_pos, trajectory.cells, m.spacing, levels_of(m.longest_side, m.spacing), m.periodicity)
    above, below = graph.descent
    mass = trajectory.mass[below].astype(np.float64)
    count = len(graph.level)
    total = np.bincount(above, mass, count)[graph.num_nodes :]
    pos, _ = unwrapped(trajectory.pos[frame].astype(np.float64), graph.cell_edges, m.periodicity)
    mean = [np.bincount(above, mass * x[below], count)[graph.num_nodes :] / total for x in pos.T]
    points = np.concatenate([pos, np.stack(mean, axis=1)])[:, [0, -1]]

    num_levels = int(graph.level.max())
    figure = new_figure(PANEL * (num_levels + 1), 1.15 * PANEL)
    panels = figure.subplots(1, num_levels + 1, squeeze=False, sharex=True, sharey=True)[0]
    for level, panel in enumerate(panels):
        lateral = graph.same_edges if level else graph.cell_edges
        for edges, color, width in ((graph.down_edges, "0.75", 0.4), (lateral, PALETTE[0], 0.8)):
            source, target = edges[:, graph.level[edges[0]] == level]
            ends = np.stack([points[source], points[target], np.full_like(points[source], np.nan)], axis=1)
            panel.plot(*ends.reshape(-1, 2).T, color=color, linewidth=width)
        here = points[graph.level == level]
        panel.scatter(*here.T, s=4 * 1.8**level, color=PALETTE[1] if level else "black", linewidths=0, zorder=3)
        panel.set_title(f"{len(here)} × grid_{level}" if level else f"{len(here)} mesh nodes", fontsize=8)
        panel.set_aspect("equal")
        panel.set_axis_off()
    figure.suptitle(textwrap.fill(describe(trajectory), int(figure.get_figwidth() / CHARACTER)), fontsize=8)
    return figure
