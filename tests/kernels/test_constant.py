import numpy as np

from skevgp.kernels.constant import Constant

from .cases import X, Z, random_bars


def test_constant_diagonal_is_scalar():
    covariance = Constant()
    at, prepared = covariance.at(np.array([0.6]), Z), covariance.prepare(X)
    U = at.cross(prepared)
    assert U.shape == (7, 40)
    assert U.strides == (0, 0)
    assert at.diagonal(prepared) == U[0, 0] == 0.6
    np.testing.assert_array_equal(at.matrix(), np.full((7, 7), U[0, 0]))


def test_gradient_is_the_sum_of_all_and_none_moves_the_points():
    cross_bar, diagonal_bar, K_bar = random_bars(7, 40)
    covariance = Constant()
    at, prepared = covariance.at(np.array([0.6]), Z), covariance.prepare(X)
    total = at.start_pullback() + at.cross_pullback(prepared, at.cross(prepared), cross_bar, diagonal_bar)
    hyper_bar, Z_bar = at.finish_pullback(total, K_bar)
    np.testing.assert_allclose(hyper_bar, 0.6 * (cross_bar.sum() + diagonal_bar.sum() + K_bar.sum()), rtol=1e-12)
    np.testing.assert_array_equal(Z_bar, np.zeros((7, 2)))
