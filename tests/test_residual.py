import dask.array as da
import numpy as np
import pandas as pd
import pytest
import sklearn
from sklearn.base import BaseEstimator, RegressorMixin, clone
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.linear_model import LinearRegression, Ridge
from sklearn.metrics import r2_score
from sklearn.model_selection import cross_validate
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from skevgp import EGPRegressor, EVGPRegressor, ResidualRegressor

RNG = np.random.RandomState(0)
X = RNG.uniform(-2, 2, (60, 3))
CHANGE = np.column_stack([np.sin(2 * X[:, 2]), X[:, 0] * X[:, 1]])
Y = X[:, :2] + 0.1 * CHANGE
X_NEW = RNG.uniform(-2, 2, (20, 3))
NAMES = ["angle", "speed", "force"]
TARGETS = [(Y[:, 0], [0]), (Y[:, :1], [0]), (Y, [0, 1])]


def evgp(**arguments):
    return EVGPRegressor(**{"n_inducing": 8, "max_iter": 0, "random_state": 0} | arguments)


@pytest.fixture
def routing():
    with sklearn.config_context(enable_metadata_routing=True):
        yield


class Recorder(RegressorMixin, BaseEstimator):
    """Keeps what it is given."""

    def fit(self, X, y, sample_weight=None):
        self.fit_given_ = X, y, sample_weight
        return self

    def partial_fit(self, X, y, sample_weight=None):
        return self.fit(X, y, sample_weight)

    def predict(self, X, **given):
        self.predict_given_ = X, given
        return np.zeros(len(X))


# --- what it learns and predicts ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("y", "base"), TARGETS, ids=["one output", "one column", "two outputs"])
@pytest.mark.parametrize("regressor", [LinearRegression(), evgp(), GaussianProcessRegressor(optimizer=None)], ids=str)
def test_prediction_is_base_plus_change(regressor, y, base):
    change = clone(regressor).fit(X, y - X[:, base].reshape(y.shape)).predict(X_NEW)
    m = ResidualRegressor(regressor).fit(X, y)
    np.testing.assert_array_equal(m.predict(X_NEW), change + X_NEW[:, base].reshape(change.shape))
    np.testing.assert_array_equal(m.base_, base)


@pytest.mark.parametrize("base", [[2, 0], np.array([2, 0]), [-1, -3], ["force", "angle"], np.array(["force", "angle"])])
def test_base_columns_are_chosen_by_index_or_name(base):
    frame = pd.DataFrame(X, columns=NAMES)
    m = ResidualRegressor(LinearRegression(), base=base).fit(frame, Y)
    np.testing.assert_array_equal(m.base_, [2, 0])
    np.testing.assert_allclose(m.regressor_.coef_, LinearRegression().fit(X, Y - X[:, [2, 0]]).coef_, atol=1e-12)
    # A linear regression learns the same sum whatever is taken away before.
    direct = LinearRegression().fit(X, Y).predict(X_NEW)
    np.testing.assert_allclose(m.predict(pd.DataFrame(X_NEW, columns=NAMES)), direct, atol=1e-12)


def test_base_columns_of_a_frame_must_be_finite_numbers(frame_of):
    m = ResidualRegressor(Recorder(), base="angle")
    with pytest.raises(ValueError, match="Column 0 of X, a base, must be real numbers"):
        m.fit(frame_of({"angle": ["left"] * 60}), Y[:, 0])
    with pytest.raises(ValueError, match="base columns of X must be finite; they contain NaN or infinity"):
        m.fit(frame_of({"angle": np.full(60, np.nan)}), Y[:, 0])


@pytest.mark.parametrize(("y", "base"), TARGETS[::2], ids=["1-D", "(n, 2)"])
def test_dask_arrays_stay_where_they_are(y, base):
    lazy, targets = da.from_array(X, chunks=(25, 2)), da.from_array(y, chunks=-1)
    expected = evgp().fit(lazy, da.from_array(y - X[:, base].reshape(y.shape), chunks=(25, *y.shape[1:])))
    new = da.from_array(X_NEW, chunks=(10, 3))
    new = new[new[:, 0] > 0.0]  # of unknown lengths
    some = X_NEW[X_NEW[:, 0] > 0.0]
    for method in ("fit", "partial_fit"):
        found = getattr(ResidualRegressor(evgp(), base=base), method)(lazy, targets)
        mean, std = found.predict(new, return_std=True)
        for own, other in zip((mean, std), expected.predict(some, return_std=True), strict=True):
            assert isinstance(own, da.Array)
            base_columns = some[:, base].reshape(other.shape) if own is mean else 0.0
            np.testing.assert_allclose(own.compute(), other + base_columns, rtol=1e-7)
    with pytest.raises(TypeError, match="X is a Dask array, but the exact model"):
        ResidualRegressor(EGPRegressor()).fit(lazy, targets)


@pytest.mark.parametrize("method", ["sample_y", "partial_fit"])
def test_methods_are_there_if_the_regressor_has_them(method):
    assert hasattr(ResidualRegressor(evgp()), method)
    assert not hasattr(ResidualRegressor(LinearRegression()), method)
    assert not hasattr(ResidualRegressor(LinearRegression()).fit(X, Y), method)


def test_partial_fit_is_the_regressors():
    m, direct = ResidualRegressor(evgp()), evgp()
    for rows in (slice(0, 40), slice(40, 60)):
        m.partial_fit(X[rows], Y[rows])
        direct.partial_fit(X[rows], Y[rows] - X[rows, :2])
    np.testing.assert_array_equal(m.predict(X_NEW), direct.predict(X_NEW) + X_NEW[:, :2])


# --- uncertainty passes through -----------------------------------------------------------------------------------


@pytest.mark.parametrize("asked", ["return_std", "return_cov"])
@pytest.mark.parametrize("routed", [False, True])
def test_spread_passes_through_pipelines_around_and_inside(asked, routed):
    scale, shift = StandardScaler().fit(X), evgp()
    Z, Z_new = scale.transform(X), scale.transform(X_NEW)
    mean, spread = shift.fit(Z, Y - Z[:, :2]).predict(Z_new, **{asked: True})
    with sklearn.config_context(enable_metadata_routing=routed):
        inner = evgp().set_predict_request(**{asked: True}) if routed else evgp()
        around = make_pipeline(StandardScaler(), ResidualRegressor(inner)).fit(X, Y)
        inside = ResidualRegressor(make_pipeline(StandardScaler(), inner)).fit(X, Y)
        actual, same = around.predict(X_NEW, **{asked: True})
        _, other = inside.predict(X_NEW, **{asked: True})
    np.testing.assert_array_equal(actual, mean + Z_new[:, :2])
    np.testing.assert_array_equal(same, spread)
    np.testing.assert_array_equal(other, evgp().fit(Z, Y - X[:, :2]).predict(Z_new, **{asked: True})[1])


# --- scikit-learn's conventions -----------------------------------------------------------------------------------


def test_weights_are_routed_through_a_cross_validation(routing):
    weight = np.where(np.arange(60) % 3 == 0, 1e-9, 1.0)
    m = ResidualRegressor(Ridge().set_fit_request(sample_weight=True)).set_score_request(sample_weight=True)
    found = cross_validate(m, X, Y, params={"sample_weight": weight}, cv=2, return_estimator=True)
    half = slice(30, 60)
    direct = Ridge().fit(X[half], Y[half] - X[half, :2], sample_weight=weight[half])
    np.testing.assert_array_equal(found["estimator"][0].regressor_.coef_, direct.coef_)
    score = r2_score(Y[:30], direct.predict(X[:30]) + X[:30, :2], sample_weight=weight[:30])
    assert found["test_score"][0] == pytest.approx(score, rel=1e-12)


# --- errors -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("base", "message"),
    [
        ([0], r"base=\[0\] must be one index or name .* n_outputs=2"),
        ([0.0, 1.0], "must be one index or name"),
        ([[0, 1]], "must be one index or name"),
        ([0, 3], r"base=\[0, 3\] must be below the 3 columns"),
        ([0, -4], r"base=\[0, -4\] must be below the 3 columns"),
        (["angle", "torque"], r"base=\['angle', 'torque'\] must name columns of X; .*\['angle', 'speed', 'force'\]"),
        ([True, False], "must be one index or name"),
        ([[0], [1, 2]], r"base=\[\[0\], \[1, 2\]\] must be one index or name"),
        ({}, "base={} must be one index or name"),
    ],
)
def test_base_that_is_not_in_x_raises(base, message):
    with pytest.raises(ValueError, match=message):
        ResidualRegressor(LinearRegression(), base=base).fit(pd.DataFrame(X, columns=NAMES), Y)


def test_names_need_a_data_frame():
    with pytest.raises(ValueError, match=r"must name columns of X; its columns' names are \[\]"):
        ResidualRegressor(LinearRegression(), base=["angle", "speed"]).fit(X, Y)


def test_more_outputs_than_columns_raise():
    with pytest.raises(ValueError, match=r"first n_outputs=2 columns of X, which has 1. Pass base"):
        ResidualRegressor(LinearRegression()).fit(X[:, :1], Y)
    assert ResidualRegressor(LinearRegression(), base=[0, 0]).fit(X[:, :1], Y).predict(X[:, :1]).shape == (60, 2)


@pytest.mark.parametrize("method", ["fit", "partial_fit"])
def test_fit_that_fails_leaves_the_model_as_it_was(method):
    m = ResidualRegressor(evgp()).fit(X, Y)
    before = m.predict(X_NEW)
    with pytest.raises(ValueError, match="features|columns|base"):
        getattr(m, method)(X[:, :1], Y)
    np.testing.assert_array_equal(m.predict(X_NEW), before)
    assert m.n_features_in_ == 3
