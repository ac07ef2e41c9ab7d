import casadi as ca
import numpy as np
import pandas as pd
import pytest
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.compose import ColumnTransformer, make_column_selector
from sklearn.decomposition import PCA, TruncatedSVD
from sklearn.pipeline import FeatureUnion, Pipeline, make_pipeline, make_union
from sklearn.preprocessing import (
    FunctionTransformer,
    MaxAbsScaler,
    MinMaxScaler,
    OneHotEncoder,
    PolynomialFeatures,
    QuantileTransformer,
    RobustScaler,
    StandardScaler,
)

from skevgp.features import AngleEncoder, InertiaForce, InertiaForceGravity, LinkGravity, NominalDynamics
from skevgp.maps.symbolic import mapped
from skevgp.robots import layout_of

TERMS = ["acceleration", "gravity", "bias", "input"]


class Wave(TransformerMixin, BaseEstimator):
    """A map of a user's own."""

    def fit(self, X, y=None):
        return self

    def transform(self, X):
        return np.column_stack([np.sin(X[:, 0]), X[:, 1] ** 2])

    def to_casadi(self, x):
        return ca.vertcat(ca.sin(x[0]), x[1] ** 2)


class Rows(Wave):
    """A row for each of two outputs."""

    def transform(self, X):
        return np.stack([X[:, :2], X[:, 1:3] ** 2], axis=1)

    def to_casadi(self, x):
        return [x[:2], x[1:3] ** 2]


# Name -> the map, and of how many columns.
MAPS = {
    "standard": (StandardScaler(), 4),
    "standard, no mean": (StandardScaler(with_mean=False), 4),
    "standard, no std": (StandardScaler(with_std=False), 4),
    "standard, nothing": (StandardScaler(with_mean=False, with_std=False), 4),
    "min max": (MinMaxScaler((-1.0, 3.0)), 4),
    "min max, clip": (MinMaxScaler((0.2, 0.7), clip=True), 4),
    "max abs": (MaxAbsScaler(), 4),
    "robust": (RobustScaler(), 4),
    "robust, no centre": (RobustScaler(with_centering=False), 4),
    "robust, no scale": (RobustScaler(with_scaling=False), 4),
    "polynomial": (PolynomialFeatures(3), 4),
    "polynomial, interactions": (PolynomialFeatures((2, 3), interaction_only=True, include_bias=False), 4),
    "polynomial, constant": (PolynomialFeatures(0), 4),
    "pca": (PCA(3), 4),
    "pca, whitened": (PCA(2, whiten=True), 4),
    "svd": (TruncatedSVD(2), 4),
    "identity": (FunctionTransformer(), 4),
    "sine": (FunctionTransformer(np.sin), 4),
    "pipeline": (Pipeline([("a", StandardScaler()), ("b", "passthrough"), ("c", PolynomialFeatures(2))]), 4),
    "union": (FeatureUnion([("a", StandardScaler()), ("b", "drop"), ("c", "passthrough"), ("d", PCA(2))]), 4),
    "union, weights": (FeatureUnion([("a", PCA(2)), ("b", RobustScaler())], transformer_weights={"a": 3.0}), 4),
    "columns": (
        ColumnTransformer(
            [("a", StandardScaler(), [2, 0]), ("b", "drop", [1]), ("c", PCA(1), slice(0, 2)), ("d", "passthrough", [])],
            remainder="passthrough",
            transformer_weights={"a": 0.5},
        ),
        4,
    ),
    "columns, mask": (ColumnTransformer([("a", MinMaxScaler(), [True, False, True, False])]), 4),
    "columns, called": (ColumnTransformer([("a", MinMaxScaler(), lambda X: [3, -4])]), 4),
    "own": (make_union(Wave(), StandardScaler()), 4),
    "rows": (Rows(), 4),
    "angles": (AngleEncoder(angles=[2, 0]), 4),
    "no angles": (AngleEncoder(), 4),
    "angles, pendulum": (AngleEncoder("pendulum"), 3),
    "angles, cartpole": (make_pipeline(AngleEncoder("cartpole"), StandardScaler()), 5),
    "angles, iiwa14": (AngleEncoder("iiwa14"), 21),
    "IF": (InertiaForce("cartpole"), 5),
    "IF, no robot": (InertiaForce(), 4),
    "IFG, no robot": (InertiaForceGravity(), 4),
    "IFG, pendulum": (InertiaForceGravity("pendulum"), 3),
    "IFG, cartpole": (InertiaForceGravity("cartpole"), 5),
    "IFG, acrobot": (InertiaForceGravity("acrobot"), 5),
    "IFG, iiwa14": (InertiaForceGravity("iiwa14"), 21),
    "IFG, chosen": (InertiaForceGravity("acrobot", gravity=LinkGravity(axes="x", links=[1])), 5),
    "gravity, no robot": (LinkGravity(), 4),
    "gravity, cartpole": (LinkGravity("cartpole"), 5),
    "gravity, ur5": (LinkGravity("ur5", axes="x"), 18),
    "nominal, no robot": (NominalDynamics(), 4),
    "nominal, cartpole": (NominalDynamics("cartpole", terms=TERMS), 5),
    "nominal, acrobot": (NominalDynamics("acrobot", terms=TERMS[::-1]), 5),
    "nominal, iiwa14": (make_union(InertiaForce("iiwa14"), NominalDynamics("iiwa14", terms=TERMS)), 21),
}


def rows(n_columns, n_rows=40, seed=0):
    return np.random.RandomState(seed).randn(n_rows, n_columns) * 1.5 + 0.3


def expressions(fitted, n_columns, name="feature_map"):
    x = ca.MX.sym("x", n_columns)
    row = mapped(fitted, x, name)
    return x, [*row] if isinstance(row, list) else [row]


@pytest.mark.parametrize(("transformer", "n_columns"), MAPS.values(), ids=MAPS)
def test_a_map_does_what_transform_does(transformer, n_columns):
    fitted = transformer.fit(rows(n_columns))
    x, each = expressions(fitted, n_columns)
    function = ca.Function("h", [x], each)
    X = rows(n_columns, 5, seed=1)
    expected = fitted.transform(X).reshape(len(X), len(each), -1)
    for own, found in zip(expected, map(function.call, ([row] for row in X)), strict=True):
        for values, output in zip(own, found, strict=True):
            assert output.shape == (len(values), 1)
            np.testing.assert_allclose(output.full().ravel(), values, rtol=1e-11, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize(
    "name", ["polynomial", "min max", "pca, whitened", "angles, cartpole", "IFG, iiwa14", "nominal, iiwa14", "rows"]
)
def test_a_map_is_differentiated(name):
    transformer, n_columns = MAPS[name]
    fitted = transformer.fit(rows(n_columns))
    x, each = expressions(fitted, n_columns)
    function = ca.Function("j", [x], [ca.jacobian(ca.vertcat(*each), x)])
    row, h = rows(n_columns, 1, seed=1), 1e-6
    sides = [fitted.transform(row + sign * h * np.eye(n_columns)) for sign in (1.0, -1.0)]
    expected = ((sides[0] - sides[1]) / (2.0 * h)).reshape(n_columns, -1).T
    np.testing.assert_allclose(function(row[0]).full(), expected, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize(
    "columns",
    [["c", "a"], slice("b", "c"), slice(1, 3), [2, -4], make_column_selector("a|d")],
    ids=["names", "slice of names", "slice", "indices", "selector"],
)
def test_columns_of_a_data_frame_are_found(columns):
    X = rows(4)
    frame = pd.DataFrame(X, columns=list("abcd"))
    fitted = ColumnTransformer([("scaled", StandardScaler(), columns)], remainder="passthrough").fit(frame)
    x, (row,) = expressions(fitted, 4)
    found = ca.Function("h", [x], [row])(X[0])
    np.testing.assert_allclose(found.full().ravel(), fitted.transform(frame[:1])[0], rtol=1e-12)


@pytest.mark.parametrize("robot", ["pendulum", "acrobot", "iiwa14"])
@pytest.mark.parametrize("kind", [AngleEncoder, InertiaForce, InertiaForceGravity, LinkGravity, NominalDynamics])
def test_rows_that_end_with_their_time_step(kind, robot):
    X = rows(layout_of(robot).n_columns + 1)
    X[:, -1] = np.linspace(0.005, 0.05, len(X))
    fitted = kind(robot, dt="column").fit(X)
    x, (row,) = expressions(fitted, X.shape[1])
    function = ca.Function("h", [x], [row, ca.jacobian(row, x)])
    for own, values, slopes in zip(X[:5], fitted.transform(X), fitted.jacobian(X), strict=False):
        found, jacobian = function(own)
        np.testing.assert_allclose(found.full().ravel(), values, rtol=1e-9, atol=1e-11 * np.abs(values).max())
        np.testing.assert_allclose(jacobian.full(), slopes, rtol=1e-8, atol=1e-10 * np.abs(slopes).max())


def test_no_map_and_a_passthrough_leave_the_row():
    x = ca.MX.sym("x", 3)
    assert mapped(None, x, "kernel_map") is x
    assert mapped("passthrough", x, "kernel_map") is x


def test_a_polynomial_is_exact_where_a_column_is_zero():
    """No logarithms of powers."""
    fitted = PolynomialFeatures(2).fit(rows(2))
    x, (row,) = expressions(fitted, 2)
    jacobian = ca.Function("j", [x], [ca.jacobian(row, x)])([0.0, 2.0])
    np.testing.assert_array_equal(jacobian.full(), [[0, 0], [1, 0], [0, 1], [0, 0], [2, 0], [0, 4]])


def test_parts_with_a_row_per_output_are_joined_to_others():
    fitted = make_union(Rows(), StandardScaler()).transformer_list
    union = FeatureUnion([(name, part.fit(rows(3))) for name, part in fitted], transformer_weights={"rows": 2.0})
    x, (first, second) = expressions(union, 3)
    X = rows(3)[:1]
    scaled = union.transformer_list[1][1].transform(X)[0]
    found = ca.Function("h", [x], [first, second])(X[0])
    for own, output in zip(Rows().transform(X)[0], found, strict=True):
        np.testing.assert_allclose(output.full().ravel(), [*(2.0 * own), *scaled], rtol=1e-12)


@pytest.mark.parametrize(
    "transformer",
    [
        QuantileTransformer(n_quantiles=5),
        make_pipeline(StandardScaler(), QuantileTransformer(n_quantiles=5)),
        make_union(StandardScaler(), QuantileTransformer(n_quantiles=5)),
        ColumnTransformer([("a", QuantileTransformer(n_quantiles=5), [0])]),
    ],
    ids=lambda transformer: type(transformer).__name__,
)
def test_other_maps_are_named(transformer):
    with pytest.raises(
        TypeError, match=r"kernel_map: QuantileTransformer\(.*cannot be .*StandardScaler.* to_casadi\(x\)"
    ):
        expressions(transformer.fit(rows(3)), 3, "kernel_map")


def test_a_subclass_may_do_something_else():
    class Doubled(StandardScaler):
        def transform(self, X, copy=None):
            return 2.0 * super().transform(X, copy)

    with pytest.raises(TypeError, match=r"feature_map: Doubled\(\) cannot be written in CasADi"):
        expressions(Doubled().fit(rows(3)), 3)


def test_a_function_of_numpy_that_casadi_has_not_is_named():
    with pytest.raises(TypeError, match=r"FunctionTransformer\(.*sin, cos, .*to_casadi"):
        expressions(FunctionTransformer(np.cbrt).fit(rows(3)), 3)


def test_a_map_after_one_with_a_row_per_output_is_an_error():
    with pytest.raises(TypeError, match=r"StandardScaler\(\) comes after a map that returns a row for each output"):
        expressions(Pipeline([("rows", Rows()), ("scaled", StandardScaler())]), 3)


def test_words_cannot_be_exported():
    with pytest.raises(TypeError, match="OneHotEncoder"):
        expressions(OneHotEncoder().fit([["a"], ["b"]]), 1, "kernel_map")
