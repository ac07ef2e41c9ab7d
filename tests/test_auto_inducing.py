"""n_inducing="auto": as many inducing points as the data ask for."""

import re

import numpy as np
import pytest
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.solvers import LBFGS, Adam

RNG = np.random.RandomState(0)
X = RNG.uniform(-2.0, 2.0, (150, 2))
# A line and a wave: they ask for other numbers of points.
Y = np.column_stack([X[:, 0], np.sin(4.0 * X[:, 0]) * X[:, 1]]) + 0.05 * RNG.randn(150, 2)
X_NEW = RNG.uniform(-2.0, 2.0, (40, 2))


def model(**arguments):
    return EVGPRegressor(**{"n_inducing": "auto", "sharing": "all", "random_state": 0} | arguments)


def test_it_is_as_good_as_the_exact_model_with_fewer_points_than_rows():
    y = Y[:, 1]
    m, exact = model(noise_cv=None).fit(X, y), EGPRegressor().fit(X, y)
    assert 15 < len(m.inducing_points_) < 100
    assert m.lower_bound_ > exact.log_marginal_likelihood_value_ - 0.02 * len(X)
    np.testing.assert_allclose(m.predict(X_NEW), exact.predict(X_NEW), atol=0.1)
    assert m.n_iter_ == len(m.loss_curve_)
    assert -m.loss_curve_[-1] == pytest.approx(m.lower_bound_, rel=1e-6)


def test_what_the_features_explain_needs_no_points():
    m = model(feature_map=PolynomialFeatures(1)).fit(X, Y[:, 0])
    assert len(m.inducing_points_) == 10


@pytest.mark.filterwarnings("ignore:The noise explains everything:sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("most", [1, 7, 10, 17])
def test_there_are_no_more_points_than_allowed(most):
    m = model(solver=LBFGS(max_inducing=most, tol=1.0), max_iter=50).fit(X, Y[:, 1])
    assert len(m.inducing_points_) == most


def test_outputs_that_share_nothing_have_their_own_numbers():
    m = model(sharing="none", feature_map=PolynomialFeatures(1)).fit(X, Y)
    line, wave = m.inducing_points_
    assert len(line) == 10
    assert len(wave) > 15
    mean, std = m.predict(X_NEW, return_std=True)
    for o in range(2):
        alone = model(feature_map=PolynomialFeatures(1)).fit(X, Y[:, o])
        np.testing.assert_allclose(mean[:, o], alone.predict(X_NEW), atol=0.02)
    assert std.shape == (40, 2)
    assert m.partial_fit(X_NEW, mean).inducing_points_[1].shape == wave.shape


def test_who_looks_on_is_told_how_many_points_there_are(capsys):
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
def test_other_values_are_refused(wrong):
    named = "max_inducing" if "solver" in wrong else next(iter(wrong))
    with pytest.raises((ValueError, TypeError), match=named):
        model(**wrong).fit(X, Y)


@pytest.mark.parametrize("solver", ["adam", Adam()])
def test_adam_is_told_a_number(solver):
    with pytest.raises(ValueError, match=r'n_inducing="auto" needs solver="lbfgs"'):
        model(solver=solver).fit(X, Y)


def test_a_warm_start_has_no_more_points_than_it_may():
    m = EVGPRegressor(n_inducing="auto", warm_start=True, random_state=0)
    X = np.random.RandomState(0).uniform(-3.0, 3.0, (200, 2))
    y = np.sin(2.0 * X[:, 0]) * np.cos(X[:, 1]) + 0.1 * X[:, 1]
    assert len(m.fit(X, y).inducing_points_) > 15
    assert len(m.set_params(solver=LBFGS(max_inducing=15)).fit(X, y).inducing_points_) <= 15
    assert len(m.set_params(solver=LBFGS(max_inducing=1000)).fit(X[:12], y[:12]).inducing_points_) <= 12
