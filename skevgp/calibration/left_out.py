"""Rows that were left out, as the others predict them, for any signal and noise variance: no pass over rows for each.

Of an output let ρ = s²/σ² be the ratio of the two. In the whitened coordinates of `inference.bounds`, with
β = μ_β + C (w₀ + w), the precision of v given w is I + ρ V Vᵀ. With that at one ratio, I + ρ₀ V Vᵀ = L Lᵀ, and the
eigenvalues λ and eigenvectors U of L⁻¹ L⁻ᵀ it is

    I + ρ V Vᵀ = L U D Uᵀ Lᵀ,   D = diag(λ + (ρ/ρ₀) (1 - λ)),

so that in the coordinates z = Uᵀ L⁻¹ v(x) of a row it is diagonal for all ρ. With X = Uᵀ L⁻¹ V H and t = Uᵀ L⁻¹ V r
what is left for w are p-sized matrices,

    precision of w: I + σ⁻² Cᵀ M C,   M = HᵀH - ρ Xᵀ D⁻¹ X,   its linear term: σ⁻² Cᵀ (Hᵀr - ρ Xᵀ D⁻¹ t) - w₀,

and a row is predicted as

    mean: ρ zᵀ D⁻¹ t + a(x)ᵀ C w,   variance: σ² (1 + ρ (zᵀ D⁻¹ z + k̃(x, x) - |v|²)) + a(x)ᵀ C Cov[w] Cᵀ a(x),

with a = h - ρ Xᵀ D⁻¹ z: what the Gaussian process does not explain of the features. But for C all of this is common to
the outputs of a group, and the same trick makes the precision of w diagonal for all σ². Where outputs share w, what the
others know of it takes the place of its prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import accumulate
from operator import add

import numpy as np
from scipy.linalg import eigh

from .._linalg import diagonal_of, jittered_cholesky, triangular_inverse
from ..inference.bounds import Group, PosteriorFamily
from ..inference.statistics import SufficientStatistics, Whitening
from ..rows.blocks import AnyBlock


@dataclass(frozen=True)
class SeenRows:
    """Rows as a set of inducing points and its outputs see them; their sum are the rows of both.

    Attributes
    ----------
    V : ndarray of shape (n, m)
    unexplained : ndarray of shape (n,)
        k(x, x) - |v|².
    features : ndarray of shape (n, p)
    residuals : ndarray of shape (n, o)
    noise : ndarray of shape (n,)
        Of each row, relative to σ².
    counts : ndarray of shape (n,)
        How often it counts.
    """

    V: np.ndarray
    unexplained: np.ndarray
    features: np.ndarray
    residuals: np.ndarray
    noise: np.ndarray
    counts: np.ndarray

    def __add__(self, other: SeenRows) -> SeenRows:
        each = (np.concatenate([getattr(self, field.name), getattr(other, field.name)]) for field in fields(self))
        return SeenRows(*each)


@dataclass(frozen=True)
class Seen:
    """Block -> `SeenRows`."""

    whitening: Whitening
    outputs: slice

    def __call__(self, block: AnyBlock) -> SeenRows:
        block, outputs = block.of(self.outputs)
        _, V = self.whitening.project(block.prepared)
        unexplained = self.whitening.unexplained(block.prepared, V)
        features, residuals, counts = block.features, block.residuals[:, outputs], np.ones(len(unexplained))
        if block.roots is None or block.counts is None:
            return SeenRows(V.T, unexplained, features, residuals, counts, counts)
        roots = block.roots[:, np.newaxis]
        return SeenRows(
            V.T, unexplained, features / roots, residuals / roots, block.counts / block.roots**2, block.counts
        )


@dataclass(frozen=True)
class Weights:
    """What is known of w: its precision (p, p), and that times its mean (p,)."""

    precision: np.ndarray
    linear: np.ndarray

    def __add__(self, other: Weights) -> Weights:
        return Weights(self.precision + other.precision, self.linear + other.linear)


@dataclass(frozen=True)
class _AtRatio:
    """What is common to outputs: known ρ zᵀ D⁻¹ t (n, o), a (n, p), variance in units of σ² (n,), and M and its row."""

    known: np.ndarray
    features: np.ndarray
    variance: np.ndarray
    M: np.ndarray
    Mr: np.ndarray


@dataclass(frozen=True)
class _WeightsAtRatio:
    """Of an output, in coordinates in which the precision of w is diagonal for all σ².

    Attributes
    ----------
    ratio : float
    beside : Weights
        What is known of w beside the output's own data.
    eigenvalues : ndarray of shape (p,)
        As λ of the module's text, with the fitted noise as reference.
    coordinates : ndarray of shape (n, p)
        Of the rows.
    told, known : ndarray of shape (p,)
        The linear terms, of the output's own data in units of σ⁻², and of what is known beside.
    """

    ratio: float
    beside: Weights
    eigenvalues: np.ndarray
    coordinates: np.ndarray
    told: np.ndarray
    known: np.ndarray


class LeftOut:
    """One fold of rows and what the other folds say of it.

    Parameters
    ----------
    group : Group
        With the statistics of the other folds.
    family : {"full", "diagonal"}
    rows : SeenRows
        Of the fold.
    """

    def __init__(self, group: Group, family: PosteriorFamily, rows: SeenRows):
        self.group, self.rows, statistics = group, rows, group.statistics
        self._ratio = float(np.max(group.signal / group.noise))
        B = self._ratio * statistics.VV
        diagonal_of(B)[...] += 1.0
        root_inv = triangular_inverse(jittered_cholesky(B))
        eigenvalues, U = eigh(root_inv @ root_inv.T, overwrite_a=True, check_finite=False)
        self._eigenvalues = np.clip(eigenvalues, 0.0, 1.0)
        basis = U.T @ root_inv
        self._Z, self._X, self._T = rows.V @ basis.T, basis @ statistics.VH, basis @ statistics.VR
        # Of both families: squares, and precisions as at_zero + ρ slope.
        self._squares, self._at_zero = self._Z**2, self._eigenvalues
        self._slope = (1.0 - self._eigenvalues) / self._ratio
        self._is_diagonal = family == "diagonal"
        if self._is_diagonal:
            L_inv = group.whitening.L_inv
            self._squares, self._at_zero = (rows.V @ L_inv) ** 2, np.einsum("ji,ji->i", L_inv, L_inv)
            self._slope = np.einsum("ji,jk,ki->i", L_inv, statistics.VV, L_inv, optimize=True)
        self._roots, self._at = group.prior.roots(), dict[float, _AtRatio]()
        self._priors = [prior_of(group, output) for output in range(len(group.noise))]
        self._last: dict[int, _WeightsAtRatio] = {}

    def _at_ratio(self, ratio: float) -> _AtRatio:
        if ratio not in self._at:
            statistics, rows = self.group.statistics, self.rows
            factor = ratio / (self._eigenvalues + (ratio / self._ratio) * (1.0 - self._eigenvalues))
            both = factor[:, np.newaxis] * np.hstack([self._X, self._T])
            p = self._X.shape[1]
            seen, told = self._Z @ both, self._X.T @ both
            variance = self._squares @ (1.0 / (self._at_zero + ratio * self._slope))
            if not self.group.complete:
                variance += rows.unexplained
            self._at[ratio] = _AtRatio(
                seen[:, p:],
                rows.features - seen[:, :p],
                rows.noise + ratio * variance,
                statistics.HH - told[:, :p],
                statistics.HR - told[:, p:],
            )
        return self._at[ratio]

    def says(self, output: int) -> Weights:
        """What the other folds say of w through an output as it was fitted."""
        noise = self.group.noise[output]
        at, C = self._at_ratio(float(self.group.signal[output] / noise)), self._roots[output]
        return Weights(C.T @ at.M @ C / noise, C.T @ at.Mr[:, output] / noise)

    def predicted(
        self, output: int, ratio: float, noise: np.ndarray, known: Weights | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Errors and variances of y, each (n, g) or (n, 1), for a ratio and noise variances (g,).

        ``known`` is what is known of w beside the output's own data; None is its prior.
        """
        at, C = self._at_ratio(ratio), self._roots[output]
        error = (self.rows.residuals[:, output] - at.known[:, output])[:, np.newaxis]
        variance = np.multiply.outer(at.variance, noise)
        if len(C) == 0:
            return error, variance
        known = self._priors[output] if known is None else known
        own = self._weights_at(output, ratio, known)
        eigenvalues = own.eigenvalues[:, np.newaxis]
        precision = eigenvalues + (1.0 - eigenvalues) * (self.group.noise[output] / noise)
        weights = (np.outer(own.told, 1.0 / noise) + own.known[:, np.newaxis]) / precision
        error = error - own.coordinates @ weights
        if self._is_diagonal:
            squares = (self.rows.features @ C) ** 2
            diagonal = np.einsum("ji,jk,ki->i", C, self.group.statistics.HH, C)
            precision = np.diagonal(known.precision)[:, np.newaxis] + np.outer(diagonal, 1.0 / noise)
        else:
            squares = own.coordinates**2
        return error, variance + squares @ (1.0 / precision)

    def _weights_at(self, output: int, ratio: float, known: Weights) -> _WeightsAtRatio:
        """Kept until another ratio is asked for."""
        found = self._last.get(output)
        if found is None or found.ratio != ratio or found.beside is not known:
            at, C = self._at_ratio(ratio), self._roots[output]
            M = C.T @ at.M @ C
            root_inv = triangular_inverse(jittered_cholesky(known.precision + M / self.group.noise[output]))
            eigenvalues, W = eigh(root_inv @ known.precision @ root_inv.T, overwrite_a=True, check_finite=False)
            basis = W.T @ root_inv
            found = self._last[output] = _WeightsAtRatio(
                ratio,
                known,
                np.clip(eigenvalues, 0.0, 1.0),
                at.features @ (C @ basis.T),
                basis @ (C.T @ at.Mr[:, output]),
                basis @ known.linear,
            )
        return found


def prior_of(group: Group, output: int) -> Weights:
    """The prior of w."""
    return Weights(np.eye(group.prior.scale.shape[1]), -group.prior.reference[output])


def sums_of_others(each: Sequence[SufficientStatistics]) -> list[SufficientStatistics]:
    """For each entry of two or more the sum of all others.

    Summed, not subtracted from that of all: what only one knows is then exactly unknown without it.
    """
    before, after = list(accumulate(each[:-1])), list(accumulate(reversed(each[1:])))[::-1]
    return [after[0], *map(add, before, after[1:]), before[-1]]
