"""Static friction: nodes that rest on a wall and hardly move keep their positions; flying, fast or pushed nodes move as without it."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch_geometric.data import HeteroData

from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.standards import Standards
from gpe_pl.graphs.topology import Topology
from gpe_pl.learned.differentiable import Differentiable
from gpe_pl.learned.simulator import CheckpointError, LearnedSimulator, SceneError
from gpe_pl.models.base import Prediction
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.static_friction import bears, supported
from gpe_pl.nn.wall_contacts import WallContacts
from gpe_pl.rollout.loop import rollout
from gpe_pl.schema import STICKY
from gpe_pl.system.compiled import unfused
from gpe_pl.trajectory.loads import Loads
from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.state import State
from tests import scenes

NET = 0.4
"""Fraction of gravity that the model of these tests leaves unbalanced."""
ENOUGH = 0.5


class Supporting(GPE):
    """Model that predicts an upward acceleration of most of gravity for every node."""

    def forward(self, data: HeteroData) -> Prediction:
        up = torch.tensor([0.0, (1 - NET) * 9.81])
        return Prediction({m: up.expand(data[m].num_nodes, 2) for m in self.spec.materials})


def simulator(islands: bool = True, materials: tuple[str, ...] = ("sand",)) -> LearnedSimulator:
    build = scenes.builder(materials, islands=islands)
    return LearnedSimulator(Supporting(build.spec, num_message_passing_steps=1, hidden_channels=8), build).eval()


def silent() -> LearnedSimulator:
    """Return a simulator whose network predicts zero."""
    build = scenes.builder(("sand",), islands=True)
    made = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8), build).eval()
    with torch.no_grad():
        for p in made.model.parameters():
            p.zero_()
    return made


def lying_and_flying(materials: tuple[str, ...] = ("sand",)) -> tuple[State, np.ndarray]:
    """Return a layer on the floor and a cloud above it, both at rest, and a mask of the lying nodes [node]."""
    state = scenes.state(24, materials, seed=3)
    lies = np.arange(24) % 4 < 2
    pos = np.stack([np.linspace(0.3, 0.7, 24), np.where(lies, 0.04, 0.5)], axis=1)
    return replace(state, pos=pos, vel=np.zeros_like(pos), velocity_history=np.zeros((24, 1, 2))), lies


@pytest.mark.parametrize("materials", [("sand",), ("snow", "sand")])
def test_what_lies_on_a_wall_stays_and_what_flies_falls(materials: tuple[str, ...]) -> None:
    state, lies = lying_and_flying(materials)
    learned = simulator(materials=materials)
    free = learned.step(state.to_torch())
    learned.static_friction = ENOUGH
    held = learned.step(state.to_torch())
    assert torch.equal(held.pos[lies], state.to_torch().pos[lies])
    assert not held.vel[lies].any() and held.velocity_history is not None and not held.velocity_history[lies].any()
    assert torch.equal(held.pos[~lies], free.pos[~lies]) and torch.equal(held.vel[~lies], free.vel[~lies])
    assert free.vel[lies].any()


def test_steps_for_training_from_states_without_gradients_keep_the_same_nodes() -> None:
    learned = simulator()
    learned.model.register_parameter("weight", torch.nn.Parameter(torch.zeros(())))
    learned.model.register_forward_hook(lambda model, _, found: Prediction({m: a + model.weight for m, a in found.acceleration.items()}))
    learned.static_friction = ENOUGH
    state, lies = lying_and_flying()
    after, expected = Differentiable(learned).step(state.to_torch()), learned.step(state.to_torch())
    assert after.pos.requires_grad and not after.vel[lies].any()
    torch.testing.assert_close(after.pos.detach(), expected.pos)


def test_features_are_compiled_unless_a_wall_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    state, lies = lying_and_flying()
    learned = simulator()
    learned.static_friction = ENOUGH
    graph = GraphBuilder.graph
    made: list[State] = []

    def counted(build: GraphBuilder, topology: Topology, state: State, standards: Standards | None = None) -> HeteroData:
        made.extend([state] if standards is not None else [])
        return graph(build, topology, state, standards)

    monkeypatch.setattr(GraphBuilder, "graph", counted)
    still = learned.step(state.to_torch())
    assert len(made) == 1 and torch.equal(still.pos[lies], state.to_torch().pos[lies])
    vel = np.zeros_like(state.boundary.vel)
    vel[:] = [0.0, 1.0]
    lifted = learned.step(replace(state, boundary=replace(state.boundary, vel=vel)).to_torch())
    assert len(made) == 1 and (lifted.pos[lies] != state.to_torch().pos[lies]).any()
    with unfused():
        assert torch.equal(learned.step(state.to_torch()).pos, still.pos)


@pytest.mark.parametrize("materials", [("sand",), ("snow", "sand")])
def test_compiled_steps_of_several_scenes_keep_the_same_nodes(materials: tuple[str, ...]) -> None:
    first, lies = lying_and_flying(materials)
    vel = np.where(np.arange(24)[:, None] % 3 == 0, [0.1, 0.0], 0.0)  # a third is too fast
    second = replace(first, vel=vel, velocity_history=vel[:, None], frame_velocity=vel.copy())
    states = [first.to_torch(), second.to_torch()]
    learned = simulator(materials=materials)
    learned.static_friction = ENOUGH
    found = learned.step_all(states)
    with unfused():
        expected = learned.step_all(states)
    for new, other, old in zip(found, expected, states, strict=True):
        assert isinstance(new, State) and isinstance(other, State)
        for name in ("pos", "vel", "velocity_history"):
            torch.testing.assert_close(getattr(new, name), getattr(other, name), rtol=0, atol=1e-14)
        stays = (new.pos == old.pos).all(dim=1).numpy()
        assert stays[lies].any() and not stays[~lies].any()
    assert (found[0].pos[lies] == states[0].pos[lies]).all() and (found[1].pos[lies] != states[1].pos[lies]).any()  # type: ignore[union-attr]


def test_at_rest_is_for_ever() -> None:
    state, lies = lying_and_flying()
    learned = simulator()
    learned.static_friction = ENOUGH
    result = rollout(learned, state.to_torch(), 20, learned.builder.metadata)
    assert (result.pos[:, lies] == result.pos[0, lies]).all()
    assert (result.pos[-1, ~lies] < result.pos[0, ~lies])[:, 1].all()


@pytest.mark.parametrize("when", ["before", "after"])
def test_what_moves_is_not_held(when: str) -> None:
    """A node moves before the step, or because the unbalanced part of gravity exceeds static friction."""
    state, lies = lying_and_flying()
    learned = simulator()
    velocity = 1.01 * ENOUGH * 9.81 * learned.builder.metadata.frame_dt
    vel = np.where(lies[:, None] & (when == "before"), [velocity, 0.0], 0.0)
    moving = replace(state, vel=vel, velocity_history=vel[:, None]).to_torch()
    free = learned.step(moving)
    learned.static_friction = ENOUGH if when == "before" else 0.9 * NET
    held = learned.step(moving)
    assert torch.equal(held.pos, free.pos)


def test_a_wall_that_moves_holds_nothing() -> None:
    state, lies = lying_and_flying()
    floor = state.boundary.pos[:, 1] <= 0
    vel = np.where((floor & (state.boundary.pos[:, 0] > 0.5))[:, None], [0.2, 0.0], 0.0)
    moving = replace(state, boundary=replace(state.boundary, vel=vel)).to_torch()
    learned = simulator()
    free = learned.step(moving)
    learned.static_friction = ENOUGH
    assert torch.equal(learned.step(moving).pos, free.pos)
    assert not torch.equal(learned.step(state.to_torch()).pos[lies], free.pos[lies])


def given_motion(kind: str, state: State, chosen: np.ndarray, speed: float, dt: float) -> State:
    """Return a state in which some nodes move upwards with a speed [m/s], in an opening around them or on a given path."""
    if kind == "opening":
        pos = state.pos[chosen]
        low, high = (tuple(corner.tolist()) for corner in (pos.min(axis=0) - 0.01, pos.max(axis=0) + 0.01))
        return state.opened([Opening(low, high, "y_low", speed)])
    prescribed = np.repeat(chosen[:, None], 2, axis=1)
    return replace(state, loads=Loads(prescribed, state.pos[chosen] + np.array([0.0, speed * dt]) * np.arange(2)[:, None, None]))


@pytest.mark.parametrize("kind", ["opening", "path"])
@pytest.mark.parametrize("is_compiled", [True, False])
def test_what_moves_from_outside_holds_nothing(kind: str, is_compiled: bool) -> None:
    """One node moves slowly, lying on the floor or flying; the others of its island move as without static friction."""
    state, lies = lying_and_flying()
    learned = simulator()
    dt = learned.builder.metadata.frame_dt
    with nullcontext() if is_compiled else unfused():
        for of_island in (lies, ~lies):
            chosen = np.arange(24) == np.flatnonzero(of_island)[0]
            for speed in (1e-4, 0.0):
                moving = given_motion(kind, state, chosen, speed, dt).to_torch()
                learned.static_friction = 0.0
                free = learned.step(moving)
                learned.static_friction = ENOUGH
                found = (learned.step(moving).pos == free.pos).all(dim=1).numpy()
                holds = lies & ~chosen if speed == 0.0 or of_island[~lies].any() else np.zeros(24, bool)
                assert (found[~chosen] == ~holds[~chosen]).all(), (of_island, speed)


def test_islands_that_touch_walls_none_of_which_moves_and_one_of_which_bears() -> None:
    at = torch.tensor([0, 1, 1, 3, 4, 5, 5])
    bearing = torch.tensor([True, True, False, True, False, False, True])
    moves = torch.tensor([False, False, True, False, False, False, False])
    normal = torch.where(bearing[:, None], torch.tensor([0.0, 1.0]), torch.tensor([1.0, 0.0]))
    is_pushed = torch.zeros(7, dtype=torch.bool)
    contacts = WallContacts(torch.arange(7), is_pushed, is_pushed, at, normal, torch.zeros(7), moves)
    gravity = torch.tensor([0.0, -9.81])
    assert supported(contacts, gravity).tolist() == [True, False, False, True, False, True, False]
    pushed = replace(contacts, is_pushed=torch.arange(7) == 3)
    assert supported(pushed, gravity).tolist() == [True, False, False, False, False, True, False]


@pytest.mark.parametrize("dim", [2, 3])
def test_a_wall_bears_up_to_its_angle_of_friction(dim: int) -> None:
    gravity = 9.81 * torch.tensor([0.6, 0.0, -0.8] if dim == 3 else [0.6, -0.8], dtype=torch.float64)
    up = -gravity / gravity.norm()
    across = torch.tensor([0.8, 0.0, 0.6] if dim == 3 else [0.8, 0.6], dtype=torch.float64)
    slopes = torch.deg2rad(torch.tensor([0.0, 21.0, 23.0, 44.0, 46.0, 89.0, 90.0, 120.0, 180.0], dtype=torch.float64))
    normal = (slopes.cos()[:, None] * up + slopes.sin()[:, None] * across).float()
    for friction, steepest in ((0.0, 0.0), (0.4, 21.0), (1.0, 44.0), (STICKY, 89.0)):
        found = bears(normal, torch.full((9,), friction), gravity)
        assert found.tolist() == [bool(slope <= np.deg2rad(steepest) + 1e-9) for slope in slopes], friction
    assert not bears(normal, torch.full((9,), STICKY), torch.zeros(dim)).any()


@pytest.mark.parametrize("is_compiled", [True, False])
def test_ceilings_and_steep_walls_hold_nothing(is_compiled: bool) -> None:
    """Nodes on the floor stay. With turned normals, it is a ceiling, a side wall or a slope, which holds them if its friction suffices."""
    state, lies = lying_and_flying()
    learned = simulator()
    learned.static_friction = ENOUGH
    with nullcontext() if is_compiled else unfused():
        for turned, friction, holds in ((180, STICKY, False), (90, STICKY, False), (40, 0.5, False), (40, 1.0, True), (0, 0.0, True)):
            angle = np.deg2rad(turned)
            normal = np.tile([np.sin(angle), np.cos(angle)], (len(state.boundary.pos), 1))
            boundary = replace(state.boundary, normal=normal, friction=np.full(len(normal), friction))
            now = replace(state, boundary=boundary).to_torch()
            stays = (learned.step(now).pos == now.pos).all(dim=1).numpy()
            assert (stays == (lies & holds)).all(), (turned, friction)


def test_a_graph_without_normals_has_none() -> None:
    build = scenes.builder(("sand",), islands=True, boundary_condition=False)
    made = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8), build)
    with pytest.raises(SceneError, match="needs a model that was trained with graph.boundary_condition=true"):
        made.static_friction = ENOUGH


def test_a_model_that_does_not_know_its_islands_has_none() -> None:
    with pytest.raises(SceneError, match="needs a model that was trained with graph.islands=true"):
        simulator(islands=False).static_friction = ENOUGH


def test_what_nothing_supports_falls() -> None:
    """Even tied to a wall, and whatever the static friction: one that no network predicts is no support."""
    state, _ = lying_and_flying()
    learned = silent()
    free = learned.step(state.to_torch())
    learned.static_friction = 0.99
    assert torch.equal(learned.step(state.to_torch()).pos, free.pos)


@pytest.mark.parametrize("share", [-0.1, float("nan"), 1.0, True, "0.5"])
def test_values_that_make_no_sense(share: Any) -> None:
    with pytest.raises(ValueError, match="must be a number from 0 to less than 1"):
        simulator().static_friction = share


def test_a_checkpoint_keeps_it(tmp_path: Path) -> None:
    learned = silent()
    learned.static_friction = ENOUGH
    learned.save(tmp_path / "model.ckpt")
    assert LearnedSimulator.from_checkpoint(tmp_path / "model.ckpt").static_friction == ENOUGH
    checkpoint = torch.load(tmp_path / "model.ckpt", weights_only=True)
    checkpoint["simulator"]["static_friction"] = -1.0
    torch.save(checkpoint, tmp_path / "wrong.ckpt")
    with pytest.raises(CheckpointError, match="static_friction=-1"):
        LearnedSimulator.from_checkpoint(tmp_path / "wrong.ckpt")
    del checkpoint["simulator"]["static_friction"]  # as before there was any
    torch.save(checkpoint, tmp_path / "old.ckpt")
    assert LearnedSimulator.from_checkpoint(tmp_path / "old.ckpt").static_friction == 0
