"""Profiles φ(E) against differences, and where the formulas of a general Matérn overflow."""

import numpy as np
import pytest

from skevgp.kernels import periodic, stationary

PROFILES = [
    (stationary.Exponential(), []),
    (stationary.Matern12(), []),
    (stationary.Matern32(), []),
    (stationary.Matern52(), []),
    (stationary.Matern(1.9), []),
    (stationary.RationalQuadratic(), [0.4]),
    (periodic.ExpSineSquared(), [-0.3]),
]


@pytest.mark.parametrize(("profile", "parameters"), PROFILES, ids=str)
def test_derivatives_agree_with_finite_differences(profile, parameters):
    E, parameters, step = -np.geomspace(1e-2, 5.0, 20), np.array(parameters), 1e-6
    assert len(parameters) == profile.n_parameters
    slope, others = profile.derivatives(E.copy(), profile.value(E.copy(), parameters), parameters)
    high, low = profile.value(E * (1.0 - step), parameters), profile.value(E * (1.0 + step), parameters)
    np.testing.assert_allclose(slope, (high - low) / (-2.0 * step * E), rtol=1e-6, atol=1e-9)
    for other, direction in zip(others, np.eye(len(parameters)), strict=True):
        high, low = (profile.value(E.copy(), parameters + sign * step * direction) for sign in (1.0, -1.0))
        np.testing.assert_allclose(other, (high - low) / (2.0 * step), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("profile", "parameters"), PROFILES, ids=str)
def test_a_profile_is_1_at_distance_0(profile, parameters):
    assert profile.value(np.zeros(1), np.array(parameters))[0] == 1.0


@pytest.mark.parametrize(
    ("special", "nu"), [(stationary.Matern12(), 0.5), (stationary.Matern32(), 1.5), (stationary.Matern52(), 2.5)]
)
def test_the_general_matern_has_the_special_ones(special, nu):
    E, none = -np.geomspace(1e-4, 5.0, 20), np.empty(0)
    general = stationary.Matern(nu)
    np.testing.assert_allclose(general.value(E, none), special.value(E, none), rtol=1e-12)
    slopes = (one.derivatives(E, one.value(E, none), none)[0] for one in (general, special))
    np.testing.assert_allclose(next(slopes), next(slopes), rtol=1e-10)


@pytest.mark.parametrize("nu", [30.0, 60.5, 100.0, 150.0])
def test_matern_where_bessel_functions_overflow(nu):
    """1 - ν r² / 2(ν - 1) + ν² r⁴ / 8(ν - 1)(ν - 2) - ..., from exact fractions; scikit-learn's is inf there."""
    r, none = np.array([0.0, 1e-8, 1e-4, 1e-3, 1e-2]), np.empty(0)
    E, profile = -0.5 * r**2, stationary.Matern(nu)
    first, second = nu / (2.0 * (nu - 1.0)), nu**2 / (8.0 * (nu - 1.0) * (nu - 2.0))
    expected = 1.0 - first * r**2 + second * r**4
    np.testing.assert_allclose(profile.value(E, none), expected, rtol=1e-12)
    slope, _ = profile.derivatives(E, expected, none)
    np.testing.assert_allclose(slope, 2.0 * first - 4.0 * second * r**2, rtol=1e-8)
