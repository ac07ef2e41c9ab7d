"""Folds for calibration: which rows are held out, and which of them are predicted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# Fewer rows than this are not calibrated.
FEWEST_ROWS = 50
# At most this many rows are predicted in all, drawn at random. More do not improve a standard deviation.
PREDICTED_ROWS = 2000
# If one group has this share of the rows (one of two has), there are too few others to predict it from. Then blocks of
# consecutive rows are held out. This share of a block at either end is close to its neighbours and is not predicted.
_LARGEST_SHARE, _GAP = 0.5, 0.15
# Along a slow direction, the mean squared step from row to row is less than this share of the mean squared distance of
# any two rows. A sorted table may have one slow direction. No more steps than this are used.
_SLOW, _SLOW_DIRECTIONS, _MOST_STEPS = 0.1, 2, 2000
# Directions in which inputs vary less than this, in standard deviations of their columns, do not count.
_FLAT = 1e-3


@dataclass(frozen=True)
class CrossValidation:
    """How rows are held out."""

    # At most as many as there are rows or groups.
    n_folds: int
    # (n,): rows with the same label are held out together. None: random folds.
    groups: np.ndarray | None = None
    # Whether the signal may leave the limits of the fit, because the user gave none. Those keep kernels from becoming
    # long waves of huge height. Here the shape of the kernel is fixed.
    wide: bool = True

    def folds(self, order: np.ndarray, rng: np.random.RandomState) -> list[Fold]:
        """Folds of all rows, or none if there are too few. ``order`` (n,) are the rows in the user's order."""
        if len(order) < FEWEST_ROWS:
            return []
        if self.groups is None:
            return random_folds(len(order), self.n_folds, rng)
        return folds_of_groups(self.groups, self.n_folds, rng, order)


@dataclass(frozen=True)
class Fold:
    """Rows that are held out together, by index in ascending order, and those of them that are predicted."""

    rows: np.ndarray
    predicted: np.ndarray


def random_folds(n_rows: int, n_folds: int, rng: np.random.RandomState) -> list[Fold]:
    """Folds of nearly equal length, at most one per row."""
    return _thinned(np.array_split(rng.permutation(n_rows), min(n_folds, n_rows)), rng)


def folds_in_order(order: np.ndarray, n_folds: int, rng: np.random.RandomState, gap: bool = False) -> list[Fold]:
    """Folds of consecutive rows. With a gap, the ends of each are not predicted."""
    parts = [part for part in np.array_split(order, n_folds) if len(part)]
    ends = [int(_GAP * len(part)) if gap else 0 for part in parts]
    return _thinned(parts, rng, [part[end : len(part) - end] for part, end in zip(parts, ends, strict=True)])


def folds_of_groups(groups: np.ndarray, n_folds: int, rng: np.random.RandomState, order: np.ndarray) -> list[Fold]:
    """Folds of whole groups, of nearly equal numbers of rows. A group that is too large is cut by ``order`` (n,)."""
    names, group_of_row, sizes = np.unique(groups, return_inverse=True, return_counts=True)
    if sizes.max() >= _LARGEST_SHARE * len(groups):
        return folds_in_order(order[np.argsort(group_of_row[order], kind="stable")], n_folds, rng, gap=True)
    n_folds = min(n_folds, len(names))
    # The largest group first, each to the fold with the fewest rows. Equal ones come in random order.
    shuffled = rng.permutation(len(names))
    fold_of, load = np.empty(len(names), dtype=int), np.zeros(n_folds)
    for group in shuffled[np.argsort(-sizes[shuffled], kind="stable")]:
        fold_of[group] = np.argmin(load)
        load[fold_of[group]] += sizes[group]
    folds = fold_of[group_of_row]
    return _thinned([np.flatnonzero(folds == fold) for fold in range(n_folds)], rng)


def _thinned(parts: list[np.ndarray], rng: np.random.RandomState, inner: list[np.ndarray] | None = None) -> list[Fold]:
    """Folds of these rows. Of ``inner``, at most `PREDICTED_ROWS` in all are predicted, an equal share of each."""
    inner = parts if inner is None else inner
    share = min(1.0, PREDICTED_ROWS / sum(map(len, inner)))
    folds = []
    for rows, predicted in zip(parts, inner, strict=True):
        if share < 1.0:
            predicted = rng.permutation(predicted)[: max(round(share * len(predicted)), 1)]
        folds.append(Fold(np.sort(rows), np.sort(predicted)))
    return folds


def follow_a_path(order: np.ndarray, inputs: Callable[[np.ndarray], np.ndarray]) -> bool:
    """Whether consecutive rows are close to each other as in a trajectory, and not as in a sorted table.

    ``order`` (n,) are the rows in the user's order. ``inputs`` returns rows (n, ...) by index.
    """
    first = np.unique(np.linspace(0, len(order) - 2, min(len(order) - 1, _MOST_STEPS)).astype(int))
    starts, ends = (inputs(order[rows]).reshape(len(rows), -1) for rows in (first, first + 1))
    scale = starts.std(axis=0)
    starts, ends, scale = starts[:, scale > 0.0], ends[:, scale > 0.0], scale[scale > 0.0]
    steps = (ends - starts) / scale
    if steps.shape[1] < _SLOW_DIRECTIONS or (steps >= 0.0).all(axis=0).any() or (steps <= 0.0).all(axis=0).any():
        return False
    _, sizes, directions = np.linalg.svd(
        (starts - starts.mean(axis=0)) / scale / np.sqrt(len(starts)), full_matrices=False
    )
    kept = sizes > _FLAT
    along = steps @ (directions[kept].T / sizes[kept])
    shares = np.linalg.eigvalsh(along.T @ along / (2.0 * len(along)))
    return bool(np.sum(shares < _SLOW) >= _SLOW_DIRECTIONS)
