"""MPM with inlets and outlets: material that falls from an inlet or lies on it, and an exact account of particles."""

from __future__ import annotations

import numpy as np
import pytest

from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.rollout.loop import SimulationError, rollout, steps
from gpe_pl.schema import MATERIALS, node_code, param_names
from gpe_pl.solvers.mpm import MPM
from gpe_pl.solvers.mpm.solver import MPMInternal
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata

SPACING, DT, SPEED, BOUNDS = 1 / 32, 5e-3, 1.5, ((0.0, 1.0), (0.0, 1.0))
TAP = Opening((0.375, 0.875), (0.5, 1.0), "y_high", SPEED, SPACING, node_code("sand"), 1600 * SPACING**2, (30.0,))


def tap(*openings: Opening) -> State:
    pos = TAP.nodes_at_start()
    count = len(pos)
    state = State(
        pos, np.tile(TAP.velocity_at(0.0), (count, 1)), np.full(count, TAP.node_type, np.uint8), np.full(count, TAP.mass), np.full((count, 1), 30.0),
        Boundary.sample(domain_walls(BOUNDS, 0.5), SPACING, 2), np.array([0.0, -9.81]), param_names=("friction_angle",),
    )  # fmt: skip
    return state.opened(openings)


def test_sand_leaves_the_inlet_with_its_speed_and_falls_freely() -> None:
    *_, last = steps(MPM(bounds=BOUNDS, grid_spacing=SPACING, materials=("sand",), frame_dt=DT), tap(TAP), 40)
    assert isinstance(last.internal, MPMInternal)
    assert last.internal.plastic.shape == (last.num_nodes,)
    depth = TAP.depth_of(last.pos) - TAP.depth
    np.testing.assert_allclose(last.vel[depth < -0.01], np.tile([0.0, -SPEED], ((depth < -0.01).sum(), 1)), atol=1e-12)
    beyond = (depth > 2 * SPACING) & (last.pos[:, 1] > 0.6)
    np.testing.assert_allclose(-last.vel[beyond, 1], np.sqrt(SPEED**2 + 2 * 9.81 * depth[beyond]), rtol=0.05)
    assert last.num_nodes == 16 + 4 * round(40 * DT * SPEED / SPACING)


FINE, LAYERS = 1 / 64, 10
"""Distance of particles and number of layers in a slot without friction, of which the lowest four are in the opening."""


def slot(material: str, dim: int, speed: float, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the heights [node] in spacings at the start and after some frames, in a slot on whose floor an opening moves with a speed."""
    width = 8 if dim == 2 else 4
    bounds = (*[(0.0, width * FINE)] * (dim - 1), (0.0, 1.0))
    sites = np.stack(np.meshgrid(*[np.arange(width)] * (dim - 1), np.arange(LAYERS), indexing="ij"), axis=-1).reshape(-1, dim)
    names, code, mass, count, up = param_names((material,)), node_code(material), 1000.0 * FINE**dim, len(sites), np.eye(dim)[-1]
    least = {p.name: p.limits.low for p in MATERIALS[material]}
    params = tuple((least | {"friction_angle": 30.0, "kinematic_viscosity": 1e-6})[name] for name in names)
    high = (*[width * FINE] * (dim - 1), 4 * FINE)
    opening = Opening((0.0,) * dim, high, f"{'xyz'[dim - 1]}_low", speed, FINE if speed > 0 else 0.0, code, mass, params)
    state = State(
        FINE * (sites + 0.5), np.tile(speed * up, (count, 1)), np.full(count, code, np.uint8), np.full(count, mass), np.tile(params, (count, 1)),
        Boundary.sample(domain_walls(bounds, 0.0), FINE, dim), -9.81 * up, param_names=names,
    ).opened([opening])  # fmt: skip
    solver = MPM(bounds=bounds, grid_spacing=2 * FINE, materials=(material,), frame_dt=DT)
    *_, last = steps(solver, state, frames)
    return state.pos[:, -1] / FINE, last.pos[:, -1] / FINE


@pytest.mark.parametrize(
    ("material", "dim", "speed", "frames"),
    [("sand", 2, 0.1, 60), ("sand", 2, 0.4, 60), ("snow", 2, 0.2, 30), ("fluid", 2, 0.2, 30), ("sand", 3, 0.2, 30), ("sand", 2, -0.2, 30)],
)
def test_what_lies_on_an_opening_moves_with_it_at_constant_density(material: str, dim: int, speed: float, frames: int) -> None:
    start, end = slot(material, dim, speed, frames)
    travel, layers = speed * frames * DT / FINE, len(end) / len(start) * LAYERS
    assert end.max() - start.max() == pytest.approx(travel, rel=0.1)
    assert end.mean() == pytest.approx(LAYERS + travel - layers / 2, rel=0.03)


def test_sand_that_entered_less_sand_that_left_is_there() -> None:
    drain = Opening((0.0, 0.3), (1.0, 0.5), "y_low")
    metadata = Metadata("tap", ("sand",), ("friction_angle",), DT, SPACING, 3 * SPACING, BOUNDS, (0.0, -9.81))
    result = rollout(MPM(bounds=BOUNDS, grid_spacing=SPACING, materials=("sand",), frame_dt=DT), tap(TAP, drain), 60, metadata)
    assert result.termination is None
    assert result.alive is not None
    change = np.diff(result.alive.astype(int), axis=0)
    assert (change == -1).sum() > 20
    np.testing.assert_array_equal(result.alive[1:].sum(axis=1), 16 + np.cumsum(change.sum(axis=1)))
    assert (result.pos[result.alive][:, 1] > 0.5).all()


def test_stress_in_open_scenes_is_refused() -> None:
    with pytest.raises(SimulationError, match="no stress in scenes with inlets"):
        MPM(bounds=BOUNDS, grid_spacing=SPACING, materials=("sand",), frame_dt=DT, stress=True).step(tap(TAP))


def test_internal_state_follows_its_particles() -> None:
    internal = MPMInternal.at_rest(3, 2)
    internal.plastic[:] = [1.0, 2.0, 3.0]
    internal.deformation[:] *= np.array([2.0, 3.0, 4.0])[:, None, None]
    other = internal.of_rows(np.array([2, -1, 0]))
    assert other.plastic.tolist() == [3.0, 0.0, 1.0]
    assert other.deformation[:, 0, 0].tolist() == [4.0, 1.0, 2.0]
    assert internal.plastic.tolist() == [1.0, 2.0, 3.0]
