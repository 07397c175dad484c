"""Controls of the material: rollouts with other material parameters, which show whether a model uses the parameter that it is given.

A model reads the material only if it is better with a scene's own, unseen values than with the nearest trained ones. For each scene with unseen parameters,
the model starts from the same state with the nearest trained values, those in the middle of the trained range, the farthest ones, and those of another scene.
The solver runs with the nearest, the lowest and the highest trained values. The distance of the first run from the ground truth shows how much the parameter
changes. The distance between the other two is the effect of the whole trained range.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from gpe_pl.data.control_runs import HIGHEST, LOWEST, NEAREST, ControlRuns, TrainedValues, Values, scene_values, with_values
from gpe_pl.data.ground_truth import DatasetSpec, parameter_values
from gpe_pl.errors import GpeError
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics import displacement
from gpe_pl.rollout.loop import Simulator, Start, rollouts
from gpe_pl.schema import Split
from gpe_pl.system.progress import Progress
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.captions import row_label

log = logging.getLogger(__name__)

UNSEEN: Split = "test_unseen"
"""Split whose scenes get controls."""
CONTROLS = ("nearest", "middle", "far", "shuffled")
"""Names of the values that replace a scene's own in rollouts of a model."""
SOLVER_NEAREST, SOLVER_ENDS = "solver at nearest value", "solver at lowest against highest value"
"""Labels of the rows that compare a run of the solver with the ground truth, and two runs of the solver with each other."""
SAME_START = 1e-3
"""Largest difference between a stored frame and the start of the solver's runs [spacings]."""
SAME_VALUE = 1e-5
"""Largest relative difference between ends of trained ranges that are the same."""
MOST_DRAWS = 100
"""Number of random permutations of the scenes' values. The permutation in which the fewest scenes keep their own values is used for ``shuffled``."""

AtValue = tuple[str, Trajectory, Trajectory]
"""A scene with some values of its parameters: caption that names the values, run of the solver, rollout of the model."""


class ControlError(GpeError):
    """Raised when the solver does not reproduce a scene, or the data set has no scenes with unseen parameters that are long enough."""


def label_of(model: str, control: str) -> str:
    """Return the label of a model's rollouts with the values that ``control``, one of ``CONTROLS``, names."""
    return f"{model} at {control} value"


@dataclass(frozen=True)
class MaterialControls:
    """Computes the controls of one evaluation.

    Attributes:
        root: folder of the evaluated data set.
        spec: the evaluated data set.
        trained: the data set of the training, whose values are the trained ones.
        start_frame: frame of the model at which rollouts start.
        num_trajectories: number of trajectories, from the start of the split; None takes all.
        stride: number of stored frames in a frame of the model.
    """

    root: Path
    spec: DatasetSpec
    trained: DatasetSpec
    start_frame: int
    num_trajectories: int | None = None
    stride: int = 1

    def prepare(self, num_workers: int = 1, on_progress: Progress | None = None) -> None:
        """Compute the missing solver runs. Warn of scenes without shuffled values.

        Raises:
            ControlError: the data set has no scenes with unseen parameters, or they are too short, or its train split has a single value.
            GenerationError: the solver stopped.
        """
        if not self._indices or self.spec.num_frames <= (self.start_frame + 1) * self.stride:
            raise ControlError(
                f"evaluation.material_controls=true: {self.spec.name} has {self.spec.num_test_unseen} trajectories of {self.spec.num_frames} frames in "
                f"{UNSEEN}, rollouts start at frame {self.start_frame * self.stride}; choose data with more, or false"
            )
        if TrainedValues(self.trained).is_single:
            raise ControlError(
                f"evaluation.material_controls=true: all trajectories ({self.trained.num_train}) in the train split of {self.trained.name} have the same "
                "material parameters, so there is nothing to compare; choose a larger data.num_train, or false"
            )
        if missing := sum("shuffled" not in scene for scene in self.values):
            log.warning(
                "evaluation.material_controls=true: %d of %d scenes in %s of %s are not rolled out at shuffled values, because no scene of their group has "
                "other values",
                *(missing, len(self.values), UNSEEN, self.spec.name),
            )
        self._runs.generate(self._indices, num_workers, on_progress)

    def check_trained(self, simulator: LearnedSimulator) -> None:
        """Raise ``ControlError`` if the trained values of these controls have another range than those with which a model was trained."""
        for known, own, line in self._ranges(simulator):
            if not np.allclose(own, known, rtol=SAME_VALUE):
                raise ControlError(f"evaluation.material_controls=true: {line}; choose the data settings of its training, or false")

    def warn_of_start(self, start: LearnedSimulator) -> None:
        """Warn if the model from which a training starts knows values outside the trained values of these controls, which are then not all trained ones."""
        for known, own, line in self._ranges(start):
            margin = SAME_VALUE * np.abs(own)
            if np.isfinite(known).all() and (known[0] < own[0] - margin[0] or known[1] > own[1] + margin[1]):
                log.warning("evaluation.material_controls=true: %s; so unseen values can be known from its first training", line)

    def _ranges(self, simulator: LearnedSimulator) -> Iterator[tuple[np.ndarray, np.ndarray, str]]:
        """Yield the lowest and highest value [2] of each parameter in the training of a model and in the train split, and a message that names them."""
        trained = TrainedValues(self.trained)
        ends = [trained.end(name) for name in (LOWEST, HIGHEST)]
        for material, values in simulator.trained_ranges():
            for k, parameter in enumerate(simulator.builder.spec.parameters[material]):
                if parameter.name in ends[0].get(material, {}):
                    known, own = values[:, k].cpu().numpy(), np.array([end[material][parameter.name] for end in ends])
                    yield (
                        known,
                        own,
                        f"the model was trained with {parameter.name} of {material} from {known[0]:g} to {known[1]:g}, and the train split of these data "
                        f"has {own[0]:g} to {own[1]:g}",
                    )

    def predictions(self, simulator: Simulator, starts: Sequence[Start], numbers: Sequence[int]) -> list[dict[str, Trajectory]]:
        """Return the model's rollouts of each scene, by name in ``CONTROLS``. Scenes without shuffled values lack that rollout.

        Args:
            simulator: the model, wrapped as for its other rollouts, for example with containment.
            starts: starts of scenes with their own values.
            numbers: numbers of the scenes in the split.
        """
        found: list[dict[str, Trajectory]] = [{} for _ in starts]
        for control in CONTROLS:
            chosen = [k for k, number in enumerate(numbers) if control in self.values[number]]
            changed = [_changed(starts[k], self.values[numbers[k]][control]) for k in chosen]
            for k, prediction in zip(chosen, rollouts(simulator, changed), strict=True):
                found[k][control] = prediction
        return found

    def at_three_values(self, simulator: Simulator, start: Start, number: int, truth: Trajectory, prediction: Trajectory) -> list[AtValue]:
        """Return a scene at the lowest trained values, its own unseen ones and the highest trained ones, in ascending order of the values.

        Args:
            simulator: the model, wrapped as for its other rollouts, for example with containment.
            start: start of the scene with its own values.
            number: number of the scene.
            truth: its ground truth from ``start_frame`` on.
            prediction: the model's rollout with the scene's own values.
        """
        runs, trained = self._solved(number), TrainedValues(self.trained)
        ends = {name: trained.end(name) for name in (LOWEST, HIGHEST)}
        predicted = rollouts(simulator, [_changed(start, values) for values in ends.values()])
        own: Values = scene_values(self.spec, UNSEEN, number)
        scenes = [(own, f"{row_label(own)} (unseen)", truth, prediction)]
        scenes += [(values, row_label(values), runs[name], rolled) for (name, values), rolled in zip(ends.items(), predicted, strict=True)]
        scenes.sort(key=lambda scene: [[*parameters.values()] for parameters in scene[0].values()])
        return [(caption, solved, rolled) for _, caption, solved, rolled in scenes]

    def solver_runs(self, number: int, truth: Trajectory) -> dict[str, tuple[Trajectory, Trajectory]]:
        """Return the solver's runs of a scene and what each is compared with, by label.

        Args:
            number: number of the scene.
            truth: its ground truth from ``start_frame`` on.

        Raises:
            ControlError: the runs do not start like the ground truth.
        """
        runs = self._solved(number)
        start, spacing = runs[NEAREST], truth.metadata.spacing
        is_same = start.metadata.seed == truth.metadata.seed and start.pos.shape == truth.pos.shape
        if not is_same or np.abs(displacement(start.pos[0], truth.pos[0], truth.metadata)).max() > SAME_START * spacing:
            raise ControlError(
                f"{self.root}: the solver does not reproduce trajectory {number} of {UNSEEN}; generate the data again, or choose "
                "evaluation.material_controls=false"
            )
        return {SOLVER_NEAREST: (start, truth), SOLVER_ENDS: (runs[LOWEST], runs[HIGHEST])}

    @cached_property
    def values(self) -> list[dict[str, Values]]:
        """Parameter values of each scene, by name in ``CONTROLS``. Scenes of a group in which all have the same values have no ``shuffled`` ones."""
        trained, own = TrainedValues(self.trained), [scene_values(self.spec, UNSEEN, k) for k in self._indices]
        found: list[dict[str, Values]] = [
            {"nearest": trained.nearest(v), "middle": trained.middle, "far": trained.farthest(v)} for v in own
        ]
        for k, other in self._shuffled().items():
            found[k]["shuffled"] = own[other]
        return found

    def _shuffled(self) -> dict[int, int]:
        """Return the number of the scene from which each scene takes its shuffled values. Both have the same group of parameters, and different values.

        Scenes for which there is no such scene are left out.
        """
        dealt = [parameter_values(self.spec, UNSEEN, k) for k in self._indices]
        other, rng = dict[int, int](), np.random.default_rng(0)
        for group in dict.fromkeys(group for _, group in dealt):
            own = np.array([k for k, (_, of) in enumerate(dealt) if of == group])
            drawn = [rng.permutation(own) for _ in range(MOST_DRAWS)]
            order = min(drawn, key=lambda order: sum(dealt[a][0] == dealt[b][0] for a, b in zip(own, order, strict=True)))
            for a, b in zip(own, order, strict=True):
                different = [
                    int(k) for k in (b, *own) if dealt[k][0] != dealt[a][0]
                ]  # where the permutation keeps a value, the first other scene
                if different:
                    other[int(a)] = different[0]
        return other

    def _solved(self, number: int) -> dict[str, Trajectory]:
        """Return the solver's runs of a scene by name, with frames as long as the model's."""
        return {name: run.every(self.stride) for name, run in self._runs.read(number).items()}

    @property
    def _indices(self) -> range:
        count = self.spec.num_test_unseen
        return range(count if self.num_trajectories is None else min(count, self.num_trajectories))

    @cached_property
    def _runs(self) -> ControlRuns:
        return ControlRuns(self.root, self.spec, TrainedValues(self.trained), UNSEEN, self.start_frame * self.stride)


def _changed(start: Start, values: Values) -> Start:
    return replace(start, state=with_values(start.state, start.metadata.param_names, values))
