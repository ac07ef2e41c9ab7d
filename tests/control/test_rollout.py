"""Multi-step prediction, against the same done by hand."""

import autograd.numpy as anp
import numpy as np
import pandas as pd
import polars
import pytest
from scipy.stats import kstest, norm
from sklearn.base import BaseEstimator
from sklearn.compose import ColumnTransformer
from sklearn.exceptions import NotFittedError
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from skevgp import EGPRegressor, EVGPRegressor, ResidualRegressor, rollout
from skevgp.exceptions import UnstableRolloutWarning
from skevgp.features import LogNormal, ParametricFeatures
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS

N_STEPS = 12
QUICK = {"max_iter": 5, "solver": LBFGS(tol=1e6), "sharing": "all", "noise_cv": None, "random_state": 0}


def plant(z, u):
    """A damped pendulum's step, roughly."""
    angle, speed = z.T
    return np.column_stack([angle + 0.1 * speed, 0.95 * speed - 0.3 * np.sin(angle) + 0.1 * u[:, 0]])


@pytest.fixture(scope="module")
def data():
    # With fewer rows, outputs share the draws of their kernel, and are a little correlated.
    rng = np.random.RandomState(0)
    z, u = rng.uniform(-2.0, 2.0, (90, 2)), rng.uniform(-1.0, 1.0, (90, 1))
    return np.hstack([z, u]), plant(z, u) + 0.02 * rng.randn(90, 2)


@pytest.fixture(scope="module")
def inputs():
    return np.random.RandomState(1).uniform(-1.0, 1.0, (N_STEPS, 1))


def pull(X, rate):
    return anp.sin(rate * X[:, 0])


PULL = ParametricFeatures(pull, {"rate": LogNormal(0.8, 1.0)})
REGRESSORS = {
    "sparse": EVGPRegressor(n_inducing=15, **QUICK),
    "features": EVGPRegressor(FunctionTransformer(), kernel_map=StandardScaler(), n_inducing=15, **QUICK),
    "exact": EGPRegressor(FunctionTransformer(), random_state=0, max_iter=5, tol=1e6),
    "parameters": EVGPRegressor(PULL, n_inducing=15, **QUICK),
    "residual of parameters": ResidualRegressor(EVGPRegressor(PULL, n_inducing=15, **QUICK)),
    "residual": ResidualRegressor(EVGPRegressor(n_inducing=15, **QUICK)),
    "scikit-learn's": GaussianProcessRegressor(RBF(2.0) + WhiteKernel(1e-3), normalize_y=True, optimizer=None),
    "pipeline": make_pipeline(StandardScaler(), EVGPRegressor(n_inducing=15, **QUICK)),
}


@pytest.fixture(scope="module", params=REGRESSORS)
def model(request, data):
    return REGRESSORS[request.param].fit(*data)


@pytest.fixture(scope="module")
def sparse(data):
    return EVGPRegressor(FunctionTransformer(), n_inducing=15, **QUICK).fit(*data)


Z0 = np.array([0.5, -0.2])


@pytest.mark.parametrize("process_noise", ["learned", "none"])
def test_after_one_step_samples_have_the_predictive_distribution(model, inputs, process_noise):
    found = rollout(model, Z0, inputs[:1], n_samples=10_000, process_noise=process_noise, random_state=0)
    # Those whose predict knows no include_noise have it in their std.
    options = {"include_noise": False} if process_noise == "none" and hasattr(model, "_posterior") else {}
    mean, std = model.predict(np.concatenate([Z0, inputs[0]])[np.newaxis], return_std=True, **options)
    for state in range(2):
        # The largest distance is below this in 999 of 1000 cases.
        assert kstest(found.samples[:, 0, state], norm(mean[0, state], std[0, state]).cdf).statistic < 1.95 / 100.0


def test_without_a_jacobian_differences_do(model, inputs):
    # Outputs that share parameters are a little correlated, which predict alone does not tell.
    correlated = hasattr(getattr(model, "regressor_", model), "theta_")
    ours, found = (rollout(each, Z0, inputs, method="linearized") for each in (model, _Hidden(model)))
    np.testing.assert_allclose(found.covariance, ours.covariance, rtol=1e-4, atol=1e-4 if correlated else 1e-8)


def test_mean_is_fed_back(model, inputs):
    found = rollout(model, Z0, inputs, method="mean")
    z = Z0
    for t, u in enumerate(inputs):
        mean, std = model.predict(np.concatenate([z, u])[np.newaxis], return_std=True)
        z = mean[0]
        np.testing.assert_allclose(found.mean[t], z, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(found.std[t], std[0], rtol=1e-6)
    np.testing.assert_array_equal(found.inputs, inputs)
    assert "samples" not in found


@pytest.mark.parametrize("n_samples", [2, 5])
def test_covariance_of_few_particles_is_unbiased(sparse, inputs, n_samples):
    n_runs = 4000
    found = rollout(sparse, np.tile(Z0, (n_runs, 1)), inputs[:1], n_samples=n_samples, random_state=0)
    _, std = sparse.predict(np.hstack([Z0, inputs[0]])[np.newaxis], return_std=True)
    # The variance of a normal distribution's sample variance is 2 / (n_samples - 1) times the square of its mean.
    error = np.sqrt(2.0 / ((n_samples - 1) * n_runs))
    np.testing.assert_allclose((found.std[:, 0] ** 2).mean(axis=0), std[0] ** 2, rtol=4.0 * error)


@pytest.mark.parametrize("process_noise", ["learned", "none"])
def test_linearised_covariance_goes_through_the_derivatives(sparse, inputs, process_noise):
    found = rollout(sparse, Z0, inputs, method="linearized", process_noise=process_noise)
    z, Sigma = Z0, np.zeros((2, 2))
    for t, u in enumerate(inputs):
        X = np.concatenate([z, u])[np.newaxis]
        A = sparse.jacobian(X)[0, :, :2]
        mean, std = sparse.predict(X, return_std=True, include_noise=process_noise == "learned")
        z, Sigma = mean[0], A @ Sigma @ A.T + np.diag(std[0] ** 2)
        np.testing.assert_allclose(found.mean[t], z, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(found.covariance[t], Sigma, rtol=1e-8)
    np.testing.assert_allclose(found.std**2, np.einsum("tii->ti", found.covariance))


class _Plain(BaseEstimator):
    """A regressor of other packages, which does not say how many columns it takes."""

    def fit(self, X, y):
        return self

    def __sklearn_is_fitted__(self):
        return True

    def predict(self, X, return_std=False):
        mean = X[:, :1] + X[:, 1:].sum(axis=1, keepdims=True)
        return (mean, np.zeros_like(mean)) if return_std else mean


def test_inputs_say_how_many_there_are_if_the_regressor_does_not():
    U = np.arange(24.0).reshape(2, 4, 3)
    found = rollout(_Plain(), np.zeros((2, 1)), U, method="mean", process_noise="none")
    np.testing.assert_allclose(found.mean[:, :, 0], U.sum(axis=2).cumsum(axis=1))


class _Hidden(BaseEstimator):
    """A regressor that can do nothing but predict."""

    def __init__(self, regressor):
        self.regressor = regressor
        self.n_features_in_ = 3

    def fit(self, X, y):
        return self

    def __sklearn_is_fitted__(self):
        return True

    def predict(self, X, return_std=False):
        return self.regressor.predict(X, return_std=return_std)


def test_function_samples_agree_with_linearisation(data, inputs):
    """Of a system that is linear and known but for its weights, errors add up from step to step, and do not average."""
    X, y = data
    kernel = ConstantKernel(1e-10, "fixed") * RBF(1.0, "fixed")
    model = EVGPRegressor(
        FunctionTransformer(), kernel, n_inducing=5, noise_cv=None, max_iter=0, noise=Gaussian(variance=1e-4)
    )
    model.fit(X, y)
    found = rollout(model, Z0, inputs, n_samples=4000, process_noise="none", random_state=0)
    means = (
        np.linalg.cholesky(model.coef_cov_) @ np.random.RandomState(2).randn(2, 3, 4000) + model.coef_[:, :, np.newaxis]
    )
    z = np.repeat(Z0[:, np.newaxis], 4000, axis=1)
    for t, u in enumerate(inputs):
        z = np.einsum("ijs,js->is", means, np.vstack([z, np.full((1, 4000), u[0])]))
        np.testing.assert_allclose(found.std[t], z.std(axis=1), rtol=0.12)
    anew = rollout(_Hidden(model), Z0, inputs, n_samples=4000, random_state=0)
    assert (np.abs(anew.std[-1] / found.std[-1] - 1.0) > 0.2).any()


def test_feedback_is_in_the_derivative(sparse):
    gain = np.array([[-1.0, -2.0]])
    found = rollout(sparse, Z0, lambda z, t: z @ gain.T, n_steps=2, method="linearized")
    X = np.concatenate([Z0, gain @ Z0])[np.newaxis]
    mean, std = sparse.predict(X, return_std=True)
    first = np.diag(std[0] ** 2)
    X = np.concatenate([mean[0], gain @ mean[0]])[np.newaxis]
    slopes = sparse.jacobian(X)[0]
    A = slopes[:, :2] + slopes[:, 2:] @ gain
    std = sparse.predict(X, return_std=True)[1]
    np.testing.assert_allclose(found.covariance[1], A @ first @ A.T + np.diag(std[0] ** 2), rtol=1e-6)
    samples = rollout(sparse, Z0, lambda z, t: z @ gain.T, n_steps=2, n_samples=50, random_state=0)
    np.testing.assert_allclose(samples.inputs[:, 1], samples.samples[:, 0] @ gain.T, rtol=1e-12)


def sine_of_polars(frame):
    return frame.select(polars.all().sin()).to_numpy()


@pytest.mark.parametrize("residual", [False, True])
@pytest.mark.parametrize(("frame_of", "sine"), [(pd.DataFrame, np.sin), (polars.DataFrame, sine_of_polars)])
def test_maps_that_take_columns_by_name_see_them(data, inputs, residual, frame_of, sine):
    X, y = data
    frame = frame_of(dict(zip(["angle", "speed", "torque"], X.T, strict=True)))

    def made(scaled, angle, sine):
        by_names = ColumnTransformer([("s", StandardScaler(), scaled), ("a", FunctionTransformer(sine), angle)])
        model = EVGPRegressor(kernel_map=by_names, n_inducing=10, **QUICK | {"max_iter": 0})
        return ResidualRegressor(model) if residual else model

    named, numbered = made(["speed", "torque"], ["angle"], sine).fit(frame, y), made([1, 2], [0], np.sin).fit(X, y)
    for method in ("mean", "linearized", "sample"):
        found, expected = (
            rollout(each, Z0, inputs[:4], method=method, n_samples=3, random_state=0) for each in (named, numbered)
        )
        np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(found.std, expected.std, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (([0.0], np.zeros((5, 1))), {}, r"U must be of shape \(n_steps, 2\)"),
        (([0.0, 0.0, 0.0, 0.0], np.zeros((5, 1))), {}, "z0 has 4 states, but rows of the regressor"),
        (([0.0, 0.0, 0.0], np.zeros((5, 0))), {}, "predicts 2 outputs, but z0 has 3 states"),
        (([0.0, np.nan], np.zeros((5, 1))), {}, "z0 must be finite"),
        (([[[0.0, 0.0]]], np.zeros((5, 1))), {}, "z0 must be of shape"),
        ((Z0, np.zeros((5, 2))), {}, r"U must be of shape \(n_steps, 1\).* got \(5, 2\)\.$"),
        ((Z0, np.zeros((5, 0))), {}, r'got \(5, 0\)\. If its features have dt="column", inputs are \[u, Δt\]\.$'),
        ((Z0, np.full((5, 1), np.inf)), {}, "U must be finite"),
        ((Z0, np.zeros((0, 1))), {}, "U has no steps"),
        ((Z0, np.zeros((3, 5, 1))), {}, "n_batch=1"),
        ((Z0, np.zeros((5, 1))), {"n_steps": 5}, "Pass n_steps only with a controller"),
        ((Z0, lambda z, t: [0.0]), {}, "n_steps is needed"),
        ((Z0, lambda z, t: [0.0]), {"n_steps": 0}, "n_steps"),
        ((Z0, lambda z, t: [0.0, 1.0]), {"n_steps": 3}, "The controller must return inputs of shape"),
        ((Z0, lambda z, t: [np.nan]), {"n_steps": 3}, "What the controller returns must be finite"),
        ((Z0, np.zeros((5, 1))), {"method": "exact"}, "method must be one of"),
        ((Z0, np.zeros((5, 1))), {"process_noise": "all"}, "process_noise must be one of"),
        ((Z0, np.zeros((5, 1))), {"n_samples": 0}, "n_samples"),
    ],
)
@pytest.mark.parametrize("method", ["sample", "mean"])
def test_invalid_arguments_raise(sparse, arguments, options, message, method):
    with pytest.raises(ValueError, match=message):
        rollout(sparse, *arguments, **{"method": method, **options})


def test_one_particle_raises(sparse, inputs):
    with pytest.raises(ValueError, match='n_samples of method="sample" must be at least 2; got 1'):
        rollout(sparse, Z0, inputs, n_samples=1)


def test_invalid_regressors_raise(data, inputs):
    with pytest.raises(NotFittedError):
        rollout(EVGPRegressor(), Z0, inputs)
    with pytest.raises(TypeError, match=r"LinearRegression.predict has no return_std"):
        rollout(LinearRegression().fit(*data), Z0, inputs)


def test_system_that_runs_away_raises(data):
    X, _ = data
    model = EVGPRegressor(FunctionTransformer(), n_inducing=5, **QUICK).fit(X, 1e3 * X[:, :2])
    for method in ("sample", "mean", "linearized"):
        with pytest.raises(ValueError, match=r"States of \d+ of \d+ (particles|rollouts) grow beyond 1e.100 at step"):
            rollout(model, Z0, np.zeros((60, 1)), method=method, n_samples=3, random_state=0)


class Escape(BaseEstimator):
    """A stable step up to |z| = 3, from which states grow by half in each step."""

    def fit(self, X, y):
        self.n_features_in_ = X.shape[1]
        return self

    def predict(self, X, return_std=False):
        z = X[:, :1]
        mean = np.where(np.abs(z) < 3.0, 0.5 * z, 1.5 * z)
        return mean, np.ones_like(z)


def test_particles_that_run_away_raise_a_warning():
    # After the first step particles are N(1.45, 1), so that about 6 % of them pass 3. Others follow.
    model = Escape().fit(np.zeros((2, 2)), np.zeros(2))
    with pytest.warns(
        UnstableRolloutWarning, match=r"\d+ of 100 particles run away, the first at step \d+, "
    ) as caught:
        ahead = rollout(model, [2.9], np.zeros((60, 1)), random_state=0)
    assert len(caught) == 1
    assert ahead.std[-1] > 1e6
    rollout(model, [2.9], np.zeros((3, 1)), random_state=0)


class Bistable(Escape):
    """Steps of ẋ = x - x³, with the stable states -1 and 1."""

    def predict(self, X, return_std=False):
        z = X[:, :1]
        return z + 0.2 * (z - z**3), np.full_like(z, 0.003)


def test_particles_in_another_stable_state_do_not_run_away():
    # A seventh ends at -1, the others at 1 with a spread of about 0.01.
    ahead = rollout(Bistable().fit(np.zeros((2, 2)), np.zeros(2)), [0.006], np.zeros((80, 1)), random_state=0)
    assert 5 < (ahead.samples[:, -1, 0] < -0.9).sum() < 25
    assert ahead.std[-1, 0] > 30.0 * np.subtract(*np.percentile(ahead.samples[:, -1, 0], [75, 25]))
