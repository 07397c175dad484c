"""Calibrates error bands on the scenes of an evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gpe_pl.errors import GpeError
from gpe_pl.evaluation.metric_rows import LEARNED
from gpe_pl.evaluation.predictions import PredictedScene
from gpe_pl.learned.bands import LEVEL, Bands, factors_of, identity, rounded_up, scores_of
from gpe_pl.learned.pretrained import checkpoint_path
from gpe_pl.learned.unlike import united
from gpe_pl.learned.verdicts import checksum
from gpe_pl.metrics.conformal import fewest_scenes


class CalibrationError(GpeError, ValueError):
    """Raised when scenes cannot calibrate bands; the message says what to do."""


@dataclass
class Calibration:
    """Collects calibration scenes.

    Attributes:
        split_checksum: checksum of the calibration split.
        containment: whether rollouts are contained in walls.
        start_frame: frame of the scenes at which rollouts start.
        settings: other settings with which rollouts differ from those of the model by default, by key.
    """

    split_checksum: str
    containment: bool
    start_frame: int
    settings: dict[str, bool | int | float] = field(default_factory=dict)
    scenes: list[np.ndarray] = field(default_factory=list)
    spreads: list[np.ndarray] = field(default_factory=list)
    features: list[dict[str, tuple[float, float]]] = field(default_factory=list)
    identities: list[str] = field(default_factory=list)
    about: tuple[str, str, float, float] = ("", "", 0.0, 0.0)

    def add(self, scene: PredictedScene) -> None:
        """Add a scene after its rollout."""
        prediction, metadata = scene.predictions[LEARNED], scene.truth.metadata
        self.about = metadata.dataset, metadata.split, metadata.frame_dt, metadata.spacing
        self.identities.append(identity(scene.truth))
        self.scenes.append(scores_of(prediction, scene.truth, scene.spread))
        self.features.append(scene.features)
        if scene.spread is not None:
            self.spreads.append(scene.spread.mean(axis=1))

    def bands(self, checkpoints: Sequence[Path | str]) -> Bands:
        """Return the bands of the checkpoints that rolled the scenes out.

        Raises:
            CalibrationError: there are too few scenes for ``LEVEL``.
        """
        if len(self.scenes) < (fewest := fewest_scenes(LEVEL)):
            raise CalibrationError(
                f"{len(self.scenes)} calibration scenes: bands with a level of {LEVEL:g} need at least {fewest}; choose more, such as data.num_test=40"
            )
        dataset, split, frame_dt, spacing = self.about
        num_frames = max(map(len, self.spreads), default=0)  # rollouts that stopped early leave the limits of later frames to the others
        return Bands(
            checkpoints=[checksum(checkpoint_path(path)) for path in checkpoints],
            dataset=dataset,
            split=split,
            split_checksum=self.split_checksum,
            num_scenes=len(self.scenes),
            start_frame=self.start_frame,
            frame_dt=frame_dt,
            spacing=spacing,
            scenes=self.identities,
            containment=self.containment,
            settings=self.settings,
            nodes=factors_of(self.scenes, "nodes"),
            scene=factors_of(self.scenes, "scene"),
            spread=[rounded_up(max(own[frame] for own in self.spreads if frame < len(own))) for frame in range(1, num_frames)],
            features={name: (float(f"{low:.6g}"), float(f"{high:.6g}")) for name, (low, high) in united(self.features).items()},
        )
