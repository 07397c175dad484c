"""Stress tests of invariances: order of nodes and edges, position of a scene, and other scenes computed beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.benchmarks.stability.subject import (
    Outcome,
    Subject,
    acceleration,
    in_double,
    inapplicable,
    largest,
    output,
    relative_change,
    shifted,
    stress_test,
    with_velocities,
)
from gpe_pl.graphs.batching import batched
from gpe_pl.learned.testing.changes import permuted, turned
from gpe_pl.schema import is_symmetric
from gpe_pl.trajectory.state import State

NUM_DRAWS = 5


def relabelling_error(subject: Subject, dtype: torch.dtype, seed: int) -> float:
    """Return ‖Pᵀ f(P x) − f(x)‖ / ‖f(x)‖ for a random permutation of the nodes."""
    simulator = in_double(subject.simulator) if dtype == torch.float64 else subject.simulator
    state = subject.state(seed)
    order = torch.randperm(state.num_nodes, generator=torch.Generator().manual_seed(seed))
    build, n = simulator.builder, state.num_nodes
    return relative_change(output(simulator, build(permuted(state, order)), n), output(simulator, build(state), n)[order])


def turning_error(subject: Subject, dtype: torch.dtype, seed: int, *, turn: bool, shuffle: bool) -> float:
    """Return the relative change of the output when a random half of the edges is reversed (``turn``), and when edges are shuffled (``shuffle``)."""
    simulator = in_double(subject.simulator) if dtype == torch.float64 else subject.simulator
    state = subject.state(seed)
    graph = simulator.builder(state)
    changed = turned(graph, simulator.builder.spec, seed, turn=turn, shuffle=shuffle)
    return relative_change(output(simulator, changed, state.num_nodes), output(simulator, graph, state.num_nodes))


def _both_precisions(double: list[float], single: list[float]) -> Outcome:
    exact, rounded = largest(double), largest(single)
    return Outcome(exact < 1e-12 and rounded < 1e-5, f"{exact:.1e} in float64, {rounded:.1e} in float32")


@stress_test(1, "label permutation", "‖Pᵀf(Px) − f(x)‖/‖f‖ < 1e-12 in float64, < 1e-5 in float32, largest of 5")
def label_permutation(subject: Subject) -> Outcome:
    double, single = ([relabelling_error(subject, d, k) for k in range(NUM_DRAWS)] for d in (torch.float64, torch.float32))
    return _both_precisions(double, single)


@stress_test(2, "edge orientation", "half of the edges turned: change < 1e-12 in float64, < 1e-5 in float32, largest of 5")
def edge_orientation(subject: Subject) -> Outcome:
    double, single = (
        [turning_error(subject, d, k, turn=True, shuffle=False) for k in range(NUM_DRAWS)] for d in (torch.float64, torch.float32)
    )
    return _both_precisions(double, single)


@stress_test(3, "edge order", "edges shuffled: change < 1e-6 in float32; no graph has an edge twice or from a node to itself")
def edge_order(subject: Subject) -> Outcome:
    change = largest(turning_error(subject, torch.float32, k, turn=False, shuffle=True) for k in range(NUM_DRAWS))
    bad = sum(
        wrong_edges(subject.simulator.builder(subject.state(k, fraction)), subject) for k in range(NUM_DRAWS) for fraction in (0.1, 0.9)
    )
    return Outcome(change < 1e-6 and bad == 0, f"{change:.1e}; {bad} such edges (graphs are built, never given, so none can be refused)")


def wrong_edges(graph: HeteroData, subject: Subject) -> int:
    """Count the edges that are stored twice, also in the other direction if it is the same edge, and those that connect a node to itself."""
    count = 0
    for relation in subject.simulator.builder.spec.relations:
        index = graph[relation].edge_index
        ends = index.sort(dim=0).values if is_symmetric(relation) else index
        count += index.shape[1] - torch.unique(ends, dim=1).shape[1]
        count += int((index[0] == index[1]).sum()) if relation[0] == relation[2] else 0
    return count


@stress_test(4, "translation", "by 1, 1e2, 1e4 and 1e6 domain sizes, positions in float64: change < 1e-6, with walls and without")
def translation(subject: Subject) -> Outcome:
    size = max(high - low for low, high in subject.simulator.builder.metadata.bounds)
    texts, found = [], list[float]()
    for name, state in (("scene", subject.state()), ("free", subject.free_state())):
        direction = torch.tensor([1.0, -0.7, 0.4], dtype=torch.float64)[: state.dim] * size
        before = acceleration(subject.simulator, state)
        changes = [relative_change(acceleration(subject.simulator, shifted(state, s * direction)), before) for s in (1.0, 1e2, 1e4, 1e6)]
        found += changes
        texts.append(f"{name} {', '.join(f'{c:.1e}' for c in changes)}")
    return Outcome(largest(found) < 1e-6, "; ".join(texts))


@stress_test(5, "Galilean boost", "exact where only relative velocities are used; else reported")
def galilean_boost(subject: Subject) -> Outcome:
    state = subject.free_state()
    boost = torch.zeros(state.dim, dtype=torch.float64)
    boost[0] = float(state.vel.square().mean().sqrt()) or 1e-3 * subject.simulator.builder.scales.velocity
    moved = with_velocities(state, lambda velocity: velocity + boost)
    change = (acceleration(subject.simulator, moved) - acceleration(subject.simulator, state)).square().mean().sqrt().item()
    text = f"{change / subject.one_step_rmse:.2g} one-step RMSE for a boost by the rms velocity"
    return inapplicable(f"nodes know their velocities: {text}")


@stress_test(6, "rotations by 90° and reflections", "gravity turned too: one-step error ≤ 1.2 times that of the scene as it is")
def rotations(subject: Subject) -> Outcome:
    dim = subject.simulator.builder.spec.dim
    quarter, mirror = quarter_turn(subject.simulator.builder.metadata.gravity), torch.eye(dim, dtype=torch.float64)
    mirror[0, 0] = -1.0
    errors: dict[str, list[float]] = {}
    for scene, truth in enumerate(subject.scenes):
        for frame in np.linspace(subject.history, truth.num_frames - 2, 4).astype(int).tolist():
            state = subject.simulator.initial_state(truth, frame)
            target = torch.from_numpy(subject.truth_acceleration(scene, frame)) - state.gravity
            for name, q in (("as it is", torch.eye(dim).double()), ("90°", quarter), ("180°", quarter @ quarter), ("mirrored", mirror)):
                error = acceleration(subject.simulator, _transformed(state, q)) - target @ q.T
                errors.setdefault(name, []).append(error.square().mean().item())
    rms = {name: float(np.sqrt(np.mean(values))) for name, values in errors.items()}
    ratios = {name: value / rms["as it is"] for name, value in rms.items() if name != "as it is"}
    return Outcome(largest(ratios.values()) <= 1.2, ", ".join(f"{name}: {ratio:.2f}" for name, ratio in ratios.items()))


def quarter_turn(gravity: Sequence[float]) -> Tensor:
    """Return a rotation by 90° [dim, dim] in a plane with the vertical, so that gravity [m/s²] turns, too."""
    vertical = int(np.argmax(np.abs(gravity)))
    first, second = (vertical - 1, vertical) if vertical else (0, 1)
    quarter = torch.eye(len(gravity), dtype=torch.float64)
    quarter[[first, first, second, second], [first, second, first, second]] = torch.tensor([0.0, -1.0, 1.0, 0.0], dtype=torch.float64)
    return quarter


def _transformed(state: State, q: Tensor) -> State:
    b = state.boundary
    return replace(
        with_velocities(state, lambda velocity: velocity @ q.T),
        pos=state.pos @ q.T,
        rest_pos=None if state.rest_pos is None else state.rest_pos @ q.T,
        gravity=state.gravity @ q.T,
        boundary=replace(b, pos=b.pos @ q.T, vel=b.vel @ q.T, normal=b.normal @ q.T, shapes=()),  # shapes cannot be turned
        stress=None,
    )


@stress_test(7, "batch and component independence", "alone = in a batch = beside a far copy: change < 1e-6")
def independence(subject: Subject) -> Outcome:
    simulator, states = subject.simulator, [subject.state(k, fraction) for k, fraction in ((0, 0.2), (1, 0.5), (0, 0.8))]
    graphs = [simulator.builder(s) for s in states]
    alone = [output(simulator, g, s.num_nodes) for g, s in zip(graphs, states, strict=True)]
    with torch.no_grad():
        batch = batched(graphs)
        predicted = simulator(batch).acceleration
    changes = list[float]()
    for k, (graph, single) in enumerate(zip(graphs, alone, strict=True)):
        together = torch.full_like(single, float("nan"))
        for material, value in predicted.items():
            together[graph[material].node_id] = value[batch[material].batch == k]
        changes.append(relative_change(together, single))
    free = subject.free_state()
    far = shifted(free, torch.full((free.dim,), 64 * subject.simulator.builder.scales.radius, dtype=torch.float64))
    both = acceleration(simulator, State.joined([free, far]))
    single = acceleration(simulator, free)
    copies = largest(relative_change(both[rows], single) for rows in (slice(free.num_nodes), slice(free.num_nodes, None)))
    change = largest(changes)
    return Outcome(largest([change, copies]) < 1e-6, f"{change:.1e} in a batch, {copies:.1e} beside a copy")


TESTS = (label_permutation, edge_orientation, edge_order, translation, galilean_boost, rotations, independence)
