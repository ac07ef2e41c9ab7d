"""The predictor for control loops says what the estimator says."""

import pickle
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EVGPRegressor

from .cases import QUICK


def same(found, expected):
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert one.shape == other.shape
        assert np.abs(one - other).max() <= 1e-12 * max(np.abs(other).max(), 1.0)


@pytest.mark.parametrize("include_noise", [True, False])
def test_compiled_model_predicts_like_estimator(model, data, include_noise):
    X, options = data[2], {"return_std": True, "include_noise": include_noise}
    compiled = model.compile(include_noise)
    mean, std = model.predict(X, **options)
    found = compiled.predict(X, return_std=True)
    same([found[0]], [mean])
    # Where the variance is what two large numbers leave, rounding counts.
    np.testing.assert_allclose(found[1], std, rtol=1e-9)
    same([compiled.predict(X)], [mean])
    same(compiled.value_and_jacobian(X), model.value_and_jacobian(X))
    for one, other in zip(
        compiled.value_and_jacobian(X, return_std=True), model.value_and_jacobian(X, **options), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("n_inducing", [15, 60])
def test_compiled_model_updates_on_request(data, n_inducing):
    """With points at all rows the fit is exact, and an update makes it a sparse one."""
    X, Y, X_new = data
    model = EVGPRegressor(PolynomialFeatures(1), n_inducing=n_inducing, **QUICK).fit(X[:60], Y[:60])
    compiled, before = model.compile(), model.predict(X_new, return_std=True)
    model.partial_fit(X[60:], Y[60:] + 1.0)
    same(compiled.predict(X_new, return_std=True), before)
    compiled.update(model)
    after = model.predict(X_new, return_std=True)
    same(compiled.predict(X_new, return_std=True), after)
    assert np.abs(after[0] - before[0]).max() > 1e-3


@pytest.fixture
def often():
    """Threads take turns every 10 µs, so that few calls suffice."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(before)


def test_threads_may_share_it_and_it_can_be_pickled(model, data, often):
    rows = np.repeat(data[2], 4, axis=0)
    compiled = pickle.loads(pickle.dumps(model.compile()))
    expected = [compiled.value_and_jacobian(row, return_std=True) for row in data[2]]
    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(lambda row: compiled.value_and_jacobian(row, return_std=True), rows))
    for i, each in enumerate(found):
        for one, other in zip(each, expected[i // 4], strict=True):
            np.testing.assert_array_equal(one, other)
