"""For any state, scene or graph: graphs are valid, predictions finite, and scenes meet their contract."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from torch_geometric.data import Batch, HeteroData

from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.testing.changes import in_order, permuted
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.guard import Guard, crowding
from gpe_pl.rollout.loop import SimulationError, rollout
from gpe_pl.schema import MATERIALS
from gpe_pl.solvers.scenes import BodyScene
from gpe_pl.trajectory.state import State
from tests.scenes import builder, metadata
from tests.strategies import PARTICLES, body_scenes, graphs, seeds, states


@cache
def simulator(dim: int) -> LearnedSimulator:
    """Return an untrained model with exact momentum."""
    torch.manual_seed(0)
    build = builder(PARTICLES, dim, history=2)
    settings: dict[str, Any] = {"edge_state": "geometry", "island_momentum": "angular"}
    return LearnedSimulator(GPE(build.spec, num_message_passing_steps=2, hidden_channels=8, **settings), build).eval()


@given(states())
def test_edges_are_those_of_brute_force(state: State) -> None:
    build = builder(PARTICLES, state.dim, history=2)
    graph = build(state.to_torch())
    radius = build.scales.radius
    close = np.linalg.norm(state.pos[:, None] - state.pos[None], axis=-1)
    ambiguous = np.abs(close - radius) < 1e-12
    expected = {(int(i), int(j)) for i, j in np.argwhere(np.triu(close <= radius, 1))}
    found: list[tuple[int, int]] = []
    for source, name, target in build.spec.relations:
        if name == "radius" and source != "boundary":
            j, i = graph[source, name, target].edge_index
            pairs = torch.stack([graph[source].node_id[j], graph[target].node_id[i]]).sort(dim=0).values
            found += [(int(a), int(b)) for a, b in pairs.T]
    assert len(found) == len(set(found))
    assert not [pair for pair in expected ^ set(found) if not ambiguous[pair]]
    for store in graph.stores:
        for key in {"x", "odd", "even", "pos"} & set(store.keys()):
            assert bool(torch.isfinite(store[key]).all()), key


@given(states())
def test_a_step_is_finite_and_momentum_that_must_be_kept_is_kept(state: State) -> None:
    model = simulator(state.dim)
    tensors = state.to_torch()
    after = model.step(tensors)
    assert after.pos.shape == tensors.pos.shape
    assert bool(torch.isfinite(after.pos).all() and torch.isfinite(after.vel).all())
    if len(state.boundary.pos) == 0 and state.num_nodes:
        change = after.vel - tensors.vel - model.builder.metadata.frame_dt * tensors.gravity
        impulse = (tensors.mass[:, None] * change).sum(dim=0).norm()
        predicted = (
            tensors.mass.sum() * model.builder.metadata.frame_dt * model.acceleration_std.max()
        )  # before a node alone loses all of it
        assert impulse <= 1e-5 * (tensors.mass[:, None] * change).norm(dim=1).sum() + 1e-6 * predicted


@given(states(), seeds)
def test_the_order_of_nodes_does_not_matter(state: State, seed: int) -> None:
    model, tensors = simulator(state.dim), state.to_torch()
    order = torch.from_numpy(np.random.default_rng(seed).permutation(state.num_nodes))
    a, b = model.step(tensors).pos[order], model.step(permuted(tensors, order)).pos
    torch.testing.assert_close(a, b, rtol=0, atol=1e-6)


@given(states(), st.integers(1, 4))
def test_a_rollout_is_finite_or_stops_with_a_reason(state: State, num_steps: int) -> None:
    about = metadata(PARTICLES, state.dim)
    guard = Guard(1e3, about.bounds, 0.1, about.spacing)
    result = rollout(Contained(simulator(state.dim), about.frame_dt), state.to_torch(), num_steps, about, guard)
    assert np.isfinite(result.pos).all()
    stop = result.termination
    assert (stop is None) == (result.num_frames == num_steps + 1)
    if stop is not None:
        assert stop.reason in ("nan", "escape", "explosion", "clustering", "tunnelling", "material")
        assert 0 <= stop.node < state.num_nodes
        assert str(stop.node) in stop.message


@given(st.lists(graphs(), min_size=2, max_size=4))
def test_a_batch_equals_its_graphs(items: list[tuple[GraphBuilder, HeteroData]]) -> None:
    model = simulator(2)
    data = [graph for _, graph in items]
    with torch.no_grad():
        batch = Batch.from_data_list(data)
        together = model(batch).acceleration
        for k, graph in enumerate(data):
            alone = model(graph)
            count = sum(graph[m].num_nodes for m in PARTICLES)
            expected = in_order(alone, graph, count, 2)
            for material, values in together.items():
                rows = graph[material].node_id
                torch.testing.assert_close(values[batch[material].batch == k], expected[rows].to(values.dtype), rtol=0, atol=1e-5)


@given(seeds, st.floats(1e-3, 1.0), st.sampled_from([2, 3]))
def test_crowding_never_counts_too_few(seed: int, width: float, dim: int) -> None:
    pos = np.random.default_rng(seed).uniform(-3.0, 3.0, (40, dim))
    boxes = np.floor(pos / width)
    expected = (boxes[:, None] == boxes[None]).all(axis=-1).sum(axis=1)
    assert (crowding(pos, width) >= expected).all()


@given(body_scenes(), seeds)
def test_scenes_keep_their_promises(scene: BodyScene, seed: int) -> None:
    limits = {material: MATERIALS[material][0].limits for material in scene.materials}
    values = {material: (own.low + min(own.high, 40.0)) / 2 for material, own in limits.items()}
    try:
        state = scene.sample(values, seed)
    except ValueError:  # impossible settings are said to be
        assume(False)
    assert 0 < state.num_nodes <= scene.max_nodes
    low, high = np.array(scene.bounds).T
    assert ((state.pos >= low) & (state.pos <= high)).all()
    assert (np.linalg.norm(state.vel, axis=1) <= scene.max_speed * math.sqrt(state.dim) + 1e-9).all()
    assert (np.asarray(state.mass) > 0).all()
    again = scene.sample(values, seed)
    assert state.pos.tobytes() == again.pos.tobytes()


@given(states(), st.sampled_from(["pos", "vel"]), st.sampled_from([np.nan, np.inf, -np.inf]), seeds)
def test_values_that_are_not_finite_are_found(state: State, name: str, value: float, seed: int) -> None:
    assume(state.num_nodes > 0)
    rng = np.random.default_rng(seed)
    node, axis = int(rng.integers(state.num_nodes)), int(rng.integers(state.dim))
    tensors = state.to_torch()
    if name == "pos":
        tensors.pos[node, axis] = value
    else:
        assert tensors.velocity_history is not None
        tensors.velocity_history[node, -1, axis] = value
    try:
        simulator(state.dim).step(tensors)
    except SimulationError as error:
        assert (error.reason, error.node) == ("nan", node)
    else:
        raise AssertionError("not found")
