"""Internal units: the fit of the features alone is subtracted from y, and the residuals are divided by their size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import lapack, lstsq, qr

from ..data.rows import SMALLEST_UNIT, Columns, Moments, RawRows, Rows, Source, times_weights
from ..data.threads import BlockMap
from ..model.predictor import CoefficientPrior, Predictor

# Size of the rounding errors of residuals, as a share of the target's largest value.
_TARGET_ROUNDING = 1e-14
# Directions in which features of length 1 vary less than this are rounding errors.
_ROUNDING = 1e-12
# If the features explain all but this share of Σ ω (y - target_mean)², the residuals are fitted once more.
_NEARLY_EXACT = 1e-12
# The least noise variance of an output that shares its weights, as a share of the largest one.
_LEAST_NOISE = 1e-16
# Number of columns that LAPACK reflects together.
_PANEL = 32


def _residuals(raw: RawRows, target_mean: np.ndarray, coef: np.ndarray | None) -> np.ndarray:
    """Residuals y - target_mean - H coefᵀ (n, o). None: the weights are 0."""
    left_over = raw.targets - target_mean
    return left_over if coef is None else left_over - times_weights(raw.features, coef)


def _squares(raw: RawRows, target_mean: np.ndarray, coef: np.ndarray) -> np.ndarray:
    """Σω of the squared residuals, (o,)."""
    squares = _residuals(raw, target_mean, coef) ** 2
    total: np.ndarray = squares.sum(axis=0) if raw.precision is None else raw.precision @ squares
    return total


@dataclass(frozen=True)
class LeastSquares:
    """A few rows [A, b] that replace all rows [H, y - target_mean] in least squares.

    For any weights β, |b - A β|² is the sum of squared residuals, weighted by ω.
    """

    # [A, b] is a rotation of the triangle R of √Ω [H, y - target_mean] = Q R (Golub & Van Loan 2013, section 5.3). The
    # triangle of two parts of the rows is that of their triangles, one below the other. Hence one pass is enough (TSQR;
    # Demmel, Grigori, Hoemmen & Langou 2012). The rounding errors of a column are small next to this column (Higham
    # 2002, theorem 19.4). Products HᵀΩH would lose twice as many digits of nearly collinear features (Björck 1996,
    # section 2.2).

    # (k, r, p + q): k triangles of p features and q targets. If each output has its own features, k = o and q = 1, else
    # k = 1 and q = o. r is p + q, or the number of rows if that is smaller.
    triangles: np.ndarray
    # (o,): subtracted from y.
    target_mean: np.ndarray
    # p.
    n_features: int

    @classmethod
    def of(cls, source: Source, target_mean: np.ndarray, coef: np.ndarray | None = None) -> LeastSquares:
        """Read all rows once. With weights ``coef`` (o, p), their residuals replace the targets."""
        total = source.sum(partial(cls._of_rows, target_mean=target_mean, coef=coef))
        rotated = [_without_rounding(rows, total.n_features) for rows in total.triangles]
        return replace(total, triangles=np.array(rotated))

    @classmethod
    def _of_rows(cls, raw: RawRows, target_mean: np.ndarray, coef: np.ndarray | None) -> LeastSquares:
        H, targets = raw.features, _residuals(raw, target_mean, coef).T
        parts = [(H, targets)]
        if H.ndim == 3:
            parts = [(H[:, output], targets[[output]]) for output in range(len(targets))]
        root = 1.0 if raw.precision is None else np.sqrt(raw.precision)
        triangles = [_triangle((np.concatenate([features.T, some]) * root).T) for features, some in parts]
        return cls(np.array(triangles), target_mean, H.shape[-1])

    def __add__(self, other: LeastSquares) -> LeastSquares:
        both = np.concatenate([self.triangles, other.triangles], axis=1)
        return replace(self, triangles=np.array([_triangle(rows) for rows in both]))

    @property
    def features(self) -> np.ndarray:
        """A, (k, r, p)."""
        return self.triangles[:, :, : self.n_features]

    @property
    def targets(self) -> np.ndarray:
        """b, (o, r)."""
        columns = self.triangles[:, :, self.n_features :].swapaxes(1, 2)
        return columns.reshape(-1, columns.shape[2])

    def left_over(self, coef: np.ndarray) -> np.ndarray:
        """Residuals b - A β (o, r) for weights β (o, p)."""
        return self.targets - np.squeeze(self.features @ coef[:, :, np.newaxis], axis=2)


def _triangle(rows: np.ndarray) -> np.ndarray:
    """R (r, c) of the QR decomposition of rows (n, c), with r = min(n, c)."""
    # For tall matrices, LAPACK's dgeqrt is three times as fast as the dgeqrf of `np.linalg.qr`.
    r = min(rows.shape)
    return np.triu(lapack.dgeqrt(min(r, _PANEL), rows, overwrite_a=1)[0][:r])


def _without_rounding(rows: np.ndarray, p: int) -> np.ndarray:
    """Rotated rows (r, c) whose first p columns do not vary in directions in which they did by rounding errors only."""
    # A QR decomposition with column pivoting shows the rank (Golub & Van Loan 2013, section 5.4). In a direction
    # without features, Q is arbitrary, and b is not small: a rounding error in A would give this direction a weight.
    if p == 0:
        return rows
    sizes = _sizes(rows[:, :p])
    Q, R, order = qr(rows[:, :p] / sizes, pivoting=True, check_finite=False)
    diagonal = np.abs(np.diagonal(R))
    R[np.count_nonzero(diagonal > _ROUNDING * diagonal.max(initial=0.0)) :] = 0.0
    rotated = np.empty(rows.shape)
    rotated[:, order], rotated[:, p:] = R * sizes[order], Q.T @ rows[:, p:]
    return rotated


def _sizes(rows: np.ndarray) -> np.ndarray:
    """The largest absolute value (c,) of each column of (r, c). 1 for a column of zeros."""
    largest = np.abs(rows).max(axis=0, initial=0.0)
    return np.where(largest > 0.0, largest, 1.0)


def features_alone(
    source: Source, rows: LeastSquares, prior: CoefficientPrior, n_rows: float
) -> tuple[np.ndarray, np.ndarray]:
    """The posterior mode w (o, p) of y = target_mean + H (mean + C w) + ε, w ~ N(0, I), and its squared residuals (o,).

    ``rows`` replace those of the source, which weigh ``n_rows`` in all.
    """
    features, w, o = rows.features @ prior.roots(), np.zeros(prior.scale.shape), len(prior.scale)

    def move(left_over: np.ndarray, noise: np.ndarray) -> None:
        for outputs in [list(range(o))] if prior.shared else [[output] for output in range(o)]:
            if noise[outputs].any() and prior.scale[outputs].any():
                w[outputs] += _step(features[outputs], left_over[outputs], noise[outputs], w[outputs[0]])

    def squares() -> np.ndarray:
        return source.sum(partial(_squares, target_mean=rows.target_mean, coef=prior.mean + prior.times(w)))

    # The noise variance is first negligible, then the mean squared residual of that fit. If outputs share their
    # weights, the residuals of each decide how much it counts.
    for share in (1e-12, 1.0, 1.0) if prior.shared else (1e-12, 1.0):
        left_over = rows.left_over(prior.mean + prior.times(w))
        move(left_over, share * np.sum(left_over**2, axis=1) / n_rows)
    remaining = squares()
    # Rounding errors of b are small next to y, but not next to such residuals. A step of iterative refinement removes
    # them (Björck 1996, section 2.9).
    if (remaining < _NEARLY_EXACT * np.sum(rows.targets**2, axis=1)).any():
        move(LeastSquares.of(source, rows.target_mean, prior.mean + prior.times(w)).targets, remaining / n_rows)
        remaining = squares()
    return w, remaining


def _step(features: np.ndarray, left_over: np.ndarray, noise: np.ndarray, w: np.ndarray) -> np.ndarray:
    """The d (p,) that minimises |w + d|² + Σ |l - A d|² / σ² over outputs with A (g, r, p), l (g, r) and σ² (g,)."""
    # In units of the smallest σ², this is least squares with the rows of the prior below those of the data (Björck
    # 1996, section 2.7). If neither is above the rounding errors of the other in a direction, the shortest d keeps the
    # w of the noise before.
    noise = np.maximum(noise, _LEAST_NOISE * noise.max())
    least, p = noise.min(), len(w)
    roots = np.sqrt(least / noise)[:, np.newaxis]
    rows = np.concatenate([(roots[:, :, np.newaxis] * features).reshape(-1, p), np.sqrt(least) * np.eye(p)])
    wanted, sizes = np.append(roots * left_over, -np.sqrt(least) * w), _sizes(rows)
    step: np.ndarray = lstsq(rows / sizes, wanted, cond=_ROUNDING, lapack_driver="gelsy", check_finite=False)[0]
    return step / sizes


def may_hide_noise(prior: CoefficientPrior, n_rows: int) -> bool:
    """Whether the residuals of the features may be far below the noise.

    They vanish with as many features as rows. They are also too small if weights are far from their prior.
    """
    return 2 * prior.scale.shape[1] >= n_rows or float((prior.reference**2).sum(axis=1).max(initial=0.0)) > n_rows


def noise_of_most_evidence(
    evidence: Callable[[np.ndarray], np.ndarray], least: np.ndarray, highest: np.ndarray, shared: bool
) -> tuple[float, np.ndarray]:
    """The highest evidence of a linear model, summed over outputs, and the noise variances (o,) that reach it.

    ``evidence`` maps noise variances (o,) to nats (o,) (Rasmussen & Williams 2006, eq. 2.30). The search goes from
    ``least`` to ``highest``, both (o,). If ``shared``, all outputs have the same multiple of ``least``.
    """
    # The evidence may be flat over most decades: all are tried, then quarters of decades around the best.
    best, value = least.copy(), np.full(len(least), -np.inf)
    reach = np.log10(np.max(highest / least, initial=1.0))
    for exponents in (np.append(np.arange(0.0, reach), reach), np.arange(-0.75, 1.0, 0.25)):
        centre = best.copy()
        for exponent in exponents:
            noise = np.clip(centre * 10.0**exponent, least, np.maximum(least, highest))
            found = evidence(noise)
            if shared:
                found = np.full(len(found), found.mean())
            higher = found > value
            best[higher], value[higher] = noise[higher], found[higher]
        if (best == least).all():
            break
    return float(value.sum()), best


def check_independent(features: np.ndarray, vague: np.ndarray, shared: bool) -> None:
    """Raise a ValueError if features with an infinite prior scale are collinear on the rows.

    Features are (n, p) or (n, o, p), and ``vague`` (o, p) says which weights have an infinite scale.
    """
    if features.ndim == 3 and not shared:
        for output, own in enumerate(vague):
            check_independent(features[:, output], own[np.newaxis], shared)
        return
    features = features.reshape(np.prod(features.shape[:-1]), features.shape[-1])
    size = np.sqrt(np.sum(features**2, axis=0))
    scaled = features / np.where(size > 0.0, size, 1.0)
    for mask in np.unique(vague, axis=0):
        rank = np.linalg.matrix_rank(scaled[:, mask]) if mask.any() else 0
        if rank < mask.sum():
            raise ValueError(
                "An infinite scale of CoefPrior needs features that are linearly independent on the rows of X: "
                f"{mask.sum()} features have an infinite scale, but only {rank} of them are independent. Pass a "
                "finite scale for some of them."
            )


def unit_of(left_over: np.ndarray, targets: Moments, from_features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unit (o,) of each target, and whether it is a constant that the features explain, (o,).

    ``left_over`` (o,) is the rms of the residuals. ``from_features`` (o,) is the largest prior mean of a feature's
    contribution, which gives the size of rounding errors where the target is 0.
    """
    # The unit is the size of the residuals, but not below the rounding error of the target.
    rounding = _TARGET_ROUNDING * np.where(targets.largest > 0.0, targets.largest, from_features)
    # A constant that the features explain says nothing about a size: its unit is 1, as in scikit-learn's scalers.
    constant = (left_over <= rounding) & (np.sqrt(targets.variance) <= rounding)
    unit = np.maximum(np.where(constant, 1.0, left_over), rounding)
    return np.maximum(unit, SMALLEST_UNIT), constant


@dataclass(frozen=True)
class Units:
    """The shift and scale of the targets, and the prior of the weights."""

    # (o,): subtracted from y, and part of the model. 0 unless y is normalised.
    target_mean: np.ndarray
    # (o,): the size of the residuals of the features alone.
    target_unit: np.ndarray
    # In the user's units.
    prior: CoefficientPrior
    # (o,): the targets' variance, and the rounding variance of their largest value, in squared target units.
    target_scatter: np.ndarray
    rounding: np.ndarray
    # (o,): whether a target is constant and the features explain it.
    constant: np.ndarray

    @classmethod
    def of(
        cls,
        source: Source,
        features: Moments,
        targets: Moments,
        rows: LeastSquares,
        prior: CoefficientPrior,
    ) -> Units:
        """The units of training rows, given the moments of their features and targets, and the prior of the weights."""
        reference, squares = features_alone(source, rows, prior, features.n)
        largest = np.max(np.abs(prior.mean) * features.largest, axis=1, initial=0.0)
        unit, constant = unit_of(np.sqrt(squares / targets.n), targets, largest)
        rounding = (np.finfo(float).eps * targets.largest / unit) ** 2
        prior = replace(prior, reference=reference)
        return cls(rows.target_mean, unit, prior, targets.variance / unit**2, rounding, constant)

    def to_internal(self, raw: RawRows) -> RawRows:
        """The same inputs and features, with the residuals in internal units for targets."""
        left_over = raw.targets - self.target_mean - times_weights(raw.features, self.prior.offset)
        return replace(raw, targets=left_over / self.target_unit)

    def rows(self, source: Source, threads: BlockMap | None = None) -> Rows:
        """Rows in internal units."""
        threads = BlockMap() if threads is None else threads
        return Rows(source, self.to_internal, threads=threads, constant=self.constant, rounding=self.rounding)

    def internal_prior(self) -> CoefficientPrior:
        """The prior of the weights in internal units."""
        return self.prior.scaled(1.0 / self.target_unit)

    def shift(self, n_contrasts: np.ndarray, outputs: Columns) -> float:
        """The loss of some outputs in the user's units less that in internal ones. ``n_contrasts`` are (o,)."""
        return float(n_contrasts @ np.log(self.target_unit[outputs]))

    def predictor(self, parts: Sequence[Predictor], outputs: Sequence[list[int]]) -> Predictor:
        """The predictor of all outputs in the user's units, from predictors of some outputs each in internal units."""
        return Predictor.joined(parts, outputs, self.target_unit, self.prior.offset, self.target_mean)
