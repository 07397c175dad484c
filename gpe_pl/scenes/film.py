"""``Film``: rollouts of one scene, with their error, pictures and viewer."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpe_pl.errors import GpeError
from gpe_pl.export.trajectories import write_npz
from gpe_pl.files.destinations import file_fault
from gpe_pl.files.names import portable
from gpe_pl.metrics.open_scenes import entering, leaving, ledger
from gpe_pl.metrics.rollouts import displacement
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.browser import open_page
from gpe_pl.viz.captions import describe, heading, with_heading
from gpe_pl.viz.figures import rollout_figure
from gpe_pl.viz.notebook import MOST_FRAMES, embedded_viewer
from gpe_pl.viz.saving import save_figure
from gpe_pl.viz.video import write_animation
from gpe_pl.viz.viewer import write_viewer

FIGURES = (".png", ".svg", ".pdf")
ANIMATIONS = (".gif", ".mp4")


class FilmFault(GpeError, ValueError):
    """Raised for a file as which a film cannot be written."""


@dataclass(frozen=True)
class Film:
    """Rollouts of one scene.

    Attributes:
        title: name of the scene.
        first: the ground truth if there is one, else a prediction.
        others: further rollouts with the same nodes and frames, by name.
    """

    title: str
    first: Trajectory
    others: Mapping[str, Trajectory]

    def summary(self) -> str:
        """Return one line per inlet, outlet and rollout.

        Lines of rollouts have the length, the error if the first rollout is ground truth, and why a rollout stopped if it stopped early.
        """
        lines = [describe(self.first), *map(str, self.first.openings)]
        for name, rollout in with_heading(self.first, self.others).items():
            line = f"{name}: {(rollout.num_frames - 1) * rollout.metadata.frame_dt:.3g} s in {rollout.num_frames - 1} frames, {rollout.num_nodes} nodes"
            if rollout.alive is not None:
                line += f" in all{_account(rollout)}"
            if rollout is not self.first and rollout.alive is None:
                line += f"; {self._in_words(name)}"
            lines.append(line + (f"; stopped early, {rollout.termination.message}" if rollout.termination is not None else ""))
        return "\n".join(lines)

    def _in_words(self, name: str) -> str:
        """Return the distance of another rollout from the first, with the time that it covers if one of the two stopped early."""
        shared, frames = (count(rollout.num_frames for rollout in (self.first, self.others[name])) - 1 for count in (min, max))
        what = f"distance from the {heading(self.first)}"
        if shared == 0:
            return f"{what} not known, because they have no frame after the start in common"
        until = f" over {shared * self.first.metadata.frame_dt:.3g} s" if shared < frames else ""
        return f"{what} {self.distance(name):.3g} m (root mean square{until})"

    def distance(self, name: str) -> float:
        """Return the root mean square distance [m] of the nodes of another rollout from those of the first, over the frames that both have.

        Along periodic axes it is that of the nearest images. It is NaN if they have none after the start in common.

        Nodes of open scenes are at other places after some time, so there the distance says nothing; compare ``metrics.open_scenes``.
        """
        other = self.others[name]
        count = min(self.first.num_frames, other.num_frames)
        apart = displacement(other.pos[1:count], self.first.pos[1:count], self.first.metadata)
        return float(np.sqrt(np.mean(np.sum(apart**2, axis=-1)))) if count > 1 else math.nan

    def write(self, path: Path | str) -> Path:
        """Write a viewer (.html), a figure (.png, .svg, .pdf), an animation (.gif, .mp4), or arrays (.npz); returns the path.

        Of several rollouts, arrays become one file each (see ``files``), and the path of the first is returned.

        Raises:
            FilmFault: another file type, or a place where no file can be.
            OSError: the file cannot be written.
        """
        path = Path(path)
        stride = max(1, -(-self.first.num_frames // MOST_FRAMES))
        check_file(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".html":
            write_viewer(path, self.first, self.others, stride=stride, title=self.title)
        elif path.suffix in FIGURES:
            save_figure(rollout_figure(self.first, self.others), path)
        elif path.suffix in ANIMATIONS:
            write_animation(path, self.first, self.others, stride=stride)
        else:
            for file, rollout in zip(self.files(path), (self.first, *self.others.values()), strict=True):
                write_npz(file, rollout)
        return self.files(path)[0]

    def files(self, path: Path | str) -> list[Path]:
        """Return the files that ``write`` writes: ``path``, or for arrays of several rollouts ``path`` with the name of each added, in their order."""
        path = Path(path)
        if path.suffix != ".npz" or not self.others:
            return [path]
        names = with_heading(self.first, self.others)
        return [path.with_stem(f"{path.stem}_{portable(name.replace(' ', '_'))}") for name in names]

    def _repr_html_(self) -> str:
        """Return the viewer for a notebook."""
        return embedded_viewer(self.first, self.others, self.title)

    def show(self) -> Path:
        """Open the viewer in a browser, and return its file. Where there is no browser, print where the file is."""
        path = self.write(Path(tempfile.mkdtemp(prefix="gpe_")) / "film.html")
        if not open_page(path):
            print(f"no browser here; open {path}")
        return path


def _account(rollout: Trajectory) -> str:
    """Describe what enters, leaves and stays in a rollout of an open scene. The second half shows whether a flow has become steady."""
    entered, left, book = entering(rollout).sum(), leaving(rollout).sum(), ledger(rollout)
    half = slice(rollout.num_frames // 2, None)
    seconds = max(1, len(book.mass[half])) * rollout.metadata.frame_dt
    unit = "kg" if rollout.metadata.dim == 3 else "kg/m"
    rates = [
        f"{mass[half].sum() / seconds:.4g} {unit}/s {verb}" for mass, verb in ((book.entered_mass, "enter"), (book.left_mass, "leave"))
    ]
    stays = f"{book.mass[half].mean():.4g} {unit} are there"
    return f", {entered} entered, {left} left; in the second half {rates[0]}, {rates[1]} and {stays}"


def check_file(path: Path) -> None:
    """Raise ``FilmFault`` if a film cannot be written as a file of this type, or not at this place."""
    known = (".html", *FIGURES, *ANIMATIONS, ".npz")
    if path.suffix not in known:
        raise FilmFault(f"{path}: files of type {path.suffix or 'none'} are not written; take one of {', '.join(known)}")
    if fault := file_fault(path):
        raise FilmFault(f"file={path}: {fault}; name another file")
