"""The rows that a fit uses: in which order, how often each counts, and how noisy each is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..utils.sklearn import safe_indexing
from ..utils.validation import LARGEST, as_floats, is_dask, is_frame

# Up to this many rows are sorted, which takes milliseconds.
ORDERED_ROWS = 10_000
_SMALLEST_VARIANCE = 1.0 / LARGEST
# No noise variance is smaller than so much of the median: float64 would lose the other rows in the sums over rows.
_SMALLEST_OF_MEDIAN = 1e-10


@dataclass(frozen=True)
class Chosen:
    """The rows of X and y that a fit uses."""

    # Number of rows that the user gave.
    n_samples: int
    # (n,): index of each used row in the user's X. Equal rows are merged into the first. None: all, in their order.
    positions: np.ndarray | None = None
    # (n,): as of `RawRows`.
    counts: np.ndarray | None = None
    precision: np.ndarray | None = None
    # (n_samples,): the used row that stands for each of the user's rows, -1 for rows of weight 0. None: ``positions``
    # says it all.
    merged_into: np.ndarray | None = None
    # Indices in the user's X of all rows of positive weight, in the order of ``positions``. None: they are
    # ``positions``.
    unmerged: np.ndarray | None = None

    @property
    def n_rows(self) -> int:
        """Number of used rows."""
        return self.n_samples if self.positions is None else len(self.positions)

    @classmethod
    def of(
        cls,
        X: Any,
        y: Any,
        sample_weight: Any = None,
        relative_variance: Any = None,
        groups: np.ndarray | None = None,
        ordered: bool = True,
        smallest: float | None = None,
    ) -> Chosen:
        """Choose the rows of X, an array or a data frame, with positive weight.

        If ``ordered`` and there are at most `ORDERED_ROWS` rows, they are sorted, and equal rows of the same group
        (n_samples,) are merged. Then a fit does not depend on the order of the rows, and a weight of 2 is the same as
        the row twice. A relative variance below ``smallest`` (None: `smallest_variance` of these rows) counts as that.
        """
        n = len(y)
        counts, variance = (
            _numbers(sample_weight, "sample_weight", n),
            _numbers(relative_variance, "relative_variance", n),
        )
        if counts is not None:
            check_weights(float(counts.min()), float(counts.max()))
        if variance is not None:
            check_variances(float(variance.min()), float(variance.max()))
            variance = np.maximum(variance, smallest_variance(variance, counts) if smallest is None else smallest)
        positions, merged_into, unmerged = np.arange(n) if counts is None else np.flatnonzero(counts), None, None
        if ordered and len(positions) <= ORDERED_ROWS:
            order, starts = _sorted(X, y, positions, variance, groups)
            unmerged = positions[order]
            positions = unmerged[starts]
            counts = np.add.reduceat(np.ones(len(unmerged)) if counts is None else counts[unmerged], starts)
            if len(starts) == n:
                unmerged = None
            else:
                merged_into = np.full(n, -1)
                merged_into[unmerged] = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(unmerged)))
        elif counts is not None:
            counts = counts[positions]
        if variance is not None:
            variance = variance[positions]
        # Weights that are all 1 are left out.
        counts, variance = (None if each is None or (each == 1.0).all() else each for each in (counts, variance))
        precision = counts
        if variance is not None:
            counts = np.ones(len(variance)) if counts is None else counts
            precision = counts / variance
        in_order = len(positions) == n and bool((positions == np.arange(n)).all())
        return cls(n, None if in_order else positions, counts, precision, merged_into, unmerged)

    def as_given(self, values: np.ndarray) -> np.ndarray:
        """Values (n, ...) of the used rows for each of the user's rows, (n_samples, ...). NaN for rows of weight 0."""
        if self.positions is None:
            return values
        row_of = self.merged_into
        if row_of is None:
            row_of = np.full(self.n_samples, -1)
            row_of[self.positions] = np.arange(len(self.positions))
        found = values[row_of].astype(np.float64)
        found[row_of < 0] = np.nan
        return found

    def labels_of(self, labels: np.ndarray) -> np.ndarray:
        """The labels (n,) of the used rows, from those of the user's rows."""
        return labels if self.positions is None else labels[self.positions]


def _sorted(
    X: Any, y: np.ndarray, rows: np.ndarray, variance: np.ndarray | None, groups: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """The order that sorts some rows by all columns, and where each new value begins in that order."""
    # Columns that are not numbers become numbers that differ where the values do.
    if is_frame(X):
        columns = [_as_numbers(np.asarray(safe_indexing(X, index, axis=1))) for index in range(X.shape[1])]
    else:
        columns = list(X.T)
    columns += [*np.reshape(y, (len(y), -1)).T, *(own for own in (variance, groups) if own is not None)]
    # Adding 0 makes -0.0 equal to 0.0.
    keys = [column[rows] + 0.0 if column.dtype.kind == "f" else column[rows] for column in columns]
    order = np.lexsort(keys[::-1])
    is_new = np.zeros(len(order), dtype=bool)
    is_new[0] = True
    for key in keys:
        own = key[order]
        is_new[1:] |= own[1:] != own[:-1]
    return order, np.flatnonzero(is_new)


def _as_numbers(column: np.ndarray) -> np.ndarray:
    if column.dtype.kind in "fiub":
        return column
    # For a map, 1 and "1" differ, and so do None and "None".
    words = [f"{type(value).__name__} {value!r}" for value in column.tolist()]
    return np.unique(words, return_inverse=True)[1]


def rows_of(values: Any, rows: np.ndarray | None) -> Any:
    """Some rows of an array or a data frame. None: all."""
    if rows is None:
        return values
    return safe_indexing(values, rows) if is_frame(values) else values[rows]


def check_weights(lowest: float, highest: float) -> None:
    """Raise ValueError if the lowest or the highest weight is out of range."""
    if not 0.0 <= lowest <= highest <= LARGEST:
        raise ValueError(
            f"sample_weight must be finite, not negative and at most {LARGEST:g}; its entries range from {lowest:g} to "
            f"{highest:g}."
        )
    if highest == 0.0:
        raise ValueError("sample_weight must be above 0 for at least one row; all its entries are zero.")


def check_variances(lowest: float, highest: float) -> None:
    """Raise ValueError if the lowest or the highest relative noise variance is out of range."""
    if not _SMALLEST_VARIANCE <= lowest <= highest <= LARGEST:
        raise ValueError(
            f"relative_variance must be positive, from {_SMALLEST_VARIANCE:g} to {LARGEST:g}; its entries range from "
            f"{lowest:g} to {highest:g}."
        )


def smallest_variance(variance: np.ndarray, counts: np.ndarray | None) -> float:
    """The smallest relative noise variance that float64 can represent next to those of the rows of positive weight."""
    used = variance if counts is None else variance[counts > 0.0]
    return _SMALLEST_OF_MEDIAN * float(np.median(used)) if len(used) else 0.0


def _numbers(values: Any, name: str, n_samples: int) -> np.ndarray | None:
    if values is None:
        return None
    numbers = as_floats(values.compute() if is_dask(values) else values, name)
    if numbers.shape != (n_samples,):
        raise ValueError(f"{name} must have the shape (n_samples,) = ({n_samples},); got {numbers.shape}.")
    return numbers
