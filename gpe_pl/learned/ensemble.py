"""Several trained models as one simulator."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gpe_pl.learned.checkpoint_file import CheckpointError
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.ensemble import Ensemble
from gpe_pl.rollout.loop import Simulator
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

SAME_RADIUS = 0.01
"""Relative difference up to which radii, in spacings, are the same."""


@dataclass(frozen=True)
class LearnedEnsemble(Ensemble):
    """Trained models whose mean is the prediction, for example one network trained with several seeds.

    Use it like a ``LearnedSimulator``: take a state from ``initial_state`` or ``standing``, and roll it out. ``rollout.ensemble.spread`` returns how far the
    members are from each other.

    Attributes:
        members: models with the same frame interval, spacing, materials, history, radius and ``graph.cells``, so that they share their starts.

    Raises:
        CheckpointError: there is no member, or one does not fit the first.
    """

    members: tuple[LearnedSimulator, ...]

    def __post_init__(self) -> None:
        if not self.members:
            raise CheckpointError("an ensemble needs at least one model")
        for number, other in enumerate(self.members[1:], start=1):
            if difference := _difference(self.members[0], other):
                raise CheckpointError(f"member {number} has other {difference} than member 0; members of an ensemble share them")

    @classmethod
    def from_checkpoints(cls, checkpoints: Sequence[Path | str], device: Any = "cpu") -> LearnedEnsemble:
        """Return the ensemble of several checkpoints.

        Args:
            checkpoints: paths, folders of runs, or names of shipped models, as in ``LearnedSimulator.from_checkpoint``.
            device: device of the simulators.

        Raises:
            CheckpointError: a checkpoint cannot be loaded, or does not fit the first one.
        """
        if not checkpoints:
            raise CheckpointError("an ensemble needs at least one checkpoint; name some")
        members = tuple(LearnedSimulator.from_checkpoint(path, device) for path in checkpoints)
        for path, other in zip(checkpoints[1:], members[1:], strict=True):
            if difference := _difference(members[0], other):
                raise CheckpointError(f"{path}: has other {difference} than {checkpoints[0]}; members of an ensemble share them")
        return cls(members)

    def on(self, scene: Metadata) -> LearnedEnsemble:
        """Do the same as ``LearnedSimulator.on`` for all members."""
        return LearnedEnsemble(tuple(member.on(scene) for member in self.members))

    def initial_state(self, trajectory: Trajectory, frame: int) -> State:
        """Do the same as ``LearnedSimulator.initial_state``. Every member warns of what is outside its own training."""
        first, *_ = [member.initial_state(trajectory, frame) for member in self.members]
        return first

    def standing(self, state: State, scene: Metadata) -> State:
        """Do the same as ``LearnedSimulator.standing``. Every member warns of what is outside its own training."""
        first, *_ = [member.standing(state, scene) for member in self.members]
        return first


def _difference(one: LearnedSimulator, other: LearnedSimulator) -> str | None:
    """Describe in what two models differ that members of an ensemble share; None if they fit each other."""
    own, there = one.builder, other.builder
    if not (one.fits(there.metadata) and other.fits(own.metadata) and own.config.history == there.config.history):
        return "materials, frames, spacing or history"
    if own.config.cells != there.config.cells:
        return "velocities at the start (graph.cells)"
    reach = [builder.scales.radius / builder.metadata.spacing for builder in (own, there)]
    return None if math.isclose(*reach, rel_tol=SAME_RADIUS) else "neighbours (connectivity radius)"


def members_of(simulator: LearnedSimulator | LearnedEnsemble) -> tuple[LearnedSimulator, ...]:
    """Return the models of an ensemble, or the model itself."""
    return simulator.members if isinstance(simulator, LearnedEnsemble) else (simulator,)


def combined(members: Sequence[LearnedSimulator], wrapped: Callable[[LearnedSimulator], Simulator]) -> Simulator:
    """Return models as one simulator after each was wrapped, for example with containment. A single model stays what it is."""
    parts = tuple(wrapped(member) for member in members)
    return parts[0] if len(parts) == 1 else Ensemble(parts)


def configured(simulator: LearnedSimulator | LearnedEnsemble, **settings: Any) -> LearnedSimulator | LearnedEnsemble:
    """Return a copy with other settings of ``LearnedSimulator.configured``, for all members of an ensemble."""
    if isinstance(simulator, LearnedEnsemble):
        return LearnedEnsemble(tuple(member.configured(**settings) for member in simulator.members))
    return simulator.configured(**settings)
