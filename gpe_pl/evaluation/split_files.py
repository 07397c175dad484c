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
    """Writes the files of a split: those of its first scenes while they are evaluated, and those about all scenes after that.

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
    _materials: dict[int, list[str]] = field(default_factory=dict)
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

    def write_quantities(self) -> None:
        """Write the table of quantities, if there are some."""
        if not self._numbers:
            return
        table = io.StringIO(newline="")
        writer = csv.writer(table)
        writer.writerow(COLUMNS)
        writer.writerows([*about, name, quantity.unit, quantity.value, predicted] for about, name, quantity, predicted in self._numbers)
        replace_text(self.run_dir / f"quantities_{self.split}.csv", table.getvalue())

    def draw(self) -> None:
        """Draw the figures about all scenes of the split."""
        if self._truth is None or not self.settings.num_pictures:
            return
        if self._curves:
            path = self.run_dir / f"error_curve_{self.split}.png"
            write_error_curve(path, self._curves, self._truth.metadata.frame_dt, self.settings.export)
        if self._numbers:
            self._draw_quantities()

    def _add_quantities(self, scene: PredictedScene, about: About) -> None:
        from gpe_pl.viz.captions import describe, materials_of
        from gpe_pl.viz.quantities import courses_figure

        truth, prediction = scene.truth, scene.predictions[self.label]
        self._materials[about[1]] = materials_of(truth)
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
            title = f"{self.split} {about[1]}: {describe(truth)}"
            figure = courses_figure(courses, truth.start_time, truth.metadata.frame_dt, title)
            save(figure, self.run_dir / f"quantities_{self.split}_{about[1]:02d}.png", self.settings.export)

    def _draw_quantities(self) -> None:
        from gpe_pl.viz.captions import parameter_name, parameter_value
        from gpe_pl.viz.quantities import Numbers, parity_figure

        numbers: dict[str, Numbers] = {}
        known: dict[int, float] = {}  # by scene
        for (_, scene, _, parameter), name, quantity, predicted in self._numbers:
            assert quantity.value is not None
            numbers.setdefault(name, (quantity.unit, []))[1].append((parameter, quantity.value, predicted))
            known |= {scene: parameter} if np.isfinite(parameter) else {}
        occurring = dict.fromkeys(material for own in self._materials.values() for material in own)
        firsts = {(own.name, own.unit): own for scene in known for own in (MATERIALS[material][0] for material in self._materials[scene])}
        label, span = "material parameter", ""
        if len(firsts) == 1:
            (first,) = firsts.values()
            label = f"{parameter_name(first)} [{first.unit}]"
            span = f", {parameter_name(first)} {parameter_value(first, min(known.values()), max(known.values()))}"
        title = f"{self.split}, {len({about[1] for about, *_ in self._numbers})} scenes of {', '.join(occurring)}{span}"
        save(parity_figure(numbers, label, title), self.run_dir / f"parity_{self.split}.png", self.settings.export)
