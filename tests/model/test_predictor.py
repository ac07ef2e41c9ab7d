"""The frozen predictor against the moments of a dense Gaussian of inducing values and weights."""

import pickle
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from skevgp.kernels.dot_product import DotProduct
from skevgp.model.model import SparseModel
from skevgp.model.predictor import CoefficientPrior, Predictor
from skevgp.model.statistics import Whitening

from ..oracle import problem, squared_exponential

M, P, O = 6, 3, 2  # noqa: E741
RNG = np.random.RandomState(7)
X_NEW, H_NEW = RNG.randn(11, 2), RNG.randn(11, P)


def some_posterior(shared=True, p=P, seed=3):
    """A predictor of some q(ω), not at any optimum; mean (o, m + p) and covariance of ω; values and model."""
    model, _, table = problem(shared=shared, p=p)
    values, rng = table.values_at_start(), np.random.RandomState(seed)
    mean, root = rng.randn(O, M + p), 0.5 * rng.randn(O, M + p, M + p)
    predictor = model.predictor(values, list(model.whitenings(values)), list(mean), list(root))
    return predictor, mean, np.einsum("oki,okj->oij", root, root), values, model


def dense_moments(mean, covariance, values, model, X, H):
    """Mean (n, o) and covariance (n, n, o) of g(x) by the paper's eq. prediction, in the coordinates (f_m, β)."""
    means, covariances = [], []
    for o in range(O):
        Z = values["inducing_points"][o % len(values["inducing_points"])]
        s2, prior, lengthscales = values["signal"][o], model.prior, values["hyperparameters"]
        K, U = (s2 * squared_exponential(Z, other, lengthscales) for other in (Z, X))
        p = H.shape[1]
        # (f_m, β) = T ω + (0, μ + c w₀)
        T = np.zeros((M + p, M + p))
        T[:M, :M], T[M:, M:] = np.linalg.cholesky(K), np.diag(prior.scale[o])
        joint = T @ covariance[o] @ T.T
        a, b = (T @ mean[o])[:M], (T @ mean[o])[M:] + prior.mean[o] + prior.scale[o] * prior.reference[o]
        means.append(H @ b + U.T @ np.linalg.solve(K, a))
        A, B, C, weights = joint[:M, :M], joint[M:, M:], joint[:M, M:], np.linalg.solve(K, U)
        within = s2 * squared_exponential(X, X, lengthscales) - U.T @ weights
        cross = weights.T @ C @ H.T
        covariances.append(within + H @ B @ H.T + weights.T @ A @ weights + cross + cross.T)
    return np.stack(means, axis=1), np.stack(covariances, axis=2)


@pytest.mark.parametrize("p", [0, P])
@pytest.mark.parametrize("shared", [True, False])
def test_predictions_are_those_of_the_dense_gaussian(shared, p):
    predictor, *q, values, model = some_posterior(shared, p)
    features = H_NEW[:, :p]
    mean, variance = predictor.predict(X_NEW, features, return_variance=True)
    expected_mean, expected = dense_moments(*q, values, model, X_NEW, features)
    np.testing.assert_allclose(mean, expected_mean, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(variance, np.einsum("nno->no", expected), rtol=1e-8)
    again, covariance = predictor.covariance(X_NEW, features)
    np.testing.assert_array_equal(again, mean)
    np.testing.assert_allclose(covariance, expected, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("shared", [True, False])
def test_novelty_is_what_is_left_of_the_variance_of_f_alone_at_most_all_of_it(shared):
    predictor, *q, values, model = some_posterior(shared)
    _, covariance = dense_moments(*q, values, model, X_NEW, np.zeros((11, P)))
    share = np.einsum("nno->no", covariance) / values["signal"]
    assert (share > 1.0).any()
    assert (share < 1.0).any()
    np.testing.assert_allclose(predictor.novelty(X_NEW, H_NEW), np.minimum(share, 1.0), rtol=1e-8)


def test_novelty_where_f_is_known_without_data():
    """A linear function is 0 at the origin; elsewhere its prior variance is |x|² s²."""
    model, _, table = problem(d=1, m=1, p=0)
    values = table.values_at_start() | {"hyperparameters": np.array([1e-170]), "inducing_points": np.array([[[2.0]]])}
    model = SparseModel(DotProduct(), model.prior, model.groups)
    predictor = model.predictor(values, list(model.whitenings(values)), [np.ones(1)] * O, [np.full((1, 1), 0.5)] * O)
    inputs = np.array([[0.0], [1e-3], [2.0], [-30.0]])
    expected = np.repeat([[0.0], [0.25], [0.25], [0.25]], O, axis=1)
    np.testing.assert_allclose(predictor.novelty(inputs, np.empty((4, 0))), expected, rtol=1e-6, atol=1e-12)


def test_each_output_sees_its_own_rows():
    predictor = some_posterior(shared=False)[0]
    inputs, features = (np.stack([rows, rows[::-1] + 0.5], axis=1) for rows in (X_NEW, H_NEW))
    found = predictor.predict(inputs, features, return_variance=True)
    for o in range(O):
        alone = predictor.predict(inputs[:, o], features[:, o], return_variance=True)
        for part, expected in zip(found, alone, strict=True):
            np.testing.assert_allclose(part[:, o], expected[:, o], rtol=1e-12)


def test_each_group_prepares_rows_for_its_own_kernel():
    """Of which one is used around another centre: the same covariances, to rounding."""
    predictor = some_posterior(shared=False)[0]
    first, second = predictor.groups
    kernel = second.kernel.centred(np.array([2.0, -3.0]))
    elsewhere = replace(second, kernel=kernel, whitening=Whitening.of(kernel, second.hyperparameters, second.points))
    found = replace(predictor, groups=(first, elsewhere)).predict(X_NEW, H_NEW, return_variance=True)
    for part, expected in zip(found, predictor.predict(X_NEW, H_NEW, return_variance=True), strict=True):
        np.testing.assert_allclose(part, expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("shared", [True, False])
def test_scaled_outputs_are_predicted_in_their_units(shared):
    predictor, factor = some_posterior(shared)[0], np.array([10.0, 0.01])
    offset = factor[:, np.newaxis] * predictor.offset
    joined = Predictor.joined([predictor], [[0, 1]], factor, offset, np.zeros(O))
    mean, covariance = predictor.covariance(X_NEW, H_NEW)
    found_mean, found = joined.covariance(X_NEW, H_NEW)
    np.testing.assert_allclose(found_mean, mean * factor, rtol=1e-12)
    np.testing.assert_allclose(found, covariance * factor**2, rtol=1e-12)
    np.testing.assert_allclose(joined.noise, predictor.noise * factor**2, rtol=1e-15)
    np.testing.assert_allclose(joined.signal, predictor.signal * factor**2, rtol=1e-15)


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_predictors_of_single_outputs_are_joined_each_to_its_own(order):
    """In whatever order they come, each with its own points; units, offset and intercept are those of the whole."""
    whole, mean, _, values, model = some_posterior(shared=False)
    rng = np.random.RandomState(3)
    root = (rng.randn(O, M + P), 0.5 * rng.randn(O, M + P, M + P))[1]
    parts = []
    for o in range(O):
        own = slice(o, o + 1)
        alone = SparseModel(model.kernel, model.prior.outputs(own), (slice(0, 1),))
        of_output = {name: value[own] for name, value in values.items() if name != "hyperparameters"}
        of_output["hyperparameters"] = values["hyperparameters"]
        parts.append(alone.predictor(of_output, list(alone.whitenings(of_output)), mean[own], root[own]))
    unit, offset, intercept = np.array([2.0, 30.0]), RNG.randn(O, P), np.array([1.0, -4.0])
    joined = Predictor.joined([parts[o] for o in order], [[o] for o in order], unit, offset, intercept)
    expected = Predictor.joined([whole], [[0, 1]], unit, offset, intercept)
    assert [group.outputs for group in joined.groups] == [[o] for o in order]
    assert type(joined.groups) is tuple
    for group, of_whole in zip(joined.by_output, expected.by_output, strict=True):
        np.testing.assert_array_equal(group.points, of_whole.points)
    np.testing.assert_array_equal(joined.signal, expected.signal)
    np.testing.assert_array_equal(joined.noise, expected.noise)
    for found, of_whole in zip(joined.covariance(X_NEW, H_NEW), expected.covariance(X_NEW, H_NEW), strict=True):
        np.testing.assert_allclose(found, of_whole, rtol=1e-10, atol=1e-10)
    for found, of_whole in zip(joined.coefficients(), expected.coefficients(), strict=True):
        np.testing.assert_allclose(found, of_whole, rtol=1e-12)
    np.testing.assert_array_equal(joined.intercept, intercept)


def test_predictor_is_frozen_and_keeps_no_rows():
    predictor = some_posterior()[0]
    with pytest.raises(FrozenInstanceError):
        predictor.noise = np.zeros(O)
    with pytest.raises(FrozenInstanceError):
        predictor.groups[0].mean = np.zeros((O, M + P))
    fewer, more = (len(pickle.dumps(problem_of(n))) for n in (60, 600))
    assert fewer == more


def problem_of(n):
    model, rows, table = problem(n=n)
    values = table.values_at_start()
    return model.at_optimum(values, model.statistics(values, rows.blocks(model.kernel, 17)))


@pytest.mark.parametrize("shared", [True, False])
def test_pickle_predicts_same_bits(shared):
    predictor = some_posterior(shared)[0]
    again = pickle.loads(pickle.dumps(predictor))
    for found, expected in zip(again.covariance(X_NEW, H_NEW), predictor.covariance(X_NEW, H_NEW), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_block_size_limits_memory():
    predictor = some_posterior()[0]
    assert predictor.rows_at_once == 4096
    large = replace(predictor.groups[0], mean=np.zeros((100, 10_000)))
    assert replace(predictor, groups=(large,)).rows_at_once == 256
    nothing = replace(predictor.groups[0], mean=np.zeros((1, 0)))
    assert replace(predictor, groups=(nothing,)).rows_at_once == 4096
    middle = replace(predictor.groups[0], mean=np.zeros((1, 1000)))
    assert replace(predictor, groups=(middle, middle)).rows_at_once * 2000 <= 2**20


ROOT = np.array([[[2.0, 0.0], [1.0, 0.5]], [[1.0, 0.2], [0.0, 3.0]]])
PRIOR = CoefficientPrior(
    np.array([[1.0, 2.0], [3.0, 4.0]]), np.sqrt(np.sum(ROOT**2, axis=2)), np.array([[0.1, 0.0], [0.0, 0.2]]), ROOT
)


def test_independent_weights_have_a_diagonal_root():
    prior = CoefficientPrior(PRIOR.mean, PRIOR.scale, PRIOR.reference)
    np.testing.assert_array_equal(prior.roots()[1], np.diag(PRIOR.scale[1]))
    np.testing.assert_allclose(prior.times(PRIOR.reference), PRIOR.scale * PRIOR.reference)


def test_outputs_and_units_of_a_prior():
    own = PRIOR.outputs([1])
    np.testing.assert_array_equal(own.roots(), ROOT[[1]])
    scaled = PRIOR.scaled(np.array([10.0, 0.1]))
    np.testing.assert_allclose(scaled.offset, PRIOR.offset * [[10.0], [0.1]])
    np.testing.assert_allclose(
        scaled.roots() @ scaled.roots().transpose(0, 2, 1),
        ROOT @ ROOT.transpose(0, 2, 1) * np.array([100.0, 0.01])[:, np.newaxis, np.newaxis],
    )
