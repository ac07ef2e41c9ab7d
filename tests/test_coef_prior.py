import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.compose import make_column_transformer
from sklearn.pipeline import FeatureUnion, make_pipeline, make_union
from sklearn.preprocessing import FunctionTransformer, OneHotEncoder, PolynomialFeatures, StandardScaler

from skevgp.features import InertiaForce, InertiaForceGravity
from skevgp.fitting.prior import CoefPrior, resolved, wide_scale

RNG = np.random.default_rng(0)
X = RNG.normal(size=(20, 3)) * [1.0, 10.0, 0.1]
TARGETS = RNG.normal(size=(20, 2)) * [1.0, 5.0] + 3.0
IF_MEAN, IF_SCALE = InertiaForce("pendulum").coef_prior(2)


class Opinionated(TransformerMixin, BaseEstimator):
    """The identity, with a prior given beforehand."""

    def __init__(self, mean, scale):
        self.mean = mean
        self.scale = scale

    def fit(self, X, y=None):
        return self

    def transform(self, X):
        return X

    def coef_prior(self, n_outputs):
        return self.mean, self.scale


def resolve(feature_map, mean="auto", scale="auto", targets=TARGETS):
    fitted = feature_map.fit(X)
    prior = CoefPrior(mean, scale)
    return resolved(prior, fitted, X, wide(fitted.transform(X), targets), targets.shape[1])[:2]


def wide(features, targets=TARGETS):
    return wide_scale(np.sqrt(np.mean(features**2, axis=0)), targets.std(axis=0), np.abs(targets).max(axis=0))


@pytest.mark.parametrize("feature_map", [InertiaForce("pendulum"), InertiaForceGravity("pendulum", gravity_gain=20.0)])
def test_auto_asks_the_map(feature_map):
    mean, scale = resolve(feature_map)
    expected_mean, expected_scale = feature_map.coef_prior(2)
    assert_array_equal(mean, expected_mean)
    assert_array_equal(scale, expected_scale)


def test_map_without_an_opinion_gets_a_wide_prior():
    polynomials = PolynomialFeatures(2)
    mean, scale = resolve(polynomials)
    assert_array_equal(mean, np.zeros((2, 10)))
    assert_allclose(scale, wide(polynomials.transform(X)))


def test_target_and_a_feature_of_zeros_get_a_finite_scale():
    nothing = FunctionTransformer(np.zeros_like)
    assert_array_equal(resolve(nothing, targets=np.zeros((20, 1)))[1], [[10.0, 10.0, 10.0]])


def test_union_concatenates():
    polynomials = PolynomialFeatures(2)
    mean, scale = resolve(make_union(InertiaForce("pendulum"), polynomials))
    assert_array_equal(mean, np.hstack([IF_MEAN, np.zeros((2, 10))]))
    assert_allclose(scale, np.hstack([IF_SCALE, wide(polynomials.fit_transform(X))]))


def test_parts_of_a_column_transformer_see_their_columns_of_a_frame(frame_of):
    names = ["theta", "dtheta/dt", "u"]
    frame = frame_of({"kind": ["x", "y"] * 10} | dict(zip(names, X.T, strict=True)))
    scaled = make_pipeline(StandardScaler(), InertiaForce("pendulum"))
    parts = make_column_transformer((OneHotEncoder(), ["kind"]), (scaled, names)).fit(frame)
    features = parts.transform(frame)
    mean, scale, _ = resolved(CoefPrior(), parts, frame, wide(features), 2)
    assert_array_equal(mean, np.hstack([np.zeros((2, 2)), IF_MEAN]))
    assert_allclose(scale, np.hstack([wide(features[:, :2]), IF_SCALE]))


def test_weights_of_a_union_are_divided_out():
    union = FeatureUnion(
        [("physics", InertiaForce("pendulum")), ("x", "passthrough")], transformer_weights={"physics": 4.0, "x": 0.5}
    )
    mean, scale = resolve(union)
    assert_allclose(mean, np.hstack([IF_MEAN / 4.0, np.zeros((2, 3))]))
    assert_allclose(scale, np.hstack([IF_SCALE / 4.0, wide(0.5 * X)]))


@pytest.mark.parametrize("name", ["mean", "scale"])
@pytest.mark.parametrize("shape", [(3,), (2,), (1, 3), (2, 1), (3, 2), (2, 3, 1)])
def test_table_of_another_shape_raises(name, shape):
    with pytest.raises(ValueError, match=rf"{name} of CoefPrior must be .* \(2, 3\); got the shape \({shape[0]},"):
        resolve(FunctionTransformer(), **{name: np.ones(shape)})


def test_one_output_does_not_take_a_row_of_another_width():
    with pytest.raises(ValueError, match=r"mean of CoefPrior must be .* \(1, 3\), or \(3,\) .*; got the shape \(2,\)"):
        resolve(FunctionTransformer(), mean=[1.0, 2.0], targets=TARGETS[:, :1])


def test_negative_scale_raises():
    with pytest.raises(ValueError, match=r"scale of CoefPrior must not be negative; its smallest value is -2\.0"):
        resolve(FunctionTransformer(), scale=[[1.0, 1.0, 1.0], [1.0, -2.0, 1.0]])


@pytest.mark.parametrize("name", ["mean", "scale"])
@pytest.mark.parametrize("value", [np.nan, np.inf, [[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]]])
def test_values_must_be_finite(name, value):
    with pytest.raises(ValueError, match="must be finite"):
        resolve(FunctionTransformer(), **{name: value})


@pytest.mark.parametrize(
    ("mean", "scale"),
    [
        (np.zeros((2, 2)), np.ones((2, 2))),
        (np.zeros((2, 3)), np.ones((2, 4))),
        (np.zeros((3, 2)), np.ones((2, 3))),
        (np.zeros(3), np.ones(3)),
        (0.0, 1.0),
    ],
)
def test_map_whose_prior_has_another_shape_raises(mean, scale):
    with pytest.raises(ValueError, match=r"(?s)coef_prior of Opinionated.* = \(2, 3\), .*; got "):
        resolve(Opinionated(mean, scale))


def test_part_of_a_union_whose_prior_has_another_width_raises():
    union = make_union(Opinionated(np.zeros((2, 2)), np.ones((2, 2))), FunctionTransformer())
    with pytest.raises(ValueError, match=r"\(2, 3\), .*; got \[\(2, 2\), \(2, 2\)\]"):
        resolve(union)


def test_width_of_the_target_must_fit_the_robot():
    with pytest.raises(ValueError, match="y has 1 columns, but InertiaForce"):
        resolve(InertiaForce("pendulum"), targets=TARGETS[:, :1])


def test_column_transformer_keeps_the_prior_of_its_parts():
    columns = make_column_transformer(
        (PolynomialFeatures(1), [0]), (InertiaForce("pendulum"), [0, 1, 2]), ("drop", [1]), ("passthrough", [2])
    )
    mean, scale = resolve(columns)
    assert_array_equal(mean[:, 2:5], IF_MEAN)
    assert_array_equal(scale[:, 2:5], IF_SCALE)
    assert_array_equal(mean[:, [0, 1, 5]], 0.0)
    assert_allclose(scale[:, [0, 1, 5]], wide(columns.transform(X))[:, [0, 1, 5]])


@pytest.mark.parametrize("prior", [None, np.ones((2, 3))])
def test_prior_that_is_not_two_arrays_raises(prior):
    class Broken(Opinionated):
        def coef_prior(self, n_outputs):
            return prior

    with pytest.raises(ValueError, match=r"must return two arrays"):
        resolve(Broken(None, None))
