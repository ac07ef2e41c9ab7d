"""Weights without prior knowledge are free: what the features can represent costs nothing."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from sklearn.base import clone
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor
from skevgp.features import InertiaForce, InertiaForceGravity

RNG = np.random.default_rng(0)
X, NEW = RNG.uniform(-2.0, 2.0, (40, 2)), RNG.uniform(-3.0, 3.0, (20, 2))
Y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], np.cos(X[:, 1]) - X[:, 0]]) + 0.1 * RNG.standard_normal((40, 2))
LINE = PolynomialFeatures(1)


def line_of_each_output(X):
    """An intercept and a slope, which two outputs may share."""
    ones = np.ones(len(X))
    return np.stack([np.column_stack([ones, X[:, 0]]), np.column_stack([ones, X[:, 1]])], axis=1)


OF_EACH = FunctionTransformer(line_of_each_output)
EVGP = EVGPRegressor(LINE, n_inducing=10, random_state=0)
MODELS = {
    "sparse": (EVGP, Y[:, 0]),
    "exact": (EGPRegressor(LINE), Y[:, 0]),
    "two outputs": (clone(EVGP).set_params(sharing="kernel"), Y),
    "shared": (clone(EVGP).set_params(feature_map=OF_EACH, coef_prior=CoefPrior(shared=True)), Y),
    "shared, exact": (EGPRegressor(OF_EACH, coef_prior=CoefPrior(shared=True)), Y),
    "student-t": (clone(EVGP).set_params(noise="student-t"), Y[:, 0]),
    "inertia and gravity": (clone(EVGP).set_params(feature_map=InertiaForceGravity(), sharing="all"), Y),
}


def predictions_without(model, X, y, offset, new, offset_of_new):
    """Mean and std of rows whose y has an offset, without the offset of the mean."""
    mean, std = clone(model).fit(X, y + offset).predict(new, return_std=True)
    return mean - offset_of_new, std


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize(("model", "y"), MODELS.values(), ids=MODELS)
def test_what_features_represent_changes_neither_errors_nor_std(model, y):
    of_rows, of_new = (np.asarray(clone(model.feature_map).fit_transform(rows)) for rows in (X, NEW))
    p = of_rows.shape[-1]
    b = 1e6 * np.where(np.arange(p) % 2, 1.0, -1.0)[:, np.newaxis] * np.ones(y[0].size)
    if of_rows.ndim == 3:
        offset, offset_of_new = of_rows @ b[:, 0], of_new @ b[:, 0]
    else:
        offset, offset_of_new = ((H @ b).reshape(len(H), *y.shape[1:]) for H in (of_rows, of_new))
    model = clone(model).set_params(max_iter=6)
    mean, std = predictions_without(model, X, y, 0.0, NEW, 0.0)
    moved, moved_std = predictions_without(model, X, y, offset, NEW, offset_of_new)
    # Both fits start at the same place and take the same way, up to rounding.
    np.testing.assert_array_less(np.abs(moved - mean), 0.05 * std)
    np.testing.assert_allclose(moved_std, std, rtol=0.02)


@given(
    st.integers(0, 10_000),
    st.sampled_from([LINE, PolynomialFeatures(2), FunctionTransformer(np.tanh), InertiaForce()]),
    st.sampled_from([1.0, 1e3, 1e6]),
    st.sampled_from([0.0, 300.0]),
    st.booleans(),
)
def test_what_features_represent_is_added_to_predictions(seed, feature_map, size, far, exact):
    """For a given kernel and noise, up to rounding and 1e-6 of std. Columns may be far from 0."""
    rng = np.random.default_rng(seed)
    rows, new = rng.normal(size=(80, 2)) + far, rng.normal(size=(5, 2)) + far
    kernel = ConstantKernel(2.0, "fixed") * RBF(1.5, "fixed") + WhiteKernel(0.1, "fixed")
    model = (
        EGPRegressor(feature_map, kernel)
        if exact
        else EVGPRegressor(feature_map, kernel, n_inducing=8, max_iter=0, random_state=0)
    )
    H = np.asarray(clone(feature_map).fit_transform(rows))
    unit = np.sqrt(np.mean(H**2, axis=0))
    singular = np.linalg.svd(H / unit, compute_uv=False)
    # Sums of products keep the digits of such features.
    assume(singular[-1] > 1e-4 * singular[0])
    y = np.sin(rows[:, 0]) + 0.1 * rng.normal(size=80)
    b = size * rng.normal(size=H.shape[1]) / unit
    mean, std = predictions_without(model, rows, y, 0.0, new, 0.0)
    offset_of_new = clone(feature_map).fit(rows).transform(new) @ b
    moved, moved_std = predictions_without(model, rows, y, H @ b, new, offset_of_new)
    rounding = 1e-13 * size * singular[0] / singular[-1] * np.abs(H).max() / unit.min()
    np.testing.assert_array_less(np.abs(moved - mean), 1e-4 * std + rounding)
    np.testing.assert_allclose(moved_std, std, rtol=1e-4)


def test_temperature_in_kelvin_is_forecast_from_its_trend():
    x = np.linspace(0.0, 10.0, 200)[:, np.newaxis]
    waves = 4.0 * np.sin(0.8 * np.pi * x[:, 0]) + 0.3 * np.random.default_rng(0).standard_normal(200)
    mean, std = (
        EVGPRegressor(LINE, random_state=0).fit(x, 290.0 + 0.8 * x[:, 0] + waves).predict([[12.0]], return_std=True)
    )
    assert abs(mean[0] - 299.6) < 2.0 * std[0] < 20.0


def test_learned_scale_of_groups_follows_the_size_of_weights():
    model = clone(EVGP).set_params(coef_prior=CoefPrior(groups=["intercept", "slopes", "slopes"]))
    mean, std = predictions_without(model, X, Y[:, 0], 0.0, NEW, 0.0)
    moved, moved_std = predictions_without(model, X, Y[:, 0], 1e6, NEW, 1e6)
    np.testing.assert_array_less(np.abs(moved - mean), 0.2 * std)
    np.testing.assert_allclose(moved_std, std, rtol=0.1)


def test_warning_names_weights_far_from_a_narrow_prior():
    model = clone(EVGP).set_params(coef_prior=CoefPrior(scale=[1e3, 1.0, 1.0]))
    with pytest.warns(UserWarning, match=r"The weights of x0 are more than 100 prior standard deviations away"):
        model.fit(X, Y[:, 0] + 1e4 * X[:, 0])
