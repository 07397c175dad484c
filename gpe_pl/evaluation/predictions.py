"""Rolls out the scenes of a split: with the learned simulator, with controls, and with the trivial baselines."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count, islice, takewhile
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.data.dataset import long_enough, open_split
from gpe_pl.evaluation.material_controls import UNSEEN, AtValue, MaterialControls, label_of
from gpe_pl.evaluation.metric_rows import EXACT
from gpe_pl.evaluation.rollout_cost import Timed
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.geometry.shapes import surface_tolerance
from gpe_pl.learned.approximate import approximate
from gpe_pl.learned.ensemble import LearnedEnsemble, combined, members_of
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.unlike import Watch
from gpe_pl.metrics import per_frame_mse
from gpe_pl.rollout.baselines import BASELINES
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.ensemble import spread
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import Simulator, Start, fraction_outside, rollout, rollouts
from gpe_pl.schema import RADIUS, Split
from gpe_pl.system.progress import Bars, Progress, no_bar
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory

MAX_SPEED_FACTOR = 20.0
"""A learned rollout has exploded if a particle's speed exceeds this factor times a reference speed. The reference is the speed of the fastest particle of the
ground truth, or the speed that crosses the domain within the trajectory if that is larger."""
SCENES_AT_ONCE = 16
"""Number of scenes, or windows, in one pass of the model."""


@dataclass(frozen=True)
class PredictedScene:
    """A scene of a split after its rollouts.

    Attributes:
        number: number of the scene in its split. Scenes that are too short for a model have numbers, too.
        trajectory: the stored scene, with the frames before the start.
        truth: the ground truth from the start on.
        predictions: rollouts by model.
        counts: metrics of the learned rollout that need more than its positions, by name (see ``rollouts.evaluate``).
        solver_runs: runs of the solver with other parameters, by label, each with the trajectory that it is compared with.
        at_values: the scene at three values of its parameters, if a picture shows them; else empty.
        spread: spread of the ensemble's members in each frame of the learned rollout [frame, node] in m; None for a single model.
        features: ranges of the quantities that tell whether a scene is unlike others (see ``learned.unlike``).
    """

    number: int
    trajectory: Trajectory
    truth: Trajectory
    predictions: dict[str, Trajectory]
    counts: dict[str, float]
    solver_runs: dict[str, tuple[Trajectory, Trajectory]]
    at_values: list[AtValue]
    spread: np.ndarray | None
    features: dict[str, tuple[float, float]]


@dataclass
class Predictor:
    """Rolls out the scenes of a split.

    Attributes:
        simulator: trained simulator, or several as an ensemble.
        settings: what to evaluate.
        label: name of the model.
        controls: prepared controls of scenes with unseen parameters.
        stride: number of stored frames in a frame of the simulator.
        start_frame: frame at which rollouts start.
        seconds: computing time per scene of each step so far [s].
        bars: makes the progress bar of a split, which counts frames of the simulator's own rollouts.
    """

    simulator: LearnedSimulator | LearnedEnsemble
    settings: EvaluationSettings
    label: str
    controls: MaterialControls | None
    stride: int
    start_frame: int
    seconds: list[float]
    bars: Bars = field(default_factory=lambda: no_bar)

    def scenes(self, root: Path, split: Split) -> Iterator[PredictedScene]:
        """Yield the first ``settings.num_trajectories`` scenes of a split, in its order, without those that are too short."""
        wanted = self.settings.num_trajectories
        scenes = takewhile(lambda scene: wanted is None or scene[0] < wanted, long_enough(root, split, self.start_frame, self.stride))
        controls = self.controls if split == UNSEEN else None
        done = 0
        with self.bars(f"evaluating {split}") as on_progress:
            stored = [-(-t.num_stored // self.stride) for t in open_split(root, split, cache_bytes=0)]
            total = self._num_frames(stored[: self.settings.num_trajectories])
            on_progress(done, total)
            while batch := list(islice(scenes, SCENES_AT_ONCE)):
                numbers, trajectories = [number for number, _ in batch], [trajectory for _, trajectory in batch]
                yield from self._batch(trajectories, numbers, controls, _each(on_progress, done, total))
                done += self._num_frames([t.num_frames for t in trajectories])
                on_progress(done, total)  # rollouts that stopped early lack frames

    def _num_frames(self, lengths: Sequence[int]) -> int:
        """Return the number of predicted frames of trajectories with these numbers of frames."""
        return sum(max(0, length - 1 - self.start_frame) for length in lengths)

    def _batch(
        self, trajectories: list[Trajectory], numbers: list[int], controls: MaterialControls | None, on_frame: Callable[[], Any]
    ) -> Iterator[PredictedScene]:
        """Roll several scenes out at once. ``numbers`` are theirs in the split; ``on_frame`` is called for each predicted frame."""
        members, dt = members_of(self.simulator), trajectories[0].metadata.frame_dt
        truths = [trajectory.frames(self.start_frame) for trajectory in trajectories]
        starts = [start_of(self.simulator, self.start_frame, *pair) for pair in zip(trajectories, truths, strict=True)]
        totals = [{"num_corrected": 0.0, "num_asleep": 0.0, "lost_impulse": 0.0} for _ in starts]
        spreads = [[np.zeros(truth.num_nodes)] for truth in truths]
        watches = [Watch(members[0], start.num_steps) for start in starts]
        for watch, own in zip(watches, starts, strict=True):
            watch.see(0, own.state)

        def see(scene: int, frame: int, state: State) -> None:
            watches[scene].see(frame, state)
            on_frame()
            for name in totals[scene]:
                totals[scene][name] += getattr(state, name)
            if len(members) > 1:
                spreads[scene].append(np.asarray(spread(state)))

        def within_walls(inner: Simulator) -> Simulator:
            return Contained(inner, dt) if self.settings.containment else inner

        runner = combined(members, lambda member: within_walls(approximate(member)))
        predicted = rollouts(Timed(runner, self.seconds, members[0].acceleration_std.is_cuda), starts, see)
        free = self._uncontained(combined(members, approximate), starts, numbers) if self.settings.containment else predicted
        is_exact = all(approximate(member) is member for member in members)
        exact = None if is_exact else rollouts(combined(members, within_walls), starts)
        others = None if controls is None else controls.predictions(runner, starts, numbers)
        for scene, (trajectory, truth) in enumerate(zip(trajectories, truths, strict=True)):
            prediction, number = predicted[scene], numbers[scene]
            predictions = {self.label: prediction} if exact is None else {self.label: prediction, EXACT: exact[scene]}
            for name, baseline in BASELINES.items():
                start = trajectory.state(self.start_frame, self.start_frame)
                predictions[name] = rollout(baseline(truth.metadata.frame_dt), start, truth.num_frames - 1, truth.metadata)
            if others is not None:
                predictions |= {label_of(self.label, control): other for control, other in others[scene].items()}
            counts = self._counts(trajectory, truth, prediction, free[scene] if scene < len(free) else None, totals[scene])
            if exact is not None:
                counts |= _cost_of_skipping(prediction, exact[scene], totals[scene])
            at_values: list[AtValue] = []
            if controls is not None and number < self.settings.num_pictures:
                at_values = controls.at_three_values(runner, starts[scene], number, truth, prediction)
            solver_runs = {} if controls is None else controls.solver_runs(number, truth)
            spread_of = np.stack(spreads[scene]) if len(members) > 1 else None
            yield PredictedScene(number, trajectory, truth, predictions, counts, solver_runs, at_values, spread_of, watches[scene].found)

    def _uncontained(self, runner: Simulator, starts: list[Start], numbers: list[int]) -> list[Trajectory]:
        """Roll out those of the scenes without containment that ``settings.num_uncontained`` includes. Their numbers ascend."""
        wanted = self.settings.num_uncontained
        return rollouts(runner, [start for start, number in zip(starts, numbers, strict=True) if wanted is None or number < wanted])

    def _counts(
        self, trajectory: Trajectory, truth: Trajectory, prediction: Trajectory, free: Trajectory | None, totals: dict[str, float]
    ) -> dict[str, float]:
        """Return counts of a learned rollout. ``free`` is the rollout without containment, if there is one."""
        counts = {
            "num_good_frames": float(prediction.num_frames - 1),
            "edges_per_node": _edges_per_node(members_of(self.simulator)[0], trajectory),
        }
        if truth.boundary.shapes:  # a boundary of nodes alone has no inside
            steps = truth.num_frames - 1
            counts["fraction_outside_at_end"] = _fraction_outside(
                prediction, steps, steps, tolerance=surface_tolerance(truth.boundary.shapes)
            )
            counts["fraction_corrected"] = totals["num_corrected"] / _particle_steps(prediction)
            if free is not None:
                counts["fraction_outside_uncontained"] = _fraction_outside(free, 1, steps, tolerance=1e-3 * truth.metadata.spacing)
        return counts


def _each(on_progress: Progress, done: int, total: int) -> Callable[[], Any]:
    """Return a function that counts one more than ``done`` with each call."""
    numbers = count(done + 1)
    return lambda: on_progress(next(numbers), total)


def start_of(simulator: LearnedSimulator | LearnedEnsemble, start_frame: int, trajectory: Trajectory, truth: Trajectory) -> Start:
    """Return the start of a rollout, with a guard whose limits are far beyond the ground truth.

    Args:
        simulator: simulator that is rolled out.
        start_frame: frame of ``trajectory`` at which the rollout starts.
        trajectory: the stored scene.
        truth: its ground truth from ``start_frame`` on.
    """
    bounds = truth.metadata.bounds
    size = max(high - low for low, high in bounds)
    across = size / (trajectory.num_frames * truth.metadata.frame_dt)  # the reference where everything rests
    speed = float(np.linalg.norm(trajectory.vel, axis=-1).max(initial=0.0))
    guard = Guard(max_speed=MAX_SPEED_FACTOR * max(speed, across), bounds=bounds, margin=size, spacing=truth.metadata.spacing)
    if start_frame < members_of(simulator)[0].builder.config.history:
        initial = simulator.standing(trajectory.state(start_frame), trajectory.metadata)
    else:
        initial = simulator.initial_state(trajectory, start_frame)
    return Start(initial, truth.num_frames - 1, truth.metadata, guard)


def _cost_of_skipping(prediction: Trajectory, exact: Trajectory, totals: dict[str, float]) -> dict[str, float]:
    """Return what approximate levels change in a rollout, and how much they skip."""
    both = min(prediction.num_frames, exact.num_frames)
    error = per_frame_mse(prediction.frames(0, both), exact.frames(0, both))[1:]
    return {
        "skipping_mse": float(error.mean()) if len(error) else math.inf,
        "fraction_asleep": totals["num_asleep"] / _particle_steps(prediction),
        "lost_impulse": totals["lost_impulse"],
    }


def _particle_steps(prediction: Trajectory) -> int:
    if prediction.alive is not None:
        return max(1, int(prediction.alive[1:].sum()))
    return prediction.num_nodes * max(1, prediction.num_frames - 1)


def _edges_per_node(simulator: LearnedSimulator, trajectory: Trajectory) -> float:
    """Return the number of edges within the radius over that of dynamic nodes, in the graph of the middle frame of a trajectory."""
    history = simulator.builder.config.history
    state = trajectory.state(max(history, trajectory.num_frames // 2), history)
    graph = simulator.builder(state.to_torch())
    edges = (graph[relation].edge_index.shape[1] for relation in simulator.builder.spec.relations if relation[1] == RADIUS)
    return sum(edges) / state.num_nodes


def _fraction_outside(prediction: Trajectory, first: int, last: int, tolerance: float) -> float:
    """Return the fraction of particle-frames that are inside a wall or obstacle in frames ``first … last``.

    All particles of the frames that a stopped rollout lacks count as inside.

    Args:
        prediction: rollout; frame 0 is its start.
        first, last: frames.
        tolerance: depth [m] up to which a particle is not counted.
    """
    if first >= prediction.num_frames:
        return 1.0
    wanted, good = last - first + 1, prediction.frames(first, last + 1)
    return (fraction_outside(good, tolerance) * good.num_frames + wanted - good.num_frames) / wanted
