import numpy as np
import pytest
from scipy.spatial.distance import cdist

from skevgp.fitting.inducing import Placement, are_all_rows, with_more_points
from skevgp.kernels.stationary import SquaredExponential


def points(X, n_inducing, method="k-means", lengthscale=1.0, seed=0):
    kernel, hyperparameters = SquaredExponential(X.shape[1]), np.full(X.shape[1], lengthscale)
    return Placement(method, n_inducing).points(X, kernel, hyperparameters, np.random.RandomState(seed))


@pytest.mark.parametrize("method", ["k-means", "greedy"])
def test_points_spread_over_the_data_whatever_the_scales(method):
    scale = np.array([1e-6, 1e6])
    X = np.random.RandomState(0).rand(2000, 2) * scale
    chosen = points(X, 25, method, 0.2 * scale) / scale
    assert chosen.shape == (25, 2)
    nearest = np.linalg.norm(X[:, np.newaxis] / scale - chosen, axis=2).min(axis=1)
    assert nearest.max() < 0.35


@pytest.mark.parametrize("method", ["k-means", "greedy"])
def test_rows_that_differ_by_rounding_only_are_one(method):
    """In units of their column's scatter, however far from 0 that is."""
    rng = np.random.RandomState(0)
    for X in (rng.randn(20, 2), 1e6 * rng.randn(20, 2), 1e-6 * rng.randn(20, 2)):
        twice = np.vstack([X, X * (1.0 + 4e-16 * rng.choice([-1, 1], X.shape))])
        np.testing.assert_array_equal(points(twice, 30, method), X)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_whether_points_are_all_rows_but_for_rounding(scale):
    X = scale * np.random.RandomState(0).randn(20, 2)
    assert are_all_rows(X, X)
    assert are_all_rows(X[::-1] * (1.0 + 1e-15), np.vstack([X, X]))
    assert are_all_rows(np.vstack([X, X[:1] + scale]), X)
    assert not are_all_rows(X[1:], X)
    assert not are_all_rows(X + 1e-6 * scale, X)


def test_greedy_takes_the_row_of_largest_conditional_variance():
    X = np.random.RandomState(0).randn(200, 3)
    chosen = points(X, 12, "greedy", 1.5)

    def k(A, B):
        return np.exp(-0.5 * cdist(A / 1.5, B / 1.5, "sqeuclidean"))

    for count in range(1, 12):
        Z = chosen[:count]
        left = 1.0 - np.einsum("ij,ij->j", k(Z, X), np.linalg.solve(k(Z, Z), k(Z, X)))
        np.testing.assert_array_equal(chosen[count], X[np.argmax(left)])


# --- more points ---------------------------------------------------------------------------------------------------


def more(Z, n_inducing, X, lengthscale=1.5):
    return with_more_points(Z, n_inducing, X, SquaredExponential(X.shape[1]), np.full(X.shape[1], lengthscale))


def test_more_points_are_the_least_known_from_points_that_are_no_rows():
    X, Z = np.random.RandomState(0).randn(200, 3), np.random.RandomState(1).randn(7, 3)
    chosen = more(Z, 15, X)

    def k(A, B):
        return np.exp(-0.5 * cdist(A / 1.5, B / 1.5, "sqeuclidean"))

    np.testing.assert_array_equal(chosen[:7], Z)
    for count in range(7, 15):
        known = chosen[:count]
        left = 1.0 - np.einsum("ij,ij->j", k(known, X), np.linalg.solve(k(known, known), k(known, X)))
        np.testing.assert_array_equal(chosen[count], X[np.argmax(left)])
