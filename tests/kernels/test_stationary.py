"""Functions of a scaled distance: what is theirs alone; the rest is in `test_contract`."""

import numpy as np
import pytest
from sklearn.gaussian_process import kernels as sk

from skevgp.kernels.parse import parse_kernel
from skevgp.kernels.periodic import ExpSineSquared
from skevgp.kernels.stationary import (
    Exponential,
    Matern,
    Matern12,
    Matern32,
    Matern52,
    RationalQuadratic,
    SquaredExponential,
    Stationary,
)

from .cases import X, Z, pulled_back, random_bars


def test_profile_of_the_general_class_is_the_squared_exponential():
    hyperparameters = np.array([0.8, 1.4])
    special, general = SquaredExponential(2), Stationary(Exponential(), 2)
    bars = random_bars(7, 40)
    for one, other in zip(
        pulled_back(special, hyperparameters, Z, X, bars),
        pulled_back(general, hyperparameters, Z, X, bars),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_coincident_points_have_covariance_one_at_most():
    kernel = SquaredExponential(2)
    at = kernel.at(np.array([1e-3, 1e-3]), 1e3 * X)
    U = at.cross(kernel.prepare(1e3 * X))
    assert U.max() <= 1.0
    np.testing.assert_allclose(np.diag(U), 1.0, atol=0.05)


def test_length_scales_must_fit_the_columns():
    with pytest.raises(ValueError, match="3 length scales, but its inputs have 2 columns"):
        parse_kernel(sk.RBF([1.0, 2.0, 3.0]), 2)


@pytest.mark.parametrize(
    ("nu", "message"),
    [(-1.0, "nu must be above 0"), (np.nan, "nu must be above 0"), (1000.0, "at most 150, or inf; got 1000.0")],
)
def test_nu_out_of_range_raises(nu, message):
    with pytest.raises(ValueError, match=message):
        parse_kernel(sk.Matern(nu=nu), 2)


# --- profiles φ(E): against differences, and where the formulas of a general Matérn overflow -----------------------

PROFILES = [
    (Exponential(), []),
    (Matern12(), []),
    (Matern32(), []),
    (Matern52(), []),
    (Matern(1.9), []),
    (RationalQuadratic(), [1.5]),
    (ExpSineSquared(), [0.7]),
]


@pytest.mark.parametrize(("profile", "parameters"), PROFILES, ids=str)
def test_derivatives_agree_with_finite_differences(profile, parameters):
    E, parameters, step = -np.geomspace(1e-2, 5.0, 20), np.array(parameters), 1e-6
    assert len(parameters) == profile.n_parameters
    slope, others = profile.derivatives(E.copy(), profile.value(E.copy(), parameters), parameters)
    high, low = profile.value(E * (1.0 - step), parameters), profile.value(E * (1.0 + step), parameters)
    np.testing.assert_allclose(slope, (high - low) / (-2.0 * step * E), rtol=1e-6, atol=1e-9)
    for other, direction in zip(others, np.eye(len(parameters)), strict=True):
        # The derivative is that in the logarithm of the parameter.
        high, low = (profile.value(E.copy(), parameters * np.exp(sign * step * direction)) for sign in (1.0, -1.0))
        np.testing.assert_allclose(other, (high - low) / (2.0 * step), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("special", "nu"), [(Matern12(), 0.5), (Matern32(), 1.5), (Matern52(), 2.5)])
def test_general_matern_has_the_special_ones(special, nu):
    E, none = -np.geomspace(1e-4, 5.0, 20), np.empty(0)
    general = Matern(nu)
    np.testing.assert_allclose(general.value(E, none), special.value(E, none), rtol=1e-12)
    slopes = (one.derivatives(E, one.value(E, none), none)[0] for one in (general, special))
    np.testing.assert_allclose(next(slopes), next(slopes), rtol=1e-10)


@pytest.mark.parametrize("nu", [30.0, 60.5, 100.0, 150.0])
def test_matern_where_bessel_functions_overflow(nu):
    """1 - ν r² / 2(ν - 1) + ν² r⁴ / 8(ν - 1)(ν - 2) - ..., from exact fractions; scikit-learn's is inf there."""
    r, none = np.array([0.0, 1e-8, 1e-4, 1e-3, 1e-2]), np.empty(0)
    E, profile = -0.5 * r**2, Matern(nu)
    first, second = nu / (2.0 * (nu - 1.0)), nu**2 / (8.0 * (nu - 1.0) * (nu - 2.0))
    expected = 1.0 - first * r**2 + second * r**4
    np.testing.assert_allclose(profile.value(E, none), expected, rtol=1e-12)
    slope, _ = profile.derivatives(E, expected, none)
    np.testing.assert_allclose(slope, 2.0 * first - 4.0 * second * r**2, rtol=1e-8)
