"""The factors of the prior's standard deviations, one for each output and group of weights."""

from copy import deepcopy
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import brentq
from scipy.stats import multivariate_normal
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor, InverseDynamics
from skevgp.features import RigidBodyRegressor
from skevgp.noise import Gaussian
from skevgp.solvers import Adam

from .test_inverse_dynamics import Arm, with_masses

SCALE = np.array([[0.1, 0.2, 0.3, 0.4, 1.0, 2.0, 3.0, 4.0]] * 2)
GROUPS = np.array([["far"] * 4 + ["near"] * 4, ["near"] * 4 + [""] * 4], dtype=object)
FAR = GROUPS == "far"


def problem(seed=0, n=120):
    """Two outputs with independent features, and true weights of 30 (far) or 1 standard deviations of the prior."""
    rng = np.random.RandomState(seed)
    X, weights = rng.uniform(-2.0, 2.0, (n, 9)), np.where(FAR, 30.0, 1.0) * SCALE * rng.randn(*SCALE.shape)
    y = X[:, 1:] @ weights.T + np.sin(2.0 * X[:, :1]) + 0.01 * rng.randn(n, 2)
    return X, y, weights


def model(kind=EVGPRegressor, scale=SCALE, groups=GROUPS, **parameters):
    """The kernel sees the first column, and the features are the others."""
    if kind is EVGPRegressor:
        parameters = {"n_inducing": 10, "noise_cv": None, "random_state": 0} | parameters
    features, inputs = FunctionTransformer(lambda X: X[:, 1:]), FunctionTransformer(lambda X: X[:, :1])
    return kind(features, kernel_map=inputs, coef_prior=CoefPrior(0.0, scale, groups=groups), **parameters)


@cache
def learned(kind, seed=0):
    """A model that no test may change."""
    return model(kind).fit(*problem(seed)[:2])


def most_probable_factors(weights):
    """Factors t (2, 8) under a log-normal prior for known weights: maxima of -n log t - ½ Σ z² / t² - ½ log² t."""
    factors = np.ones(SCALE.shape)
    for output, labels in enumerate(GROUPS):
        for group in set(labels) - {""}:
            own = labels == group
            z = (weights / SCALE)[output, own]
            factors[output, own] = np.exp(
                brentq(lambda log, z=z: z @ z * np.exp(-2.0 * log) - len(z) - log, -10.0, 10.0)
            )
    return factors


@pytest.mark.parametrize("kind", [EVGPRegressor, EGPRegressor])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))])
def test_scales_are_the_most_probable_ones_for_the_true_weights(kind, seed):
    """The data determine the weights to a hundredth of their prior standard deviation."""
    weights, fitted = problem(seed)[2], learned(kind, seed)
    assert_array_equal(fitted.coef_groups_, GROUPS)
    assert_allclose(fitted.coef_prior_scale_, most_probable_factors(weights) * SCALE, rtol=0.05)
    assert_array_equal(fitted.coef_prior_scale_[GROUPS == ""], SCALE[GROUPS == ""])
    assert (fitted.coef_prior_scale_[FAR] > 10.0 * SCALE[FAR]).all()


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("kind", [EVGPRegressor, EGPRegressor])
def test_without_groups_scales_stay(kind):
    X, y, _ = problem()
    fitted = model(kind, groups=None, max_iter=5).fit(X, y)
    assert_array_equal(fitted.coef_prior_scale_, SCALE)
    assert_array_equal(fitted.coef_groups_, np.full(SCALE.shape, ""))


@pytest.mark.parametrize("kind", [EVGPRegressor, EGPRegressor])
def test_weights_that_outputs_share_have_one_factor_for_each_group(kind):
    X, y, weights = problem()
    y = np.column_stack([y[:, 0], y[:, 0] + 0.1 * np.cos(X[:, 0])])
    fitted = model(kind).set_params(coef_prior=CoefPrior(0.0, SCALE[0], shared=True, groups=GROUPS[0])).fit(X, y)
    assert_array_equal(fitted.coef_groups_, GROUPS[0])
    assert_allclose(fitted.coef_prior_scale_, (most_probable_factors(weights) * SCALE)[0], rtol=0.05)


def test_learned_scales_survive_a_warm_start_and_new_rows():
    X, y, _ = problem()
    fitted = deepcopy(learned(EVGPRegressor))
    expected = fitted.coef_prior_scale_
    fitted.set_params(warm_start=True, max_iter=0).fit(X, y)
    assert_allclose(fitted.coef_prior_scale_, expected, rtol=1e-12)
    X_new, y_new, _ = problem(1)
    fitted.partial_fit(X_new, y_new)
    assert_allclose(fitted.coef_prior_scale_, expected, rtol=1e-12)
    # Without a warm start they are the prior's own.
    assert_array_equal(model(max_iter=0).fit(X, y).coef_prior_scale_, SCALE)


@pytest.mark.parametrize("options", [{}, {"posterior": "diagonal"}, {"natural_gradient": True}], ids=str)
def test_adam_moves_scales_towards_those_of_lbfgs(options):
    X, y, _ = problem()
    fitted = model(solver=Adam(60, **options), max_iter=60).fit(X, y)
    assert_array_equal(fitted.coef_prior_scale_[GROUPS == ""], SCALE[GROUPS == ""])
    steps, wanted = (np.log(own.coef_prior_scale_[FAR] / SCALE[FAR]) for own in (fitted, learned(EVGPRegressor)))
    assert (steps > 0.1 * wanted).all()
    assert (steps < wanted).all()


def test_bound_is_that_of_a_prior_with_the_learned_scales():
    """It does not have the log prior of the factors, which the solver maximises with it."""
    X, y, _ = problem()
    y = y[:, 0]
    fitted = model(scale=SCALE[0], groups=GROUPS[0]).fit(X, y)
    given = model(
        scale=fitted.coef_prior_scale_,
        groups=None,
        kernel=fitted.kernel_,
        noise=Gaussian(variance=fitted.noise_variance_),
        inducing_init=fitted.inducing_points_,
        max_iter=0,
    ).fit(X, y)
    assert fitted.lower_bound_ == pytest.approx(given.lower_bound_, rel=1e-9)
    assert fitted.upper_bound_ == pytest.approx(given.upper_bound_, rel=1e-9)
    for own, expected in zip(fitted.predict(X, return_std=True), given.predict(X, return_std=True), strict=True):
        assert_allclose(own, expected, rtol=1e-7)


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_exact_likelihood_is_the_dense_one_and_its_slope_that_of_the_log_prior(correlation):
    """Of a Gaussian with the covariance K + H Σ Hᵀ + σ² I (Rasmussen & Williams 2006, eq. 2.43)."""
    rng = np.random.RandomState(0)
    X = rng.uniform(-2.0, 2.0, (60, 2))
    y = 10.0 + X @ [5.0, -8.0] + np.sin(3.0 * X[:, 0]) + 0.1 * rng.randn(60)
    groups, scale = np.array(["constant", "slope", "slope"]), np.array([0.5, 0.3, 0.4])
    covariance = np.outer(scale, scale) * [[1.0, 0.0, 0.0], [0.0, 1.0, correlation], [0.0, correlation, 1.0]]
    given = {"cov": covariance} if correlation else {"scale": scale}
    H = PolynomialFeatures(1).fit_transform(X)
    fitted = EGPRegressor(PolynomialFeatures(1), coef_prior=CoefPrior(0.0, groups=groups, **given)).fit(X, y)
    logs = np.log(fitted.coef_prior_scale_ / scale)
    assert logs[1] == pytest.approx(logs[2], rel=1e-12)
    assert (logs > 1.0).all()
    without = fitted.kernel_(X) + fitted.noise_variance_ * np.eye(60)

    def likelihood(logs):
        return multivariate_normal.logpdf(y, cov=without + H @ (covariance * np.exp(np.add.outer(logs, logs))) @ H.T)

    assert fitted.log_marginal_likelihood_value_ == pytest.approx(likelihood(logs), rel=1e-8)
    # The fit is at the maximum of the likelihood times the prior, where log t ~ N(0, 1).
    for group, log in zip(groups[:2], logs[:2], strict=True):
        step = 1e-4 * (groups == group)
        assert (likelihood(logs + step) - likelihood(logs - step)) / 2e-4 == pytest.approx(log, abs=1e-3)


@pytest.mark.filterwarnings("ignore:The robot's model does not fit the torques")
def test_torques_of_a_machine_that_is_ten_times_heavier_than_its_model():
    arm = Arm("pendulum", error=0.0, noise=0.2)
    truth, light = arm.torque(arm.new), with_masses(arm, 0.1)

    def fitted(learn_scales):
        options = {"learn_scales": learn_scales, "n_inducing": 0}
        return InverseDynamics(light, **options).fit(arm.X, arm.y, groups=arm.groups)

    def error(own):
        return np.sqrt(np.mean((own.predict(arm.new) - truth) ** 2)) / truth.std()

    free, kept = fitted(True), fitted(False)
    _, covariance = RigidBodyRegressor(light).fit(arm.X).coef_prior(1)
    scale = np.sqrt(np.diag(covariance))
    assert_array_equal(kept.coef_prior_scale_, scale)
    assert (free.coef_prior_scale_[:10] > 5.0 * scale[:10]).all()
    assert error(free) < 0.05
    assert error(free) < 0.2 * error(kept)
