"""What is known before there are data."""

import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, WhiteKernel

from skevgp.fitting.start import prior_predictor
from skevgp.kernels.parse import parse_kernel
from skevgp.model.predictor import CoefficientPrior

from .cases import COEF_MEAN, COEF_SCALE, NO_FEATURES, H, O, X, source_of, units_of

KERNEL = ConstantKernel(1.4) * RBF([0.9, 1.6]) + DotProduct(0.3)


def predictor(kernel=KERNEL, H=H, shared=False):
    p = H.shape[1]
    mean, scale = COEF_MEAN[:, :p], COEF_SCALE[:, :p]
    if shared:
        mean, scale = (np.repeat(own[:1], O, axis=0) for own in (mean, scale))
    prior = CoefficientPrior(mean, scale, np.zeros((O, p)), None, shared)
    rows = units_of(H=H).rows(source_of(H=H))
    return prior_predictor(rows, parse_kernel(kernel, 2).as_given(), prior), prior


@pytest.mark.parametrize("H", [H, NO_FEATURES], ids=["features", "none"])
def test_prior_is_dense_one(H):
    found, prior = predictor(H=H)
    mean, covariance = found.covariance(X, H)
    np.testing.assert_allclose(mean, H @ prior.mean.T, rtol=1e-12)
    for o in range(O):
        expected = KERNEL(X) + (H * prior.scale[o] ** 2) @ H.T
        np.testing.assert_allclose(covariance[:, :, o], expected, rtol=1e-10, atol=1e-10 * expected.max())
    np.testing.assert_allclose(found.predict(X, H, True)[1], np.einsum("nno->no", covariance), rtol=1e-10)
    np.testing.assert_array_equal(found.coefficients()[0], prior.mean)
    np.testing.assert_array_equal(np.sqrt(np.einsum("oii->oi", found.coefficients()[1])), prior.scale)


def test_prior_noise_is_kernel_noise():
    assert (predictor()[0].noise == 0.0).all()
    np.testing.assert_array_equal(predictor(KERNEL + WhiteKernel(0.7))[0].noise, [0.7, 0.7])
