"""Contract of models whose cells move bodies (``model.elastic``): the units of gravity and of stress.

The law takes gravity and returns stress in other units than the network. The checks of symmetries in ``contract`` pass with a wrong conversion factor, too, so
the checks here test the factors. A check raises ``AssertionError`` if a model fails.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.testing import scenes
from gpe_pl.learned.testing.changes import to_dtype
from gpe_pl.learned.testing.contract import Check, Factory
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.strain import shape_gradients

SOLID = "solid"
HEAVY = 1e6
"""Factor of masses. Bodies this heavy hardly move within a frame, so their stress is the same at its start and its end."""


def check_gravity(make: Factory, kind: str) -> None:
    """Check that additional gravity Δg moves a free body by Δg/2 in a frame and adds Δg to its velocity at the frame (in units of frames).

    The features of the network are the same with and without it, so only the law can cause the difference.
    """
    simulator, state = _simulator_and_state(make, kind)
    extra, dt = torch.linspace(-20.0, 3.0, state.dim, dtype=torch.float64), simulator.builder.metadata.frame_dt
    pulled = replace(state, gravity=state.gravity + extra)
    graphs = [_graph(simulator, s) for s in (state, pulled)]
    for node_type in graphs[0].node_types:
        graphs[1][node_type].x = graphs[0][node_type].x
    first, second = (simulator.moved([s], [g], simulator(g))[0] for s, g in zip((state, pulled), graphs, strict=True))
    assert first.frame_velocity is not None and second.frame_velocity is not None, "the model predicts no velocity at the frame"
    _assert_close(second.pos - first.pos, (0.5 * dt**2 * extra).expand_as(first.pos), "the displacement by gravity")
    _assert_close(second.frame_velocity - first.frame_velocity, (dt * extra).expand_as(first.pos), "the velocity by gravity")


def check_stress(make: Factory, kind: str) -> None:
    """Check that the stress [Pa] is that of the forces which move the nodes, by the changes of stress and acceleration due to a homogeneous strain.

    The nodal forces of a stress σ are −Σ V σ ∇N, with the volumes V of cells and the gradients ∇N of their shape functions.
    """
    simulator, state = _simulator_and_state(make, kind)
    resting = _graph(simulator, state)
    store = resting[SOLID]
    store.mass, store.velocity, store.body_pos = HEAVY * store.mass, torch.zeros_like(store.velocity), store.rest_pos
    strained = resting.clone()
    random = np.random.default_rng(0)
    strain = torch.from_numpy(0.01 * random.normal(size=(state.dim, state.dim)))
    strained[SOLID].body_pos = store.rest_pos + store.rest_pos @ strain
    before, after = (simulator(g) for g in (resting, strained))
    assert SOLID in after.stress, "the model predicts no stress"
    change = ((after.stress[SOLID] - before.stress[SOLID]) * simulator.stress_std).detach().numpy()
    own = (store.cell_index[:, : state.dim + 1] if kind != "lattice" else store.cell_index).numpy()
    stress = _as_matrix(change[np.unique(own)].mean(axis=0), state.dim)
    gradient, volume = shape_gradients(store.rest_pos.numpy()[own])
    at_corner = -np.einsum("cq,ij,cqaj->cai", np.abs(volume), stress, gradient)
    force = np.zeros((len(store.mass), state.dim))
    np.add.at(force, own.ravel(), at_corner.reshape(-1, state.dim))
    way = (after.acceleration[SOLID] - before.acceleration[SOLID]).detach() * simulator.acceleration_std
    _assert_close(way, 0.5 * torch.from_numpy(force) / store.mass[:, None], "the acceleration by stress")


ELASTIC_CHECKS: dict[str, Check] = {
    f"{name} with {kind}": partial(check, kind=kind)
    for name, check in (("gravity", check_gravity), ("stress", check_stress))
    for kind in ("triangles", "lattice", "tetrahedra")
}
"""Checks of models with ``elastic`` and ``stress`` by name."""


def _simulator_and_state(make: Factory, kind: str) -> tuple[LearnedSimulator, State]:
    """Return a simulator whose statistics all differ from 1, and a free body."""
    dim = 3 if kind == "tetrahedra" else 2
    build = scenes.builder((SOLID,), dim, mesh=True, cells=True)
    state = scenes.mesh_state(kind, (SOLID,), num_bodies=1, walls=False).to_torch()
    state = replace(state, mass=3.0 * state.mass, frame_velocity=1.1 * state.vel)
    sample, random = to_dtype(build(state), torch.float64), torch.Generator().manual_seed(0)
    store = sample[SOLID]
    store.target = 7.0 * torch.randn(state.num_nodes, dim, generator=random, dtype=torch.float64)
    store.stress_target = 2e4 * torch.randn(state.num_nodes, build.spec.stress_channels[SOLID], generator=random, dtype=torch.float64)
    simulator = LearnedSimulator(make(build.spec), build).double().eval()
    simulator.fit_statistics([sample])
    return simulator, state


def _graph(simulator: LearnedSimulator, state: State) -> HeteroData:
    return to_dtype(simulator.builder(state), torch.float64)


def _as_matrix(components: np.ndarray, dim: int) -> np.ndarray:
    """Return the stress tensor [dim, dim] from components in the order of ``schema.STRESS_COMPONENTS``."""
    rows, columns = ([0, 0, 1], [0, 1, 1]) if dim == 2 else ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
    matrix = np.empty((dim, dim))
    matrix[rows, columns] = matrix[columns, rows] = components[: len(rows)]
    return matrix


def _assert_close(found: Tensor, expected: Tensor, name: str, tolerance: float = 0.05) -> None:
    difference, size = float((found - expected).detach().norm()), float(expected.norm())
    assert difference <= tolerance * size, f"{name} has an error of {difference:.1e}, allowed are {tolerance:g} of {size:.1e}"
