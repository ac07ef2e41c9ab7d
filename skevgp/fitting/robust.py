"""Rows before any fit: the medians of neighbours, which outliers hardly move, and targets without far outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtri

from ..data.rows import LocalSource

# The prediction of a row is the median of so many neighbours among so many rows, evenly spaced.
_NEIGHBOURS, _SAMPLE = 15, 5000
# An outlier is next to others if most of so many of its nearest neighbours are outliers.
_CLOSE = 5
# Share of the rows that set the scale of errors: a larger one would include outliers.
_ORDINARY = 0.7
# Targets with errors of more than so many standard deviations are moved to this limit.
_FAR = 6.0


@dataclass(frozen=True)
class Neighbours:
    """The nearest other rows of each row, among a sample of the rows."""

    # (n, k): indices of rows, the nearest first.
    indices: np.ndarray

    @classmethod
    def of(cls, inputs: np.ndarray) -> Neighbours:
        """Find the neighbours of rows with inputs (n, ...)."""
        n = len(inputs)
        inputs = inputs.reshape(n, -1)
        sample = np.unique(np.linspace(0, n - 1, _SAMPLE).astype(int))
        k = min(_NEIGHBOURS, len(sample) - 1)
        if k < 2:
            return cls(np.empty((n, 0), dtype=int))
        # In units of the middle half of each column: columns may have outliers too.
        low, high = np.quantile(inputs, [0.25, 0.75], axis=0)
        scale = np.where(high > low, high - low, inputs.std(axis=0))
        inputs = (inputs - low) / np.where(scale > 0.0, scale, 1.0)
        # The row itself may be the nearest one.
        _, nearest = cKDTree(inputs[sample]).query(inputs, k + 1)
        other = sample[nearest] != np.arange(n)[:, np.newaxis]
        other[other.all(axis=1), -1] = False
        return cls(sample[nearest][other].reshape(n, k))

    def errors(self, targets: np.ndarray) -> np.ndarray:
        """Errors (n, o) of predicting each row of targets (n, o) by the median of its neighbours."""
        if self.indices.shape[1] == 0:
            return np.zeros(targets.shape)
        return np.asarray(targets - np.median(targets[self.indices], axis=1))

    def together(self, chosen: np.ndarray) -> float:
        """Share of the chosen rows (n,) that have mostly chosen rows around them, as a bump of a function has."""
        close = chosen[self.indices[chosen, :_CLOSE]]
        return float(np.mean(2 * close.sum(axis=1) > close.shape[1])) if chosen.any() else 0.0


def ordinary_variance(errors: np.ndarray) -> np.ndarray:
    """Variance (o,) of errors (n, o) of which some may be outliers, as if the others were normal."""
    found: np.ndarray = (np.quantile(np.abs(errors), _ORDINARY, axis=0) / ndtri(0.5 + 0.5 * _ORDINARY)) ** 2
    return found


def without_far_targets(source: LocalSource) -> LocalSource:
    """The same rows, with far outliers of each target moved to the edge of the others."""
    rows = source.take(slice(0, source.n_rows))
    errors = Neighbours.of(rows.inputs).errors(rows.targets)
    most = _FAR * np.sqrt(ordinary_variance(errors))
    # Targets of which most are equal have no scale.
    most = np.where(most > 0.0, most, np.inf)
    return source.with_targets(rows.targets - errors + np.clip(errors, -most, most))
