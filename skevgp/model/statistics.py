"""Two passes over the rows: the sufficient statistics of a sparse GP with explicit features, and their gradient.

A model learns from the data through a few sums over rows only (Titsias 2009, with the explicit features of Rasmussen &
Williams 2006, section 2.7). Each block of rows is whitened, V = L⁻¹ k(X_m, X), before it is summed. Whitening the sum
of k(X_m, X) k(X, X_m) instead loses all digits if the signal is 1e6 times the noise or more.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property, partial
from typing import Any

import numpy as np

from ..data.blocks import AnyBlock, Block, Blocks
from ..kernels.base import Covariance
from ..utils.linalg import (
    JITTER,
    Jitter,
    cholesky_of_covariance,
    cholesky_pullback,
    diagonal_of,
    lower_transposed_times,
    triangular_inverse,
    triangular_product,
    triangular_solve,
)

# k̃: a covariance function of unit signal variance.
Kernel = Covariance

_ROUNDING = 4.0 * np.finfo(float).eps
# A jitter is larger than this share of the diagonal. A smaller difference is rounding.
_NO_JITTER = 1e-13


@dataclass(frozen=True)
class Whitening:
    """Whitens rows by one set of m inducing points: V = L⁻¹ k(X_m, X), where K = k(X_m, X_m) = L Lᵀ."""

    # The `CovarianceAt` of k̃ at these points. None: there are no points.
    covariance: Any
    # (m, m): the lower Cholesky factor of K, perhaps with a jitter, and its inverse.
    L: np.ndarray
    L_inv: np.ndarray

    @classmethod
    def of(
        cls, kernel: Kernel, hyperparameters: np.ndarray, inducing_points: np.ndarray, jitter: Jitter = JITTER
    ) -> Whitening:
        """The whitening for hyperparameters (n_hyper,) and inducing points (m, d)."""
        covariance = kernel.at(hyperparameters, inducing_points)
        L = cholesky_of_covariance(covariance.matrix(), jitter)
        return cls(covariance, L, triangular_inverse(L))

    def jitter(self) -> float:
        """The largest jitter on the diagonal of K."""
        return float(self._added()[0].max(initial=0.0))

    def _added(self) -> tuple[np.ndarray, np.ndarray]:
        """The jitter on the diagonal of K, and the diagonal without it, both (m,)."""
        diagonal = np.diagonal(self.covariance.matrix())
        added = np.einsum("ij,ij->i", self.L, self.L) - diagonal
        return np.where(added > _NO_JITTER * diagonal, added, 0.0), diagonal

    def times_inverse(self, U: np.ndarray) -> np.ndarray:
        """L⁻¹ U for U (..., m, n)."""
        return self.L_inv @ U

    def times_inverse_transposed(self, U: np.ndarray) -> np.ndarray:
        """L⁻ᵀ U for U (..., m, n)."""
        return self.L_inv.T @ U

    def project(self, prepared: Any, out: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """U = k(X_m, X) and V = L⁻¹ U, both (m, n), for rows from `Kernel.prepare`. V is written to ``out``."""
        U = self.covariance.cross(prepared)
        return U, triangular_product(self.L_inv, U, np.empty(U.shape) if out is None else out)

    def solve(self, prepared: Any, out: np.ndarray) -> np.ndarray:
        """V = L⁻¹ k(X_m, X), written to ``out`` (m, n). Predictions use this, sums over rows use `project`."""
        # With small pivots, a triangular solve keeps one or two digits more of k(x, x) - |v|² than the product with L⁻¹
        # (Higham 2002, section 14.1). But while BLAS solves, SciPy lets no other thread run.
        out[...] = self.covariance.cross(prepared)
        triangular_solve(self.L, out)
        return out

    def unexplained(self, prepared: Any, V: np.ndarray, roots: np.ndarray | None = None) -> np.ndarray:
        """The variance k(x, x) - |v|² (n,) that the inducing points do not explain, clipped at 0.

        If the columns of V were multiplied by ``roots`` (n,), the result is multiplied by their squares.
        """
        variance = self.covariance.diagonal(prepared)
        if roots is not None:
            variance = variance * roots**2
        left = variance - np.einsum("mn,mn->n", V, V)
        # If a row is an inducing point, this difference is rounding error. Only such rows are set to 0: subtracting the
        # rounding error from each row would bias the bound by N s²/σ² times as much.
        np.putmask(left, left < _ROUNDING * variance, 0.0)
        return left

    def remaining(self, prepared: Any, V: np.ndarray) -> np.ndarray:
        """The same variance k(x, x) - |v|² (n,) for a prediction, clipped at its rounding error."""
        # |v|² is known to a few units in the last place of k(x, x). A smaller difference cannot be told from 0.
        variance = self.covariance.diagonal(prepared)
        return np.maximum(variance - np.einsum("mn,mn->n", V, V), _ROUNDING * variance)

    def pull_back(self, rows_bar: Any, factor_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradients in the log hyperparameters (n_hyper,) and in X_m (m, d).

        ``rows_bar`` is the kernel's sum over rows (see `pull_back`). ``factor_bar`` is Lᵀ L̄ (m, m).
        """
        K_bar = cholesky_pullback(self.L_inv, factor_bar)
        # A jitter is a share of the diagonal and changes with it. (The bound of a diagonal q contains its logarithm.)
        added, diagonal = self._added()
        diagonal_of(K_bar)[...] *= 1.0 + np.divide(added, diagonal, out=np.zeros_like(added), where=diagonal > 0.0)
        return self.covariance.finish_pullback(rows_bar, K_bar)


@dataclass(frozen=True)
class SufficientStatistics:
    """Sums over rows, for m inducing points, p features and o outputs. ``+`` adds the sums of two sets of rows.

    If rows have weights w and relative noise variances v, each product has the factor ω = w / v of its row.
    """

    # N, or Σ w. Forgetting earlier rows makes it smaller.
    n_rows: float
    # V Vᵀ (m, m), V H (m, p) and V r (m, o), where V is whitened for a kernel of unit signal variance.
    VV: Any
    VH: Any
    VR: Any
    # HᵀH (p, p), Hᵀr (p, o) and rᵀr (o,).
    HH: np.ndarray
    HR: np.ndarray
    RR: np.ndarray
    # Σ (k(x, x) - |v|²), each term clipped at 0.
    unexplained: Any
    # Σ w log v and Σ max(ω, 1) - Σ w, as in `LinearSums`.
    log_variance: float
    surplus: float
    # (2, o): Σ ŵ log(1 + x) and Σ ŵ x / (1 + x), ŵ = max(w, 1), x = (s²/σ²) (k(x, x) - |v|²) ω / ŵ, for the tight bound
    # at one signal and noise variance (see `BoundAtOptimum`). 0 for the bound of Titsias (2009).
    charge: Any = 0.0

    @cached_property
    def joint(self) -> np.ndarray:
        """[V; Hᵀ] [Vᵀ, H], (m + p, m + p)."""
        m, p = self.VH.shape
        joint = np.empty((m + p, m + p))
        joint[:m, :m], joint[:m, m:], joint[m:, m:] = self.VV, self.VH, self.HH
        joint[m:, :m] = self.VH.T
        return joint

    def __add__(self, other: SufficientStatistics) -> SufficientStatistics:
        return SufficientStatistics(*(getattr(self, field.name) + getattr(other, field.name) for field in fields(self)))

    def scaled(self, factor: float) -> SufficientStatistics:
        """Each sum times ``factor``, so that earlier rows count less."""
        return SufficientStatistics(*(factor * getattr(self, field.name) for field in fields(self)))


@dataclass(frozen=True)
class StatisticsGradient:
    """Gradients of a scalar in the statistics."""

    # (m, m) and (m, p): gradients in V Vᵀ and V H.
    VV: np.ndarray
    VH: np.ndarray
    # (m, o): the gradient in V e, where e = r - [V; Hᵀ]ᵀ weights.
    VE: np.ndarray
    # The gradient in Σ (k(x, x) - |v|²). With ``ratio``, that of a row is multiplied by its slope (see `_charge`).
    unexplained: float
    # (m, m): Lᵀ L̄, where L̄ is the gradient in L itself (see `cholesky_pullback`).
    factor: np.ndarray
    # (o,): s²/σ² n/N of each output, for the tight bound.
    ratio: np.ndarray | None = None


@dataclass(frozen=True)
class Residuals:
    """Sums over rows of the residuals e = r - [V; Hᵀ]ᵀ weights, where weights (m + p, o) are the mean of q."""

    # (o,) and (m, o): eᵀe and V e of each output.
    squares: np.ndarray
    VE: np.ndarray
    # (p, o): Hᵀe. None after the second pass.
    HE: np.ndarray | None = None


# --- passes over the rows ---------------------------------------------------------------------------------------------


def collect(
    blocks: Blocks, whitening: Whitening, outputs: slice, ratio: np.ndarray | None = None
) -> SufficientStatistics:
    """The sufficient statistics of some outputs: the first pass over the rows.

    ``ratio`` (o,) is s²/σ² of each output, for the tight bound.
    """
    sums = blocks.linear
    HH, HR, RR = sums.of(outputs)
    VV, VL, unexplained, charge = blocks.sum(partial(_first_pass, whitening, outputs, ratio))
    p = len(HH)
    return SufficientStatistics(
        n_rows=sums.n_rows,
        VV=VV,
        VH=VL[:, :p],
        VR=VL[:, p:],
        HH=HH,
        HR=HR,
        RR=RR,
        unexplained=float(unexplained),
        log_variance=sums.log_variance,
        surplus=sums.surplus,
        charge=charge,
    )


def _first_pass(
    whitening: Whitening, outputs: slice, ratio: np.ndarray | None, block: AnyBlock
) -> tuple[np.ndarray, np.ndarray, float, Any]:
    """V Vᵀ, V [H, r], Σ max(k(x, x) - |v|², 0) and the charge of one block."""
    block, outputs = block.of(outputs)
    U, P = _projected(block, whitening, outputs)
    V, linear = P[: len(U)], P[len(U) :]
    unexplained = whitening.unexplained(block.prepared, V, block.roots)
    charge, slope = (0.0, None) if ratio is None else _charge(ratio, unexplained, block.counts)
    block.kept = (whitening, U, P, slope) if block.may_keep else None
    return V @ V.T, V @ linear.T, unexplained.sum(), charge


def _charge(ratio: np.ndarray, unexplained: np.ndarray, counts: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """The charge (2, o) of rows in the tight bound, and the mean slope (n,) of Σ_o log(1 + x) in each row.

    The slope of an output is 1 / (1 + x). In the mean it has the weight ``ratio`` (o,).
    """
    # (o, n): x of each output and row. ``unexplained`` has the factor ω.
    counts = None if counts is None else np.maximum(counts, 1.0)
    x = np.multiply.outer(ratio, unexplained if counts is None else unexplained / counts)
    slopes = 1.0 / (1.0 + x)
    terms = np.array([np.log1p(x), x * slopes])
    charge = terms.sum(axis=2) if counts is None else terms @ counts
    return charge, ratio @ slopes / ratio.sum()


def _projected(block: Block, whitening: Whitening, outputs: slice) -> tuple[np.ndarray, np.ndarray]:
    """U (m, n), and [V; Hᵀ; rᵀ] √Ω (m + p + o, n) in one array, so that one product serves all sums."""
    linear, m = block.linear_of(outputs), len(whitening.L)
    P = np.empty((m + linear.shape[1], len(linear)))
    U, V = whitening.project(block.prepared, out=P[:m])
    if block.roots is not None:
        V *= block.roots
    P[m:] = linear.T
    return U, P


def errors(blocks: Blocks, whitening: Whitening, outputs: slice, weights: np.ndarray) -> Residuals:
    """The residuals e under weights (m + p, o), summed row by row: a pass without a gradient."""
    return Residuals(*blocks.sum(partial(_error_pass, whitening, outputs, weights)))


def _error_pass(
    whitening: Whitening, outputs: slice, weights: np.ndarray, block: AnyBlock
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """eᵀe (o,), V e (m, o) and Hᵀe (p, o) of one block."""
    block, outputs = block.of(outputs)
    U, P = _projected(block, whitening, outputs)
    m, k = len(U), len(weights)
    # eᵀ (o, n) replaces rᵀ in [V; Hᵀ; rᵀ].
    e = np.subtract(block.residuals[:, outputs].T, weights.T @ P[:k], out=P[k:])
    PE = P[:k] @ e.T
    return np.einsum("on,on->o", e, e), PE[:m], PE[m:]


def pull_back(
    blocks: Blocks,
    whitening: Whitening,
    outputs: slice,
    statistics: SufficientStatistics,
    gradient: StatisticsGradient,
    weights: np.ndarray,
) -> tuple[tuple[np.ndarray, np.ndarray], Residuals]:
    """Gradients of a scalar in the log hyperparameters (n_hyper,) and in X_m (m, d): the second pass over the rows.

    ``statistics`` are those of `collect`, and ``gradient`` is the scalar's gradient in them. The residuals e under
    ``weights`` (m + p, o) are summed row by row, so that no digits cancel at any signal-to-noise ratio.
    """
    # With the given gradients Ḡ,
    #
    #     V̄ = (Ḡ_VV + Ḡ_VVᵀ - 2 ḡ_unexplained I) V + Ḡ_VH Hᵀ + Ḡ_VE eᵀ    (m, n)
    #     Ū = L⁻ᵀ V̄ = back [V; Hᵀ; eᵀ]                                     (m, n), back: (m, m + p + o)
    #     L̄ = Ḡ_L - tril(L⁻ᵀ V̄ Vᵀ)                                         (m, m)
    #
    # so that Lᵀ L̄ = Lᵀ Ḡ_L - V̄ Vᵀ in the lower triangle, where V̄ Vᵀ comes from the sums. (Clipping the unexplained
    # variance at 0 changes it by rounding only. Its gradient is left out.)
    #
    # In the tight bound, ḡ_unexplained = ḡ_i differs from row to row: -2 V diag(ḡ) (m, n) takes the place of
    # -2 ḡ V in V̄, so that Ū gets -2 L⁻ᵀ V diag(ḡ), and V̄ Vᵀ gets -2 V diag(ḡ) Vᵀ.
    symmetric = gradient.VV + gradient.VV.T
    if gradient.ratio is None:
        diagonal_of(symmetric)[...] -= 2.0 * gradient.unexplained
    back = lower_transposed_times(whitening.L_inv, np.hstack([symmetric, gradient.VH, gradient.VE]))
    second_pass = partial(_second_pass, whitening, outputs, back, gradient.unexplained, gradient.ratio, weights)
    rows_bar, squares, VE, VgV = blocks.sum(second_pass)
    VbarV = symmetric @ statistics.VV + gradient.VH @ statistics.VH.T + gradient.VE @ VE.T
    return whitening.pull_back(rows_bar, gradient.factor - (VbarV - VgV)), Residuals(squares, VE)


def _second_pass(
    whitening: Whitening,
    outputs: slice,
    back: np.ndarray,
    unexplained_bar: float,
    ratio: np.ndarray | None,
    weights: np.ndarray,
    block: AnyBlock,
) -> tuple[Any, np.ndarray, np.ndarray, Any]:
    """The term of one block in the kernel's gradient, eᵀe (o,), V e (m, o), and 2 V diag(ḡ) Vᵀ for the tight bound."""
    block, outputs = block.of(outputs)
    # Kept arrays stay until the next first pass replaces them: freed memory would be given back to the system.
    if block.kept is not None and block.kept[0] is whitening:
        _, U, P, slope = block.kept
    else:
        U, P = _projected(block, whitening, outputs)
        slope = None
    # eᵀ (o, n) replaces rᵀ in [V; Hᵀ; rᵀ].
    k = len(weights)
    e = np.subtract(block.residuals[:, outputs].T, weights.T @ P[:k], out=P[k:])
    # Ū = back [V; Hᵀ; eᵀ] Ω (m, n). The products of size m are in ``back``.
    U_bar, omega = back @ P, 1.0 if block.roots is None else block.roots**2
    if block.roots is not None:
        U_bar *= block.roots
    diagonal_bar: Any = unexplained_bar * omega
    VgV: Any = 0.0
    if ratio is not None and unexplained_bar != 0.0:
        V = P[: len(U)]
        if slope is None:
            _, slope = _charge(ratio, whitening.unexplained(block.prepared, V, block.roots), block.counts)
        # With V' = V diag(√|2 ḡ|): V' V'ᵀ, a product with its own transpose, costs half of another one.
        root, sign = np.sqrt(np.abs(2.0 * unexplained_bar) * slope), np.sign(unexplained_bar)
        scaled = V * root
        VgV = sign * (scaled @ scaled.T)
        back_of_charge = triangular_product(whitening.L_inv, scaled, np.empty(scaled.shape), transposed=True)
        back_of_charge *= sign * root if block.roots is None else sign * root * block.roots
        U_bar -= back_of_charge
        diagonal_bar = unexplained_bar * slope * omega
    rows_bar = whitening.covariance.cross_pullback(block.prepared, U, U_bar, diagonal_bar)
    return rows_bar, np.einsum("on,on->o", e, e), P[: len(U)] @ e.T, VgV
