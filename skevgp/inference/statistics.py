"""One pass over the rows: the sufficient statistics of a sparse GP with explicit features, and their pull-back.

Everything the model learns from the data goes through a few sums over rows (Titsias 2009 with
explicit features, Rasmussen & Williams 2006 section 2.7). Rows are whitened inside each block, V = L⁻¹ k(X_m, X),
*before* they are summed: summing k(X_m, X) k(X, X_m) and whitening afterwards loses all digits when the signal is
1e6 times the noise or more.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from .._linalg import diagonal_of
from ..rows.blocks import Block, Blocks


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

    def cross_pullback(self, prepared: Any, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: float) -> Any:
        """What one block adds, by ``+``, to the sum for `finish_pullback`; may overwrite ``U_bar``."""

    def finish_pullback(self, total: Any, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradients in the hyperparameters (n_hyper,) and the inducing points (m, d), of the rows and of `matrix`."""


class Kernel(Protocol):
    """A covariance function of unit signal variance, k̃."""

    @property
    def n_hyperparameters(self) -> int:
        """How many hyperparameters there are."""

    def prepare(self, inputs: np.ndarray) -> Any:
        """What `KernelAt` needs of rows (n, d), computed once."""

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> KernelAt:
        """The covariance with hyperparameters (n_hyper,) and inducing points (m, d) put in."""


@dataclass(frozen=True)
class SufficientStatistics:
    """Sums over rows; V = L⁻¹ k(X_m, X) is whitened for a kernel of unit signal variance.

    Attributes
    ----------
    n_rows : float
        N; less than there were, once earlier rows have been forgotten in part.
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
    """

    n_rows: float
    VV: Any
    VH: Any
    VR: Any
    HH: np.ndarray
    HR: np.ndarray
    RR: np.ndarray
    unexplained: Any

    def __add__(self, other: SufficientStatistics) -> SufficientStatistics:
        return SufficientStatistics(*(getattr(self, name) + getattr(other, name) for name in self._fields()))

    def scaled(self, factor: float) -> SufficientStatistics:
        """Each sum times ``factor``: a past that fades."""
        return SufficientStatistics(*(factor * getattr(self, name) for name in self._fields()))

    def outputs(self, columns: slice) -> SufficientStatistics:
        """The statistics of some of the outputs."""
        return SufficientStatistics(
            self.n_rows,
            self.VV,
            self.VH,
            self.VR[:, columns],
            self.HH,
            self.HR[:, columns],
            self.RR[columns],
            self.unexplained,
        )

    @classmethod
    def _fields(cls) -> Iterable[str]:
        return cls.__dataclass_fields__


@dataclass(frozen=True)
class _FirstPass:
    """Block -> V Vᵀ, V [H, r] and Σ max(k(x, x) - |v|², 0)."""

    kernel: KernelAt
    L_inv: np.ndarray

    def __call__(self, block: Block) -> tuple[np.ndarray, np.ndarray, float]:
        U = self.kernel.cross(block.prepared)
        V = self.L_inv @ U
        block.kept = (self.L_inv, U, V) if block.may_keep else None
        unexplained = self.kernel.diagonal(block.prepared) - np.einsum("ij,ij->j", V, V)
        return V @ V.T, V @ block.linear, np.maximum(unexplained, 0.0).sum()


@dataclass(frozen=True)
class _SecondPass:
    """Block -> what it adds to the kernel's pull-back, eᵀe of each output and V e.

    Ū = (L⁻ᵀ symmetric) V + (L⁻ᵀ linear_bar) [H, e]ᵀ: the m-sized products came first.
    """

    kernel: KernelAt
    L_inv: np.ndarray
    from_whitened: np.ndarray
    from_linear: np.ndarray
    unexplained_bar: float
    fitted: np.ndarray | None

    def __call__(self, block: Block) -> tuple[Any, np.ndarray, np.ndarray]:
        if block.kept is not None and block.kept[0] is self.L_inv:
            _, U, V = block.kept
        else:
            U = self.kernel.cross(block.prepared)
            V = self.L_inv @ U
        linear, p, m = block.linear, block.n_features, len(V)
        if self.fitted is not None:
            linear = linear.copy()
            linear[:, p:] -= V.T @ self.fitted[:m]
            linear[:, p:] -= block.features @ self.fitted[m:]
        e = linear[:, p:]
        U_bar = self.from_whitened @ V
        U_bar += self.from_linear @ linear.T
        rows_bar = self.kernel.cross_pullback(block.prepared, U, U_bar, self.unexplained_bar)
        return rows_bar, np.einsum("no,no->o", e, e), V @ e


def collect(rows: Blocks, kernel: KernelAt, L_inv: np.ndarray) -> SufficientStatistics:
    """First pass over the rows.

    Parameters
    ----------
    rows : Blocks
    kernel : KernelAt
        With m inducing points.
    L_inv : ndarray of shape (m, m)
        Inverse of the lower Cholesky factor of k(X_m, X_m).

    Returns
    -------
    statistics : SufficientStatistics
    """
    linear = rows.linear
    VV, VL, unexplained = rows.sum(_FirstPass(kernel, L_inv))
    p = len(linear.HH)
    return SufficientStatistics(
        linear.n_rows, VV, VL[:, :p], VL[:, p:], linear.HH, linear.HR, linear.RR, float(unexplained)
    )


def pull_back(
    rows: Blocks,
    kernel: KernelAt,
    L_inv: np.ndarray,
    statistics: SufficientStatistics,
    VV_bar: np.ndarray,
    VH_bar: np.ndarray,
    VR_bar: np.ndarray,
    unexplained_bar: float,
    fitted: np.ndarray | None = None,
) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray]:
    """Second pass over the rows: gradients of a scalar in the statistics -> in the kernel's rows and in L.

    With Ḡ the given gradients, V̄ = (Ḡ_VV + Ḡ_VVᵀ - 2 ḡ_unexplained I) V + Ḡ_VH Hᵀ + Ḡ_VR rᵀ, Ū = L⁻ᵀ V̄ and
    L̄ = -tril(L⁻ᵀ V̄ Vᵀ), where V̄ Vᵀ comes from the sums. (The clipping of the unexplained variance acts only at
    the level of rounding and is left out.)

    Parameters
    ----------
    rows, kernel, L_inv
        As in `collect`.
    statistics : SufficientStatistics
        What `collect` returned.
    VV_bar, VH_bar, VR_bar, unexplained_bar
        Gradients in the statistics of these names, of the same shapes.
    fitted : ndarray of shape (m + p, o), default=None
        If given, e = r - [V; Hᵀ]ᵀ fitted, computed row by row, takes the place of r.

    Returns
    -------
    rows_bar : object
        For `KernelAt.finish_pullback`.
    L_bar : ndarray of shape (m, m)
        Lower triangular.
    squares : ndarray of shape (o,)
        eᵀe, or rᵀr.
    VE : ndarray of shape (m, o)
        V e, or V r.
    """
    symmetric = VV_bar + VV_bar.T
    diagonal_of(symmetric)[...] -= 2.0 * unexplained_bar
    from_whitened, from_linear = L_inv.T @ symmetric, L_inv.T @ np.hstack([VH_bar, VR_bar])
    rows_bar, squares, VE = rows.sum(_SecondPass(kernel, L_inv, from_whitened, from_linear, unexplained_bar, fitted))
    VbarV = symmetric @ statistics.VV + VH_bar @ statistics.VH.T + VR_bar @ VE.T
    return rows_bar, -np.tril(L_inv.T @ VbarV), squares, VE
