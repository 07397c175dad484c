"""FLIP with inlets and outlets: continuity in a duct, and an exact account of nodes in an open channel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import SimulationError, rollout, steps
from gpe_pl.schema import node_code
from gpe_pl.solvers.flip import FLIP
from gpe_pl.solvers.supported import check_surroundings
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata

SPACING, CELL, DT, SPEED = 0.05, 0.1, 5e-3, 1.0
FLUID = node_code("fluid")


def duct(height: float, length: float, filled: float, *openings: Opening, gravity: float = 0.0) -> tuple[FLIP, State, Metadata]:
    """Return a solver, and water that fills a duct up to ``filled`` [m] at the speed of the inlet."""
    bounds = ((0.0, length), (0.0, height))
    sites = np.stack(np.meshgrid(np.arange(round(filled / SPACING)), np.arange(round(height / SPACING)), indexing="ij"), axis=-1)
    pos = SPACING * (sites.reshape(-1, 2) + 0.5)
    count = len(pos)
    state = State(
        pos, np.tile([SPEED, 0.0], (count, 1)), np.full(count, FLUID, np.uint8), np.full(count, 1000.0 * SPACING**2), np.full((count, 1), 1e-6),
        Boundary.sample(domain_walls(bounds, 0.0), SPACING, 2), np.array([0.0, gravity]), param_names=("kinematic_viscosity",),
    )  # fmt: skip
    metadata = Metadata("duct", ("fluid",), ("kinematic_viscosity",), DT, SPACING, 3 * SPACING, bounds, (0.0, gravity))
    return FLIP(bounds=bounds, grid_spacing=CELL, frame_dt=DT), state.opened(openings), metadata


def inlet(height: float, speed: float = SPEED) -> Opening:
    return Opening((0.0, 0.0), (0.2, height), "x_low", speed, SPACING, FLUID, 1000.0 * SPACING**2, (1e-6,))


def test_water_in_a_duct_moves_with_the_speed_of_the_inlet() -> None:
    solver, state, _ = duct(0.4, 1.2, 1.0, inlet(0.4), Opening((1.0, 0.0), (1.2, 0.4), "x_high"))
    slow = replace(state, vel=0.25 * state.vel)  # the inlet has to accelerate all the water at once
    inside, after = inlet(0.4).contains(state.pos), solver.step(slow)
    np.testing.assert_allclose(after.pos[inside], state.pos[inside] + [DT * SPEED, 0.0], atol=1e-12)
    *_, last = steps(solver, slow, 4)
    beyond = last.pos[:, 0] > 0.2
    np.testing.assert_allclose(last.vel[beyond].mean(axis=0), [SPEED, 0.0], atol=0.02)
    np.testing.assert_allclose(last.vel[~beyond], np.tile([SPEED, 0.0], ((~beyond).sum(), 1)))


def test_an_outlet_with_a_speed_draws_water_out_of_a_duct() -> None:
    outlet = Opening((1.0, 0.0), (1.2, 0.4), "x_high", speed=-SPEED)
    solver, state, _ = duct(0.4, 1.2, 1.2, outlet)
    state = state.take(state.pos[:, 0] > 0.3).opened(state.openings)  # air takes the place of the water
    *_, last = steps(solver, replace(state, vel=0.0 * state.vel), 4)
    drawn = (last.pos[:, 0] > 0.5) & (last.pos[:, 0] < 1.0)
    np.testing.assert_allclose(last.vel[drawn].mean(axis=0), [SPEED, 0.0], atol=0.03)


def test_a_zone_in_both_directions_pushes_water_and_draws_it_back() -> None:
    zone = replace(inlet(0.4), speed=None, speeds=((0.0, SPEED), (0.05, SPEED), (0.06, -SPEED)))
    solver, state, metadata = duct(0.4, 1.2, 0.8, zone)
    result = rollout(solver, state, 40, metadata)
    assert result.alive is not None
    speed = [result.vel[k, result.alive[k] & (result.pos[k, :, 0] > 0.2), 0].mean() for k in range(41)]
    np.testing.assert_allclose(speed[8:10], SPEED, atol=0.03)
    np.testing.assert_allclose(speed[20:], -SPEED, atol=0.05)
    change = np.diff(result.alive.astype(int), axis=0)
    net = (change == 1).sum() - (change == -1).sum()
    assert (change == 1).sum() == 8
    assert net == pytest.approx(8 * zone.travel(40 * DT) / SPACING, abs=8)
    assert result.alive[-1].sum() == state.num_nodes + net


def test_an_inlet_of_a_closed_basin_fills_it_exactly() -> None:
    solver, state, metadata = duct(0.6, 1.0, 0.2, inlet(0.2), gravity=-9.81)
    state = state.take(state.pos[:, 1] < 0.2).opened(state.openings)
    result = rollout(solver, state, 60, metadata, Guard(bounds=metadata.bounds, spacing=SPACING))
    assert result.termination is None
    assert result.alive is not None
    assert result.alive[-1].sum() == result.num_nodes == 16 + 4 * round(60 * DT * SPEED / SPACING)
    *_, last = steps(solver, state, 60)
    assert last.mass.sum() == pytest.approx(1000.0 * SPACING**2 * last.num_nodes)


def test_an_opening_thinner_than_a_cell_is_refused() -> None:
    solver, state, _ = duct(0.4, 1.2, 1.0, replace(inlet(0.4), high=(0.04, 0.4)))
    with pytest.raises(SimulationError, match=r"contains the centre of no cell of the grid, whose cells are 0.1 m wide; make it deeper"):
        solver.step(state)


def test_a_solver_without_openings_refuses_open_scenes() -> None:
    _, state, _ = duct(0.4, 1.2, 1.0, inlet(0.4))
    with pytest.raises(SimulationError, match="FEM does not compute scenes with inlets and outlets; FLIP and MPM do"):
        check_surroundings(state, "FEM")


@pytest.mark.slow
def test_an_open_channel_becomes_steady() -> None:
    solver, state, metadata = duct(0.8, 2.0, 0.2, inlet(0.3), Opening((1.8, -0.1), (2.0, 0.8), "x_high"), gravity=-9.81)
    state = state.take(state.pos[:, 1] < 0.3).opened(state.openings)
    result = rollout(solver, state, 1200, metadata, Guard(bounds=metadata.bounds, margin=2.0, spacing=SPACING))
    assert result.termination is None
    assert result.alive is not None
    change = np.diff(result.alive.astype(int), axis=0)
    entered, left = (change == 1).sum(axis=1), (change == -1).sum(axis=1)
    np.testing.assert_array_equal(result.alive[1:].sum(axis=1), result.alive[0].sum() + np.cumsum(entered - left))
    assert entered.sum() == 6 * round(1200 * DT * SPEED / SPACING)
    assert left[900:].sum() == pytest.approx(entered[900:].sum(), rel=0.05)
