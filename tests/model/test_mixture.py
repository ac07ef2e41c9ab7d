"""The posterior averaged over draws of kernel and noise, against the moments of the draws one by one."""

from copy import deepcopy

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.data.rows import LocalSource, RawRows
from skevgp.model.mixture import MixturePosterior, mixed, unmixed
from skevgp.model.posterior import SparsePosterior

RNG = np.random.RandomState(0)
N, D, O = 24, 2, 2  # noqa: E741
X, X_NEW = RNG.uniform(-2.0, 2.0, (N, D)), RNG.uniform(-2.5, 2.5, (7, D))
Y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], 30.0 * np.cos(X[:, 1])]) + [0.1, 3.0] * RNG.randn(N, O)
TREND = PolynomialFeatures(1)
MODELS = {
    "exact": EGPRegressor(TREND),
    "sparse": EVGPRegressor(TREND, n_inducing=8, random_state=0),
    "without features": EVGPRegressor(n_inducing=8, random_state=0),
    "two kernels": EVGPRegressor(TREND, n_inducing=8, sharing="none", random_state=0),
    "sum of kernels": EGPRegressor(TREND, ConstantKernel() * RBF([1.0, 1.0]) * Matern(nu=2.5) + ConstantKernel()),
}


@pytest.fixture(scope="module", params=MODELS)
def model(request):
    return MODELS[request.param].fit(X, Y)


@pytest.fixture(scope="module")
def draws(model):
    """A predictor of all outputs for each draw, in the user's units."""
    posteriors = [one.posterior for one in model._fitted.models]
    assert all(isinstance(posterior, MixturePosterior) for posterior in posteriors)
    units, outputs = model._fitted.units, model._fitted.outputs
    each = zip(*(posterior.draws for posterior in posteriors), strict=True)
    return [units.predictor([draw.predictor for draw in of_all], outputs) for of_all in each]


def rows_of(model, X):
    return model._posterior.maps.rows(X, X, slice(None))


def test_moments_are_those_of_all_draws(model, draws):
    """The law of total variance, for each row and between rows."""
    rows = rows_of(model, X_NEW)
    means, variances = map(np.array, zip(*(draw.predict(*rows, True) for draw in draws), strict=True))
    mean, std = model.predict(X_NEW, return_std=True)
    assert_allclose(mean, means.mean(axis=0), rtol=1e-9, atol=1e-9)
    noise = np.mean([draw.noise for draw in draws], axis=0)
    assert_allclose(std**2, variances.mean(axis=0) + means.var(axis=0) + noise, rtol=1e-8)
    assert means.std(axis=0).max() > 0.01  # the draws differ
    _, covariance = model.predict(X_NEW, return_cov=True)
    within = np.mean([draw.covariance(*rows, 0.0)[1] for draw in draws], axis=0)
    apart = means - means.mean(axis=0)
    between = np.einsum("sno,smo->nmo", apart, apart) / len(draws)
    expected = within + between + noise * np.eye(len(X_NEW))[:, :, np.newaxis]
    assert_allclose(covariance, expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max())


def test_outputs_move_together_from_draw_to_draw(model, draws):
    rows = rows_of(model, X_NEW)
    means = np.array([draw.predict(*rows)[0] for draw in draws])
    apart = means - means.mean(axis=0)
    between = np.einsum("sni,smj->nimj", apart, apart) / len(draws)
    _, joint = model.predict(X_NEW, return_cov="joint")
    found = joint.reshape(len(X_NEW), O, len(X_NEW), O)
    # Outputs of different models have their own draws.
    expected = between[:, 0, :, 1] if len(model._fitted.models) == 1 else 0.0
    assert_allclose(found[:, 0, :, 1], expected, rtol=1e-7, atol=1e-9 * np.abs(joint).max())
    _, own = model.predict(X_NEW, return_cov=True)
    assert_allclose(found[:, 0, :, 0], own[..., 0], rtol=1e-9, atol=1e-12)


def test_weights_are_those_of_all_draws(model, draws):
    if model.feature_map_ is None:
        return
    means, covariances = map(np.array, zip(*(draw.coefficients() for draw in draws), strict=True))
    assert_allclose(model.coef_, means.mean(axis=0), rtol=1e-9, atol=1e-9)
    apart = means - means.mean(axis=0)
    expected = covariances.mean(axis=0) + np.einsum("soi,soj->oij", apart, apart) / len(draws)
    assert_allclose(model.coef_cov_, expected, rtol=1e-8, atol=1e-9)


def test_groups_of_the_draws_are_found_again(model, draws):
    again = [unmixed(group) for group in model._posterior.predictor.groups]
    for number, draw in enumerate(draws):
        for groups, expected in zip(again, draw.by_output, strict=True):
            group, index = groups[number], np.arange(O)[expected.outputs].tolist().index(groups[number].outputs[0])
            assert_allclose(group.mean[0], expected.mean[index], rtol=1e-8, atol=1e-9 * np.abs(expected.mean).max())
            covariance, other = (root.T @ root for root in (group.root[0], expected.root[index]))
            assert_allclose(covariance, other, rtol=1e-7, atol=1e-9 * np.abs(other).max())
            assert_allclose(group.signal, expected.signal[index])
            np.testing.assert_array_equal(group.points, expected.points)
            np.testing.assert_array_equal(group.hyperparameters, expected.hyperparameters)


def test_derivatives_compiled_and_sampled(model):
    mean, jacobian, std, std_jacobian = model.value_and_jacobian(X_NEW, return_std=True)
    expected, expected_std = model.predict(X_NEW, return_std=True)
    assert_allclose(mean, expected, rtol=1e-9, atol=1e-9)
    assert_allclose(std, expected_std, rtol=1e-8)
    step = 1e-5
    for column in range(D):
        moved = [X_NEW + sign * step * (np.arange(D) == column) for sign in (-1.0, 1.0)]
        low, high = (model.predict(rows, return_std=True) for rows in moved)
        assert_allclose(jacobian[..., column], (high[0] - low[0]) / (2.0 * step), rtol=1e-5, atol=1e-5)
        assert_allclose(std_jacobian[..., column], (high[1] - low[1]) / (2.0 * step), rtol=1e-4, atol=1e-4)
    assert_allclose(model.compile().predict(X_NEW), expected, rtol=1e-9, atol=1e-9)
    _, gradient_std = model.predict_gradient(X_NEW, return_std=True)
    assert np.isfinite(gradient_std).all()
    functions = model.sample_functions(400, random_state=0)
    _, noise_free = model.predict(X_NEW, return_std=True, include_noise=False)
    values = functions(X_NEW)
    # Each function has the kernel of one draw. Their mean is known to std / √400.
    assert np.abs(values.mean(axis=0) - expected).max() < (5.0 * noise_free / np.sqrt(400)).max()
    assert_allclose(values.std(axis=0), noise_free, rtol=0.25)
    value, slope = functions[3].value_and_jacobian(X_NEW)
    assert_allclose(value, values[3], rtol=1e-9, atol=1e-9)
    near = [functions[3](X_NEW + sign * step * np.eye(D)[0]) for sign in (-1.0, 1.0)]
    assert_allclose(slope[..., 0], (near[1] - near[0]) / (2.0 * step), rtol=1e-4, atol=1e-4)


def test_new_rows_update_each_draw(model):
    """The kernels of the draws stay. The posterior of each is that of all rows."""
    if isinstance(model, EGPRegressor):
        return
    updated = deepcopy(model).partial_fit(X_NEW, Y[:7])._fitted
    everything = np.vstack([X, X_NEW])
    raw = RawRows(everything, rows_of(model, everything)[1], np.vstack([Y, Y[:7]]))
    rows = updated.units.rows(LocalSource.holding(raw))
    for one in updated.models:
        expected = []
        for draw in one.posterior.draws:
            own = rows.outputs(one.outputs)
            blocks = draw.sparse.blocks(own, len(draw.values["inducing_points"][0]))
            expected.append(SparsePosterior.of(draw.sparse, draw.values, blocks).predictor)
        inputs = X_NEW, rows_of(model, X_NEW)[1]
        for found, wanted in zip(
            one.predictor.predict(*inputs, True), mixed(expected).predict(*inputs, True), strict=True
        ):
            assert_allclose(found, wanted, rtol=1e-7, atol=1e-8)
