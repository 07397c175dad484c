"""What an evaluation does about uncertainty: it calibrates error bands, or measures their coverage, and warns of scenes unlike the known ones."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

from gpe_pl.evaluation.calibration import Calibration
from gpe_pl.evaluation.coverage import TABLE, Coverage
from gpe_pl.evaluation.horizons import labels
from gpe_pl.evaluation.metric_rows import LEARNED, Row
from gpe_pl.evaluation.predictions import PredictedScene
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.learned import bands
from gpe_pl.learned.pretrained import FOLDER
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.unlike import UnlikeScenes, trained_limits
from gpe_pl.schema import Split

log = logging.getLogger(__name__)


class Uncertainty:
    """Sees the scenes of a split after their rollouts.

    Args:
        checkpoints: checkpoints of the evaluated model, or of the members of an ensemble.
        members: the model, or the members, for the spacing and the frames of the split (``LearnedSimulator.on``).
        settings: settings of the evaluation.
        split: evaluated split.
        split_checksum: checksum of its scenes.
        calibrate: calibrate bands instead of measuring the coverage of stored ones.

    Raises:
        SealError: the bands beside the checkpoint are damaged.
    """

    def __init__(
        self,
        checkpoints: Sequence[str],
        members: Sequence[LearnedSimulator],
        settings: EvaluationSettings,
        split: Split,
        split_checksum: str,
        calibrate: bool = False,
    ) -> None:
        self.checkpoints, self.split = checkpoints, split
        first, self.num_repeated = members[0], 0
        frame_dt, spacing = first.builder.metadata.frame_dt, first.builder.metadata.spacing
        self.horizons = labels(settings.horizons, frame_dt)
        start_frame = settings.first_frame(first.builder.config.history, frame_dt)
        other = _other_settings(settings, members)
        self.calibration = Calibration(split_checksum, settings.containment, start_frame, other) if calibrate else None
        stored = None if calibrate else bands.read(*checkpoints)
        unfit = "" if stored is None else stored.unfit(start_frame, frame_dt, spacing, settings.containment, other, split_checksum)
        if unfit:
            log.warning("the coverage of the model's error bands is not measured: %s", unfit)
        self.coverage = None if stored is None or unfit else Coverage(stored)
        if stored is None:
            self.unlike = UnlikeScenes(trained_limits(first), "training", is_complete=False)
        else:
            self.unlike = UnlikeScenes(stored.features, "calibration scenes", is_complete=True, spread=stored.spread)

    def see(self, scene: PredictedScene, about: tuple[str, int, str, float]) -> Iterator[Row]:
        """Take a scene, and yield further metrics (``Coverage.add``), and the number of quantities in which it is unlike the known scenes (``num_unlike``).

        Args:
            scene: scene with its rollouts.
            about: split, number, parameter group and parameter of the scene, as in ``Row``.
        """
        if self.calibration is not None:
            self.calibration.add(scene)
            return
        spread = None if scene.spread is None else scene.spread.mean(axis=1)
        num_unlike = self.unlike.add(scene.features, spread)
        if self.coverage is None:
            return
        yield Row(LEARNED, *about, "num_unlike", "full", float(num_unlike))
        if bands.identity(scene.truth) in self.coverage.bands.scenes:
            self.num_repeated += 1
        else:
            yield from self.coverage.add(scene, self.horizons, about)

    def finish(self, folder: Path) -> None:
        """Store the bands beside the checkpoint (those of a shipped model in the folder of the evaluation), or write table and figure of coverage there. Log
        warnings.

        Raises:
            CalibrationError: there are too few scenes.
        """
        if self.calibration is not None:
            path = bands.path_beside(self.checkpoints)
            if path.parent == FOLDER:
                path = folder / path.name
                log.warning(
                    "the bands that come with the shipped model stay in use; for others, copy the checkpoint and calibrate the copy"
                )
            bands.write(path, self.calibration.bands(self.checkpoints))
            print(path)
            return
        self.unlike.warn(self.split)
        if self.num_repeated:
            log.warning(
                "the coverage of the model's error bands leaves out %d scenes of %s that calibrated them", self.num_repeated, self.split
            )
        if self.coverage is not None and self.coverage.scenes:
            self.coverage.write(folder, self.horizons)
            print((folder / TABLE).read_text(encoding="utf-8"))


def _other_settings(settings: EvaluationSettings, members: Sequence[LearnedSimulator]) -> dict[str, bool | int | float]:
    """Return the settings, besides start and containment, with which rollouts differ from those of the model, or of any member, by default, by key."""
    own = {
        "clamp_parameters": {member.clamps_parameters for member in members},
        "static_friction": {member.static_friction for member in members},
        "mirror_average": {member.mirror_average for member in members},
    }
    given = {name: getattr(settings, name) for name in own}
    changed = {f"evaluation.{name}": value for name, value in given.items() if value is not None and own[name] != {value}}
    return {**changed, **{f"rollout.{name}": value for name, value in members[0].skips.approximations.items()}}
