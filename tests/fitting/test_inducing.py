import numpy as np
import pytest
from scipy.spatial.distance import cdist

from skevgp.fitting.inducing import LARGEST_SEARCH, MAX_SAMPLE, Placement, are_all_rows, distinct_rows, with_more
from skevgp.kernels.stationary import SquaredExponential


def points(X, n_inducing, method="k-means", lengthscale=1.0, seed=0):
    kernel, hyperparameters = SquaredExponential(X.shape[1]), np.log(np.full(X.shape[1], lengthscale))
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


@pytest.mark.parametrize("method", ["auto", "k-means", "greedy"])
@pytest.mark.parametrize("n_inducing", [1, 100, 1000, 5000])
def test_a_sample_has_rows_enough_to_choose_from_and_no_more(method, n_inducing):
    size = Placement(method, n_inducing).sample_size
    assert size >= 2 * n_inducing
    assert size <= max(MAX_SAMPLE, 10 * n_inducing)
    if method == "greedy" and size > 2 * n_inducing:
        assert size * n_inducing <= LARGEST_SEARCH


@pytest.mark.parametrize("method", ["k-means", "greedy"])
def test_the_first_points_are_far_apart(method):
    """Adam moves in coordinates whitened in this order; sorted points make each nearly follow from the one before."""
    X = np.random.RandomState(0).rand(2000, 1)
    chosen = points(X, 20, method, 0.1)[:, 0]
    assert np.abs(np.diff(chosen[:5])).min() > 2.0 * np.diff(np.sort(chosen)).mean()


def test_greedy_takes_the_row_of_largest_conditional_variance():
    X = np.random.RandomState(0).randn(200, 3)
    chosen = points(X, 12, "greedy", 1.5)

    def k(A, B):
        return np.exp(-0.5 * cdist(A / 1.5, B / 1.5, "sqeuclidean"))

    for count in range(1, 12):
        Z = chosen[:count]
        left = 1.0 - np.einsum("ij,ij->j", k(Z, X), np.linalg.solve(k(Z, Z), k(Z, X)))
        np.testing.assert_array_equal(chosen[count], X[np.argmax(left)])


@pytest.mark.parametrize("lengthscale", [1e4, 1.0, 1e-4])
def test_greedy_goes_on_where_the_kernel_is_exhausted_or_every_row_a_stranger(lengthscale):
    """A long lengthscale is known from one row; then the farthest row is next. Copies never serve twice."""
    X = np.repeat(np.random.RandomState(0).rand(60, 1), 3, axis=0)
    chosen = points(X, 40, "greedy", lengthscale)
    assert len(np.unique(chosen, axis=0)) == 40
    assert np.isin(chosen, X).all()
    assert cdist(X, points(X, 10, "greedy", 1e4)).min(axis=1).max() < 0.1


# --- more points ---------------------------------------------------------------------------------------------------


def more(Z, n_inducing, X, lengthscale=1.5):
    return with_more(Z, n_inducing, X, SquaredExponential(X.shape[1]), np.log(np.full(X.shape[1], lengthscale)))


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


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_no_more_points_than_there_are_distinct_rows(scale):
    X = scale * np.random.RandomState(0).randn(20, 2)
    twice = np.vstack([X, X * (1.0 + 4e-16)])
    np.testing.assert_array_equal(distinct_rows(twice), X)
    grown = more(X[5:15], 100, twice, scale)
    assert grown.shape == (20, 2)
    assert are_all_rows(grown, X)
    np.testing.assert_array_equal(more(X, 30, twice, scale), X)
    beside = X[:3] + 0.1 * scale
    assert more(beside, 100, twice, scale).shape == (23, 2)
