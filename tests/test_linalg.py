import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad

from skevgp.utils.linalg import (
    Jitter,
    NotPositiveDefiniteError,
    cholesky_of_covariance,
    cholesky_pullback,
    covariance_root,
    jittered_cholesky,
    lower_transposed_times,
    nearest_covariance,
    times_lower,
    triangular_inverse,
    triangular_product,
    triangular_solve,
)


def positive_definite(n, seed=0):
    A = np.random.RandomState(seed).randn(n, n)
    return A @ A.T + n * np.eye(n)


def test_factor_of_a_well_conditioned_matrix_is_numpys():
    A = positive_definite(7)
    np.testing.assert_allclose(jittered_cholesky(A), np.linalg.cholesky(A), rtol=1e-13)


def test_jitter_is_relative_to_the_diagonal():
    A = np.diag([1.0, 1e8, 1e-8])
    L = jittered_cholesky(A, 1e-2)
    np.testing.assert_allclose(np.diag(L) ** 2, 1.01 * np.diag(A), rtol=1e-14)


def test_singular_matrix_gets_just_enough_jitter():
    A = np.ones((5, 5))
    L = jittered_cholesky(A)
    np.testing.assert_allclose(L @ L.T, A, atol=1e-12)


LARGE = Jitter(1e-3, well_conditioned=1e-6)


def with_last_pivot(pivot):
    """A covariance whose last row is known from the first but for this share of its variance."""
    L = np.array([[1.0, 0.0], [np.sqrt(1.0 - pivot), np.sqrt(pivot)]])
    return 4.0 * L @ L.T


@pytest.mark.parametrize("pivot", [5e-7, 1e-12, 0.0])
def test_one_whose_rows_nearly_follow_from_each_other_gets_it(pivot):
    A = with_last_pivot(pivot)
    L = cholesky_of_covariance(A, LARGE)
    np.testing.assert_allclose(L @ L.T, A + 1e-3 * np.diag(np.diag(A)), rtol=1e-14)


def test_jitter_above_the_most_is_not_tried():
    indefinite = np.array([[1.0, 1.0 + 1e-6], [1.0 + 1e-6, 1.0]])
    assert np.isfinite(jittered_cholesky(indefinite)).all()
    with pytest.raises(NotPositiveDefiniteError, match="with a relative jitter of 1e-08"):
        jittered_cholesky(indefinite, most=1e-8)


# --- errors -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "bad",
    [
        np.array([[1.0, 2.0], [2.0, 1.0]]),
        np.full((2, 2), np.nan),
        np.array([[np.inf]]),
        np.array([[np.inf, np.inf], [np.inf, 6e307]]),
    ],
)
def test_hopeless_matrices_raise_a_named_error(bad):
    with pytest.raises(NotPositiveDefiniteError, match="not positive definite|not finite"):
        jittered_cholesky(bad)


@pytest.mark.parametrize("lengthscale", [0.05, 0.3, 1.0])
def test_inverse_has_a_small_left_residual_however_ill_conditioned_the_factor(lengthscale):
    """Higham 2002, section 14.2: |X L - I| <= c n u |X| |L|, entry by entry; here with the product's own rounding."""
    x = np.linspace(0.0, 1.0, 60)
    L = jittered_cholesky(np.exp(-0.5 * ((x[:, np.newaxis] - x) / lengthscale) ** 2), 1e-12)
    assert np.linalg.cond(L) > 1e5
    inverse = triangular_inverse(L)
    bound = 4 * len(x) * np.finfo(float).eps * (np.abs(inverse) @ np.abs(L))
    assert (np.abs(inverse @ L - np.eye(60)) <= bound).all()
    # A whitened row comes back: V = L⁻¹ (L V).
    V = np.random.RandomState(0).randn(60, 5)
    assert (
        np.abs(inverse @ (L @ V) - V) <= 4 * len(x) * np.finfo(float).eps * (np.abs(inverse) @ np.abs(L) @ np.abs(V))
    ).all()


def test_factors_pull_back_agrees_with_autograd():
    A, weights = positive_definite(4), np.tril(np.random.RandomState(1).randn(4, 4))
    expected = grad(lambda A: anp.sum(weights * anp.linalg.cholesky(0.5 * (A + A.T))))(A)
    L = np.linalg.cholesky(A)
    above = np.triu(np.full((4, 4), 1e3), 1)
    for L_bar in (weights, weights + above):
        found = cholesky_pullback(triangular_inverse(L), L.T @ L_bar)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)
        np.testing.assert_array_equal(cholesky_pullback(triangular_inverse(L), L.T @ L_bar + above), found)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (1, 1), (2, 5), (7, 5)])
def test_products_with_a_lower_triangle(shape, order):
    """What lies above the diagonal is not read."""
    rng = np.random.RandomState(0)
    A, L = np.array(rng.randn(*shape), order=order), np.tril(rng.randn(shape[1], shape[1]))
    given, dirty = A.copy(), L + np.triu(np.full(L.shape, 1e3), 1)
    for transposed, expected in ((False, A @ L), (True, A @ L.T)):
        found = times_lower(A, dirty, transposed)
        assert found.shape == expected.shape
        np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(lower_transposed_times(dirty, A.T), L.T @ A.T, rtol=1e-13, atol=1e-14)
    np.testing.assert_array_equal(A, given)


@pytest.mark.parametrize("m", [0, 1, 47, 48, 49, 130])
def test_triangular_product_leaves_out_nothing_but_zeros(m):
    rng = np.random.RandomState(m)
    L, B, out = np.tril(rng.randn(m, m)), rng.randn(m, 5), np.full((m + 2, 5), np.nan)
    found = triangular_product(L, B, out[:m])
    assert found.base is out
    np.testing.assert_allclose(found, L @ B, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(triangular_product(np.asfortranarray(L), B, out[:m]), L @ B, rtol=1e-12, atol=1e-12)
    assert np.isnan(out[m:]).all()


@pytest.mark.parametrize(("n", "k"), [(60, 7), (60, 1), (1, 3), (5, 0), (0, 3), (0, 1)])
def test_solve_has_a_small_residual_however_ill_conditioned_the_factor(n, k):
    """Within |L| |X| row by row, and in the place of B (Higham 2002, theorem 8.5)."""
    x = np.linspace(0.0, 1.0, n)
    L = jittered_cholesky(np.exp(-0.5 * np.subtract.outer(x, x) ** 2), 1e-12)
    B = np.random.RandomState(0).randn(n + 2, k)
    X, rest = B[:n], B[n:].copy()
    before = X.copy()
    triangular_solve(L, X)
    assert (np.abs(L @ X - before) <= 4 * n * np.finfo(float).eps * (np.abs(L) @ np.abs(X))).all()
    np.testing.assert_array_equal(B[n:], rest)


# --- roots of covariances ---------------------------------------------------------------------------------------------


def of_rank(rank, n=80, seed=0):
    """A covariance of rows that repeat and have different units."""
    B = np.random.RandomState(seed).randn(n, rank)
    B[n // 2 :] = B[: n - n // 2]
    B *= np.logspace(-6, 3, n)[:, np.newaxis]
    return B @ B.T


def check_root(covariance, sizes, error):
    F, by = covariance_root(covariance, sizes), np.sqrt(np.outer(sizes, sizes))
    np.testing.assert_allclose(F @ F.T / by, covariance / by, rtol=0.0, atol=error)
    np.testing.assert_allclose(np.einsum("ij,ij->i", F, F), np.diag(covariance), rtol=1e-13)
    nearest = nearest_covariance(covariance, sizes)
    np.testing.assert_allclose(nearest / by, F @ F.T / by, rtol=0.0, atol=error)
    np.testing.assert_array_equal(np.diag(nearest), np.diag(covariance))


@pytest.mark.parametrize("rank", [0, 1, 3, 30])
def test_root_of_a_singular_covariance_is_exact_to_rounding_in_all_units(rank):
    A = of_rank(rank)
    sizes = np.diag(A).copy() if rank else np.ones(len(A))
    check_root(A, sizes, 40 * np.finfo(float).eps)


@pytest.mark.parametrize("share", [1e-4, 1e-9, 1e-13, 1e-15])
def test_root_of_a_difference_has_rounding_errors_of_its_terms(share):
    """A covariance that is a small share of the terms whose difference it is."""
    n, noise = 80, np.random.RandomState(1).randn(80, 80)
    x = np.linspace(0.0, 1.0, n)
    A = share * np.exp(-0.5 * np.subtract.outer(x, x) ** 2 / 0.3**2)
    A += np.finfo(float).eps * (noise + noise.T) * (1.0 - np.eye(n))
    check_root(A, np.ones(n), n * 16 * np.finfo(float).eps)


def test_root_of_an_indefinite_matrix_keeps_its_diagonal():
    A = np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 3.0]])  # nearest, scaled: correlation 1
    np.testing.assert_allclose(nearest_covariance(A, np.diag(A)), [[1, 1, 0], [1, 1, 0], [0, 0, 3]], atol=1e-14)
