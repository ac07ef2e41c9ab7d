"""How often rows count and how noisy they are, as the user says it, and which rows a fit sees, in which order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..utils.sklearn import safe_indexing
from ..utils.validation import LARGEST, as_floats, is_dask, is_frame

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


# --- sample_weight and relative_variance ------------------------------------------------------------------------------

_SMALLEST_VARIANCE = 1.0 / LARGEST


def chosen_rows(
    X: Any,
    y: Any,
    sample_weight: Any = None,
    relative_variance: Any = None,
    groups: np.ndarray | None = None,
    ordered: bool = True,
) -> Chosen:
    """The rows in memory that count.

    Parameters
    ----------
    X : ndarray or data frame of shape (n_samples, d)
    y : ndarray of shape (n_samples,) or (n_samples, o)
    sample_weight, relative_variance : array-like of shape (n_samples,), optional
        As `EVGPRegressor.fit` takes them.
    groups : ndarray of shape (n_samples,), optional
        Of integers: only rows of the same group are joined.
    ordered : bool, default=True
        Whether few rows are put into an order of their own, and equal ones joined.

    Returns
    -------
    chosen : Chosen

    Raises
    ------
    ValueError
        If they are not one number for each row, weights are negative or all 0, or variances are not positive.
    """
    counts = _numbers(sample_weight, "sample_weight", len(y))
    variance = _numbers(relative_variance, "relative_variance", len(y))
    if counts is not None:
        check_weights(float(counts.min()), float(counts.max()))
    if variance is not None:
        check_variances(float(variance.min()), float(variance.max()))
    return Chosen.of(X, y, counts, variance, groups) if ordered else Chosen.in_order(len(y), counts, variance)


def check_weights(lowest: float, highest: float) -> None:
    """Refuse weights by the lowest and the highest of them."""
    if not 0.0 <= lowest <= highest <= LARGEST:
        raise ValueError(
            f"sample_weight must be finite, not negative and at most {LARGEST:g}; its entries range from {lowest:g} to "
            f"{highest:g}."
        )
    if highest == 0.0:
        raise ValueError("sample_weight must be above 0 for at least one row; all its entries are zero.")


def check_variances(lowest: float, highest: float) -> None:
    """Refuse relative noise variances by the lowest and the highest of them."""
    if not _SMALLEST_VARIANCE <= lowest <= highest <= LARGEST:
        raise ValueError(
            f"relative_variance must be positive, from {_SMALLEST_VARIANCE:g} to {LARGEST:g}; its entries range from "
            f"{lowest:g} to {highest:g}."
        )


def _numbers(values: Any, name: str, n_samples: int) -> np.ndarray | None:
    if values is None:
        return None
    numbers = as_floats(values.compute() if is_dask(values) else values, name)
    if numbers.shape != (n_samples,):
        raise ValueError(f"{name} must have the shape (n_samples,) = ({n_samples},); got {numbers.shape}.")
    return numbers
