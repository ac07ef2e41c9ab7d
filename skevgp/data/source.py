"""A data set in the user's units, wherever its rows are: what can be summed over it, and its columns' moments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol, Self, TypeVar

import numpy as np

from .blocks import AnyBlock, Blocks, LocalBlocks
from .threads import BlockMap, ordered_sum

Total = TypeVar("Total")
# Of targets: which outputs.
Columns = slice | list[int]

# Rows that a pass over raw rows sees at once.
PASS_ROWS = 16_384


@dataclass(frozen=True)
class RawRows:
    """Some rows in the user's units.

    Attributes
    ----------
    inputs : ndarray of shape (n, d) or (n, o, d)
        The kernel's, of all outputs or of each.
    features : ndarray of shape (n, p) or (n, o, p)
        h(x), of all outputs or of each.
    targets : ndarray of shape (n, o)
    counts, precision : ndarray of shape (n,), optional
        w, how often a row counts, and ω = w / v, where its noise variance is σ² v. None: 1; both or neither.
    log_variance : ndarray of shape (n,), optional
        What the bound has for log v, where v is not known but for a q.
    """

    inputs: np.ndarray
    features: np.ndarray
    targets: np.ndarray
    counts: np.ndarray | None = None
    precision: np.ndarray | None = None
    log_variance: np.ndarray | None = None

    def __getitem__(self, rows: slice | np.ndarray) -> RawRows:
        """Some of them."""
        some: list[Any] = [None if part is None else part[rows] for part in self.parts]
        return RawRows(*some)

    @property
    def parts(self) -> tuple[Any, ...]:
        """Their arrays, or None, in the order of the attributes."""
        return self.inputs, self.features, self.targets, self.counts, self.precision, self.log_variance

    @property
    def total(self) -> float:
        """Σ w."""
        return len(self.inputs) if self.counts is None else float(self.counts.sum())

    def of(self, columns: Columns) -> RawRows:
        """Some of the outputs; of a single one inputs and features have no axis of outputs."""
        inputs, features = (of_outputs(values, columns) for values in (self.inputs, self.features))
        return replace(self, inputs=inputs, features=features, targets=self.targets[:, columns])


def of_outputs(values: np.ndarray, columns: Columns) -> np.ndarray:
    """Rows (n, k), or what is there for some outputs of rows for each output (n, o, k)."""
    if values.ndim == 2:
        return values
    values = values[:, columns]
    return values[:, 0] if values.shape[1] == 1 else values


def times_weights(features: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """h(x)ᵀ weights (n, o), of features (n, p) or (n, o, p) and the weights (o, p) of each output."""
    return features @ weights.T if features.ndim == 2 else np.einsum("nop,op->no", features, weights)


class Source(Protocol):
    """All rows of a data set: in memory, in a file, or on other machines. Their order never changes."""

    n_rows: int
    # Of each row among the user's; None if they are in his order.
    positions: np.ndarray | None

    def sum(self, function: Callable[[RawRows], Total]) -> Total:
        """The sum of function(piece) over pieces of the rows, by ``+``; ``function`` can be pickled."""

    def take(self, rows: np.ndarray) -> RawRows:
        """Some rows, by index."""

    def part(self, first: int, end: int) -> Source:
        """Consecutive rows, at least one."""

    def some(self, rows: np.ndarray) -> Source:
        """Rows by index, at least one; in ascending order if they are Dask's, whose chunks stay in theirs."""

    def blocks(self, make: Callable[[RawRows], AnyBlock], n_inducing: int, threads: BlockMap, share: float) -> Blocks:
        """The rows as blocks for so many inducing points, each made by ``make``, with a share of the memory."""


@dataclass(frozen=True)
class Moments:
    """Count, mean, scatter and range of columns; sums of them are exact (Chan, Golub & LeVeque 1983, eq. 2.1).

    Attributes
    ----------
    n : float
        The sum of the weights, if rows have some.
    mean, squares, lowest, highest : ndarray of shape (columns,), or (o, columns) of columns for each output
        ``squares`` is the sum of squared deviations from the mean.
    """

    n: float
    mean: np.ndarray
    squares: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray, weights: np.ndarray | None = None) -> Self:
        """Of an array (n, columns) with at least one row, and its rows' weights (n,), above 0; None are ones."""
        lowest, highest = values.min(axis=0), values.max(axis=0)
        n = len(values) if weights is None else float(weights.sum())
        # The mean of equal numbers may round.
        average = values.mean(axis=0) if weights is None else np.tensordot(weights, values, 1) / n
        mean = np.where(lowest == highest, lowest, average)
        squares = (values - mean) ** 2
        # What is too large for it is refused by its size.
        with np.errstate(over="ignore"):
            total = np.sum(squares, axis=0) if weights is None else np.tensordot(weights, squares, 1)
        return cls(n, mean, total, lowest, highest)

    def __add__(self, other: Self) -> Self:
        n, difference = self.n + other.n, other.mean - self.mean
        return type(self)(
            n,
            self.mean + difference * (other.n / n),
            self.squares + other.squares + difference**2 * (self.n * other.n / n),
            np.minimum(self.lowest, other.lowest),
            np.maximum(self.highest, other.highest),
        )

    def at(self, columns: Columns) -> Self:
        """Of some outputs, of columns (k,) or (o, k); of a single one without an axis of outputs."""
        each = (self.mean, self.squares, self.lowest, self.highest)
        return type(self)(self.n, *(of_outputs(values[np.newaxis], columns)[0] for values in each))

    @property
    def variance(self) -> np.ndarray:
        return self.squares / self.n

    @property
    def rms(self) -> np.ndarray:
        """Root mean square."""
        return np.sqrt(self.variance + self.mean**2)

    @property
    def largest(self) -> np.ndarray:
        """The largest absolute value."""
        return np.maximum(np.abs(self.lowest), np.abs(self.highest))


def moments_of_rows(raw: RawRows) -> tuple[Moments, Moments, Moments]:
    """Of inputs, features and targets, whose weights are ω: the noisier a row, the less it says of them."""
    return (
        Moments.of(raw.inputs, raw.counts),
        Moments.of(raw.features, raw.counts),
        Moments.of(raw.targets, raw.precision),
    )


class LocalSource:
    """Rows that this process can load.

    Parameters
    ----------
    load : callable
        A slice, or indices -> `RawRows`; may be called from several threads.
    n_rows : int
    positions : ndarray of shape (n_rows,), optional
    """

    def __init__(self, load: Callable[[slice | np.ndarray], RawRows], n_rows: int, positions: np.ndarray | None = None):
        self.load, self.n_rows, self.positions = load, n_rows, positions

    @classmethod
    def of(cls, inputs: np.ndarray, features: np.ndarray, targets: np.ndarray) -> Self:
        """Of arrays."""
        return cls.holding(RawRows(inputs, features, targets))

    @classmethod
    def holding(cls, rows: RawRows) -> Self:
        """Of rows in memory."""
        return cls(rows.__getitem__, len(rows.inputs))

    def sum(self, function: Callable[[RawRows], Total]) -> Total:
        pieces = (self.load(slice(first, first + PASS_ROWS)) for first in range(0, self.n_rows, PASS_ROWS))
        return ordered_sum(map(function, pieces))

    def take(self, rows: np.ndarray) -> RawRows:
        return self.load(rows)

    def part(self, first: int, end: int) -> LocalSource:
        return LocalSource(_Part(self.load, first, end), end - first)

    def some(self, rows: np.ndarray) -> LocalSource:
        """Rows by index, as a data set of their own."""
        return LocalSource(_Some(self.load, rows), len(rows))

    def weighed(self, factors: np.ndarray, log_variance: np.ndarray) -> LocalSource:
        """The same rows with ω times ``factors`` (n_rows,), and with so much added to their log v."""
        return LocalSource(_Weighed(self.load, factors, log_variance), self.n_rows, self.positions)

    def blocks(self, make: Callable[[RawRows], AnyBlock], n_inducing: int, threads: BlockMap, share: float) -> Blocks:
        return LocalBlocks(self.through(make), self.n_rows, n_inducing, threads, share)

    def through(self, make: Callable[[RawRows], AnyBlock]) -> Callable[[slice], AnyBlock]:
        """Load, then make."""
        return _Through(self.load, make)


@dataclass(frozen=True)
class _Part:
    load: Callable[[slice | np.ndarray], RawRows]
    first: int
    end: int

    def __call__(self, rows: slice | np.ndarray) -> RawRows:
        if isinstance(rows, slice):
            return self.load(slice(self.first + rows.start, min(self.first + rows.stop, self.end)))
        return self.load(self.first + rows)


@dataclass(frozen=True)
class _Some:
    load: Callable[[slice | np.ndarray], RawRows]
    chosen: np.ndarray

    def __call__(self, rows: slice | np.ndarray) -> RawRows:
        return self.load(self.chosen[rows])


@dataclass(frozen=True)
class _Weighed:
    load: Callable[[slice | np.ndarray], RawRows]
    factors: np.ndarray
    log_variance: np.ndarray

    def __call__(self, rows: slice | np.ndarray) -> RawRows:
        raw, factors, log_variance = self.load(rows), self.factors[rows], self.log_variance[rows]
        if raw.counts is None or raw.precision is None:
            return replace(raw, counts=np.ones(len(factors)), precision=factors, log_variance=log_variance)
        log_v = np.log(raw.counts / raw.precision)
        return replace(raw, precision=raw.precision * factors, log_variance=log_variance + log_v)


@dataclass(frozen=True)
class _Through:
    load: Callable[[slice | np.ndarray], RawRows]
    make: Callable[[RawRows], AnyBlock]

    def __call__(self, rows: slice) -> AnyBlock:
        return self.make(self.load(rows))
