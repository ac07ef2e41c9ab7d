"""Cholesky factors with jitter, their pullback, and products with triangular matrices."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

import numpy as np
from scipy.linalg import blas, eigh, lapack

# Largest relative jitter to try.
MAX_JITTER = 1e-2
# Directions with a smaller share of a semi-definite matrix than this are rounding errors.
_NO_DIRECTION = 1e-12
# Pivots of a semi-definite matrix are rounding errors up to the first of these tolerances, if its terms have a diagonal
# of 1. It is raised up to the second while a variance grows by more than the third times the tolerance.
_ROUNDING, _MOST_ROUNDING, _GROWTH = 16.0 * np.finfo(float).eps, 1e-8, 10.0
# Number of rows of a triangular matrix to multiply at once.
_BAND = 48


class NotPositiveDefiniteError(ArithmeticError):
    """No jitter up to `MAX_JITTER` makes the matrix positive definite, or it is not finite."""


@dataclass(frozen=True)
class Jitter:
    """Relative addend to the diagonal of a covariance matrix that is badly conditioned."""

    size: float = 1e-12  # k(X_m, X_m) from exact differences is accurate to about m times 1e-16
    well_conditioned: float = 1e-6  # no jitter if every pivot is above this share of its diagonal entry


JITTER = Jitter()


def cholesky_of_covariance(K: np.ndarray, jitter: Jitter) -> np.ndarray:
    """Return the lower Cholesky factor of a covariance matrix, with jitter only if it is badly conditioned."""
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
    """Return the lower Cholesky factor (n, n) of a symmetric matrix plus the smallest sufficient jitter."""
    # jitter is relative to the diagonal (which must not be negative), or to sizes (n,): for a difference of two
    # matrices, the diagonal of the first. It is always added, and raised by factors of ten, from at least 1e-15, while
    # the factorisation fails. Only the lower triangle of matrix is read.
    diagonal = diagonal_of(matrix)
    while True:
        shifted = matrix.copy()
        if jitter > 0.0:
            # An entry of 0 (a linear kernel at the origin) gets the jitter of a very small entry.
            own = diagonal if sizes is None else sizes
            own = own if own.all() else np.where(own == 0.0, 1e-16 * own.max(), own)
            diagonal_of(shifted)[...] += jitter * own
        # LAPACK reads the transpose of a C-contiguous matrix without a copy; its upper factor is our lower one.
        factor, info = lapack.dpotrf(shifted.T, lower=0, clean=1, overwrite_a=1)
        if info == 0 and isfinite(factor.trace()):
            return factor.T
        if not np.isfinite(matrix).all():
            raise NotPositiveDefiniteError("the matrix is not finite")
        jitter = max(10.0 * jitter, 1e-15)
        if jitter > most:
            raise NotPositiveDefiniteError(f"not positive definite with a relative jitter of {most}")


def semidefinite_inverse(matrix: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse (n, n) of a symmetric positive semi-definite matrix.

    Directions that are small next to ``sizes`` (n,), the diagonal without cancellation of terms, are left out.
    """
    by = np.sqrt(np.where(sizes > 0.0, sizes, 1.0))
    values, vectors = np.linalg.eigh(matrix / np.multiply.outer(by, by))
    kept = values > _NO_DIRECTION * max(values.max(initial=0.0), np.finfo(float).tiny)
    root = vectors[:, kept] / np.sqrt(values[kept]) / by[:, np.newaxis]
    return root @ root.T


def covariance_root(covariance: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return a root F (n, n) of a covariance matrix that rounding errors may have made indefinite.

    ``sizes`` (n,) are the diagonal without cancellation of terms. F Fᵀ has the diagonal of the matrix. Its other
    entries differ by rounding errors of sizes.
    """
    factor = _cholesky_root(covariance)
    return _semidefinite_root(covariance, sizes)[0] if factor is None else factor


def nearest_covariance(covariance: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the matrix itself if it has a Cholesky factor, else F Fᵀ of `covariance_root`, with the same diagonal."""
    if _cholesky_root(covariance) is not None:
        return 0.5 * (covariance + covariance.T)
    root, rank = _semidefinite_root(covariance, sizes)
    found: np.ndarray = root[:, :rank] @ root[:, :rank].T
    diagonal_of(found)[...] = diagonal_of(covariance)
    return found


def _semidefinite_root(covariance: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, int]:
    """Return a root (n, n), and the number of its first columns that determine all entries except the diagonal."""
    variances, n = diagonal_of(covariance), len(covariance)
    # Rows are divided by the square roots of sizes, so that all entries have rounding errors of about the same size.
    sizes = np.maximum(sizes, variances)
    by = np.sqrt(np.where(sizes > 0.0, sizes, 1.0))
    scaled = covariance / by
    scaled /= by[:, np.newaxis]
    tol = _ROUNDING
    while tol <= _MOST_ROUNDING:
        found = _pivoted_root(scaled, tol)
        if found is not None:
            root, rank = found
            root *= by[:, np.newaxis]
            return root, rank
        tol *= 10.0
    # The nearest positive semi-definite matrix (Higham 1988, "Computing a nearest symmetric positive semidefinite
    # matrix"). Dropping negative eigenvalues increases the diagonal, so that rows and columns are scaled to keep it.
    values, vectors = eigh(covariance, check_finite=False)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    lengths = np.einsum("ij,ij->i", root, root)
    shrink = np.divide(variances, lengths, out=np.zeros(n), where=lengths > 0.0)
    return root * np.sqrt(shrink)[:, np.newaxis], n


def _pivoted_root(matrix: np.ndarray, tol: float) -> tuple[np.ndarray, int] | None:
    """Return `_semidefinite_root` by pivots above ``tol``, or None if some of these are rounding errors."""
    # The Cholesky factor with complete pivoting ends at the rank r (Higham 2002, section 10.3), after about n r²
    # operations. The Schur complement that is left has no entry above tol. It is replaced by its diagonal.
    n, diagonal = len(matrix), diagonal_of(matrix)
    factor, pivots, rank, _ = lapack.dpstrf(matrix.T, tol=tol, lower=1)
    rank = rank if diagonal.max(initial=0.0) > tol else 0  # LAPACK takes the first pivot whatever its size
    order, columns = pivots - 1, np.tril(factor[:, :rank])
    own = diagonal[order]
    grown = np.einsum("ij,ij->i", columns, columns) - own
    # A pivot that is a rounding error makes other rows grow.
    if not grown.max(initial=0.0) <= _GROWTH * tol:  # True if there is a NaN
        return None
    # Rows that grew keep their variance. They are scaled if they grew by the rounding errors of a sum. Otherwise each
    # entry is at most what the entries before it leave.
    little = (grown > 0.0) & (grown <= n * np.finfo(float).eps * own)
    columns[little] *= np.sqrt(own[little] / (own[little] + grown[little]))[:, np.newaxis]
    much = (grown > 0.0) & ~little
    squares = columns[much] ** 2
    most = np.maximum(own[much, np.newaxis] - (np.cumsum(squares, axis=1) - squares), 0.0)
    columns[much] = np.copysign(np.sqrt(np.minimum(squares, most)), columns[much])
    root = np.zeros((n, n))
    root[order, :rank] = columns
    root[order[rank:], np.arange(rank, n)] = np.sqrt(np.maximum(-grown[rank:], 0.0))
    return root, rank


def _cholesky_root(covariance: np.ndarray) -> np.ndarray | None:
    factor, info = lapack.dpotrf(covariance.T, lower=0, clean=1)
    return factor.T if info == 0 and isfinite(factor.trace()) else None


def diagonal_of(matrix: np.ndarray) -> np.ndarray:
    """Return a view of the diagonal of a matrix (n, n)."""
    if matrix.flags.c_contiguous:
        return matrix.reshape(-1)[:: len(matrix) + 1]
    return np.einsum("ii->i", matrix)


def triangular_inverse(L: np.ndarray) -> np.ndarray:
    """Return the inverse X of a lower triangular L, with a small left residual X L - I."""
    # The inverse is explicit because it then multiplies whole blocks of rows in one matrix product. Rows are whitened
    # by X U with U = L V, so that the distance of X L from the identity matters. LAPACK's method for a *lower* matrix
    # bounds it by |X| |L| (Higham 2002, section 14.2). Its method for an upper matrix, on the transpose, bounds L X - I
    # instead; X L - I is then larger by the condition of L, which is 1e6 if there is little noise.
    return lapack.dtrtri(L, lower=1)[0] if len(L) else L.copy()


def triangular_product(L: np.ndarray, B: np.ndarray, out: np.ndarray, transposed: bool = False) -> np.ndarray:
    """Write L B, or Lᵀ B, to ``out`` for a lower triangular L, by bands of rows without most of its zeros."""
    # BLAS has a product for this, but SciPy holds the lock of the interpreter meanwhile, so that no other thread runs.
    for first in range(0, len(L), _BAND):
        end = first + _BAND
        if transposed:
            np.matmul(L[first:, first:end].T, B[first:], out=out[first:end])
        else:
            np.matmul(L[first:end, :end], B[:end], out=out[first:end])
    return out


def times_lower(A: np.ndarray, L: np.ndarray, transposed: bool = False) -> np.ndarray:
    """Return A L, or A Lᵀ, for A (k, n) and a lower triangular L (n, n), at half the cost of a full product."""
    # BLAS reads C-contiguous matrices as their transposes, without a copy. Use it for m-sized products, not for blocks
    # of rows in threads: see `triangular_product`.
    return blas.dtrmm(1.0, L.T, A.T, trans_a=int(transposed)).T if A.size else A.copy()


def lower_transposed_times(L: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return Lᵀ B (n, k), for a lower triangular L (n, n) and B (n, k), in the way of `times_lower`."""
    return blas.dtrmm(1.0, L.T, B.T, side=1, trans_a=1).T if B.size else B.copy()


def triangular_solve(L: np.ndarray, B: np.ndarray) -> None:
    """Overwrite B by L⁻¹ B, for a lower triangular L and a C-contiguous B."""
    # BLAS reads and writes transposes without a copy: X Lᵀ = Bᵀ.
    if B.size and B.shape[1] == 1:
        blas.dtrsv(L.T, B[:, 0], trans=1, overwrite_x=1)
    elif B.size:
        blas.dtrsm(1.0, L.T, B.T, side=1, overwrite_b=1)


def symmetric_inverse(L_inv: np.ndarray) -> np.ndarray:
    """Return (L Lᵀ)⁻¹ from L⁻¹."""
    if not len(L_inv):
        return L_inv.copy()
    # LAPACK computes the lower triangle, with a third of the operations of a symmetric product. The upper one is that
    # of L⁻¹, which is 0.
    half = lapack.dlauum(L_inv, lower=1)[0]
    inverse: np.ndarray = np.add(half, half.T, order="C")
    diagonal_of(inverse)[...] *= 0.5
    return inverse


def cholesky_pullback(L_inv: np.ndarray, factor_bar: np.ndarray) -> np.ndarray:
    """Pull a gradient back through L = cholesky(K): returns the symmetric K̄ (n, n) from L⁻¹ and Lᵀ L̄."""
    # K̄ = ½ L⁻ᵀ S L⁻¹, where S is symmetric and equals Lᵀ L̄ below its diagonal (Murray 2016, "Differentiation of the
    # Cholesky decomposition", equation 10, symmetrised). With L̄ the gradient of a scalar in the factor, factor_bar is
    # Lᵀ L̄, of which the lower triangle is read; it does not depend on L̄ above the diagonal. If L̄ is L⁻ᵀ A, factor_bar
    # is A. For symmetric dK, d scalar = sum(K̄ * dK).
    half = 0.5 * np.tril(factor_bar)
    diagonal_of(half)[...] *= 0.5
    return lower_transposed_times(L_inv, times_lower(half + half.T, L_inv))
