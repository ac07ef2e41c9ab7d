import casadi as ca
import numpy as np
import pandas as pd
import polars
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.sparse import csr_array
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.preprocessing import (
    FunctionTransformer,
    Normalizer,
    PolynomialFeatures,
    SplineTransformer,
    StandardScaler,
)

from skevgp.features import AngleEncoder
from skevgp.maps import ADAPTERS, Map, adapts, as_map


def rows(n_rows=200, seed=0):
    """Some outside the range of those that maps are fitted to here."""
    return np.random.default_rng(seed).normal(size=(n_rows, 5)) * [1.0, 0.5, 2.0, 1.0, 3.0] + [0.0, 1.0, 0.0, -2.0, 0.0]


def fitted(transformer):
    return transformer.fit(rows(40, seed=1))


def differences(function, X, step=1e-6):
    """Without those rows that have a kink so near that the differences see it."""
    both = [(function(X + shift) - function(X - shift)) / (2.0 * step) for shift in step * np.eye(X.shape[1])]
    return np.stack(both, axis=-1)


# --- what has no adapter ---------------------------------------------------------------------------------------------


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
    direct, expected = as_map(transformer), differences(transformer.transform, X)
    assert_allclose(direct.jacobian(X), expected, rtol=0.0, atol=1e-6 * np.abs(expected).max())
    assert_array_equal(direct.value(X), transformer.transform(X))


def test_differences_call_transform_once_for_each_column():
    X, transformer = rows(), fitted(Counted())
    as_map(transformer).jacobian(X)
    assert transformer.calls_ == [(400, 5)] * 5


def test_differences_are_close_to_the_derivative():
    X = rows(500)
    found, exact = as_map(fitted(Counted())).jacobian(X), WithJacobian().jacobian(X)
    assert_allclose(found, exact, rtol=0.0, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e4])
def test_steps_are_measured_by_the_scale_of_each_column(unit):
    X = rows(50) * unit
    exact = WithJacobian(unit).jacobian(X)[:, :5]
    found = as_map(fitted(Counted(unit)), example=rows(300) * unit).jacobian(X)[:, :5]
    assert_allclose(found, exact, rtol=0.0, atol=1e-8 * np.abs(exact).max())


@pytest.mark.parametrize(
    "given", [np.asarray, pd.DataFrame, lambda rows: pd.DataFrame(rows).convert_dtypes(), polars.DataFrame]
)
def test_a_constant_column_is_no_scale_and_one_of_gaps_neither(given):
    example = given(np.tile([0.0, 1e-12, 1.0, np.nan, 1e3], (4, 1)))
    exact = WithJacobian().jacobian(rows(50))
    found = as_map(fitted(Counted()), example=example).jacobian(rows(50))
    assert_allclose(found, exact, rtol=0.0, atol=1e-5 * np.abs(exact).max())


def test_a_jacobian_that_a_map_has_is_asked():
    X, transformer = rows(), fitted(WithJacobian(2.0))
    assert_array_equal(as_map(transformer).jacobian(X), transformer.jacobian(X))
    assert transformer.calls_ == []


@pytest.mark.parametrize("shape", [(200, 10), (200, 10, 4), (100, 10, 5)])
def test_a_jacobian_of_another_shape_is_an_error(shape, monkeypatch):
    monkeypatch.setattr(WithJacobian, "jacobian", lambda self, X: np.zeros(shape))
    with pytest.raises(ValueError, match=r"jacobian of WithJacobian\(\) must return \(n_samples, n_features_out, "):
        as_map(fitted(WithJacobian())).jacobian(rows())


class Doubled:
    """What changes the values of any map, but not its Jacobian."""

    def transform(self, X):
        return 2.0 * super().transform(X)


class DoubledScaler(Doubled, StandardScaler):
    pass


class DoubledEncoder(Doubled, AngleEncoder):
    pass


class FurtherEncoder(AngleEncoder):
    """It changes what its class computes, with the derivatives."""

    def _features(self, X):
        return 3.0 * super()._features(X)

    def _jacobian(self, X):
        return 3.0 * super()._jacobian(X)


class DoubledOwn(Doubled, WithJacobian):
    pass


@pytest.mark.parametrize("kind", [DoubledScaler, DoubledEncoder, FurtherEncoder, DoubledOwn])
def test_a_class_below_a_known_one_is_known_by_what_it_does(kind):
    X, transformer = rows(), fitted(kind())
    direct, expected = as_map(transformer), differences(transformer.transform, X)
    assert_array_equal(direct.value(X), transformer.transform(X))
    assert_allclose(direct.jacobian(X), expected, rtol=0.0, atol=1e-6 * np.abs(expected).max())


def test_a_class_below_a_known_one_that_changes_no_number_stays_known():
    class Renamed(AngleEncoder):
        pass

    X, transformer = rows(), fitted(Renamed("cartpole"))
    assert_array_equal(as_map(transformer).jacobian(X), transformer.jacobian(X))


def test_sparse_values_become_an_array():
    transformer = fitted(FunctionTransformer(csr_array))
    assert_array_equal(as_map(transformer).value(rows()), rows())
    assert_allclose(as_map(transformer).jacobian(rows()), np.broadcast_to(np.eye(5), (200, 5, 5)), atol=1e-8)


@pytest.mark.parametrize("frame", [pd.DataFrame, polars.DataFrame], ids=["pandas", "polars"])
@pytest.mark.parametrize("transformer", [StandardScaler(), Normalizer(), PolynomialFeatures(), SplineTransformer()])
def test_maps_fitted_to_data_frames_take_arrays_without_a_warning(transformer, frame):
    names = [f"column {index}" for index in range(5)]
    expected = as_map(fitted(transformer))
    value, jacobian = expected.value(rows()), expected.jacobian(rows())
    data = frame(dict(zip(names, rows(40, seed=1).T, strict=True)))
    direct = as_map(type(transformer)(**transformer.get_params()).fit(data))
    assert_allclose(direct.value(rows()), value, rtol=1e-12, atol=1e-12)  # sums over a frame are in another order
    assert_allclose(direct.jacobian(rows()), jacobian, rtol=1e-9, atol=1e-9)


def test_a_map_that_takes_columns_by_name_gets_a_frame():
    names = list("abcde")
    transformer = FunctionTransformer(lambda X: X[["b"]] ** 2).fit(pd.DataFrame(rows(), columns=names))
    direct = as_map(transformer)
    assert_array_equal(direct.value(rows()), rows()[:, [1]] ** 2)
    assert_allclose(direct.jacobian(rows())[:, 0, 1], 2.0 * rows()[:, 1], rtol=1e-7, atol=1e-7)


def test_values_are_arrays_also_of_maps_that_make_frames():
    scaler = StandardScaler().set_output(transform="pandas").fit(rows())
    unknown = Normalizer().set_output(transform="pandas").fit(rows())
    assert type(as_map(scaler).value(rows())) is np.ndarray
    assert type(as_map(unknown).value(rows())) is np.ndarray


# --- adapters --------------------------------------------------------------------------------------------------------


def test_an_adapter_says_what_it_knows_and_leaves_the_rest_to_the_transformer(monkeypatch):
    monkeypatch.setattr("skevgp.maps.base.ADAPTERS", dict(ADAPTERS))

    @adapts(Counted)
    class Known(Map):
        def value(self, X):
            return np.hstack([np.sin(X), X**2])

    X, transformer = rows(), fitted(Counted())
    own = as_map(transformer)
    assert_allclose(own.jacobian(X), WithJacobian().jacobian(X), rtol=0.0, atol=1e-8)
    assert type(own) is Known
    assert transformer.calls_ == []
    assert type(as_map(fitted(WithJacobian()))) is Map  # a subclass may do something else


@pytest.mark.parametrize("transformer", [None, "passthrough"])
def test_no_map_and_a_passthrough_leave_the_rows(transformer):
    X, x = rows(), ca.MX.sym("x", 5)
    assert as_map(transformer).value(X) is X
    assert as_map(transformer).casadi(x) is x
    assert_array_equal(as_map(transformer).jacobian(X), np.broadcast_to(np.eye(5), (200, 5, 5)))


@pytest.mark.parametrize("kind", [DoubledScaler, DoubledEncoder, FurtherEncoder, type("Renamed", (AngleEncoder,), {})])
def test_a_subclass_has_no_expression_unless_it_brings_one(kind):
    x, transformer = ca.MX.sym("x", 5), fitted(kind())
    with pytest.raises(TypeError, match=rf"{kind.__name__}\(\) cannot be written in CasADi"):
        as_map(transformer).casadi(x)
    transformer.to_casadi = lambda x: 2.0 * x
    assert as_map(transformer).casadi(x).shape == (5, 1)
