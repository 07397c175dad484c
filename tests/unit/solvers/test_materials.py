"""The constitutive laws against an independent implementation with a singular value decomposition."""

import math

import numpy as np
import pytest

from gpe_pl.solvers import materials

LAM, MU = materials.lame_parameters(3e5, 0.2)


def respond(deformation, plastic, alpha, code=materials.SAND):
    out = materials.respond(code, *np.ravel(deformation), plastic, alpha, LAM, MU)
    return np.reshape(out[:4], (2, 2)), out[4], np.array([[out[5], out[6]], [out[6], out[7]]])


def reference(deformation, plastic, alpha):
    """Drucker-Prager return mapping of Klar et al. 2016, written with an SVD."""
    u, sigma, vt = np.linalg.svd(deformation)
    strain = np.log(sigma) + plastic / 2
    if strain.sum() >= 0:
        return u @ vt, strain.sum(), np.zeros((2, 2))
    deviator = strain - strain.sum() / 2
    excess = np.linalg.norm(deviator) + (2 * LAM + 2 * MU) / (2 * MU) * strain.sum() * alpha
    if excess > 0:
        strain = strain - excess * deviator / np.linalg.norm(deviator)
    stress = u @ np.diag(2 * MU * strain + LAM * strain.sum()) @ u.T
    return u @ np.diag(np.exp(strain)) @ vt, 0.0, stress


def random_deformation(rng):
    while True:
        deformation = np.eye(2) + rng.uniform(-0.4, 0.4, (2, 2))
        if np.linalg.det(deformation) > 0.1:
            return deformation


@pytest.mark.parametrize("seed", range(4))
def test_equals_svd_reference(seed):
    rng = np.random.default_rng(seed)
    cases = {"tension": 0, "cone": 0}
    for _ in range(200):
        deformation, plastic = random_deformation(rng), max(0.0, rng.uniform(-0.2, 0.2))
        alpha = float(materials.drucker_prager_coefficient(np.array([rng.uniform(0, 45)]), 2)[0])
        expected = reference(deformation, plastic, alpha)
        got = respond(deformation, plastic, alpha)
        cases["tension" if not expected[2].any() else "cone"] += 1
        np.testing.assert_allclose(got[0], expected[0], atol=1e-12)
        np.testing.assert_allclose(got[1], expected[1], atol=1e-12)
        np.testing.assert_allclose(got[2], expected[2], atol=1e-12 * MU)
    assert min(cases.values()) > 20


@pytest.mark.parametrize("angle", [20.0, 30.0, 40.0])
def test_return_mapping_realises_friction_angle(angle):
    """|τ₁ - τ₂| = sin φ |τ₁ + τ₂| on the yield surface in plane strain."""
    alpha = float(materials.drucker_prager_coefficient(np.array([angle]), 2)[0])
    _, _, stress = respond([[0.97, 0.2], [0.0, 0.95]], 0.0, alpha)
    tau = np.linalg.eigvalsh(stress)
    realised = math.degrees(math.asin(abs(tau[0] - tau[1]) / abs(tau[0] + tau[1])))
    assert realised == pytest.approx(angle, abs=1e-6)


def test_elastic_inside_the_cone_keeps_deformation():
    deformation = np.array([[0.99, 0.001], [0.0, 0.99]])
    new, plastic, stress = respond(deformation, 0.0, 0.5)
    np.testing.assert_array_equal(new, deformation)
    assert plastic == 0.0 and stress[0, 0] < 0


def test_small_strain_limit_is_hookes_law():
    strain = 1e-7 * np.array([[-3.0, 0.2], [0.2, -2.0]])
    _, _, stress = respond(np.eye(2) + strain, 0.0, 10.0)
    np.testing.assert_allclose(stress, 2 * MU * strain + LAM * np.trace(strain) * np.eye(2), rtol=1e-5)


def test_volume_is_accounted_for():
    """log det F + v is conserved by the return mapping, in tension, on the cone and inside it."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        deformation, plastic = random_deformation(rng), rng.uniform(0, 0.2)
        new, new_plastic, _ = respond(deformation, plastic, 0.3)
        before, after = math.log(np.linalg.det(deformation)) + plastic, math.log(np.linalg.det(new)) + new_plastic
        assert after == pytest.approx(before, abs=1e-12)


def test_expanded_sand_must_close_before_it_bears_pressure():
    opened, gap, stress = respond(1.1 * np.eye(2), 0.0, 0.3)
    assert gap == pytest.approx(2 * math.log(1.1)) and not stress.any()
    np.testing.assert_allclose(opened, np.eye(2), atol=1e-15)
    _, gap, stress = respond(0.95 * opened, gap, 0.3)
    assert gap == pytest.approx(2 * math.log(1.1 * 0.95)) and not stress.any()


@pytest.mark.parametrize(
    "deformation", [np.zeros((2, 2)), np.diag([1.0, 0.0]), np.array([[1.0, 1.0], [1.0, 1.0]]), -np.eye(2), np.diag([1e-200, 1.0])]
)
def test_degenerate_deformation_gives_finite_stress(deformation):
    new, plastic, stress = respond(deformation, 0.0, 0.3)
    assert np.all(np.isfinite(new)) and np.isfinite(plastic) and np.all(np.isfinite(stress))
    np.testing.assert_array_equal(stress, stress.T)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_not_finite_deformation_is_not_hidden(bad):
    _, _, stress = respond([[bad, 0.0], [0.0, 1.0]], 0.0, 0.3)
    assert not np.all(np.isfinite(stress))


def test_unknown_code_gives_nan():
    assert np.all(np.isnan(respond(np.eye(2), 0.0, 0.3, code=99)[2]))


def test_coefficient_in_three_dimensions_is_triaxial():
    sine = math.sin(math.radians(30))
    assert materials.drucker_prager_coefficient(np.array([30.0]), 3)[0] == pytest.approx(math.sqrt(2 / 3) * 2 * sine / (3 - sine))
