"""Which of the user's rows count, how often, and in which order.

Few rows are put into an order that follows from what they are, and equal ones are joined. So a row that is there twice
and one that counts twice are the same problem, and no result depends on the order of the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..utils.sklearn import safe_indexing
from ..utils.validation import is_frame

# Up to so many rows are ordered: that takes milliseconds.
ORDERED_ROWS = 10_000


@dataclass(frozen=True)
class Chosen:
    """The rows of X and y that a fit sees.

    Attributes
    ----------
    n_samples : int
        Rows that the user gave.
    positions : ndarray of shape (n,), optional
        Of these rows among the user's; of those that were joined, the first. None: all, in his order.
    counts, precision : ndarray of shape (n,), optional
        As of `RawRows`.
    alike : ndarray of shape (n_samples,), optional
        Which of these rows each of the user's is; -1 for rows of weight 0. None: as ``positions`` says.
    repeated : ndarray, optional
        Positions of all rows that count, none of them joined, in the same order. None: ``positions``.
    """

    n_samples: int
    positions: np.ndarray | None = None
    counts: np.ndarray | None = None
    precision: np.ndarray | None = None
    alike: np.ndarray | None = None
    repeated: np.ndarray | None = None

    @property
    def n_rows(self) -> int:
        """How many there are."""
        return self.n_samples if self.positions is None else len(self.positions)

    def as_given(self, values: np.ndarray) -> np.ndarray:
        """What is known of each row (n, ...) for each of the user's, (n_samples, ...); NaN for rows of weight 0."""
        if self.positions is None:
            return values
        alike = self.alike
        if alike is None:
            alike = np.full(self.n_samples, -1)
            alike[self.positions] = np.arange(len(self.positions))
        found = values[alike].astype(np.float64)
        found[alike < 0] = np.nan
        return found

    def labels_of(self, labels: np.ndarray) -> np.ndarray:
        """Of labels (n_samples,) of the user's rows those of these, (n,)."""
        return labels if self.positions is None else labels[self.positions]

    @classmethod
    def in_order(cls, n_samples: int, counts: np.ndarray | None, variance: np.ndarray | None) -> Chosen:
        """All rows that count, in the user's order; arguments as of `of`."""
        if counts is None or counts.all():
            return cls(n_samples, None, *_counts_and_precision(counts, variance))
        kept = np.flatnonzero(counts)
        return cls(n_samples, kept, *_counts_and_precision(counts[kept], None if variance is None else variance[kept]))

    @classmethod
    def of(
        cls,
        X: Any,
        y: np.ndarray,
        counts: np.ndarray | None = None,
        variance: np.ndarray | None = None,
        labels: np.ndarray | None = None,
    ) -> Chosen:
        """Choose them; up to `ORDERED_ROWS` are ordered, and equal ones joined.

        Parameters
        ----------
        X : ndarray or data frame of shape (n_samples, d)
        y : ndarray of shape (n_samples,) or (n_samples, o)
        counts : ndarray of shape (n_samples,), optional
            How often each row counts, some of them above 0; None are ones.
        variance : ndarray of shape (n_samples,), optional
            Noise variances in units of σ², above 0; None are ones.
        labels : ndarray of shape (n_samples,), optional
            Only rows with the same label are joined.
        """
        n = len(y)
        kept = np.arange(n) if counts is None else np.flatnonzero(counts)
        if len(kept) > ORDERED_ROWS:
            return cls.in_order(n, counts, variance)
        keys = [*_columns(X), *np.reshape(y, (n, -1)).T]
        keys += [column for column in (variance, labels) if column is not None]
        # Whatever its sign, 0 is 0.
        keys = [column[kept] + 0.0 if column.dtype.kind == "f" else column[kept] for column in keys]
        order = np.lexsort(keys[::-1])
        starts = np.flatnonzero(_differ_from_the_one_before(keys, order))
        repeated = kept[order]
        positions, alike = repeated[starts], np.full(n, -1)
        alike[repeated] = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(repeated)))
        counts = np.add.reduceat(np.ones(len(kept)) if counts is None else counts[repeated], starts)
        weights = _counts_and_precision(counts, None if variance is None else variance[positions])
        if len(starts) == n:
            # None were joined, and perhaps they came in order.
            in_order = bool((positions == np.arange(n)).all())
            return cls(n, None if in_order else positions, *weights)
        return cls(n, positions, *weights, alike, repeated)


def _counts_and_precision(
    counts: np.ndarray | None, variance: np.ndarray | None
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """The w and w / v of rows; neither if all are 1."""
    counts, variance = (None if each is None or (each == 1.0).all() else each for each in (counts, variance))
    if variance is None:
        return counts, counts
    counts = np.ones(len(variance)) if counts is None else counts
    return counts, counts / variance


def _columns(X: Any) -> list[np.ndarray]:
    """The columns, as numbers; what is no number as any that tell words apart and order them."""
    if not is_frame(X):
        return list(X.T)
    return [_as_numbers(np.asarray(safe_indexing(X, index, axis=1))) for index in range(X.shape[1])]


def _as_numbers(column: np.ndarray) -> np.ndarray:
    if column.dtype.kind in "fiub":
        return column
    # 1 and "1", None and "None" are as different to a map as any other words.
    words = [f"{type(value).__name__} {value!r}" for value in column.tolist()]
    return np.unique(words, return_inverse=True)[1]


def _differ_from_the_one_before(keys: Sequence[np.ndarray], order: np.ndarray) -> np.ndarray:
    """Whether each of the rows in order is another than the row before, in any of the keys."""
    differ = np.zeros(len(order), dtype=bool)
    differ[0] = True
    for key in keys:
        column = key[order]
        differ[1:] |= column[1:] != column[:-1]
    return differ


def rows_of(values: Any, rows: np.ndarray | None) -> Any:
    """Some rows of an array or a data frame, as they are; None are all."""
    if rows is None:
        return values
    return safe_indexing(values, rows) if is_frame(values) else values[rows]
