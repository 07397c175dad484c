"""The stress of particles compared with the laws' formulas, and with the weight that it carries."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gpe_pl.config.datasets import dataset
from gpe_pl.config.entry_point import ConfigError
from gpe_pl.data.ground_truth import generate_trajectory
from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.solvers.materials import LAMBDA, MU, Fluid, Snow
from gpe_pl.solvers.mpm import MPM
from gpe_pl.solvers.mpm.solver import MPMInternal
from gpe_pl.solvers.mpm.stress import cauchy_stress
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory
from tests.particles import block

BOUNDS = ((0.0, 1.0), (0.0, 1.0), (0.0, 1.0))
STRETCH = {"elastomer": (1.1, 0.8, 1.05), "snow": (1.004, 0.99, 0.995), "sand": (0.999, 0.998, 0.9985)}
"""Principal stretches within the elastic limits."""


def solver(material: str, dim: int) -> MPM:
    return MPM(bounds=BOUNDS[:dim], grid_spacing=0.125, materials=(material,), stress=True)


def some_particles(material: str, dim: int, value: float | None = None) -> State:
    state = block((0.4,) * dim, (0.5,) * dim, 0.1, material)
    return state if value is None else replace(state, material_params=np.full_like(state.material_params, value))


def stress_of(
    material: str, deformation: np.ndarray, gradient: np.ndarray | None = None, plastic: float = 0.0, value: float | None = None
) -> np.ndarray:
    """Return the stress [component] of one particle with an elastic deformation gradient and a velocity gradient."""
    dim = len(deformation)
    state = some_particles(material, dim, value)
    count, rate = state.num_nodes, np.zeros((dim, dim)) if gradient is None else gradient
    deformations, rates = (np.tile(x, (count, 1, 1)) for x in (deformation, rate))
    internal = MPMInternal(deformations, rates, rates.copy(), np.full(count, plastic))
    return cauchy_stress(solver(material, dim)._particles(state, internal), 0.0)[0]


def tensor(components: np.ndarray) -> np.ndarray:
    """Return the tensor [3, 3] of stress components."""
    if len(components) == 4:
        xx, xy, yy, zz = components
        return np.array([[xx, xy, 0.0], [xy, yy, 0.0], [0.0, 0.0, zz]])
    xx, xy, xz, yy, yz, zz = components
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def rotation(dim: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(dim, dim)))
    return q * np.sign(np.linalg.det(q)) if dim == 3 else np.array([[0.6, -0.8], [0.8, 0.6]])


def expected(material: str, stretches: np.ndarray, lam: float, mu: float) -> np.ndarray:
    """Return the principal Cauchy stresses [3] by the law, for principal stretches [3]."""
    volume = np.prod(stretches)
    if material == "elastomer":
        kirchhoff = mu * (stretches**2 - 1) + lam * math.log(volume)
    elif material == "snow":
        kirchhoff = 2 * mu * (stretches - 1) * stretches + lam * (volume - 1) * volume
    else:
        kirchhoff = 2 * mu * np.log(stretches) + lam * math.log(volume)
    return kirchhoff / volume


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("material", STRETCH)
def test_stress_is_that_of_the_law_in_any_orientation(material: str, dim: int) -> None:
    stretches = np.array([*STRETCH[material][:dim], *[1.0] * (3 - dim)])
    turned, own = rotation(dim), np.diag(stretches[:dim])
    state = some_particles(material, dim)
    constants = solver(material, dim)._particles(state, MPMInternal.at_rest(state.num_nodes, dim)).constants[0]
    principal = expected(material, stretches, constants[LAMBDA], constants[MU])
    for deformation, turn in ((own, np.eye(dim)), (turned @ own, turned)):
        axes = np.eye(3)
        axes[:dim, :dim] = turn
        found = tensor(stress_of(material, deformation))
        np.testing.assert_allclose(found, axes @ np.diag(principal) @ axes.T, rtol=1e-9, atol=1e-6 * abs(principal).max())


@pytest.mark.parametrize("dim", [2, 3])
def test_compacted_snow_is_stiffer_and_smaller(dim: int) -> None:
    deformation, compaction, xi = np.diag((0.99,) * dim), -0.1, 10.0
    loose, dense = stress_of("snow", deformation, value=xi), stress_of("snow", deformation, plastic=compaction, value=xi)
    np.testing.assert_allclose(dense, loose * math.exp(-xi * compaction) / (1 + compaction), rtol=1e-9)
    assert math.exp(-xi * compaction) < Snow().max_hardening


@pytest.mark.parametrize("dim", [2, 3])
def test_viscosity_adds_the_deviator_of_the_rate(dim: int) -> None:
    viscosity, rate = 0.5, np.zeros((dim, dim))
    rate[0, 0], rate[0, 1] = 3.0, 4.0
    found = tensor(stress_of("fluid", np.eye(dim), rate, value=viscosity))
    symmetric = np.zeros((3, 3))
    symmetric[:dim, :dim] = (rate + rate.T) / 2
    deviator = symmetric - np.trace(symmetric) / 3 * np.eye(3)
    np.testing.assert_allclose(found, 2 * Fluid().density * viscosity * deviator, rtol=1e-9, atol=1e-9)


def test_liquid_has_a_pressure_alone_at_rest() -> None:
    squeezed = 0.999
    for dim in (2, 3):
        found = stress_of("fluid", np.diag([squeezed, *[1.0] * (dim - 1)]))
        np.testing.assert_allclose(tensor(found), Fluid().bulk_modulus * math.log(squeezed) / squeezed * np.eye(3), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("material", ["elastomer", "snow"])
def test_inverted_particles_have_the_stress_of_their_mirror_image(material: str) -> None:
    np.testing.assert_allclose(stress_of(material, np.diag([0.99, -0.98])), stress_of(material, np.diag([0.99, 0.98])), rtol=1e-9)


def test_sand_in_tension_has_no_stress() -> None:
    for dim in (2, 3):
        assert not stress_of("sand", np.diag((1.01,) * dim)).any()


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("material", ["sand", "snow", "elastomer", "fluid"])
def test_stress_changes_no_motion(material: str, dim: int) -> None:
    state = block((0.3,) * dim, (0.6,) * dim, 0.06, material)
    state = replace(state, vel=np.random.default_rng(0).normal(size=state.vel.shape))
    plain: State = state
    with_stress: State = state
    for _ in range(5):
        plain, with_stress = replace(solver(material, dim), stress=False).step(plain), solver(material, dim).step(with_stress)
    assert np.array_equal(plain.pos, with_stress.pos)
    assert plain.stress is None
    assert with_stress.stress is not None
    assert with_stress.stress.node.shape == (state.num_nodes, 4 if dim == 2 else 6)
    assert np.isfinite(with_stress.stress.node).all()


def test_stress_carries_the_weight() -> None:
    """In a layer at rest between slip walls, -σ_yy is the weight above."""
    height, spacing, gravity = 0.25, 1 / 32, 9.81
    boundary = Boundary.sample(domain_walls(BOUNDS[:2], 0.0), spacing, 2)
    state = block((0.0, 0.0), (1.0, height), spacing, "sand", boundary=boundary, gravity=np.array([0.0, -gravity]))
    layer = MPM(bounds=BOUNDS[:2], grid_spacing=2 * spacing, materials=("sand",), stress=True)
    seen = []
    for _ in range(120):
        state = layer.step(state)
        assert state.stress is not None
        seen.append(state.stress.node[:, 2])
    inner = (state.pos[:, 1] > 2 * spacing) & (state.pos[:, 1] < height - 2 * spacing)
    slope, floor = np.polyfit(state.pos[inner, 1], np.mean(seen[40:], axis=0)[inner], 1)
    weight = layer.sand.density * gravity
    assert floor == pytest.approx(-weight * height, rel=0.1)
    assert slope == pytest.approx(weight, rel=0.15)


def data(*more: str) -> Any:
    return dataset("data=snow", "size=tiny", *more)


def test_only_true_and_false_say_whether_stress_is_stored() -> None:
    with pytest.raises(ConfigError, match="stress"):  # the data set would have the name of one without stress
        data("data.solver.stress=1")


def test_data_sets_without_stress_are_those_of_before() -> None:
    plain, with_stress = data(), data("data.solver.stress=true")
    assert (plain.name, with_stress.name) == ("snow", "snow_stress")
    assert "stress" not in plain.as_dict()["solver"]
    assert with_stress.as_dict()["solver"]["stress"] is True


@pytest.mark.parametrize("name", ["snow", "elastomer"])
def test_trajectories_have_the_stress_of_particles(name: str) -> None:
    spec = dataset(f"data={name}", "size=tiny", "data.solver.stress=true")
    found: Trajectory = generate_trajectory(spec, "train", 0, num_frames=6)
    assert found.metadata.with_stress == (name,)
    assert found.stress is not None
    assert not found.stress.node[0].any()
    assert found.stress.cell.shape[1] == (0 if found.cells is None else len(found.cells))
