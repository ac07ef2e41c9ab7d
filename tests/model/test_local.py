"""The model with a local part: its limits, its oracle, and its gradient."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from skevgp.data.rows import RawRows, Rows
from skevgp.data.threads import BlockMap
from skevgp.kernels.stationary import Matern52, SquaredExponential, Stationary
from skevgp.model import conditioning
from skevgp.model.local import LocalModel, values_by_output
from skevgp.model.model import SparseModel
from skevgp.model.posterior import LocalPosterior
from skevgp.model.predictor import CoefficientPrior

from ..oracle import central_differences

N, N_OUTPUTS, P = 60, 2, 2
RNG = np.random.RandomState(0)
X, X_NEW = RNG.randn(N, 2), RNG.randn(15, 2)
Y, PRECISION = RNG.randn(N, N_OUTPUTS), np.exp(RNG.randn(N))
ORDER = RNG.permutation(N)
VALUES = {
    "hyperparameters": np.array([0.8, 1.3]),
    "signal": np.array([1.5, 0.7]),
    "noise": np.array([0.1, 0.2]),
    "inducing_points": X[np.newaxis, :7] + 0.1,
}
SCALE = 1.7


def features(rows):
    return np.column_stack([np.ones(len(rows)), rows[:, 0]])


ROWS = RawRows(X, features(X), Y, np.ones(N), PRECISION)


def sparse_of(kernel=None, n_outputs=N_OUTPUTS, **fields):
    prior = CoefficientPrior(np.zeros((n_outputs, P)), np.full((n_outputs, P), SCALE), np.zeros((n_outputs, P)))
    return SparseModel(kernel or SquaredExponential(2), prior, (slice(0, n_outputs),), **fields)


def posterior_of(n_neighbors, rows=ROWS, order=ORDER, values=VALUES, model=None):
    model = model or sparse_of()
    return LocalPosterior.of(model, values, LocalModel.of(model, rows, n_neighbors, order))


def exact(output, rows=X, targets=Y, precision=PRECISION):
    """Log likelihood, mean and covariance of an exact Gaussian process with k + h Σ hᵀ, in plain NumPy."""
    lengths, signal, noise = VALUES["hyperparameters"], VALUES["signal"][output], VALUES["noise"][output]

    def covariance(A, B):
        squares = (((A[:, np.newaxis] - B) / lengths) ** 2).sum(axis=2)
        return signal * np.exp(-0.5 * squares) + SCALE**2 * features(A) @ features(B).T

    y, C = targets[:, output], covariance(rows, rows) + np.diag(noise / precision)
    likelihood = -0.5 * (y @ np.linalg.solve(C, y) + np.linalg.slogdet(C)[1] + len(y) * np.log(2.0 * np.pi))
    crossed = covariance(X_NEW, rows)
    mean = crossed @ np.linalg.solve(C, y)
    return likelihood, mean, covariance(X_NEW, X_NEW) - crossed @ np.linalg.solve(C, crossed.T)


def assert_exact(posterior):
    likelihoods, means, covariances = zip(*map(exact, range(N_OUTPUTS)), strict=True)
    assert posterior.bound == pytest.approx(sum(likelihoods), rel=1e-10)
    mean, covariance = posterior.predictor.covariance(X_NEW, features(X_NEW))
    assert_allclose(mean, np.column_stack(means), atol=1e-8)
    assert_allclose(covariance, np.stack(covariances, axis=2), atol=1e-8)
    mean, variance = posterior.predictor.predict(X_NEW, features(X_NEW), return_variance=True)
    assert_allclose(mean, np.column_stack(means), atol=1e-8)
    assert_allclose(variance, np.column_stack([np.diagonal(own) for own in covariances]), atol=1e-8)


@pytest.mark.parametrize("m", [0, 1, 7, 40])
def test_all_rows_as_neighbours_are_the_exact_model(m):
    """With features, two outputs and noise variances of the rows. Without inducing points it is Vecchia's model."""
    points = np.vstack([X + 0.1, X_NEW])[:m]
    assert_exact(posterior_of(N, values=VALUES | {"inducing_points": points[np.newaxis]}))


def test_no_neighbours_are_fitc():
    """Snelson & Ghahramani 2006: the residual of f has a variance for each row, and no correlation."""
    values = VALUES | {"signal": np.array([1.5]), "noise": np.array([0.1])}
    none = np.empty((1, 0))
    model = SparseModel(SquaredExponential(2), CoefficientPrior(none, none, none), (slice(0, 1),))
    posterior = posterior_of(0, RawRows(X, np.empty((N, 0)), Y[:, :1]), values=values, model=model)
    K, Z = SquaredExponential(2), VALUES["inducing_points"][0]
    at = K.at(VALUES["hyperparameters"], Z)
    U, within = at.cross(K.prepare(X)), at.matrix()
    explained = U.T @ np.linalg.solve(within, U)
    C = 1.5 * (explained + np.diag(1.0 - np.diagonal(explained))) + 0.1 * np.eye(N)
    y = Y[:, 0]
    likelihood = -0.5 * (y @ np.linalg.solve(C, y) + np.linalg.slogdet(C)[1] + N * np.log(2.0 * np.pi))
    assert posterior.bound == pytest.approx(likelihood, rel=1e-10)


def test_errors_against_the_exact_model_fall_with_the_number_of_neighbours():
    """Of smooth functions, whose near rows say most."""
    y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], np.cos(2.0 * X[:, 1])])
    rows = replace(ROWS, targets=y)
    expected = [exact(output, targets=y)[1:] for output in range(N_OUTPUTS)]
    errors = []
    for k in (0, 4, 12, 30, N):
        mean, variance = posterior_of(k, rows).predictor.predict(X_NEW, features(X_NEW), return_variance=True)
        wanted = np.column_stack([mean for mean, _ in expected])
        variances = np.column_stack([np.diagonal(covariance) for _, covariance in expected])
        errors.append([np.abs(mean - wanted).mean(), np.abs(variance - variances).mean()])
    assert (np.diff(errors, axis=0) < 0.0).all()
    assert np.max(errors[-1]) < 1e-8


@pytest.mark.parametrize("k", [0, 5, 25])
@pytest.mark.parametrize("kernels", ["one", "own"])
def test_gradient_agrees_with_finite_differences(k, kernels):
    """Neighbours are held. Outputs have one kernel, or each their own with other length scales."""
    model, values = sparse_of(Stationary(Matern52(), 2)), VALUES
    if kernels == "own":
        model = replace(model, groups=(slice(0, 1), slice(1, 2)), kernels=(model.kernel, model.kernel))
        values = values | {"hyperparameters": np.array([[0.8, 1.3], [0.5, 2.0]])}
        values["inducing_points"] = np.repeat(VALUES["inducing_points"], 2, axis=0)
    local = LocalModel.of(model, ROWS[:25], k, np.argsort(ORDER[:25]))
    by_output = values_by_output(model, values)
    neighbours = local.neighbours(local.known(by_output))
    _, gradient = local.log_likelihood(by_output, neighbours)
    for name in ("hyperparameters", "signal", "noise"):
        shape = by_output[name].shape

        def likelihood(logs, name=name, shape=shape):
            return local.log_likelihood(by_output | {name: np.exp(logs).reshape(shape)}, neighbours)[0]

        expected = central_differences(likelihood, np.log(by_output[name]).ravel(), 1e-5)
        assert_allclose(gradient[name].ravel(), expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_rows_at_once_and_threads_change_nothing(monkeypatch):
    expected = posterior_of(9)
    monkeypatch.setattr(conditioning, "_NUMBERS", 1)
    monkeypatch.setattr(conditioning, "_KEPT_NUMBERS", 1)
    threads = BlockMap(2)
    try:
        model = sparse_of()
        local = replace(LocalModel.of(model, ROWS, 9, ORDER, threads), n_threads=2)
        found = LocalPosterior.of(model, VALUES, local)
        assert found.bound == pytest.approx(expected.bound, rel=1e-12)
        assert_allclose(
            found.predictor.predict(X_NEW, features(X_NEW), True),
            expected.predictor.predict(X_NEW, features(X_NEW), True),
            rtol=1e-9,
        )
    finally:
        threads.close()


def test_weighted_rows_are_repeated_rows():
    counts = RNG.randint(1, 4, N)
    weighted = replace(ROWS, counts=counts.astype(float), precision=counts * PRECISION)
    again = np.repeat(np.arange(N), counts)
    repeated = ROWS[again]
    posterior, expected = posterior_of(N, weighted), posterior_of(len(again), repeated, np.arange(len(again)))
    assert posterior.bound == pytest.approx(expected.bound, rel=1e-9)
    for found, wanted in zip(
        posterior.predictor.predict(X_NEW, features(X_NEW), True),
        expected.predictor.predict(X_NEW, features(X_NEW), True),
        strict=True,
    ):
        assert_allclose(found, wanted, atol=1e-7)


@pytest.mark.parametrize("weighted", [True, False])
def test_further_rows_are_conditioned_on_all_earlier_ones(weighted):
    """Adding rows one part after the other is one pass."""
    rows = ROWS if weighted else replace(ROWS, counts=None, precision=None)
    all_at_once = posterior_of(8, rows, np.arange(N))
    posterior = posterior_of(8, rows[:30], np.arange(30))
    for part in (slice(30, 31), slice(31, N)):
        posterior = posterior.updated(Rows.in_internal_units(rows[part]), 1.0, np.zeros(N_OUTPUTS))
    assert posterior.bound == pytest.approx(all_at_once.bound, rel=1e-10)
    for found, wanted in zip(
        posterior.predictor.predict(X_NEW, features(X_NEW), True),
        all_at_once.predictor.predict(X_NEW, features(X_NEW), True),
        strict=True,
    ):
        assert_allclose(found, wanted, atol=1e-9)


def test_other_features_and_priors_are_those_of_a_new_posterior():
    posterior, prior = posterior_of(8), sparse_of().prior
    wider = replace(prior, scale=2.0 * prior.scale)
    moved = posterior.moved(wider, Rows.in_internal_units(replace(ROWS, features=2.0 * ROWS.features)))
    model = replace(sparse_of(), prior=wider)
    again = posterior_of(8, replace(ROWS, features=2.0 * ROWS.features), model=model)
    assert moved.bound == pytest.approx(again.bound, rel=1e-12)
    likelihoods = posterior.weight_likelihoods(wider)
    expected = posterior_of(8, model=model).weight_likelihoods()
    for found, wanted in zip(likelihoods, expected, strict=True):
        assert_allclose(found.M, wanted.M, rtol=1e-9)
