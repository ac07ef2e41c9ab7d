"""The rows of a data set: in the user's units wherever they are, and in internal units as the inference sees them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, Protocol, Self, TypeVar

import numpy as np
from sklearn.utils.random import sample_without_replacement

from .blocks import AnyBlock, Batch, Block, Blocks, LocalBlocks, SplitBlock
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
        Slice or indices -> RawRows.
    n_rows : int
    positions : ndarray of shape (n_rows,), optional
        Of each row among the user's; None if they are in the user's order.
    chosen : slice or ndarray of shape (n_rows,), optional
        Which of the rows that ``load`` knows these are; None are all.
    factors, log_variance : ndarray of shape (n_rows,), optional
        ω is multiplied by the first, and the second is added to log v.
    """

    def __init__(
        self,
        load: Callable[[slice | np.ndarray], RawRows],
        n_rows: int,
        positions: np.ndarray | None = None,
        chosen: slice | np.ndarray | None = None,
        factors: np.ndarray | None = None,
        log_variance: np.ndarray | None = None,
    ):
        self.load, self.n_rows, self.positions = load, n_rows, positions
        self._chosen, self._factors, self._log_variance = chosen, factors, log_variance

    @classmethod
    def holding(cls, rows: RawRows) -> Self:
        """Of rows in memory."""
        return cls(rows.__getitem__, len(rows.inputs))

    def take(self, rows: slice | np.ndarray) -> RawRows:
        """Load some rows."""
        if isinstance(self._chosen, slice):
            first, end = self._chosen.start, self._chosen.stop
            known: Any = (
                slice(first + rows.start, min(first + rows.stop, end)) if isinstance(rows, slice) else first + rows
            )
        else:
            known = rows if self._chosen is None else self._chosen[rows]
        raw = self.load(known)
        if self._factors is None or self._log_variance is None:
            return raw
        factors, log_variance = self._factors[rows], self._log_variance[rows]
        if raw.counts is None or raw.precision is None:
            return replace(raw, counts=np.ones(len(factors)), precision=factors, log_variance=log_variance)
        log_v = np.log(raw.counts / raw.precision)
        return replace(raw, precision=raw.precision * factors, log_variance=log_variance + log_v)

    def sum(self, function: Callable[[RawRows], Total]) -> Total:
        pieces = (self.take(slice(first, first + PASS_ROWS)) for first in range(0, self.n_rows, PASS_ROWS))
        return ordered_sum(map(function, pieces))

    def part(self, first: int, end: int) -> LocalSource:
        return LocalSource(self.take, end - first, chosen=slice(first, end))

    def some(self, rows: np.ndarray) -> LocalSource:
        """Rows by index, as a data set of their own."""
        return LocalSource(self.take, len(rows), chosen=rows)

    def weighed(self, factors: np.ndarray, log_variance: np.ndarray) -> LocalSource:
        """The same rows with ω times ``factors`` (n_rows,), and with so much added to their log v."""
        return LocalSource(self.take, self.n_rows, self.positions, None, factors, log_variance)

    def blocks(self, make: Callable[[RawRows], AnyBlock], n_inducing: int, threads: BlockMap, share: float) -> Blocks:
        return LocalBlocks(partial(made, self.take, make), self.n_rows, n_inducing, threads, share)


def made(take: Callable[[slice], RawRows], make: Callable[[RawRows], AnyBlock], rows: slice) -> AnyBlock:
    """A block of rows: take them, then make it."""
    return make(take(rows))


# --- in internal units: residuals in place of targets, of order one ---------------------------------------------------

# Residuals that scatter by no more than so many times the variance of the targets' rounding do not vary.
_ROUNDED = 16.0
# Mini-batches are drawn from so many rows at a time: shuffling needs memory.
_SHUFFLED_ROWS = 2**18


class Preparer(Protocol):
    """What `Rows` needs of a kernel."""

    def prepare(self, inputs: np.ndarray) -> Any:
        """What the kernel computes once of rows (n, d)."""


# From the user's units to the internal ones: (inputs, features, residuals) as `RawRows`.
ToInternal = Callable[[RawRows], RawRows]


@dataclass(frozen=True)
class MakeBlock:
    """Rows in the user's units -> `Block` of some outputs, or `SplitBlock` of groups of them.

    Attributes
    ----------
    kernels : tuple of Preparer
        One, or that of each group.
    to_internal : callable
    outputs : slice or list of int
    groups : tuple of slice, optional
        Of these outputs.
    """

    kernels: tuple[Preparer, ...]
    to_internal: ToInternal
    outputs: Columns = field(default_factory=lambda: slice(None))
    groups: tuple[slice, ...] | None = None

    def __call__(self, raw: RawRows) -> AnyBlock:
        rows = self.to_internal(raw).of(self.outputs)
        if self.groups is None:
            return _block(rows, self.kernels[0].prepare(rows.inputs))
        each = [rows.of(outputs) for outputs in self.groups]
        prepared = [kernel.prepare(own.inputs) for kernel, own in zip(self.kernels, each, strict=True)]
        return SplitBlock(
            {group.start: _block(own, made) for group, own, made in zip(self.groups, each, prepared, strict=True)}
        )


def _block(rows: RawRows, prepared: Any) -> Block:
    # A column's numbers side by side: products and errors take the columns, not the rows.
    linear = np.asfortranarray(np.hstack([rows.features, rows.targets]))
    block = Block(prepared, linear, rows.features.shape[1])
    if rows.counts is not None and rows.precision is not None:
        block.counts, block.roots = rows.counts, np.sqrt(rows.precision)
        linear *= block.roots[:, np.newaxis]
        log_v = np.log(rows.counts / rows.precision) if rows.log_variance is None else rows.log_variance
        block.log_variance = float(rows.counts @ log_v)
    return block


@dataclass(frozen=True)
class _InternalMoments:
    """Rows in the user's units -> moments of the inputs and the residuals in internal units."""

    to_internal: ToInternal

    def __call__(self, raw: RawRows) -> tuple[Moments, Moments]:
        rows = self.to_internal(raw)
        return Moments.of(rows.inputs, rows.counts), Moments.of(rows.targets, rows.precision)


@dataclass(frozen=True)
class Rows:
    """All rows of a data set, as an estimator hands them to the inference.

    Attributes
    ----------
    source : Source
        In the user's units.
    to_internal : callable
        From there to residuals in place of targets: y minus the reference linear part, in units of its own size.
    columns : slice or list of int
        The outputs that count.
    share : float
        Of the memory for blocks, for one of several fits at once.
    threads : BlockMap
        What blocks are worked on by.
    constant : ndarray of bool, optional
        Which of all outputs do not vary, so that what scatters of them is rounding.
    rounding : ndarray, optional
        The variance of the rounding of each output.
    """

    source: Source
    to_internal: ToInternal
    columns: Columns = field(default_factory=lambda: slice(None))
    share: float = 1.0
    threads: BlockMap = field(default_factory=BlockMap)
    constant: np.ndarray | None = None
    rounding: np.ndarray | None = None

    def __len__(self) -> int:
        return self.source.n_rows

    @cached_property
    def _moments(self) -> tuple[Moments, Moments]:
        return self.source.sum(_InternalMoments(self.to_internal))

    @property
    def inputs(self) -> Moments:
        """Of the inputs' columns (d,), or (o, d) where outputs have inputs of their own."""
        return self._moments[0].at(self.columns)

    @property
    def residuals(self) -> Moments:
        """Of the residuals of all outputs."""
        return self._moments[1]

    def noisier(self, variance: np.ndarray | None) -> Rows:
        """With noise variances (n, n_outputs) of all outputs in units of σ², of which these share the mean."""
        if variance is None:
            return self
        if not isinstance(self.source, LocalSource):
            raise TypeError("Rows of Dask arrays have no noise of their own.")
        own = variance[:, self.columns].mean(axis=1)
        return replace(self, source=self.source.weighed(1.0 / own, np.log(own)))

    @property
    def total(self) -> float:
        """Σ w: rows, each as often as it counts."""
        return self.inputs.n

    @property
    def mean_precision(self) -> float:
        """The mean of 1 / v, Σ ω / Σ w: a noise variance σ² is one of σ² / this, on average."""
        return self.residuals.n / self.inputs.n

    def scatter(self) -> np.ndarray:
        """The noise variance σ² (o,) that would explain how residuals vary; the mean of 1 / v where they do not."""
        scatter, rounding = self.residuals.variance, 0.0 if self.rounding is None else self.rounding
        varies = (scatter > _ROUNDED * rounding)[self.columns] & ~self.still()
        return np.where(varies, scatter[self.columns], 1.0) * self.mean_precision

    def still(self) -> np.ndarray:
        """Which outputs (o,) do not vary."""
        n_outputs = len(self.residuals.mean)
        constant = np.zeros(n_outputs, dtype=bool) if self.constant is None else self.constant
        return constant[self.columns]

    def some(self, chosen: np.ndarray) -> RawRows:
        """Rows by index, in internal units."""
        return self.to_internal(self.source.take(chosen)).of(self.columns)

    def sample(self, size: int, rng: np.random.RandomState) -> RawRows:
        """All rows, or ``size`` of them drawn at random, in their order."""
        chosen = np.arange(len(self))
        if len(self) > size:
            chosen = np.sort(sample_without_replacement(len(self), size, random_state=rng))
        return self.some(chosen)

    def blocks(
        self, kernel: Preparer | Sequence[Preparer], n_inducing: int, groups: tuple[slice, ...] | None = None
    ) -> Blocks:
        """The rows as blocks for a kernel with so many inducing points, perhaps split by groups with one each."""
        kernels = tuple(kernel) if isinstance(kernel, Sequence) else (kernel,)
        make = MakeBlock(kernels, self.to_internal, self.columns, groups)
        return self.source.blocks(make, n_inducing, self.threads, self.share)

    def batches(self, kernel: Preparer, size: int, rng: np.random.RandomState) -> Iterator[Batch]:
        """Mini-batches without end: each epoch shuffles the rows anew and leaves out what does not fill a batch."""
        size = min(size, len(self))
        make = MakeBlock((kernel,), self.to_internal, self.columns)
        # Parts of nearly equal length, none of them shorter than a batch.
        ends = np.linspace(0, len(self), max(len(self) // max(_SHUFFLED_ROWS, size), 1) + 1).astype(int)
        parts = list(pairwise(ends))
        while True:
            for part in rng.permutation(len(parts)) if len(parts) > 1 else (0,):
                first, last = parts[part]
                order = first + rng.permutation(last - first)
                for begin in range(0, len(order) - size + 1, size):
                    yield Batch(make(self.source.take(order[begin : begin + size])))

    def sampled(self, size: int, rng: np.random.RandomState) -> Rows:
        """``size`` of the rows, drawn at random and held in memory, in random order."""
        chosen = np.sort(sample_without_replacement(len(self), size, random_state=rng))
        raw, order = self.source.take(chosen), rng.permutation(size)
        return replace(self, source=LocalSource.holding(raw[order]))

    def as_given(self) -> np.ndarray:
        """The rows, by index, in the order in which the user gave them."""
        positions = self.source.positions
        return np.arange(len(self)) if positions is None else np.argsort(positions)

    def some_of(self, chosen: np.ndarray, share: float) -> Rows:
        """Rows by index, in ascending order where the source is Dask's, with a share of the memory."""
        return replace(self, source=self.source.some(chosen), share=self.share * share)

    def part(self, first: int, end: int, share: float) -> Rows:
        """Consecutive rows, with a share of the memory."""
        return replace(self, source=self.source.part(first, end), share=self.share * share)

    def within(self, group: slice) -> Rows:
        """The same rows with some of these outputs."""
        columns = np.arange(len(self.residuals.mean))[self.columns][group].tolist()
        return replace(self, columns=columns)

    def outputs(self, columns: Columns, share: float = 1.0) -> Rows:
        """The same rows with some of the outputs."""
        return replace(self, columns=columns, share=share)
