"""The constitutive laws compared with independent implementations with a singular value decomposition, in 2D and 3D."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from gpe_pl.schema import parameters_by_name
from gpe_pl.solvers import materials
from gpe_pl.solvers.materials import Elastomer, Sand, Snow
from gpe_pl.solvers.mpm import laws_2d, laws_3d

DIMS = (2, 3)
MATERIAL: dict[str, tuple[Any, float]] = {"sand": (Sand(), 30.0), "snow": (Snow(), 10.0), "elastomer": (Elastomer(), 1e5)}
LAM, MU = materials.lame_parameters(3e5, 0.2)


def respond(material, value, deformation, plastic=0.0):
    """Return return-mapped F, plastic state, Kirchhoff stress and stiffness of a material with this first parameter, or these by name."""
    dim = len(deformation)
    constants = material.constants(parameters(material, value), dim)
    return by_code(material.law, deformation, plastic, constants)


def parameters(material, value):
    """Return the parameters of one particle as the solver passes them."""
    return {name: np.array([number]) for name, number in parameters_by_name(type(material).__name__.lower(), value).items()}


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


@pytest.mark.slow
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
    constants = Sand().constants(parameters(Sand(), 30.0), dim)
    assert np.all(np.isnan(by_code(99, np.eye(dim), 0.0, constants)[2]))


@pytest.mark.slow
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


COHESIVE = [{"friction_angle": angle, "cohesion": cohesion} for angle, cohesion in ((30.0, 1e3), (15.0, 200.0), (40.0, 5e3))]


def cohesive_reference(deformation, plastic, friction_angle, cohesion):
    """Apply the return mapping to the cone with its tip in tension, written with an SVD in stresses."""
    dim, angle = len(deformation), math.radians(friction_angle)
    alpha = float(materials.drucker_prager_coefficient(np.array([friction_angle]), dim)[0])
    tip = cohesion / math.tan(angle)  # mean stress
    u, sigma, vt = np.linalg.svd(deformation)
    strain = np.log(sigma) + plastic / dim
    bulk = LAM + 2 * MU / dim
    if bulk * strain.sum() >= tip:
        return u @ vt * math.exp(tip / bulk / dim), strain.sum() - tip / bulk, tip * np.eye(dim)
    mean, deviator = bulk * strain.sum(), 2 * MU * (strain - strain.sum() / dim)
    allowed = alpha * dim * (tip - mean)
    deviator *= min(1.0, allowed / np.linalg.norm(deviator))
    stress = mean + deviator
    strain = deviator / (2 * MU) + strain.sum() / dim
    return u @ np.diag(np.exp(strain)) @ vt, 0.0, u @ np.diag(stress) @ u.T


@pytest.mark.slow
@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("values", COHESIVE)
def test_sand_with_cohesion_equals_reference(dim, values):
    rng, tips = np.random.default_rng(0), 0
    for _ in range(200):
        deformation, plastic = random_deformation(rng, dim, rng.choice([0.01, 0.1])), max(0.0, rng.uniform(-0.05, 0.02))
        expected, got = cohesive_reference(deformation, plastic, **values), respond(Sand(), values, deformation, plastic)
        tips += expected[1] != 0
        np.testing.assert_allclose(got[0] @ got[0].T, expected[0] @ expected[0].T, atol=1e-12)
        np.testing.assert_allclose(got[1], expected[1], atol=1e-12)
        np.testing.assert_allclose(got[2], expected[2], atol=1e-9 * MU)
    assert 20 < tips < 180


@pytest.mark.parametrize("dim", DIMS)
def test_sand_without_cohesion_is_dry_sand(dim):
    rng = np.random.default_rng(0)
    for angle in (0.0, 30.0):
        for _ in range(50):
            deformation, plastic = random_deformation(rng, dim), max(0.0, rng.uniform(-0.2, 0.2))
            dry = respond(Sand(), angle, deformation, plastic)
            for one, other in zip(dry, respond(Sand(), {"friction_angle": angle, "cohesion": 0.0}, deformation, plastic), strict=True):
                np.testing.assert_array_equal(one, other)


def compressed(material, values, dim, num_steps, step):
    """Return the stress along the last axis and the lateral strains of one particle that is compressed with free sides."""
    elastic, plastic, stretch = np.eye(dim), 0.0, np.ones(dim)

    def trial(lateral):
        return respond(material, values, np.diag([1 + lateral] * (dim - 1) + [1 - step]) @ elastic, plastic)

    for _ in range(num_steps):
        lateral = brentq(lambda x: trial(x)[2][0, 0], -step, 20 * step, xtol=1e-16, rtol=1e-14)
        elastic, plastic, stress, _ = trial(lateral)
        stretch *= [1 + lateral] * (dim - 1) + [1 - step]
    return stress[-1, -1], np.log(stretch)


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("values", COHESIVE)
def test_unconfined_compressive_strength_is_that_of_mohr_coulomb(dim, values):
    """A particle with free sides yields at ``2 c cos φ / (1 - sin φ)``, in plane strain and in triaxial compression."""
    angle, cohesion = math.radians(values["friction_angle"]), values["cohesion"]
    strength = 2 * cohesion * math.cos(angle) / (1 - math.sin(angle))
    before, _ = compressed(Sand(), values, dim, 5, 0.1 * strength / 3e5)
    after, _ = compressed(Sand(), values, dim, 40, 0.1 * strength / 3e5)
    assert -before < 0.9 * strength and -after == pytest.approx(strength, rel=1e-6)


@pytest.mark.parametrize("dim", DIMS)
def test_cohesion_bears_the_isotropic_tension_of_its_tip(dim):
    stress = respond(Sand(), COHESIVE[0], 1.5 * np.eye(dim))[2]
    np.testing.assert_allclose(stress, 1e3 / math.tan(math.radians(30)) * np.eye(dim), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("dim", DIMS)
def test_cohesion_without_friction_is_a_cylinder(dim):
    """Without friction the deviator is bounded by ``√2 c`` (in plane strain) at any mean stress, and tension has no bound."""
    values = {"friction_angle": 0.0, "cohesion": 1e3}
    bound = math.sqrt(2) * 1e3 if dim == 2 else math.sqrt(2 / 3) * 2e3
    for volume in (0.9, 1.1):
        stress = respond(Sand(), values, volume * np.diag([1.05, 0.97, 1.0][:dim]))[2]
        mean = np.trace(stress) / dim
        assert np.linalg.norm(stress - mean * np.eye(dim)) == pytest.approx(bound, rel=1e-9)
        assert mean == pytest.approx((LAM + 2 * MU / dim) * math.log(volume**dim * 1.05 * 0.97), rel=1e-9)


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("ratio", [0.0, 0.2, 0.45])
def test_an_elastomer_contracts_by_its_poisson_ratio(dim, ratio):
    """Uniaxial stress: lateral strain over axial strain is -ν, and in plane strain -ν / (1 - ν); the modulus is E, and E / (1 - ν²)."""
    stress, strain = compressed(Elastomer(), {"youngs_modulus": 1e5, "poisson_ratio": ratio}, dim, 1, 1e-6)
    assert -strain[0] / strain[-1] == pytest.approx(ratio if dim == 3 else ratio / (1 - ratio), abs=1e-5)
    assert stress / strain[-1] == pytest.approx(1e5 if dim == 3 else 1e5 / (1 - ratio**2), rel=1e-5)


@pytest.mark.parametrize("dim", DIMS)
def test_snow_yields_at_its_own_critical_strains(dim):
    for compression, stretch in ((0.1, 0.02), (0.01, 0.1)):
        values = {"hardening_coefficient": 10.0, "critical_compression": compression, "critical_stretch": stretch}
        for change, limit in ((-0.05, compression), (0.05, stretch)):
            new, plastic, _, _ = respond(Snow(), values, np.diag([1 + change] + [1.0] * (dim - 1)))
            assert abs(new[0, 0] - 1) == pytest.approx(min(0.05, limit)) and (plastic != 0) == (limit < 0.05)
