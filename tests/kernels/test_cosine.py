"""The kernel itself; how it does as a covariance is in `test_contract`, where the registry takes it."""

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import jacobian

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
