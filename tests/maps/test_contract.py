"""What every adapter promises: its value is what `transform` returns, its Jacobian the derivative of that, its CasADi
expression the same function again. A new adapter gets a case in `CASES`; one without a case fails the first test.
"""

import pickle
from copy import deepcopy
from functools import cache

import autograd.numpy as anp
import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.compose import ColumnTransformer
from sklearn.decomposition import PCA, TruncatedSVD
from sklearn.pipeline import FeatureUnion, Pipeline, make_pipeline, make_union
from sklearn.preprocessing import (
    FunctionTransformer,
    MaxAbsScaler,
    MinMaxScaler,
    Normalizer,
    PolynomialFeatures,
    RobustScaler,
    SplineTransformer,
    StandardScaler,
)

from skevgp.features import (
    AngleEncoder,
    Friction,
    InertiaForce,
    InertiaForceGravity,
    LinkGravity,
    LogNormal,
    NominalDynamics,
    Normal,
    ParametricFeatures,
    RigidBodyRegressor,
    Uniform,
)
from skevgp.features.robot_map import RobotTransformer
from skevgp.maps import ADAPTERS, NoExpressionError, as_map
from skevgp.maps.theta import LinearizedFeatures, Theta, theta_jacobian

from ..theta import DECAY, PRIORS, WAVE, rows_of_outputs, wave_and_slope

TERMS = ["acceleration", "midpoint", "gravity", "bias", "input"]
MASK = np.array([False, True, False, False, True])


class Wave(TransformerMixin, BaseEstimator):
    """A user's own map, which says all that a map can say."""

    def fit(self, X, y=None):
        self.n_features_in_ = X.shape[1]
        return self

    def transform(self, X):
        return np.column_stack([np.sin(X[:, 0]), X[:, 1] ** 2])

    def jacobian(self, X):
        jacobian = np.zeros((len(X), 2, X.shape[1]))
        jacobian[:, 0, 0], jacobian[:, 1, 1] = np.cos(X[:, 0]), 2.0 * X[:, 1]
        return jacobian

    def to_casadi(self, x):
        return ca.vertcat(ca.sin(x[0]), x[1] ** 2)


class PerOutput(TransformerMixin, BaseEstimator):
    """A row for each of two outputs, and no Jacobian."""

    def fit(self, X, y=None):
        self.n_features_in_ = X.shape[1]
        return self

    def transform(self, X):
        return np.stack([np.sin(X[:, :2]), X[:, 1:3] ** 2], axis=1)

    def to_casadi(self, x):
        return [ca.sin(x[:2]), x[1:3] ** 2]


class Linearized(LinearizedFeatures):
    """With a fit, at parameters that are not their medians."""

    def __init__(self, feature_map, columns=None):
        super().__init__(feature_map, columns)

    def fit(self, X, y=None):
        feature_map = self.feature_map.fit(X)
        theta = Theta.of(feature_map)
        theta.set(np.linspace(0.5, -0.5, len(theta)))
        jacobian = theta_jacobian(feature_map, X, theta)
        largest = np.abs(jacobian).reshape(-1, *jacobian.shape[-2:]).max(axis=0)
        return LinearizedFeatures(feature_map, np.argwhere(largest > 0.0))


def wave(X, period, height):
    return anp.stack([height * anp.sin(X[:, 0] / period), X[:, 1] ** 2 + height], axis=1)


def by_columns(*parts, **arguments):
    return ColumnTransformer([(str(number), *part) for number, part in enumerate(parts)], **arguments)


def spline(degree, extrapolation, include_bias=True):
    return SplineTransformer(4, degree=degree, extrapolation=extrapolation, include_bias=include_bias)


SCALED_ANGLES = make_pipeline(AngleEncoder("acrobot"), StandardScaler())
UNION = FeatureUnion(
    [
        ("inertia", InertiaForce("acrobot")),
        ("no", "drop"),
        ("gravity", LinkGravity("acrobot")),
        ("as it is", "passthrough"),
        ("dynamics", NominalDynamics("acrobot")),
    ],
    transformer_weights={"gravity": 0.1, "as it is": -2.0},
)
# Of five columns each.
SKLEARN = {
    "standard": StandardScaler(),
    "standard, no mean": StandardScaler(with_mean=False),
    "standard, no std": StandardScaler(with_std=False),
    "standard, nothing": StandardScaler(with_mean=False, with_std=False),
    "min max": MinMaxScaler(feature_range=(-2.0, 1.0)),
    "min max, clip": MinMaxScaler((0.2, 0.7), clip=True),
    "max abs": MaxAbsScaler(),
    "robust": RobustScaler(),
    "robust, no centre": RobustScaler(with_centering=False, unit_variance=True),
    "robust, no scale": RobustScaler(with_scaling=False),
    "polynomial": PolynomialFeatures(3),
    "polynomial, linear": PolynomialFeatures(1, include_bias=False),
    "polynomial, constant": PolynomialFeatures(0),
    "polynomial, another order": PolynomialFeatures(4, order="F"),
    "polynomial, interactions": PolynomialFeatures((2, 3), interaction_only=True, include_bias=False),
    "polynomial, one degree": PolynomialFeatures((3, 3), interaction_only=True),
    "polynomial, from nothing": PolynomialFeatures((0, 2)),
    "spline, constant": spline(3, "constant"),
    "spline, linear": spline(3, "linear", False),
    "spline, quadratic": spline(2, "linear"),
    "spline, broken lines": spline(1, "constant"),
    "spline, broken lines that go on": spline(1, "linear"),
    "spline, continued": spline(2, "continue"),
    "spline, periodic": spline(3, "periodic", False),
    "pca": PCA(),
    "pca, two": PCA(2),
    "pca, whitened": PCA(2, whiten=True, random_state=0),
    "svd": TruncatedSVD(2, random_state=0),
    "identity": FunctionTransformer(),
    "identity, validated": FunctionTransformer(validate=True),
    "sine": FunctionTransformer(np.sin),
    "hyperbolic tangent": FunctionTransformer(np.tanh),
    "function": FunctionTransformer(np.arcsinh),
    "pipeline": make_pipeline(StandardScaler(), "passthrough", PolynomialFeatures(2)),
    "pipeline, scaled angles": SCALED_ANGLES,
    "pipeline, three steps": make_pipeline(AngleEncoder("acrobot"), PolynomialFeatures(2), StandardScaler()),
    "pipeline, scaled twice": make_pipeline(StandardScaler(), PCA(3), MinMaxScaler(), PolynomialFeatures(3)),
    "pipeline, clipped": make_pipeline(MinMaxScaler(clip=True), PCA(2), PolynomialFeatures(2), MinMaxScaler(clip=True)),
    "pipeline, one step": make_pipeline(PolynomialFeatures(2)),
    "pipeline, nothing": Pipeline([("a", "passthrough"), ("b", None)]),
    "pipeline, identities": make_pipeline(FunctionTransformer(), PolynomialFeatures(2), "passthrough"),
    "pipeline, unknown step": make_pipeline(AngleEncoder("acrobot"), Normalizer(), StandardScaler()),
    "union": UNION,
    "union, in a pipeline": make_pipeline(StandardScaler(), UNION, PCA(4)),
    "union, of pipelines": FeatureUnion([("a", SCALED_ANGLES), ("b", make_pipeline(PCA(2), PolynomialFeatures(2)))]),
    "union, of nothing": FeatureUnion([("a", "drop")]),
    "union, unknown part": FeatureUnion([("a", Normalizer()), ("b", SCALED_ANGLES)], transformer_weights={"a": 2.0}),
    "columns": by_columns((PolynomialFeatures(2), [3, 0]), (StandardScaler(), slice(1, 3)), remainder="drop"),
    "columns, and the rest": by_columns((StandardScaler(), [1]), ("drop", [0, 4]), remainder="passthrough"),
    "columns, a rest that is mapped": by_columns((StandardScaler(), MASK), remainder=PolynomialFeatures(2)),
    "columns, one twice": by_columns((PolynomialFeatures(2), [2, 2]), ("passthrough", [2, -1]), (PCA(), [])),
    "columns, a list for a mask": by_columns((PolynomialFeatures(2), MASK.tolist()), remainder="passthrough"),
    "columns, called": by_columns((MinMaxScaler(), lambda X: [3, -4])),
    "columns, weights": by_columns((PCA(), slice(None, -1)), (PCA(), [0, 1]), transformer_weights={"1": 3.0}),
    "columns, in a pipeline": make_pipeline(
        PolynomialFeatures(2), by_columns((MinMaxScaler(), slice(0, 20, 3)), (PCA(2), [4, 8, 7])), StandardScaler()
    ),
    "columns, unknown part": by_columns((Normalizer(), [0, 3]), remainder="passthrough"),
    "columns, a vector": by_columns((FunctionTransformer(lambda x: np.column_stack([x**2, x**3])), 2), (PCA(), [0, 1])),
    "columns, no part of a vector": by_columns((StandardScaler(), [0, 1]), ("drop", 2)),
    "own": make_union(Wave(), StandardScaler()),
    "rows": PerOutput(),
    "rows, at the end": make_pipeline(StandardScaler(), PCA(3), PerOutput()),
    "rows, in the middle": make_pipeline(PerOutput(), FunctionTransformer(np.exp), FunctionTransformer()),
}
# With the number of their columns.
PHYSICS = {
    "angles": (AngleEncoder(angles=[2, 0]), 4),
    "no angles": (AngleEncoder(), 4),
    "angles, pendulum": (AngleEncoder("pendulum"), 3),
    "angles, cartpole": (AngleEncoder("cartpole"), 5),
    "angles, iiwa14": (AngleEncoder("iiwa14"), 21),
    "IF, no robot": (InertiaForce(), 4),
    "IF": (InertiaForce("cartpole"), 5),
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
    "torques, no robot": (RigidBodyRegressor(), 4),
    "torques": (RigidBodyRegressor("acrobot"), 6),
}
FACTORS = {f"{kind}(q{i})": LogNormal(1.0, 0.3) for i in (1, 2) for kind in ("mass", "length", "inertia", "damping")}
NUMBERS = {"stiction_velocity": LogNormal(0.5, 0.5), "sharpness(q2)": Uniform(0.5, 2.5)}
WITH_PARAMETERS = {
    "function": (ParametricFeatures(wave, {"period": LogNormal(2.0, 0.5), "height": Normal(1.0, 0.5)}), 4),
    "sines": (InertiaForceGravity("acrobot", parameters={"offset(q2)": Normal(0.1, 0.1)}), 5),
    "levers": (InertiaForceGravity("iiwa14", parameters={"offset(q4)": Normal(0.1, 0.1)}), 21),
    "gravity": (LinkGravity("acrobot", parameters={"offset(q1)": Normal(0.1, 0.1)}), 5),
    "friction": (Friction("acrobot", stribeck_velocity=2.0, parameters=NUMBERS), 5),
    "nominal": (NominalDynamics("acrobot", terms=TERMS, parameters=FACTORS), 5),
    "nominal, ur5": (NominalDynamics("ur5", parameters={"length(elbow_joint)": LogNormal(1.0, 0.2)}), 18),
    "torques": (RigidBodyRegressor("acrobot", parameters={"stiction_velocity": LogNormal(0.5, 0.5)}), 6),
    "union": (
        make_union(
            InertiaForce("acrobot"),
            NominalDynamics("acrobot", parameters={"mass(q1)": LogNormal(1.0, 0.3)}),
            make_pipeline(LinkGravity("acrobot", parameters={"offset(q2)": Normal(0.1, 0.1)}), PolynomialFeatures(2)),
        ),
        5,
    ),
}
LINEARIZED = {
    f"linearized, {name}": (Linearized(feature_map), n_columns)
    for name, (feature_map, n_columns) in WITH_PARAMETERS.items()
}
PHYSICS |= {"friction, no robot": (Friction(), 4), "friction": (Friction("acrobot"), 5), **LINEARIZED}
PHYSICS["function of parameters"] = WITH_PARAMETERS["function"]
LINEAR = np.array([[0, 0], [0, 1], [2, 1]])
THETA = {
    "parametric": (WAVE, 2),
    "parametric, rows": (ParametricFeatures(rows_of_outputs, PRIORS), 2),
    "parametric, in a pipeline": (make_pipeline(StandardScaler(), WAVE, PolynomialFeatures(2)), 2),
    "parametric, by differences": (ParametricFeatures(wave_and_slope, PRIORS, derivatives="differences"), 2),
    "linearised": (LinearizedFeatures(make_union(WAVE, StandardScaler()), LINEAR[:2]), 2),
    "linearised, rows": (LinearizedFeatures(ParametricFeatures(rows_of_outputs, PRIORS), LINEAR[:2]), 2),
    "linearised, nested": (
        LinearizedFeatures(
            FeatureUnion(
                [("a", WAVE), ("b", make_pipeline(StandardScaler(), DECAY, MinMaxScaler()))],
                transformer_weights={"a": 2.0},
            ),
            np.array([[0, 1], [1, 2]]),
        ),
        2,
    ),
}
TIMED = {
    f"{kind.__name__}, {robot}, time step": (kind(robot, dt="column"), n_columns)
    for kind in (AngleEncoder, Friction, InertiaForce, InertiaForceGravity, LinkGravity, NominalDynamics)
    for robot, n_columns in (("pendulum", 4), ("acrobot", 6), ("iiwa14", 22))
}
CASES = {**{name: (transformer, 5) for name, transformer in SKLEARN.items()}, **PHYSICS, **THETA, **TIMED}
# Those that are not, or not wholly, known, so that differences or `transform` are asked.
BY_DIFFERENCES = {
    "spline, broken lines that go on",
    "sine",
    "hyperbolic tangent",
    "function",
    "pipeline, unknown step",
    "union, unknown part",
    "columns, unknown part",
    "columns, a vector",
    "columns, no part of a vector",
    "own",
    "rows",
    "rows, at the end",
    "rows, in the middle",
    *LINEARIZED,
    "parametric, by differences",
    *(name for name in THETA if name.startswith("linearised")),
}
WITHOUT_EXPRESSION = {
    "function": r"cannot be written in CasADi\. Only these NumPy functions can be exported: sin, ",
    "pipeline, unknown step": r"Normalizer\(\) cannot be written in CasADi\. These can be exported: AngleEncoder,",
    "union, unknown part": r"Normalizer\(\) cannot",
    "columns, unknown part": r"Normalizer\(\) cannot",
    "columns, a vector": "FunctionTransformer.*cannot",
    "rows, in the middle": "comes after a map that returns a row for each output",
    "torques": "RigidBodyRegressor.*StandardScaler.* any transformer with a method to_casadi",
    "torques, no robot": "RigidBodyRegressor",
    "linearized, torques": r"(?s)The parameters of RigidBodyRegressor.*cannot be written in CasADi",
    **dict.fromkeys([name for name in SKLEARN if name.startswith("spline")], r"SplineTransformer\("),
}


def rows(n_columns, n_rows=200, seed=0, timed=False):
    """Some outside the range of those that the cases are fitted to."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n_rows, n_columns)) * np.resize([1.0, 0.5, 2.0, 1.0, 1.5], n_columns)
    X += np.resize([0.0, 1.0, 0.0, -2.0, 0.3], n_columns)
    if timed:
        X[:, -1] = np.linspace(0.005, 0.05, n_rows)
    return X


def rows_of(name, n_rows=200, seed=0):
    return rows(CASES[name][1], n_rows, seed, name in TIMED)


def differences(function, X, step=1e-6):
    both = [(function(X + shift) - function(X - shift)) / (2.0 * step) for shift in step * np.eye(X.shape[1])]
    return np.stack(both, axis=-1)


def close(found, expected, share):
    assert found.shape == expected.shape
    assert found.dtype == np.float64
    assert_allclose(found, expected, rtol=0.0, atol=share * max(np.abs(expected).max(initial=0.0), 1e-3))


@pytest.fixture(params=CASES)
def name(request):
    return request.param


@cache
def fitted(name):
    """Fitted once for all tests, which do not change it."""
    transformer, X = deepcopy(CASES[name][0]), rows_of(name, 40, seed=1)
    if isinstance(transformer, LinearizedFeatures):
        transformer.feature_map.fit(X)
    return transformer.fit(X)


@pytest.fixture
def transformer(name):
    return fitted(name)


def test_every_adapter_has_a_case():
    def kinds(transformer):
        yield type(transformer)
        parts = getattr(transformer, "steps", None) or getattr(transformer, "transformer_list", [])
        for _, part in parts:
            yield from kinds(part)

    tried = {kind for transformer, _ in CASES.values() for kind in kinds(transformer)}
    # A subclass of each is there.
    assert set(ADAPTERS) - tried == {RobotTransformer}


def test_value_is_that_of_transform(name, transformer):
    X = rows_of(name)
    rounded = name.startswith(
        ("pca", "svd", "pipeline", "union", "columns", "own", "rows", "linearised, nested", "parametric, in")
    )
    for some in (X, X[:1]):
        close(as_map(transformer).value(some), transformer.transform(some), 1e-12 if rounded else 0.0)


def test_jacobian_is_the_derivative_of_transform(name, transformer):
    n_rows = 60 if CASES[name][1] <= 6 else 20
    X = rows_of(name, n_rows)
    close(as_map(transformer, example=X).jacobian(X), differences(transformer.transform, X), 1e-6)


def test_chain_rule_is_the_product(name, transformer):
    X, own = rows_of(name, 7), as_map(transformer)
    inner = np.random.default_rng(2).normal(size=(7, X.shape[1], 3))
    jacobian = own.jacobian(X)
    expected = jacobian @ (inner if jacobian.ndim == 3 else inner[:, np.newaxis])
    close(own.chain(X, inner), expected, 1e-7 if name in BY_DIFFERENCES else 1e-12)


def test_expression_is_the_function_and_its_derivative(name, transformer):
    X = rows_of(name, 5, seed=3)
    x, own = ca.MX.sym("x", X.shape[1]), as_map(transformer)
    if name in WITHOUT_EXPRESSION:
        with pytest.raises(NoExpressionError, match=WITHOUT_EXPRESSION[name]):
            own.casadi(x)
        return
    row = own.casadi(x)
    each = row if isinstance(row, list) else [row]
    outputs = [*each, ca.densify(ca.jacobian(ca.vertcat(*each), x))]
    expected, slopes = transformer.transform(X), own.jacobian(X)
    assert isinstance(row, list) == (expected.ndim == 3)
    for own_values, own_slopes, found in zip(
        expected.reshape(len(X), len(each), -1),
        slopes.reshape(len(X), -1, X.shape[1]),
        map(ca.Function("h", [x], outputs).call, ([row] for row in X)),
        strict=True,
    ):
        for values, output in zip(own_values, found, strict=False):
            assert output.shape == (len(values), 1)
            close(output.full().ravel(), values, 1e-11)
        close(found[-1].full(), own_slopes, 1e-7 if name in BY_DIFFERENCES else 1e-9)


def test_adapter_pickles_and_keeps_rows(name, transformer):
    X = rows_of(name, 9)
    own = as_map(transformer)
    before = own.value(X).copy(), own.jacobian(X)
    again = own if "lambda" in str(transformer) else pickle.loads(pickle.dumps(own))
    again.jacobian(X)[...] = 0.0
    assert_array_equal(X, rows_of(name, 9))
    assert_array_equal(again.value(X), before[0])
    assert_array_equal(again.jacobian(X), before[1])
