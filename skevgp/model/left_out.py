"""Held-out rows as the other rows predict them, for any signal and noise variance, from sufficient statistics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import accumulate
from operator import add

import numpy as np
from scipy.linalg import eigh

from ..data.blocks import AnyBlock
from ..utils.linalg import diagonal_of, jittered_cholesky, triangular_inverse
from .bounds import Group, PosteriorFamily
from .statistics import SufficientStatistics, Whitening

# No ratio or noise variance needs a pass over the rows.
#
# For an output let ρ = s²/σ². In the whitened coordinates of `model.bounds`, with β = μ_β + C (w₀ + w), the precision
# of v given w is I + ρ V Vᵀ, (m, m). Let I + ρ₀ V Vᵀ = L Lᵀ at one ratio ρ₀, and let λ and U be the eigenvalues and
# eigenvectors of L⁻¹ L⁻ᵀ. Then
#
#     I + ρ V Vᵀ = L U D Uᵀ Lᵀ,   D = diag(λ + (ρ/ρ₀) (1 - λ)),
#
# which is diagonal for all ρ in the coordinates z = Uᵀ L⁻¹ v(x) of a row. With X = Uᵀ L⁻¹ V H, (m, p), and
# t = Uᵀ L⁻¹ V r, (m,), matrices of size p remain for w:
#
#     precision of w: I + σ⁻² Cᵀ M C,   M = HᵀH - ρ Xᵀ D⁻¹ X,   its linear term: σ⁻² Cᵀ (Hᵀr - ρ Xᵀ D⁻¹ t) - w₀.
#
# The prediction of a row is
#
#     mean: ρ zᵀ D⁻¹ t + a(x)ᵀ C w,   variance: σ² (1 + ρ (zᵀ D⁻¹ z + k̃(x, x) - |v|²)) + a(x)ᵀ C Cov[w] Cᵀ a(x),
#
# with a = h - ρ Xᵀ D⁻¹ z, the part of the features that the Gaussian process does not explain. All of this but C is the
# same for the outputs of a group. The same method makes the precision of w diagonal for all σ². With many more
# features than inducing points, I + σ⁻² Cᵀ HᵀH C is made diagonal once for all ρ, and the points change it by a matrix
# of rank m. If outputs share w, the knowledge from the other outputs replaces its prior.

# With this many times more features than inducing points, w is made diagonal once.
_MANY_FEATURES = 4


@dataclass(frozen=True)
class SeenRows:
    """Rows as a set of inducing points and its outputs see them. ``+`` joins the rows of two."""

    # (n, m) and (n,): v, and k(x, x) - |v|².
    V: np.ndarray
    unexplained: np.ndarray
    # (n, p) and (n, o).
    features: np.ndarray
    residuals: np.ndarray
    # (n,): the noise variance of each row over σ², and its weight.
    noise: np.ndarray
    counts: np.ndarray

    def __add__(self, other: SeenRows) -> SeenRows:
        each = (np.concatenate([getattr(self, field.name), getattr(other, field.name)]) for field in fields(self))
        return SeenRows(*each)


@dataclass(frozen=True)
class Seen:
    """The function block -> `SeenRows`."""

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
    """Knowledge of w: its precision (p, p), and the precision times the mean (p,). ``+`` joins the knowledge of two."""

    precision: np.ndarray
    linear: np.ndarray

    def __add__(self, other: Weights) -> Weights:
        return Weights(self.precision + other.precision, self.linear + other.linear)


@dataclass(frozen=True)
class _Diagonal:
    """Coordinates of w in which known + σ⁻² A is diagonal for all σ²."""

    # (p, p).
    basis: np.ndarray
    # (p,): as λ above, with the fitted noise in the role of ρ₀.
    eigenvalues: np.ndarray

    @classmethod
    def of(cls, matrix: np.ndarray, noise: float, known: Weights | None) -> _Diagonal:
        """The coordinates for a matrix A (p, p), the fitted noise variance, and known weights (None: I)."""
        precision = matrix / noise
        if known is None:
            diagonal_of(precision)[...] += 1.0
        else:
            precision += known.precision
        root_inv = triangular_inverse(jittered_cholesky(precision))
        from_elsewhere = root_inv if known is None else root_inv @ known.precision
        eigenvalues, W = eigh(from_elsewhere @ root_inv.T, overwrite_a=True, check_finite=False)
        return cls(W.T @ root_inv, np.clip(eigenvalues, 0.0, 1.0))


@dataclass(frozen=True)
class _AtRatio:
    """An output at one ratio ρ, for all σ²."""

    ratio: float
    # Knowledge of w from elsewhere. None: its prior.
    known: Weights | None
    # (n,): of the rows, without the part of w. The variance is in units of σ².
    error: np.ndarray
    variance: np.ndarray
    # (p,) and (n, p): λ of a `_Diagonal`, and the rows in its coordinates.
    eigenvalues: np.ndarray
    coordinates: np.ndarray
    # (p,): linear terms of w, from the output's own data in units of σ⁻², and from elsewhere.
    from_data: np.ndarray
    linear: np.ndarray
    # (m, p): U, where the precision is the diagonal one minus σ⁻² UᵀU.
    less: np.ndarray | None = None

    def of_weights(self, noise: np.ndarray, fitted: float) -> tuple[np.ndarray, np.ndarray]:
        """The part of w in mean and variance (n, g) of the rows, for noise variances (g,)."""
        eigenvalues = self.eigenvalues[:, np.newaxis]
        precision = eigenvalues + (1.0 - eigenvalues) * (fitted / noise)
        linear = np.outer(self.from_data, 1.0 / noise) + self.linear[:, np.newaxis]
        mean, variance = self.coordinates @ (linear / precision), self.coordinates**2 @ (1.0 / precision)
        if self.less is not None:
            for g in range(len(noise)):
                # (E - σ⁻² UᵀU)⁻¹ = E⁻¹ + E⁻¹ Uᵀ (σ² I - U E⁻¹ Uᵀ)⁻¹ U E⁻¹
                scaled = self.less / precision[:, g]
                inner = -(scaled @ self.less.T)
                diagonal_of(inner)[...] += noise[g]
                scaled = triangular_inverse(jittered_cholesky(inner)) @ scaled
                seen = self.coordinates @ scaled.T
                mean[:, g] += seen @ (scaled @ linear[:, g])
                variance[:, g] += np.einsum("nm,nm->n", seen, seen)
        return mean, variance


class LeftOut:
    """The held-out rows of one fold, and their prediction from the statistics of the other folds (in ``group``)."""

    def __init__(self, group: Group, family: PosteriorFamily, rows: SeenRows):
        self.group, self.rows, statistics = group, rows, group.statistics
        # ρ₀.
        self._ratio = float(np.max(group.signal / group.noise))
        B = self._ratio * statistics.VV
        diagonal_of(B)[...] += 1.0
        root_inv = triangular_inverse(jittered_cholesky(B))
        eigenvalues, U = eigh(root_inv @ root_inv.T, overwrite_a=True, check_finite=False)
        self._eigenvalues = np.clip(eigenvalues, 0.0, 1.0)
        basis = U.T @ root_inv
        # (n, m), (m, p) and (m, o): z of each row, X and t.
        self._Z, self._X, self._T = rows.V @ basis.T, basis @ statistics.VH, basis @ statistics.VR
        # Both families: squared coordinates (n, m), and their precisions (m,) as at_zero + ρ slope.
        self._squares, self._at_zero = self._Z**2, self._eigenvalues
        self._slope = (1.0 - self._eigenvalues) / self._ratio
        self._is_diagonal = family == "diagonal"
        if self._is_diagonal:
            L_inv = group.whitening.L_inv
            self._squares, self._at_zero = (rows.V @ L_inv) ** 2, np.einsum("ji,ji->i", L_inv, L_inv)
            self._slope = np.einsum("ji,jk,ki->i", L_inv, statistics.VV, L_inv, optimize=True)
        # Only the last ratio of each output is kept, since each has a matrix (n, p).
        self._last: dict[int, _AtRatio] = {}
        self._without: dict[int, tuple[Weights | None, _Diagonal]] = {}

    def says(self, output: int) -> Weights:
        """The knowledge of w that the other folds give through an output as it was fitted."""
        noise = self.group.noise[output]
        factor = self._factor(float(self.group.signal[output] / noise))
        from_data = self._times_root(output, self._from_data(output, factor))
        return Weights(self._within_root(output, self._unexplained(factor)) / noise, from_data / noise)

    def predicted(
        self, output: int, ratio: float, noise: np.ndarray, known: Weights | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Errors and variances of y, each (n, g) or (n, 1), for a ratio and noise variances (g,)."""
        at = self._last.get(output)
        if at is None or at.ratio != ratio or at.known is not known:
            at = self._last[output] = self._at(output, ratio, known)
        error, variance = at.error[:, np.newaxis], np.multiply.outer(at.variance, noise)
        if not len(at.eigenvalues):
            return error, variance
        mean, of_weights = at.of_weights(noise, float(self.group.noise[output]))
        if self._is_diagonal:
            prior = 1.0 if known is None else np.diagonal(known.precision)[:, np.newaxis]
            determined = np.diagonal(self._within_root(output, self.group.statistics.HH))[:, np.newaxis]
            of_weights = self._times_root(output, self.rows.features) ** 2 @ (1.0 / (prior + determined / noise))
        return error - mean, variance + of_weights

    def _at(self, output: int, ratio: float, known: Weights | None) -> _AtRatio:
        """An output at a ratio."""
        rows, factor, prior = self.rows, self._factor(ratio), self.group.prior
        m, p = self._X.shape
        error = rows.residuals[:, output] - self._Z @ (factor * self._T[:, output])
        # The variance that a jitter leaves unexplained counts too: it keeps the signal from growing without end.
        variance = rows.noise + self._squares @ _divided(ratio, self._at_zero + ratio * self._slope)
        variance += ratio * rows.unexplained
        if p == 0:
            none = np.empty(0)
            return _AtRatio(ratio, known, error, variance, none, np.empty((len(error), 0)), none, none)
        features = rows.features - self._Z @ (factor[:, np.newaxis] * self._X)
        less = None
        if p > _MANY_FEATURES * m:
            diagonal = self._diagonal_without(output, known)
            less = self._times_root(output, np.sqrt(factor)[:, np.newaxis] * self._X) @ diagonal.basis.T
        else:
            matrix = self._within_root(output, self._unexplained(factor))
            diagonal = _Diagonal.of(matrix, self.group.noise[output], known)
        return _AtRatio(
            ratio,
            known,
            error,
            variance,
            diagonal.eigenvalues,
            self._times_root(output, features) @ diagonal.basis.T,
            diagonal.basis @ self._times_root(output, self._from_data(output, factor)),
            diagonal.basis @ (-prior.reference[output] if known is None else known.linear),
            less,
        )

    def _diagonal_without(self, output: int, known: Weights | None) -> _Diagonal:
        """The coordinates of w for a model without a Gaussian process."""
        before, diagonal = self._without.get(output, (None, None))
        if diagonal is None or before is not known:
            matrix = self._within_root(output, self.group.statistics.HH)
            diagonal = _Diagonal.of(matrix, self.group.noise[output], known)
            self._without[output] = known, diagonal
        return diagonal

    def _factor(self, ratio: float) -> np.ndarray:
        """The diagonal (m,) of ρ D⁻¹."""
        return _divided(ratio, self._eigenvalues + (ratio / self._ratio) * (1.0 - self._eigenvalues))

    def _unexplained(self, factor: np.ndarray) -> np.ndarray:
        """M (p, p), with ``factor`` = ρ D⁻¹."""
        return self.group.statistics.HH - self._X.T @ (factor[:, np.newaxis] * self._X)

    def _from_data(self, output: int, factor: np.ndarray) -> np.ndarray:
        """Hᵀr - ρ Xᵀ D⁻¹ t (p,) of an output."""
        return self.group.statistics.HR[:, output] - self._X.T @ (factor * self._T[:, output])

    def _times_root(self, output: int, values: np.ndarray) -> np.ndarray:
        """Rows (..., p) times C of an output."""
        prior = self.group.prior
        return values * prior.scale[output] if prior.root is None else values @ prior.root[output]

    def _within_root(self, output: int, matrix: np.ndarray) -> np.ndarray:
        """Cᵀ A C of a symmetric matrix A."""
        return self._times_root(output, self._times_root(output, matrix).T)


def prior_of(group: Group, output: int) -> Weights:
    """The prior of w."""
    return Weights(np.eye(group.prior.scale.shape[1]), -group.prior.reference[output])


def sums_of_others(each: Sequence[SufficientStatistics]) -> list[SufficientStatistics]:
    """For each of two or more folds, the sum over all others."""
    # They are summed, not subtracted from the sum of all: what only one fold knows is then exactly unknown without it.
    before, after = list(accumulate(each[:-1])), list(accumulate(reversed(each[1:])))[::-1]
    return [after[0], *map(add, before, after[1:]), before[-1]]


def _divided(ratio: float, D: np.ndarray) -> np.ndarray:
    """ρ D⁻¹. It is 0 without a signal, even where D was rounded to 0."""
    return np.divide(ratio, D, out=np.zeros(D.shape), where=D > 0.0)
