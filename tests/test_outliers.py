"""``noise="student-t"``: rows that are wrong, and who notices."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EVGPRegressor
from skevgp.noise import StudentT
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
    # What outputs share, and what noise_cv finds, would take most of the time.
    options = {"n_inducing": 12, "max_iter": 25, "random_state": 0, "sharing": "all", "noise_cv": None}
    return EVGPRegressor(**{**options, "noise": "student-t", **parameters})


@cache
def gaussian(variant="plain"):
    return evgp(**{**VARIANTS[variant], "noise": "gaussian"}).fit(X, Y)


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
    robust, expected = evgp().fit(X, Y), gaussian()
    np.testing.assert_allclose(robust.weights_, 1.0, atol=0.05)
    np.testing.assert_allclose(robust.predict(GRID), expected.predict(GRID), atol=0.02)
    assert robust.lower_bound_ == pytest.approx(expected.lower_bound_, abs=2.0)
    assert robust.upper_bound_ == np.inf


@pytest.mark.parametrize(
    "variant", [pytest.param(name, marks=[pytest.mark.long] * (name == "auto")) for name in VARIANTS]
)
def test_outliers_do_not_change_fit(variant):
    robust, clean = evgp(**VARIANTS[variant]).fit(X, WRONG), gaussian(variant)
    spoiled = clone(clean).fit(X, WRONG)
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
        evgp(noise="no such noise").fit(X, Y)
    model = evgp(max_iter=5).partial_fit(X, Y)
    before = model.predict(GRID)
    with pytest.raises(ValueError, match="partial_fit needs .* forgetting_factor=1; got forgetting_factor=0.9"):
        model.partial_fit(X, Y, forgetting_factor=0.9)
    np.testing.assert_array_equal(model.predict(GRID), before)


def test_dask_arrays_raise():
    da = pytest.importorskip("dask.array")
    with pytest.raises(ValueError, match="rows in memory or in a file.*Array"):
        evgp().fit(da.from_array(X), da.from_array(Y))


# --- far outliers, on one side or both, of any noise model ------------------------------------------------------------

FIELD_X = np.random.default_rng(1).uniform(-3.0, 3.0, (300, 2))
FIELD = np.sin(FIELD_X[:, 0]) + 0.3 * FIELD_X[:, 1]
FIELD_Y = FIELD + 0.1 * np.random.default_rng(2).standard_normal(300)


def with_outliers(share, sigmas, sides=1):
    """Rows, and which of them are wrong by so many standard deviations of the noise."""
    rng = np.random.default_rng(3)
    bad = np.zeros(300, dtype=bool)
    bad[rng.permutation(300)[: max(int(share * 300), 1)]] = True
    signs = np.where(rng.random(300) < 0.5, -1.0, 1.0) if sides == 2 else 1.0
    return FIELD_Y + 0.1 * sigmas * bad * signs, bad


@cache
def without_outliers(share):
    _, bad = with_outliers(share, 0.0)
    return EVGPRegressor(n_inducing=20, random_state=0).fit(FIELD_X[~bad], FIELD_Y[~bad])


@pytest.mark.parametrize(
    ("share", "sigmas", "sides"),
    [
        pytest.param(0.0, 1e2, 1, marks=pytest.mark.long),
        (0.0, 1e9, 1),
        (0.15, 10.0, 1),
        pytest.param(0.15, 20.0, 1, marks=pytest.mark.long),
        (0.15, 1e4, 2),
        (0.15, 1e9, 1),
    ],
)
def test_noise_and_intervals_are_those_of_clean_rows(share, sigmas, sides):
    y, bad = with_outliers(share, sigmas, sides)
    clean = without_outliers(share)
    model = clone(clean).set_params(noise="student-t").fit(FIELD_X, y)
    assert model.noise_variance_**0.5 == pytest.approx(clean.noise_variance_**0.5, rel=0.1)
    assert (model.weights_[bad] < 0.1).all()
    new = np.random.default_rng(4).uniform(-3.0, 3.0, (2000, 2))
    truth = np.sin(new[:, 0]) + 0.3 * new[:, 1] + 0.1 * np.random.default_rng(5).standard_normal(2000)
    mean, std = model.predict(new, return_std=True)
    assert 0.92 <= np.mean(np.abs(truth - mean) <= 1.96 * std) <= 0.98


@pytest.mark.filterwarnings("default")
def test_more_outliers_than_the_noise_allows_warn():
    y, _ = with_outliers(0.2, 50.0)
    with pytest.warns(ConvergenceWarning, match="20% of the rows are far from the prediction"):
        EVGPRegressor(n_inducing=20, noise="student-t", noise_cv=None, random_state=0).fit(FIELD_X, y)


@dataclass(frozen=True)
class LaplaceScales:
    """Each row has Laplace noise with the variance σ² v: 1/τ is exponential."""

    n_outputs: int
    distances: np.ndarray

    def at(self, distances):
        return LaplaceScales(self.n_outputs, distances)

    @property
    def mean(self):
        return np.sqrt(2.0 / np.maximum(self.distances, 1e-3))

    @property
    def outlier(self):
        return np.zeros(len(self.distances))

    @property
    def log_variance(self):
        evidence = -0.5 * np.log(2.0) - np.sqrt(2.0 * self.distances) + 0.5 * np.log(2.0 * np.pi)
        return -2.0 * (evidence + 0.5 * self.mean * self.distances)


class Laplace(StudentT):
    def row_scales(self, n_outputs, distances):
        return LaplaceScales(n_outputs, distances)


def test_far_outliers_do_not_move_a_noise_model_without_outliers():
    y, bad = with_outliers(0.1, 1e6)
    model = EVGPRegressor(n_inducing=20, noise=Laplace(), noise_cv=None, random_state=0)
    noise = clone(model).fit(FIELD_X[~bad], FIELD_Y[~bad]).noise_variance_
    model.fit(FIELD_X, y)
    assert model.noise_variance_ == pytest.approx(noise, rel=0.2)
    assert np.corrcoef(model.predict(FIELD_X), FIELD)[0, 1] > 0.995


def test_bump_of_the_function_is_no_outlier():
    """Thirty standard deviations high, with 5 % of the rows."""
    rng = np.random.default_rng(0)
    x = np.sort(rng.uniform(-3.0, 3.0, 300))[:, np.newaxis]
    bump = 3.0 * np.exp(-0.5 * ((x[:, 0] - 0.5) / 0.15) ** 2)
    y = np.sin(x[:, 0]) + bump + 0.1 * rng.standard_normal(300)
    model = EVGPRegressor(n_inducing=40, noise="student-t", noise_cv=None, random_state=0).fit(x, y)
    assert (model.weights_ > 0.5).all()
    assert np.abs(model.predict(x) - np.sin(x[:, 0]) - bump).max() < 0.5
