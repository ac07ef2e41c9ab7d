"""Derivatives of predictions, against differences of `predict` and the Gaussian process of the gradient written out."""

from copy import copy

import numpy as np
import pandas as pd
import polars
import pytest
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.compose import ColumnTransformer
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, OneHotEncoder, PolynomialFeatures, StandardScaler

from skevgp import BayesianMLPRegressor, CoefPrior, EGPRegressor, EVGPRegressor, ResidualRegressor
from skevgp.noise import Gaussian

from .cases import N_OUTPUTS, QUICK, D


def differences(function, X, step=1e-4):
    """Of function(X), (n, ...), in each column of X: (n, ..., D)."""
    steps = step * np.eye(X.shape[1])
    return np.stack([(function(X + own) - function(X - own)) / (2.0 * step) for own in steps], axis=-1)


def close(actual, expected, share):
    assert actual.shape == expected.shape
    assert np.abs(actual - expected).max() <= share * np.abs(expected).max()


@pytest.mark.parametrize("include_noise", [True, False])
def test_jacobians_agree_with_differences_of_predictions(model, data, include_noise):
    X = data[2]
    mean, jacobian, std, std_jacobian = model.value_and_jacobian(X, return_std=True, include_noise=include_noise)
    expected = model.predict(X, return_std=True, include_noise=include_noise)
    np.testing.assert_allclose(mean, expected[0], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(std, expected[1], rtol=1e-9)
    assert jacobian.shape == std_jacobian.shape == (len(X), N_OUTPUTS, D)
    close(jacobian, differences(model.predict, X), 1e-6)

    def std_of(rows):
        return model.predict(rows, return_std=True, include_noise=include_noise)[1]

    close(std_jacobian, differences(std_of, X), 1e-5)
    np.testing.assert_array_equal(model.jacobian(X), jacobian)
    for one, other in zip(model.value_and_jacobian(X), (mean, jacobian), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_gradient_of_the_exact_model_is_the_formula(data):
    """Rasmussen & Williams 2006, section 9.4, with k + h Σ hᵀ as the kernel (section 2.7)."""
    X, Y, X_new = data
    scale, s2, noise, lengths = 1.5, 2.0, 0.01, np.array([0.9, 1.2])
    kernel = ConstantKernel(s2, "fixed") * RBF(lengths, "fixed") + WhiteKernel(noise, "fixed")
    model = EGPRegressor(PolynomialFeatures(1), kernel, coef_prior=CoefPrior(scale=scale)).fit(X, Y[:, 0])
    gradient, cov = model.predict_gradient(X_new, return_cov=True)
    K = model.kernel_(X) + scale**2 * (1.0 + X @ X.T) + noise * np.eye(len(X))
    for x, own_gradient, own_cov in zip(X_new, gradient, cov, strict=True):
        slopes = (X - x) / lengths**2 * model.kernel_(X, x[np.newaxis]) + scale**2 * X
        np.testing.assert_allclose(own_gradient, slopes.T @ np.linalg.solve(K, Y[:, 0]), rtol=1e-7, atol=1e-9)
        prior = np.diag(s2 / lengths**2) + scale**2 * np.eye(D)
        np.testing.assert_allclose(own_cov, prior - slopes.T @ np.linalg.solve(K, slopes), rtol=1e-6, atol=1e-9)


def test_covariance_of_a_gradient_is_that_of_differences(model, data):
    X, h = data[2], 1e-2
    gradient, cov = model.predict_gradient(X, return_cov=True)
    np.testing.assert_array_equal(gradient, model.jacobian(X))
    assert cov.shape == (len(X), N_OUTPUTS, D, D)
    _, std = model.predict_gradient(X, return_std=True)
    np.testing.assert_allclose(std, np.sqrt(np.einsum("noii->noi", cov)), rtol=1e-12)
    for row, own in zip(X[:3], cov, strict=False):
        points = row + h * np.vstack([np.eye(D), -np.eye(D)])
        between = model.predict(points, return_cov=True, include_noise=False)[1]
        by = np.hstack([np.eye(D), -np.eye(D)]) / (2.0 * h)
        close(own, np.einsum("ai,ijo,bj->oab", by, between, by), 5e-3)


def test_novelty_is_the_share_of_the_variance_of_f_that_is_left(model, data):
    novelty = model.novelty(np.vstack([data[2], 3.0 * data[2], data[0]]))
    assert novelty.shape == (18 + len(data[0]), N_OUTPUTS)
    assert (novelty >= 0.0).all()
    assert (novelty <= 1.0).all()
    assert np.median(novelty[18:]) < np.median(novelty[9:18])


class Squashed(TransformerMixin, BaseEstimator):
    """The map that the next test has differentiated, with its derivative."""

    def __init__(self, unit, offset):
        self.unit, self.offset = unit, offset

    def fit(self, X, y=None):
        return self

    def transform(self, X):
        return np.tanh((X - self.offset) / self.unit)

    def jacobian(self, X):
        return (1.0 - self.transform(X) ** 2)[:, :, np.newaxis] * np.eye(D) / self.unit


@pytest.mark.parametrize(("unit", "offset"), [(1e-6, 0.0), (1.0, 1e8), (1e7, 0.0), (1e-6, -3.0)])
@pytest.mark.parametrize(
    ("frame", "split"), [(None, "together"), (pd.DataFrame, "in a pipeline"), (polars.DataFrame, "of columns")]
)
def test_differences_take_steps_in_the_units_of_the_columns(data, unit, offset, frame, split):
    X, Y, X_new = data[0][:40], data[1][:40], data[2]
    names = slice(0, 2) if frame is None else ["a", "b"]
    centred, together = FunctionTransformer(lambda X: X - offset), FunctionTransformer(Squashed(unit, offset).transform)
    kernel_map = {
        "together": together,
        "in a pipeline": make_pipeline(centred, FunctionTransformer(lambda X: np.tanh(X / unit))),
        "of columns": ColumnTransformer([("all", together, names)]),
    }[split]
    X, X_new = X * unit + offset, X_new * unit + offset
    given = X if frame is None else frame({"a": X[:, 0], "b": X[:, 1]})
    model = EVGPRegressor(kernel_map=kernel_map, n_inducing=10, **QUICK).fit(given, Y[:, 0])
    exact = copy(model)
    exact.kernel_map_ = Squashed(unit, offset)
    for ask in (EVGPRegressor.compile, lambda model: model.sample_functions(2, n_waves=20)):
        found, expected = (ask(each).value_and_jacobian(X_new)[1] for each in (model, exact))
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-6 * np.abs(expected).max())


def test_novelty_takes_what_predict_takes_and_derivatives_need_numbers(data):
    X, Y, X_new = data
    encoder = ColumnTransformer([("words", OneHotEncoder(), ["c"]), ("numbers", StandardScaler(), ["a", "b"])])

    def frame_of(rows):
        return pd.DataFrame(rows, columns=["a", "b"]).assign(c=np.where(rows[:, 0] > 0.5, "high", "low"))

    model = EVGPRegressor(kernel_map=encoder, n_inducing=10, **QUICK).fit(frame_of(X), Y[:, 0])
    _, std = model.predict(frame_of(X_new), return_std=True, include_noise=False)
    expected = std**2 / model._posterior.predictor.signal
    np.testing.assert_allclose(model.novelty(frame_of(X_new)), expected, rtol=1e-6, atol=1e-9)
    many = model.novelty(frame_of(np.repeat(X_new, 1000, axis=0)))
    np.testing.assert_allclose(many, np.repeat(expected, 1000), rtol=1e-6, atol=1e-9)
    message = r"\['c'\] of X are not numbers.* derivatives"
    for method in (model.jacobian, model.value_and_jacobian, model.predict_gradient):
        with pytest.raises(ValueError, match=message):
            method(frame_of(X_new))
    for method in (model.compile, model.sample_functions):
        with pytest.raises(ValueError, match=message):
            method()
    with pytest.raises(ValueError, match=r"inputs of Gaussian noise needs numbers.*\['c'\] are not numbers"):
        model.set_params(noise=Gaussian(inputs=0.1)).fit(frame_of(X), Y[:, 0])
    numbers = EVGPRegressor(kernel_map=StandardScaler(), n_inducing=10, **QUICK)
    numbers.fit(pd.DataFrame(X, columns=["a", "c"]), Y[:, 0])
    with pytest.raises(ValueError, match=message):
        numbers.jacobian(frame_of(X_new)[["a", "c"]])


def test_residual_regressor_jacobian_includes_base(data):
    X, Y, X_new = data
    model = ResidualRegressor(EVGPRegressor(n_inducing=10, **QUICK), base=[1, 0, 0])
    model.fit(X, Y)
    mean, jacobian, std, _ = model.value_and_jacobian(X_new, return_std=True, include_noise=False)
    expected = model.predict(X_new, return_std=True, include_noise=False)
    np.testing.assert_allclose(mean, expected[0])
    np.testing.assert_allclose(std, expected[1])
    close(jacobian, differences(model.predict, X_new), 1e-6)
    np.testing.assert_array_equal(model.jacobian(X_new), jacobian)
    gradient, std = model.predict_gradient(X_new, return_std=True)
    np.testing.assert_array_equal(gradient, jacobian)
    np.testing.assert_array_equal(std, model.regressor_.predict_gradient(X_new, return_std=True)[1])
    np.testing.assert_array_equal(model.novelty(X_new), model.regressor_.novelty(X_new))
    single = ResidualRegressor(EVGPRegressor(n_inducing=10, **QUICK), base=1).fit(X, Y[:, 0])
    close(single.jacobian(X_new), differences(single.predict, X_new), 1e-6)
    for method in ("value_and_jacobian", "novelty"):
        assert not hasattr(ResidualRegressor(BayesianMLPRegressor()), method)


def test_derivatives_are_not_for_dask_arrays(data):
    da = pytest.importorskip("dask.array")
    X, Y, _ = data
    model = EVGPRegressor(n_inducing=10, **QUICK).fit(X, Y)
    with pytest.raises(ValueError, match="instead of a Dask array"):
        model.jacobian(da.from_array(X))
    with pytest.raises(ValueError, match="novelty needs rows in memory"):
        model.novelty(da.from_array(X))
