"""The exact model against dense formulas that share nothing with it."""

from dataclasses import replace

import autograd
import autograd.numpy as anp
import numpy as np
import pytest

from skevgp.data.rows import RawRows
from skevgp.kernels.base import Sum
from skevgp.kernels.constant import Constant
from skevgp.kernels.dot_product import DotProduct
from skevgp.kernels.stationary import SquaredExponential
from skevgp.model.exact import ExactModel
from skevgp.model.predictor import CoefficientPrior

from ..oracle import central_differences, relative_error, squared_exponential

LOG_2PI = np.log(2 * np.pi)
N, D, P, O = 25, 2, 3, 2  # noqa: E741
VAGUE = {
    "proper": np.zeros((O, P), dtype=bool),
    "vague": np.ones((O, P), dtype=bool),
    "mixed": np.array([[True, False, False], [False, True, True]]),
}
VALUES = {
    "hyperparameters": np.array([0.8, 1.3]),
    "signal": np.array([1.5, 0.4]),
    "noise": np.array([0.02, 0.3]),
    "inducing_points": np.empty((1, 0, D)),
}


def problem(vague, n=N, p=P, seed=0):
    """An exact model whose targets are y less a reference, and y itself."""
    rng = np.random.RandomState(seed)
    X, H, Y = rng.randn(n, D), rng.randn(n, p), 3.0 * rng.randn(n, O)
    scale = 0.5 + rng.rand(O, p)
    scale[0, -1:] = 0.0
    scale = np.where(vague, 1.7, scale)
    prior = CoefficientPrior(rng.randn(O, p), scale, 0.5 * rng.randn(O, p))
    rows = RawRows(X, H, Y - H @ prior.offset.T)
    return ExactModel(SquaredExponential(D), prior, vague, rows), Y


def dense_likelihood(lengthscales, signal, noise, model, Y):
    """Rasmussen & Williams, eq. 2.45 for the vague weights, after the others are put into the covariance."""
    X, H, total = model.rows.inputs, model.rows.features, 0.0
    for o in range(O):
        mean, scale, vague = model.prior.mean[o], model.prior.scale[o], model.vague[o]
        K = signal[o] * squared_exponential(X, X, lengthscales) + noise[o] * np.eye(len(X))
        K = K + (H[:, ~vague] * scale[~vague] ** 2) @ H[:, ~vague].T
        y, T = Y[:, o] - H[:, ~vague] @ mean[~vague], H[:, vague]
        inverse = anp.linalg.inv(K)
        A = T.T @ inverse @ T
        C = inverse @ T @ anp.linalg.inv(A) @ T.T @ inverse if T.shape[1] else np.zeros_like(X[:, :1])
        log_det_A = anp.linalg.slogdet(A)[1] if T.shape[1] else 0.0
        total = total - 0.5 * (y @ inverse @ y - y @ (C @ y if T.shape[1] else 0.0 * y))
        total = total - 0.5 * (anp.linalg.slogdet(K)[1] + log_det_A + (len(X) - T.shape[1]) * LOG_2PI)
    return total


@pytest.mark.parametrize("vague", VAGUE.values(), ids=VAGUE)
def test_likelihood_and_its_gradient_are_those_of_the_dense_formula(vague):
    model, Y = problem(vague)

    def dense(logs):
        return dense_likelihood(anp.exp(logs[:2]), anp.exp(logs[2:4]), anp.exp(logs[4:]), model, Y)

    logs = np.log(np.concatenate([VALUES[name] for name in ("hyperparameters", "signal", "noise")]))
    value, gradient = model.log_likelihood(VALUES)
    flat = np.concatenate([gradient[name] for name in ("hyperparameters", "signal", "noise")])
    assert value == pytest.approx(dense(logs), rel=1e-12)
    np.testing.assert_allclose(flat, autograd.grad(dense)(logs), rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("vague", VAGUE.values(), ids=VAGUE)
@pytest.mark.parametrize(
    ("kernel", "hyperparameters"),
    [
        (SquaredExponential(D), [0.8, 1.3]),
        (Sum((SquaredExponential(D), DotProduct(), Constant())), [0.8, 1.3, 0.5, 2.0]),
    ],
    ids=["squared exponential", "sum"],
)
def test_gradient_is_that_of_finite_differences(vague, kernel, hyperparameters):
    model, _ = problem(vague)
    model = ExactModel(kernel, model.prior, model.vague, model.rows)
    h = len(hyperparameters)

    def values(logs):
        parts = np.split(np.exp(logs), [h, h + O])
        return VALUES | dict(zip(("hyperparameters", "signal", "noise"), parts, strict=True))

    logs = np.log(np.concatenate([hyperparameters, VALUES["signal"], VALUES["noise"]]))
    gradient = model.log_likelihood(values(logs))[1]
    flat = np.concatenate([gradient[name] for name in ("hyperparameters", "signal", "noise")])
    numeric = central_differences(lambda at: model.log_likelihood(values(at))[0], logs)
    assert relative_error(flat, numeric) < 1e-7


@pytest.mark.parametrize("vague", VAGUE.values(), ids=VAGUE)
def test_reference_of_the_residuals_does_not_matter(vague):
    model, Y = problem(vague)
    moved = CoefficientPrior(model.prior.mean, model.prior.scale, model.prior.reference + 0.7)
    rows = RawRows(model.rows.inputs, model.rows.features, Y - model.rows.features @ moved.offset.T)
    other = ExactModel(model.kernel, moved, vague, rows)
    assert other.log_likelihood(VALUES)[0] == pytest.approx(model.log_likelihood(VALUES)[0], rel=1e-12)
    new = np.random.RandomState(1).randn(4, D), np.random.RandomState(2).randn(4, P)
    predictions = (m.predictor(VALUES).predict(*new, True) for m in (other, model))
    for actual, expected in zip(*predictions, strict=True):
        np.testing.assert_allclose(actual, expected, rtol=1e-11)


@pytest.mark.parametrize("vague", VAGUE.values(), ids=VAGUE)
def test_posterior_is_that_of_a_dense_gaussian_of_values_and_weights(vague):
    model, Y = problem(vague)
    rng = np.random.RandomState(3)
    X, H, x, h = model.rows.inputs, model.rows.features, rng.randn(6, D), rng.randn(6, P)
    posterior = model.predictor(VALUES)
    mean, variance = posterior.predict(x, h, return_variance=True)
    _, covariance = posterior.covariance(x, h)
    coef, coef_cov = posterior.coefficients()
    for o in range(O):
        # A weight without a prior, by generalised least squares; with one, by a row of its own for each.
        scale, prior_mean = model.prior.scale[o], model.prior.mean[o]
        K = VALUES["signal"][o] * squared_exponential(X, X, VALUES["hyperparameters"])
        K_y = K + VALUES["noise"][o] * np.eye(N)
        k = VALUES["signal"][o] * squared_exponential(X, x, VALUES["hyperparameters"])
        free = scale > 0.0
        precision = np.diag(np.where(vague[o][free], 0.0, scale[free] ** -2.0))
        r = Y[:, o] - H[:, ~free] @ prior_mean[~free]
        A = precision + H[:, free].T @ np.linalg.solve(K_y, H[:, free])
        beta = np.linalg.solve(A, H[:, free].T @ np.linalg.solve(K_y, r) + precision @ prior_mean[free])
        expected = prior_mean.copy()
        expected[free] = beta
        np.testing.assert_allclose(coef[o], expected, rtol=1e-10)
        np.testing.assert_allclose(coef_cov[o][np.ix_(free, free)], np.linalg.inv(A), rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(coef_cov[o][~free], 0.0)
        alpha = np.linalg.solve(K_y, Y[:, o] - H @ expected)
        np.testing.assert_allclose(mean[:, o], h @ expected + k.T @ alpha, rtol=1e-9)
        within = VALUES["signal"][o] * squared_exponential(x, x, VALUES["hyperparameters"])
        left = h[:, free].T - H[:, free].T @ np.linalg.solve(K_y, k)
        expected_cov = within - k.T @ np.linalg.solve(K_y, k) + left.T @ np.linalg.solve(A, left)
        np.testing.assert_allclose(covariance[:, :, o], expected_cov, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(variance[:, o], np.diag(expected_cov), rtol=1e-8)


@pytest.mark.parametrize("correlated", [False, True])
def test_more_features_than_rows_have_the_likelihood_of_as_many_as_rows(correlated):
    model, _ = problem(np.zeros((O, 40), dtype=bool), p=40)
    if correlated:
        root = 0.3 * np.random.RandomState(3).randn(O, 40, 40)
        model = replace(model, prior=replace(model.prior, root=root))
    precision = np.random.RandomState(4).uniform(0.5, 2.0, N)
    for own in (model, replace(model, rows=replace(model.rows, precision=precision, counts=np.ones(N)))):
        fewer = own.with_fewer_features()
        assert fewer.rows.features.shape == (N, O, N)
        (value, gradient), (expected, expected_gradient) = (each.log_likelihood(VALUES) for each in (fewer, own))
        assert value == pytest.approx(expected, rel=1e-10)
        for name, of_values in expected_gradient.items():
            np.testing.assert_allclose(gradient[name], of_values, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("size", [1e9, 1e14])
def test_wide_prior_of_the_last_of_many_features_costs_no_digits(size):
    model, _ = problem(np.zeros((O, 40), dtype=bool), p=40)
    model.prior.scale[:, -1] = size
    expected = model.log_likelihoods(VALUES)
    np.testing.assert_allclose(model.with_fewer_features().log_likelihoods(VALUES), expected, rtol=1e-8)


def test_features_are_kept_if_few_vague_or_shared():
    few, _ = problem(VAGUE["proper"])
    vague, _ = problem(np.arange(O * 40).reshape(O, 40) == 0, p=40)
    many, _ = problem(np.zeros((O, 40), dtype=bool), p=40)
    for model in (few, vague, replace(many, prior=replace(many.prior, shared=True))):
        assert model.with_fewer_features() is model


def test_badly_scaled_vague_features_keep_their_digits():
    # Normal equations would square a condition of 1e10.
    rng = np.random.RandomState(0)
    X, H = rng.randn(40, D), rng.randn(40, 2)
    H = np.column_stack([H[:, 0], H[:, 0] + 1e-10 * H[:, 1]])
    beta = np.array([[1.0, 2.0]])
    prior = CoefficientPrior(np.zeros((1, 2)), np.ones((1, 2)), np.zeros((1, 2)))
    model = ExactModel(SquaredExponential(D), prior, np.ones((1, 2), dtype=bool), RawRows(X, H, H @ beta.T))
    values = VALUES | {"signal": np.array([1e-6]), "noise": np.array([1e-2])}
    np.testing.assert_allclose(model.predictor(values).coefficients()[0], beta, rtol=1e-4)
