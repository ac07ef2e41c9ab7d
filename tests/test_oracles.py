"""The whole regressor against scikit-learn's exact GP and against a QR factorisation."""

import numpy as np
import pytest
from scipy.linalg import solve_triangular
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Kernel, WhiteKernel
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures

from skevgp import CoefPrior, EVGPRegressor
from skevgp.solvers import LBFGS

NOISE = 0.01


class Linear(Kernel):
    """h(x)ᵀ diag(scale²) h(x'), h = (1, x₀, x₁)."""

    def __init__(self, scale=(1.0, 1.0, 1.0)):
        self.scale = scale

    def _features(self, X):
        return np.hstack([np.ones((len(X), 1)), X]) * np.asarray(self.scale)

    def __call__(self, X, Y=None, eval_gradient=False):
        K = self._features(X) @ self._features(X if Y is None else Y).T
        return (K, np.empty((len(X), len(X), 0))) if eval_gradient else K

    def diag(self, X):
        return (self._features(X) ** 2).sum(axis=1)

    def is_stationary(self):
        return False


def fixed_kernel(signal=1.5, length=(0.7, 1.3)):
    return ConstantKernel(signal, "fixed") * RBF(length, "fixed")


@pytest.fixture
def data():
    rng = np.random.RandomState(0)
    X, X_new = rng.randn(70, 2), rng.randn(25, 2)
    Y = np.column_stack([np.sin(2 * X[:, 0]) + X[:, 1], np.cos(X[:, 1]) - 2 * X[:, 0]]) + 0.1 * rng.randn(70, 2)
    return X, Y, X_new


MEAN, SCALE = np.array([[0.3, -0.2, 1.1], [0.0, 2.0, 0.5]]), np.array([[0.5, 1.0, 2.0], [1.0, 0.3, 0.7]])


def exact(X, y, o, include_noise):
    kernel = fixed_kernel() + Linear(tuple(SCALE[o]))
    gpr = GaussianProcessRegressor(kernel, alpha=NOISE, optimizer=None).fit(X, y)
    return gpr, NOISE * include_noise


@pytest.mark.parametrize("include_noise", [True, False])
@pytest.mark.parametrize("sharing", ["all", "kernel", "none"])
def test_inducing_points_at_all_rows_give_the_exact_gp(data, sharing, include_noise):
    X, Y, X_new = data
    model = EVGPRegressor(
        PolynomialFeatures(1),
        fixed_kernel() + WhiteKernel(NOISE, "fixed"),
        n_inducing=70,
        sharing=sharing,
        coef_prior=CoefPrior(mean=MEAN, scale=SCALE),
        max_iter=0,
    ).fit(X, Y)
    mean, std = model.predict(X_new, return_std=True, include_noise=include_noise)
    _, cov = model.predict(X_new, return_cov=True, include_noise=include_noise)
    H, H_new = PolynomialFeatures(1).fit_transform(X), PolynomialFeatures(1).fit_transform(X_new)
    bound = 0.0
    for o in range(2):
        gpr, noise = exact(X, Y[:, o] - H @ MEAN[o], o, include_noise)
        exact_mean, exact_cov = gpr.predict(X_new, return_cov=True)
        exact_cov = exact_cov + noise * np.eye(25)
        np.testing.assert_allclose(mean[:, o], exact_mean + H_new @ MEAN[o], atol=1e-6)
        np.testing.assert_allclose(std[:, o], np.sqrt(np.diag(exact_cov)), atol=1e-6)
        np.testing.assert_allclose(cov[:, :, o], exact_cov, atol=1e-6)
        bound += gpr.log_marginal_likelihood_value_
    np.testing.assert_allclose(model.lower_bound_, bound, rtol=1e-6)


@pytest.mark.parametrize(
    "options", [{}, {"solver__posterior": "diagonal"}, {"noise_cv": 5}, {"normalize_y": True}], ids=str
)
def test_exact_likelihood_of_what_was_fitted_lies_between_the_bounds(data, options):
    X, Y, _ = data
    unit = np.array([1.0, 100.0])
    prior = {"coef_prior": CoefPrior(mean=MEAN * unit[:, np.newaxis], scale=SCALE * unit[:, np.newaxis])}
    model = EVGPRegressor(
        PolynomialFeatures(1), n_inducing=15, sharing="kernel", random_state=0, solver=LBFGS(tol=1e3), **prior
    )
    model.set_params(**options).fit(X, Y * unit)
    mean = np.mean(Y, axis=0) if "normalize_y" in options else np.zeros(2)
    likelihood = 0.0
    for o in range(2):
        kernel = model.kernel_[o] + Linear(tuple(unit[o] * SCALE[o]))
        gpr = GaussianProcessRegressor(kernel, alpha=model.noise_variance_[o], optimizer=None)
        left = Y[:, o] - mean[o] - PolynomialFeatures(1).fit_transform(X) @ MEAN[o]
        likelihood += gpr.fit(X, unit[o] * left).log_marginal_likelihood_value_
    assert model.lower_bound_ < likelihood < model.upper_bound_


def drawn(X, noise):
    """Two targets as likely as any under the kernel."""
    root = np.linalg.cholesky(fixed_kernel()(X) + noise * np.eye(len(X)))
    return root @ np.random.RandomState(1).randn(len(X), 2)


@pytest.mark.parametrize("noise", [1e-4, 1e-8])
def test_upper_bound_comes_down_to_the_likelihood_as_points_are_added(data, noise):
    X, Y = data[0], drawn(data[0], noise)
    kernel = fixed_kernel() + WhiteKernel(noise, "fixed")
    likelihood = GaussianProcessRegressor(fixed_kernel(), alpha=noise, optimizer=None).fit(X, Y[:, 0])
    upper = [
        EVGPRegressor(kernel=kernel, inducing_init=X[:m], max_iter=0).fit(X, Y[:, 0]).upper_bound_
        for m in (5, 20, 50, 65, 70)
    ]
    assert (np.diff(upper) < 0.0).all()
    assert upper[-1] == pytest.approx(likelihood.log_marginal_likelihood_value_, abs=0.1)


def test_vague_prior_gives_generalised_least_squares(data):
    X, Y, _ = data
    H = PolynomialFeatures(1).fit_transform(X)
    model = EVGPRegressor(
        PolynomialFeatures(1),
        fixed_kernel() + WhiteKernel(NOISE, "fixed"),
        n_inducing=70,
        coef_prior=CoefPrior(mean=0.0, scale=1e4),
        max_iter=0,
    ).fit(X, Y[:, 0])
    K_inv = np.linalg.inv(fixed_kernel()(X) + NOISE * np.eye(70))
    expected = np.linalg.solve(H.T @ K_inv @ H, H.T @ K_inv @ Y[:, 0])
    np.testing.assert_allclose(model.coef_, expected, rtol=1e-5)


@pytest.mark.parametrize("relative_noise", [1e-3, 1e-4, 1e-5])
def test_predictions_keep_their_digits_at_high_signal_to_noise(relative_noise):
    """40 inducing points on 2,000 rows, against least squares by QR: unwhitened sums fail here."""
    rng = np.random.RandomState(0)
    X, X_new = rng.rand(2000, 2), rng.rand(200, 2)
    f = np.sin(5 * X[:, 0]) * np.cos(4 * X[:, 1])
    noise = relative_noise * f.std()
    y = f + noise * rng.randn(2000)
    lengths = np.array([0.5, 0.6])
    kernel = ConstantKernel(1.0, "fixed") * RBF(lengths, "fixed") + WhiteKernel(noise**2, "fixed")
    linear = FunctionTransformer(lambda X: X)
    model = EVGPRegressor(
        linear, kernel, n_inducing=40, coef_prior=CoefPrior(mean=0.0, scale=1.0), max_iter=0, random_state=0
    )
    model.fit(X, y)

    Z = model.inducing_points_
    L = np.linalg.cholesky(RBF(lengths)(Z) + 1e-12 * np.eye(40))
    P = np.hstack([solve_triangular(L, RBF(lengths)(Z, X), lower=True).T, X])
    P_new = np.hstack([solve_triangular(L, RBF(lengths)(Z, X_new), lower=True).T, X_new])
    Q, R = np.linalg.qr(np.vstack([P / noise, np.eye(42)]))
    omega = solve_triangular(R, Q.T @ np.concatenate([y / noise, np.zeros(42)]))
    np.testing.assert_allclose(model.predict(X_new), P_new @ omega, atol=1e-8)
