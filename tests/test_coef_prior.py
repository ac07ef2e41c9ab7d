import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.compose import make_column_transformer
from sklearn.pipeline import FeatureUnion, make_pipeline, make_union
from sklearn.preprocessing import FunctionTransformer, OneHotEncoder, PolynomialFeatures, StandardScaler

from skevgp import EVGPRegressor
from skevgp.features import InertiaForce, InertiaForceGravity
from skevgp.fitting.prior import CoefPrior, InData, resolved, wide_scale

RNG = np.random.default_rng(0)
X = RNG.normal(size=(20, 3)) * [1.0, 10.0, 0.1]
TARGETS = RNG.normal(size=(20, 2)) * [1.0, 5.0] + 3.0
IF_MEAN, _ = InertiaForce("pendulum").coef_prior(2)


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


class Labelled(Opinionated):
    """With labels of groups too."""

    def __init__(self, mean, scale, labels):
        super().__init__(mean, scale)
        self.labels = labels

    def coef_groups(self, n_outputs):
        return self.labels


def resolve(feature_map, mean="auto", scale="auto", targets=TARGETS, rows=X, **prior):
    fitted = feature_map.fit(rows)
    data = in_data(fitted.transform(rows), targets)
    return resolved(CoefPrior(mean, scale, **prior), fitted, rows, data, targets.shape[1])


def in_data(features, targets=TARGETS):
    def left_over(mean):
        return rms(targets - features @ mean.T)

    shape = targets.shape[1], features.shape[1]
    return InData(shape, lambda learned: wide(features, targets, moderate=learned), rms(features), left_over)


def rms(values):
    return np.sqrt(np.mean(values**2, axis=0))


def wide(features, targets=TARGETS, **options):
    return wide_scale(np.linalg.qr(features).R[np.newaxis], len(features), np.abs(targets).max(axis=0), **options)


def scale_of(feature_map, features, left_over):
    """The standard deviations that a map gives weights: its own, and those in units of the data."""
    _, own = feature_map.coef_prior(2)
    return np.where(np.isnan(own), feature_map.coef_scale(left_over, rms(features)), own)


# What the prior mean of `InertiaForce` leaves of the targets, and its standard deviations.
IF_LEFT_OVER = rms(TARGETS - X @ IF_MEAN.T)
IF_SCALE = scale_of(InertiaForce("pendulum"), X, IF_LEFT_OVER)


@pytest.mark.parametrize("feature_map", [InertiaForce("pendulum"), InertiaForceGravity("pendulum", gravity_gain=20.0)])
def test_auto_asks_the_map(feature_map):
    found = resolve(feature_map)
    mean, _ = feature_map.coef_prior(2)
    assert_array_equal(found.mean, mean)
    H = feature_map.transform(X)
    assert_allclose(found.scale, scale_of(feature_map, H, rms(TARGETS - H @ mean.T)))
    assert_array_equal(found.groups, feature_map.coef_groups(2))
    assert found.root is None


def test_map_without_an_opinion_gets_a_wide_prior():
    polynomials = PolynomialFeatures(2)
    mean, scale, *_ = resolve(polynomials)
    assert_array_equal(mean, np.zeros((2, 10)))
    # 1000 times |y| over the part of each feature that the others do not represent.
    H = polynomials.transform(X)
    alone = [np.linalg.lstsq(np.delete(H, j, axis=1), H[:, j], rcond=None)[1][0] for j in range(10)]
    assert_allclose(scale, 1e3 * np.abs(TARGETS).max(axis=0)[:, np.newaxis] * np.sqrt(20.0 / np.array(alone)))


def test_wide_scale_is_that_of_a_feature_alone_for_copies_and_zeros():
    H = np.array([[1.0, 1.0, 0.0]] * 4 + [[-2.0, -2.0, 0.0]] * 4)
    assert_allclose(wide(H, np.full((8, 1), 3.0)), [3e3 * np.array([1.0, 1.0, np.sqrt(2.5)]) / np.sqrt(2.5)])


def test_scale_for_few_rows_is_ten_times_what_would_explain_the_target():
    model = EVGPRegressor(PolynomialFeatures(2), random_state=0).fit(X[:15], TARGETS[:15, 0])
    H = PolynomialFeatures(2).fit_transform(X[:15])
    assert_allclose(model.coef_prior_scale_, 10.0 * rms(TARGETS[:15, 0]) / rms(H))


def test_shared_wide_scale_follows_the_output_that_needs_the_widest():
    R = np.array([[[3.0, 0.0], [0.0, 4.0]], [[3.0, 0.0], [0.0, 0.0]]])
    # The second weight is seen in the first output only, where rows are 1e-3 as large.
    assert_allclose(wide_scale(R, 9.0, np.array([1e-3, 1.0]), shared=True), [[1e3, np.sqrt(2.0) * 0.75]])


def test_target_and_a_feature_of_zeros_get_a_finite_scale():
    nothing = FunctionTransformer(np.zeros_like)
    assert_array_equal(resolve(nothing, targets=np.zeros((20, 1))).scale, [[1e3, 1e3, 1e3]])


def test_union_concatenates():
    polynomials = PolynomialFeatures(2)
    mean, scale, *_ = resolve(make_union(InertiaForce("pendulum"), polynomials))
    assert_array_equal(mean, np.hstack([IF_MEAN, np.zeros((2, 10))]))
    features = np.hstack([X, polynomials.fit_transform(X)])
    assert_allclose(scale, np.hstack([IF_SCALE, wide(features)[:, 3:]]))


def test_parts_of_a_column_transformer_see_their_columns_of_a_frame(frame_of):
    names = ["theta", "dtheta/dt", "u"]
    frame = frame_of({"kind": ["x", "y"] * 10} | dict(zip(names, X.T, strict=True)))
    scaled = make_pipeline(StandardScaler(), InertiaForce("pendulum"))
    parts = make_column_transformer((OneHotEncoder(), ["kind"]), (scaled, names)).fit(frame)
    features = parts.transform(frame)
    mean, scale, *_ = resolved(CoefPrior(), parts, frame, in_data(features), 2)
    assert_array_equal(mean, np.hstack([np.zeros((2, 2)), IF_MEAN]))
    own = features[:, 2:]
    of_inertia = scale_of(InertiaForce("pendulum"), own, rms(TARGETS - own @ IF_MEAN.T))
    assert_allclose(scale, np.hstack([wide(features)[:, :2], of_inertia]))


def test_weights_of_a_union_are_divided_out():
    union = FeatureUnion(
        [("physics", InertiaForce("pendulum")), ("x", "passthrough")], transformer_weights={"physics": 4.0, "x": 0.5}
    )
    mean, scale, *_ = resolve(union)
    assert_allclose(mean, np.hstack([IF_MEAN / 4.0, np.zeros((2, 3))]))
    assert_allclose(scale, np.hstack([IF_SCALE / 4.0, wide(union.transform(X))[:, 3:]]))


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
    mean, scale, *_ = resolve(columns)
    assert_array_equal(mean[:, 2:5], IF_MEAN)
    assert_allclose(scale[:, 2:5], IF_SCALE)
    assert_array_equal(mean[:, [0, 1, 5]], 0.0)
    assert_allclose(scale[:, [0, 1, 5]], wide(columns.transform(X))[:, [0, 1, 5]])


@pytest.mark.parametrize("prior", [None, np.ones((2, 3))])
def test_prior_that_is_not_two_arrays_raises(prior):
    class Broken(Opinionated):
        def coef_prior(self, n_outputs):
            return prior

    with pytest.raises(ValueError, match=r"must return two arrays"):
        resolve(Broken(None, None))


# --- units of the data ---------------------------------------------------------------------------------------------


def test_what_is_left_over_is_that_of_all_parts():
    """A part with another mean changes the scales of `InertiaForce`."""
    shift = np.array([[1.0, 2.0, 3.0], [-1.0, -2.0, -3.0]])
    _, scale, *_ = resolve(make_union(InertiaForce("pendulum"), Opinionated(shift, np.ones((2, 3)))))
    left_over = rms(TARGETS - X @ (IF_MEAN + shift).T)
    assert_allclose(scale, np.hstack([scale_of(InertiaForce("pendulum"), X, left_over), np.ones((2, 3))]))


def test_mean_given_by_hand_decides_what_is_left_over():
    mean = np.array([[0.5, 0.0, 1.0], [0.0, -2.0, 30.0]])
    found = resolve(InertiaForce("pendulum"), mean=mean)
    assert_array_equal(found.mean, mean)
    assert_allclose(found.scale, scale_of(InertiaForce("pendulum"), X, rms(TARGETS - X @ mean.T)))
    assert_array_equal(found.groups, InertiaForce("pendulum").coef_groups(2))


def test_scale_of_a_feature_of_zeros_is_finite():
    """Its weight has no effect."""
    rows = X * [1.0, 1.0, 0.0]
    _, scale, *_ = resolve(InertiaForce("pendulum"), rows=rows)
    assert np.isfinite(scale).all()
    assert (scale[:, 2] > 0.0).all()


# --- groups of weights ---------------------------------------------------------------------------------------------

LABELS = np.array([["a", "a", "b"], ["a", "", "b"]], dtype=object)
GIVEN = {"mean": np.zeros((2, 3)), "scale": np.full((2, 3), 2.0)}


def prefixed(name, labels):
    return [[f"{name}: {label}" if label else "" for label in row] for row in labels]


def test_labels_of_several_parts_begin_with_their_names():
    parts = [("first", Labelled(**GIVEN, labels=LABELS)), ("x", "passthrough"), ("if", InertiaForce("pendulum"))]
    expected = [prefixed("first", LABELS), np.full((2, 3), ""), prefixed("if", InertiaForce("pendulum").coef_groups(2))]
    assert_array_equal(resolve(FeatureUnion(parts)).groups, np.hstack(expected))
    # Those of a single part do not.
    assert_array_equal(resolve(FeatureUnion(parts[:2])).groups, np.hstack([LABELS, np.full((2, 3), "")]))


@pytest.mark.parametrize("groups", [["a", "", "b"], [["a", "", "b"], ["a", "", "b"]]])
@pytest.mark.parametrize("scale", ["auto", 2.0])
def test_groups_given_by_hand_are_those_of_any_scale(groups, scale):
    found = resolve(Labelled(**GIVEN, labels=LABELS), scale=scale, groups=groups)
    assert_array_equal(found.groups, [["a", "", "b"]] * 2)


def test_groups_none_gives_no_labels():
    assert_array_equal(resolve(InertiaForce("pendulum"), groups=None).groups, np.full((2, 3), ""))


@pytest.mark.parametrize("prior", [{"scale": 2.0}, {"cov": np.eye(3)}])
def test_labels_of_the_map_are_not_those_of_a_scale_given_by_hand(prior):
    assert_array_equal(resolve(InertiaForce("pendulum"), **prior).groups, np.full((2, 3), ""))


@pytest.mark.parametrize("groups", [["a", "b"], [["a", "b", "c"]], [["a"], ["b"]], "a", np.full((3, 2), "a")])
def test_groups_of_another_shape_raise(groups):
    with pytest.raises(ValueError, match=r"groups of CoefPrior must be .* of the shape \(3,\) or \(2, 3\); got"):
        resolve(FunctionTransformer(), groups=groups)


def test_weights_that_stay_are_in_no_group():
    scale = [[1.0, 0.0, 2.0], [0.0, 3.0, 4.0]]
    found = resolve(FunctionTransformer(), scale=scale, groups=["a", "a", "b"])
    assert_array_equal(found.groups, [["a", "", "b"], ["", "a", "b"]])
    pinned = resolve(InertiaForce("pendulum", other_ratio=0.0))
    assert_array_equal(pinned.groups == "", pinned.scale == 0.0)
    assert "other" not in pinned.groups
    # An infinite scale stays too.
    data = in_data(X)
    prior = CoefPrior(scale=np.where(np.eye(2, 3), np.inf, 1.0), groups=["a", "b", "c"])
    vague = resolved(prior, FunctionTransformer().fit(X), X, data, 2, allow_vague=True)
    assert_array_equal(vague.groups, [["", "b", "c"], ["a", "", "c"]])


COVARIANCE = np.array([[4.0, 3.0, 0.0], [3.0, 9.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("groups", [["a", "b", "a"], ["a", "", "b"], [["a", "a", "b"], ["a", "b", "b"]]])
def test_groups_that_are_correlated_raise(groups):
    with pytest.raises(
        ValueError, match=r"Weights of different groups must be independent; .*CoefPrior\(groups=None\)"
    ):
        resolve(FunctionTransformer(), cov=COVARIANCE, groups=groups)
    with pytest.raises(ValueError, match="Weights of different groups must be independent"):
        resolve(Opinionated(np.zeros((2, 3)), COVARIANCE), groups=groups)
    # Without groups it is the user's covariance.
    root = resolve(FunctionTransformer(), cov=COVARIANCE).root
    assert_allclose(root @ root.transpose(0, 2, 1), [COVARIANCE] * 2, atol=1e-14)


def test_root_of_a_covariance_has_nothing_between_groups():
    """Then a factor on a group's rows of C is one on its standard deviations alone."""
    groups = np.array(["a", "a", "b"])
    root = resolve(FunctionTransformer(), cov=COVARIANCE, groups=groups).root
    assert_allclose(root @ root.transpose(0, 2, 1), [COVARIANCE] * 2, atol=1e-14)
    assert not root[:, groups[:, np.newaxis] != groups].any()


class LabelledOnly(TransformerMixin, BaseEstimator):
    """The identity, which knows the groups of its weights and nothing else."""

    def fit(self, X, y=None):
        return self

    def transform(self, X):
        return X

    def coef_groups(self, n_outputs):
        return np.array([["a", "b", ""]] * n_outputs, dtype=object)


def test_map_may_know_groups_only():
    found = resolve(LabelledOnly())
    assert found.groups.tolist() == [["a", "b", ""]] * 2
    assert_array_equal(found.mean, np.zeros((2, 3)))


def test_no_label_is_none_and_others_are_words():
    found = resolve(LabelledOnly(), groups=np.array(["a", None, ""], dtype=object))
    assert found.groups.tolist() == [["a", "", ""]] * 2
    with pytest.raises(ValueError, match="groups of CoefPrior must be strings"):
        resolve(LabelledOnly(), groups=[1.0, 2.0, np.nan])
