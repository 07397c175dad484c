"""Training samples and their graphs with targets: graphs of single states, starts of push-forward, and unrolls with gradients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.data.solver_targets import SolverTargets
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.topology import Topology
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.openings import carried
from gpe_pl.trajectory.state import State


@dataclass(frozen=True)
class UnrollStart:
    """The start of an unroll with the ground truth that follows.

    Attributes:
        state: initial state with noise, as float64 tensors.
        truth: true positions in m, from the frame of ``state`` on [num_steps + 2, node, dim].
        stress: true Cauchy stress in Pa, from the frame after ``state`` on [num_steps + 1, node, component]; None if the trajectory has none, or if
            ``WindowDataset`` leaves it out.
        position_correction: fraction of the deviation from the true position that the target removes within one step; see ``Noise``.
        velocity_correction: fraction of the deviation from the true velocity that the target removes within one step, after the unroll; as in ``StartKey``.
        about: attributes of the graphs: numbers of trajectory and frame, and the weight in the loss if there is one.
        sample, lane: as in ``StartKey``.
        solver_targets: computes targets with the solver instead of with the two corrections; None without a solver.
        alive: nodes of ``truth`` that are in the scene in each frame [num_steps + 2, node], if the data set has open scenes. The identity of a node is then
            its column in ``truth``, and its positions before and after are those of ``open_windows.continued``.
        scale: rest spacing [m] and frame interval [s] of the scene, if the data have several; the scenes of a batch share them.
    """

    state: State
    truth: Tensor
    stress: Tensor | None
    position_correction: float
    velocity_correction: float
    about: dict[str, Any]
    sample: int
    lane: int
    solver_targets: SolverTargets | None = None
    alive: Tensor | None = None
    scale: tuple[float, float] | None = None

    @property
    def num_steps(self) -> int:
        """Number of steps of the unroll."""
        return self.truth.shape[0] - 2

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields with arrays instead of tensors, for another process. Each tensor would need shared memory of its own, which takes longer."""
        boundary = replace(self.state.boundary, **_arrays(self.state.boundary))
        return vars(self) | _arrays(self) | {"state": replace(self.state, **_arrays(self.state), boundary=boundary)}

    def __setstate__(self, values: dict[str, Any]) -> None:
        tensors = {name: torch.from_numpy(value) for name, value in values.items() if isinstance(value, np.ndarray)}
        vars(self).update(values | tensors | {"state": values["state"].to_torch()})

    def target(self, state: State, step: int, dt: float) -> tuple[Tensor, Tensor | None]:
        """Return the target of the state that the model has reached after ``step`` steps: acceleration [m/s²] without gravity, and stress [Pa] if there is one.

        The target is the acceleration that leads to a target velocity v*. With v̂ the next true velocity, Δv and Δx the deviations of velocity and position from
        the truth, and c_v and c_x the two corrections, v* = v̂ + (1 − c_v) Δv − c_x Δx / Δt. At step 0, Δv is noise and c_v is 1. With ``solver_targets``, the
        target is that of ``SolverTargets.target`` instead, unless the solver refuses the state.

        Args:
            state: state of float64 tensors.
            step: number of steps from the start.
            dt: frame interval [s].
        """
        if self.solver_targets is not None and (found := self.solver_targets.target(state, step)) is not None:
            acceleration, stress = found
            return acceleration, None if self.stress is None else stress
        where, truth = state.periodicity, self.truth[max(0, step - 1) : step + 2]
        if state.node_id is not None:
            truth = truth[:, self._columns(state)]
        vel = integrators.velocities(truth[-2:], dt, where)[0]
        if step:  # the velocity noise of the start is removed entirely
            before = integrators.velocities(truth[:2], dt, where)[0]
            vel = vel + (1 - self.velocity_correction) * (state.vel - before)
        deviation = integrators.velocities(torch.stack([truth[-2], state.pos]), dt, where)[0]
        acceleration = integrators.acceleration(vel - self.position_correction * deviation, state.vel, dt) - state.gravity
        return acceleration, None if self.stress is None else self.stress[step]

    def without_target(self, state: State, step: int) -> Tensor | None:
        """Return a mask [node] of the nodes from which nothing is learned after ``step`` steps; None in data sets without open scenes.

        These are nodes that an opening moves, and nodes that are not in the true scene now and one frame later.
        """
        if self.alive is None:
            return None
        if state.node_id is None:
            return torch.zeros(state.num_nodes, dtype=torch.bool)
        columns = self._columns(state)
        stays = self.alive[step, columns] & self.alive[step + 1, columns] & (columns == state.node_id)
        return ~stays | torch.from_numpy(carried(state.openings, state.pos.numpy()))

    def _columns(self, state: State) -> Tensor:
        """Return the column of ``truth`` for each node of an open scene; the last one for nodes that the truth lacks."""
        columns: Tensor = state.node_id.clamp(max=self.truth.shape[1] - 1)  # type: ignore[union-attr]
        return columns

    def graph(self, builder: GraphBuilder, state: State, step: int) -> HeteroData:
        """Create the training graph of the state that the model has reached after ``step`` steps."""
        target, stress = self.target(state, step, builder.metadata.frame_dt)
        return training_graph(builder, state, target, stress, self.about, self.without_target(state, step))


def _arrays(part: Any) -> dict[str, Any]:
    """Return the fields of a data class that are tensors, as arrays."""
    return {name: value.numpy() for name, value in vars(part).items() if isinstance(value, Tensor)}


@dataclass(frozen=True)
class Unroll:
    """The start of an unroll with gradients, and the positions that it should reach.

    Attributes:
        graph: training graph of the initial state.
        state: initial state with noise, as float64 tensors.
        reference: positions [num_steps, node, dim] in m that the state should have after each step: the true ones, plus the part of the noise on the last
            position that the targets have not removed (see ``Noise.correction``).
        stress: true Cauchy stress [num_steps, node, component] in Pa after each step; None as in ``UnrollStart``.
        about: attributes of the graphs, as in ``UnrollStart``.
    """

    graph: HeteroData
    state: State
    reference: Tensor
    stress: Tensor | None
    about: dict[str, Any]

    @property
    def num_steps(self) -> int:
        """Number of steps of the unroll."""
        return self.reference.shape[0]

    def to(self, device: Any) -> Unroll:
        """Return the same unroll on another device."""
        stress = None if self.stress is None else self.stress.to(device)
        return Unroll(self.graph.to(device), self.state.to_torch(device), self.reference.to(device), stress, self.about)

    def graph_after(self, builder: GraphBuilder, state: State, step: int) -> HeteroData:
        """Create the training graph of the state after ``step`` steps.

        The target is the acceleration that leads to the next reference position. Gradients of the loss pass through the target to the state, too.

        Raises:
            SimulationError: as ``GraphBuilder.topology``.
        """
        dt = builder.metadata.frame_dt
        vel = integrators.velocities(torch.stack([state.pos, self.reference[step]]), dt, state.periodicity)[0]
        target = integrators.acceleration(vel, state.vel, dt) - state.gravity
        return training_graph(builder, state, target, None if self.stress is None else self.stress[step], self.about)


def training_graph(
    builder: GraphBuilder,
    state: State,
    target: Tensor,
    stress: Tensor | None,
    about: dict[str, Any],
    without_target: Tensor | None = None,
) -> HeteroData:
    """Create the graph of a state, with targets for each node in the stores of materials.

    Args:
        builder: builder of the graph.
        state: state of the scene.
        target: acceleration without gravity [node, dim] in m/s²; stored as ``target``.
        stress: Cauchy stress after the step [node, component] in Pa; stored as ``stress_target``. None stores none.
        about: further attributes of the graph.
        without_target: nodes from which nothing is learned [node]; stored as ``without_target``. None stores none.
    """
    data = builder(state)
    rows = [{m: data[m].node_id for m in builder.spec.materials}]
    _add_targets(data, builder, rows, [target], None if stress is None else [stress])
    if without_target is not None:
        _add_masks(data, builder, rows, [without_target])
    for name, value in about.items():
        data[name] = value
    return data


def training_batch(
    builder: GraphBuilder, topologies: Sequence[Topology], states: Sequence[State], starts: Sequence[UnrollStart], steps: Sequence[int]
) -> HeteroData:
    """Return the batch of the training graphs of several states, equal to ``batched`` of those of ``UnrollStart.graph``.

    Args:
        builder: builder of the graphs.
        topologies: topologies of the states.
        states: states that the model has reached.
        starts: starts of their unrolls.
        steps: number of steps from these starts.
    """
    data, dt = builder.batch(topologies, states), builder.metadata.frame_dt
    targets = [start.target(state, step, dt) for start, state, step in zip(starts, states, steps, strict=True)]
    stresses = [stress for _, stress in targets if stress is not None]
    rows = [t.rows for t in topologies]
    _add_targets(data, builder, rows, [target for target, _ in targets], stresses or None)
    masks = [start.without_target(state, step) for start, state, step in zip(starts, states, steps, strict=True)]
    if known := [mask for mask in masks if mask is not None]:
        _add_masks(data, builder, rows, known)
    for name in starts[0].about:
        data[name] = torch.tensor([start.about[name] for start in starts])
    return data


def _add_targets(
    data: HeteroData, builder: GraphBuilder, rows: Sequence[dict[str, Tensor]], targets: Sequence[Tensor], stresses: Sequence[Tensor] | None
) -> None:
    """Add targets and stresses of the nodes of several states to their graph; ``rows`` has the nodes of each material in each state."""
    for name, values, materials in (("target", targets, builder.spec.materials), ("stress_target", stresses, builder.spec.stress_channels)):
        for material in materials if values is not None else ():
            parts = [value.to(builder.precision)[own[material]] for value, own in zip(values or (), rows, strict=True)]
            data[material][name] = parts[0] if len(parts) == 1 else torch.cat(parts)


def _add_masks(data: HeteroData, builder: GraphBuilder, rows: Sequence[dict[str, Tensor]], masks: Sequence[Tensor]) -> None:
    """Add masks of nodes without target to the graph of several states; arguments as in ``_add_targets``."""
    for material in builder.spec.materials:
        data[material].without_target = torch.cat([mask[own[material]] for mask, own in zip(masks, rows, strict=True)])
