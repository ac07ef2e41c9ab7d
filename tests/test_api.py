"""What clients of the estimators expect of any scikit-learn regressor, and of a Gaussian process in particular."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import Kernel
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EGPRegressor, EVGPRegressor

RNG = np.random.RandomState(0)
X = RNG.uniform(-2.0, 2.0, (40, 2))
Y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], X[:, 0] * X[:, 1]]) + 0.05 * RNG.randn(40, 2)
X_NEW = RNG.uniform(-2.0, 2.0, (15, 2))
TREND = PolynomialFeatures(1)
MODELS = [
    EVGPRegressor(max_iter=0, n_inducing=8, random_state=0),
    EVGPRegressor(max_iter=0, n_inducing=8, random_state=0, sharing="none"),
    EGPRegressor(max_iter=0),
]


def fresh(model, **parameters):
    return clone(model).set_params(**parameters)


# --- shapes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", MODELS, ids=str)
@pytest.mark.parametrize("y", [Y[:, 0], Y[:, :1], Y], ids=["one output", "one column", "two outputs"])
def test_shapes_are_those_of_scikit_learns_gaussian_process(model, y):
    ours, theirs = fresh(model).fit(X, y), GaussianProcessRegressor(optimizer=None).fit(X, y)
    assert ours.predict(X_NEW).shape == theirs.predict(X_NEW).shape
    for asked in ("return_std", "return_cov"):
        found, expected = (one.predict(X_NEW, **{asked: True}) for one in (ours, theirs))
        assert [part.shape for part in found] == [part.shape for part in expected]
    assert ours.sample_y(X_NEW, 3).shape == theirs.sample_y(X_NEW, 3).shape


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_a_y_of_one_column_is_one_output(model):
    column, plain = (fresh(model, feature_map=TREND).fit(X, y) for y in (Y[:, :1], Y[:, 0]))
    assert isinstance(column.kernel_, Kernel)
    np.testing.assert_allclose(column.kernel_.theta, plain.kernel_.theta)
    assert isinstance(column.noise_variance_, float)
    arrays = {name for name, value in vars(plain).items() if name.endswith("_") and isinstance(value, np.ndarray)}
    assert arrays >= {"coef_", "coef_std_", "coef_cov_", "coef_prior_mean_", "coef_prior_scale_", "loss_curve_"}
    for name in arrays:
        actual, expected = getattr(column, name), getattr(plain, name)
        assert actual.shape == expected.shape
        np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-9)
