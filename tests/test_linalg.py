import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad

from skevgp._linalg import (
    NotPositiveDefiniteError,
    cholesky_pullback,
    jittered_cholesky,
    triangular_inverse,
)


def positive_definite(n, seed=0):
    A = np.random.RandomState(seed).randn(n, n)
    return A @ A.T + n * np.eye(n)


def test_factor_of_a_well_conditioned_matrix_is_numpys():
    A = positive_definite(7)
    np.testing.assert_allclose(jittered_cholesky(A), np.linalg.cholesky(A), rtol=1e-13)


def test_the_matrix_is_left_alone():
    A = positive_definite(4)
    before = A.copy()
    jittered_cholesky(A, 1e-3)
    np.testing.assert_array_equal(A, before)


def test_a_zero_on_the_diagonal_gets_a_jitter_too():
    A = np.diag([4.0, 0.0, 1.0])
    L = jittered_cholesky(A, 1e-12)
    np.testing.assert_allclose(L @ L.T, A, atol=1e-11)
    assert L[1, 1] > 0.0


def test_jitter_is_relative_to_the_diagonal():
    A = np.diag([1.0, 1e8, 1e-8])
    L = jittered_cholesky(A, 1e-2)
    np.testing.assert_allclose(np.diag(L) ** 2, 1.01 * np.diag(A), rtol=1e-14)


def test_a_singular_matrix_gets_just_enough_jitter():
    A = np.ones((5, 5))
    L = jittered_cholesky(A)
    np.testing.assert_allclose(L @ L.T, A, atol=1e-12)


@pytest.mark.parametrize("bad", [np.array([[1.0, 2.0], [2.0, 1.0]]), np.full((2, 2), np.nan), np.array([[np.inf]])])
def test_hopeless_matrices_raise_a_named_error(bad):
    with pytest.raises(NotPositiveDefiniteError, match="not positive definite|not finite"):
        jittered_cholesky(bad)


def test_triangular_inverse():
    L = np.linalg.cholesky(positive_definite(6))
    inverse = triangular_inverse(L)
    np.testing.assert_allclose(inverse @ L, np.eye(6), atol=1e-13)
    np.testing.assert_array_equal(inverse, np.tril(inverse))


def test_the_factors_pull_back_agrees_with_autograd():
    A, weights = positive_definite(4), np.tril(np.random.RandomState(1).randn(4, 4))
    expected = grad(lambda A: anp.sum(weights * anp.linalg.cholesky(0.5 * (A + A.T))))(A)
    L = np.linalg.cholesky(A)
    np.testing.assert_allclose(cholesky_pullback(L, triangular_inverse(L), weights), expected, rtol=1e-9, atol=1e-15)
