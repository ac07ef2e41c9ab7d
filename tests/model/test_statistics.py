"""Whitening and the two passes over the rows, against dense formulas and finite differences."""

from dataclasses import replace

import numpy as np
import pytest

from skevgp.kernels.dot_product import DotProduct
from skevgp.kernels.stationary import SquaredExponential
from skevgp.model.statistics import StatisticsGradient, Whitening, collect, errors, pull_back
from skevgp.utils.linalg import JITTER, Jitter

from ..oracle import ArrayRows, central_differences, relative_error, squared_exponential

RNG = np.random.RandomState(0)
N, M, D, P, O = 60, 6, 2, 3, 2  # noqa: E741
LENGTHSCALES = np.array([0.9, 1.4])
Z = RNG.randn(M, D)
X, H, R = RNG.randn(N, D), RNG.randn(N, P), RNG.randn(N, O)
KERNEL = SquaredExponential(D)
THETA = np.concatenate([np.log(LENGTHSCALES), Z.ravel()])
ROWS = ArrayRows(X, H, R)
STATISTICS = ("n_rows", "VV", "VH", "VR", "HH", "HR", "RR", "unexplained")


def whitening(theta=THETA, points=None):
    points = theta[D:].reshape(M, D) if points is None else points
    return Whitening.of(KERNEL, np.exp(theta[:D]), points)


def blocks(size=17, rows=ROWS):
    return rows.blocks(KERNEL, size)


def dense(theta=THETA):
    """L, and U of all rows, written down."""
    lengthscales, points = np.exp(theta[:D]), theta[D:].reshape(M, D)
    L = np.linalg.cholesky(squared_exponential(points, points, lengthscales))
    return L, squared_exponential(points, X, lengthscales)


# --- one set of inducing points ------------------------------------------------------------------------------------


def test_whitened_rows_agree_with_a_solve():
    L, U = dense()
    own = whitening()
    np.testing.assert_allclose(own.L, L, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(own.L_inv @ own.L, np.eye(M), atol=1e-10)
    found_U, V = own.project(KERNEL.prepare(X))
    np.testing.assert_allclose(found_U, U, rtol=1e-10)
    np.testing.assert_allclose(V, np.linalg.solve(L, U), rtol=1e-8, atol=1e-10)


def test_unexplained_variance_is_not_negative():
    """Nor of any row within a long lengthscale, whatever rounding says."""
    prepared = KERNEL.prepare(Z)
    own = whitening()
    np.testing.assert_allclose(own.unexplained(prepared, own.project(prepared)[1]), 0.0, atol=1e-12)
    for factor in (1e2, 1e4):
        own = Whitening.of(KERNEL, factor * LENGTHSCALES, Z)
        left = own.unexplained(KERNEL.prepare(X), own.project(KERNEL.prepare(X))[1])
        assert (left >= 0.0).all()


def test_unexplained_variance_is_not_biased():
    """Of one point it is 1 - exp(-(x - z)² / ℓ²), here 1e-12 and more: right to a unit of 1, on average."""
    x = np.linspace(1e-6, 1e-4, 2000)[:, np.newaxis]
    kernel = SquaredExponential(1)
    own, prepared = Whitening.of(kernel, np.ones(1), np.zeros((1, 1))), kernel.prepare(x)
    shift = own.unexplained(prepared, own.project(prepared)[1]) + np.expm1(-(x[:, 0] ** 2))
    assert abs(shift.mean()) < np.finfo(float).eps


@pytest.mark.parametrize(("kernel", "size"), [(SquaredExponential(3), 1.0), (DotProduct(), 1e3)], ids=["near 1", "1e6"])
def test_rows_at_points_have_no_unexplained_variance(kernel, size):
    """It would leave about a half of them something, whatever the variance is."""
    nothing = []
    for seed in range(100):
        points = size * np.random.RandomState(seed).randn(3, 3)
        own, prepared = Whitening.of(kernel, np.ones(kernel.n_hyperparameters), points), kernel.prepare(points)
        nothing.append(own.unexplained(prepared, own.project(prepared)[1]) == 0.0)
    assert np.mean(nothing) > 0.8


def test_there_is_a_jitter_only_where_the_points_need_one():
    K = squared_exponential(Z, Z, LENGTHSCALES)
    np.testing.assert_array_equal(whitening().L, Whitening.of(KERNEL, LENGTHSCALES, Z, Jitter(0.1)).L)
    np.testing.assert_allclose(whitening().L @ whitening().L.T, K, atol=1e-15)
    twice = np.vstack([Z, Z])
    own = whitening(points=twice)
    assert np.isfinite(own.L_inv).all()
    K = squared_exponential(twice, twice, LENGTHSCALES)
    np.testing.assert_allclose(own.L @ own.L.T, K + JITTER.size * np.eye(2 * M), atol=1e-14)


def test_gradients_in_the_factor_are_pulled_back():
    weights = np.tril(RNG.randn(M, M))
    own = whitening()
    found = own.pull_back(own.covariance.start_pullback(), own.L.T @ weights)
    expected = central_differences(lambda theta: np.vdot(weights, whitening(theta).L), THETA)
    assert relative_error(np.concatenate([part.ravel() for part in found]), expected) < 1e-7


def test_gradients_in_whitened_rows_are_pulled_back():
    """Of <W, V>: Ū = L⁻ᵀ W, and L̄ = -tril(Ū Vᵀ), so that Lᵀ L̄ is -W Vᵀ."""
    weights, prepared = RNG.randn(M, N), KERNEL.prepare(X)
    own = whitening()
    U, V = own.project(prepared)
    U_bar = own.L_inv.T @ weights
    found = own.pull_back(own.covariance.cross_pullback(prepared, U, U_bar, 0.0), -weights @ V.T)
    expected = central_differences(lambda theta: np.vdot(weights, whitening(theta).project(prepared)[1]), THETA)
    assert relative_error(np.concatenate([part.ravel() for part in found]), expected) < 1e-7


# --- the first pass ------------------------------------------------------------------------------------------------


def test_sums_add_and_fade():
    whole = collect(blocks(), whitening(), slice(0, O))
    halves = [
        collect(blocks(rows=ArrayRows(X[part], H[part], R[part])), whitening(), slice(0, O))
        for part in (slice(0, 25), slice(25, N))
    ]
    added, faded = halves[0] + halves[1], whole.scaled(0.25)
    for name in STATISTICS:
        np.testing.assert_allclose(getattr(added, name), getattr(whole, name), rtol=1e-10, atol=1e-11, err_msg=name)
        np.testing.assert_array_equal(getattr(faded, name), 0.25 * getattr(whole, name))


def test_whitened_sums_keep_digits():
    """Points so near to each other that K has a condition of 1e10; the oracle is a QR factorisation of L."""
    points = np.linspace(-1.0, 1.0, M)[:, np.newaxis] * [0.35, 0.0]
    own = Whitening.of(KERNEL, np.ones(D), points)
    assert np.linalg.cond(own.L) > 1e4
    prepared = KERNEL.prepare(X)
    U, _ = own.project(prepared)
    V = np.linalg.solve(own.L, U)
    error = relative_error(collect(blocks(), own, slice(0, O)).VV, V @ V.T)
    late = np.linalg.solve(own.L, np.linalg.solve(own.L, U @ U.T).T)
    assert error < 1e-9
    assert error < 1e-2 * relative_error(late, V @ V.T)


# --- the second pass -----------------------------------------------------------------------------------------------


# Of `scalar` in L, where it is `whitening()`'s.
L_BAR = np.tril(np.random.RandomState(5).randn(M, M))


def some_gradient(outputs=O, seed=1):
    rng = np.random.RandomState(seed)
    of_sums = rng.randn(M, M), rng.randn(M, P), rng.randn(M, outputs), float(rng.randn())
    return StatisticsGradient(*of_sums, whitening().L.T @ L_BAR)


def scalar(statistics, own, gradient):
    """What has these gradients where the mean of q is 0, so that e = r."""
    parts = [(getattr(gradient, name), getattr(statistics, name)) for name in ("VV", "VH")]
    parts += [(gradient.VE, statistics.VR), (L_BAR, own.L)]
    return sum(np.vdot(*part) for part in parts) + gradient.unexplained * statistics.unexplained


def flat(gradients):
    return np.concatenate([part.ravel() for part in gradients])


@pytest.mark.parametrize("size", [1, 17, 60])
def test_second_pass_is_the_gradient_of_the_first(size):
    gradient, own, outputs = some_gradient(), whitening(), slice(0, O)
    statistics = collect(blocks(size), own, outputs)
    found, _ = pull_back(blocks(size), own, outputs, statistics, gradient, np.zeros((M + P, O)))

    def value(theta):
        at = whitening(theta)
        return scalar(collect(blocks(), at, outputs), at, gradient)

    assert relative_error(flat(found), central_differences(value, THETA)) < 1e-7


def test_jitter_moves_with_the_diagonal():
    """Of a kernel whose diagonal depends on its hyperparameters and points; at the origin of one it is 0."""
    kernel, points = DotProduct(), Z.copy()
    points[0] = 0.0
    jitter, weights = Jitter(0.3, 2.0), np.tril(np.random.RandomState(2).randn(M, M))

    def whitened(theta):
        own = theta[kernel.n_hyperparameters :].reshape(M, D)
        return Whitening.of(kernel, np.exp(theta[: kernel.n_hyperparameters]), own, jitter)

    theta = np.append(np.full(kernel.n_hyperparameters, -0.3), points)
    own = whitened(theta)
    found = own.pull_back(own.covariance.start_pullback(), own.L.T @ weights)
    expected = central_differences(lambda at: float(np.vdot(whitened(at).L, weights)), theta)
    assert relative_error(flat(found), expected) < 1e-7
    assert Whitening.of(KERNEL, LENGTHSCALES, np.empty((0, D))).jitter() == 0.0


def test_errors_of_mean_replace_residuals():
    gradient, own, outputs = some_gradient(), whitening(), slice(0, O)
    weights = RNG.randn(M + P, O)
    V = own.project(KERNEL.prepare(X))[1]
    e = R - V.T @ weights[:M] - H @ weights[M:]
    found, residuals = pull_back(blocks(), own, outputs, collect(blocks(), own, outputs), gradient, weights)
    np.testing.assert_allclose(residuals.squares, np.sum(e**2, axis=0), rtol=1e-10)
    np.testing.assert_allclose(residuals.VE, V @ e, rtol=1e-8, atol=1e-10)
    alone = errors(blocks(), own, outputs, weights)
    np.testing.assert_allclose(alone.squares, residuals.squares, rtol=1e-12)
    np.testing.assert_allclose(alone.VE, residuals.VE, rtol=1e-9, atol=1e-11)
    left = blocks(rows=ArrayRows(X, H, e))
    expected, _ = pull_back(left, own, outputs, collect(left, own, outputs), gradient, np.zeros((M + P, O)))
    np.testing.assert_allclose(flat(found), flat(expected), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("output", range(O))
def test_second_pass_of_one_output_sees_no_other(output):
    outputs, weights, gradient = slice(output, output + 1), RNG.randn(M + P, O), some_gradient()
    own = whitening()
    alone = replace(gradient, VE=gradient.VE[:, outputs])
    found, residuals = pull_back(blocks(), own, outputs, collect(blocks(), own, outputs), alone, weights[:, outputs])
    silent = replace(gradient, VE=gradient.VE * (np.arange(O) == output))
    both = slice(0, O)
    expected, all_residuals = pull_back(blocks(), own, both, collect(blocks(), own, both), silent, weights)
    np.testing.assert_allclose(flat(found), flat(expected), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(residuals.squares, all_residuals.squares[outputs], rtol=1e-12)
    np.testing.assert_allclose(residuals.VE, all_residuals.VE[:, outputs], rtol=1e-9, atol=1e-11)


def test_second_pass_uses_cached_whitening():
    """Kept blocks give the bits of those made again; those of other points are not mistaken for one's own."""
    gradient, outputs, weights = some_gradient(), slice(0, O), np.zeros((M + P, O))
    kept, made = blocks(), blocks()
    own, other = whitening(), whitening(THETA + 0.1)
    assert kept[0].may_keep
    statistics = collect(kept, own, outputs)
    assert kept[0].kept[0] is own
    first = pull_back(kept, own, outputs, statistics, gradient, weights)
    collect(kept, other, outputs)
    for part, expected in zip(pull_back(kept, own, outputs, statistics, gradient, weights)[0], first[0], strict=True):
        np.testing.assert_array_equal(part, expected)
    for index in range(len(made)):
        made[index].may_keep = False
    statistics = collect(made, own, outputs)
    assert made[0].kept is None
    for part, expected in zip(pull_back(made, own, outputs, statistics, gradient, weights)[0], first[0], strict=True):
        np.testing.assert_array_equal(part, expected)
