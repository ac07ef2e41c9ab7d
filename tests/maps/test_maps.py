import pickle
import re
import warnings

import numpy as np
import pandas as pd
import polars
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.compose import ColumnTransformer
from sklearn.decomposition import PCA
from sklearn.pipeline import FeatureUnion, Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer, MinMaxScaler, Normalizer, PolynomialFeatures, StandardScaler

from skevgp.features import AngleEncoder, InertiaForce, InertiaForceGravity, LinkGravity, NominalDynamics
from skevgp.maps.elementary import Foreign
from skevgp.maps.maps import direct_map

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


def by_columns(*parts, **arguments):
    return ColumnTransformer([(str(number), *part) for number, part in enumerate(parts)], **arguments)


MASK = np.array([False, True, False, False, True])
COMPOSED = {
    "scaled angles": SCALED_ANGLES,
    "three steps": make_pipeline(AngleEncoder("acrobot"), PolynomialFeatures(2), StandardScaler()),
    "scaled at the end and before": make_pipeline(StandardScaler(), PCA(3), MinMaxScaler(), PolynomialFeatures(3)),
    "clipped inside": make_pipeline(MinMaxScaler(clip=True), PCA(2), PolynomialFeatures(2), MinMaxScaler(clip=True)),
    "one step": make_pipeline(PolynomialFeatures(2)),
    "nothing": Pipeline([("a", "passthrough"), ("b", None)]),
    "identities inside": make_pipeline(FunctionTransformer(), PolynomialFeatures(2), "passthrough"),
    "union": UNION,
    "union in a pipeline": make_pipeline(StandardScaler(), UNION, PCA(4)),
    "pipelines in a union": FeatureUnion([("a", SCALED_ANGLES), ("b", make_pipeline(PCA(2), PolynomialFeatures(2)))]),
    "columns": by_columns((PolynomialFeatures(2), [3, 0]), (StandardScaler(), slice(1, 3)), remainder="drop"),
    "columns and the rest": by_columns((StandardScaler(), [1]), ("drop", [0, 4]), remainder="passthrough"),
    "a rest that is mapped": by_columns((StandardScaler(), MASK), remainder=PolynomialFeatures(2)),
    "a column twice": by_columns((PolynomialFeatures(2), [2, 2]), ("passthrough", [2, -1]), (PCA(), [])),
    "a list for a mask": by_columns((PolynomialFeatures(2), MASK.tolist()), remainder="passthrough"),
    "weighed columns": by_columns((PCA(), slice(None, -1)), (PCA(), [0, 1]), transformer_weights={"1": 3.0}),
    "columns in a pipeline": make_pipeline(
        PolynomialFeatures(2), by_columns((MinMaxScaler(), slice(0, 20, 3)), (PCA(2), [4, 8, 7])), StandardScaler()
    ),
}
each_composed = pytest.mark.parametrize("name", COMPOSED)
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
    assert_allclose(direct_map(transformer).value(X), transformer.transform(X), rtol=1e-12, atol=1e-12)
    jacobian, expected = direct_map(transformer).jacobian(X), differences(transformer.transform, X)
    assert jacobian.shape == expected.shape
    assert_allclose(jacobian, expected, rtol=0.0, atol=rtol * max(np.abs(expected).max(initial=0.0), 1e-3))


@pytest.fixture
def nothing_numerical(monkeypatch):
    def never(*arguments):
        raise AssertionError("not to be called")

    monkeypatch.setattr(Foreign, "_differences", never)
    monkeypatch.setattr(Foreign, "value", never)


@pytest.mark.usefixtures("nothing_numerical")
@each_composed
def test_values_and_jacobians_of_compositions(name):
    check(fitted(COMPOSED[name]), rows())


@each_composed
def test_the_chain_rule_goes_through_compositions(name):
    direct_one, inner = direct_map(fitted(COMPOSED[name])), np.random.default_rng(2).normal(size=(100, 5, 3))
    assert_allclose(direct_one.chain(rows(), inner), direct_one.jacobian(rows()) @ inner, rtol=1e-11, atol=1e-10)


@each_composed
def test_compositions_can_be_pickled_and_change_no_row(name):
    X, one = rows(), direct_map(fitted(COMPOSED[name]))
    value, jacobian = one.value(X).copy(), one.jacobian(X).copy()
    again = pickle.loads(pickle.dumps(one))
    again.jacobian(X)[...] = 0.0
    assert_array_equal(X, rows())
    assert_array_equal(again.value(X), value)
    assert_array_equal(again.jacobian(X), jacobian)


@each_composed
def test_what_calls_itself_linear_has_one_jacobian_for_all_rows(name):
    one = direct_map(fitted(COMPOSED[name]))
    if one.linear:
        assert np.ptp(one.jacobian(rows()), axis=0).max(initial=0.0) == 0.0


def test_what_is_linear_is_known_through_compositions():
    names = {name for name in COMPOSED if direct_map(fitted(COMPOSED[name])).linear}
    assert names == {"nothing", "columns and the rest", "weighed columns"}


@pytest.mark.parametrize("n_rows", [1, 50])
def test_scaled_angles_are_bitwise_those_of_transform(n_rows):
    transformer = fitted(SCALED_ANGLES)
    assert_array_equal(direct_map(transformer).value(rows(n_rows)), transformer.transform(rows(n_rows)))


@pytest.mark.parametrize(
    "transformer", [None, "passthrough", FunctionTransformer(), FunctionTransformer(validate=True)]
)
def test_identities(transformer):
    X = rows()
    assert_array_equal(direct_map(transformer).value(X), X)
    assert_array_equal(direct_map(transformer).jacobian(X), np.broadcast_to(np.eye(5), (100, 5, 5)))


def test_a_union_of_nothing_has_no_columns():
    transformer = fitted(FeatureUnion([("a", "drop")]))
    assert direct_map(transformer).value(rows()).shape == (100, 0)
    assert direct_map(transformer).jacobian(rows()).shape == (100, 0, 5)


# --- parts that are not known ------------------------------------------------------------------------------------


class PerOutput(TransformerMixin, BaseEstimator):
    """A row for each of three outputs."""

    def fit(self, X, y=None):
        self.n_features_in_ = X.shape[1]
        return self

    def transform(self, X):
        return np.stack([np.sin(X[:, 1:]), np.cos(X[:, :-1]), X[:, 1:] * X[:, :-1]], axis=1)


@pytest.mark.parametrize(
    "transformer",
    [
        make_pipeline(AngleEncoder("acrobot"), Normalizer(), StandardScaler()),
        FeatureUnion([("a", Normalizer()), ("b", SCALED_ANGLES)], transformer_weights={"a": 2.0}),
        by_columns((Normalizer(), [0, 3]), remainder="passthrough"),
        by_columns((FunctionTransformer(lambda x: np.column_stack([x**2, x**3])), 2), (PCA(), [0, 1])),
    ],
    ids=["pipeline", "union", "columns", "a column as a vector"],
)
def test_a_part_that_is_not_known_is_differentiated_numerically(transformer):
    check(fitted(transformer), rows(1000))


def test_a_row_for_each_output_at_the_end():
    check(fitted(make_pipeline(StandardScaler(), PolynomialFeatures(2), PerOutput())), rows())
    assert direct_map(fitted(make_pipeline(PCA(3), PerOutput()))).jacobian(rows()).shape == (100, 3, 2, 5)


def test_a_row_for_each_output_in_the_middle():
    check(fitted(make_pipeline(PerOutput(), FunctionTransformer(np.exp), FunctionTransformer())), rows())
    inner = np.random.default_rng(2).normal(size=(100, 5, 2))
    one = direct_map(fitted(make_pipeline(PerOutput(), FunctionTransformer(np.exp))))
    assert_allclose(one.chain(rows(), inner), one.jacobian(rows()) @ inner[:, np.newaxis], rtol=1e-6, atol=1e-6)


def test_a_union_of_rows_for_each_output_and_rows_for_all():
    union, X = FeatureUnion([("all", AngleEncoder("acrobot")), ("each", PerOutput())]), rows()
    for _, part in union.transformer_list:
        part.fit(X)
    value, jacobian = direct_map(union).value(X), direct_map(union).jacobian(X)
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
        found = direct_map(fitted(transformer, X), example=X).jacobian(X)
        assert_allclose(found, exact, rtol=0.0, atol=1e-8 * np.abs(exact).max())


class Halved(Pipeline):
    def transform(self, X):
        return super().transform(X) / 2.0


def test_a_class_below_a_pipeline_is_known_by_what_it_does():
    transformer = fitted(Halved([("a", StandardScaler())]))
    check(transformer, rows())
    assert type(direct_map(transformer)) is Foreign


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
        value, jacobian = direct_map(transformer).value(rows()), direct_map(transformer).jacobian(rows())
    assert_allclose(value, by_frame(rows()), rtol=1e-12, atol=1e-12)
    assert_allclose(jacobian, differences(by_frame, rows()), rtol=0.0, atol=1e-6 * np.abs(jacobian).max())


def test_a_pipeline_whose_steps_make_frames():
    frame = pd.DataFrame(rows(40, seed=1), columns=NAMES)
    transformer = make_pipeline(StandardScaler(), Normalizer(), PolynomialFeatures(2)).set_output(transform="pandas")
    transformer.fit(frame)
    expected = transformer.transform(pd.DataFrame(rows(), columns=NAMES)).to_numpy()
    assert type(direct_map(transformer).value(rows())) is np.ndarray
    assert_allclose(direct_map(transformer).value(rows()), expected, rtol=1e-12, atol=1e-12)
    assert direct_map(transformer).jacobian(rows()).shape == (100, 21, 5)


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
        read = direct_map(transformer, example=given)
        assert_allclose(read.value(rows()), transformer.transform(new), rtol=1e-12, atol=1e-12)
        assert read.jacobian(rows()).shape == (100, 1, 5)
