"""Push-forward: trains a simulator on states that its own unrolls reach.

A training step uses the prediction of the model twice: for the loss, and to advance the unrolled states by one step. Unrolls therefore need no additional pass
of the model. The advanced states are kept until the next training step of their lane. States are on the CPU, also if the model is on another device: the search
for neighbours runs there, and a batch of graphs reaches the device in a few copies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.data.training_samples import UnrollStart, training_batch
from gpe_pl.graphs.topology import Topology
from gpe_pl.learned.differentiable import Differentiable
from gpe_pl.learned.least_distance import kept_apart
from gpe_pl.learned.next_states import Rows
from gpe_pl.learned.simulator import CheckpointError, LearnedSimulator
from gpe_pl.models.base import Prediction
from gpe_pl.rollout.flow import through_openings
from gpe_pl.rollout.loop import step_scenes
from gpe_pl.system import ranks
from gpe_pl.trajectory.state import State, Stress

MOVED = ("pos", "vel", "velocity_history", "frame_velocity", "time")
"""Fields of a state that a step changes. A moving boundary changes, too, but follows from the number of steps."""
OPEN = ("node_type", "mass", "material_params", "node_id", "next_id")
"""Further fields that change in open scenes, where nodes enter and leave."""


@dataclass
class Excursion:
    """The unrolls of one batch of scenes, at the step that they have reached.

    Attributes:
        samples: number of each scene's sample in the data set.
        states: state that each unroll has reached.
        steps: number of steps that each unroll has made.
        rows: rows of the nodes of each material in ``states``; empty between ``move_on`` and the next call of ``graphs``.
        scale: rest spacing and frame interval of the scenes, as in ``UnrollStart``.
    """

    samples: list[int]
    states: list[State]
    steps: list[int]
    rows: list[Rows]
    scale: tuple[float, float] | None = None


Stored = dict[int, dict[int, dict[str, Any]]]
"""Unrolls by lane and sample as a checkpoint stores them: ``steps`` and the fields in ``MOVED`` (see ``Excursions.state_dict``)."""


class Excursions:
    """All batches that a simulator is unrolling, one per lane (see ``PushForward``).

    After ``clear``, the unrolls are computed again from their starts with the current weights.
    """

    def __init__(self) -> None:
        self._lanes: dict[int, Excursion] = {}
        self._loaded: Stored = {}

    def clear(self) -> None:
        self._lanes.clear()
        self._loaded.clear()

    def state_dict(self) -> Stored:
        """Return the unrolls of all ranks: the number of steps and the fields ``MOVED`` of each scene. All ranks have to call it."""
        own: Stored = {lane: dict(scenes) for lane, scenes in self._loaded.items()}  # loaded from a checkpoint and not used since
        for lane, way in self._lanes.items():
            scenes = zip(way.samples, way.states, way.steps, strict=True)
            own[lane] = {
                sample: {"steps": steps, **{name: getattr(state, name) for name in _moving(state)}, **_stored_stress(state)}
                for sample, state, steps in scenes
            }
        together: Stored = {}
        for part in ranks.gathered(own):
            for lane, stored in part.items():
                together.setdefault(lane, {}).update(stored)
        return together

    def load_state_dict(self, stored: Stored) -> None:
        """Continue from the result of ``state_dict``. The number of ranks may differ; each rank takes the samples of its own batches."""
        self.clear()
        self._loaded = {lane: dict(scenes) for lane, scenes in stored.items()}

    def graphs(self, simulator: LearnedSimulator, starts: Sequence[UnrollStart]) -> HeteroData:
        """Return a batch of graphs of the states that the unrolls of a lane have reached, on the CPU.

        If the lane has other samples than ``starts``, these replace them. The new unrolls continue from a loaded checkpoint, or are made first. A scene whose
        unroll failed or passed the last ground-truth frame restarts.

        Args:
            simulator: makes unrolls and graphs.
            starts: starts of the scenes of one lane.
        """
        samples, lane, simulator = [start.sample for start in starts], starts[0].lane, _located(simulator, starts[0].scale)
        under_way = self._lanes.get(lane)
        if under_way is None or under_way.samples != samples:
            under_way = self._taken_up(lane, starts) or Excursion(samples, *unrolled(simulator, starts), [])
        topologies = []
        for k, start in enumerate(starts):
            step = under_way.steps[k]  # this start's stretch of given motion may reach further than the last
            if start.state.boundary.motion is not None:
                under_way.states[k] = replace(under_way.states[k], boundary=start.state.boundary.at(step))
            if start.state.loads is not None:
                under_way.states[k] = replace(under_way.states[k], loads=start.state.loads.at(step))
            is_over = under_way.steps[k] > start.num_steps
            found = None if is_over else simulator.builder.topology_or_error(under_way.states[k])
            if not isinstance(found, Topology):
                under_way.states[k], under_way.steps[k] = start.state, 0
                found = simulator.builder.topology(start.state)
            topologies.append(found)
        under_way.rows = [topology.rows for topology in topologies]
        under_way.scale = starts[0].scale
        self._lanes[lane] = under_way
        return training_batch(simulator.builder, topologies, under_way.states, starts, under_way.steps)

    def _taken_up(self, lane: int, starts: Sequence[UnrollStart]) -> Excursion | None:
        """Return a batch of these samples as a checkpoint stored it; None if the checkpoint does not have all of them."""
        stored = self._loaded.pop(lane, {})
        if not all(start.sample in stored for start in starts):
            return None
        scenes = [stored[start.sample] for start in starts]
        states = [_moved(start.state, scene) for start, scene in zip(starts, scenes, strict=True)]
        return Excursion([start.sample for start in starts], states, [scene["steps"] for scene in scenes], [])

    @torch.no_grad()
    def move_on(self, simulator: LearnedSimulator, lane: int, predicted: Prediction) -> None:
        """Advance a lane's unrolls by one step, as a rollout does: liquid nodes keep the least distance of the simulator.

        Args:
            simulator: integrates the accelerations.
            lane: lane of the graphs.
            predicted: prediction for the lane's last ``graphs``.
        """
        under_way = self._lanes[lane]
        located = _located(simulator, under_way.scale)
        later = located.later(under_way.states, under_way.rows, predicted.to(under_way.states[0].pos.device))
        if located.least_distance and located.training:  # in evaluation mode, later has done it
            later = [kept_apart(state, located.least_distance, located.frame_dt) for state in later]
        pairs = zip(under_way.states, later, strict=True)
        under_way.states = [through_openings(state, after) if after.openings else after for state, after in pairs]
        under_way.steps = [step + 1 for step in under_way.steps]
        under_way.rows = []


def _moving(state: State) -> tuple[str, ...]:
    """Return the names of the fields that a checkpoint needs of an unroll."""
    return MOVED if state.node_id is None else (*MOVED, *OPEN)


def _moved(start: State, scene: dict[str, Any]) -> State:
    """Return the state of a start with the fields that move replaced by those of a checkpoint.

    Most models, and older checkpoints, have no ``frame_velocity``.

    Raises:
        CheckpointError: a field has another shape or type.
    """
    values: dict[str, Any] = {}
    is_open = start.node_id is not None
    for name in _moving(start):
        there, here = scene.get(name) if name in ("frame_velocity", *OPEN) else scene[name], getattr(start, name)
        if isinstance(here, Tensor) and not (name == "frame_velocity" and there is None):
            if not (isinstance(there, Tensor) and there.shape[is_open:] == here.shape[is_open:] and there.dtype == here.dtype):
                raise CheckpointError(
                    f"last.ckpt: excursions.{name} does not fit the training data; delete the file to train from the start"
                )
            there = there.to(here.device)
        values[name] = there
    if start.stress is not None:
        node = scene.get("node_stress")
        if not (isinstance(node, Tensor) and node.shape == start.stress.node.shape):
            raise CheckpointError(
                "last.ckpt: excursions.node_stress does not fit the training data; delete the file to train from the start"
            )
        values["stress"] = Stress(node.to(start.stress.node), scene["cell_stress"].to(start.stress.cell))
    return replace(start, **values)


def _stored_stress(state: State) -> dict[str, Tensor]:
    """Return the stress that the next step of a model reads; nothing for other models."""
    return {} if state.stress is None else {"node_stress": state.stress.node, "cell_stress": state.stress.cell}


def _located(simulator: LearnedSimulator, scale: tuple[float, float] | None) -> LearnedSimulator:
    return simulator if scale is None else simulator.at(*scale)


@torch.no_grad()
def unrolled(simulator: LearnedSimulator, starts: Sequence[UnrollStart]) -> tuple[list[State], list[int]]:
    """Return states after unrolling each start for ``num_steps`` steps, all starts together, and the number of steps of each.

    An unroll ends earlier if no graph of its scene can be built any more.
    """
    states, steps = [start.state for start in starts], [0] * len(starts)
    num_steps = {k: start.num_steps for k, start in enumerate(starts)}
    was_training, simulator = simulator.training, _located(simulator, starts[0].scale)
    simulator.eval()
    try:
        for k, step, item in step_scenes(Differentiable(simulator), dict(enumerate(states)), num_steps):
            if isinstance(item, State):
                states[k], steps[k] = item, step
    finally:
        simulator.train(was_training)
    return states, steps
