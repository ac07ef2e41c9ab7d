"""Learning while the system runs: thousands of small updates, and what they cost nothing of."""

import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.preprocessing import PolynomialFeatures

from skevgp import CoefPrior, EVGPRegressor
from skevgp.solvers import LBFGS

KERNEL = ConstantKernel(1.5, "fixed") * RBF([1.0, 1.3], "fixed") + WhiteKernel(1e-4, "fixed")


def rows(n):
    rng = np.random.RandomState(0)
    X = rng.uniform(-2.0, 2.0, (n, 2))
    return X, np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], X[:, 0] * X[:, 1]]) + 0.01 * rng.randn(n, 2)


def model(points):
    return EVGPRegressor(
        PolynomialFeatures(1), KERNEL, inducing_init=points, coef_prior=CoefPrior(scale=3.0), max_iter=0
    )


def test_update_makes_no_factor_of_the_points_and_no_bound(monkeypatch):
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


@pytest.mark.parametrize("fading", [1.0, 0.1])
@pytest.mark.parametrize("n_points", [12, 40])
def test_tight_bound_stays_one_when_rows_are_added_or_forgotten(n_points, fading):
    """Also after an exact fit, whose noise may be lower than that of the sparse model."""
    X, Y = rows(60)
    kernel = ConstantKernel(1.5, "fixed") * RBF([1.0, 1.3], "fixed") + WhiteKernel(1e-13, "fixed")
    found = {}
    for bound in ("titsias", "tight"):
        learner = model(X[:n_points]).set_params(solver=LBFGS(bound=bound))
        if n_points == 40:
            learner.set_params(kernel=kernel)
        learner.fit(X[:40], Y[:40]).partial_fit(X[40:], Y[40:], forgetting_factor=fading)
        found[bound] = learner.lower_bound_
    assert found["titsias"] <= found["tight"] + 1e-6 * abs(found["tight"])
    assert found["tight"] <= learner.upper_bound_ + 1e-6 * abs(found["tight"])
