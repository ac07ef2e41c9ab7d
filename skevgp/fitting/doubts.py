"""Rows that may be outliers: their errors, their noise scales, and their weights in a fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..data.rows import LocalSource, Rows
from ..model.model import SparseModel
from ..model.predictor import Predictor
from ..noise.base import RowScales

# The median of the square of a standard normal number.
_MEDIAN_SQUARE = 0.4549
# If more than this share of the rows seem to be outliers, the first scales are all 1.
FEW = 0.2
# Scales and q alternate until no E[τ] changes by more than this share, or so many times.
_SETTLED, TURNS = 0.05, 5
# Smaller E[τ] are all alike.
_LEAST_SCALE = 1e-200
# The weight of an outlier in fits of kernel and noise. (It must not be 0.)
_NOTHING = 1e-9
# Rows with larger errors than so many standard deviations of the others do not count for the noise of y.
FAR = 6.0
# Number of rows that are predicted at once.
_ROWS_AT_ONCE = 4096


@dataclass(frozen=True)
class RowDoubts:
    """The noise scale of each row."""

    # q(τ) of each row.
    scales: RowScales
    # (n,): rows with errors that are too large for the noise, whatever its model. None: no row.
    rejected: np.ndarray | None = None
    # Share of the rows with errors far from the median error.
    far: float = 0.0

    def __getstate__(self) -> dict[str, Any]:
        # Copies and pickles of a model hold no rows.
        return {**vars(self), "rejected": None}

    def seen_in(self, look: Look, noise: np.ndarray) -> RowDoubts:
        """The doubts for other errors, with noise variances (o,)."""
        scales = self.scales.at(look.distances(noise))
        rejected = (scales.outlier > 0.5) | look.beyond(noise)
        return RowDoubts(scales, rejected if 0.0 < rejected.mean() <= FEW else None)

    def weigh(self, rows: Rows) -> Rows:
        """The rows weighted by their noise scales."""
        return replace(rows, source=_local(rows).reweighted(self.scales.mean, self.scales.log_variance))

    def without_outliers(self, rows: Rows) -> Rows:
        """The same rows, with rejected ones that have almost no weight, for a fit of kernel and noise."""
        # A far outlier adds (ν + o) σ² to the sum of E[τ] times squared errors, where another row adds o σ². One in ten
        # rows would raise σ² by half and more, and with it the distance at which a row is an outlier.
        return rows if self.rejected is None else without(rows, self.rejected)

    def precision(self, sparse: SparseModel, noise: np.ndarray) -> np.ndarray | None:
        """E[τ]/σ² (o, n) of each output and row, if the bound is the tight one."""
        return self.scales.mean / noise[:, np.newaxis] if sparse.variant.tight else None

    def rejects_as(self, other: RowDoubts) -> bool:
        """Whether both reject the same rows."""
        if self.rejected is None or other.rejected is None:
            return self.rejected is other.rejected
        return bool((self.rejected == other.rejected).all())

    def differ_from(self, before: RowDoubts) -> bool:
        """Whether the scale of some row has changed."""
        # A far outlier has E[τ] near σ² / error²: only a relative change shows that σ² is still too large.
        now, then = (np.maximum(doubts.scales.mean, _LEAST_SCALE) for doubts in (self, before))
        return bool(np.abs(np.log(now / then)).max() >= _SETTLED)


def without(rows: Rows, outlier: np.ndarray) -> Rows:
    """The same rows, of which some (n,) have almost no weight."""
    return rows.counted(np.where(outlier, _NOTHING, 1.0))


def _local(rows: Rows) -> LocalSource:
    if not isinstance(rows.source, LocalSource):
        raise TypeError("Rows of Dask arrays cannot be doubted.")
    return rows.source


def of_residuals(predictor: Predictor) -> Predictor:
    """The same predictor for residuals."""
    return replace(predictor, offset=np.zeros_like(predictor.offset))


@dataclass(frozen=True)
class Look:
    """Rows and their predictions."""

    # (n, o): errors of the mean, and variances of the noise-free prediction.
    errors: np.ndarray
    latent: np.ndarray
    # (n,): v and w.
    variance: np.ndarray
    counts: np.ndarray

    @property
    def squares(self) -> np.ndarray:
        """E(y - g)² / v, (n, o)."""
        return (self.errors**2 + self.latent) / self.variance[:, np.newaxis]

    def far_from_median(self, most: float, least: np.ndarray | float = 0.0) -> np.ndarray:
        """Whether an error of a row (n,) is more than ``most`` standard deviations away from the median error.

        The standard deviations (o,) come from a median, and are not below ``least``.
        """
        distance = np.abs(self.errors - np.median(self.errors, axis=0)) / np.sqrt(self.variance)[:, np.newaxis]
        scale = np.median(distance, axis=0) / np.sqrt(_MEDIAN_SQUARE)
        scale = np.maximum(scale, least)
        return np.asarray(np.any(distance > most * scale, axis=1))

    def beyond(self, variance: np.ndarray) -> np.ndarray:
        """Whether an error of a row (n,) is too large for noise variances (o,)."""
        return np.asarray(np.any(self.squares > FAR**2 * variance, axis=1))

    @property
    def typical(self) -> np.ndarray:
        """A robust variance (o,), from the median."""
        return np.maximum(np.median(self.squares, axis=0) / _MEDIAN_SQUARE, np.finfo(float).tiny)

    def distances(self, noise: np.ndarray) -> np.ndarray:
        """The squared Mahalanobis distance (n,) of rows, for noise variances (o,)."""
        return (self.squares / noise).sum(axis=1)


def look_at(rows: Rows, predictor: Predictor, precision: np.ndarray | None = None) -> Look:
    """Predict each row by a predictor of residuals, in one pass.

    For the tight bound, ``precision`` (o, n) is E[τ]/σ² of each output and row.
    """
    # The charge of the tight bound, -½ ŵ log(1 + x) with ŵ = max(w, 1) and x = w τ d / (ŵ σ² v), is convex in E[τ] (see
    # `model.bounds.BoundAtOptimum`). Its tangent at the present E[τ] is below it. The tangent has the slope
    # -½ w d' / (σ² v) with d' = d / (1 + x). So the best q(τ) for d' in place of d raises the bound.

    def of(first: int) -> tuple[np.ndarray, ...]:
        some = rows.some(np.arange(first, min(first + _ROWS_AT_ONCE, len(rows))))
        mean, latent = predictor.predict(some.inputs, some.features, return_variance=True)
        counts = variance = np.ones(len(mean))
        if some.counts is not None and some.precision is not None:
            counts, variance = some.counts, some.counts / some.precision
        if precision is not None and latent is not None:
            d = predictor.unexplained(some.inputs, some.features)
            x = d * precision[:, first : first + len(d)].T * (np.minimum(counts, 1.0) / variance)[:, np.newaxis]
            latent = np.maximum(latent - d * (x / (1.0 + x)), 0.0)
        return some.targets - mean, np.zeros_like(mean) if latent is None else latent, variance, counts

    parts = rows.threads(of, range(0, len(rows), _ROWS_AT_ONCE))
    return Look(*(np.concatenate(each) for each in zip(*parts, strict=True)))
