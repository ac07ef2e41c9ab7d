"""``noise="student-t"``: rows that are wrong, and who notices."""

import numpy as np
import pytest
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EVGPRegressor
from skevgp.solvers import LBFGS, Adam

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")

RNG = np.random.RandomState(0)
N = 300
X = RNG.uniform(-3.0, 3.0, (N, 1))
TRUTH = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 0], np.cos(X[:, 0])])
Y = TRUTH + 0.1 * RNG.randn(N, 2)
BAD = RNG.rand(N) < 0.05
WRONG = Y + 2.0 * BAD[:, np.newaxis] * np.sign(RNG.randn(N, 2))
GRID = np.linspace(-3.0, 3.0, 60)[:, np.newaxis]


def evgp(**parameters):
    return EVGPRegressor(**{"n_inducing": 12, "max_iter": 60, "random_state": 0, "noise": "student-t", **parameters})


def error(model, output=slice(None)):
    truth = np.column_stack([np.sin(2.0 * GRID[:, 0]) + GRID[:, 0], np.cos(GRID[:, 0])])[:, output]
    return np.sqrt(np.mean((model.predict(GRID) - truth) ** 2))


VARIANTS = {
    "plain": {},
    "features": {"feature_map": PolynomialFeatures(1), "normalize_y": True},
    "diagonal": {"sharing": "kernel", "solver": LBFGS(posterior="diagonal")},
    "auto": {"n_inducing": "auto", "solver": LBFGS(max_inducing=15)},
}


def test_without_outliers_it_is_the_fit_with_gaussian_noise():
    robust, gaussian = evgp().fit(X, Y), evgp(noise="gaussian").fit(X, Y)
    np.testing.assert_allclose(robust.weights_, 1.0, atol=0.05)
    np.testing.assert_allclose(robust.predict(GRID), gaussian.predict(GRID), atol=0.02)
    assert robust.lower_bound_ == pytest.approx(gaussian.lower_bound_, abs=2.0)
    assert robust.upper_bound_ == np.inf


@pytest.mark.parametrize("parameters", VARIANTS.values(), ids=VARIANTS)
def test_outliers_do_not_change_fit(parameters):
    robust = evgp(**parameters).fit(X, WRONG)
    clean = evgp(**{**parameters, "noise": "gaussian"})
    clean.fit(X, Y)
    spoiled = evgp(**{**parameters, "noise": "gaussian"}).fit(X, WRONG)
    assert error(robust) < 1.3 * error(clean)
    assert error(spoiled) > 1.5 * error(robust)
    assert robust.weights_.shape == (N, 2)
    assert (robust.weights_[BAD] < 0.1).all()
    assert np.mean(robust.weights_[~BAD] > 0.9) > 0.99
    np.testing.assert_allclose(robust.noise_variance_, clean.noise_variance_, rtol=0.35)
    _, std = robust.predict(GRID, return_std=True)
    np.testing.assert_allclose(std, clean.predict(GRID, return_std=True)[1], rtol=0.35)


def test_weights_are_in_the_users_order_and_none_are_of_rows_that_do_not_count():
    order = RNG.permutation(N)
    model, shuffled = evgp().fit(X, WRONG[:, 0]), evgp().fit(X[order], WRONG[order, 0])
    np.testing.assert_array_equal(shuffled.weights_, model.weights_[order])
    assert model.weights_.shape == (N,)
    counts = np.where(np.arange(N) % 7 == 0, 0.0, 1.0 + np.arange(N) % 2)
    weighted = evgp().fit(X, WRONG[:, 0], counts)
    np.testing.assert_array_equal(np.isnan(weighted.weights_), counts == 0.0)
    again = np.repeat(np.arange(N), counts.astype(int))
    repeated = evgp().fit(X[again], WRONG[again, 0])
    assert weighted.lower_bound_ == pytest.approx(repeated.lower_bound_, rel=1e-9)
    np.testing.assert_allclose(repeated.weights_, weighted.weights_[again])
    np.testing.assert_allclose(weighted.predict(GRID), repeated.predict(GRID), rtol=1e-7, atol=1e-9)


def test_partial_fit_doubts_new_rows():
    first, rest = slice(0, 150), slice(150, None)
    model = evgp().fit(X[first], WRONG[first]).partial_fit(X[rest], WRONG[rest])
    clean = evgp(noise="gaussian").fit(X[first], Y[first]).partial_fit(X[rest], Y[rest])
    assert error(model) < 1.3 * error(clean)
    assert model.weights_.shape == (150, 2)
    assert (model.weights_[BAD[rest]] < 0.1).all()
    assert np.mean(model.weights_[~BAD[rest]] > 0.9) > 0.99


def test_student_t_with_other_solvers_raises():
    with pytest.raises(ValueError, match='noise=.student-t. needs solver="lbfgs".*got solver=.adam'):
        evgp(solver="adam").fit(X, Y)
    with pytest.raises(ValueError, match='noise=.student-t. needs solver="lbfgs"'):
        evgp(solver=Adam()).fit(X, Y)
    with pytest.raises(ValueError, match="noise must be one of .*student-t"):
        evgp(noise="laplace").fit(X, Y)
    model = evgp(max_iter=5).partial_fit(X, Y)
    before = model.predict(GRID)
    with pytest.raises(ValueError, match="partial_fit needs .* forgetting_factor=1; got forgetting_factor=0.9"):
        model.partial_fit(X, Y, forgetting_factor=0.9)
    np.testing.assert_array_equal(model.predict(GRID), before)


def test_dask_arrays_raise():
    da = pytest.importorskip("dask.array")
    with pytest.raises(ValueError, match="rows in memory or in a file.*Array"):
        evgp().fit(da.from_array(X), da.from_array(Y))
