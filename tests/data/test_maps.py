import re

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal
from scipy.sparse import csr_array
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.gaussian_process.kernels import RBF, ConstantKernel
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import FeatureUnion, make_pipeline, make_union
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from skevgp.data import maps as _maps
from skevgp.data.maps import apply_map, fit_map
from skevgp.kernels import FunctionKernel

X = np.random.default_rng(0).normal(size=(10, 3))
Y = np.zeros(10)


class Recorder(TransformerMixin, BaseEstimator):
    """The identity, which keeps what it was given."""

    def fit(self, X, y=None):
        self.fitted_with_ = X, y
        self.seen_ = []
        return self

    def transform(self, X):
        self.seen_.append(X)
        return X


def identity():
    return Recorder().fit(X)


def returning(function):
    return FunctionTransformer(function).fit(X)


@pytest.fixture
def blocks_of_four(monkeypatch):
    monkeypatch.setattr(_maps, "MAP_ROWS", 4)


@pytest.mark.parametrize("name", ["feature_map", "kernel_map"])
@pytest.mark.parametrize("no_map", ["physics", 3, LinearRegression(), StandardScaler, np.sin])
def test_invalid_transformer_raises(name, no_map):
    with pytest.raises(TypeError, match=f"{name} must be None or a transformer instance with fit and transform; got"):
        fit_map(no_map, X, Y, name)


@pytest.mark.parametrize("name", ["feature_map", "kernel_map"])
@pytest.mark.parametrize("kernel", [RBF(2.0), ConstantKernel() * RBF(), FunctionKernel(lambda X, Z: X @ Z.T)], ids=str)
def test_kernel_in_place_of_a_map_is_sent_where_it_belongs(name, kernel):
    with pytest.raises(TypeError, match=f"^{re.escape(f'{name}={kernel!r} is a kernel. Pass it as kernel=.')}$"):
        fit_map(kernel, X, Y, name)


def test_sparse_result_becomes_dense():
    values = apply_map(returning(csr_array), X, "feature_map")
    assert isinstance(values, np.ndarray)
    assert_array_equal(values, X)


@pytest.mark.usefixtures("blocks_of_four")
def test_map_sees_blocks_of_rows():
    recorder = identity()
    assert_array_equal(apply_map(recorder, X, "feature_map"), X)
    assert [len(block) for block in recorder.seen_] == [4, 4, 2]


@pytest.mark.parametrize("function", [lambda X: X[:-1], lambda X: np.vstack([X, X]), lambda X: X[:1]])
def test_another_number_of_rows_raises(function):
    with pytest.raises(ValueError, match=r"feature_map=.* must return one row per row of X; for 10 rows it returned"):
        apply_map(returning(function), X, "feature_map")


@pytest.mark.parametrize("function", [lambda X: X[:, 0], lambda X: X[:, :, np.newaxis, np.newaxis], lambda X: 1.0])
def test_result_of_other_dimensions_raises(function):
    with pytest.raises(ValueError, match=r"kernel_map=.* must return one row per row of X"):
        apply_map(returning(function), X, "kernel_map")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_result_that_is_not_finite_raises(value):
    with pytest.raises(ValueError, match=r"kernel_map=.* returned NaN or infinity"):
        apply_map(returning(lambda X: np.add(X, [0.0, 0.0, value])), X, "kernel_map")


def test_map_that_changes_its_width_raises(monkeypatch):
    monkeypatch.setattr("skevgp.data.maps.MAP_ROWS", 3)
    widths = iter([2, 1])
    with pytest.raises(ValueError, match="same number of columns for all rows; it returned 2 and 1"):
        apply_map(returning(lambda X: X[:, : next(widths)]), np.ones((6, 3)), "feature_map")


def test_map_that_returns_words_raises():
    with pytest.raises(ValueError, match="What feature_map=.* returns must be real numbers"):
        apply_map(returning(lambda X: np.full(X.shape, "a")), np.ones((2, 2)), "feature_map")


def test_map_that_cannot_be_cloned_raises():
    class Plain:
        def fit(self, X, y=None):
            return self

        def transform(self, X):
            return X

    with pytest.raises(TypeError, match="kernel_map=.* cannot be cloned"):
        fit_map(Plain(), np.ones((2, 2)), np.ones(2), "kernel_map")


def per_output(X):
    """A row for each of two outputs."""
    values = np.asarray(X)
    return np.stack([values[:, :2], 2.0 * values[:, :2]], axis=1)


@pytest.mark.parametrize("rows", [X, pd.DataFrame(X, columns=list("abc")), X[:1]], ids=["array", "frame", "row"])
@pytest.mark.parametrize(
    ("around", "weights"),
    [
        (lambda union: union, None),
        (lambda union: union, {"own": 3.0, "all": None}),
        (lambda union: make_pipeline(FunctionTransformer(), union), None),
        (lambda union: make_union(make_pipeline(union)), None),
    ],
    ids=["union", "weights", "pipeline", "nested"],
)
def test_union_may_have_rows_for_each_output(around, weights, rows):
    one_hot = FunctionTransformer(lambda X: csr_array(np.asarray(X)[:, :1]))
    parts = [("own", FunctionTransformer(per_output)), ("all", StandardScaler()), ("sparse", one_hot), ("no", "drop")]
    fitted = fit_map(around(FeatureUnion(parts, transformer_weights=weights)), rows, Y[: len(rows)], "feature_map")
    own, scaled, first = per_output(rows), StandardScaler().fit_transform(rows), np.asarray(rows)[:, :1]
    own = own * (3.0 if weights else 1.0)
    expected = [np.hstack([own[:, j], scaled, first]) for j in range(2)]
    assert_array_equal(apply_map(fitted, rows, "feature_map"), np.stack(expected, axis=1))


def test_parts_of_a_union_agree_on_the_number_of_outputs():
    union = make_union(FunctionTransformer(per_output), FunctionTransformer(lambda X: per_output(X)[:, [0, 1, 0]]))
    with pytest.raises(ValueError, match=r"different numbers of outputs: \[2, 3\]"):
        apply_map(union.fit(X), X, "feature_map")
