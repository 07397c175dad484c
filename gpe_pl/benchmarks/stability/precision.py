"""Stress tests of rounding, of implementations that should agree, of memory, of training on extreme data, and of the guard."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch_geometric.data import HeteroData

from gpe_pl.benchmarks.stability.horizon import PERTURBATION, advanced, separation
from gpe_pl.benchmarks.stability.inputs import Spoiled
from gpe_pl.benchmarks.stability.subject import (
    Outcome,
    Subject,
    acceleration,
    in_double,
    inapplicable,
    largest,
    output,
    relative_change,
    stress_test,
)
from gpe_pl.geometry.shapes import Box, Sphere
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.learned.approximate import approximate
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.testing.changes import in_order, permuted, to_dtype
from gpe_pl.metrics import per_frame_mse
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import rollout, steps
from gpe_pl.rollout.skips import Skips
from gpe_pl.system.machine import resident_bytes
from gpe_pl.training.module import TrainingModule
from gpe_pl.trajectory.state import State

NUM_STEPS = 100


@stress_test(25, "single precision", "100 steps in float32 and float64 differ by no more than twins 1e-6 of the domain apart do")
def single_precision(subject: Subject) -> Outcome:
    start = subject.state(0, 0.0)
    single, double = Contained(subject.simulator, subject.dt), Contained(in_double(subject.simulator), subject.dt)
    a, b = (advanced(simulator, start, NUM_STEPS) for simulator in (single, double))
    difference = float((a.pos - b.pos).square().sum(dim=1).mean().sqrt()) / subject.spacing
    twin = float(separation(single, start, NUM_STEPS, subject.spacing, subject.simulator.builder.metadata.longest_side)[-1])
    text = f"{difference:.2g} spacings, twins {PERTURBATION:g} of the domain apart {twin:.2g}"
    return Outcome(bool(difference <= twin < math.inf), text)


@stress_test(26, "equal implementations", "fused = plain: change < 1e-5")
def implementations(subject: Subject) -> Outcome:
    settings = subject.simulator.description()["settings"]
    if "implementation" not in settings:
        return inapplicable("the model has one implementation; compilation is used in training only, and tested there")
    other = "plain" if settings["implementation"] == "factored" else "factored"
    model = type(subject.simulator.model)(subject.simulator.builder.spec, **{**settings, "implementation": other})
    twin = LearnedSimulator(model, subject.simulator.builder)
    twin.load_state_dict(subject.simulator.state_dict())
    state = subject.state()
    change = relative_change(acceleration(twin.eval(), state), acceleration(subject.simulator, state))
    return Outcome(change < 1e-5, f"{change:.1e} between factored and plain")


@stress_test(27, "memory and recompilation", "200 steps with changing edges: resident memory grows by < 1 % after 50; ≤ 3 recompilations")
def memory(subject: Subject) -> Outcome:
    used, edges, num_compiled = [], set(), compilations()
    for state in steps(Contained(subject.simulator, subject.dt), subject.state(0, 0.0), 200):
        used.append(resident_bytes())
        graph = subject.simulator.builder(state)
        edges.add(sum(graph[r].edge_index.shape[1] for r in subject.simulator.builder.spec.relations))
    growth, num_compiled = max(used[50:]) / max(used[:50]) - 1, compilations() - num_compiled
    text = f"{100 * growth:.2g} %, {num_compiled} compilations, {len(edges)} numbers of edges"
    return Outcome(growth < 0.01 and num_compiled <= 3 and len(edges) > 1, text)


def compilations() -> int:
    """Return the number of graphs that ``torch.compile`` has made in this process."""
    return int(torch._dynamo.utils.counters["stats"]["unique_graphs"])


@stress_test(
    28,
    "skipped work",
    "exact levels: change < 1e-6; sleeping, if 1 % sleep: error after 20 steps ≤ 1.05 times that of computing everything",
)
def skipping(subject: Subject) -> Outcome:
    changes = []
    for fraction in (0.1, 0.5, 0.9):
        state = subject.state(0, fraction)
        everything = acceleration(_skipping(subject, NOTHING), state)
        changes += [relative_change(acceleration(_skipping(subject, skips), state), everything) for skips in EXACT]
        builder = subject.simulator.builder
        other = GraphBuilder(replace(builder.config, trim_boundary=not builder.config.trim_boundary), builder.metadata, NOTHING)
        untrimmed = output(subject.simulator, other(state), state.num_nodes).double() * subject.acceleration_std
        changes.append(relative_change(untrimmed, everything))
    ratio, speed_up, fraction = sleeping(subject)
    slept = f"sleeping {ratio:.3f} times the error, {speed_up:.2f} times as fast, {100 * fraction:.2g} % asleep"
    slept = slept if fraction >= ENOUGH_ASLEEP else f"sleeping not judged, {100 * fraction:.2g} % asleep"
    return Outcome(largest(changes) < 1e-6 and (fraction < ENOUGH_ASLEEP or ratio <= 1.05), f"exact levels {largest(changes):.1e}; {slept}")


ENOUGH_ASLEEP = 0.01
"""Fraction of particle-steps asleep from which the error of sleeping says something; below, both rollouts are nearly the same computation."""
NOTHING = Skips(absent_types=False, static_boundary=False, isolated_nodes=False, edges_at_once=None)
EXACT = (
    Skips(),
    *(replace(NOTHING, **{name: True}) for name in ("absent_types", "static_boundary", "isolated_nodes")),
    replace(NOTHING, edges_at_once=64),
)
ASLEEP = Skips(sleep_after=5)


def _skipping(subject: Subject, skips: Skips) -> LearnedSimulator:
    simulator = copy.deepcopy(subject.simulator)
    simulator.skips = skips
    return simulator


def sleeping(subject: Subject, num_steps: int = 20) -> tuple[float, float, float]:
    """Compare rollouts with and without sleeping, from starts throughout the scenes.

    Returns:
        The mean squared error with sleeping over that without, the time without sleeping over that with, and the fraction of particle-steps asleep.
    """
    without_stress = subject.simulator.model.settings.get("stress_unit") == "strain"  # with it, such models refuse to sleep
    runners = {"asleep": approximate(_skipping(subject, replace(ASLEEP, stress=without_stress))), "awake": subject.simulator}
    errors, seconds, num_asleep, num_steps_of_nodes = dict.fromkeys(runners, 0.0), dict.fromkeys(runners, 0.0), 0.0, 0

    def count(_: int, state: State) -> None:
        nonlocal num_asleep, num_steps_of_nodes
        num_asleep, num_steps_of_nodes = num_asleep + state.num_asleep, num_steps_of_nodes + state.num_nodes

    for truth in subject.scenes:
        for frame in np.unique(
            np.linspace(subject.history, max(subject.history, truth.num_frames - 1 - num_steps), 4).astype(int)
        ).tolist():
            start, known = subject.simulator.initial_state(truth, frame), truth.frames(frame, frame + num_steps + 1)
            for name, runner in runners.items():
                began = time.perf_counter()
                result = rollout(
                    Contained(runner, subject.dt), start, known.num_frames - 1, known.metadata, None, count if name == "asleep" else None
                )
                seconds[name] += time.perf_counter() - began
                errors[name] += float(per_frame_mse(result, known)[1:].mean())
    return errors["asleep"] / max(errors["awake"], 1e-300), seconds["awake"] / seconds["asleep"], num_asleep / max(1, num_steps_of_nodes)


# --- training -------------------------------------------------------------------------------------------------------------------------------


@stress_test(
    29,
    "training under attack",
    "learning rate × 4, a batch with targets of 1e6 scales: loss finite; one batch learned to nMSE < 1e-2 in 300 steps; gradcheck on 5 nodes",
)
def training(subject: Subject) -> Outcome:
    graph = training_graph(subject)
    spoiled = graph.clone()
    for material in subject.simulator.builder.spec.materials:
        spoiled[material].target = torch.full_like(spoiled[material].target, 1e6 * subject.acceleration_std)
    attacked = trained(subject, [graph] * 20 + [spoiled] + [graph] * 79, 4e-3)
    learned = trained(subject, [graph] * 300, 1e-3)
    nmse = learned[-1] / target_power(subject, graph)
    correct = gradients_are_correct(subject)
    text = f"loss {attacked[-1]:.2g} after the attack, nMSE {nmse:.2g}, gradients {'correct' if correct else 'wrong'}"
    return Outcome(bool(np.isfinite(attacked).all() and nmse < 1e-2 and correct), text)


def training_graph(subject: Subject) -> HeteroData:
    """Return a graph of the first scene with its target."""
    truth, builder = subject.scenes[0], subject.simulator.builder
    frame = truth.num_frames // 2
    state = subject.simulator.initial_state(truth, frame)
    graph = builder(state)
    target = torch.from_numpy(subject.truth_acceleration(0, frame)) - state.gravity
    for material in builder.spec.materials:
        graph[material].target = target[graph[material].node_id].float()
    return graph


def target_power(subject: Subject, graph: HeteroData) -> float:
    """Return the mean square of a graph's normalised target, which is the loss of predicting zero."""
    values = torch.cat([graph[m].target for m in subject.simulator.builder.spec.materials]) / subject.acceleration_std
    return float(values.square().mean())


def trained(subject: Subject, graphs: list[HeteroData], learning_rate: float) -> list[float]:
    """Train fresh weights on a list of graphs, with gradients clipped as in training and without stresses; return the losses."""
    torch.manual_seed(0)
    simulator = copy.deepcopy(subject.simulator).train()
    settings = simulator.description()["settings"]
    simulator.model = type(subject.simulator.model)(
        simulator.builder.spec, **{**settings, **({"stress": False} if "stress" in settings else {})}
    )
    simulator.set_units_of(simulator.model)
    module = TrainingModule(simulator, len(graphs), learning_rate, compile="off")
    optimizer = torch.optim.Adam(simulator.parameters(), lr=learning_rate)
    losses = []
    for graph in graphs:
        optimizer.zero_grad()
        loss = module.loss(graph)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(simulator.parameters(), 1.0)
        optimizer.step()
        losses.append(loss.item())
    return losses


def gradients_are_correct(subject: Subject) -> bool:
    """Tell whether gradients with respect to node features equal finite differences in double precision, on 5 nodes."""
    simulator = in_double(subject.simulator)
    state = subject.state()
    near = torch.argsort((state.pos - state.pos[0]).norm(dim=1))[:5]
    few = permuted(state, near)
    graph = to_dtype(simulator.builder(few), torch.float64)
    material = next(m for m in simulator.builder.spec.materials if graph[m].num_nodes)

    def f(x: torch.Tensor) -> torch.Tensor:
        changed = graph.clone()
        changed[material].x = x
        return in_order(simulator(changed), graph, few.num_nodes, few.dim)

    x = graph[material].x.clone().requires_grad_()
    return bool(torch.autograd.gradcheck(f, (x,), eps=1e-6, atol=1e-5, rtol=1e-3, raise_exception=False))


# --- the guard ------------------------------------------------------------------------------------------------------------------------------


@stress_test(
    30,
    "guard",
    "NaN, explosion, escape, tunnelling, clustering: stopped at that frame with reason, node and good frames; impossible material: at once",
)
def guard(subject: Subject) -> Outcome:
    state = subject.state(0, 0.0)
    radius, size = subject.simulator.builder.scales.radius, 1e3 * subject.spacing
    limits = Guard(1e3 * subject.max_speed, ((-size, size),) * state.dim, radius, subject.spacing)
    found = {}
    for reason, spoil in attacks(subject, limits).items():
        simulator = Spoiled(subject.simulator, 3, state.num_nodes, spoil, subject.dt, state.time)
        result = rollout(simulator, state, 5, subject.scenes[0].metadata, limits)
        stop = result.termination
        found[reason] = stop is not None and (stop.reason, stop.frame) == (reason, 3) and stop.node >= 0 and result.num_frames == 3
    obstructed = replace(state, boundary=replace(state.boundary, shapes=(obstacle(state, subject.spacing),)))
    before, behind = (replace(obstructed, pos=torch.cat([place[None], state.pos[1:]])) for place in _beside(obstructed, subject.spacing))
    stop = limits.check(behind, 3, before)  # a model may avoid an obstacle, so both states are constructed
    found["tunnelling"] = stop is not None and (stop.reason, stop.frame, stop.node) == ("tunnelling", 3, 0)
    inside = replace(obstructed, boundary=replace(state.boundary, shapes=(ball(state, 2 * radius),)))
    stop = limits.check(inside, 3)
    found["deep inside"] = stop is not None and (stop.reason, stop.frame, stop.node) == ("tunnelling", 3, 0)
    params = state.material_params.clone()
    params[1] = -1.0
    result = rollout(subject.simulator, replace(state, material_params=params), 5, subject.scenes[0].metadata, limits)
    stop = result.termination
    found["material"] = stop is not None and (stop.reason, stop.frame, stop.node) == ("material", 0, 1)
    bad = [reason for reason, is_found in found.items() if not is_found]
    return Outcome(not bad, f"not found: {', '.join(bad)}" if bad else f"{len(found)} of {len(found)} found")


def attacks(subject: Subject, limits: Guard) -> dict[str, Callable[[State, State], State]]:
    """Return functions that spoil a new state, by the reason for which the guard must stop."""

    def placed(new: State, rows: slice, to: torch.Tensor) -> State:
        pos = new.pos.clone()
        pos[rows] = to
        return replace(new, pos=pos)

    found: dict[str, Callable[[State, State], State]] = {
        "nan": lambda _, new: placed(new, slice(1, 2), torch.full((new.dim,), torch.nan).double()),
        "explosion": lambda _, new: replace(new, vel=new.vel + 2 * limits.max_speed),
        "escape": lambda _, new: placed(new, slice(1, 2), torch.full((new.dim,), 2 * limits.bounds[0][1]).double()),
    }
    if subject.state().num_nodes > 40:
        found["clustering"] = lambda _, new: placed(new, slice(0, 40), new.pos[0])
    return found


def obstacle(state: State, spacing: float) -> Box:
    """Return a plate two spacings above the highest node. It is two spacings thick and eight wide."""
    middle, top = state.pos.mean(dim=0), state.pos.max(dim=0).values
    low, high = middle - 4 * spacing, middle + 4 * spacing
    low[-1], high[-1] = top[-1] + 2 * spacing, top[-1] + 4 * spacing
    return Box(tuple(low.tolist()), tuple(high.tolist()), friction=0.0)


def ball(state: State, radius: float) -> Sphere:
    """Return an obstacle around the first node."""
    return Sphere(tuple(state.pos[0].tolist()), radius, friction=0.0)


def _beside(state: State, spacing: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return positions one spacing below and one spacing above the plate."""
    plate = state.boundary.shapes[-1]
    assert isinstance(plate, Box)
    below, above = torch.tensor([plate.low, plate.high], dtype=torch.float64)
    below[:-1] = above[:-1] = 0.5 * (below + above)[:-1]
    return below - spacing * (torch.arange(state.dim) == state.dim - 1), above + spacing * (torch.arange(state.dim) == state.dim - 1)


TESTS = (single_precision, implementations, memory, skipping, training, guard)
