"""Bad input of all kinds: it is refused by an error that names the cause, or does no harm."""

from copy import deepcopy
from functools import cache

import numpy as np
import pandas as pd
import polars as pl
import pytest
from scipy import sparse
from sklearn.base import BaseEstimator, TransformerMixin, clone
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures, StandardScaler

from skevgp import BayesianMLPRegressor, CoefPrior, EGPRegressor, EVGPRegressor, InverseDynamics, ResidualRegressor
from skevgp.features import InertiaForce

RNG = np.random.RandomState(0)
# Numbers that float32 holds.
X = RNG.randint(-100, 100, (40, 3)) / 32.0
Y = np.column_stack([np.sin(X[:, 0]) + 0.5 * X[:, 1], X[:, 2] ** 2]) + 0.01 * RNG.randn(40, 2)
# To find groups of outputs takes most of a small fit.
QUICK = {"n_inducing": 8, "sharing": "all", "max_iter": 2, "random_state": 0}
ESTIMATORS = {
    "EVGPRegressor": EVGPRegressor(InertiaForce(), **QUICK),
    "EGPRegressor": EGPRegressor(InertiaForce(), max_iter=2),
    "ResidualRegressor": ResidualRegressor(EVGPRegressor(**QUICK)),
    "BayesianMLPRegressor": BayesianMLPRegressor((4,), max_iter=2, random_state=0),
    "InverseDynamics": InverseDynamics(n_inducing=0, random_state=0),
}
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


def crossed(names, few):
    """All of them with one estimator, a few with the others."""
    every = [("EVGPRegressor", name) for name in names]
    return every + [(other, name) for other in ESTIMATORS if other != "EVGPRegressor" for name in few]


@cache
def fitted(name):
    """A model that no test may change."""
    return clone(ESTIMATORS[name]).fit(X, Y)


class MapError(Exception):
    """Of a user's own map: it must come through as it is."""


class BadMap(TransformerMixin, BaseEstimator):
    """A map that goes wrong in one way, when it is fitted or at a later call."""

    def __init__(self, how="raises", late=False):
        self.how = how
        self.late = late

    def fit(self, X, y=None):
        self.calls_ = 0
        return self

    def transform(self, X):
        X = np.asarray(X, dtype=float)
        self.calls_ += 1
        if self.late and self.calls_ == 1:
            return X
        if self.how == "raises":
            raise MapError("the sensor model is not defined here")
        if self.how == "rows":
            return X[:-1]
        if self.how == "width":
            return np.column_stack([X, X])[:, : X.shape[1] + 1]
        if self.how == "words":
            return np.full(X.shape, "a")
        return np.full(X.shape, {"nan": np.nan, "infinity": np.inf, "huge": 1e200}[self.how])

    # What each may be refused with.
    messages = {  # noqa: RUF012
        "raises": "the sensor model is not defined here",
        "rows": "one row per row of X",
        "width": "columns",
        "words": "must be real numbers",
        "nan": "NaN or infinity",
        "infinity": "NaN or infinity",
        "huge": "must not exceed",
    }


# --- containers --------------------------------------------------------------------------------------------------


def mapped(rows, path, dtype):
    rows.astype(dtype).tofile(path)
    return np.memmap(path, dtype=dtype, mode="r", shape=rows.shape)


def read_only(rows):
    rows = rows.copy()
    rows.flags.writeable = False
    return rows


CONTAINERS = {
    "float32": lambda rows, _: rows.astype(np.float32),
    "longdouble": lambda rows, _: rows.astype(np.longdouble),
    "object": lambda rows, _: rows.astype(object),
    "list": lambda rows, _: rows.tolist(),
    "Fortran order": lambda rows, _: np.asfortranarray(rows),
    "strided": lambda rows, _: np.repeat(np.repeat(rows, 2, axis=0), 3, axis=1)[::2, ::3],
    "backwards": lambda rows, _: np.ascontiguousarray(rows[::-1, ::-1])[::-1, ::-1],
    "big-endian": lambda rows, _: rows.astype(">f8"),
    "read-only": lambda rows, _: read_only(rows),
    "read-only map of float64": lambda rows, path: mapped(rows, path, np.float64),
    "read-only map of float32": lambda rows, path: mapped(rows, path, np.float32),
}


@pytest.mark.parametrize(("name", "container"), crossed(CONTAINERS, ["float32", "read-only"]))
def test_containers_give_same_predictions(name, container, tmp_path):
    estimator = clone(ESTIMATORS[name])
    rows = CONTAINERS[container](X, tmp_path / "rows.bin")
    before = np.array(rows, dtype=float)
    expected = fitted(name).predict(X, return_std=True)
    found = estimator.fit(rows, read_only(Y)).predict(rows, return_std=True)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(np.array(rows, dtype=float), before)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_integers_give_predictions_of_floats(name):
    estimator = clone(ESTIMATORS[name])
    rows, y = np.round(8 * X).astype(np.int16), np.round(50 * Y).astype(np.int64)
    expected = clone(estimator).fit(rows.astype(float), y.astype(float)).predict(rows.astype(float))
    np.testing.assert_allclose(estimator.fit(rows, y).predict(rows), expected, rtol=1e-6, atol=1e-6)


# --- what is refused ---------------------------------------------------------------------------------------------


# Each is allowed by itself.
EXTREME = {"sample_weight": np.full(40, 1e100), "relative_variance": np.full(40, 1e-100)}


def with_one(rows, value):
    rows = rows.copy()
    rows[3, 1] = value
    return rows


BAD = {
    "NaN": (with_one(X, np.nan), Y, ValueError, "^Input X contains NaN"),
    "infinity": (with_one(X, np.inf), Y, ValueError, "^Input X contains infinity"),
    "minus infinity": (with_one(X, -np.inf), Y, ValueError, "^Input X contains infinity"),
    "huge": (with_one(X, -1e101), Y, ValueError, r"^X must not exceed 1e\+100 in size; its largest value is 1e\+101"),
    "y with NaN": (X, with_one(Y, np.nan), ValueError, "^Input y contains NaN"),
    "y with infinity": (X, with_one(Y, np.inf), ValueError, "^Input y contains infinity"),
    "y huge": (
        X,
        with_one(Y, 1e101),
        ValueError,
        r"y must not exceed 1e\+[0-9]+ in size; its largest value is 1e\+101",
    ),
    "y nearly 0": (X, 1e-150 * Y, ValueError, "y must be 0 or exceed 1e-[0-9]+ in size; a column's largest value is"),
    "y short": (X, Y[:-1], ValueError, r"inconsistent numbers of samples: \[40, 39\]"),
    "y long": (X[:-1], Y, ValueError, r"inconsistent numbers of samples: \[39, 40\]"),
    "no y": (X, None, ValueError, "requires y to be passed, but the target y is None"),
    "y of three dimensions": (X, np.zeros((40, 2, 2)), ValueError, "Found array with dim 3"),
    "y of words": (X, np.full((40, 2), "a"), ValueError, "y must be real numbers"),
    "y with None": (X, np.where(Y > 1.5, None, Y), ValueError, "Input y contains NaN"),
    "y of dates": (
        X,
        np.full((40, 2), "2026-01-01", "M8[D]"),
        ValueError,
        "y must be real numbers; got dates or times",
    ),
    "y sparse": (
        X,
        sparse.csr_matrix(Y),
        TypeError,
        r"^y must be a dense array; got a sparse matrix of the shape \(40, 2\)",
    ),
    "y masked": (X, np.ma.masked_greater(Y, 0.5), ValueError, "^y must have no masked values"),
    "y of complex numbers": (X, Y + 1j, ValueError, "[Cc]omplex data not supported|must be real numbers"),
    "no rows": (X[:0], Y[:0], ValueError, r"^Found array with 0 sample\(s\)"),
    "no columns": (X[:, :0], Y, ValueError, r"^Found array with 0 feature\(s\)"),
    "one dimension": (X[:, 0], Y, ValueError, "^Expected 2D array, got 1D array instead"),
    "three dimensions": (X[:, :, np.newaxis], Y, ValueError, "Found array with dim 3"),
    "words": (np.full(X.shape, "a"), Y, ValueError, "X must be real numbers: could not convert"),
    "dates": (np.full(X.shape, "2026-01-01", "M8[D]"), Y, ValueError, "X must be real numbers; got dates or times"),
    "masked": (np.ma.masked_greater(X, 0.5), Y, ValueError, "X must have no masked values"),
    "complex numbers": (X + 1j, Y, ValueError, "^Complex data not supported"),
    "sparse matrix": (sparse.csr_matrix(X), Y, TypeError, "[Ss]parse data was passed"),
    "sparse array": (sparse.coo_array(X), Y, TypeError, "[Ss]parse data was passed"),
    "objects": (with_one(X.astype(object), {}), Y, TypeError, "float.* not 'dict'"),
    "pandas with missing values": (pd.DataFrame(with_one(X, np.nan)), Y, ValueError, "contains NaN"),
    "nullable pandas": (pd.DataFrame(with_one(X, np.nan), dtype="Float64"), Y, ValueError, "contains NaN"),
    "polars with missing values": (
        pl.DataFrame(X, schema=["a", "b", "c"]).with_columns(pl.lit(None).cast(pl.Float64).alias("a")),
        Y,
        ValueError,
        "contains NaN",
    ),
}


@pytest.mark.parametrize("kind", [EVGPRegressor, EGPRegressor])
def test_overflowing_prior_scale_raises(kind):
    spread = "the prior standard deviation of coef_ times features, in units of what these leave of y,"
    message = rf"^{spread} must not exceed 1e\+130 in size; "
    model = kind(PolynomialFeatures(), coef_prior=CoefPrior(scale=1e8), max_iter=1)
    with pytest.raises(ValueError, match=message):
        model.fit(1e12 * X, 1e-110 * Y)
    assert np.isfinite(model.fit(1e12 * X, 1e-80 * Y).predict(1e12 * X, return_std=True)).all()


@pytest.mark.parametrize("kind", [EVGPRegressor, EGPRegressor])
def test_targets_whose_weighted_squares_overflow_raise(kind):
    message = r"^√\(sample_weight / relative_variance\) times y must not exceed 1e\+130 in size"
    with pytest.raises(ValueError, match=message):
        kind().fit(X, 1e98 * Y, **EXTREME)


@pytest.mark.filterwarnings("ignore:Feature names only support names that are all strings")
@pytest.mark.parametrize(
    ("name", "bad"), crossed(BAD, ["NaN", "y with NaN", "y nearly 0", "y masked", "no rows", "nullable pandas"])
)
def test_invalid_rows_raise_in_fit(name, bad):
    estimator, (rows, y, kind, message) = clone(ESTIMATORS[name]), BAD[bad]
    if isinstance(estimator, ResidualRegressor):
        if bad == "y nearly 0":
            rows = np.zeros_like(rows)  # what it fits is what y adds to columns of X
        if hasattr(rows, "columns"):
            message = "^The base columns of X must be finite; they contain NaN or infinity"
    with pytest.raises(kind, match=message) as raised:
        estimator.fit(rows, y)
    assert raised.type is kind
    assert not [attribute for attribute in vars(estimator) if attribute.endswith("_")]


@pytest.mark.parametrize(
    ("name", "bad"), crossed([bad for bad in BAD if not bad.startswith(("y", "no y"))], ["infinity", "words"])
)
def test_invalid_rows_raise_in_predict(name, bad):
    estimator, (rows, _, kind, message) = fitted(name), BAD[bad]
    if isinstance(rows, pl.DataFrame):
        estimator = clone(estimator).fit(pl.DataFrame(X, schema=rows.columns), Y)
    with pytest.raises(kind, match=message.replace("^", "").replace("Input X", "X")) as raised:
        estimator.predict(rows, return_std=True)
    assert raised.type is kind


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        (1e60, r"^y must not exceed 1e\+40 in size; its largest value is 4\.8e\+61\. Rescale it\."),
        (1e-120, r"^y must be 0 or exceed 1e-105 in size; a column's largest value is 4\.8e-119"),
    ],
)
def test_torques_of_extreme_size_raise(scale, message):
    y = scale * np.linspace(-48.0, 24.0, 40)
    with pytest.raises(ValueError, match=message):
        InverseDynamics(n_inducing=5, max_iter=1).fit(X, y)


@pytest.mark.parametrize("kind", [EVGPRegressor, EGPRegressor])
@pytest.mark.parametrize(
    ("factor", "weights", "message"),
    [
        (1e-150, {}, "^What feature_map returns must be 0 or exceed 1e-140 in size; a column's largest value is"),
        (1e-165, {}, "^What feature_map returns must be 0 or exceed 1e-140 in size; a column's largest value is"),
        (1e-120, {}, r'^scale="auto" of CoefPrior, from the feature map or .*, must not exceed 1e\+100 in size'),
        (
            1e60,
            EXTREME,
            r"^√\(sample_weight / relative_variance\) times what feature_map returns must not exceed 1e\+130",
        ),
    ],
)
def test_features_of_extreme_size_raise(kind, factor, weights, message):
    with pytest.raises(ValueError, match=message):
        kind(FunctionTransformer(lambda X: factor * X)).fit(X, Y, **weights)


@pytest.mark.parametrize("kind", [EVGPRegressor, EGPRegressor, BayesianMLPRegressor])
def test_frame_with_dates_raises(kind):
    dates = pd.date_range("2026-01-01", periods=len(X))
    for frame in (pd.DataFrame({"a": dates}), pd.DataFrame({"a": dates, "b": X[:, 0]})):
        with pytest.raises(ValueError, match=r"X must be real numbers|The columns \['a'\] of X are not numbers"):
            kind().fit(frame, Y)
    kind(max_iter=2).fit(pd.DataFrame({"_mask": X[:, 0], "b": X[:, 1]}), Y)


@pytest.mark.parametrize("name", ["NaN", "huge", "y with NaN", "y short", "sparse matrix", "one dimension"])
def test_partial_fit_with_bad_rows_keeps_model(name):
    rows, y, kind, message = BAD[name]
    model = deepcopy(fitted("EVGPRegressor"))
    before = model.predict(X, return_std=True)
    with pytest.raises(kind, match=message):
        model.partial_fit(rows, y)
    np.testing.assert_array_equal(model.predict(X, return_std=True), before)


# --- maps --------------------------------------------------------------------------------------------------------


# In a fit a map of any width is a good one.
@pytest.mark.parametrize(
    ("how", "late"), [(how, late) for how in BadMap.messages for late in (False, True) if late or how != "width"]
)
@pytest.mark.parametrize(("kind", "argument"), [(EVGPRegressor, "feature_map"), (EGPRegressor, "kernel_map")])
def test_map_error_names_map(kind, argument, how, late):
    """In a fit, or after it: the second call may be in either."""
    sharing = {"sharing": "all"} if kind is EVGPRegressor else {}
    model = kind(**{argument: BadMap(how, late)}, max_iter=2, **sharing)
    with pytest.raises(MapError if how == "raises" else ValueError, match=BadMap.messages[how]) as raised:
        model.fit(X, Y).predict(X[:5], return_std=True)
    if how != "raises":
        assert f"{argument}=" in str(raised.value) or how == "width"


class Breaks(StandardScaler):
    """A map that goes wrong once it is told to."""

    now = None

    def transform(self, X):
        values = super().transform(X)
        return values if Breaks.now is None else Breaks.now(values)


@pytest.mark.parametrize(("kind", "argument"), [(EVGPRegressor, "feature_map"), (EGPRegressor, "kernel_map")])
@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (lambda values: values[:, :2], r"same number of columns for all rows; they returned .*3.* and .*2"),
        (
            lambda values: np.hstack([values, values]),
            r"same number of columns for all rows; they returned .*3.* and .*6",
        ),
        (lambda values: np.nan * values, "returned NaN or infinity"),
        (lambda values: values[1:], "must return one row per row of X; for 4 rows it returned the shape"),
        (lambda values: values[:, 0], "must return one row per row of X"),
        (lambda values: 1e200 * values, r"must not exceed 1e\+100 in size"),
    ],
    ids=["narrow", "wide", "NaN", "rows", "1-D", "huge"],
)
def test_map_error_after_fit_keeps_model(monkeypatch, kind, argument, broken, message):
    sharing = {"sharing": "all"} if kind is EVGPRegressor else {}
    model = kind(**{argument: Breaks()}, max_iter=2, **sharing).fit(X, Y)
    before = model.predict(X[:4], return_std=True)
    monkeypatch.setattr(Breaks, "now", staticmethod(broken))
    for call in (
        model.predict,
        model.sample_y,
        *([] if kind is EGPRegressor else [lambda X: model.partial_fit(X, Y[:4])]),
    ):
        with pytest.raises(ValueError, match=message):
            call(X[:4])
    monkeypatch.undo()
    np.testing.assert_array_equal(model.predict(X[:4], return_std=True), before)


def test_map_is_called_few_times():
    """However many iterations there are."""
    rows = []

    class Slow(PolynomialFeatures):
        def transform(self, X):
            rows.append(len(X))
            return super().transform(X)

    model = EVGPRegressor(Slow(), kernel_map=Slow(degree=1), n_inducing=8, random_state=0, max_iter=30).fit(X, Y)
    assert model.n_iter_ > 20
    assert sum(rows) <= 8 * len(X)


# --- data --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("kind", [EVGPRegressor, EGPRegressor])
@pytest.mark.parametrize("feature_map", [None, PolynomialFeatures(2)], ids=["plain", "features"])
def test_one_to_three_rows_are_fitted(kind, n, feature_map):
    model = kind(feature_map, max_iter=10, random_state=0).fit(X[:n], Y[:n])
    mean, std = model.predict(X, return_std=True)
    assert mean.shape == std.shape == Y.shape
    assert np.isfinite(mean).all()
    assert np.isfinite(std).all()
    assert (std > 0.0).all()


def test_five_hundred_columns_are_fitted():
    rng = np.random.RandomState(0)
    rows = rng.randn(60, 500)
    y = rows[:, 0] + 0.1 * rng.randn(60)
    model = EVGPRegressor(n_inducing=20, max_iter=10, random_state=0).fit(rows, y)
    mean, std = model.predict(rows, return_std=True)
    assert np.corrcoef(mean, y)[0, 1] > 0.5
    assert (std > 0.0).all()


@pytest.mark.parametrize("noise", [1e-8, 1e-4])
def test_tiny_noise_is_fitted(noise):
    x = np.linspace(0.0, 3.0, 60)[:, np.newaxis]
    y = np.sin(2.0 * x[:, 0]) + noise * np.random.RandomState(0).randn(60)
    model = EVGPRegressor(n_inducing=30, random_state=0).fit(x, y)
    mean, std = model.predict(x, return_std=True)
    assert np.abs(mean - y).max() < 1e-4 + 10.0 * noise
    assert (std < 1e-3 + 10.0 * noise).all()


def test_no_prior_mean_warning_if_features_explain_targets():
    """Their residuals scatter by rounding, which is little, but so is their mean. No intercept is too far away."""
    rng = np.random.RandomState(0)
    rows = rng.randn(10, 5)
    for normalize_y in (True, False):
        model = EVGPRegressor(PolynomialFeatures(2), normalize_y=normalize_y, random_state=0)
        model.fit(rows, 1e8 + rows[:, 0])
        np.testing.assert_allclose(model.predict(rows), 1e8 + rows[:, 0], rtol=1e-12)
