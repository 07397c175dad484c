"""Deformation after the best rigid motion, and strain energy, against formulas and the finite element solver."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.metrics.deformation import body_motion, rotation_angle, strain_energy
from gpe_pl.schema import node_code
from gpe_pl.solvers.fem import FEM
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.strain import lame_parameters, shape_gradients
from gpe_pl.trajectory.trajectory import Trajectory

MODULUS, POISSON_RATIO = 1e6, 0.35


def turn(angle: float, dim: int) -> np.ndarray:
    """Return a rotation by an angle [deg], in 3D about an axis that is no coordinate axis."""
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    if dim == 2:
        return np.array([[c, -s], [s, c]])
    axis = np.array([1.0, -2.0, 0.5]) / np.linalg.norm([1.0, -2.0, 0.5])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + s * cross + (1 - c) * cross @ cross


def lattice(*counts: int) -> np.ndarray:
    """Return nodes one unit apart around the origin."""
    axes = [np.arange(n) - (n - 1) / 2 for n in counts]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(counts))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("angle", [0.0, 1e-5, 30.0, 90.0, 179.0])
def test_a_rigid_motion_is_no_deformation(dim: int, angle: float) -> None:
    rng = np.random.default_rng(0)
    rest, mass = 1e-3 * rng.normal(size=(40, dim)), rng.uniform(0.5, 2.0, 40)
    motion = body_motion(rest, (rest @ turn(angle, dim).T + 3.0)[None], mass)
    assert motion.rms_deformation[0] < 1e-14
    np.testing.assert_allclose(motion.rotation[0], turn(angle, dim), atol=1e-11)
    assert motion.tilt[0] == pytest.approx(angle, abs=1e-9)


def test_shear_leaves_what_the_polar_decomposition_leaves() -> None:
    """On a square lattice Σ X Xᵀ = c I, so the rms deformation is √(c Σ (σ - 1)²) with σ the principal stretches."""
    rest, shear = lattice(9, 9), 0.4
    deformed = rest @ np.array([[1.0, shear], [0.0, 1.0]]).T @ turn(20.0, 2).T
    stretches = math.sqrt(1 + shear**2 / 4) + shear / 2, math.sqrt(1 + shear**2 / 4) - shear / 2
    motion = body_motion(rest, deformed[None], np.ones(81))
    spread = (rest[:, 0] ** 2).mean()
    assert motion.rms_deformation[0] == pytest.approx(math.sqrt(spread * sum((s - 1) ** 2 for s in stretches)))
    assert motion.tilt[0] == pytest.approx(20.0 - math.degrees(math.atan(shear / 2)))


@pytest.mark.parametrize("counts", [(7, 3), (6, 3, 2)])
def test_the_field_of_a_stretched_and_turned_body_is_in_its_own_frame(counts: tuple[int, ...]) -> None:
    rest, dim = lattice(*counts), len(counts)
    motion = body_motion(rest, (rest * ([1.1] + [1.0] * (dim - 1)) @ turn(75.0, dim).T)[None] + 1.0, np.ones(len(rest)))
    np.testing.assert_allclose(motion.field[0], 0.1 * rest * ([1.0] + [0.0] * (dim - 1)), atol=1e-12)


def test_a_bent_beam_deviates_by_its_deflection() -> None:
    """Small curvature κ: the deflection is κ (x² - ⟨x²⟩)/2, the rest is of second order."""
    rest, curvature = lattice(41, 3), 1e-4
    angle, radius = curvature * rest[:, 0], 1 / curvature - rest[:, 1]
    bent = np.stack([radius * np.sin(angle), 1 / curvature - radius * np.cos(angle)], axis=-1)
    deflection = curvature / 2 * (rest[:, 0] ** 2 - (rest[:, 0] ** 2).mean())
    motion = body_motion(rest, bent[None] @ turn(33.0, 2).T, np.ones(len(rest)))
    assert motion.rms_deformation[0] == pytest.approx(math.sqrt((deflection**2).mean()), rel=0.02)
    assert np.corrcoef(motion.field[0, :, 1], deflection)[0, 1] > 0.999


def test_heavy_nodes_count_more() -> None:
    rest = lattice(5, 5)
    pos = rest.copy()
    pos[12] += 0.3  # the node in the middle, which turns nothing
    light, heavy = np.ones(25), np.ones(25)
    heavy[12] = 24.0
    for mass in (light, heavy):
        fraction = mass[12] / mass.sum()
        expected = 0.3 * math.sqrt(2) * math.sqrt(fraction * (1 - fraction))
        assert body_motion(rest, pos[None], mass).rms_deformation[0] == pytest.approx(expected)


def test_a_mirror_image_is_deformed() -> None:
    """No proper rotation maps a body on its mirror image; the best one is wrong along the thinnest axis."""
    for counts in ((9, 4), (7, 5, 3)):
        rest = lattice(*counts)
        motion = body_motion(rest, (rest * ([-1.0] + [1.0] * (len(counts) - 1)))[None], np.ones(len(rest)))
        assert motion.rms_deformation[0] == pytest.approx(2 * math.sqrt((rest[:, -1] ** 2).mean()))
        assert np.linalg.det(motion.rotation[0]) == pytest.approx(1.0)


def test_broken_and_collapsed_frames() -> None:
    rest = lattice(4, 3)
    frames = np.stack([rest, np.zeros_like(rest), rest + 1.0])
    frames[2, 5, 0] = np.inf
    motion = body_motion(rest, frames, np.ones(12))
    assert motion.rms_deformation[1] == pytest.approx(math.sqrt((rest**2).sum(axis=1).mean()))
    assert np.isfinite(motion.tilt[:2]).all() and np.isnan(motion.rms_deformation[2]) and np.isnan(motion.tilt[2])


def test_angles_add_in_one_plane() -> None:
    np.testing.assert_allclose(rotation_angle((turn(-20.0, 3) @ turn(-35.0, 3))[None]), [55.0])


def mesh(kind: str) -> tuple[np.ndarray, np.ndarray, int]:
    """Return rest positions, cells and dimension of a distorted block."""
    dim = 2 if kind in ("triangle", "quadrilateral", "mixed") else 3
    rest = lattice(*[3] * dim)
    rest += 0.1 * np.random.default_rng(1).uniform(-1, 1, rest.shape)
    number = np.arange(3**dim).reshape([3] * dim)
    square = [(0, 0), (1, 0), (1, 1), (0, 1)]
    if dim == 2:
        quads = np.array([[number[i + a, j + b] for a, b in square] for i in range(2) for j in range(2)])
        triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        mixed = np.concatenate([quads[:2], triangles[2:4][:, [0, 1, 2, 2]], triangles[6:8][:, [0, 1, 2, 2]]])
        return rest, {"triangle": triangles, "quadrilateral": quads, "mixed": mixed}[kind], dim
    blocks = [(i, j, k) for i in range(2) for j in range(2) for k in range(2)]
    hexahedra = np.array([[number[i + a, j + b, k + c] for c in (0, 1) for a, b in square] for i, j, k in blocks])
    around = [0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]
    return rest, hexahedra if kind == "hexahedron" else np.concatenate([hexahedra[:, list(corners)] for corners in around]), dim


def body(kind: str, frames: np.ndarray, config: str | None = None, modulus: float | np.ndarray = MODULUS) -> Trajectory:
    rest, cells, dim = mesh(kind)
    pos = np.concatenate([frames, np.repeat(frames[-1:], 3, axis=0)])  # at least three
    given = {"quadrilateral": cells[:2], "triangle": cells[2:, :3]} if kind == "mixed" else {kind: cells}
    made = Trajectory.from_numpy(pos, 0.1, "solid", {"solid": modulus}, cells=given, rest_pos=rest, spacing=1.0, bounds=((-9, 9),) * dim)
    config = json.dumps({"solver": {"poisson_ratio": POISSON_RATIO}}) if config is None else config
    return replace(made, metadata=replace(made.metadata, config=config))


def energy_of(trajectory: Trajectory) -> np.ndarray:
    energy = strain_energy(trajectory)
    assert energy is not None
    return energy


KINDS = ["triangle", "quadrilateral", "mixed", "tetrahedron", "hexahedron"]


@pytest.mark.parametrize("kind", KINDS)
def test_the_energy_of_a_homogeneous_deformation(kind: str) -> None:
    """The energy is Ψ(F) times the volume at rest for every kind of cell, and does not change when the body moves rigidly."""
    rest, _, dim = mesh(kind)
    deformation = np.eye(dim) + 0.3 * np.random.default_rng(2).uniform(-1, 1, (dim, dim))
    frames = np.stack([rest, rest @ deformation.T, rest @ deformation.T @ turn(50.0, dim).T + 2.0])
    energy = energy_of(body(kind, frames))
    lam, mu = MODULUS * POISSON_RATIO / (1 + POISSON_RATIO) / (1 - 2 * POISSON_RATIO), MODULUS / 2 / (1 + POISSON_RATIO)
    log = math.log(np.linalg.det(deformation))
    density = mu / 2 * ((deformation**2).sum() - dim) - mu * log + lam / 2 * log**2
    simplices = mesh("triangle" if dim == 2 else "tetrahedron")[1]
    edges = rest[simplices][:, 1:] - rest[simplices][:, :1]
    volume = (np.linalg.det(edges) / math.factorial(dim)).sum()
    # the faces of hexahedra are bilinear, not split into triangles
    volume = shape_gradients(rest[mesh(kind)[1]])[1].sum() if kind == "hexahedron" else volume
    np.testing.assert_allclose(energy[:3], [0.0, density * volume, density * volume], rtol=1e-12, atol=1e-6)


@pytest.mark.parametrize("kind", ["triangle", "quadrilateral", "tetrahedron"])
@pytest.mark.parametrize("factor", [1.2, 0.1, 0.0, -1.0])
def test_the_energy_is_that_of_the_finite_element_solver(kind: str, factor: float) -> None:
    """This also holds for crushed and inverted cells, and for a stiffness that varies from node to node."""
    rest, cells, dim = mesh(kind)
    pos = rest * ([factor] + [1.0] * (dim - 1)) + 0.05 * np.random.default_rng(3).normal(size=rest.shape)
    modulus = MODULUS * np.linspace(1, 2, len(rest))
    found = energy_of(body(kind, pos[None], modulus=modulus))
    state = State(
        pos, np.zeros_like(pos), np.full(len(pos), node_code("solid"), np.uint8), np.ones(len(pos)), modulus[:, None],
        Boundary.empty(dim), np.zeros(dim), rest_pos=rest, cells=cells,
    )  # fmt: skip
    assert np.isfinite(found).all()
    assert found[0] == pytest.approx(FEM(bounds=((-9.0, 9.0),) * dim, poisson_ratio=POISSON_RATIO).energy(state), rel=1e-6)


@pytest.mark.parametrize("kind", ["triangle", "hexahedron"])
def test_crushing_a_body_further_takes_ever_more_energy(kind: str) -> None:
    """The energy goes on with the slope that it has at the smallest ratio, also where cells are inverted."""
    rest, _, dim = mesh(kind)
    factors = np.array([0.3, 0.2, 0.1, 0.0, -0.5, -1.0])
    energy = energy_of(body(kind, np.stack([rest * ([factor] + [1.0] * (dim - 1)) for factor in factors])))[: len(factors)]
    assert np.isfinite(energy).all() and (np.diff(energy) > 0).all()


def test_the_order_of_corners_does_not_matter() -> None:
    rest, cells, _ = mesh("triangle")
    trajectory = body("triangle", np.stack([rest, 1.1 * rest]))
    reverse = replace(trajectory, cells=cells[:, [0, 2, 1]])
    np.testing.assert_allclose(energy_of(reverse), energy_of(trajectory), atol=1e-9)


def test_poissons_ratio_may_vary_from_node_to_node() -> None:
    """A column of the material parameters comes before the settings of the solver; a cell takes the mean over its corners."""
    rest, cells, _ = mesh("triangle")
    trajectory = body("triangle", 1.1 * rest[None])
    metadata = replace(trajectory.metadata, param_names=("youngs_modulus", "poisson_ratio"))
    ratio = np.linspace(0.1, 0.4, len(rest))
    varied = replace(trajectory, metadata=metadata, material_params=np.stack([np.full(len(rest), MODULUS), ratio], axis=-1))
    single = [
        energy_of(body("triangle", 1.1 * rest[None], json.dumps({"solver": {"poisson_ratio": r}})))[0] for r in ratio[cells].mean(axis=1)
    ]
    areas = np.linalg.det(rest[cells][:, 1:] - rest[cells][:, :1])
    assert energy_of(varied)[0] == pytest.approx((np.array(single) * areas).sum() / areas.sum())


@pytest.mark.parametrize("config", ["{}", "[1]", "not JSON", '{"solver": 3}', '{"solver": {"poisson_ratio": null}}'])
def test_no_energy_without_poissons_ratio(config: str) -> None:
    assert strain_energy(body("triangle", mesh("triangle")[0][None], config)) is None


def test_no_energy_of_surfaces_and_particles() -> None:
    shell = np.concatenate([mesh("triangle")[0], np.zeros((9, 1))], axis=1)
    frames = np.repeat(shell[None], 3, axis=0)
    made = Trajectory.from_numpy(frames, 0.1, "solid", {"solid": MODULUS}, cells={"triangle": mesh("triangle")[1]})
    assert strain_energy(replace(made, metadata=replace(made.metadata, config='{"solver": {"poisson_ratio": 0.3}}'))) is None
    assert strain_energy(Trajectory.from_numpy(frames, 0.1, "sand", {"sand": 30.0})) is None


def test_the_elastomers_poisson_ratio_is_that_of_its_material() -> None:
    rest, _, _ = mesh("triangle")
    config = json.dumps({"solver": {"elastomer": {"poisson_ratio": POISSON_RATIO}, "sand": {"poisson_ratio": 0.1}}})
    solid = body("triangle", np.stack([rest, 1.1 * rest]))
    rubber = replace(
        solid,
        node_type=np.full_like(solid.node_type, node_code("elastomer")),
        metadata=replace(solid.metadata, materials=("elastomer",), config=config),
    )
    np.testing.assert_allclose(energy_of(rubber), energy_of(solid), atol=1e-9)
    lam, mu = lame_parameters(MODULUS, POISSON_RATIO)
    area = 4.0
    assert energy_of(replace(rubber, pos=rest[None] * 1.0001))[0] == pytest.approx(2 * (lam + mu) * 1e-8 * area, rel=0.2)
