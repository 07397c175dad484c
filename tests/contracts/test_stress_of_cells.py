"""Models whose cells give the deviatoric stress: it is that of the elastic law at the predicted positions, and the network decodes the rest."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.testing import scenes
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.elastic_bodies import CellError
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.strain import shape_gradients

SOLID, SHEAR = "solid", 3e4
KINDS = ("triangles", "lattice", "tetrahedra")


def simulator(kind: str, **settings: Any) -> tuple[LearnedSimulator, State]:
    """Return a simulator with random weights, units that all differ from 1 and a shear modulus of ``SHEAR`` Pa, and a strained free body."""
    dim = 3 if kind == "tetrahedra" else 2
    build = scenes.builder((SOLID,), dim, mesh=True, cells=True)
    torch.manual_seed(0)
    model: Any = GPE(
        build.spec,
        hidden_channels=8,
        num_message_passing_steps=1,
        stress=True,
        **{"deviator": "cells", "material_embedding": "none", **settings},
    )
    made = LearnedSimulator(model, build).eval()
    made.acceleration_std.fill_(7.0)
    made.stress_std.fill_(2e4)
    made.standardizer.mass.fill_(0.3)
    made.set_units_of(model)
    if model.settings["deviator"] == "cells":
        frame = build.scales.frame_dt
        unit = 0.3 * build.scales.spacing ** (2 - dim) / frame**2  # of the constants, in Pa
        with torch.no_grad():
            model.deviator.constants[SOLID].logarithm["bias"].copy_(torch.tensor([10.0, SHEAR / unit, 1.0]).log() / 5.0)
    state = scenes.mesh_state(kind, (SOLID,), num_bodies=1, walls=False).to_torch()
    assert state.rest_pos is not None
    centre = state.pos.mean(dim=0)
    skew = torch.eye(dim, dtype=torch.float64) + 0.1 * torch.randn(dim, dim, dtype=torch.float64)  # no cell is inverted
    return made, replace(state, pos=(state.rest_pos - state.rest_pos.mean(dim=0)) @ skew + centre, vel=0.01 * state.vel)


def without_network(made: LearnedSimulator) -> LearnedSimulator:
    model: Any = made.model
    with torch.no_grad():
        for p in model.stress_decoder.parameters():
            p.zero_()
    return made


def expected(state: State, kind: str) -> np.ndarray:
    """Return the deviatoric part of μ F Fᵀ / J at nodes, in the third dimension with a stretch of 1, the mean over cells by rest volume."""
    assert state.cells is not None and state.rest_pos is not None
    cells = state.cells.numpy()
    if kind != "lattice":
        cells = cells[:, : state.dim + 1]
    gradient, volume = shape_gradients(state.rest_pos.numpy()[cells])
    f = np.einsum("cai,cqaj->cqij", state.pos.numpy()[cells], gradient)
    ratio = np.linalg.det(f)
    whole = np.zeros((*ratio.shape, 3, 3))
    whole[..., : state.dim, : state.dim] = f @ np.swapaxes(f, -1, -2)
    if state.dim == 2:
        whole[..., 2, 2] = 1.0
    stress = SHEAR * (whole - np.trace(whole, axis1=-2, axis2=-1)[..., None, None] / 3 * np.eye(3)) / ratio[..., None, None]
    rows, columns = ([0, 0, 1, 2], [0, 1, 1, 2]) if state.dim == 2 else ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
    weighted, size = (np.abs(volume)[..., None] * stress[..., rows, columns]).sum(axis=1), np.abs(volume).sum(axis=1)
    total, around = np.zeros((state.num_nodes, len(rows))), np.zeros(state.num_nodes)
    for corner in cells.T:
        np.add.at(total, corner, weighted)
        np.add.at(around, corner, size)
    return np.asarray(total / np.maximum(around, 1e-30)[:, None])


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_deviator_of_the_law_at_the_predicted_positions(kind: str) -> None:
    made, state = simulator(kind)
    after = without_network(made).step(state)
    assert after.stress is not None
    wanted = expected(after, kind)
    assert np.abs(wanted).max() > 1000
    np.testing.assert_allclose(after.stress.node.numpy(), wanted, rtol=1e-3, atol=1e-4 * np.abs(wanted).max())


def test_the_network_decodes_the_rest() -> None:
    made, state = simulator("triangles")
    plain, _ = simulator("triangles", deviator="network")
    plain.load_state_dict({k: v for k, v in made.state_dict().items() if ".deviator." not in k})
    whole, rest = made.step(state).stress, plain.step(state).stress
    alone = without_network(made).step(state).stress
    assert whole is not None and rest is not None and alone is not None
    torch.testing.assert_close(whole.node, rest.node + alone.node, rtol=1e-4, atol=1e-4 * float(whole.node.abs().max()))


def test_scenes_together_have_the_stress_of_scenes_alone() -> None:
    made, state = simulator("triangles")
    other = replace(state, pos=state.pos + 0.01, vel=2 * state.vel)
    for alone, together in zip((made.step(state), made.step(other)), made.step_all([state, other]), strict=True):
        assert not isinstance(together, SimulationError)
        assert alone.stress is not None and together.stress is not None
        torch.testing.assert_close(together.stress.node, alone.stress.node, rtol=1e-4, atol=1.0)


def test_the_modulus_learns_and_positions_do_not() -> None:
    made, state = simulator("triangles")
    without_network(made)
    made.train()
    made(made.builder(state)).stress[SOLID].square().mean().backward()
    model: Any = made.model
    slope = model.deviator.constants[SOLID].logarithm["bias"].grad
    assert slope is not None and slope[1] > 0 and slope[0].abs() < 1e-6 * slope[1]
    assert not any(p.grad is not None and p.grad.any() for p in model.node_decoder.parameters())


def test_what_it_needs_is_named() -> None:
    build = scenes.builder((SOLID,), mesh=True, cells=True)
    for stress, elastic in ((False, False), (True, True)):
        with pytest.raises(CellError, match="model.deviator=cells needs model.stress=true model.elastic=false graph.cells=true"):
            GPE(build.spec, deviator="cells", hidden_channels=8, num_message_passing_steps=1, stress=stress, elastic=elastic)
