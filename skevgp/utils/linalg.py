"""The jittered Cholesky factor and its pull-back."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

import numpy as np
from scipy.linalg import blas, eigh, lapack

# The largest relative jitter that is tried before a matrix counts as not finite or hopelessly indefinite.
MAX_JITTER = 1e-2
# Rows of a triangular matrix that are multiplied at once.
_BAND = 48


class NotPositiveDefiniteError(ArithmeticError):
    """No jitter up to `MAX_JITTER` makes the matrix positive definite, or it is not finite."""


@dataclass(frozen=True)
class Jitter:
    """What is added to the diagonal of a covariance matrix that needs it.

    Attributes
    ----------
    size : float
        Relative to the diagonal. k(X_m, X_m) from exact differences is accurate to about m times 1e-16.
    well_conditioned : float
        Where every pivot is above this share of its diagonal entry, a matrix needs no jitter.
    """

    size: float = 1e-12
    well_conditioned: float = 1e-6


JITTER = Jitter()


def cholesky_of_covariance(K: np.ndarray, jitter: Jitter) -> np.ndarray:
    """Lower Cholesky factor of a covariance matrix, with a jitter (`jittered_cholesky`) only where it needs one."""
    try:
        L = jittered_cholesky(K, 0.0, 0.0)
        if (diagonal_of(L) ** 2 >= jitter.well_conditioned * diagonal_of(K)).all():
            return L
    except NotPositiveDefiniteError:
        pass
    return jittered_cholesky(K, jitter.size)


def jittered_cholesky(
    matrix: np.ndarray, jitter: float = 0.0, most: float = MAX_JITTER, sizes: np.ndarray | None = None
) -> np.ndarray:
    """Lower Cholesky factor of a symmetric matrix plus the smallest multiple of its diagonal that makes it work.

    Parameters
    ----------
    matrix : ndarray of shape (n, n)
        Symmetric, with a diagonal that is nowhere negative. Only its lower triangle is read.
    jitter : float, default=0.0
        Always added, relative to the diagonal; raised by factors of ten, from at least 1e-15, while the
        factorisation fails.
    most : float, default=1e-2
        The largest jitter that is tried.
    sizes : ndarray of shape (n,), optional
        What jitters are relative to, where it is not the diagonal: of a difference of two matrices, that of the first.

    Returns
    -------
    L : ndarray of shape (n, n)
        Lower triangular, C-contiguous.

    Raises
    ------
    NotPositiveDefiniteError
        If even ``most`` does not help, or the matrix is not finite.
    """
    diagonal = diagonal_of(matrix)
    while True:
        shifted = matrix.copy()
        if jitter > 0.0:
            # Where a covariance is 0 (a linear one at the origin), the jitter is that of a very small one.
            own = diagonal if sizes is None else sizes
            own = own if own.all() else np.where(own == 0.0, 1e-16 * own.max(), own)
            diagonal_of(shifted)[...] += jitter * own
        # The transpose of a C-contiguous matrix is what LAPACK reads without a copy: its upper factor is our lower.
        factor, info = lapack.dpotrf(shifted.T, lower=0, clean=1, overwrite_a=1)
        if info == 0 and isfinite(factor.trace()):
            return factor.T
        if not np.isfinite(matrix).all():
            raise NotPositiveDefiniteError("the matrix is not finite")
        jitter = max(10.0 * jitter, 1e-15)
        if jitter > most:
            raise NotPositiveDefiniteError(f"not positive definite with a relative jitter of {most}")


def covariance_root(covariance: np.ndarray) -> np.ndarray:
    """A root F of a covariance matrix that rounding errors may have made indefinite.

    F is the Cholesky factor where there is one. Else F Fᵀ is the nearest positive semi-definite matrix (Higham 1988,
    "Computing a nearest symmetric positive semidefinite matrix"), with its rows and columns scaled so that the diagonal
    stays: without its negative eigenvalues a matrix has a larger one.

    Parameters
    ----------
    covariance : ndarray of shape (n, n)
        Symmetric but for rounding, with a diagonal that is nowhere negative.

    Returns
    -------
    root : ndarray of shape (n, n)
    """
    factor = _cholesky_root(covariance)
    if factor is not None:
        return factor
    values, vectors = eigh(covariance, check_finite=False)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    sizes = np.einsum("ij,ij->i", root, root)
    shrink = np.divide(diagonal_of(covariance), sizes, out=np.zeros(len(sizes)), where=sizes > 0.0)
    return root * np.sqrt(shrink)[:, np.newaxis]


def nearest_covariance(covariance: np.ndarray) -> np.ndarray:
    """The matrix itself if it has a Cholesky factor, else F Fᵀ of `covariance_root`, with the same diagonal."""
    if _cholesky_root(covariance) is not None:
        return 0.5 * (covariance + covariance.T)
    root = covariance_root(covariance)
    found: np.ndarray = root @ root.T
    diagonal_of(found)[...] = diagonal_of(covariance)
    return found


def _cholesky_root(covariance: np.ndarray) -> np.ndarray | None:
    factor, info = lapack.dpotrf(covariance.T, lower=0, clean=1)
    return factor.T if info == 0 and isfinite(factor.trace()) else None


def diagonal_of(matrix: np.ndarray) -> np.ndarray:
    """The diagonal of a matrix (n, n), to read and to write."""
    if matrix.flags.c_contiguous:
        return matrix.reshape(-1)[:: len(matrix) + 1]
    return np.einsum("ii->i", matrix)


def triangular_inverse(L: np.ndarray) -> np.ndarray:
    """Inverse X of a lower triangular matrix, lower triangular, with a small left residual: X L = I.

    Explicit because it multiplies whole blocks of rows as one matrix product. Rows are whitened by X U, where U = L V:
    what counts is how far X L is from the identity, and that is what LAPACK's method for a *lower* matrix bounds by
    |X| |L| (Higham 2002, section 14.2). Its method for an upper one, on the transpose, bounds L X - I instead; X L - I
    is then larger by the condition of L, 1e6 where there is little noise.
    """
    return lapack.dtrtri(L, lower=1)[0] if len(L) else L.copy()


def triangular_product(L: np.ndarray, B: np.ndarray, out: np.ndarray) -> np.ndarray:
    """L B for a lower triangular L, by bands of its rows without most of its zeros.

    (BLAS has a product of its own for it, but SciPy lets no other thread run meanwhile.)
    """
    for first in range(0, len(L), _BAND):
        end = first + _BAND
        np.matmul(L[first:end, :end], B[:end], out=out[first:end])
    return out


def times_lower(A: np.ndarray, L: np.ndarray, transposed: bool = False) -> np.ndarray:
    """A L, or A Lᵀ, (k, n), for A (k, n) and a lower triangular L (n, n): half the work of a product with zeros.

    (BLAS reads C-contiguous matrices as their transposes, without a copy. For m-sized products, not for blocks of rows
    in threads: see `triangular_product`.)
    """
    return blas.dtrmm(1.0, L.T, A.T, trans_a=int(transposed)).T if A.size else A.copy()


def lower_transposed_times(L: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Lᵀ B (n, k), for a lower triangular L (n, n) and B (n, k), as `times_lower`."""
    return blas.dtrmm(1.0, L.T, B.T, side=1, trans_a=1).T if B.size else B.copy()


def triangular_solve(L: np.ndarray, B: np.ndarray) -> None:
    """Put L⁻¹ B in the place of B, for a lower triangular L and a C-contiguous B."""
    # BLAS reads and writes transposes without a copy: X Lᵀ = Bᵀ.
    if B.size and B.shape[1] == 1:
        blas.dtrsv(L.T, B[:, 0], trans=1, overwrite_x=1)
    elif B.size:
        blas.dtrsm(1.0, L.T, B.T, side=1, overwrite_b=1)


def symmetric_inverse(L_inv: np.ndarray) -> np.ndarray:
    """(L Lᵀ)⁻¹ from L⁻¹."""
    return L_inv.T @ L_inv


def cholesky_pullback(L_inv: np.ndarray, factor_bar: np.ndarray) -> np.ndarray:
    """Pull a gradient back through L = cholesky(K): K̄ = ½ L⁻ᵀ S L⁻¹, where S is symmetric and below its diagonal Lᵀ L̄.

    (Murray 2016, "Differentiation of the Cholesky decomposition", equation 10, symmetrised.)

    Parameters
    ----------
    L_inv : ndarray of shape (n, n)
        The factor's inverse.
    factor_bar : ndarray of shape (n, n)
        Lᵀ L̄, with L̄ the gradient of a scalar in the factor; the lower triangle counts. (It takes nothing from above
        the diagonal of L̄; where L̄ is L⁻ᵀ times something, that something is it.)

    Returns
    -------
    K_bar : ndarray of shape (n, n)
        Symmetric: d scalar = sum(K_bar * dK) for symmetric dK.
    """
    half = 0.5 * np.tril(factor_bar)
    diagonal_of(half)[...] *= 0.5
    return lower_transposed_times(L_inv, times_lower(half + half.T, L_inv))
