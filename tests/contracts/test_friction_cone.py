"""Coulomb's law for islands that touch one plane: with static friction, walls push and rub islands, but do not hold them."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.base import Prediction
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.friction_cone import limit, limited
from gpe_pl.nn.wall_contacts import WallContacts
from gpe_pl.schema import STICKY
from gpe_pl.system.compiled import unfused
from gpe_pl.trajectory.loads import Loads
from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.state import State
from tests import scenes

GRAVITY = 9.81
FORCE = (0.3, 0.8)
"""Acceleration without gravity that the model of these tests predicts for every node, over that of gravity."""


class Pushing(GPE):
    """Model that predicts the same acceleration for every node, and a part that sums to zero."""

    def forward(self, data: HeteroData) -> Prediction:
        found = {}
        for m in self.spec.materials:
            deforms = torch.linspace(-1.0, 1.0, data[m].num_nodes)[:, None] * torch.tensor([0.5, -0.7])
            found[m] = GRAVITY * torch.tensor(FORCE) + deforms
        return Prediction(found)


def pushing(loads: tuple[str, ...] = ()) -> LearnedSimulator:
    build = GraphBuilder(GraphConfig(history=1, islands=True), replace(scenes.metadata(("sand",)), loads=loads))
    made = LearnedSimulator(Pushing(build.spec, num_message_passing_steps=1, hidden_channels=8), build).eval()
    made.static_friction = 1e-6
    return made


def lying(turned: float, friction: float) -> State:
    """Return a layer at rest on the floor, all of equal mass, whose wall has a normal that is turned from the vertical [degrees]."""
    state = scenes.state(12, ("sand",), seed=3)
    pos = np.stack([np.linspace(0.4, 0.6, 12), np.full(12, 0.04)], axis=1)
    angle = np.deg2rad(turned)
    normal = np.tile([np.sin(angle), np.cos(angle)], (len(state.boundary.pos), 1))
    boundary = replace(state.boundary, normal=normal, friction=np.full(len(normal), friction))
    zero = np.zeros_like(pos)
    return replace(state, pos=pos, vel=zero, velocity_history=zero[:, None], mass=np.full(12, 0.1), boundary=boundary)


def mean_force(learned: LearnedSimulator, state: State) -> np.ndarray:
    """Return the mean acceleration without gravity in one step, over that of gravity."""
    new = learned.step(state.to_torch())
    acceleration = new.vel.mean(dim=0).numpy() / learned.builder.metadata.frame_dt
    return (acceleration + np.array([0.0, GRAVITY])) / GRAVITY  # type: ignore[no-any-return]


CASES: list[tuple[float, float, Any]] = [
    (0, 0.0, (0.0, 0.8)),  # a smooth floor does not rub
    (0, 0.25, (0.2, 0.8)),
    (0, 0.5, (0.3, 0.8)),  # inside the cone
    (180, 0.5, (0.0, 0.0)),  # a ceiling
    (180, STICKY, (0.3, 0.8)),  # to which material sticks
    (90, 0.0, (0.3, 0.0)),  # a smooth wall
    (90, 0.5, (0.3, 0.15)),
    (-90, 0.5, (0.0, 0.0)),  # a wall that would have to pull
]


@pytest.mark.parametrize("is_compiled", [True, False])
@pytest.mark.parametrize(("turned", "friction", "expected"), CASES)
def test_a_plane_acts_within_its_friction_cone(turned: float, friction: float, expected: Any, is_compiled: bool) -> None:
    learned = pushing()
    with nullcontext() if is_compiled else unfused():
        found = mean_force(learned, lying(turned, friction))
        np.testing.assert_allclose(found, expected, atol=1e-6)
        learned.static_friction = 0.0
        np.testing.assert_allclose(mean_force(learned, lying(turned, friction)), FORCE, atol=1e-6)


@pytest.mark.parametrize("is_compiled", [True, False])
def test_the_law_changes_no_deformation(is_compiled: bool) -> None:
    learned, state = pushing(), lying(180, 0.0).to_torch()
    with nullcontext() if is_compiled else unfused():
        found = learned.step(state).vel
        learned.static_friction = 0.0
        free = learned.step(state).vel
    torch.testing.assert_close(found - found.mean(dim=0), free - free.mean(dim=0), rtol=0, atol=1e-12)
    assert (found.mean(dim=0) - free.mean(dim=0)).norm() > 0.01


@pytest.mark.parametrize("is_compiled", [True, False])
@pytest.mark.parametrize("what", ["second normal", "force", "given motion", "opening"])
def test_islands_on_which_more_acts_are_left_alone(what: str, is_compiled: bool) -> None:
    state = lying(180, 0.0)
    learned = pushing(("force",) if what == "force" else ())
    if what == "second normal":
        normal = state.boundary.normal.copy()
        normal[state.boundary.pos[:, 0] > 0.5] = [1.0, 0.0]
        state = replace(state, boundary=replace(state.boundary, normal=normal))
    elif what == "force":
        force = np.where(np.arange(12)[:, None] == 0, [0.01, 0.0], 0.0)[None]
        state = replace(state, loads=Loads(np.zeros((12, 2), bool), np.empty((1, 0, 2)), force))
    elif what == "given motion":
        chosen = np.repeat((np.arange(12) == 0)[:, None], 2, axis=1)
        state = replace(state, loads=Loads(chosen, np.stack([state.pos[:1]] * 2)))
    else:
        low, high = (tuple((state.pos[0] + sign * 0.005).tolist()) for sign in (-1, 1))
        state = state.opened([Opening(low, high, "y_low", 0.1)])
    with nullcontext() if is_compiled else unfused():
        found = learned.step(state.to_torch())
        learned.static_friction = 0.0
        free = learned.step(state.to_torch())
    torch.testing.assert_close(found.pos[1:], free.pos[1:], rtol=0, atol=1e-12)


def random_contacts(seed: int, dim: int) -> tuple[Tensor, Tensor, Tensor, WallContacts]:
    """Return accelerations, masses, gravity and contacts of five islands, some of which touch one plane."""
    random = torch.Generator().manual_seed(seed)

    def normals(count: int) -> Tensor:
        return torch.nn.functional.normalize(torch.randn(count, dim, generator=random, dtype=torch.float64), dim=1)

    island = torch.randint(0, 5, (40,), generator=random)
    plane, at = normals(5), torch.randint(0, 4, (30,), generator=random)  # the last island touches nothing
    normal = plane[at]
    bent = at == 3
    normal[bent] = normals(int(bent.sum()))
    friction = torch.tensor([0.0, 0.4, STICKY, 0.2], dtype=torch.float64)[at] * torch.rand(30, generator=random, dtype=torch.float64).clamp(
        min=0.9
    )
    no_island, no_edge = torch.zeros(5, dtype=torch.bool), torch.zeros(30, dtype=torch.bool)
    contacts = WallContacts(island, no_island, no_island, at, normal.float(), friction, no_edge)
    gravity = -9.81 * torch.eye(dim, dtype=torch.float64)[-1]
    acceleration = gravity + 5 * torch.randn(40, dim, generator=random, dtype=torch.float64)
    return acceleration, torch.rand(40, generator=random, dtype=torch.float64) + 0.1, gravity, contacts


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("seed", range(8))
def test_the_compiled_loop_equals_operations_of_pytorch(seed: int, dim: int) -> None:
    acceleration, mass, gravity, contacts = random_contacts(seed, dim)
    expected, found = limited(acceleration, mass, gravity, contacts), acceleration.clone()
    limit(found.numpy(), mass.numpy(), gravity.numpy(), contacts)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    changed = {int(k) for k in contacts.island[(found != acceleration).any(dim=1)]}
    assert changed <= {0, 1}  # smooth and rubbing planes; no-slip ones, bent walls and free islands are left alone
    for k in changed:
        of_island = contacts.island == k
        force = (mass[:, None] * (found - gravity))[of_island].sum(dim=0) / mass[of_island].sum()
        normal, mu = contacts.normal[contacts.at == k][0].double(), contacts.friction[contacts.at == k].max()
        along = force @ normal
        assert along > -1e-9 and (force - along * normal).norm() <= mu * along + 1e-6


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_gradients_pass_through(weight: float) -> None:
    acceleration, mass, gravity, contacts = random_contacts(0, 3)
    acceleration, gravity = acceleration - (1 - weight) * gravity, weight * gravity
    acceleration.requires_grad_()
    assert torch.autograd.gradcheck(lambda a: limited(a, mass, gravity, contacts), acceleration)


@pytest.mark.parametrize("friction", [0.0, 0.3, float("inf")])
def test_nothing_is_undefined_where_nothing_acts(friction: float) -> None:
    """Nodes without force, in flight or on a plane, without gravity, and with a friction that rounds to infinity."""
    nothing, zero = torch.zeros(2, dtype=torch.bool), torch.zeros(1, dtype=torch.bool)
    at, normal = torch.tensor([1]), torch.tensor([[0.0, 1.0]])
    contacts = WallContacts(torch.tensor([0, 1]), nothing, nothing, at, normal, torch.tensor([friction]), zero)
    acceleration, gravity = torch.zeros(2, 2, dtype=torch.float64, requires_grad=True), torch.zeros(2, dtype=torch.float64)
    found = limited(acceleration, torch.ones(2, dtype=torch.float64), gravity, contacts)
    (gradient,) = torch.autograd.grad(found.sum(), acceleration)
    compiled = np.zeros((2, 2))
    limit(compiled, np.ones(2), np.zeros(2), contacts)
    assert not found.any() and not compiled.any() and gradient.isfinite().all()


class Exact(Pushing):
    """Model that also predicts velocities at the frame, as models with the elastic law do."""

    def forward(self, data: HeteroData) -> Prediction:
        return replace(super().forward(data), frame_velocity={m: torch.zeros(data[m].num_nodes, 2) for m in self.spec.materials})


@pytest.mark.parametrize("is_compiled", [True, False])
def test_models_that_move_nodes_within_the_frame_are_left_alone(is_compiled: bool) -> None:
    learned, state = pushing(), lying(180, 0.0).to_torch()
    learned.model.__class__ = Exact
    with nullcontext() if is_compiled else unfused():
        found = learned.step(state)
        learned.static_friction = 0.0
        torch.testing.assert_close(found.vel, learned.step(state).vel, rtol=0, atol=0)
