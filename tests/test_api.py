"""What clients of the estimators expect of any scikit-learn regressor, and of a Gaussian process in particular."""

import numpy as np
import pytest
import skops.io
from sklearn.base import clone
from sklearn.compose import make_column_transformer
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, Matern, WhiteKernel
from sklearn.preprocessing import OneHotEncoder, PolynomialFeatures, StandardScaler

from skevgp import BayesianMLPRegressor, CoefPrior, EGPRegressor, EVGPRegressor, ResidualRegressor
from skevgp.solvers import LBFGS, Adam

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


# --- data frames --------------------------------------------------------------------------------------------------

ENCODE = make_column_transformer((OneHotEncoder(drop="if_binary"), ["kind"]))


SCALE = make_column_transformer((StandardScaler(), ["a", "b"]))


def with_words(rows):
    """Columns of a frame: those of the rows, and in words whether the second is positive."""
    return {"a": rows[:, 0], "kind": np.where(rows[:, 1] > 0, "up", "down"), "b": rows[:, 1]}


@pytest.mark.parametrize("model", MODELS, ids=str)
@pytest.mark.parametrize("feature_map", [None, ENCODE])
def test_without_a_kernel_map_the_columns_must_be_numbers(model, feature_map, frame_of):
    message = r"The columns \['kind'\] of X are not numbers, but with kernel_map=None .*: give a kernel_map"
    with pytest.raises(ValueError, match=message):
        fresh(model, feature_map=feature_map).fit(frame_of(with_words(X)), Y)


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


def test_frame_of_words_must_have_rows_and_the_columns_of_the_fit(frame_of):
    columns = with_words(X)
    m = fresh(MODELS[0], feature_map=ENCODE, kernel_map=SCALE).fit(frame_of(columns), Y)
    with pytest.raises(ValueError, match=r"X is empty: its shape is \(0, 3\)"):
        m.predict(frame_of({name: column[:0] for name, column in columns.items()}))
    columns.pop("b")
    with pytest.raises(ValueError, match="Feature names seen at fit time, yet now missing"):
        m.predict(frame_of(columns))


# --- files --------------------------------------------------------------------------------------------------------

SHORT = {"n_inducing": 5, "max_iter": 1, "noise_cv": None, "random_state": 0}
SAVED = [
    EVGPRegressor(TREND, kernel_map=StandardScaler(), **SHORT | {"sharing": [[0], [1]]}),
    EVGPRegressor(TREND, solver=Adam(natural_gradient=True), **SHORT | {"sharing": "all"}),
    EVGPRegressor(TREND, solver=LBFGS(posterior="diagonal"), **SHORT | {"sharing": "none"}),
    EGPRegressor(
        TREND,
        2.0 * RBF([0.5, 0.7], "fixed") + Matern(nu=1.5) + WhiteKernel(0.1),
        coef_prior=CoefPrior(scale=np.inf),
        max_iter=3,
    ),
    BayesianMLPRegressor((5,), max_iter=3, random_state=0),
    ResidualRegressor(EVGPRegressor(**SHORT | {"sharing": "all"})),
]


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("model", SAVED, ids=str)
@pytest.mark.parametrize("used", [False, True], ids=["fresh", "used"])
def test_model_from_a_skops_file_is_the_model(model, used):
    fitted = clone(model).fit(X, Y)
    if used:
        fitted.predict(X_NEW, return_std=True)
    file = skops.io.dumps(fitted)
    trusted = skops.io.get_untrusted_types(data=file)
    assert all(name.startswith(("skevgp.", "sklearn.")) or name == "operator.itemgetter" for name in trusted)
    loaded = skops.io.loads(file, trusted=trusted)
    for asked in ("return_std", "return_cov"):
        expected = fitted.predict(X_NEW, **{asked: True})
        for actual, part in zip(loaded.predict(X_NEW, **{asked: True}), expected, strict=True):
            np.testing.assert_array_equal(actual, part)


# --- errors -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("estimator", [EVGPRegressor, EGPRegressor])
def test_kernel_as_the_first_argument_is_sent_to_kernel(estimator):
    # As in scikit-learn's GaussianProcessRegressor, whose first argument it is.
    with pytest.raises(TypeError, match=r"feature_map=RBF\(length_scale=2\) is a kernel. Pass it as kernel="):
        estimator(RBF(2.0)).fit(X, Y)
