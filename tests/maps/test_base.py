import numpy as np
import pandas as pd
import polars
import pytest
from numpy.testing import assert_allclose, assert_array_equal
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


def test_differences_are_close_to_the_derivative():
    X = rows(500)
    found, exact = as_map(fitted(Counted())).jacobian(X), WithJacobian().jacobian(X)
    assert_allclose(found, exact, rtol=0.0, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize("shape", [(200, 10), (200, 10, 4), (100, 10, 5)])
def test_jacobian_of_another_shape_raises(shape, monkeypatch):
    monkeypatch.setattr(WithJacobian, "jacobian", lambda self, X: np.zeros(shape))
    with pytest.raises(
        ValueError, match=r"jacobian of WithJacobian\(\) must return the shape \(n_samples, n_features_out, "
    ):
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
def test_subclass_with_own_transform_is_unknown(kind):
    X, transformer = rows(), fitted(kind())
    direct, expected = as_map(transformer), differences(transformer.transform, X)
    assert_array_equal(direct.value(X), transformer.transform(X))
    assert_allclose(direct.jacobian(X), expected, rtol=0.0, atol=1e-6 * np.abs(expected).max())


def test_unchanged_subclass_is_known():
    class Renamed(AngleEncoder):
        pass

    X, transformer = rows(), fitted(Renamed("cartpole"))
    assert_array_equal(as_map(transformer).jacobian(X), transformer.jacobian(X))


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


# --- adapters --------------------------------------------------------------------------------------------------------


def test_adapter_falls_back_to_transformer(monkeypatch):
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
