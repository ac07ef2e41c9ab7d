"""What clients of the estimators expect of any scikit-learn regressor, and of a Gaussian process in particular."""

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.compose import make_column_transformer
from sklearn.feature_selection import RFE, SelectFromModel
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, Kernel
from sklearn.impute import SimpleImputer
from sklearn.preprocessing import OneHotEncoder, PolynomialFeatures, StandardScaler

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


# --- data frames --------------------------------------------------------------------------------------------------

NAMES = ["a", "kind", "b"]
ENCODE = make_column_transformer((OneHotEncoder(drop="if_binary"), ["kind"]))
SCALE = make_column_transformer((StandardScaler(), ["a", "b"]))


def with_words(rows):
    """Columns of a frame: those of the rows, and in words whether the second is positive."""
    return {"a": rows[:, 0], "kind": np.where(rows[:, 1] > 0, "up", "down"), "b": rows[:, 1]}


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_maps_choose_columns_of_a_frame_by_name(model, frame_of):
    frame, new = (frame_of({"a": rows[:, 0], "b": rows[:, 1]}) for rows in (X, X_NEW))
    by_name = fresh(model, feature_map=make_column_transformer((TREND, ["b"]))).fit(frame, Y)
    by_place = fresh(model, feature_map=make_column_transformer((TREND, [1]))).fit(X, Y)
    for actual, expected in zip(by_name.predict(new, True), by_place.predict(X_NEW, True), strict=True):
        np.testing.assert_allclose(actual, expected, rtol=1e-6)
    assert by_name.feature_names_in_.tolist() == ["a", "b"]


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_with_a_kernel_map_a_frame_may_hold_words(model, frame_of):
    frame, new = (frame_of(with_words(rows)) for rows in (X, X_NEW))
    numbers, new_numbers = (np.column_stack([rows[:, 0], rows[:, 1] > 0, rows[:, 1]]) for rows in (X, X_NEW))
    scale = make_column_transformer((StandardScaler(), [0, 2]))
    expected = fresh(model, feature_map=make_column_transformer(("passthrough", [1])), kernel_map=scale).fit(numbers, Y)
    m = fresh(model, feature_map=ENCODE, kernel_map=SCALE).fit(frame, Y)
    for asked in ("return_std", "return_cov"):
        for one, other in zip(
            m.predict(new, **{asked: True}), expected.predict(new_numbers, **{asked: True}), strict=True
        ):
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(m.sample_y(new), expected.sample_y(new_numbers), rtol=1e-4)
    np.testing.assert_allclose(m.coef_prior_scale_, expected.coef_prior_scale_)
    assert m.n_features_in_ == 3
    assert m.feature_names_in_.tolist() == NAMES
    # Without features nothing but the kernel map sees X.
    assert fresh(model, kernel_map=SCALE).fit(frame, Y).predict(new).shape == (15, 2)


def test_partial_fit_takes_words_too(frame_of):
    m = fresh(MODELS[0], feature_map=ENCODE, kernel_map=SCALE).fit(frame_of(with_words(X)), Y)
    m.set_params(kernel_map=None)  # that of the next fit
    before = m.predict(frame_of(with_words(X_NEW)))
    m.partial_fit(frame_of(with_words(X_NEW)), before + 1.0)
    assert (m.predict(frame_of(with_words(X_NEW))) > before).all()


@pytest.mark.parametrize("model", MODELS, ids=str)
@pytest.mark.parametrize("feature_map", [None, ENCODE])
def test_without_a_kernel_map_the_columns_must_be_numbers(model, feature_map, frame_of):
    message = r"The columns \['kind'\] of X are not numbers, but with kernel_map=None .*: give a kernel_map"
    with pytest.raises(ValueError, match=message):
        fresh(model, feature_map=feature_map).fit(frame_of(with_words(X)), Y)


def test_a_kernel_map_may_fill_what_is_missing():
    holes = pd.DataFrame(X.copy(), columns=["a", "b"])
    holes.loc[3, "a"] = np.nan
    filled = fresh(MODELS[0], kernel_map=SimpleImputer()).fit(holes, Y)
    np.testing.assert_allclose(filled.kernel_map_.statistics_, np.nanmean(holes, axis=0))
    with pytest.raises(ValueError, match=r"kernel_map=StandardScaler\(\) returned NaN or infinity"):
        fresh(MODELS[0], kernel_map=StandardScaler()).fit(holes, Y)
    with pytest.raises(ValueError, match="Input X contains NaN"):
        fresh(MODELS[0]).fit(holes, Y)


@pytest.mark.parametrize(
    ("y", "message"),
    [
        (Y[:-1], "inconsistent numbers of samples"),
        (np.where(Y > 0, Y, np.nan), "Input y contains NaN"),
        (np.where(Y > 0, "up", "down"), "y must be real numbers"),
        (None, "requires y to be passed, but the target y is None"),
        (1e200 * Y, "y must not exceed 1e\\+100 in size"),
    ],
    ids=["too few", "NaN", "words", "none", "too large"],
)
def test_targets_beside_words_are_checked(y, message, frame_of):
    frame = frame_of(with_words(X))
    m = fresh(MODELS[0], feature_map=ENCODE, kernel_map=SCALE).fit(frame, Y)
    for method in (m.fit, m.partial_fit):
        with pytest.raises(ValueError, match=message):
            method(frame, y)


def test_a_frame_of_words_must_have_rows_and_the_columns_of_the_fit(frame_of):
    columns = with_words(X)
    m = fresh(MODELS[0], feature_map=ENCODE, kernel_map=SCALE).fit(frame_of(columns), Y)
    with pytest.raises(ValueError, match=r"X is empty: its shape is \(0, 3\)"):
        m.predict(frame_of({name: column[:0] for name, column in columns.items()}))
    columns.pop("b")
    with pytest.raises(ValueError, match="Feature names seen at fit time, yet now missing"):
        m.predict(frame_of(columns))


# --- errors -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("estimator", [EVGPRegressor, EGPRegressor])
def test_a_kernel_as_the_first_argument_is_sent_to_kernel(estimator):
    # As in scikit-learn's GaussianProcessRegressor, whose first argument it is.
    with pytest.raises(TypeError, match=r"feature_map=RBF\(length_scale=2\) is a kernel: give it as kernel="):
        estimator(RBF(2.0)).fit(X, Y)
