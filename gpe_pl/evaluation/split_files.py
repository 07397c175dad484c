"""Files of an evaluated split: pictures and exports of its first scenes, the curve of errors, and quantities over time and over the parameter."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gpe_pl.evaluation.metric_rows import EXACT, About
from gpe_pl.evaluation.predictions import PredictedScene
from gpe_pl.evaluation.scene_files import save, write_error_curve, write_exports, write_parameter_picture, write_pictures
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.files.atomic import replace_text
from gpe_pl.metrics import per_frame_mse
from gpe_pl.metrics.quantities import Quantity, quantities
from gpe_pl.rollout.baselines import BASELINES
from gpe_pl.schema import MATERIALS
from gpe_pl.trajectory.trajectory import Trajectory

COLUMNS = ("split", "trajectory", "parameter_group", "parameter", "quantity", "unit", "ground_truth", "prediction")


@dataclass
class SplitFiles:
    """Writes the files of a split while its scenes are evaluated.

    Attributes:
        run_dir: folder for the files.
        split: name of the split.
        label: name of the model.
        settings: settings of the evaluation.
    """

    run_dir: Path
    split: str
    label: str
    settings: EvaluationSettings
    _curves: dict[str, list[np.ndarray]] = field(default_factory=dict)
    _numbers: list[tuple[About, str, Quantity, float]] = field(default_factory=list)
    _truth: Trajectory | None = None

    def add(self, scene: PredictedScene, about: About) -> None:
        """Take up a scene after its rollouts, and write its files if it is one of the first."""
        number, formats = about[1], self.settings.export
        self._truth = scene.truth
        for model, prediction in scene.predictions.items():
            if model in (self.label, EXACT, *BASELINES):
                self._curves.setdefault(model, []).append(per_frame_mse(prediction, scene.truth))
        if number < self.settings.num_pictures:
            write_pictures(self.run_dir, self.split, number, scene.truth, {self.label: scene.predictions[self.label]}, formats)
            write_exports(self.run_dir, self.split, number, scene.truth, scene.predictions[self.label], formats)
            if scene.at_values:
                write_parameter_picture(self.run_dir / f"parameters_{self.split}_{number:02d}.png", scene.at_values, formats)
        if self.settings.quantities:
            self._add_quantities(scene, about)

    def finish(self) -> None:
        """Write the files about all scenes of the split."""
        if self._truth is None:
            return
        if self._curves and self.settings.num_pictures:
            path = self.run_dir / f"error_curve_{self.split}.png"
            write_error_curve(path, self._curves, self._truth.metadata.frame_dt, self.settings.export)
        if self._numbers:
            self._write_numbers()

    def _add_quantities(self, scene: PredictedScene, about: About) -> None:
        from gpe_pl.viz.captions import describe
        from gpe_pl.viz.quantities import courses_figure

        truth, prediction = scene.truth, scene.predictions[self.label]
        of_truth = quantities(truth)
        of_prediction = quantities(prediction) if prediction.num_frames > 1 else {}
        for name, quantity in of_truth.items():
            if quantity.value is not None:
                whole = prediction.num_frames == truth.num_frames and name in of_prediction
                value = of_prediction[name].value if whole else None
                self._numbers.append((about, name, quantity, float("nan") if value is None else value))
        if about[1] < self.settings.num_pictures:
            courses = {
                name: (quantity.unit, {"ground truth": quantity.over_time} | ({self.label: own.over_time} if own else {}))
                for name, quantity in of_truth.items()
                for own in [of_prediction.get(name)]
            }
            figure = courses_figure(courses, truth.metadata.frame_dt, f"{self.split} {about[1]}: {describe(truth)}")
            save(figure, self.run_dir / f"quantities_{self.split}_{about[1]:02d}.png", self.settings.export)

    def _write_numbers(self) -> None:
        from gpe_pl.viz.captions import parameter_name, parameter_value
        from gpe_pl.viz.quantities import parity_figure

        table = io.StringIO(newline="")
        writer = csv.writer(table)
        writer.writerow(COLUMNS)
        numbers: dict[str, tuple[str, list[tuple[float, float]]]] = {}
        parameters = {about[1]: about[3] for about, *_ in self._numbers}
        for about, name, quantity, predicted in self._numbers:
            assert quantity.value is not None
            writer.writerow([*about, name, quantity.unit, quantity.value, predicted])
            numbers.setdefault(name, (quantity.unit, []))[1].append((quantity.value, predicted))
        replace_text(self.run_dir / f"quantities_{self.split}.csv", table.getvalue())
        if not self.settings.num_pictures:
            return
        assert self._truth is not None
        material = self._truth.metadata.materials[0]
        parameter, known = MATERIALS[material][0], [value for value in parameters.values() if np.isfinite(value)]
        span = f", {parameter_name(parameter)} {parameter_value(parameter, min(known), max(known))}" if known else ""
        title = f"{self.split}, {len(parameters)} scenes of {', '.join(self._truth.metadata.materials)}{span}"
        figure = parity_figure(numbers, [*parameters.values()], f"{parameter_name(parameter)} [{parameter.unit}]", title)
        save(figure, self.run_dir / f"parity_{self.split}.png", self.settings.export)
