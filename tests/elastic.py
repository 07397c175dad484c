"""Simulators of elastic bodies with random weights, and bodies for them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from gpe_pl.geometry.shapes import Box, domain_walls
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from tests import scenes

BODIES = ("elastomer",)
MIXED = ("sand", "elastomer")
DT, ACCELERATION = 0.005, 200.0


def simulator(
    materials: tuple[str, ...] = BODIES, dim: int = 2, periodic: tuple[bool, ...] = (), network: float = 0.1, **settings: Any
) -> LearnedSimulator:
    """A simulator with random weights. ``network`` is the size of the weights that training starts at zero."""
    build = scenes.builder(materials, dim, mesh=True, cells=True)
    build = GraphBuilder(build.config, replace(build.metadata, periodic=periodic))
    torch.manual_seed(0)
    settings = {"num_message_passing_steps": 2, "hidden_channels": 8, "elastic": True, **settings}
    made = LearnedSimulator(GPE(build.spec, **settings), build).eval()
    with torch.no_grad():
        for name, p in made.model.named_parameters():
            if not p.any() and "elastic" not in name:
                p.normal_(std=network)
            if name.endswith("logarithm.weight"):
                p.fill_(0.01)
    made.acceleration_std.fill_(ACCELERATION)
    made.model.set_units(ACCELERATION * DT**2, scenes.SPACING, 1.0)
    return made


def bodies(seed: int = 0, kind: str = "triangles", materials: tuple[str, ...] = BODIES, **settings: Any) -> State:
    state = scenes.mesh_state(kind, materials, seed=seed, **settings).to_torch()
    return replace(state, vel=0.3 * state.vel, velocity_history=0.3 * state.vel[:, None], frame_velocity=0.4 * state.vel)


class DoubleBuilder(GraphBuilder):
    """Builder of graphs in double precision."""

    precision = torch.float64


def beside_an_obstacle(seed: int, kind: str, num_bodies: int) -> State:
    """Return strained bodies with a box at one of them, whose corner is near their edges."""
    state = scenes.mesh_state(kind, ("solid",), seed=seed, num_bodies=num_bodies)
    corner, dim = state.pos[0], state.pos.shape[1]
    box = Box(tuple(corner - 3.2 * scenes.SPACING), tuple(corner - 0.2 * scenes.SPACING), 0.4)
    boundary = Boundary.sample((*domain_walls(((-1.0, 2.0),) * dim, 0.3), box), scenes.SPACING, dim)
    return replace(state, boundary=boundary, velocity_history=state.vel[:, None]).to_torch()
