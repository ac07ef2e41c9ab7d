"""What the exact model takes over from scikit-learn's: predictions before a fit, known noise, optimizers, theta."""

import numpy as np
import pytest
from scipy.optimize import differential_evolution
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning, NotFittedError
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel
from sklearn.preprocessing import PolynomialFeatures
from sklearn.utils._param_validation import InvalidParameterError
from sklearn.utils.validation import check_is_fitted

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor, ResidualRegressor, rollout
from skevgp.datasets import make_toy
from skevgp.noise import Gaussian
from skevgp.plotting import CoefficientDisplay

RNG = np.random.RandomState(0)
X = RNG.uniform(-2, 2, (30, 2))
Y = np.column_stack([np.sin(2 * X[:, 0]) + X[:, 1], 3 * np.cos(X[:, 1]) * X[:, 0]]) + 0.1 * RNG.randn(30, 2)
X_NEW = RNG.uniform(-3, 3, (12, 2))
TREND = PolynomialFeatures(1)
KERNEL = ConstantKernel(2.0) * RBF([1.0, 2.0]) + Matern(1.5)
BARE = RBF([1.0, 2.0])


# --- before a fit -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", [None, KERNEL, BARE, BARE + WhiteKernel(0.3), 2.0 * Matern(nu=0.5)], ids=str)
@pytest.mark.parametrize("n_targets", [None, 3])
def test_before_a_fit_it_predicts_what_scikit_learns_model_does(kernel, n_targets):
    ours, theirs = (
        EGPRegressor(kernel=kernel, n_targets=n_targets),
        GaussianProcessRegressor(kernel, n_targets=n_targets),
    )
    for asked in ("return_std", "return_cov"):
        for actual, expected in zip(*(model.predict(X_NEW, **{asked: True}) for model in (ours, theirs)), strict=True):
            assert actual.shape == expected.shape
            np.testing.assert_allclose(actual, expected, atol=1e-12)
    samples = ours.sample_y(X_NEW, 5, random_state=1)
    assert samples.shape == theirs.sample_y(X_NEW, 5, random_state=1).shape
    assert vars(ours) == vars(clone(ours))


def test_posterior_of_a_kernel_as_given_is_its_prior_given_the_data():
    model = EGPRegressor(kernel=KERNEL, alpha=0.01, optimizer=None)
    joint = model.predict(np.vstack([X, X_NEW]), return_cov=True, include_noise=False)[1]
    K, K_new, K_both = joint[:30, :30] + 0.01 * np.eye(30), joint[30:, 30:], joint[:30, 30:]
    mean, cov = model.fit(X, Y[:, 0]).predict(X_NEW, return_cov=True, include_noise=False)
    np.testing.assert_allclose(mean, K_both.T @ np.linalg.solve(K, Y[:, 0]), atol=1e-10)
    np.testing.assert_allclose(cov, K_new - K_both.T @ np.linalg.solve(K, K_both), atol=1e-10)


def test_unfitted_methods_raise():
    model = EGPRegressor(TREND)
    assert not model.__sklearn_is_fitted__()
    check_is_fitted(model)  # as of scikit-learn's: it needs none to predict
    for call in (
        model.compile,
        model.sample_functions,
        model.log_marginal_likelihood,
        lambda: model.novelty(X),
        lambda: model.value_and_jacobian(X),
        lambda: model.to_casadi(),
        lambda: rollout(model, X[0], X),
        lambda: CoefficientDisplay.from_estimator(model),
        lambda: EGPRegressor(TREND, coef_prior=CoefPrior(scale=np.inf)).predict(X),
        lambda: EVGPRegressor().predict(X),
        lambda: ResidualRegressor(model).predict(X),
    ):
        with pytest.raises(NotFittedError, match="not fitted"):
            call()


def test_prior_refuses_what_a_fit_would():
    with pytest.raises(ValueError, match="NaN"):
        EGPRegressor().predict([[np.nan]])
    with pytest.raises(ValueError, match="length_scale|columns"):
        EGPRegressor(kernel=BARE).predict(X[:, :1])
    with pytest.raises(ValueError, match=r"number of targets seen in `y`.*Got 2 != 1"):
        EGPRegressor(n_targets=1).fit(X, Y)


# --- known noise --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("y", [Y[:, 0], Y], ids=["one output", "two"])
@pytest.mark.parametrize("alpha", [1e-10, 0.01, 1.0])
def test_with_alpha_and_no_optimizer_it_is_scikit_learns_model(y, alpha):
    ours = EGPRegressor(kernel=KERNEL, alpha=alpha, optimizer=None).fit(X, y)
    theirs = GaussianProcessRegressor(KERNEL, alpha=alpha, optimizer=None).fit(X, y)
    np.testing.assert_allclose(ours.noise_variance_, alpha, rtol=1e-12)
    (mean, std), (expected, expected_std) = (model.predict(X_NEW, return_std=True) for model in (ours, theirs))
    np.testing.assert_allclose(mean, expected, atol=1e-6)
    # Theirs is of the function, ours of what will be measured.
    np.testing.assert_allclose(std**2, expected_std**2 + alpha, atol=1e-8)
    np.testing.assert_allclose(ours.predict(X_NEW, True, include_noise=False)[1], expected_std, atol=1e-6)
    assert ours.log_marginal_likelihood_value_ == pytest.approx(theirs.log_marginal_likelihood_value_, abs=1e-4)


@pytest.mark.parametrize("arguments", [{"noise": Gaussian(variance=0.1)}, {"kernel": RBF() + WhiteKernel()}], ids=str)
def test_noise_is_known_or_learned(arguments):
    with pytest.raises(ValueError, match=r"alpha=0\.1 fixes the noise"):
        EGPRegressor(alpha=0.1, **arguments).fit(X, Y)


@pytest.mark.parametrize("alpha", [0.0, -1.0, np.full(30, 0.1)], ids=str)
def test_alpha_is_a_number_above_0(alpha):
    with pytest.raises(ValueError, match="'alpha' parameter"):
        EGPRegressor(alpha=alpha).fit(X, Y)


# --- optimizers ---------------------------------------------------------------------------------------------------


def test_optimizer_of_user_finds_what_lbfgs_does():
    seen = []

    def global_search(objective, theta, bounds):
        seen.append((theta, bounds))
        near = np.clip(bounds, theta[:, np.newaxis] - 3.0, theta[:, np.newaxis] + 3.0)
        found = differential_evolution(
            lambda at: objective(at, eval_gradient=False), near, seed=0, popsize=6, maxiter=10
        )
        return found.x, found.fun

    kernel = ConstantKernel(2.0, (0.1, 50.0)) * RBF(1.0, (0.1, 10.0)) + WhiteKernel(0.02, (1e-3, 1.0))
    rng = np.random.RandomState(1)
    rows = rng.uniform(-2, 2, (40, 2))  # with fewer, the default has a prior of kernel and noise
    y = np.sin(2 * rows[:, 0]) + rows[:, 1] + 0.1 * rng.randn(40)
    model, default = (
        EGPRegressor(kernel=kernel, optimizer=one).fit(rows, y) for one in (global_search, "fmin_l_bfgs_b")
    )
    assert model.log_marginal_likelihood_value_ == pytest.approx(default.log_marginal_likelihood_value_, abs=1e-3)
    np.testing.assert_allclose(model.kernel_.theta, default.kernel_.theta, atol=0.05)
    theta, bounds = seen[0]
    # Of the shape, the signal and the noise, in the units of y.
    np.testing.assert_allclose(np.exp(theta), [1.0, 2.0, 0.02], rtol=1e-10)
    np.testing.assert_allclose(np.exp(bounds), [[0.1, 10.0], [0.1, 50.0], [1e-3, 1.0]], rtol=1e-10)
    assert model.n_iter_ == len(model.loss_curve_) > 100


@pytest.mark.parametrize("feature_map", [None, TREND], ids=str)
def test_optimizer_objective_is_negative_likelihood(feature_map):
    told = []

    def look(objective, theta, bounds):
        at = theta + 0.1
        value, gradient = objective(at)
        steps = 1e-5 * np.eye(len(at))
        numerical = [(objective(at + s, False) - objective(at - s, False)) / 2e-5 for s in steps]
        told.append((value, gradient, np.array(numerical)))
        return at, value

    model = EGPRegressor(feature_map, kernel=KERNEL, optimizer=look).fit(X, 100.0 * Y)
    _, gradient, numerical = told[-1]
    # Three of the shape, two signals, two noises.
    assert gradient.shape == (4 + 2 + 2,)
    np.testing.assert_allclose(gradient, numerical, rtol=1e-4, atol=1e-3)
    assert max(-value for value, *_ in told) == pytest.approx(model.log_marginal_likelihood_value_, rel=1e-12)


def test_optimizer_that_returns_nonsense_raises():
    for answer in (np.zeros(1), np.full(4, np.nan)):
        with pytest.raises(ValueError, match="optimizer must return 4 finite numbers"):
            EGPRegressor(optimizer=lambda objective, theta, bounds, answer=answer: (answer, 0.0)).fit(X, Y[:, 0])


def test_optimizer_that_asks_for_nonsense_is_told_so():
    def asks(objective, theta, bounds):
        return objective(np.stack([theta, theta]))

    with pytest.raises(ValueError, match=r"theta must be 4 numbers; got an array of shape \(2, 4\)"):
        EGPRegressor(optimizer=asks).fit(X, Y[:, 0])


def test_ctrl_c_keeps_the_best_that_an_optimizer_of_user_has_seen():
    def interrupted(objective, theta, bounds):
        for shift in (0.0, 0.2, 5.0):
            objective(theta + shift)
        raise KeyboardInterrupt

    with pytest.warns(ConvergenceWarning, match="interrupted"):
        model = EGPRegressor(optimizer=interrupted).fit(X, Y[:, 0])
    assert -model.log_marginal_likelihood_value_ == pytest.approx(model.loss_curve_.min())


# --- theta of the kernel as given, few rows -----------------------------------------------------------------------


@pytest.mark.parametrize("kernel", [RBF(1.5), KERNEL, 2.0 * BARE + WhiteKernel(0.3)], ids=str)
def test_theta_of_the_kernel_as_given(kernel):
    model = EGPRegressor(kernel=kernel, max_iter=0).fit(X, Y[:, 0])
    theta = kernel.theta + 0.1
    assert len(theta) != len(model.kernel_.theta)
    alpha = 0.0 if "WhiteKernel" in str(kernel) else model.noise_variance_
    theirs = GaussianProcessRegressor(kernel, alpha=alpha, optimizer=None).fit(X, Y[:, 0])
    (value, gradient), (expected, slope) = (m.log_marginal_likelihood(theta, True) for m in (model, theirs))
    assert value == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(gradient, slope, rtol=1e-6, atol=1e-7)
    with pytest.raises(ValueError, match="theta must be of shape"):
        model.log_marginal_likelihood(theta, clone_kernel=False)


@pytest.mark.parametrize(
    ("parameters", "named"),
    [
        ({"alpha": -1.0}, "alpha"),
        ({"alpha": 0.0}, "alpha"),
        ({"optimizer": 5}, "optimizer"),
        ({"n_targets": -1}, "n_targets"),
        ({"n_targets": 1.5}, "n_targets"),
        ({"max_iter": -1}, "max_iter"),
        ({"tol": "x"}, "tol"),
    ],
    ids=str,
)
def test_parameters_are_checked_before_a_fit_too(parameters, named):
    with pytest.raises(InvalidParameterError, match=f"'{named}' parameter"):
        EGPRegressor(**parameters).predict([[0.0, 1.0]], return_std=True)


@pytest.mark.parametrize("rubbish", [None, (1.0, 2.0, 3.0), ("a", "b"), np.zeros(7)], ids=str)
def test_invalid_optimizer_result_raises(rubbish):
    X, y = make_toy(20, random_state=0, return_X_y=True)
    with pytest.raises(ValueError, match="optimizer must return 3 finite numbers and their value; got"):
        EGPRegressor(optimizer=lambda objective, theta, bounds: rubbish).fit(X, y)
