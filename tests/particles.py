"""Blocks of particles as initial states for tests of particle solvers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from gpe_pl.rollout.loop import Simulator
from gpe_pl.schema import MATERIALS, NODE_TYPES, node_code, param_names
from gpe_pl.solvers.materials import Elastomer, Sand, Snow
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

DENSITY = {"sand": Sand().density, "snow": Snow().density, "elastomer": Elastomer().density, "fluid": 1000.0}
VALUE = {"sand": 30.0, "snow": 10.0, "elastomer": 1e5, "fluid": 0.05}


def block(
    low: Sequence[float],
    size: Sequence[float],
    spacing: float,
    material: str = "sand",
    *,
    value: float | None = None,
    velocity: npt.ArrayLike = 0.0,
    boundary: Boundary | None = None,
    gravity: npt.ArrayLike = 0.0,
    jitter: float = 0.25,
    seed: int = 0,
) -> State:
    """Return a box of particles at the nodes of a lattice, moved by up to ``jitter`` spacings; it has as many axes as ``low``."""
    dim = len(low)
    counts = [round(s / spacing) for s in size]
    lattice = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, dim)
    moved = lattice + 0.5 + np.random.default_rng(seed).uniform(-jitter, jitter, lattice.shape)
    count = len(lattice)
    return State(
        np.asarray(low) + moved * spacing,
        np.tile(np.broadcast_to(np.asarray(velocity, float), dim), (count, 1)),
        np.full(count, node_code(material), np.uint8),
        np.full(count, DENSITY[material] * spacing**dim),
        np.full((count, 1), VALUE[material] if value is None else value),
        boundary if boundary is not None else Boundary.empty(dim),
        np.array(np.broadcast_to(np.asarray(gravity, float), dim)),
    )


def together(materials: tuple[str, ...], *states: State) -> State:
    """Join blocks to one scene with the boundary and gravity of the first; ``materials`` are those of the solver."""
    names = param_names(materials)
    blocks = []
    for state in states:
        columns = np.full((state.num_nodes, len(names)), np.nan)
        columns[:, names.index(MATERIALS[NODE_TYPES[state.node_type[0]]][0].name)] = state.material_params[:, 0]
        blocks.append(replace(state, material_params=columns))
    return State.joined(blocks)


def run(solver: Simulator, state: State, num_steps: int) -> State:
    """Return the state after some frames."""
    for _ in range(num_steps):
        state = solver.step(state)
    return state
