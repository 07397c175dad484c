"""The contact sheet of a data set: one scene under several parameter values, to check the data by eye."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.coloring import ColorBy, Coloring
from gpe_pl.viz.film_strip import evenly_spaced_frames, film_strip

DPI = 220
"""Resolution in dots per inch; a sheet is viewed on a screen, and single particles should be visible."""


def informative_color(trajectories: Sequence[Trajectory]) -> ColorBy:
    """Choose what to colour by: the stress of a mesh if there is one, else the material if there are several, else the height at the start."""
    if any(trajectory.stress is not None for trajectory in trajectories):
        return "von_mises"
    return "material" if len(trajectories[0].metadata.materials) > 1 else "height"


def contact_sheet(trajectories: Mapping[str, Trajectory], num_columns: int = 6) -> Figure:
    """Draw a row for each trajectory, with evenly spaced times to the right.

    Args:
        trajectories: trajectories of scenes in the same domain by the label of their row; their numbers of nodes may differ.
        num_columns: number of times; fewer if there are fewer frames.

    Raises:
        ValueError: no trajectories, or ``num_columns`` is not positive.
    """
    if not trajectories:
        raise ValueError("a contact sheet needs at least one trajectory")
    trajectories = {label: trajectory.with_moving_boundary().with_absent_hidden() for label, trajectory in trajectories.items()}
    shown = list(trajectories.values())
    frames = evenly_spaced_frames(max(trajectory.num_frames for trajectory in shown), num_columns)
    return film_strip(list(trajectories.items()), frames, Coloring(informative_color(shown), shown, frames), DPI)
