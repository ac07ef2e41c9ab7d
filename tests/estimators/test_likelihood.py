"""The likelihood of the exact model as a function of the kernel's hyperparameters."""

import numpy as np
import pytest
from sklearn.exceptions import NotFittedError
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, ExpSineSquared, Matern, RationalQuadratic
from sklearn.preprocessing import PolynomialFeatures

from skevgp import CoefPrior, EGPRegressor
from skevgp.kernels import Cosine
from skevgp.noise import Gaussian

RNG = np.random.RandomState(0)
X = RNG.uniform(-2, 2, (40, 2))
Y = np.column_stack([5 * np.sin(2 * X[:, 0]) + X[:, 1], 3 * np.cos(X[:, 1]) * X[:, 0]]) + 0.3 * RNG.randn(40, 2)
TREND = PolynomialFeatures(1)
KERNELS = {
    "constant in front": 2.0 * RBF([1.0, 2.0]),
    "none": RBF(1.5),
    "constant behind": Matern([1.0, 2.0], nu=2.5) * ConstantKernel(3.0),
    "of two the outer": (9.0 * RBF()) * 0.5,
    "in the middle": RBF(1.5) * ConstantKernel(2.0) * RationalQuadratic(2.0, 3.0),
    "sum": 2.0 * RBF([1.0, 3.0]) + 0.5 * DotProduct(1.5),
    "product of a sum": 2.0 * (Matern(nu=1.5) + DotProduct(0.5) * RBF(2.0)),
    "fixed signal": ConstantKernel(4.0, "fixed") * RBF([1.0, 2.0]),
    "fixed shape": 4.0 * RBF([1.0, 2.0], "fixed"),
    "one fixed of several": 2.0 * RationalQuadratic(2.0, 3.0, alpha_bounds="fixed") + DotProduct(1.5),
    "periodic": 2.0 * ExpSineSquared(2.0, 3.0) * RBF(1.5),
    "ours": 1.5 * Cosine(3.0) * RBF(2.0),
}


def start(kernel=2.0 * RBF([1.0, 2.0]), y=Y[:, 0], **arguments):  # noqa: B008
    """A model whose kernel is where the user said."""
    return EGPRegressor(kernel=kernel, noise=Gaussian(variance=0.1), **({"max_iter": 0} | arguments)).fit(X, y)


def elsewhere(model, seed=0):
    kernels = model.kernel_ if isinstance(model.kernel_, list) else [model.kernel_]
    theta = np.array([kernel.theta for kernel in kernels])
    theta += np.random.RandomState(seed).uniform(-0.5, 0.5, theta.shape)
    return theta if isinstance(model.kernel_, list) else theta[0]


def numerical_gradient(function, theta):
    """Good to 1e-7: central differences."""
    flat = np.ravel(theta)
    return np.array(
        [
            (function((flat + step).reshape(theta.shape)) - function((flat - step).reshape(theta.shape))) / 2e-5
            for step in 1e-5 * np.eye(len(flat))
        ]
    ).reshape(theta.shape)


@pytest.mark.parametrize("name", KERNELS)
def test_likelihood_is_scikit_learns(name):
    model = start(kernel=KERNELS[name])
    oracle = GaussianProcessRegressor(model.kernel_, alpha=model.noise_variance_, optimizer=None).fit(X, Y[:, 0])
    for theta in (model.kernel_.theta, elsewhere(model), elsewhere(model, 1)):
        actual, expected = (gp.log_marginal_likelihood(theta, eval_gradient=True) for gp in (model, oracle))
        assert actual[0] == pytest.approx(expected[0], rel=1e-9)
        np.testing.assert_allclose(actual[1], expected[1], rtol=1e-6, atol=1e-8)
        assert model.log_marginal_likelihood(theta) == actual[0]


def dense_likelihood(model, theta, y, scale):
    """log N(y | 0, K + H Σ Hᵀ + σ² I) (Rasmussen & Williams 2006, eq. 2.43), and its gradient by eq. 5.9."""
    K, K_theta = model.kernel_.clone_with_theta(theta)(X, eval_gradient=True)
    H = TREND.fit_transform(X)
    C = K + scale**2 * H @ H.T + model.noise_variance_ * np.eye(len(X))
    alpha, (_, log_det) = np.linalg.solve(C, y), np.linalg.slogdet(C)
    inner = np.outer(alpha, alpha) - np.linalg.inv(C)
    value = -0.5 * (y @ alpha + log_det + len(y) * np.log(2 * np.pi))
    return value, 0.5 * np.einsum("ij,ijk->k", inner, K_theta)


def test_with_features_the_likelihood_is_the_dense_one():
    model = start(feature_map=TREND, coef_prior=CoefPrior(mean=0.0, scale=2.0))
    theta = elsewhere(model)
    value, gradient = model.log_marginal_likelihood(theta, eval_gradient=True)
    expected = dense_likelihood(model, theta, Y[:, 0], 2.0)
    assert value == pytest.approx(expected[0], rel=1e-9)
    np.testing.assert_allclose(gradient, expected[1], atol=1e-7)


@pytest.mark.parametrize("scale", [2.0, np.inf])
def test_gradient_of_the_likelihood_is_the_numerical_one(scale):
    model = start(feature_map=TREND, coef_prior=CoefPrior(scale=scale), y=100.0 * Y[:, 0])
    theta = elsewhere(model)
    _, gradient = model.log_marginal_likelihood(theta, eval_gradient=True)
    expected = numerical_gradient(model.log_marginal_likelihood, theta)
    np.testing.assert_allclose(gradient, expected, rtol=1e-5, atol=1e-4)
    assert model.log_marginal_likelihood(model.kernel_.theta) == pytest.approx(model.log_marginal_likelihood_value_)


def test_without_theta_it_is_the_fitted_value():
    model = start()
    assert model.log_marginal_likelihood() == model.log_marginal_likelihood_value_
    with pytest.raises(ValueError, match="Gradient can only be evaluated for theta!=None"):
        model.log_marginal_likelihood(eval_gradient=True)
    with pytest.raises(NotFittedError):
        EGPRegressor().log_marginal_likelihood()


def test_theta_that_does_not_fit_raises():
    one, two = start(), start(y=Y)
    for model, theta in [(one, [0.0]), (one, np.zeros((1, 3))), (two, np.zeros(3)), (two, np.zeros((3, 3)))]:
        with pytest.raises(ValueError, match="theta must be of shape"):
            model.log_marginal_likelihood(theta)
    for wrong in (np.nan, np.inf, 400.0, -400.0):
        with pytest.raises(ValueError, match="theta must be logarithms of numbers from 1e-100 to 1e"):
            one.log_marginal_likelihood([0.0, wrong, 0.0])
    with pytest.raises(ValueError, match="theta must be real numbers"):
        one.log_marginal_likelihood(["a", "b", "c"])
