"""Few rows: the prior of kernel and noise, the start by forward selection, and the draws."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import lognorm
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, ExpSineSquared, Matern, WhiteKernel
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.fitting import few_rows, rules
from skevgp.fitting.few_rows import WithPrior, drawn, forward_selection
from skevgp.model.mixture import MixturePosterior
from skevgp.solvers import Adam

from .cases import data_of, model_of

RNG = np.random.RandomState(0)


def waves(n, d, seed=0):
    """Two of d columns matter."""
    rng = np.random.RandomState(seed)
    X = rng.standard_normal((n, d))
    return X, np.sin(2.0 * X[:, 0]) + X[:, 1] + 0.1 * rng.standard_normal(n)


# --- the prior --------------------------------------------------------------------------------------------------------


def few(n=20, d=3, **changes):
    X, y = waves(n, d)
    return model_of(**data_of(y[:, np.newaxis], X), **changes)


def test_prior_is_log_normal_in_units_of_the_columns_and_fades():
    model = few()
    prior, values = model.hyper_prior, model.table.values_at_start()
    assert prior.weight == pytest.approx(np.sqrt(1.0 - 20 / (12 * 5)))
    median = np.exp(few_rows._LENGTH_MEAN) * np.sqrt(3) * model.rows.inputs.scale

    def log_density(values):
        parts = [
            (values["hyperparameters"], few_rows._LENGTH_STD, median),
            (values["signal"], few_rows._SIGNAL_STD, model.table["signal"].start),
            (values["noise"], few_rows._NOISE_STD, few_rows._NOISE_SHARE * model.scatter),
        ]
        # Of the logarithm, whose density is that of the number times the number.
        return sum(np.sum(lognorm.logpdf(x, s, scale=scale) + np.log(x)) for x, s, scale in parts)

    others = {name: value * np.exp(RNG.uniform(-1.0, 1.0, value.shape)) for name, value in values.items()}
    difference = prior.log_density(others) - prior.log_density(values)
    assert difference == pytest.approx(prior.weight * (log_density(others) - log_density(values)))
    assert few(n=59).hyper_prior.weight < 0.15
    assert few(n=60).hyper_prior is None


def test_gradient_with_the_prior_agrees_with_differences():
    model = few()
    objective = model.objective(model.table)
    assert isinstance(objective, WithPrior)
    x = model.table.start() + RNG.uniform(-0.3, 0.3, model.table.size)
    loss, gradient = objective(x)
    plain = objective.objective(x)[0]
    assert loss == pytest.approx(plain - model.log_hyper_prior(model.table.values(x)) / 20)
    for j in range(len(x)):
        step = 1e-5 * (np.arange(len(x)) == j)
        difference = (objective(x + step)[0] - objective(x - step)[0]) / 2e-5
        assert gradient[j] == pytest.approx(difference, rel=1e-4, abs=1e-7)


@pytest.mark.parametrize(
    "changes",
    [
        {"max_iter": 0},
        {"solver": Adam()},
        {"kernel": ConstantKernel() * RBF([1.0, 1.0, 1.0], "fixed")},
    ],
)
def test_there_is_no_prior_where_nothing_is_learned_or_a_solver_takes_none(changes):
    assert few(**changes).hyper_prior is None


def test_lengths_are_those_of_the_kernel_also_beside_a_constant_output():
    """A kernel says which numbers are lengths. A constant output does not switch the prior off."""
    X, y = waves(20, 2)
    kernel = RBF(1.0) * Matern(1.0) + RBF([1.0, 1.0]) + DotProduct(0.7) + ConstantKernel(0.1) * ExpSineSquared(0.6, 1.1)
    prior = model_of(**data_of(y[:, np.newaxis], X), kernel=kernel).hyper_prior
    length = np.exp(few_rows._LENGTH_MEAN) * np.sqrt(2) * X.std(axis=0)
    both = np.sqrt(length.prod())
    expected = [both, both, *length, 0.7, 0.1, 0.6, 1.1]
    np.testing.assert_allclose(np.exp(prior.means["hyperparameters"]), expected)
    np.testing.assert_array_equal(prior.stds["hyperparameters"] == few_rows._LENGTH_STD, [True] * 4 + [False] * 4)
    model = EGPRegressor().fit(X, np.column_stack([y, np.zeros(20)]))
    assert model._fitted.n_draws == few_rows.N_DRAWS
    assert model.predict(X, return_std=True)[1][:, 1].max() < 1e-3


# --- the start --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_forward_selection_finds_the_columns_that_matter(seed):
    X, y = waves(50, 35, seed)
    model = model_of(**data_of(y[:, np.newaxis], X), n_inducing=50)
    table = model.table.changed("inducing_points", fixed=True)
    energies = []
    chosen = forward_selection(model._energy(table), table, model.hyper_prior, model.scatter, energies.append)
    assert len(energies) <= 1 + 8 * 35
    assert set(np.argsort(chosen["hyperparameters"])[:2]) == {0, 1}


# --- draws ------------------------------------------------------------------------------------------------------------


def gaussian(mean, covariance):
    precision = np.linalg.inv(covariance)

    def energy(x):
        slope = precision @ (x - mean)
        return 0.5 * (x - mean) @ slope, slope

    return energy


def draws_of(energy, modes, limits=None):
    limits = (np.full(len(modes[0]), -np.inf), np.full(len(modes[0]), np.inf)) if limits is None else limits
    return np.array(drawn(energy, modes, limits, np.random.RandomState(0), lambda energy: None))


def test_draws_have_the_moments_of_their_density(monkeypatch):
    monkeypatch.setattr(few_rows, "N_DRAWS", 1500)
    mean, covariance = np.array([0.5, -1.0, 30.0]), np.array([[1.0, 0.3, 0.0], [0.3, 0.5, 0.0], [0.0, 0.0, 1e-3]])
    found = draws_of(gaussian(mean, covariance), [mean])
    std = np.sqrt(np.diagonal(covariance))
    np.testing.assert_allclose((found.mean(axis=0) - mean) / std, 0.0, atol=0.15)
    np.testing.assert_allclose(np.cov(found.T) / np.outer(std, std), covariance / np.outer(std, std), atol=0.15)


def test_limits_reflect_the_draws(monkeypatch):
    """Of a uniform density."""
    monkeypatch.setattr(few_rows, "N_DRAWS", 1000)
    limits = (np.array([-1.0, 0.0]), np.array([1.0, 3.0]))
    found = draws_of(lambda x: (0.0, np.zeros(2)), [np.array([0.9, 0.0])], limits)
    assert (found >= limits[0]).all()
    assert (found <= limits[1]).all()
    np.testing.assert_allclose(found.mean(axis=0), [0.0, 1.5], atol=0.15)


def test_modes_have_draws_by_their_evidence(monkeypatch):
    """A narrow and a wide mode of the same height: their evidence is their width, and half of its logarithm counts."""
    monkeypatch.setattr(few_rows, "N_DRAWS", 1000)
    modes = [np.array([-50.0]), np.array([50.0]), np.array([50.01])]

    def energy(x):
        mode, width = (-50.0, 0.25) if x[0] < 0.0 else (50.0, 1.0)
        return 0.5 * ((x[0] - mode) / width) ** 2, (x - mode) / width**2

    found = draws_of(energy, modes)
    assert len(found) == 1000
    assert np.mean(found < 0.0) == pytest.approx(1 / 3, abs=0.01)


def test_rounding_errors_do_not_grow_along_the_chain():
    """On another processor, gradients and the mode differ by rounding. Draws are then the same, bit by bit."""
    energy, mode = gaussian(np.zeros(5), np.diag([1.0, 0.1, 1.5, 0.6, 0.01])), np.zeros(5)

    def disturbed(x):
        value, slope = energy(x)
        return value, slope * (1.0 + 1e-12 * np.random.RandomState(int(1e6 * abs(x[0]))).randn(5))

    np.testing.assert_array_equal(draws_of(energy, [mode]), draws_of(disturbed, [mode + 1e-7]))


# --- fits -------------------------------------------------------------------------------------------------------------


def scores(model, X, y):
    mean, std = model.predict(X, return_std=True)
    return np.mean(np.abs(y - mean) < 1.96 * std), np.sqrt(np.mean((y - mean) ** 2))


@pytest.mark.parametrize("make", [lambda: EVGPRegressor(random_state=0), EGPRegressor])
def test_intervals_of_few_rows_with_many_columns(make, monkeypatch):
    """Without the prior and the average, half of the rows or fewer are inside of the 95 % intervals."""
    X, y = waves(550, 35, seed=3)
    coverage, error = scores(make().fit(X[:50], y[:50]), X[50:], y[50:])
    assert coverage > 0.85
    assert error < 0.4
    monkeypatch.setattr(rules, "RULES", replace(rules.RULES, few_rows=0.0))
    plain, of_plain = scores(make().fit(X[:50], y[:50]), X[50:], y[50:])
    assert plain < 0.75
    assert error < 0.5 * of_plain


@pytest.mark.filterwarnings("ignore:The optimal value found")
def test_draws_stay_within_given_bounds_and_fixed_values_stay():
    X, y = waves(20, 2)
    kernel = ConstantKernel(1.0, (0.5, 2.0)) * RBF([1.0, 1.0], (0.8, 3.0)) + WhiteKernel(0.05, "fixed")
    model = EGPRegressor(PolynomialFeatures(1), kernel).fit(X, y)
    (fitted,) = model._fitted.models
    assert isinstance(fitted.posterior, MixturePosterior)
    assert len(fitted.posterior.draws) == few_rows.N_DRAWS
    unit = model._fitted.units.target_unit[0] ** 2
    for draw in fitted.posterior.draws:
        assert ((draw.values["hyperparameters"] >= 0.8 - 1e-9) & (draw.values["hyperparameters"] <= 3.0 + 1e-9)).all()
        assert 0.5 - 1e-9 <= draw.values["signal"][0] * unit <= 2.0 + 1e-9
        assert draw.values["noise"][0] * unit == pytest.approx(0.05)
    # The kernel is the one at the mode.
    assert model.kernel_.k2.length_scale == pytest.approx(fitted.values["hyperparameters"])


def test_summary_says_that_rows_are_few_and_for_what():
    X, y = waves(12, 15)
    said = str(EVGPRegressor(random_state=0).fit(X, y).summary())
    assert "12 rows are few for 17 numbers of kernel and noise: predictions are averaged over 16 draws" in said
    assert "A kernel with one length scale" in said
    assert "few" not in str(EVGPRegressor(random_state=0, kernel=RBF(1.0)).fit(*waves(40, 15)).summary())
    said = EVGPRegressor(random_state=0, noise="student-t").fit(X, y).summary().advice
    assert "std may be too small" in said
