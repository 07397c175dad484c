"""The figure of a multi-scale graph draws every node and edge once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.graphs.multiscale import levels_of, multiscale_graph
from gpe_pl.viz.graph_figure import multiscale_figure
from tests import scenes
from tests.conftest import make_trajectory


@pytest.mark.parametrize("kind", ["triangles", "tetrahedra"])
def test_every_level_is_a_panel_with_its_nodes_and_edges(kind: str) -> None:
    s = scenes.mesh_state(kind)
    assert s.rest_pos is not None
    assert s.cells is not None
    bounds = ((0.0, 1.0),) * s.dim
    trajectory = make_trajectory(num_nodes=s.num_nodes, bounds=bounds, spacing=scenes.SPACING)
    pos = np.repeat(s.pos[None], 2, axis=0)
    trajectory = replace(trajectory, pos=pos, vel=pos, rest_pos=s.rest_pos, cells=s.cells)
    graph = multiscale_graph(s.rest_pos, s.cells, scenes.SPACING, levels_of(1.0, scenes.SPACING))
    figure = multiscale_figure(trajectory, 1)
    sizes = np.bincount(graph.level)
    assert len(figure.axes) == len(sizes) > 2
    drawn = 0
    for axes, size in zip(figure.axes, sizes, strict=True):
        assert len(axes.collections[0].get_offsets()) == size  # type: ignore[arg-type]
        drawn += sum(len(line.get_xdata()) // 3 for line in axes.lines)  # type: ignore[arg-type]
    assert figure.get_suptitle() == "sand, friction angle 30°"
    assert drawn == graph.cell_edges.shape[1] + graph.same_edges.shape[1] + graph.down_edges.shape[1]


def test_a_trajectory_without_mesh_is_refused() -> None:
    with pytest.raises(ValueError, match="grains: the trajectory has no mesh"):
        multiscale_figure(make_trajectory())
