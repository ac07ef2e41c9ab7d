"""Which rows are left out together, to be predicted from the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# What few rows tell is told by random folds of no fewer rows than this, all together.
FEWEST_ROWS = 50
# A standard deviation needs no more than so many rows: of more, so many are drawn to be predicted.
PREDICTED_ROWS = 2000
# Groups of which one has this share of the rows, as one of two has, are no sample of groups, and too few rows are left
# to predict it from. Blocks of consecutive rows are then left out; so much of each at either end, which is like its
# neighbours, is not predicted.
_LARGEST_SHARE, _GAP = 0.5, 0.15
# Along slow directions the square of a step from row to row is this share of that between any two rows, on average. One
# direction may be slow in a sorted table. So many steps are looked at.
_SLOW, _SLOW_DIRECTIONS, _STEPS = 0.1, 2, 2000
# Directions along which inputs vary less than this, in standard deviations of their columns, say nothing.
_FLAT = 1e-3


@dataclass(frozen=True)
class CrossValidation:
    """How rows are left out.

    Attributes
    ----------
    n_folds : int
        No more than there are rows or groups.
    groups : ndarray of shape (n,), optional
        Which rows are left out together; None: chance says.
    wide : bool, default=True
        Whether nobody set bounds for the signal: it may then leave those of the fit, which keep kernels from becoming
        long waves of huge height. Here the kernel's shape stays.
    """

    n_folds: int
    groups: np.ndarray | None = None
    wide: bool = True

    def folds(self, order: np.ndarray, rng: np.random.RandomState) -> list[Fold]:
        """Folds of all rows; none if these are too few. ``order`` are the rows (n,) as they follow each other."""
        if len(order) < FEWEST_ROWS:
            return []
        if self.groups is None:
            return random_folds(len(order), self.n_folds, rng)
        return folds_of_groups(self.groups, self.n_folds, rng, order)


@dataclass(frozen=True)
class Fold:
    """Rows that are left out together.

    Attributes
    ----------
    rows : ndarray
        By index, in ascending order.
    predicted : ndarray
        Those of them that are predicted, at least one.
    """

    rows: np.ndarray
    predicted: np.ndarray


def random_folds(n_rows: int, n_folds: int, rng: np.random.RandomState) -> list[Fold]:
    """Folds of nearly equal length; as many as there are rows if these are fewer."""
    return _thinned(np.array_split(rng.permutation(n_rows), min(n_folds, n_rows)), rng)


def folds_in_order(order: np.ndarray, n_folds: int, rng: np.random.RandomState, gap: bool = False) -> list[Fold]:
    """Folds of rows that follow each other in an order; perhaps only what is inside of each is predicted."""
    parts = [part for part in np.array_split(order, n_folds) if len(part)]
    ends = [int(_GAP * len(part)) if gap else 0 for part in parts]
    return _thinned(parts, rng, [part[end : len(part) - end] for part, end in zip(parts, ends, strict=True)])


def folds_of_groups(groups: np.ndarray, n_folds: int, rng: np.random.RandomState, order: np.ndarray) -> list[Fold]:
    """Folds of whole groups, of nearly equal numbers of rows.

    Parameters
    ----------
    groups : ndarray of shape (n,)
        To which group each row belongs.
    n_folds : int
    rng : RandomState
    order : ndarray of shape (n,)
        The rows as they follow each other, by which a group is cut where it must be.
    """
    names, own, sizes = np.unique(groups, return_inverse=True, return_counts=True)
    if sizes.max() >= _LARGEST_SHARE * len(groups):
        return folds_in_order(order[np.argsort(own[order], kind="stable")], n_folds, rng, gap=True)
    n_folds = min(n_folds, len(names))
    # The largest first, each to the fold that has least; which of equal ones comes first is left to chance.
    shuffled = rng.permutation(len(names))
    fold_of, load = np.empty(len(names), dtype=int), np.zeros(n_folds)
    for group in shuffled[np.argsort(-sizes[shuffled], kind="stable")]:
        fold_of[group] = np.argmin(load)
        load[fold_of[group]] += sizes[group]
    folds = fold_of[own]
    return _thinned([np.flatnonzero(folds == fold) for fold in range(n_folds)], rng)


def _thinned(parts: list[np.ndarray], rng: np.random.RandomState, inner: list[np.ndarray] | None = None) -> list[Fold]:
    """Folds of these rows; of ``inner`` no more than `PREDICTED_ROWS` are predicted, an equal share of each."""
    inner = parts if inner is None else inner
    share = min(1.0, PREDICTED_ROWS / sum(map(len, inner)))
    folds = []
    for rows, own in zip(parts, inner, strict=True):
        if share < 1.0:
            own = rng.permutation(own)[: max(round(share * len(own)), 1)]
        folds.append(Fold(np.sort(rows), np.sort(own)))
    return folds


def follow_a_path(order: np.ndarray, inputs: Callable[[np.ndarray], np.ndarray]) -> bool:
    """Whether rows that follow each other are near each other, as in a trajectory and not as in a sorted table.

    Parameters
    ----------
    order : ndarray of shape (n,)
        The rows as they follow each other.
    inputs : callable
        Of rows by index, (n, ...).
    """
    first = np.unique(np.linspace(0, len(order) - 2, min(len(order) - 1, _STEPS)).astype(int))
    here, there = (inputs(order[rows]).reshape(len(rows), -1) for rows in (first, first + 1))
    scale = here.std(axis=0)
    here, there, scale = here[:, scale > 0.0], there[:, scale > 0.0], scale[scale > 0.0]
    steps = (there - here) / scale
    if steps.shape[1] < _SLOW_DIRECTIONS or (steps >= 0.0).all(axis=0).any() or (steps <= 0.0).all(axis=0).any():
        return False
    _, sizes, directions = np.linalg.svd((here - here.mean(axis=0)) / scale / np.sqrt(len(here)), full_matrices=False)
    kept = sizes > _FLAT
    along = steps @ (directions[kept].T / sizes[kept])
    shares = np.linalg.eigvalsh(along.T @ along / (2.0 * len(along)))
    return bool(np.sum(shares < _SLOW) >= _SLOW_DIRECTIONS)
