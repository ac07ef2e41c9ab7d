"""What clients of the estimators expect of any scikit-learn regressor, and of a Gaussian process in particular."""

import numpy as np
import pytest
import skops.io
from sklearn.base import clone
from sklearn.compose import make_column_transformer
from sklearn.feature_selection import RFE, SelectFromModel
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel
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


# --- values: six points of x sin(x), hardly any noise, as scikit-learn's own tests have them ----------------------

SIX = np.array([[1.0], [3.0], [5.0], [6.0], [7.0], [8.0]])
SIX_Y = SIX[:, 0] * np.sin(SIX[:, 0])
BETWEEN = np.array([[2.0], [4.0], [5.5], [6.5], [7.5]])
ALPHA = 1e-10
WAVE = ConstantKernel(1.0, (1e-2, 1e2)) * RBF(1.0, (1e-3, 1e3))
# The outermost constant is the signal variance; without a fixed one a free one would be put in front.
KERNELS = [
    ConstantKernel(1.0, "fixed") * kernel for kernel in (RBF(1.0), WAVE, WAVE + ConstantKernel(1e-5, (1e-5, 1e2)))
]


def both(kernel, y=SIX_Y, optimise=True):
    """The exact model, and scikit-learn's, with the same kernel and noise."""
    ours = EGPRegressor(kernel=kernel + WhiteKernel(ALPHA, "fixed"), max_iter=1000 if optimise else 0)
    theirs = GaussianProcessRegressor(kernel, alpha=ALPHA, optimizer="fmin_l_bfgs_b" if optimise else None)
    return ours.fit(SIX, y), theirs.fit(SIX, y)


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
@pytest.mark.parametrize("y", [SIX_Y, np.column_stack([SIX_Y, 2.0 * SIX_Y])], ids=["one output", "two outputs"])
def test_with_scikit_learns_kernel_and_noise_the_exact_model_is_scikit_learns(kernel, y):
    ours, theirs = both(kernel, y, optimise=False)
    for asked in ("return_std", "return_cov"):
        found = ours.predict(BETWEEN, include_noise=False, **{asked: True})
        for actual, expected in zip(found, theirs.predict(BETWEEN, **{asked: True}), strict=True):
            np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-6)
    assert ours.log_marginal_likelihood_value_ == pytest.approx(theirs.log_marginal_likelihood_value_, abs=1e-4)


# --- weights ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "model", [EVGPRegressor(n_inducing=15, solver=LBFGS(tol=1.0), random_state=0), EGPRegressor(tol=1.0)], ids=str
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


# --- files --------------------------------------------------------------------------------------------------------

SAVED = [
    EVGPRegressor(n_inducing=8, max_iter=3, random_state=0),
    EVGPRegressor(TREND, kernel_map=StandardScaler(), n_inducing=8, max_iter=3, random_state=0),
    EVGPRegressor(TREND, n_inducing=8, max_iter=3, solver="adam", random_state=0),
    EVGPRegressor(TREND, n_inducing=8, max_iter=3, solver=Adam(natural_gradient=True), random_state=0),
    EVGPRegressor(TREND, n_inducing=8, max_iter=3, solver=LBFGS(posterior="diagonal"), sharing="none", random_state=0),
    EGPRegressor(
        TREND,
        2.0 * RBF([0.5, 0.7], "fixed") + Matern(nu=1.5) + WhiteKernel(0.1),
        coef_prior=CoefPrior(scale=np.inf),
        max_iter=3,
    ),
    BayesianMLPRegressor((5,), max_iter=3, random_state=0),
    ResidualRegressor(EVGPRegressor(n_inducing=8, max_iter=3, random_state=0)),
]


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("model", SAVED, ids=str)
@pytest.mark.parametrize("used", [False, True], ids=["fresh", "used"])
def test_a_model_from_a_skops_file_is_the_model(model, used):
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
def test_a_kernel_as_the_first_argument_is_sent_to_kernel(estimator):
    # As in scikit-learn's GaussianProcessRegressor, whose first argument it is.
    with pytest.raises(TypeError, match=r"feature_map=RBF\(length_scale=2\) is a kernel: give it as kernel="):
        estimator(RBF(2.0)).fit(X, Y)
