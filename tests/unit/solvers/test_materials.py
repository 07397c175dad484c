"""The constitutive laws compared with independent implementations with a singular value decomposition, in 2D and 3D."""

import math
from typing import Any

import numpy as np
import pytest

from gpe_pl.solvers import materials
from gpe_pl.solvers.materials import Elastomer, Sand, Snow
from gpe_pl.solvers.mpm import laws_2d, laws_3d

DIMS = (2, 3)
MATERIAL: dict[str, tuple[Any, float]] = {"sand": (Sand(), 30.0), "snow": (Snow(), 10.0), "elastomer": (Elastomer(), 1e5)}
LAM, MU = materials.lame_parameters(3e5, 0.2)


def respond(material, value, deformation, plastic=0.0):
    """Return return-mapped F, plastic state, Kirchhoff stress and stiffness of a material with this parameter."""
    dim = len(deformation)
    constants = material.constants(np.array([value]), dim)
    return by_code(material.law, deformation, plastic, constants)


def by_code(law, deformation, plastic, constants):
    if len(deformation) == 2:
        f00, f01, f10, f11, plastic, t00, t01, t11, stiffness = laws_2d.respond(law, *np.ravel(deformation), plastic, constants, 0)
        return np.array([[f00, f01], [f10, f11]]), plastic, np.array([[t00, t01], [t01, t11]]), stiffness
    f, plastic, t, stiffness = laws_3d.respond(law, tuple(np.ravel(np.asarray(deformation, float))), plastic, constants, 0)
    return np.reshape(f, (3, 3)), plastic, np.array([[t[0], t[1], t[2]], [t[1], t[3], t[4]], [t[2], t[4], t[5]]]), stiffness


def reference_sand(deformation, plastic, alpha):
    """Apply the Drucker-Prager return mapping of Klar et al. 2016, written with an SVD."""
    dim = len(deformation)
    u, sigma, vt = np.linalg.svd(deformation)
    strain = np.log(sigma) + plastic / dim
    if strain.sum() >= 0:
        return u @ vt, strain.sum(), np.zeros((dim, dim))
    deviator = strain - strain.sum() / dim
    excess = np.linalg.norm(deviator) + (dim * LAM + 2 * MU) / (2 * MU) * strain.sum() * alpha
    if excess > 0:
        strain = strain - excess * deviator / np.linalg.norm(deviator)
    stress = u @ np.diag(2 * MU * strain + LAM * strain.sum()) @ u.T
    return u @ np.diag(np.exp(strain)) @ vt, 0.0, stress


def reference_snow(deformation, compaction, snow, xi):
    """Apply fixed-corotated snow of Stomakhin et al. 2013, written with an SVD."""
    u, sigma, vt = np.linalg.svd(deformation)
    kept = np.clip(sigma, 1 - snow.critical_compression, 1 + snow.critical_stretch)
    lam, mu = materials.lame_parameters(snow.youngs_modulus, snow.poisson_ratio)
    factor = min(math.exp(-xi * compaction), snow.max_hardening)
    new, rotation, volume = u @ np.diag(kept) @ vt, u @ vt, np.prod(kept)
    stress = factor * (2 * mu * (new - rotation) @ new.T + lam * (volume - 1) * volume * np.eye(len(new)))
    return new, (1 + compaction) * np.prod(sigma / kept) - 1, stress


def random_deformation(rng, dim, amplitude=0.4):
    while True:
        deformation = np.eye(dim) + rng.uniform(-amplitude, amplitude, (dim, dim))
        if np.linalg.det(deformation) > 0.1:
            return deformation


def special_deformations(dim):
    """Return deformations with repeated and nearly repeated principal stretches, and a rotation."""
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(dim, dim)))
    for stretches in (
        [0.9, 0.9, 0.9],
        [0.9, 0.9, 1.05],
        [0.9, 1.02, 1.02],
        [0.9, 0.9 + 1e-9, 1.05],
        [1.0, 1.0, 1.0],
        [1e-3, 1.0, 1.0],
        [1e-3, 1e-3, 1.0],
    ):
        yield turn @ np.diag(stretches[:dim]) @ turn.T @ turn


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("seed", range(3))
def test_sand_equals_reference(dim, seed):
    rng = np.random.default_rng(seed)
    cases = {"tension": 0, "cone": 0}
    for deformation in (*(random_deformation(rng, dim) for _ in range(200)), *special_deformations(dim)):
        plastic, angle = max(0.0, rng.uniform(-0.2, 0.2)), rng.uniform(0, 45)
        alpha = float(materials.drucker_prager_coefficient(np.array([angle]), dim)[0])
        expected = reference_sand(deformation, plastic, alpha)
        got = respond(Sand(), angle, deformation, plastic)
        cases["tension" if not expected[2].any() else "cone"] += 1
        # up to a rotation from the right, which no isotropic law feels
        np.testing.assert_allclose(got[0] @ got[0].T, expected[0] @ expected[0].T, atol=1e-12)
        np.testing.assert_allclose(got[1], expected[1], atol=1e-12)
        np.testing.assert_allclose(got[2], expected[2], atol=1e-9 * MU)
    assert min(cases.values()) > 20


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("amplitude", [0.01, 0.4])
def test_snow_equals_reference(dim, amplitude):
    rng = np.random.default_rng(0)
    for deformation in (*(random_deformation(rng, dim, amplitude) for _ in range(200)), *special_deformations(dim)):
        compaction, xi = rng.uniform(-0.3, 0.1), rng.uniform(0, 30)
        new, after, stress = reference_snow(deformation, compaction, Snow(), xi)
        got = respond(Snow(), xi, deformation, compaction)
        np.testing.assert_allclose(got[0], new, atol=1e-12)
        np.testing.assert_allclose(got[1], after, atol=1e-12)
        np.testing.assert_allclose(got[2], stress, atol=1e-9 * Snow().youngs_modulus)


@pytest.mark.parametrize("dim", DIMS)
def test_elastomer_is_neo_hookean(dim):
    """τ = μ (F Fᵀ - I) + λ log(det F) I."""
    rng = np.random.default_rng(0)
    lam, mu = materials.lame_parameters(1e5, 0.3)
    for deformation in (*(random_deformation(rng, dim) for _ in range(200)), *special_deformations(dim)):
        new, plastic, stress, _ = respond(Elastomer(), 1e5, deformation)
        expected = mu * (deformation @ deformation.T - np.eye(dim)) + lam * np.log(abs(np.linalg.det(deformation))) * np.eye(dim)
        np.testing.assert_array_equal(new, deformation)
        assert plastic == 0.0
        np.testing.assert_allclose(stress, expected, atol=1e-10 * mu)


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("name", MATERIAL)
def test_small_strain_limit_is_hookes_law(dim, name):
    material, value = MATERIAL[name]
    strain = 1e-7 * np.array([[-3.0, 0.2, 0.1], [0.2, -2.0, 0.3], [0.1, 0.3, -2.5]])[:dim, :dim]
    _, _, stress, stiffness = respond(material, 60.0 if name == "sand" else value, np.eye(dim) + strain)
    lam, mu = materials.lame_parameters(value if name == "elastomer" else material.youngs_modulus, material.poisson_ratio)
    np.testing.assert_allclose(stress, 2 * mu * strain + lam * np.trace(strain) * np.eye(dim), rtol=1e-5)
    assert stiffness == pytest.approx(lam + 2 * mu, rel=1e-5)


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("name", MATERIAL)
def test_stress_is_objective(dim, name):
    """τ(Q F) = Q τ(F) Qᵀ."""
    material, value = MATERIAL[name]
    rng = np.random.default_rng(0)
    for _ in range(20):
        deformation, (turn, _) = 0.9 * random_deformation(rng, dim, 0.2), np.linalg.qr(rng.normal(size=(dim, dim)))
        stress, turned = respond(material, value, deformation)[2], respond(material, value, turn @ deformation)[2]
        np.testing.assert_allclose(turned, turn @ stress @ turn.T, atol=1e-11 * max(1.0, np.abs(stress).max()))


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("name", MATERIAL)
def test_stiffness_is_not_less_than_the_second_derivative_of_the_energy(dim, name):
    """Along each principal axis: ∂τᵢ/∂(log σᵢ) - τᵢ of the elastic response, by central differences, with a factor of 1 + 1e-6 for them."""
    material, value = MATERIAL[name]
    rng = np.random.default_rng(0)
    for _ in range(100):
        stretches = rng.uniform(0.976, 1.007, dim) if name != "elastomer" else np.exp(rng.uniform(-2, 2, dim))
        if name == "sand":
            stretches = np.full(dim, rng.uniform(0.2, 0.9)) * rng.uniform(0.999, 1.001, dim)  # inside the cone
        _, _, stress, stiffness = respond(material, value, np.diag(stretches))
        for axis in range(dim):
            step = np.ones(dim)
            step[axis] = math.exp(1e-5)
            up, down = (respond(material, value, np.diag(s))[2][axis, axis] for s in (stretches * step, stretches / step))
            assert stiffness * (1 + 1e-6) >= (up - down) / 2e-5 - stress[axis, axis]


@pytest.mark.parametrize("dim", DIMS)
def test_hardening_is_exponential_and_bounded(dim):
    """The moduli grow by exp(ξ (1 - J_P)), at most by max_hardening; loosened snow softens, but not the stiffness that chooses substeps."""
    deformation = 0.99 * np.eye(dim)
    rest = respond(Snow(), 10.0, deformation, 0.0)
    for compaction, factor in ((-0.1, math.exp(1.0)), (-0.9, 20.0), (0.1, math.exp(-1.0))):
        _, kept, stress, stiffness = respond(Snow(), 10.0, deformation, compaction)
        assert kept == compaction
        np.testing.assert_allclose(stress, factor * rest[2], rtol=1e-12)
        assert stiffness == pytest.approx(max(1.0, factor) * rest[3], rel=1e-12)


@pytest.mark.parametrize("angle", [20.0, 30.0, 40.0])
def test_return_mapping_realises_friction_angle(angle):
    """|τ₁ - τ₂| = sin φ |τ₁ + τ₂| on the yield surface in plane strain."""
    _, _, stress, _ = respond(Sand(), angle, [[0.97, 0.2], [0.0, 0.95]])
    tau = np.linalg.eigvalsh(stress)
    realised = math.degrees(math.asin(abs(tau[0] - tau[1]) / abs(tau[0] + tau[1])))
    assert realised == pytest.approx(angle, abs=1e-6)


@pytest.mark.parametrize("angle", [20.0, 30.0, 40.0])
def test_return_mapping_realises_friction_angle_in_triaxial_compression(angle):
    """In 3D, with two equal principal stresses larger than the third, τ_max - τ_min = sin φ |τ_max + τ_min|."""
    _, _, stress, _ = respond(Sand(), angle, np.diag([0.8, 1.02, 1.02]))
    tau = np.linalg.eigvalsh(stress)
    realised = math.degrees(math.asin(abs(tau[2] - tau[0]) / abs(tau[2] + tau[0])))
    assert tau[1] == pytest.approx(tau[2], rel=1e-9)
    assert realised == pytest.approx(angle, abs=1e-6)


@pytest.mark.parametrize("dim", DIMS)
def test_elastic_inside_the_cone_keeps_deformation(dim):
    deformation = 0.99 * np.eye(dim)
    deformation[0, 1] = 0.001
    new, plastic, stress, _ = respond(Sand(), 40.0, deformation)
    np.testing.assert_array_equal(new, deformation)
    assert plastic == 0.0 and stress[0, 0] < 0


@pytest.mark.parametrize("dim", DIMS)
def test_volume_is_accounted_for(dim):
    """Sand: log det F + v is conserved by the return mapping, in tension, on the cone and inside it. Snow: det F J_P is."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        deformation, plastic = random_deformation(rng, dim), rng.uniform(0, 0.2)
        new, new_plastic, _, _ = respond(Sand(), 20.0, deformation, plastic)
        before, after = math.log(np.linalg.det(deformation)) + plastic, math.log(np.linalg.det(new)) + new_plastic
        assert after == pytest.approx(before, abs=1e-12)
        new, new_plastic, _, _ = respond(Snow(), 20.0, deformation, -plastic)
        assert np.linalg.det(new) * (1 + new_plastic) == pytest.approx(np.linalg.det(deformation) * (1 - plastic), rel=1e-12)


@pytest.mark.parametrize("dim", DIMS)
def test_expanded_sand_must_close_before_it_bears_pressure(dim):
    opened, gap, stress, _ = respond(Sand(), 30.0, 1.1 * np.eye(dim))
    assert gap == pytest.approx(dim * math.log(1.1)) and not stress.any()
    np.testing.assert_allclose(opened, np.eye(dim), atol=1e-15)
    _, gap, stress, _ = respond(Sand(), 30.0, 0.95 * opened, gap)
    assert gap == pytest.approx(dim * math.log(1.1 * 0.95)) and not stress.any()


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("name", MATERIAL)
@pytest.mark.parametrize("stretches", [(0, 0, 0), (1, 0, 1), (1, 1, 0), (-1, -1, -1), (1, -1, 1), (1e-200, 1, 1e-200), (1e3, 1e-9, 1)])
def test_degenerate_deformation_gives_finite_stress(dim, name, stretches):
    material, value = MATERIAL[name]
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(dim, dim)))
    for deformation in (np.diag(stretches[:dim]).astype(float), turn @ np.diag(stretches[:dim]), np.full((dim, dim), float(stretches[0]))):
        new, plastic, stress, stiffness = respond(material, value, deformation)
        assert np.all(np.isfinite(new)) and np.isfinite(plastic) and np.all(np.isfinite(stress)) and np.isfinite(stiffness)
        assert np.linalg.svd(new, compute_uv=False).min() > 0.99e-4


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("name", MATERIAL)
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_not_finite_deformation_is_not_hidden(dim, name, bad):
    material, value = MATERIAL[name]
    deformation = np.eye(dim)
    deformation[0, 0] = bad
    new, plastic, stress, _ = respond(material, value, deformation)
    assert not np.all(np.isfinite([*new.ravel(), *stress.ravel(), plastic]))


@pytest.mark.parametrize("dim", DIMS)
def test_unknown_code_gives_nan(dim):
    constants = Sand().constants(np.array([30.0]), dim)
    assert np.all(np.isnan(by_code(99, np.eye(dim), 0.0, constants)[2]))


@pytest.mark.parametrize("kind", ["random", "near identity", "double", "needle", "flat", "diagonal", "isotropic", "tiny", "huge"])
def test_spectral_decomposition(kind):
    """Axes are orthonormal and rebuild the tensor to rounding, whatever the multiplicity of the principal values."""
    rng = np.random.default_rng(0)
    values = {
        "random": lambda: rng.uniform(0.1, 2, 3),
        "near identity": lambda: 1 + 1e-3 * rng.normal(size=3),
        "double": lambda: np.array([1.0, 1.0, rng.uniform(0.5, 2)]),
        "needle": lambda: np.array([1.0, 1e-6, rng.uniform(1e-6, 2e-6)]),
        "flat": lambda: np.array([1.0, rng.uniform(0.5, 1), 1e-9]),
        "diagonal": lambda: rng.uniform(0.5, 2, 3),
        "isotropic": lambda: 1 + 1e-15 * rng.normal(size=3),
        "tiny": lambda: 1e-12 * rng.uniform(1, 2, 3),
        "huge": lambda: 1e60 * rng.uniform(1, 2, 3),
    }[kind]
    for _ in range(300):
        axes = np.eye(3) if kind == "diagonal" else np.linalg.qr(rng.normal(size=(3, 3)))[0]
        tensor = axes @ np.diag(values()) @ axes.T
        tensor = (tensor + tensor.T) / 2
        got, rows = laws_3d.spectral(tuple(tensor[np.triu_indices(3)]))
        found = np.reshape(rows, (3, 3))
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=4e-15)
        np.testing.assert_allclose(found.T @ np.diag(got) @ found, tensor, atol=4e-15 * np.abs(tensor).max())


def test_coefficient_in_three_dimensions_is_triaxial():
    sine = math.sin(math.radians(30))
    assert materials.drucker_prager_coefficient(np.array([30.0]), 3)[0] == pytest.approx(math.sqrt(2 / 3) * 2 * sine / (3 - sine))
