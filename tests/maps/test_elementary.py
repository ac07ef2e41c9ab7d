import pickle

import numpy as np
import pandas as pd
import polars
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.sparse import csr_array
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.decomposition import PCA
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

from skevgp.features import AngleEncoder, InertiaForce, InertiaForceGravity, LinkGravity, NominalDynamics
from skevgp.maps.elementary import DirectMap, Foreign, elementary

SCALERS = [
    StandardScaler(),
    StandardScaler(with_mean=False),
    StandardScaler(with_std=False),
    StandardScaler(with_mean=False, with_std=False),
    MinMaxScaler(feature_range=(-2.0, 1.0)),
    MinMaxScaler(clip=True),
    MaxAbsScaler(),
    RobustScaler(),
    RobustScaler(with_centering=False, unit_variance=True),
    RobustScaler(with_scaling=False),
]
POLYNOMIALS = [
    PolynomialFeatures(2),
    PolynomialFeatures(1, include_bias=False),
    PolynomialFeatures(0),
    PolynomialFeatures(4, order="F"),
    PolynomialFeatures(3, interaction_only=True),
    PolynomialFeatures((2, 3), include_bias=False),
    PolynomialFeatures((3, 3), interaction_only=True),
    PolynomialFeatures((0, 2)),
]
SPLINES = [
    SplineTransformer(4, degree=degree, extrapolation=extrapolation, include_bias=bias)
    for degree, extrapolation, bias in [
        (3, "constant", True),
        (3, "linear", False),
        (2, "linear", True),
        (1, "constant", True),
        (2, "continue", True),
        (3, "periodic", False),
    ]
]
PROJECTIONS = [PCA(), PCA(2), PCA(2, whiten=True, random_state=0)]
OWN = [
    InertiaForce("cartpole"),
    InertiaForceGravity("acrobot"),
    InertiaForceGravity(),
    LinkGravity("acrobot"),
    AngleEncoder("cartpole"),
    NominalDynamics("cartpole", terms=["acceleration", "bias"]),
]
KNOWN = [*SCALERS, *POLYNOMIALS, *SPLINES, *PROJECTIONS, *OWN]
each_known = pytest.mark.parametrize("transformer", KNOWN, ids=str)


def rows(n_rows=200, seed=0):
    """Some outside the range of those that maps are fitted to here."""
    return np.random.default_rng(seed).normal(size=(n_rows, 5)) * [1.0, 0.5, 2.0, 1.0, 3.0] + [0.0, 1.0, 0.0, -2.0, 0.0]


def fitted(transformer):
    return transformer.fit(rows(40, seed=1))


def differences(function, X, step=1e-6):
    """Without those rows that have a kink so near that the differences see it."""
    both = [(function(X + shift) - function(X - shift)) / (2.0 * step) for shift in step * np.eye(X.shape[1])]
    return np.stack(both, axis=-1)


@each_known
def test_values_are_those_of_transform(transformer):
    X, transformer = rows(), fitted(transformer)
    value, expected = elementary(transformer).value(X), transformer.transform(X)
    if isinstance(transformer, PCA):
        assert_allclose(value, expected, rtol=1e-12, atol=1e-13)
    else:
        assert_array_equal(value, expected)
    assert_array_equal(elementary(transformer).value(X[:1]), transformer.transform(X[:1]))


@each_known
def test_jacobians_are_those_of_transform(transformer):
    X, transformer = rows(1000), fitted(transformer)
    jacobian, expected = elementary(transformer).jacobian(X), differences(transformer.transform, X)
    assert jacobian.shape == expected.shape
    size = max(np.abs(expected).max(initial=0.0), 1e-3)
    assert_allclose(jacobian, expected, rtol=0.0, atol=1e-6 * size)


@each_known
def test_the_chain_rule_is_the_product(transformer):
    X, inner = rows(7), np.random.default_rng(2).normal(size=(7, 5, 3))
    direct = elementary(fitted(transformer))
    assert_allclose(direct.chain(X, inner), direct.jacobian(X) @ inner, rtol=1e-12, atol=1e-12)


@each_known
def test_nothing_known_is_differentiated_numerically_or_validated(transformer, monkeypatch):
    X, transformer = rows(), fitted(transformer)
    expected = transformer.transform(X)

    def never(*arguments):
        raise AssertionError("not to be called")

    monkeypatch.setattr(Foreign, "_differences", never)
    direct = elementary(transformer)
    if not isinstance(transformer, SplineTransformer):  # whose values have no short way
        monkeypatch.setattr(type(transformer), "transform", never)
    assert direct.jacobian(X).shape == (*expected.shape, 5)
    assert direct.value(X).shape == expected.shape


@each_known
def test_it_can_be_pickled_and_changes_no_row(transformer):
    X = rows(9)
    direct = elementary(fitted(transformer))
    before = direct.value(X), direct.jacobian(X)
    assert_array_equal(X, rows(9))
    again = pickle.loads(pickle.dumps(direct))
    assert_array_equal(again.value(X), before[0])
    assert_array_equal(again.jacobian(X), before[1])


@pytest.mark.parametrize("transformer", [*SCALERS, *PROJECTIONS], ids=str)
def test_a_linear_map_says_so(transformer):
    X, direct = rows(), elementary(fitted(transformer))
    jacobian = direct.jacobian(X)
    assert direct.linear == (np.ptp(jacobian, axis=0).max() == 0.0)


@pytest.mark.parametrize("transformer", [PolynomialFeatures(2), AngleEncoder("cartpole")], ids=str)
def test_a_map_that_is_not_linear_does_not_say_so(transformer):
    assert not elementary(fitted(transformer)).linear


def test_beyond_the_range_of_a_clipped_scaler_nothing_moves():
    scaler = MinMaxScaler(clip=True).fit([[0.0], [2.0]])
    assert_array_equal(elementary(scaler).jacobian(np.array([[-1.0], [1.0], [3.0]])).ravel(), [0.0, 0.5, 0.0])


def test_a_constant_column_is_scaled_by_1():
    scaler = StandardScaler().fit([[3.0, 1.0], [3.0, 2.0]])
    assert_array_equal(elementary(scaler).jacobian(np.zeros((1, 2))), [np.diag([1.0, 2.0])])


# --- maps that are not known -------------------------------------------------------------------------------------


class Counted(TransformerMixin, BaseEstimator):
    """Sines and squares of the columns, of a size of their own."""

    def __init__(self, unit=1.0):
        self.unit = unit

    def fit(self, X, y=None):
        self.calls_ = []
        return self

    def transform(self, X):
        self.calls_.append(X.shape)
        return np.hstack([np.sin(X / self.unit), X**2])


class PerOutput(Counted):
    """A row for each of two outputs."""

    def transform(self, X):
        return np.stack([super().transform(X), 2.0 * np.cos(super().transform(X))], axis=1)


class WithJacobian(Counted):
    def jacobian(self, X):
        d = X.shape[1]
        return np.hstack([np.cos(X / self.unit)[:, :, None] * np.eye(d) / self.unit, 2.0 * X[:, :, None] * np.eye(d)])


BROKEN_LINES = SplineTransformer(4, degree=1, extrapolation="linear")
OTHERS = [Counted(), PerOutput(), Normalizer(), FunctionTransformer(np.tanh), BROKEN_LINES]


@pytest.mark.parametrize("transformer", OTHERS, ids=lambda transformer: type(transformer).__name__)
def test_other_maps_are_differentiated_numerically(transformer):
    X, transformer = rows(1000), fitted(transformer)
    direct, expected = elementary(transformer), differences(transformer.transform, X)
    assert_allclose(direct.jacobian(X), expected, rtol=0.0, atol=1e-6 * np.abs(expected).max())
    assert_array_equal(direct.value(X), transformer.transform(X))


def test_differences_call_transform_once_for_each_column():
    X, transformer = rows(), fitted(Counted())
    elementary(transformer).jacobian(X)
    assert transformer.calls_ == [(400, 5)] * 5


def test_differences_are_close_to_the_derivative():
    X = rows(500)
    found, exact = elementary(fitted(Counted())).jacobian(X), WithJacobian().jacobian(X)
    assert_allclose(found, exact, rtol=0.0, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e4])
def test_steps_are_measured_by_the_scale_of_each_column(unit):
    X = rows(50) * unit
    exact = WithJacobian(unit).jacobian(X)[:, :5]
    found = elementary(fitted(Counted(unit)), example=rows(300) * unit).jacobian(X)[:, :5]
    assert_allclose(found, exact, rtol=0.0, atol=1e-8 * np.abs(exact).max())


@pytest.mark.parametrize(
    "given", [np.asarray, pd.DataFrame, lambda rows: pd.DataFrame(rows).convert_dtypes(), polars.DataFrame]
)
def test_a_constant_column_is_no_scale_and_one_of_gaps_neither(given):
    example = given(np.tile([0.0, 1e-12, 1.0, np.nan, 1e3], (4, 1)))
    exact = WithJacobian().jacobian(rows(50))
    found = elementary(fitted(Counted()), example=example).jacobian(rows(50))
    assert_allclose(found, exact, rtol=0.0, atol=1e-5 * np.abs(exact).max())


def test_a_jacobian_that_a_map_has_is_asked():
    X, transformer = rows(), fitted(WithJacobian(2.0))
    assert_array_equal(elementary(transformer).jacobian(X), transformer.jacobian(X))
    assert transformer.calls_ == []


@pytest.mark.parametrize("shape", [(200, 10), (200, 10, 4), (100, 10, 5)])
def test_a_jacobian_of_another_shape_is_an_error(shape, monkeypatch):
    monkeypatch.setattr(WithJacobian, "jacobian", lambda self, X: np.zeros(shape))
    with pytest.raises(ValueError, match=r"jacobian of WithJacobian\(\) must return \(n_samples, n_features_out, "):
        elementary(fitted(WithJacobian())).jacobian(rows())


class Doubled:
    """What changes the values of any map, but not its Jacobian."""

    def transform(self, X):
        return 2.0 * super().transform(X)


class DoubledScaler(Doubled, StandardScaler):
    pass


class DoubledEncoder(Doubled, AngleEncoder):
    pass


class DoubledOwn(Doubled, WithJacobian):
    pass


@pytest.mark.parametrize("kind", [DoubledScaler, DoubledEncoder, DoubledOwn])
def test_a_class_below_a_known_one_is_known_by_what_it_does(kind):
    X, transformer = rows(), fitted(kind())
    direct, expected = elementary(transformer), differences(transformer.transform, X)
    assert_array_equal(direct.value(X), transformer.transform(X))
    assert_allclose(direct.jacobian(X), expected, rtol=0.0, atol=1e-6 * np.abs(expected).max())


def test_a_class_below_a_known_one_that_changes_no_number_stays_known():
    class Renamed(AngleEncoder):
        pass

    X, transformer = rows(), fitted(Renamed("cartpole"))
    assert_array_equal(elementary(transformer).jacobian(X), transformer.jacobian(X))


def test_sparse_values_become_an_array():
    transformer = fitted(FunctionTransformer(csr_array))
    assert_array_equal(elementary(transformer).value(rows()), rows())
    assert_allclose(elementary(transformer).jacobian(rows()), np.broadcast_to(np.eye(5), (200, 5, 5)), atol=1e-8)


@pytest.mark.parametrize("frame", [pd.DataFrame, polars.DataFrame], ids=["pandas", "polars"])
@pytest.mark.parametrize("transformer", [StandardScaler(), Normalizer(), PolynomialFeatures(), SplineTransformer()])
def test_maps_fitted_to_data_frames_take_arrays_without_a_warning(transformer, frame):
    names = [f"column {index}" for index in range(5)]
    expected = elementary(fitted(transformer))
    value, jacobian = expected.value(rows()), expected.jacobian(rows())
    data = frame(dict(zip(names, rows(40, seed=1).T, strict=True)))
    direct = elementary(type(transformer)(**transformer.get_params()).fit(data))
    assert_allclose(direct.value(rows()), value, rtol=1e-12, atol=1e-12)  # sums over a frame are in another order
    assert_allclose(direct.jacobian(rows()), jacobian, rtol=1e-9, atol=1e-9)


def test_a_map_that_takes_columns_by_name_gets_a_frame():
    names = list("abcde")
    transformer = FunctionTransformer(lambda X: X[["b"]] ** 2).fit(pd.DataFrame(rows(), columns=names))
    direct = elementary(transformer)
    assert_array_equal(direct.value(rows()), rows()[:, [1]] ** 2)
    assert_allclose(direct.jacobian(rows())[:, 0, 1], 2.0 * rows()[:, 1], rtol=1e-7, atol=1e-7)


def test_values_are_arrays_also_of_maps_that_make_frames():
    scaler = StandardScaler().set_output(transform="pandas").fit(rows())
    unknown = Normalizer().set_output(transform="pandas").fit(rows())
    assert type(elementary(scaler).value(rows())) is np.ndarray
    assert type(elementary(unknown).value(rows())) is np.ndarray


def test_a_direct_map_says_what_it_must_have():
    with pytest.raises(NotImplementedError):
        DirectMap().value(rows())
    with pytest.raises(NotImplementedError):
        DirectMap().jacobian(rows())
