"""What clients of the estimators expect of any scikit-learn regressor, and of a Gaussian process in particular."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.feature_selection import RFE, SelectFromModel
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, Kernel
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EGPRegressor, EVGPRegressor

RNG = np.random.RandomState(0)
X = RNG.uniform(-2.0, 2.0, (40, 2))
Y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], X[:, 0] * X[:, 1]]) + 0.05 * RNG.randn(40, 2)
X_NEW = RNG.uniform(-2.0, 2.0, (15, 2))
WEIGHTS = ["coef_", "coef_std_", "coef_cov_", "coef_prior_mean_", "coef_prior_scale_"]
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
    assert arrays >= {*WEIGHTS, "loss_curve_"}
    for name in arrays:
        actual, expected = getattr(column, name), getattr(plain, name)
        assert actual.shape == expected.shape
        np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-9)


# --- weights ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", MODELS, ids=str)
@pytest.mark.parametrize("name", WEIGHTS)
def test_without_a_map_there_are_no_weights(model, name):
    message = f"{type(model).__name__} has {name} only after a fit with a feature_map: without one there are no weights"
    for one in (model, fresh(model, feature_map=TREND), fresh(model).fit(X, Y)):
        assert not hasattr(one, name)
        with pytest.raises(AttributeError, match=message):
            getattr(one, name)


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_weights_of_an_earlier_fit_do_not_stay(model):
    fitted = fresh(model, feature_map=TREND).fit(X, Y)
    assert all(hasattr(fitted, name) for name in WEIGHTS)
    fitted.set_params(feature_map=None).fit(X, Y)
    assert not any(hasattr(fitted, name) for name in WEIGHTS)


@pytest.mark.parametrize(
    "model", [EVGPRegressor(n_inducing=15, tol=1.0, random_state=0), EGPRegressor(tol=1.0)], ids=str
)
def test_columns_are_ranked_by_length_scales(model):
    rng = np.random.RandomState(1)
    rows = rng.uniform(-2.0, 2.0, (80, 4))
    y = np.sin(2.0 * rows[:, 1]) + 0.01 * rng.randn(80)
    with pytest.raises(ValueError, match="should have `coef_` or `feature_importances_`"):
        SelectFromModel(model).fit(rows, y).get_support()
    getter = {"importance_getter": lambda model: 1 / model.kernel_.k2.length_scale}  # as the docstrings say
    for select in (SelectFromModel(model, **getter), RFE(model, n_features_to_select=1, **getter)):
        assert select.fit(rows, y).get_support().tolist() == [False, True, False, False]


# --- errors -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("estimator", [EVGPRegressor, EGPRegressor])
def test_a_kernel_as_the_first_argument_is_sent_to_kernel(estimator):
    # As in scikit-learn's GaussianProcessRegressor, whose first argument it is.
    with pytest.raises(TypeError, match=r"feature_map=RBF\(length_scale=2\) is a kernel: give it as kernel="):
        estimator(RBF(2.0)).fit(X, Y)
