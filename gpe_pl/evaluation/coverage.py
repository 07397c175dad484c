"""Measures how often error bands cover the ground truth of new scenes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gpe_pl.evaluation.horizons import FULL
from gpe_pl.evaluation.metric_rows import LEARNED, Row
from gpe_pl.evaluation.predictions import PredictedScene
from gpe_pl.files.atomic import replace_text
from gpe_pl.files.markdown import table_row
from gpe_pl.learned.bands import LEVEL, LEVELS, Bands, Guarantee, errors_of, of_nodes_in
from gpe_pl.metrics import bootstrap_interval
from gpe_pl.metrics.conformal import chance_range
from gpe_pl.viz.coverage import CoverageCurves, coverage_figure
from gpe_pl.viz.saving import save_figure

TABLE, FIGURE = "coverage.md", "coverage.png"
GUARANTEES: tuple[Guarantee, ...] = ("nodes", "scene")


@dataclass(frozen=True)
class SceneCoverage:
    """Coverage of one scene. Only the nodes count that ``metrics.compared`` returns.

    Attributes:
        group: split, and group of unseen material parameters.
        inside: fraction of nodes inside the bands of each guarantee [level, frame].
        radius: mean radius of the bands of each guarantee with ``LEVEL`` in each frame [spacings].
        error: median distance of nodes from the ground truth in each frame [spacings].
    """

    group: str
    inside: dict[Guarantee, np.ndarray]
    radius: dict[Guarantee, np.ndarray]
    error: np.ndarray

    def enough(self, level: int) -> np.ndarray:
        """Return in which frames the bands whose guarantee is ``scene`` contain enough nodes. ``level`` is a number in ``LEVELS``."""
        return self.inside["scene"][level] >= LEVELS[level]


@dataclass
class Coverage:
    """Measures the coverage of bands, scene by scene.

    Attributes:
        bands: bands of the evaluated model.
        scenes: coverage of each scene so far.
    """

    bands: Bands
    scenes: list[SceneCoverage] = field(default_factory=list)

    def add(self, scene: PredictedScene, horizons: dict[int, str], about: tuple[str, int, str, float]) -> Iterator[Row]:
        """Add a scene after its rollout, and yield its metrics with a level of ``bands.LEVEL``.

        - ``fraction_in_bands``: fraction of nodes inside the bands whose guarantee is ``nodes``.
        - ``enough_in_bands``: 1 if at least 90 % of the nodes are inside the bands whose guarantee is ``scene``, else 0.
        - ``band_radius`` [m]: mean radius of the bands whose guarantee is ``nodes``.

        Args:
            scene: scene with its rollout.
            horizons: labels of horizons by number of frames.
            about: split, number, parameter group and parameter of the scene, as in ``Row``.
        """
        prediction, truth = scene.predictions[LEARNED], scene.truth
        metadata, error = truth.metadata, errors_of(prediction, truth)
        counted = ~np.isnan(error)
        num_counted = np.maximum(1, counted.sum(axis=1))
        inside, radii = dict[Guarantee, np.ndarray](), dict[Guarantee, np.ndarray]()
        for guarantee in GUARANTEES:
            bands = [of_nodes_in(truth, self.bands.radius(prediction, scene.spread, level, guarantee), 0.0) for level in LEVELS]
            inside[guarantee] = np.stack([1 - (error > radius).sum(axis=1) / num_counted for radius in bands])
            radii[guarantee] = np.where(counted, bands[LEVELS.index(LEVEL)], 0.0).sum(axis=1) / num_counted / metadata.spacing
        group = metadata.split if metadata.parameter_group == "seen" else f"{metadata.split}, {metadata.parameter_group}"
        middle = [float(np.median(own[known])) if known.any() else 0.0 for own, known in zip(error, counted, strict=True)]
        own = SceneCoverage(group, inside, radii, np.array(middle) / metadata.spacing)
        self.scenes.append(own)
        number = LEVELS.index(LEVEL)
        for frame, label in {**horizons, truth.num_frames - 1: FULL}.items():
            if frame < truth.num_frames:
                yield Row(LEARNED, *about, "fraction_in_bands", label, float(inside["nodes"][number, frame]))
                yield Row(LEARNED, *about, "enough_in_bands", label, float(own.enough(number)[frame]))
                yield Row(LEARNED, *about, "band_radius", label, float(radii["nodes"][frame]) * metadata.spacing)

    def groups(self) -> dict[str, list[SceneCoverage]]:
        """Return the scenes by group."""
        return {group: [scene for scene in self.scenes if scene.group == group] for group in dict.fromkeys(s.group for s in self.scenes)}

    def write(self, folder: Path, horizons: dict[int, str]) -> None:
        """Write ``coverage.md`` and ``coverage.png`` into a folder."""
        replace_text(folder / TABLE, "\n".join([*self._lines(horizons), ""]))
        curves = {group: _curves(own) for group, own in self.groups().items()}
        last = max(curve.inside.shape[1] for curve in curves.values()) - 1
        ends = {last: FULL if len({len(scene.error) for scene in self.scenes}) == 1 else f"{last * self.bands.frame_dt:.6g}s"}
        save_figure(coverage_figure(curves, LEVELS, LEVEL, self.bands.frame_dt, {**horizons, **ends}), folder / FIGURE, dpi=150)

    def _lines(self, horizons: dict[int, str]) -> list[str]:
        header = [
            "scenes",
            "number",
            "horizon",
            "nodes inside",
            "scenes with enough nodes inside",
            "by chance",
            "radius [spacings]",
            "radius for scenes",
        ]
        lines = [table_row(header), "|" + "---|" * len(header)]
        level, per_cent = LEVELS.index(LEVEL), f"{100 * LEVEL:g} %"
        for group, own in self.groups().items():
            for frame, label in [*horizons.items(), (-1, FULL)]:
                reached = [scene for scene in own if frame < len(scene.error)]
                if not reached or {len(scene.error) for scene in own} == {frame + 1}:  # the last frame of all is ``full``
                    continue
                inside = bootstrap_interval([[float(s.inside["nodes"][level, frame]) for s in reached]], statistic=np.mean)
                enough = np.mean([s.enough(level)[frame] for s in reached])
                low, high = chance_range(self.bands.num_scenes, len(reached), LEVEL)
                radii = [f"{np.mean([s.radius[g][frame] for s in reached]):.3g}" for g in GUARANTEES]
                cells = [
                    *(group, str(len(reached)), label),
                    f"{100 * inside.estimate:.1f} % [{100 * inside.low:.1f}, {100 * inside.high:.1f}]",
                    *(f"{100 * enough:.0f} %", f"{100 * low:.0f} to {100 * high:.0f} %", *radii),
                ]
                lines.append(table_row(cells))
        note = (
            f"Error bands with a level of {per_cent} from {self.bands.num_scenes} scenes of {self.bands.dataset}, {self.bands.split}. Nodes inside: mean "
            f"over scenes of the fraction of nodes inside the narrower bands, with its 95 % bootstrap interval. Enough: at least {per_cent} of a scene's nodes "
            "inside the wider bands. Nodes whose motion is given do not count. Rows have the scenes that reach their horizon; `full` has each at its end. "
            "By chance: where this number lies in 90 % of draws if bands are exact. Radii are means over nodes."
        )
        return [*lines, "", note]


def _curves(scenes: Sequence[SceneCoverage]) -> CoverageCurves:
    """Return means of coverages and medians of sizes over scenes, in the frames that all of them have."""
    stop = min(len(scene.error) for scene in scenes)
    inside = np.mean([scene.inside["nodes"][:, :stop] for scene in scenes], axis=0)
    radius, error = (
        np.median([scene.radius["nodes"][:stop] for scene in scenes], axis=0),
        np.median([s.error[:stop] for s in scenes], axis=0),
    )
    return CoverageCurves(len(scenes), inside, radius, error)
