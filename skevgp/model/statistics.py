"""Two passes over the rows: the sufficient statistics of a sparse GP with explicit features, and their pull-back.

Everything the model learns from the data goes through a few sums over rows (Titsias 2009 with
explicit features, Rasmussen & Williams 2006 section 2.7). Rows are whitened inside each block, V = L⁻¹ k(X_m, X),
*before* they are summed: summing k(X_m, X) k(X, X_m) and whitening afterwards loses all digits when the signal is
1e6 times the noise or more.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from ..data.blocks import AnyBlock, Block, Blocks
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

_ROUNDING = 4.0 * np.finfo(float).eps
# Relative to the diagonal: above rounding, and below any jitter.
_NO_JITTER = 1e-13


class KernelAt(Protocol):
    """A covariance function of unit signal variance with its hyperparameters and inducing points put in."""

    def matrix(self) -> np.ndarray:
        """k(X_m, X_m), from exact differences, of shape (m, m)."""

    def cross(self, prepared: Any) -> np.ndarray:
        """k(X_m, X) of shape (m, n), for rows that `Kernel.prepare` has seen."""

    def diagonal(self, prepared: Any) -> np.ndarray | float:
        """k(x, x) of each row, of shape (n,), or one number for all."""

    def start_pullback(self) -> Any:
        """An empty sum for `finish_pullback`."""

    def cross_pullback(self, prepared: Any, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: np.ndarray | float) -> Any:
        """What one block adds, by ``+``, to the sum for `finish_pullback`; may overwrite ``U_bar``.

        ``diagonal_bar`` is the gradient in each k(x, x), (n,), or one number for all.
        """

    def finish_pullback(self, total: Any, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradients in the hyperparameters (n_hyper,) and the inducing points (m, d), of the rows and of `matrix`."""


class Kernel(Protocol):
    """A covariance function of unit signal variance, k̃."""

    @property
    def n_hyperparameters(self) -> int:
        """How many hyperparameters there are."""

    def prepare(self, inputs: np.ndarray) -> Any:
        """What `KernelAt` needs of rows (n, d), computed once."""

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        """k(x, x') of rows in pairs, (..., d) and (..., d): (...)."""

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> KernelAt:
        """The covariance with hyperparameters (n_hyper,) and inducing points (m, d) put in."""


@dataclass(frozen=True)
class Whitening:
    """K = k(X_m, X_m) = L Lᵀ at one set of inducing points, and what it makes of rows: V = L⁻¹ k(X_m, X).

    Attributes
    ----------
    covariance : KernelAt
        With m inducing points.
    L, L_inv : ndarray of shape (m, m)
        Lower Cholesky factor of K (with a jitter), and its inverse.
    """

    covariance: Any
    L: np.ndarray
    L_inv: np.ndarray

    @classmethod
    def of(
        cls, kernel: Kernel, hyperparameters: np.ndarray, inducing_points: np.ndarray, jitter: Jitter = JITTER
    ) -> Whitening:
        """At hyperparameters (n_hyper,) and inducing points (m, d)."""
        covariance = kernel.at(np.log(hyperparameters), inducing_points)
        L = cholesky_of_covariance(covariance.matrix(), jitter)
        return cls(covariance, L, triangular_inverse(L))

    def jitter(self) -> float:
        """The most that was added to the diagonal of K; 0 if it is rounding."""
        return float(self._added()[0].max(initial=0.0))

    def _added(self) -> tuple[np.ndarray, np.ndarray]:
        """What was added to the diagonal of K, 0 where it is rounding, and the diagonal as it was."""
        diagonal = np.diagonal(self.covariance.matrix())
        added = np.einsum("ij,ij->i", self.L, self.L) - diagonal
        return np.where(added > _NO_JITTER * diagonal, added, 0.0), diagonal

    def project(self, prepared: Any, out: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """U = k(X_m, X) and V = L⁻¹ U, both (m, n), of rows that `Kernel.prepare` has seen; V is put into ``out``."""
        U = self.covariance.cross(prepared)
        return U, triangular_product(self.L_inv, U, np.empty(U.shape) if out is None else out)

    def solve(self, prepared: Any, out: np.ndarray) -> np.ndarray:
        """V = L⁻¹ k(X_m, X) as of `project`, into ``out`` (m, n), by a triangular solve.

        With small pivots it keeps one or two digits more of k(x, x) - |v|² than the product with L⁻¹ (Higham 2002,
        section 14.1), so it is what predicts. (Sums over rows take the product: BLAS lets no other thread run.)
        """
        out[...] = self.covariance.cross(prepared)
        triangular_solve(self.L, out)
        return out

    def unexplained(self, prepared: Any, V: np.ndarray, roots: np.ndarray | None = None) -> np.ndarray:
        """k(x, x) - |v|² of each row, (n,): what the inducing points leave of its variance, clipped at 0.

        If columns of V have been multiplied by ``roots`` (n,), that times their squares.
        """
        variance = self.covariance.diagonal(prepared)
        if roots is not None:
            variance = variance * roots**2
        left = variance - np.einsum("mn,mn->n", V, V)
        # What is left of a row that is an inducing point is rounding. (Subtracted from each row, it would be a bias, in
        # the bound N s²/σ² times as large.)
        np.putmask(left, left < _ROUNDING * variance, 0.0)
        return left

    def remaining(self, prepared: Any, V: np.ndarray) -> np.ndarray:
        """k(x, x) - |v|² of each row, (n,), for a prediction: never below its rounding error.

        |v|² is known to a few units in the last place of k(x, x). A smaller difference cannot be told from 0.
        """
        variance = self.covariance.diagonal(prepared)
        return np.maximum(variance - np.einsum("mn,mn->n", V, V), _ROUNDING * variance)

    def pull_back(self, rows_bar: Any, factor_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradients in the hyperparameters (their logarithms) and X_m, of those in the rows (`pull_back`) and Lᵀ L̄."""
        K_bar = cholesky_pullback(self.L_inv, factor_bar)
        # A jitter is a share of the diagonal, and moves with it. (The bound of a diagonal q has its logarithm.)
        added, diagonal = self._added()
        diagonal_of(K_bar)[...] *= 1.0 + np.divide(added, diagonal, out=np.zeros_like(added), where=diagonal > 0.0)
        return self.covariance.finish_pullback(rows_bar, K_bar)


@dataclass(frozen=True)
class SufficientStatistics:
    """Sums over rows; V = L⁻¹ k(X_m, X) is whitened for a kernel of unit signal variance.

    Where rows have weights w and relative noise variances v, each product has the factor ω = w / v, row by row.

    Attributes
    ----------
    n_rows : float
        N, or Σ w; less than there were, once earlier rows have been forgotten in part.
    VV : ndarray of shape (m, m)
        V Vᵀ.
    VH : ndarray of shape (m, p)
        V H.
    VR : ndarray of shape (m, o)
        V r for each output.
    HH : ndarray of shape (p, p)
        HᵀH.
    HR : ndarray of shape (p, o)
        Hᵀr.
    RR : ndarray of shape (o,)
        rᵀr.
    unexplained : float
        The sum over rows of k(x, x) - |v|², each clipped at 0.
    log_variance, surplus : float
        As of `LinearSums`.
    """

    n_rows: float
    VV: Any
    VH: Any
    VR: Any
    HH: np.ndarray
    HR: np.ndarray
    RR: np.ndarray
    unexplained: Any
    log_variance: float
    surplus: float

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
        """Each sum times ``factor``: a past that fades."""
        return SufficientStatistics(*(factor * getattr(self, field.name) for field in fields(self)))


@dataclass(frozen=True)
class StatisticsGradient:
    """Gradients of a scalar in the statistics of these names.

    ``VE`` multiplies V e, not V r; ``factor`` is Lᵀ L̄, with L̄ the gradient in L itself, as of `cholesky_pullback`.
    """

    VV: np.ndarray
    VH: np.ndarray
    VE: np.ndarray
    unexplained: float
    factor: np.ndarray


@dataclass(frozen=True)
class Residuals:
    """What the mean of q leaves over, e = r - [V; Hᵀ]ᵀ weights, summed over rows.

    Attributes
    ----------
    squares : ndarray of shape (o,)
        eᵀe of each output.
    VE : ndarray of shape (m, o)
        V e of each output.
    HE : ndarray of shape (p, o), optional
        Hᵀe, where no gradient was asked for.
    """

    squares: np.ndarray
    VE: np.ndarray
    HE: np.ndarray | None = None


@dataclass(frozen=True)
class _FirstPass:
    """Block -> V Vᵀ, V [H, r] and Σ max(k(x, x) - |v|², 0)."""

    whitening: Whitening
    outputs: slice

    def __call__(self, block: AnyBlock) -> tuple[np.ndarray, np.ndarray, float]:
        block, outputs = block.of(self.outputs)
        U, P = _projected(block, self.whitening, outputs)
        block.kept = (self.whitening, U, P) if block.may_keep else None
        V, linear = P[: len(U)], P[len(U) :]
        return V @ V.T, V @ linear.T, self.whitening.unexplained(block.prepared, V, block.roots).sum()


def _projected(block: Block, whitening: Whitening, outputs: slice) -> tuple[np.ndarray, np.ndarray]:
    """U (m, n), and [V; Hᵀ; rᵀ] √Ω of shape (m + p + o, n): one array, which one product multiplies."""
    linear, m = block.linear_of(outputs), len(whitening.L)
    P = np.empty((m + linear.shape[1], len(linear)))
    U, V = whitening.project(block.prepared, out=P[:m])
    if block.roots is not None:
        V *= block.roots
    P[m:] = linear.T
    return U, P


def _put_errors(block: Block, P: np.ndarray, outputs: slice, weights: np.ndarray) -> np.ndarray:
    """What the weights leave over, eᵀ (o, n), which takes the place of rᵀ in [V; Hᵀ; rᵀ]."""
    e = P[len(weights) :]
    return np.subtract(block.residuals[:, outputs].T, weights.T @ P[: len(weights)], out=e)


@dataclass(frozen=True)
class _Errors:
    """Block -> eᵀe of each output, V e and Hᵀe."""

    whitening: Whitening
    outputs: slice
    weights: np.ndarray

    def __call__(self, block: AnyBlock) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        block, outputs = block.of(self.outputs)
        U, P = _projected(block, self.whitening, outputs)
        e = _put_errors(block, P, outputs, self.weights)
        m, PE = len(U), P[: len(self.weights)] @ e.T
        return np.einsum("on,on->o", e, e), PE[:m], PE[m:]


@dataclass(frozen=True)
class _SecondPass:
    """Block -> what it adds to the kernel's pull-back, eᵀe of each output and V e.

    Ū = back [V; Hᵀ; eᵀ] Ω: the m-sized products came first.
    """

    whitening: Whitening
    outputs: slice
    back: np.ndarray
    unexplained_bar: float
    weights: np.ndarray

    def __call__(self, block: AnyBlock) -> tuple[Any, np.ndarray, np.ndarray]:
        block, outputs = block.of(self.outputs)
        # It stays until the next first pass replaces it: all of it, let go, would be given back to the system.
        if block.kept is not None and block.kept[0] is self.whitening:
            _, U, P = block.kept
        else:
            U, P = _projected(block, self.whitening, outputs)
        e = _put_errors(block, P, outputs, self.weights)
        U_bar, weights = self.back @ P, 1.0 if block.roots is None else block.roots**2
        if block.roots is not None:
            U_bar *= block.roots
        diagonal_bar = self.unexplained_bar * weights
        rows_bar = self.whitening.covariance.cross_pullback(block.prepared, U, U_bar, diagonal_bar)
        return rows_bar, np.einsum("on,on->o", e, e), P[: len(U)] @ e.T


def collect(blocks: Blocks, whitening: Whitening, outputs: slice) -> SufficientStatistics:
    """First pass over the rows.

    Parameters
    ----------
    blocks : Blocks
        Of the rows.
    whitening : Whitening
    outputs : slice
        Which of their outputs count.

    Returns
    -------
    statistics : SufficientStatistics
    """
    sums = blocks.linear
    HH, HR, RR = sums.of(outputs)
    VV, VL, unexplained = blocks.sum(_FirstPass(whitening, outputs))
    p = len(HH)
    return SufficientStatistics(
        sums.n_rows,
        VV,
        VL[:, :p],
        VL[:, p:],
        HH,
        HR,
        RR,
        float(unexplained),
        sums.log_variance,
        sums.surplus,
    )


def errors(blocks: Blocks, whitening: Whitening, outputs: slice, weights: np.ndarray) -> Residuals:
    """What weights (m + p, o) leave over, row by row: a pass without a gradient; arguments as of `pull_back`."""
    return Residuals(*blocks.sum(_Errors(whitening, outputs, weights)))


def pull_back(
    blocks: Blocks,
    whitening: Whitening,
    outputs: slice,
    statistics: SufficientStatistics,
    gradient: StatisticsGradient,
    weights: np.ndarray,
) -> tuple[tuple[np.ndarray, np.ndarray], Residuals]:
    """Second pass over the rows: gradients of a scalar in the statistics -> in the hyperparameters and X_m.

    With Ḡ the given gradients, V̄ = (Ḡ_VV + Ḡ_VVᵀ - 2 ḡ_unexplained I) V + Ḡ_VH Hᵀ + Ḡ_VE eᵀ, Ū = L⁻ᵀ V̄ and
    L̄ = Ḡ_L - tril(L⁻ᵀ V̄ Vᵀ), so that Lᵀ L̄ = Lᵀ Ḡ_L - V̄ Vᵀ (in the lower triangle), where V̄ Vᵀ comes from the sums.
    (The clipping of the unexplained variance acts only at the level of rounding and is left out.)

    Parameters
    ----------
    blocks, whitening, outputs
        As in `collect`.
    statistics : SufficientStatistics
        What `collect` returned.
    gradient : StatisticsGradient
    weights : ndarray of shape (m + p, o)
        e = r - [V; Hᵀ]ᵀ weights, computed row by row: no digits cancel at any signal-to-noise ratio.

    Returns
    -------
    gradients : (ndarray of shape (n_hyper,), ndarray of shape (m, d))
        In the logarithms of the hyperparameters, and in X_m.
    residuals : Residuals
    """
    symmetric = gradient.VV + gradient.VV.T
    diagonal_of(symmetric)[...] -= 2.0 * gradient.unexplained
    back = lower_transposed_times(whitening.L_inv, np.hstack([symmetric, gradient.VH, gradient.VE]))
    second = _SecondPass(whitening, outputs, back, gradient.unexplained, weights)
    rows_bar, squares, VE = blocks.sum(second)
    VbarV = symmetric @ statistics.VV + gradient.VH @ statistics.VH.T + gradient.VE @ VE.T
    return whitening.pull_back(rows_bar, gradient.factor - VbarV), Residuals(squares, VE)
