import numpy as np

from skevgp.kernels.dot_product import DotProduct

from .cases import X, Z


def test_dot_product_ignores_centre():
    """A centre, which helps covariances of differences, is none of its business."""
    covariance = DotProduct().centred(np.array([3.0, -2.0]))
    at, prepared = covariance.at(np.array([0.7]), Z + 1e3), covariance.prepare(X + 1e3)
    np.testing.assert_allclose(at.cross(prepared), 0.49 + (Z + 1e3) @ (X + 1e3).T, rtol=1e-14)
    np.testing.assert_allclose(at.diagonal(prepared), 0.49 + np.sum((X + 1e3) ** 2, axis=1), rtol=1e-14)
    np.testing.assert_allclose(at.matrix(), 0.49 + (Z + 1e3) @ (Z + 1e3).T, rtol=1e-14)
