"""n_inducing="auto": as many inducing points as the data ask for."""

import re

import numpy as np
import pytest
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EVGPRegressor
from skevgp.solvers import LBFGS, Adam

RNG = np.random.RandomState(0)
X = RNG.uniform(-2.0, 2.0, (150, 2))
# A line and a wave: they ask for other numbers of points.
Y = np.column_stack([X[:, 0], np.sin(4.0 * X[:, 0]) * X[:, 1]]) + 0.05 * RNG.randn(150, 2)


def model(**arguments):
    return EVGPRegressor(**{"n_inducing": "auto", "sharing": "all", "random_state": 0} | arguments)


def test_few_points_if_features_explain_targets():
    m = model(feature_map=PolynomialFeatures(1)).fit(X, Y[:, 0])
    assert len(m.inducing_points_) == 10


@pytest.mark.filterwarnings("ignore:The noise explains the whole residual:sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("most", [1, 10])
def test_max_inducing_is_respected(most):
    m = model(solver=LBFGS(max_inducing=most, tol=1.0), max_iter=50).fit(X, Y[:, 1])
    assert len(m.inducing_points_) == most


def test_progress_shows_number_of_inducing_points(capsys):
    model(verbose=1, max_iter=30, solver=LBFGS(tol=1.0)).fit(X, Y[:, 1])
    assert re.match(r"\d+ points, all rows, iteration ", capsys.readouterr().out.splitlines()[-1])


@pytest.mark.parametrize(
    "wrong",
    [
        {"n_inducing": "many"},
        {"n_inducing": 0},
        {"solver": LBFGS(max_inducing=0)},
        {"solver": LBFGS(max_inducing=None)},
    ],
)
def test_invalid_n_inducing_raises(wrong):
    named = "max_inducing" if "solver" in wrong else next(iter(wrong))
    with pytest.raises((ValueError, TypeError), match=named):
        model(**wrong).fit(X, Y)


@pytest.mark.parametrize("solver", ["adam", Adam()])
def test_adam_is_told_a_number(solver):
    with pytest.raises(ValueError, match=r'n_inducing="auto" needs solver="lbfgs"'):
        model(solver=solver).fit(X, Y)


def test_warm_start_has_no_more_points_than_it_may():
    m = EVGPRegressor(n_inducing="auto", warm_start=True, solver=LBFGS(tol=1.0), noise_cv=None, random_state=0)
    X = np.random.RandomState(0).uniform(-3.0, 3.0, (40, 2))
    y = np.sin(2.0 * X[:, 0]) * np.cos(X[:, 1]) + 0.1 * X[:, 1]
    assert len(m.fit(X, y).inducing_points_) > 15
    assert len(m.set_params(solver=LBFGS(max_inducing=15, tol=1.0)).fit(X, y).inducing_points_) <= 15
    assert len(m.set_params(solver=LBFGS(max_inducing=1000, tol=1.0)).fit(X[:12], y[:12]).inducing_points_) <= 12
