"""The viewer in notebooks: trajectories and films show it when they are the value of a cell."""

from __future__ import annotations

import html
from collections.abc import Mapping

from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.viewer import viewer_page

HEIGHT = 520
"""Height of the viewer in a notebook [pixel]."""
MOST_FRAMES = 200
"""Largest number of shown frames. A notebook keeps them in its file."""


def embedded_viewer(first: Trajectory, others: Mapping[str, Trajectory] | None = None, title: str | None = None) -> str:
    """Return the viewer as HTML that a notebook embeds; arguments as in ``viz.viewer.write_viewer``. Of long trajectories, every second, third, … frame."""
    page, _ = viewer_page(first, others, max(1, -(-first.num_frames // MOST_FRAMES)), title)
    return f'<iframe srcdoc="{html.escape(page)}" style="width: 100%; height: {HEIGHT}px; border: 0" title="viewer"></iframe>'
