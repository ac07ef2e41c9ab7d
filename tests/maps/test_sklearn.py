import casadi as ca
import numpy as np
import pandas as pd
import polars
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.compose import ColumnTransformer, make_column_selector
from sklearn.pipeline import FeatureUnion, make_pipeline
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures, StandardScaler

from skevgp.features import AngleEncoder
from skevgp.maps import as_map

NAMES = ["first", "second", "third", "fourth", "fifth"]


def rows(n_rows=100, seed=0):
    return np.random.default_rng(seed).normal(size=(n_rows, 5)) * [1.0, 0.5, 2.0, 1.0, 3.0]


def fitted(transformer, X=None):
    return transformer.fit(rows(40, seed=1) if X is None else X)


def differences(function, X, step=1e-6):
    both = [(function(X + shift) - function(X - shift)) / (2.0 * step) for shift in step * np.eye(X.shape[1])]
    return np.stack(both, axis=-1)


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


def test_union_of_rows_for_each_output_and_rows_for_all():
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


# --- data frames -------------------------------------------------------------------------------------------------


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


def test_polynomial_is_exact_where_a_column_is_zero():
    """No logarithms of powers."""
    fitted = PolynomialFeatures(2).fit(rows()[:, :2])
    x, (row,) = expressions(fitted, 2)
    jacobian = ca.Function("j", [x], [ca.jacobian(row, x)])([0.0, 2.0])
    np.testing.assert_array_equal(jacobian.full(), [[0, 0], [1, 0], [0, 1], [0, 0], [2, 0], [0, 4]])
