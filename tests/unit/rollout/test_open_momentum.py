"""Islands, momentum and guards in rollouts of models whose nodes enter and leave."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpe_pl.geometry.shapes import Box, domain_walls
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics.open_scenes import ledger
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import rollout, steps
from gpe_pl.schema import node_code
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata

DT, SPACING, BOUNDS, GRAVITY = 0.02, 0.05, ((0.0, 2.0), (0.0, 2.0)), (0.0, -4.0)
TAP = Opening(
    (0.9, 1.2), (1.1, 1.4), "y_high", None, SPACING, node_code("sand"), 2.0, (30.0,), ((0.0, 1.0), (0.1, 1.0), (0.11, 0.0))
)  # far from the walls; it closes after a moment, so what has left it falls off
DRAIN = Opening((0.0, 0.0), (2.0, 0.5), "y_low")


@pytest.fixture
def metadata() -> Metadata:
    return Metadata("tap", ("sand",), ("friction_angle",), DT, SPACING, 0.12, BOUNDS, GRAVITY)


@pytest.fixture
def simulator(metadata: Metadata) -> LearnedSimulator:
    torch.manual_seed(0)
    builder = GraphBuilder(GraphConfig(history=2, islands=True), metadata)
    model = GPE(builder.spec, num_message_passing_steps=1, hidden_channels=8, island_momentum="angular")
    return LearnedSimulator(model, builder).eval()


def tap() -> State:
    pos = TAP.nodes_at_start()
    count = len(pos)
    state = State(
        pos, np.tile(TAP.velocity_at(0.0), (count, 1)), np.full(count, TAP.node_type, np.uint8), np.full(count, 2.0), np.full((count, 1), 30.0),
        Boundary.sample(domain_walls(BOUNDS, 0.5), SPACING, 2), np.array(GRAVITY), param_names=("friction_angle",),
    )  # fmt: skip
    return state.opened([TAP, DRAIN])


def test_an_island_is_not_free_while_an_opening_moves_it(simulator: LearnedSimulator, metadata: Metadata) -> None:
    seen = set()
    for state in steps(simulator, simulator.standing(tap(), metadata), 30):
        graph = simulator.builder(state)
        islands = graph["sand"].island.numpy()
        inside = TAP.contains(state.pos.numpy())
        near = np.minimum(state.pos.numpy(), 2.0 - state.pos.numpy()).min(axis=1) < 0.2
        for island, is_held in enumerate(graph.island_is_held.tolist()):
            if not near[islands == island].any():  # far from the walls
                assert is_held == inside[islands == island].any()
                seen.add(is_held)
    assert seen == {False, True}


def test_momentum_of_free_islands_is_exact_while_nodes_enter_and_leave(simulator: LearnedSimulator, metadata: Metadata) -> None:
    """Whatever the model predicts, what is free falls: its momentum changes by gravity, and by what leaves."""
    film = rollout(simulator, simulator.standing(tap(), metadata), 45, metadata)
    assert film.alive is not None
    book, pos = ledger(film), film.pos
    assert book.left_mass.sum() > 0
    assert book.entered_mass.sum() > 0
    np.testing.assert_allclose(np.diff(book.mass), book.entered_mass[1:] - book.left_mass[1:])
    checked = 0
    for frame in range(8, 45):  # the tap is closed: its nodes rest, and all others are free once they are far from it
        stays = film.alive[frame] & film.alive[frame + 1]
        inside = TAP.contains(pos[frame])
        gap = np.abs(pos[frame, stays & inside][:, None] - pos[frame, stays & ~inside][None]).max(axis=-1)
        if not gap.size or gap.min() < 0.13 or book.left_mass[frame + 1] > 0:  # what leaves gives a last push to the rest of its island
            continue
        falling = film.mass[stays & ~inside].sum()
        np.testing.assert_allclose(book.forces[frame + 1], falling * DT * np.array(GRAVITY), atol=2e-4)
        checked += 1
    assert checked > 5
    deviation = rollout(Ballistic(DT), tap(), 45, metadata).pos[30] - pos[30]
    assert np.abs(deviation).max() > 1e-4  # the model does not predict free fall


def test_a_node_that_enters_behind_a_wall_has_not_tunnelled(metadata: Metadata) -> None:
    """Guards compare with the frame before. New nodes have no place there, and rows of others shift as nodes leave."""
    plate = Box((0.5, 1.0), (1.5, 1.1), 0.5)
    state = replace(tap(), boundary=Boundary.sample((*domain_walls(BOUNDS, 0.5), plate), SPACING, 2))
    below = replace(TAP, low=(0.9, 0.6), high=(1.1, 0.8), side="y_low", speeds=((0.0, 1.0),))
    side = Opening((1.3, 1.1), (2.0, 1.4), "x_high")
    guard = Guard(bounds=BOUNDS, margin=0.5, spacing=SPACING)
    film = rollout(Ballistic(DT), state.opened([replace(TAP, speeds=((0.0, 0.0),)), below, side]), 10, metadata, guard)
    assert film.termination is None
    assert film.num_nodes > state.num_nodes
