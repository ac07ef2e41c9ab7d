"""Learning while the system runs: thousands of small updates, and what they cost nothing of."""

import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.preprocessing import PolynomialFeatures

from skevgp import CoefPrior, EVGPRegressor

KERNEL = ConstantKernel(1.5, "fixed") * RBF([1.0, 1.3], "fixed") + WhiteKernel(1e-4, "fixed")


def rows(n):
    rng = np.random.RandomState(0)
    X = rng.uniform(-2.0, 2.0, (n, 2))
    return X, np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], X[:, 0] * X[:, 1]]) + 0.01 * rng.randn(n, 2)


def model(points):
    return EVGPRegressor(
        PolynomialFeatures(1), KERNEL, inducing_init=points, coef_prior=CoefPrior(scale=3.0), max_iter=0
    )


@pytest.mark.long
def test_after_ten_thousand_updates_the_model_is_that_of_one_fit():
    X, Y = rows(10_020)
    found = model(X[:12]).fit(X[:20], Y[:20])
    compiled = found.compile()
    for i in range(20, len(X)):
        found.partial_fit(X[i : i + 1], Y[i : i + 1])
    compiled.update(found)
    expected = model(X[:12]).fit(X, Y)
    X_new = rows(30)[0] + 0.1
    mean, std = expected.predict(X_new, return_std=True)
    for predicted in (found.predict(X_new, return_std=True), compiled.predict(X_new, return_std=True)):
        np.testing.assert_allclose(predicted[0], mean, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(predicted[1], std, rtol=1e-6)
    np.testing.assert_allclose(found.coef_, expected.coef_, rtol=1e-6, atol=1e-6)
    assert found.lower_bound_ == pytest.approx(expected.lower_bound_, rel=1e-6)


def test_an_update_makes_no_factor_of_the_points_and_no_bound(monkeypatch):
    X, Y = rows(60)
    found = model(X[:12]).fit(X[:40], Y[:40])
    before = found.lower_bound_
    calls = []
    for name in ("bound", "upper_bound", "whitenings"):
        monkeypatch.setattr(f"skevgp.model.model.SparseModel.{name}", lambda *_, name=name: calls.append(name))
    found.partial_fit(X[40:], Y[40:])
    assert calls == []
    monkeypatch.undo()
    assert found.lower_bound_ != before
    assert found.upper_bound_ >= found.lower_bound_
