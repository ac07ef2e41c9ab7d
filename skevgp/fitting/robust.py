"""Rows before any fit: the medians of neighbours, which outliers hardly move, and targets without far outliers."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtri

from ..data.rows import LocalSource

# The prediction of a row is the median of so many neighbours among so many rows, evenly spaced.
_NEIGHBOURS, _SAMPLE = 15, 5000
# Share of the rows that set the scale of errors: a larger one would include outliers.
_ORDINARY = 0.7
# Targets with errors of more than so many standard deviations are moved to this limit.
_FAR = 6.0


def errors_of_medians(inputs: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Errors (n, o) of predicting each row of targets (n, o) by the median of its neighbours in inputs (n, d)."""
    n = len(inputs)
    sample = np.unique(np.linspace(0, n - 1, _SAMPLE).astype(int))
    if len(sample) < 3:
        return np.zeros(targets.shape)
    # In units of the middle half of each column: columns may have outliers too.
    low, high = np.quantile(inputs, [0.25, 0.75], axis=0)
    scale = np.where(high > low, high - low, inputs.std(axis=0))
    inputs = (inputs - low) / np.where(scale > 0.0, scale, 1.0)
    k = min(_NEIGHBOURS, len(sample) - 1)
    # The row itself may be the nearest one.
    _, nearest = cKDTree(inputs[sample]).query(inputs, k + 1)
    other = sample[nearest] != np.arange(n)[:, np.newaxis]
    other[other.all(axis=1), -1] = False
    neighbours = sample[nearest][other].reshape(n, k)
    found: np.ndarray = targets - np.median(targets[neighbours], axis=1)
    return found


def ordinary_variance(errors: np.ndarray) -> np.ndarray:
    """Variance (o,) of errors (n, o) of which some may be outliers, as if the others were normal."""
    found: np.ndarray = (np.quantile(np.abs(errors), _ORDINARY, axis=0) / ndtri(0.5 + 0.5 * _ORDINARY)) ** 2
    return found


def without_far_targets(source: LocalSource) -> LocalSource:
    """The same rows, with far outliers of each target moved to the edge of the others."""
    rows = source.take(slice(0, source.n_rows))
    inputs = rows.inputs.reshape(source.n_rows, -1)
    errors = errors_of_medians(inputs, rows.targets)
    most = _FAR * np.sqrt(ordinary_variance(errors))
    # Targets of which most are equal have no scale.
    most = np.where(most > 0.0, most, np.inf)
    return source.with_targets(rows.targets - errors + np.clip(errors, -most, most))
