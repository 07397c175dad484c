"""What is measured of a rollout on a public learning set: the published metrics, and whether liquids and rigid bodies keep their shape."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.benchmarks.learning_sets.sets import FULL, ONE_STEP, POSITION, RIGIDITY, SPACING, STOPPED, STRESS, VELOCITY, LearningSet
from gpe_pl.evaluation.predictions import Predictor
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics.liquids import liquid_nodes
from gpe_pl.rollout.baselines import BASELINES
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.loop import Simulator, sound, step_all
from gpe_pl.trajectory.arrays import nearest_distances
from gpe_pl.trajectory.rigid_deformation import rigid_deformation
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory

MODEL = "model"
STEPS_AT_ONCE = 16
Axes = tuple[int, int]

POOLED_BY: dict[str, Callable[[np.ndarray, Axes], Any]] = {
    FULL: lambda table, axis: np.sqrt(np.square(table).mean(axis=axis)),
    ONE_STEP: lambda table, axis: np.sqrt(np.square(table).mean(axis=axis)),
    RIGIDITY: lambda table, axis: table.max(axis=axis),
}
"""How values [..., seed, trajectory] become one; all others by their mean."""


def pooled(quantity: str, table: np.ndarray, axis: Axes = (-2, -1)) -> Any:
    """Return one value for the values [..., seed, trajectory] of a quantity."""
    return POOLED_BY.get(quantity, lambda own, axis: own.mean(axis=axis))(table, axis)


def measured(checkpoint: Path, root: Path, learning_set: LearningSet, mirror_average: bool) -> dict[str, dict[str, list[float]]]:
    """Return the quantities of each trajectory of the test split by simulator and name: of a trained model, and of the trivial baselines.

    Args:
        checkpoint: the trained model.
        root: folder of the imported data set.
        learning_set: start and metrics.
        mirror_average: whether the model averages each step over the scene and its mirror images (``learned.mirror_average``).
    """
    simulator, found = LearnedSimulator.from_checkpoint(checkpoint), dict[str, dict[str, list[float]]]()
    simulator.mirror_average = mirror_average
    settings = EvaluationSettings(splits=["test"], num_uncontained=0, num_pictures=0)
    for scene in Predictor(simulator, settings, MODEL, None, 1, learning_set.start, seconds=[]).scenes(root, "test"):
        for name, prediction in scene.predictions.items():
            values = dict(errors(lasting(prediction, scene.truth.num_frames), scene.truth, learning_set.is_relative))
            if not learning_set.is_relative:
                values[ONE_STEP] = one_step_error(simulator, name, scene.trajectory, learning_set.start)
            values[STOPPED] = float(prediction.num_frames < scene.truth.num_frames)
            for quantity, value in values.items():
                found.setdefault(name, {}).setdefault(quantity, []).append(value)
    return found


def lasting(prediction: Trajectory, num_frames: int) -> tuple[Trajectory, np.ndarray]:
    """Return a rollout and its positions [frame, node, dim] in m. Where it stopped early, nodes stay at the positions of its last frame."""
    missing = num_frames - prediction.num_frames
    return prediction, np.concatenate([prediction.pos, np.repeat(prediction.pos[-1:], missing, axis=0)]).astype(np.float64)


def errors(prediction: tuple[Trajectory, np.ndarray], truth: Trajectory, is_relative: bool) -> Iterator[tuple[str, float]]:
    """Yield the quantities of a rollout that begins with the first frame of the truth."""
    rollout, pos = prediction
    if is_relative:
        dt = truth.metadata.frame_dt
        yield POSITION, relative_error(pos[1:], truth.pos[1:])
        yield VELOCITY, relative_error(central_velocities(pos, dt), truth.vel[1:])
        if rollout.stress is not None and truth.stress is not None:
            is_whole = rollout.num_frames == truth.num_frames
            yield STRESS, relative_error(rollout.stress.node[1:], truth.stress.node[1:]) if is_whole else math.inf
        return
    yield FULL, rms_distance(pos[1:], truth.pos[1:])
    fluid = liquid_nodes(truth)
    if fluid.any():
        own, true = (
            np.median(nearest_distances(frame[fluid].astype(np.float64), truth.metadata.periodicity)) for frame in (pos[-1], truth.pos[-1])
        )
        yield SPACING, float(own / true)
    if rollout.rigid_body is not None and (rollout.rigid_body >= 0).any():
        yield RIGIDITY, rigid_deformation(rollout, rollout.num_frames - 1)


def relative_error(values: np.ndarray, truth: np.ndarray) -> float:
    """Return the mean over frames of ‖values − truth‖ / ‖truth‖, with norms over nodes and components.

    Args:
        values, truth: [frame, node, component].
    """
    values, truth = values.astype(np.float64), truth.astype(np.float64)
    return float(np.sqrt(((values - truth) ** 2).sum(axis=(1, 2)) / (truth**2).sum(axis=(1, 2))).mean())


def central_velocities(pos: np.ndarray, dt: float) -> np.ndarray:
    """Return velocities [frame − 1, node, dim] of all frames but the first: central differences, and extrapolated ones in the last frame."""
    mean = np.diff(pos, axis=0) / dt
    if len(mean) == 1:
        return mean
    return np.concatenate([(mean[1:] + mean[:-1]) / 2, 1.5 * mean[-1:] - 0.5 * mean[-2:-1]])


def rms_distance(pos: np.ndarray, truth: np.ndarray) -> float:
    """Return the root mean square distance [m] over frames and nodes of positions [frame, node, dim]."""
    return float(np.sqrt(((pos.astype(np.float64) - truth.astype(np.float64)) ** 2).sum(axis=-1).mean()))


def one_step_error(simulator: LearnedSimulator, name: str, trajectory: Trajectory, start: int) -> float:
    """Return the RMS distance [m] after one step from each stored frame.

    Args:
        simulator: the trained model.
        name: ``MODEL``, or the name of a baseline.
        trajectory: the stored scene.
        start: first frame from which a step is made.
    """
    dt, history = trajectory.metadata.frame_dt, simulator.builder.config.history
    states: list[State]
    stepper: Simulator
    frames = range(max(start, history), trajectory.num_frames - 1)
    if name == MODEL:
        states, stepper = [simulator.initial_state(trajectory, frame) for frame in frames], Contained(simulator, dt)
    else:
        states, stepper = [trajectory.state(frame, 1) for frame in frames], BASELINES[name](dt)
    found = [sound(after) for k in range(0, len(states), STEPS_AT_ONCE) for after in step_all(stepper, states[k : k + STEPS_AT_ONCE])]
    return rms_distance(np.stack([np.asarray(after.pos) for after in found]), trajectory.pos[frames[0] + 1 :])


def trivial(values: Mapping[str, Mapping[str, float]], quantity: str) -> tuple[str, float] | None:
    """Return the baseline with the smallest error, and its error; None if no baseline has the quantity."""
    known = {name: own[quantity] for name, own in values.items() if name in BASELINES and quantity in own}
    best = min(known, key=lambda name: abs(known[name] - 1) if quantity == SPACING else known[name], default=None)
    return None if best is None else (best, known[best])
