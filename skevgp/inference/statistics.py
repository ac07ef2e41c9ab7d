"""One pass over the rows: the sufficient statistics of a sparse GP with explicit features, and their pull-back.

Everything the model learns from the data goes through a few sums over rows (Titsias 2009 with
explicit features, Rasmussen & Williams 2006 section 2.7). Rows are whitened inside each block, V = L⁻¹ k(X_m, X),
*before* they are summed: summing k(X_m, X) k(X, X_m) and whitening afterwards loses all digits when the signal is
1e6 times the noise or more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from .rows import Block, LinearStatistics

# Blocks keep k(X_m, X) and V for the second pass while they fit in this many bytes; beyond it they are recomputed.
KEEP_BYTES = 128 * 2**20


class KernelAt(Protocol):
    """A covariance function of unit signal variance with its hyperparameters and inducing points put in."""

    def matrix(self) -> np.ndarray:
        """k(X_m, X_m), from exact differences, of shape (m, m)."""

    def cross(self, prepared: Any) -> np.ndarray:
        """k(X_m, X) of shape (m, n), for rows that `Kernel.prepare` has seen."""

    def diagonal(self, prepared: Any) -> np.ndarray | float:
        """k(x, x) of each row, of shape (n,), or one number for all."""

    def start_pullback(self) -> Any:
        """An empty sum for `cross_pullback`."""

    def cross_pullback(self, prepared: Any, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: float) -> Any:
        """What one block adds to the sum; may overwrite ``U_bar``."""

    def finish_pullback(self, total: Any, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradients in the hyperparameters (n_hyper,) and the inducing points (m, d), of the rows and of `matrix`."""


class Kernel(Protocol):
    """A covariance function of unit signal variance, k̃."""

    n_hyperparameters: int

    def prepare(self, inputs: np.ndarray) -> Any:
        """What `KernelAt` needs of rows (n, d), computed once."""

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> KernelAt:
        """The covariance with hyperparameters (n_hyper,) and inducing points (m, d) put in."""

    def traceable_matrices(self, hyperparameters: Any, inducing_points: Any) -> Any:
        """k(X_m, X_m) of shape (g, m, m) for sets of inducing points (g, m, d), in autograd.numpy."""


@dataclass(frozen=True)
class SufficientStatistics:
    """Sums over rows; V = L⁻¹ k(X_m, X) is whitened for a kernel of unit signal variance.

    Attributes
    ----------
    n_rows : float
        N. (A mini-batch is scaled to N rows.)
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
        """Each sum times ``factor``: a mini-batch that stands for more rows, or a past that fades."""
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


def collect(
    blocks: Sequence[Block],
    linear: LinearStatistics,
    kernel: KernelAt,
    L_inv: np.ndarray,
    keep: bool = False,
    map_blocks: Callable[..., Iterator[Any]] = map,
) -> tuple[SufficientStatistics, list[tuple[np.ndarray, np.ndarray] | None]]:
    """First pass over the rows.

    Parameters
    ----------
    blocks : sequence of Block
    linear : LinearStatistics
        Of the same blocks.
    kernel : KernelAt
        With m inducing points.
    L_inv : ndarray of shape (m, m)
        Inverse of the lower Cholesky factor of k(X_m, X_m).
    keep : bool, default=False
        Whether blocks keep (k(X_m, X), V) for `pull_back`, within `KEEP_BYTES`.
    map_blocks : callable, default=map

    Returns
    -------
    statistics : SufficientStatistics
    kept : list with one entry per block
        (U, V), or None where it must be recomputed.
    """
    m, p = len(L_inv), len(linear.HH)
    budget = KEEP_BYTES if keep else 0

    def one(block: Block, keep_this: bool) -> tuple[Any, ...]:
        U = kernel.cross(block.prepared)
        V = L_inv @ U
        unexplained = kernel.diagonal(block.prepared) - np.einsum("ij,ij->j", V, V)
        return V @ V.T, V @ block.linear, np.maximum(unexplained, 0.0).sum(), (U, V) if keep_this else None

    bytes_per_row = 16 * m
    keeps, used = [], 0
    for block in blocks:
        used += bytes_per_row * len(block.linear)
        keeps.append(used <= budget)

    VV, VL, total = np.zeros((m, m)), np.zeros((m, p + linear.HR.shape[1])), 0.0
    kept = []
    for block_VV, block_VL, block_unexplained, block_kept in map_blocks(one, blocks, keeps):
        VV += block_VV
        VL += block_VL
        total += block_unexplained
        kept.append(block_kept)
    return SufficientStatistics(linear.n_rows, VV, VL[:, :p], VL[:, p:], linear.HH, linear.HR, linear.RR, total), kept


def pull_back(
    blocks: Sequence[Block],
    kernel: KernelAt,
    L_inv: np.ndarray,
    statistics: SufficientStatistics,
    kept: Sequence[tuple[np.ndarray, np.ndarray] | None],
    VV_bar: np.ndarray,
    VH_bar: np.ndarray,
    VR_bar: np.ndarray,
    unexplained_bar: float,
    fitted: np.ndarray | None = None,
    map_blocks: Callable[..., Iterator[Any]] = map,
) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray]:
    """Second pass over the rows: gradients of a scalar in the statistics -> in the kernel's rows and in L.

    With Ḡ the given gradients, V̄ = (Ḡ_VV + Ḡ_VVᵀ - 2 ḡ_unexplained I) V + Ḡ_VH Hᵀ + Ḡ_VR rᵀ, Ū = L⁻ᵀ V̄ and
    L̄ = -tril(L⁻ᵀ V̄ Vᵀ), where V̄ Vᵀ comes from the sums. (The clipping of the unexplained variance acts only at
    the level of rounding and is left out.)

    Parameters
    ----------
    blocks, kernel, L_inv, map_blocks
        As in `collect`.
    statistics, kept
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
    m, p = statistics.VH.shape
    symmetric = VV_bar + VV_bar.T
    np.einsum("ii->i", symmetric)[...] -= 2.0 * unexplained_bar
    # Ū = (L⁻ᵀ symmetric) V + (L⁻ᵀ linear_bar) [H, e]ᵀ: the m-sized products come first.
    from_V, from_linear = L_inv.T @ symmetric, L_inv.T @ np.hstack([VH_bar, VR_bar])

    def one(block: Block, block_kept: tuple[np.ndarray, np.ndarray] | None) -> tuple[Any, ...]:
        if block_kept is None:
            U = kernel.cross(block.prepared)
            V = L_inv @ U
        else:
            U, V = block_kept
        linear = block.linear
        if fitted is not None:
            linear = linear.copy()
            linear[:, p:] -= V.T @ fitted[:m]
            linear[:, p:] -= block.features @ fitted[m:]
        e = linear[:, p:]
        U_bar = from_V @ V
        U_bar += from_linear @ linear.T
        return kernel.cross_pullback(block.prepared, U, U_bar, unexplained_bar), np.einsum("no,no->o", e, e), V @ e

    rows_bar, squares, VE = kernel.start_pullback(), np.zeros(VR_bar.shape[1]), np.zeros(VR_bar.shape)
    for block_bar, block_squares, block_VE in map_blocks(one, blocks, kept):
        rows_bar += block_bar
        squares += block_squares
        VE += block_VE
    VbarV = symmetric @ statistics.VV + VH_bar @ statistics.VH.T + VR_bar @ VE.T
    return rows_bar, -np.tril(L_inv.T @ VbarV), squares, VE
