"""Functions of a scaled distance: what is theirs alone; the rest is in `test_contract`."""

import numpy as np
import pytest
from sklearn.gaussian_process import kernels as sk

from skevgp.kernels.parse import parse_kernel
from skevgp.kernels.stationary import Exponential, Matern, Matern32, SquaredExponential, Stationary

from ..oracle import central_differences
from .cases import X, Z, parsed, pulled_back, random_bars, scalar


def test_a_profile_of_the_general_class_is_the_squared_exponential():
    hyperparameters = np.log([0.8, 1.4])
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
    at = kernel.at(np.log([1e-3, 1e-3]), 1e3 * X)
    U = at.cross(kernel.prepare(1e3 * X))
    assert U.max() <= 1.0
    np.testing.assert_allclose(np.diag(U), 1.0, atol=0.05)


def test_matern_gradients_next_to_coincident_points():
    """The kink of exp(-r) at r = 0: on either side of it, and 1e-6 of the inputs' size away from it."""
    covariance, hyperparameters = parsed(sk.Matern([1.0, 0.7], nu=0.5))
    points = X[:7] + 1e-6 * np.random.RandomState(1).randn(7, 2)
    bars = (*random_bars(7, 40)[:2], np.zeros((7, 7)))

    def value(flat):
        return scalar(covariance, hyperparameters, flat.reshape(7, 2), X, bars)

    _, Z_bar = pulled_back(covariance, hyperparameters, points, X, bars)
    expected = central_differences(value, points.ravel(), 1e-9).reshape(7, 2)
    np.testing.assert_allclose(Z_bar, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("kernel", "covariance"),
    [
        (sk.RBF(0.5), SquaredExponential(2, True)),
        (sk.RBF([0.5, 1.0]), SquaredExponential(2)),
        (sk.Matern(nu=np.inf), SquaredExponential(2, True)),
        (sk.Matern([1.0, 2.0], nu=1.5), Stationary(Matern32(), 2)),
        (sk.Matern(nu=0.8), Stationary(Matern(0.8), 2, True)),
    ],
    ids=str,
)
def test_kernels_are_read(kernel, covariance):
    assert parse_kernel(kernel, 2).covariance == covariance


def test_length_scales_must_fit_the_columns():
    with pytest.raises(ValueError, match="3 length scales, but its inputs have 2 columns"):
        parse_kernel(sk.RBF([1.0, 2.0, 3.0]), 2)


@pytest.mark.parametrize(
    ("nu", "message"),
    [(-1.0, "nu must be above 0"), (np.nan, "nu must be above 0"), (1000.0, "at most 150, or inf; got 1000.0")],
)
def test_a_nu_out_of_range_is_named(nu, message):
    with pytest.raises(ValueError, match=message):
        parse_kernel(sk.Matern(nu=nu), 2)
