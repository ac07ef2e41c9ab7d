"""The kernel itself; how it does as a covariance is in `test_contract`, where the registry takes it."""

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import jacobian
from sklearn.base import clone
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, WhiteKernel

from skevgp import EVGPRegressor
from skevgp.kernels import Cosine

from .cases import X, Z


def formula(A, B, length_scale):
    return anp.cos(2.0 * np.pi * anp.sum((A[:, None, :] - B[None, :, :]) / length_scale, axis=2))


@pytest.mark.parametrize("length_scale", [0.8, np.array([0.8, 1.7])])
def test_values_and_gradients_are_those_of_the_formula(length_scale):
    kernel = Cosine(length_scale)
    K, gradient = kernel(X, eval_gradient=True)
    np.testing.assert_allclose(K, formula(X, X, length_scale), atol=1e-13)
    np.testing.assert_allclose(kernel(X, Z), formula(X, Z, length_scale), atol=1e-13)
    np.testing.assert_array_equal(kernel.diag(X), np.ones(40))
    expected = jacobian(lambda theta: formula(X, X, anp.exp(theta)))(kernel.theta)
    np.testing.assert_allclose(gradient, expected, atol=1e-12)


def test_it_repeats_after_a_length_scale():
    kernel = Cosine([0.5, 2.0])
    np.testing.assert_allclose(kernel(X + [0.5, 0.0], Z), kernel(X, Z), atol=1e-12)
    np.testing.assert_allclose(kernel(X - [0.0, 6.0], Z), kernel(X, Z), atol=1e-12)
    np.testing.assert_allclose(kernel(X + [0.25, 0.0], Z), -kernel(X, Z), atol=1e-12)


def test_it_is_a_scikit_learn_kernel():
    kernel = Cosine([0.5, 2.0], [(0.1, 1.0), (1.0, 3.0)])
    assert repr(kernel) == "Cosine(length_scale=[0.5, 2])"
    assert repr(Cosine()) == "Cosine(length_scale=1)"
    assert clone(kernel) == kernel != Cosine([0.5, 1.0])
    np.testing.assert_allclose(np.exp(kernel.bounds), [[0.1, 1.0], [1.0, 3.0]])
    assert kernel.is_stationary()
    fixed = Cosine(0.5, "fixed")
    assert fixed(X, eval_gradient=True)[1].shape == (40, 40, 0)
    assert (fixed * RBF())(X, eval_gradient=True)[1].shape == (40, 40, 1)
    with pytest.raises(ValueError, match="only be evaluated when Y is None"):
        kernel(X, Z, eval_gradient=True)
    with pytest.raises(ValueError, match="has 2 length scales, but its inputs have 1 columns"):
        kernel(X[:, :1])


@pytest.mark.parametrize("offset", [0.0, 1e8])
def test_a_wave_across_two_columns_is_found_and_continued(offset):
    """By the sparse model and by scikit-learn's, to the precision that the noise allows."""
    rng = np.random.RandomState(0)
    X_train, X_far = rng.uniform(0.0, 4.0, (60, 2)), rng.uniform(8.0, 12.0, (60, 2))
    y, expected = (2.0 * np.sin(2.0 * np.pi * (rows[:, 0] / 3.1 + rows[:, 1] / 4.7)) for rows in (X_train, X_far))
    kernel = 1.0 * Cosine([3.0, 5.0]) + WhiteKernel(1e-2)
    noisy = y + 0.01 * rng.randn(60)
    exact = GaussianProcessRegressor(kernel).fit(X_train + offset, noisy)
    sparse = EVGPRegressor(kernel=kernel, n_inducing=10, random_state=0).fit(X_train + offset, noisy)
    for model, fitted in ((exact, exact.kernel_.k1), (sparse, sparse.kernel_)):
        np.testing.assert_allclose(fitted.k2.length_scale, [3.1, 4.7], rtol=1e-2)
        np.testing.assert_allclose(model.predict(X_far + offset), expected, atol=0.1)
