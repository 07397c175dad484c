"""Active data: chooses the scenes to simulate next, where trained models disagree most.

An ensemble rolls out every candidate from its initial state, without the solver. The disagreement of a scene is

    s = mean over frames of √(mean over nodes of spread²) / spacing,

with the spread of ``rollout.ensemble``. Scenes are drawn without replacement with probabilities in proportion to s⁴ (``SHARPNESS``). The largest values alone
would give many scenes of one kind, because like scenes have like values; chance keeps the choice diverse.

Sources: Seung, Opper & Sompolinsky, "Query by committee", COLT 1992; Kirsch et al., "Stochastic batch acquisition", TMLR 2023, for the draw (power
acquisition).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field

from gpe_pl.data.chosen_scenes import Choice, read, write
from gpe_pl.data.generation import stored_scenes
from gpe_pl.data.ground_truth import DatasetSpec, initial_state, trajectory_metadata
from gpe_pl.errors import GpeError
from gpe_pl.learned.ensemble import LearnedEnsemble, combined
from gpe_pl.learned.pretrained import fingerprint
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.ensemble import spread
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import Start, rollouts
from gpe_pl.system.progress import Progress
from gpe_pl.trajectory.state import State

SHARPNESS = 4.0
"""Exponent of the disagreement in the probability of a scene. 0 would be a random choice, a large value takes the scenes with the largest disagreement."""

MAX_SPEED_FACTOR = 20.0
"""A rollout has exploded if a node is faster than this factor times the speed of a fall through the whole domain, or the initial speed if that is larger."""

SCENES_AT_ONCE = 16


class ChoiceError(GpeError, ValueError):
    """Raised when scenes cannot be chosen; the message says what to do."""


@dataclass(frozen=True)
class ActiveSettings:
    """Settings of a choice.

    Attributes:
        models: checkpoints, folders of runs or names of shipped models; at least two. None chooses nothing.
        num_candidates: number of training scenes among which to choose. The first scenes of the data set are candidates, without those that it has.
        horizon: length of rollouts [s]; None takes that of the data set's trajectories.
    """

    models: list[str] | None = None
    num_candidates: Annotated[int, Field(ge=2, le=100_000)] = 200
    horizon: Annotated[float, Field(gt=0)] | None = None


def num_predicted(spec: DatasetSpec, ensemble: LearnedEnsemble, horizon: float | None) -> int:
    """Return the number of frames of a rollout.

    Raises:
        SceneError: the models do not fit the scenes.
        ChoiceError: the horizon is shorter than a frame of the models.
    """
    stored = trajectory_metadata(spec, "train", 0)
    member = ensemble.members[0]
    stride = member.stride_on(stored) or 1
    member.check_scene(stored.every(stride))
    seconds = (spec.num_frames - 1) * stored.frame_dt if horizon is None else horizon
    number = math.floor(seconds / (stride * stored.frame_dt) + 1e-6)
    if number < 1:
        raise ChoiceError(f"active.horizon={seconds:g}: is shorter than a frame of the models, {stride * stored.frame_dt:g} s")
    return number


def disagreement(
    ensemble: LearnedEnsemble, spec: DatasetSpec, scenes: Sequence[int], num_frames: int, on_progress: Progress | None = None
) -> Float[np.ndarray, "scene"]:
    """Return how far the members of an ensemble are apart in training scenes [spacings].

    In a frame that a member cannot predict, the spread counts as the longest side of the domain.

    Args:
        ensemble: at least two models.
        spec: data set whose training scenes are predicted.
        scenes: indices of training scenes.
        num_frames: number of frames to predict.
        on_progress: called with the number of finished scenes and their total.

    Raises:
        SceneError: the models do not fit the scenes.
        SimulationError: the scenes have openings, which ensembles cannot predict.
        GenerationError: a scene is impossible.
    """
    found: list[float] = []
    for first in range(0, len(scenes), SCENES_AT_ONCE):
        found += _disagreement(ensemble, spec, scenes[first : first + SCENES_AT_ONCE], num_frames)
        if on_progress is not None:
            on_progress(len(found), len(scenes))
    return np.array(found)


def _disagreement(ensemble: LearnedEnsemble, spec: DatasetSpec, scenes: Sequence[int], num_frames: int) -> list[float]:
    size = max(high - low for low, high in spec.scene.bounds)
    square = np.full((len(scenes), num_frames), size**2)
    starts = [_start(ensemble, spec, scene, num_frames, size) for scene in scenes]
    own = ensemble.on(starts[0].metadata)
    runner = combined(own.members, lambda member: Contained(member, member.builder.metadata.frame_dt))

    def see(scene: int, frame: int, state: State) -> None:
        apart = spread(state)
        assert apart is not None
        square[scene, frame - 1] = min(size**2, float(np.mean(np.asarray(apart) ** 2)))

    rollouts(runner, starts, see)
    return [float(value) for value in np.sqrt(square).mean(axis=1) / spec.scene.spacing]


def _start(ensemble: LearnedEnsemble, spec: DatasetSpec, scene: int, num_frames: int, size: float) -> Start:
    metadata = trajectory_metadata(spec, "train", scene)
    metadata = metadata.every(ensemble.members[0].stride_on(metadata) or 1)
    state = initial_state(spec, "train", scene)
    fall = math.sqrt(2.0 * float(np.linalg.norm(spec.scene.gravity)) * size)
    speed = max(fall, float(np.linalg.norm(state.vel, axis=1).max(initial=0.0)))
    guard = Guard(max_speed=MAX_SPEED_FACTOR * speed, bounds=spec.scene.bounds, margin=size, spacing=spec.scene.spacing)
    return Start(ensemble.on(metadata).standing(state, metadata), num_frames, metadata, guard)


def drawn(values: Float[np.ndarray, "scene"], number: int, seed: Sequence[int]) -> Int[np.ndarray, "choice"]:
    """Draw indices without replacement, with probabilities in proportion to ``values ** SHARPNESS``. The first are those drawn first.

    The ``number`` largest of ``SHARPNESS · ln value + g`` with independent Gumbel variables g are such a draw.

    Args:
        values: disagreement of each candidate, not negative.
        number: number of indices.
        seed: seed of the draw.
    """
    gumbel = np.random.default_rng([*seed]).gumbel(size=len(values))
    keys = SHARPNESS * np.log(np.maximum(values, np.finfo(float).tiny)) + gumbel
    return np.argsort(-keys, kind="stable")[:number]


def choose(
    root: Path | str, pool: DatasetSpec, num_train: int, settings: ActiveSettings, on_progress: Progress | None = None
) -> Choice | None:
    """Choose scenes until a data set has ``num_train`` training scenes, and note the choice beside them. The scenes are not simulated.

    Args:
        root: folder of all data sets.
        pool: the data set with all candidates as its training scenes.
        num_train: wanted number of training scenes.
        settings: models, and where they choose.
        on_progress: called with the number of finished candidates and their total.

    Returns:
        The choice; None if the data set has enough scenes.

    Raises:
        CheckpointError: a model cannot be loaded, or does not fit the first one.
        SceneError: the models do not fit the scenes.
        ChoiceError: there are fewer than two different models, or too few candidates.
        GenerationError: the folder holds another data set, or a scene is impossible.
        SealError: the file of earlier choices is damaged.
    """
    folder = Path(root) / pool.name / pool.size
    stored = stored_scenes(root, pool)  # also checks that the folder holds this data set
    choices = read(folder) or ([Choice(stored, [], 0, 0, [], 0.0)] if stored else [])
    known = [scene for choice in choices for scene in choice.scenes]
    if len(known) >= num_train:
        return None
    models = settings.models or []
    if len(models) < 2:
        raise ChoiceError(
            f"active.models: {len(models)} given; models can disagree only if there are two or more, such as one training with several seeds"
        )
    ensemble, prints = LearnedEnsemble.from_checkpoints(models), [fingerprint(model) for model in models]
    if len({*prints}) < len(prints):
        raise ChoiceError(f"active.models: two of them are the same checkpoint ({', '.join(prints)}); name each once")
    candidates = np.array([scene for scene in range(pool.num_train) if scene not in {*known}])
    number = num_train - len(known)
    if number > len(candidates):
        raise ChoiceError(
            f"active.num_candidates={pool.num_train}: leaves {len(candidates)} candidates, to choose {number}; raise it, or lower data.num_train"
        )
    num_frames = num_predicted(pool, ensemble, settings.horizon)
    values = disagreement(ensemble, pool, candidates.tolist(), num_frames, on_progress)
    picks = drawn(values, number, (pool.seed, len(known)))
    rounded = [float(f"{value:.4g}") for value in values[picks]]
    choice = Choice(candidates[picks].tolist(), prints, pool.num_train, num_frames, rounded, float(f"{np.median(values):.4g}"))
    write(folder, [*choices, choice])
    return choice
