"""Stress tests of positions: coincident, isolated and crowded nodes, a node that crosses the radius, an edge that turns, and neighbour lists by brute force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gpe_pl.benchmarks.stability.subject import (
    Outcome,
    Subject,
    acceleration,
    in_flight,
    inapplicable,
    largest,
    no_boundary,
    shifted,
    stress_test,
)
from gpe_pl.errors import GpeError
from gpe_pl.graphs.neighbors import radius_pairs
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.testing.changes import permuted
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.trajectory.state import State

NUM_MOVES = 1000
NUM_CROWDED = 20_000
NUM_EDGES = 8


def has_finite_gradients(subject: Subject, state: State) -> bool:
    """Tell whether the outputs are finite, and the gradients of sums of squares: of the outputs by all weights, of the next velocities by the positions."""
    model = subject.simulator.model
    pos = state.pos.clone().requires_grad_()
    with torch.enable_grad():
        values = [*subject.simulator(subject.simulator.builder(state)).acceleration.values()]
        loss = torch.stack([v.square().sum() for v in values]).sum()
        finite = bool(torch.isfinite(loss))
        if loss.requires_grad:
            found = torch.autograd.grad(loss, [*model.parameters()], allow_unused=True)
            finite = finite and all(bool(torch.isfinite(g).all()) for g in found if g is not None)
        (after,) = subject.simulator.next_states([replace(state, pos=pos)])
        if isinstance(after, SimulationError):
            raise after
        (by_pos,) = torch.autograd.grad(after.vel.square().sum(), pos, allow_unused=True)
    return finite and (by_pos is None or bool(torch.isfinite(by_pos).all()))


@stress_test(12, "coincident particles", "4 nodes in one place: outputs and gradients are finite")
def coincident(subject: Subject) -> Outcome:
    state = subject.state()
    pos = state.pos.clone()
    pos[1:4] = pos[0]
    return Outcome(has_finite_gradients(subject, replace(state, pos=pos)), "")


@stress_test(13, "isolated, one and no particle", "no crash, ballistic: |a − g| < 1e-6 of the acceleration scale")
def isolated(subject: Subject) -> Outcome:
    simulator = subject.simulator
    state = in_flight(replace(subject.state(), boundary=no_boundary(subject.state())), subject.dt)
    far = torch.zeros_like(state.pos)
    far[0] = 32 * simulator.builder.scales.radius
    alone = permuted(replace(state, pos=state.pos + far, cells=None, rest_pos=None), torch.arange(state.num_nodes))
    one = permuted(state, torch.arange(1))
    none = permuted(state, torch.arange(0))
    values = [float(acceleration(simulator, s)[0].abs().max()) / subject.acceleration_std for s in (alone, one)]
    after = simulator.step(none)
    return Outcome(
        largest(values) < 1e-6 and after.num_nodes == 0, f"isolated {values[0]:.1e}, single {values[1]:.1e}; no particle: no crash"
    )


@stress_test(
    14,
    "density spike",
    "half the distances: finite; 20,000 particles in one place: refused with a clear error before their edges are listed",
)
def density_spike(subject: Subject) -> Outcome:
    state = subject.free_state()
    centre = state.pos.mean(dim=0)

    def compressed(factor: float) -> State:
        return replace(state, pos=centre + factor * (state.pos - centre))

    before, after = (len(radius_pairs(compressed(f).pos.numpy(), subject.simulator.builder.scales.radius).T) for f in (1.0, 0.5))
    try:
        dense = bool(torch.isfinite(subject.simulator.step(compressed(0.5)).pos).all())
    except GpeError as error:
        return Outcome(False, f"refused at half the distances: {error}")
    crowd = permuted(state, torch.zeros(NUM_CROWDED, dtype=torch.int64))
    try:
        subject.simulator.step(crowd)
        refused, text = False, "not refused"
    except SimulationError as error:
        refused, text = error.reason == "clustering" and error.node >= 0, f"refused: {error.reason}, node {error.node}"
    return Outcome(
        dense and refused, f"{after / max(before, 1):.1f} times the edges: {'finite' if dense else 'not finite'}; in one place: {text}"
    )


@stress_test(15, "crossing the radius", "a node comes within R of a cloud: no acceleration jumps by more than the one-step RMSE")
def cutoff(subject: Subject) -> Outcome:
    state, radius = subject.free_state(), subject.simulator.builder.scales.radius
    if state.cells is not None:
        state = permuted(state, torch.arange(state.num_nodes - 1))  # particles only: a node of a mesh cannot come from outside
    first = int(torch.argmax(state.pos[:, 0]))
    visitor, sides = permuted(state, torch.tensor([first])), []
    for distance in (radius * (1 + 1e-9), radius * (1 - 1e-9)):
        offset = torch.zeros(state.dim, dtype=torch.float64)
        offset[0] = distance
        sides.append(State.joined([replace(state, cells=None, rest_pos=None), shifted(visitor, offset)]))
        if len(radius_pairs(sides[-1].pos.numpy(), radius).T) == 0:
            return inapplicable("no two nodes of the scene are within the radius")

    def jump(simulator: LearnedSimulator) -> float:
        apart, joined = (acceleration(simulator, side) for side in sides)
        return float((joined - apart).abs().max()) / subject.one_step_rmse

    measured, cause = jump(subject.simulator), ""
    if subject.simulator.model.settings.get("island_momentum", "ignored") != "ignored":
        cause = f"; {jump(_without_islands(subject.simulator)):.2g} without island momentum"
    return Outcome(measured < 1, f"{measured:.2g} one-step RMSE{cause}")


def _without_islands(simulator: LearnedSimulator) -> LearnedSimulator:
    """Return a copy whose islands may push themselves. It tells which part of a jump comes from nodes that join an island."""
    other = simulator.configured()
    other.model.settings = {**other.model.settings, "island_momentum": "ignored"}
    return other


@stress_test(31, "an edge turns", "a node passes above or below a neighbour: no acceleration jumps by more than the one-step RMSE")
def turning_edge(subject: Subject) -> Outcome:
    """A message of the kind ``negated`` depends on which end is to the right (``momentum_conv.orient``), so it may jump where this changes."""
    state, radius = subject.state(), subject.simulator.builder.scales.radius
    pairs = radius_pairs(state.pos.numpy(), radius)
    if len(pairs.T) == 0:
        return inapplicable("no two nodes of the scene are within the radius")
    apart = (state.pos[pairs[0], 0] - state.pos[pairs[1], 0]).abs()
    jumps = []
    for fixed, passing in pairs.T[torch.argsort(apart)[:NUM_EDGES].numpy()].tolist():
        sides = []
        for offset in (1e-9 * radius, -1e-9 * radius):
            pos = state.pos.clone()
            pos[passing, 0] = pos[fixed, 0] + offset
            sides.append(acceleration(subject.simulator, replace(state, pos=pos)))
        jumps.append(float((sides[1] - sides[0]).abs().max()))
    jump = largest(jumps) / subject.one_step_rmse
    return Outcome(jump < 1, f"{jump:.2g} one-step RMSE, largest of {len(jumps)} edges")


@stress_test(16, "neighbour list", "equal to brute force for 1,000 random moves; pairs are unordered")
def neighbour_list(subject: Subject) -> Outcome:
    rng = np.random.default_rng(0)
    radius, state = subject.simulator.builder.scales.radius, subject.state()
    pos = state.pos.numpy()[rng.permutation(state.num_nodes)[:64]].copy()
    wrong = 0
    for _ in range(NUM_MOVES):
        pos += rng.normal(scale=0.1 * radius, size=pos.shape)
        pairs = {(min(a, b), max(a, b)) for a, b in radius_pairs(pos, radius).T.tolist()}
        distance = np.sqrt(np.square(pos[:, None] - pos[None]).sum(axis=-1))
        wrong += len(pairs ^ {(int(a), int(b)) for a, b in np.argwhere(np.triu(distance <= radius, 1))})
    return Outcome(wrong == 0, f"{wrong} pairs differ; there is no skin: every step searches anew")


TESTS = (coincident, isolated, density_spike, cutoff, turning_edge, neighbour_list)
