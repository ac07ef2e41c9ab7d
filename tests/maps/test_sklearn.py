import re
import warnings

import casadi as ca
import numpy as np
import pandas as pd
import polars
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.compose import ColumnTransformer, make_column_selector
from sklearn.decomposition import PCA
from sklearn.pipeline import FeatureUnion, Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer, MinMaxScaler, Normalizer, PolynomialFeatures, StandardScaler

from skevgp.features import AngleEncoder, InertiaForceGravity
from skevgp.maps import Map, as_map

SCALED_ANGLES = make_pipeline(AngleEncoder("acrobot"), StandardScaler())


def by_columns(*parts, **arguments):
    return ColumnTransformer([(str(number), *part) for number, part in enumerate(parts)], **arguments)


NAMES = ["first", "second", "third", "fourth", "fifth"]


def rows(n_rows=100, seed=0):
    return np.random.default_rng(seed).normal(size=(n_rows, 5)) * [1.0, 0.5, 2.0, 1.0, 3.0]


def fitted(transformer, X=None):
    return transformer.fit(rows(40, seed=1) if X is None else X)


def differences(function, X, step=1e-6):
    both = [(function(X + shift) - function(X - shift)) / (2.0 * step) for shift in step * np.eye(X.shape[1])]
    return np.stack(both, axis=-1)


def check(transformer, X, rtol=1e-6):
    """Value and Jacobian of a fitted map."""
    assert_allclose(as_map(transformer).value(X), transformer.transform(X), rtol=1e-12, atol=1e-12)
    jacobian, expected = as_map(transformer).jacobian(X), differences(transformer.transform, X)
    assert jacobian.shape == expected.shape
    assert_allclose(jacobian, expected, rtol=0.0, atol=rtol * max(np.abs(expected).max(initial=0.0), 1e-3))


@pytest.mark.parametrize("n_rows", [1, 50])
def test_scaled_angles_are_bitwise_those_of_transform(n_rows):
    transformer = fitted(SCALED_ANGLES)
    assert_array_equal(as_map(transformer).value(rows(n_rows)), transformer.transform(rows(n_rows)))


# --- rows for each output, and parts that are not known --------------------------------------------------------------


class PerOutput(TransformerMixin, BaseEstimator):
    """A row for each of three outputs."""

    def fit(self, X, y=None):
        self.n_features_in_ = X.shape[1]
        return self

    def transform(self, X):
        return np.stack([np.sin(X[:, 1:]), np.cos(X[:, :-1]), X[:, 1:] * X[:, :-1]], axis=1)

    def to_casadi(self, x):
        return [ca.sin(x[1:]), ca.cos(x[:-1]), x[1:] * x[:-1]]


def test_a_row_for_each_output_at_the_end():
    check(fitted(make_pipeline(StandardScaler(), PolynomialFeatures(2), PerOutput())), rows())
    assert as_map(fitted(make_pipeline(PCA(3), PerOutput()))).jacobian(rows()).shape == (100, 3, 2, 5)


def test_a_row_for_each_output_in_the_middle():
    check(fitted(make_pipeline(PerOutput(), FunctionTransformer(np.exp), FunctionTransformer())), rows())
    inner = np.random.default_rng(2).normal(size=(100, 5, 2))
    one = as_map(fitted(make_pipeline(PerOutput(), FunctionTransformer(np.exp))))
    assert_allclose(one.chain(rows(), inner), one.jacobian(rows()) @ inner[:, np.newaxis], rtol=1e-6, atol=1e-6)


def test_a_union_of_rows_for_each_output_and_rows_for_all():
    union, X = FeatureUnion([("all", AngleEncoder("acrobot")), ("each", PerOutput())]), rows()
    for _, part in union.transformer_list:
        part.fit(X)
    value, jacobian = as_map(union).value(X), as_map(union).jacobian(X)
    assert value.shape == (100, 3, 11)
    assert jacobian.shape == (100, 3, 11, 5)
    for output in range(3):
        assert_array_equal(value[:, output, :7], AngleEncoder("acrobot").fit(X).transform(X))
        assert_array_equal(jacobian[:, output, :7], AngleEncoder("acrobot").fit(X).jacobian(X))
    assert_array_equal(value[:, :, 7:], PerOutput().transform(X))
    assert_allclose(jacobian[:, :, 7:], differences(PerOutput().transform, X), atol=1e-6)


def test_the_scale_of_columns_reaches_the_parts_that_are_not_known():
    X = rows() * 1e-6
    curved = FunctionTransformer(lambda X: np.tanh(X / 1e-6))
    exact = (1.0 - np.tanh(X / 1e-6) ** 2)[:, :, np.newaxis] * np.eye(5) / 1e-6
    for transformer in [
        make_pipeline(curved, FunctionTransformer()),
        FeatureUnion([("a", curved)]),
        by_columns((curved, slice(0, 5))),
        by_columns((curved, [0, 1]), remainder=curved),
    ]:
        found = as_map(fitted(transformer, X), example=X).jacobian(X)
        assert_allclose(found, exact, rtol=0.0, atol=1e-8 * np.abs(exact).max())


class Halved(Pipeline):
    def transform(self, X):
        return super().transform(X) / 2.0


def test_a_class_below_a_pipeline_is_known_by_what_it_does():
    transformer = fitted(Halved([("a", StandardScaler())]))
    check(transformer, rows())
    assert type(as_map(transformer)) is Map


# --- data frames -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frame", [pd.DataFrame, polars.DataFrame], ids=["pandas", "polars"])
@pytest.mark.parametrize(
    "transformer",
    [
        make_pipeline(AngleEncoder(angles=["second"]), StandardScaler()),
        make_pipeline(StandardScaler(), Normalizer()),
        FeatureUnion([("a", InertiaForceGravity("acrobot")), ("b", Normalizer())]),
        by_columns((PolynomialFeatures(2), ["fourth", "first"]), (PCA(), slice("second", "third")), remainder="drop"),
        by_columns((StandardScaler(), slice(None, "second")), (PCA(), slice("fourth", None))),
        by_columns((Normalizer(), lambda frame: [name for name in frame.columns if "f" in name]), remainder=PCA()),
    ],
    ids=lambda transformer: re.sub(r" at 0x\w+", "", str(transformer)),
)
def test_maps_fitted_to_data_frames_take_arrays_in_the_order_of_the_columns(transformer, frame):
    transformer = fitted(transformer, frame(dict(zip(NAMES, rows(40, seed=1).T, strict=True))))

    def by_frame(X):
        return np.asarray(transformer.transform(frame(dict(zip(NAMES, X.T, strict=True)))))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        value, jacobian = as_map(transformer).value(rows()), as_map(transformer).jacobian(rows())
    assert_allclose(value, by_frame(rows()), rtol=1e-12, atol=1e-12)
    assert_allclose(jacobian, differences(by_frame, rows()), rtol=0.0, atol=1e-6 * np.abs(jacobian).max())


def test_a_pipeline_whose_steps_make_frames():
    frame = pd.DataFrame(rows(40, seed=1), columns=NAMES)
    transformer = make_pipeline(StandardScaler(), Normalizer(), PolynomialFeatures(2)).set_output(transform="pandas")
    transformer.fit(frame)
    expected = transformer.transform(pd.DataFrame(rows(), columns=NAMES)).to_numpy()
    assert type(as_map(transformer).value(rows())) is np.ndarray
    assert_allclose(as_map(transformer).value(rows()), expected, rtol=1e-12, atol=1e-12)
    assert as_map(transformer).jacobian(rows()).shape == (100, 21, 5)


def of_pandas(frame):
    return frame.loc[:, ["first"]].to_numpy()


def of_polars(frame):
    return frame.select(polars.col("first").sin()).to_numpy()


@pytest.mark.parametrize(
    ("frame", "output", "function"),
    [
        (pd.DataFrame, "default", of_pandas),
        (polars.DataFrame, "default", of_polars),
        (pd.DataFrame, "polars", of_polars),
        (polars.DataFrame, "pandas", of_pandas),
    ],
)
def test_frames_are_of_the_package_that_maps_were_fitted_to(frame, output, function):
    given = frame(dict(zip(NAMES, rows(40, seed=1).T, strict=True)))
    new = frame(dict(zip(NAMES, rows().T, strict=True)))
    steps = [FunctionTransformer(function, check_inverse=False)]
    if output != "default":
        steps = [StandardScaler().set_output(transform=output), *steps]
    for transformer in (make_pipeline(*steps), FeatureUnion([("a", make_pipeline(*steps))])):
        fitted(transformer, given)
        read = as_map(transformer, example=given)
        assert_allclose(read.value(rows()), transformer.transform(new), rtol=1e-12, atol=1e-12)
        assert read.jacobian(rows()).shape == (100, 1, 5)


# --- scalers ---------------------------------------------------------------------------------------------------------


def test_beyond_the_range_of_a_clipped_scaler_nothing_moves():
    scaler = MinMaxScaler(clip=True).fit([[0.0], [2.0]])
    assert_array_equal(as_map(scaler).jacobian(np.array([[-1.0], [1.0], [3.0]])).ravel(), [0.0, 0.5, 0.0])


def test_a_constant_column_is_scaled_by_1():
    scaler = StandardScaler().fit([[3.0, 1.0], [3.0, 2.0]])
    assert_array_equal(as_map(scaler).jacobian(np.zeros((1, 2))), [np.diag([1.0, 2.0])])


# --- expressions -----------------------------------------------------------------------------------------------------


def expressions(transformer, n_columns):
    x = ca.MX.sym("x", n_columns)
    row = as_map(transformer).casadi(x)
    return x, [*row] if isinstance(row, list) else [row]


@pytest.mark.parametrize(
    "columns",
    [["c", "a"], slice("b", "c"), slice(1, 3), [2, -4], make_column_selector("a|d")],
    ids=["names", "slice of names", "slice", "indices", "selector"],
)
def test_columns_of_a_data_frame_are_found(columns):
    X = rows()[:, :4]
    frame = pd.DataFrame(X, columns=list("abcd"))
    fitted = ColumnTransformer([("scaled", StandardScaler(), columns)], remainder="passthrough").fit(frame)
    x, (row,) = expressions(fitted, 4)
    found = ca.Function("h", [x], [row])(X[0])
    np.testing.assert_allclose(found.full().ravel(), fitted.transform(frame[:1])[0], rtol=1e-12)


def test_a_polynomial_is_exact_where_a_column_is_zero():
    """No logarithms of powers."""
    fitted = PolynomialFeatures(2).fit(rows()[:, :2])
    x, (row,) = expressions(fitted, 2)
    jacobian = ca.Function("j", [x], [ca.jacobian(row, x)])([0.0, 2.0])
    np.testing.assert_array_equal(jacobian.full(), [[0, 0], [1, 0], [0, 1], [0, 0], [2, 0], [0, 4]])


def test_expressions_with_a_row_per_output_are_joined_to_others():
    rows_per_output = PerOutput().fit(rows())
    union = FeatureUnion(
        [("rows", rows_per_output), ("scaled", fitted(StandardScaler()))], transformer_weights={"rows": 2.0}
    )
    x, each = expressions(union, 5)
    assert len(each) == 3
    for output, own in zip(ca.Function("h", [x], each)(rows()[0]), as_map(union).value(rows()[:1])[0], strict=True):
        assert_allclose(output.full().ravel(), own, rtol=1e-12)
