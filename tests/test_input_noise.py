"""Noise in X: what a row's noise variance grows by, and what a fit that knows of it learns."""

import numpy as np
import pandas as pd
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel
from sklearn.impute import SimpleImputer
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from skevgp import CoefPrior, EVGPRegressor, ResidualRegressor
from skevgp.data.dataset import Dataset
from skevgp.fitting.noisy_inputs import look_at_slopes
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS


def variance_by_inputs(model, X, Y, covariance):
    """∂g Σ ∂gᵀ of each row and output."""
    data = Dataset.further(model, model._posterior.maps, X, Y)
    return look_at_slopes(model._posterior, data, X, covariance)[0]


def test_input_noise_of_linear_function():
    """There ∂g Σ ∂gᵀ is the same of all rows, and σ² what it leaves of the noise."""
    rng = np.random.RandomState(0)
    x = rng.uniform(-1.0, 1.0, (2500, 2))
    X, y = x + [0.1, 0.05] * rng.randn(2500, 2), x @ [2.0, -1.0] + 0.1 * rng.randn(2500)
    kernel = ConstantKernel(1e-8, "fixed") * RBF(1.0, "fixed")
    options = {
        "kernel": kernel,
        "n_inducing": 5,
        "coef_prior": CoefPrior(scale=10.0),
        "noise_cv": None,
        "random_state": 0,
    }
    plain = EVGPRegressor(FunctionTransformer(), **options).fit(X, y)
    found = EVGPRegressor(FunctionTransformer(), noise=Gaussian(inputs=[0.1, 0.05]), **options).fit(X, y)
    by_inputs = (2.0 * 0.1) ** 2 + 0.05**2
    assert plain.noise_variance_ == pytest.approx(0.01 + by_inputs, rel=0.1)
    # Weights that are learned from noisy X are a little too small, and what they leave counts as noise.
    assert found.noise_variance_ == pytest.approx(0.012, rel=0.4)
    covariance = np.diag([0.1**2, 0.05**2])
    np.testing.assert_allclose(variance_by_inputs(found, X, y, covariance), by_inputs, rtol=0.15)


def test_variance_by_inputs_is_that_of_the_jacobian(monkeypatch):
    monkeypatch.setattr("skevgp.fitting.noisy_inputs._ROWS_AT_ONCE", 7)
    rng = np.random.RandomState(0)
    X = rng.uniform(-1.0, 1.0, (40, 2))
    Y = np.sin(X @ [[2.0, 1.0], [1.0, 3.0]])
    model = EVGPRegressor(kernel_map=StandardScaler(), n_inducing=8, sharing="all", solver=LBFGS(tol=1e6)).fit(X, Y)
    covariance = np.array([[0.04, 0.01], [0.01, 0.02]])
    slopes = model.jacobian(X)
    found = variance_by_inputs(model, X, Y, covariance)
    np.testing.assert_allclose(found, np.einsum("noi,ij,noj->no", slopes, covariance, slopes), rtol=1e-10)


@pytest.mark.parametrize("sharing", ["all", "none", "kernel"])
def test_input_noise_with_frames_weights_and_partial_fit(sharing):
    rng = np.random.RandomState(0)
    X = rng.uniform(-1.0, 1.0, (80, 2))
    Y = np.column_stack([np.sin(3.0 * X[:, 0]), X[:, 1]]) + 0.02 * rng.randn(80, 2)
    frame = pd.DataFrame(X, columns=["a", "b"])
    model = EVGPRegressor(
        kernel_map=StandardScaler(),
        noise=Gaussian(inputs=np.diag([0.01, 0.0])),
        sharing=sharing,
        n_inducing=8,
        noise_cv=None,
        solver=LBFGS(tol=1e6),
    )
    model.fit(frame, Y, sample_weight=np.arange(80) % 3)
    before = model.predict(frame)
    model.partial_fit(frame[:10], Y[:10] + 0.5)
    assert np.isfinite(model.predict(frame)).all()
    assert np.abs(model.predict(frame) - before).max() > 0.0
    assert np.isfinite(model.lower_bound_)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noise": Gaussian(inputs=[0.1, 0.1, 0.1])}, "n_features=2 columns of X"),
        ({"noise": Gaussian(inputs=[-0.1, 0.1])}, "must not be negative"),
        ({"noise": Gaussian(inputs=np.nan)}, "inputs of Gaussian must be finite"),
        ({"noise": Gaussian(inputs=[[1.0, 0.5], [0.0, 1.0]])}, "symmetric and positive semi-definite"),
        ({"noise": Gaussian(inputs=[[1.0, 2.0], [2.0, 1.0]])}, "symmetric and positive semi-definite"),
        ({"noise": Gaussian(inputs="much")}, "inputs of Gaussian"),
        ({"noise": Gaussian(inputs=0.1), "solver": "adam"}, 'inputs of Gaussian noise needs solver="lbfgs"'),
    ],
)
def test_invalid_arguments_raise(options, message):
    X = np.random.RandomState(0).randn(30, 2)
    with pytest.raises((ValueError, TypeError), match=message):
        EVGPRegressor(**{"n_inducing": 5, "max_iter": 3, "solver": LBFGS(tol=1e6), **options}).fit(X, X[:, 0])


def test_values_that_are_missing_have_no_slopes():
    X = pd.DataFrame(np.random.RandomState(0).randn(30, 2), columns=["a", "b"])
    y = X["a"].copy()
    X.loc[3, "b"] = np.nan
    with pytest.raises(ValueError, match="without missing values"):
        EVGPRegressor(
            kernel_map=SimpleImputer(), n_inducing=5, max_iter=3, solver=LBFGS(tol=1e6), noise=Gaussian(inputs=0.1)
        ).fit(X, y)


def test_changes_of_noisy_columns_are_noisy_by_these_too():
    """What is learned of y - x has -η in it: σ² is that of y learned directly."""
    rng = np.random.RandomState(0)
    z = rng.uniform(-2.0, 2.0, (800, 1))
    X, y = z + 0.03 * rng.randn(800, 1), z[:, 0] + 0.3 * np.sin(2.0 * z[:, 0]) + 0.01 * rng.randn(800)
    options = {"n_inducing": 15, "random_state": 0, "noise": Gaussian(inputs=0.03)}
    direct = EVGPRegressor(FunctionTransformer(), **options).fit(X, y)
    changes = ResidualRegressor(EVGPRegressor(**options)).fit(X, y)
    assert np.sqrt(direct.noise_variance_) == pytest.approx(0.01, rel=0.4)
    assert np.sqrt(changes.regressor_.noise_variance_) == pytest.approx(0.01, rel=0.4)
    before = changes.predict(X, return_std=True)[1].mean()
    assert changes.partial_fit(X[:50], y[:50]).predict(X, return_std=True)[1].mean() == pytest.approx(before, rel=0.1)
