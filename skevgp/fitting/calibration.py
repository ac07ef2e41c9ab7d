"""The noise variance under which rows that were left out are as far off as their predictions say.

The bound counts every row as new knowledge. Rows of a trajectory are alike, and what a sparse model cannot represent is
alike in all of them: the noise that the bound likes best, and with it the standard deviation of predictions, is then
too small for new trajectories. Here blocks of consecutive rows are left out one after the other (Rasmussen & Williams
2006, section 5.4.2: cross-validation, of which leaving out single rows is the finest), with kernel and inducing points
as they are, and each output's noise variance is set so that

    φ(σ²) = mean over all rows of r² / (latent variance + σ² v) = 1,

where the error r and the latent variance of a row are those of the optimal q without the row's block, for that σ²; v is
its relative noise variance, and it counts as often in the mean as its weight says.
(It may fall as well: what inducing points cannot represent is noise to the bound, while predictions count it twice.)

Without a block the sufficient statistics are sums over the other blocks. (They are summed, not subtracted: what only
one block knows is then exactly unknown without it.) With B₀ = I + σ₀⁻² PᵀP = L Lᵀ of these (see `bounds`), and the
eigenvalues λ and eigenvectors U of L⁻¹ L⁻ᵀ,

    B(σ²) = I + σ⁻² PᵀP = L U diag(λ + (σ₀²/σ²) (1 - λ)) Uᵀ Lᵀ,

so that one pass over the rows in the coordinates (L U)⁻¹ P gives φ on a whole grid of noise variances.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate, pairwise
from operator import add

import numpy as np
from scipy.linalg import block_diag, eigh

from ..inference.bounds import (
    BoundAtOptimum,
    Group,
    PosteriorFamily,
    log_variances,
    optimal_posterior,
    projected,
)
from ..inference.model import SparseModel
from ..inference.statistics import SufficientStatistics, collect
from ..optimizers.parameters import Values
from ..rows.blocks import Block, Blocks
from ..rows.internal import Rows
from ..rows.threads import BlockMap

# Noise variances at which φ is computed. Between them log φ is nearly linear in log σ²: the root is good to a per cent.
_GRID = 64
# The highest noise variance that is tried, and the lowest, in squared units of what the features leave over.
_HIGHEST, _LOWEST = 1e2, 1e-20


@dataclass(frozen=True)
class _LeftOut:
    """The optimal q(ω) of one output without a fold, for each of g noise variances; P = [V; Hᵀ] of a row.

    Attributes
    ----------
    basis : ndarray of shape (m + p, m + p)
        P -> coordinates c.
    mean : ndarray of shape (m + p, g)
        c -> mean of the latent function.
    deviation : ndarray of shape (m + p, m + p), or None
        P -> independent coordinates of the latent function's deviation; None if they are c.
    variances : ndarray of shape (m + p, g)
        Squares of these coordinates -> latent variance, but for what the inducing points do not explain.
    """

    basis: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray | None
    variances: np.ndarray


@dataclass(frozen=True)
class _Scores:
    """Block of a fold -> Σ w r² / (latent variance + σ² v) of each output and noise variance (o, g).

    Attributes
    ----------
    group : Group
    grid : ndarray of shape (o, g)
        Noise variances.
    left_out : list of _LeftOut
        One per output.
    """

    group: Group
    grid: np.ndarray
    left_out: list[_LeftOut]

    def __call__(self, block: Block) -> np.ndarray:
        whitening = self.group.whitening
        _, V = whitening.project(block.prepared)
        if block.roots is not None:
            V *= block.roots
        # Squares and variances of a row have the factor ω = w / v, as in the block's numbers.
        unexplained = whitening.unexplained(block.prepared, V, block.roots)
        w = 1.0 if block.counts is None else block.counts[:, np.newaxis]
        P = np.vstack([V, block.features.T])
        sums = np.empty(self.grid.shape)
        for o, (own, r) in enumerate(zip(self.left_out, block.residuals[:, self.group.outputs].T, strict=True)):
            c = own.basis @ P
            error = r[:, np.newaxis] - c.T @ own.mean
            coordinates = c if own.deviation is None else own.deviation @ P
            latent = (coordinates**2).T @ own.variances + self.group.signal[o] * unexplained[:, np.newaxis]
            sums[o] = (w * error**2 / (latent + w * self.grid[o])).sum(axis=0)
        return sums


def calibrated_noise(
    model: SparseModel,
    values: Values,
    statistics: list[SufficientStatistics],
    rows: Rows,
    limits: np.ndarray,
    n_folds: int,
) -> np.ndarray:
    """The noise variance of each output at which φ first falls to 1, from the lowest that is allowed.

    The lowest is what the model's own rows show, the square of what it leaves over per degree of freedom: blocks that
    have nothing like them among the others are uncertain anyway, and say little of the noise. Where φ is 1 or less
    there, it is the answer.

    Parameters
    ----------
    model : SparseModel
    values : dict
        As in `SparseModel.at_optimum`.
    statistics : list of SufficientStatistics
        Of all rows, for these values.
    rows : Rows
        At least ``n_folds``.
    limits : ndarray of shape (o, 2)
        Of the noise variances.
    n_folds : int
        Blocks of consecutive rows, of nearly equal length; 2 or more.

    Returns
    -------
    noise : ndarray of shape (o,)
    """
    edges = np.linspace(0, len(rows), n_folds + 1).astype(int)
    m, order = values["inducing_points"].shape[1], rows.as_given()
    folds = [
        (rows.part(*ends, 1.0 / n_folds) if order is None else rows.some_of(order[slice(*ends)], 1.0 / n_folds)).blocks(
            model.kernel, m
        )
        for ends in pairwise(edges)
    ]
    noise = np.empty(len(limits))
    for group in model.groups_of(values, statistics):
        bound, (low, high) = BoundAtOptimum(group, model.family), limits[group.outputs].T
        n_rows = group.statistics.n_rows
        # Rows less the trace of I - B⁻¹, the weights that they determine.
        freedom = [n_rows - len(q.B) + np.vdot(q.root_inv, q.root_inv) for q in bound.posteriors]
        left_over = bound.residuals().squares / np.maximum(freedom, 1e-6 * n_rows)
        lowest = np.maximum(np.clip(left_over, low, high), _LOWEST)
        highest = np.maximum(np.minimum(high, _HIGHEST * rows.mean_precision), lowest)
        grid = np.geomspace(lowest, highest, _GRID, axis=1)
        phi = left_out_scores(group, model.family, folds, grid, rows.threads) / n_rows
        noise[group.outputs] = [_first_root(*pair) for pair in zip(grid, phi, strict=True)]
    return noise


def left_out_scores(
    group: Group, family: PosteriorFamily, folds: Sequence[Blocks], grid: np.ndarray, threads: BlockMap
) -> np.ndarray:
    """Σ w r² / (latent variance + σ² v) over the rows of all folds, each predicted from the other folds.

    Parameters
    ----------
    group : Group
        Of o outputs.
    family : {"full", "diagonal"}
    folds : sequence of Blocks
        Two or more.
    grid : ndarray of shape (o, g)
        Noise variances σ².
    threads : BlockMap

    Returns
    -------
    scores : ndarray of shape (o, g)
    """
    total, grids = np.zeros(grid.shape), list(enumerate(grid))
    each = [collect(fold, group.whitening, group.outputs) for fold in folds]
    for fold, others in zip(folds, _sums_of_others(each), strict=True):
        known = replace(group, statistics=others)
        left_out = list(threads(partial(_without_fold, known, family), grids))
        total += fold.sum(_Scores(group, grid, left_out))
    return total


def _sums_of_others(each: Sequence[SufficientStatistics]) -> Iterator[SufficientStatistics]:
    """For each entry of two or more the sum of all others."""
    before, after = list(accumulate(each[:-1])), list(accumulate(reversed(each[1:])))[::-1]
    yield after[0]
    yield from map(add, before, after[1:])
    yield before[-1]


def _without_fold(group: Group, family: PosteriorFamily, output: tuple[int, np.ndarray]) -> _LeftOut:
    """What the statistics of the other folds say of an output, given with its grid (g,) of noise variances."""
    o, grid = output
    L_inv, m = group.whitening.L_inv, len(group.whitening.L)
    scale, reference = group.prior.scale[o], group.prior.reference[o]
    scales, ratio = np.append(np.full(m, np.sqrt(group.signal[o])), scale), group.noise[o] / grid
    q = optimal_posterior(group, o)
    _, Pr = projected(group, o)
    eigenvalues, U = eigh(q.root_inv @ q.root_inv.T, overwrite_a=True, check_finite=False)
    to_basis = U.T @ q.root_inv
    precision = _between(np.clip(eigenvalues, 0.0, 1.0), np.ones(len(U)), ratio)
    mean = (np.outer(to_basis @ Pr, 1.0 / grid) - (to_basis[:, m:] @ reference)[:, np.newaxis]) / precision
    if family == "full":
        return _LeftOut(to_basis * scales, mean, None, 1.0 / precision)
    # In the coordinates (f_m, β), whose precisions are the diagonal of that of q.
    at_prior, at_noise = (np.exp(-np.concatenate(log_variances(B, L_inv))) for B in (np.eye(len(U)), q.B))
    deviation = block_diag(L_inv.T, np.eye(len(scale))) * scales
    return _LeftOut(to_basis * scales, mean, deviation, 1.0 / _between(at_prior, at_noise, ratio))


def _between(at_zero: np.ndarray, at_one: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Precisions (k, g), linear in the ratio (g,) of noise variances; no digits cancel for a ratio below 1."""
    return at_zero[:, np.newaxis] + np.outer(at_one - at_zero, ratio)


def _first_root(grid: np.ndarray, phi: np.ndarray) -> float:
    """Where φ first falls to 1 along a rising grid, by interpolation of the logarithms; the last point if nowhere."""
    low = np.flatnonzero(phi <= 1.0)
    if len(low) == 0 or low[0] == 0:
        return float(grid[-1] if len(low) == 0 else grid[0])
    (first, last), (above, below) = np.log(grid[low[0] - 1 : low[0] + 1]), np.log(phi[low[0] - 1 : low[0] + 1])
    return float(np.exp(first + (last - first) * above / (above - below)))
