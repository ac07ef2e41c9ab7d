"""The rows of a data set: in the user's units wherever they are stored, and in internal units for the inference."""

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
# Indices of outputs.
Columns = slice | list[int]

# With a smaller unit, the lowest noise variance in the user's units would be rounded to 0.
SMALLEST_UNIT = 1e-140
# A sum over rows loads this many rows at once.
PASS_ROWS = 16_384


@dataclass(frozen=True)
class RawRows:
    """Some rows, in the user's units or in internal ones."""

    # (n, d), or (n, o, d) if each output has its own: the kernel's inputs.
    inputs: np.ndarray
    # (n, p), or (n, o, p) if each output has its own: h(x).
    features: np.ndarray
    # (n, o): y, or residuals in internal units.
    targets: np.ndarray
    # (n,): the weight w of each row, and ω = w / v, where the row's noise variance is σ² v. Both are None if all are 1.
    counts: np.ndarray | None = None
    precision: np.ndarray | None = None
    # (n,): E[log v], if v has a distribution q(v). None: log v.
    log_variance: np.ndarray | None = None

    def __getitem__(self, rows: slice | np.ndarray) -> RawRows:
        some: list[Any] = [None if values is None else values[rows] for values in vars(self).values()]
        return RawRows(*some)

    def followed_by(self, other: RawRows) -> RawRows:
        """These rows and others. If only one of both has weights, those of the other are 1."""
        parts: list[RawRows] = [self, other]
        if self.counts is not None or other.counts is not None:
            parts = [part if part.counts is not None else part.with_unit_weights() for part in parts]
        joined: list[Any] = [
            None if any(values is None for values in pair) else np.concatenate(pair)
            for pair in zip(*(vars(part).values() for part in parts), strict=True)
        ]
        return RawRows(*joined)

    def with_unit_weights(self) -> RawRows:
        """The same rows with weights and noise variances of 1."""
        ones = np.ones(len(self.inputs))
        return replace(self, counts=ones, precision=ones)

    @property
    def total(self) -> float:
        """Σ w."""
        return len(self.inputs) if self.counts is None else float(self.counts.sum())

    def of(self, columns: Columns) -> RawRows:
        """Some outputs of these rows."""
        inputs, features = of_outputs(self.inputs, columns), of_outputs(self.features, columns)
        return replace(self, inputs=inputs, features=features, targets=self.targets[:, columns])


def of_outputs(values: np.ndarray, columns: Columns) -> np.ndarray:
    """Inputs or features of some outputs: (n, k) for all outputs stay, (n, o, k) become (n, k) for a single output."""
    if values.ndim == 2:
        return values
    values = values[:, columns]
    return values[:, 0] if values.shape[1] == 1 else values


def times_weights(features: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """h(x)ᵀ β of each output, (n, o), for features (n, p) or (n, o, p) and weights β (o, p)."""
    return features @ weights.T if features.ndim == 2 else np.einsum("nop,op->no", features, weights)


class Source(Protocol):
    """All rows of a data set: in memory, in a file, or on other machines. Their order never changes."""

    n_rows: int
    # (n_rows,): index of each row in the user's X. None: the rows are in the user's order.
    positions: np.ndarray | None

    def sum(self, function: Callable[[RawRows], Total]) -> Total:
        """The sum of function(piece) over pieces of the rows, by ``+``. It must be possible to pickle ``function``."""

    def take(self, rows: np.ndarray, /) -> RawRows:
        """Load rows by index."""

    def some(self, rows: np.ndarray) -> Source:
        """A data set of one or more rows by index. Dask needs ascending order, because chunks keep theirs."""

    def blocks(self, make: Callable[[RawRows], AnyBlock], n_inducing: int, threads: BlockMap, share: float) -> Blocks:
        """Blocks for a number of inducing points. ``make`` makes each, and ``share`` is their share of the memory."""


@dataclass(frozen=True)
class Moments:
    """Count, mean, scatter and range of columns. They can be added (Chan, Golub & LeVeque 1983, equation 2.1)."""

    # Σ w, or the number of rows.
    n: float
    # Each (columns,), or (o, columns) if each output has its own. ``squares`` is Σ w (x - mean)².
    mean: np.ndarray
    squares: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray, weights: np.ndarray | None = None) -> Self:
        """The moments of at least one row (n, columns) with positive weights (n,)."""
        lowest, highest = values.min(axis=0), values.max(axis=0)
        n = len(values) if weights is None else float(weights.sum())
        # The mean of equal numbers may round.
        average = values.mean(axis=0) if weights is None else np.tensordot(weights, values, 1) / n
        mean = np.where(lowest == highest, lowest, average)
        squares = (values - mean) ** 2
        # Numbers whose squares overflow raise an error elsewhere.
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
        """The moments of some outputs, as `of_outputs` selects them."""
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

    @property
    def constant(self) -> np.ndarray:
        """Whether the entries of a column differ by a few rounding errors only."""
        return np.asarray(self.highest - self.lowest <= 8.0 * np.finfo(float).eps * self.largest)

    @property
    def centre(self) -> np.ndarray:
        """The mean of each column. For a constant column, exactly the constant."""
        return np.where(self.constant, self.lowest, self.mean)

    @property
    def scale(self) -> np.ndarray:
        """The standard deviation of each column. 1 for a constant column."""
        scale = np.sqrt(self.variance)
        return np.where(self.constant | (scale <= SMALLEST_UNIT), 1.0, scale)


def moments_of_rows(raw: RawRows) -> tuple[Moments, Moments, Moments]:
    """Moments of inputs and features, weighted by w, and of targets, weighted by ω."""
    return (
        Moments.of(raw.inputs, raw.counts),
        Moments.of(raw.features, raw.counts),
        Moments.of(raw.targets, raw.precision),
    )


@dataclass(eq=False)
class LocalSource:
    """Rows that this process can load."""

    # Loads a slice or indices. A slice may end after the last row.
    take: Callable[[slice | np.ndarray], RawRows]
    n_rows: int
    # As of `Source`.
    positions: np.ndarray | None = None

    @classmethod
    def holding(cls, rows: RawRows) -> Self:
        """Rows in memory."""
        return cls(rows.__getitem__, len(rows.inputs))

    def sum(self, function: Callable[[RawRows], Total]) -> Total:
        pieces = (self.take(slice(first, first + PASS_ROWS)) for first in range(0, self.n_rows, PASS_ROWS))
        return ordered_sum(map(function, pieces))

    def some(self, rows: np.ndarray) -> LocalSource:
        return LocalSource(partial(_some, self.take, rows), len(rows))

    def reweighted(self, factors: np.ndarray, log_variance: np.ndarray) -> LocalSource:
        """The same rows, with ω multiplied by factors (n_rows,), and with log_variance (n_rows,) added to log v."""
        return LocalSource(partial(_reweighted, self.take, factors, log_variance), self.n_rows, self.positions)

    def counted(self, factors: np.ndarray) -> LocalSource:
        """The same rows, each of which counts ``factors`` (n_rows,) times as much: w and ω are multiplied by them."""
        return LocalSource(partial(_counted, self.take, factors), self.n_rows, self.positions)

    def with_targets(self, targets: np.ndarray) -> LocalSource:
        """The same rows with other targets (n_rows, o)."""
        return LocalSource(partial(_with_targets, self.take, targets), self.n_rows, self.positions)

    def blocks(
        self,
        make: Callable[[RawRows], AnyBlock],
        n_inducing: int,
        threads: BlockMap | None = None,
        share: float = 1.0,
        keep: bool = True,
    ) -> Blocks:
        return LocalBlocks(partial(self._block, make), self.n_rows, n_inducing, threads, share, keep)

    def _block(self, make: Callable[[RawRows], AnyBlock], rows: slice) -> AnyBlock:
        return make(self.take(rows))


# Workers of Dask receive sources. Therefore they hold partial functions, which can be pickled, and no closures.


def _some(take: Callable[[np.ndarray], RawRows], chosen: np.ndarray, rows: slice | np.ndarray) -> RawRows:
    return take(chosen[rows])


def _counted(take: Callable[[slice | np.ndarray], RawRows], factors: np.ndarray, rows: slice | np.ndarray) -> RawRows:
    raw, factors = take(rows), factors[rows]
    if raw.counts is None or raw.precision is None:
        return replace(raw, counts=factors, precision=factors)
    return replace(raw, counts=raw.counts * factors, precision=raw.precision * factors)


def _with_targets(
    take: Callable[[slice | np.ndarray], RawRows], targets: np.ndarray, rows: slice | np.ndarray
) -> RawRows:
    return replace(take(rows), targets=targets[rows])


def _reweighted(
    take: Callable[[slice | np.ndarray], RawRows],
    factors: np.ndarray,
    log_variance: np.ndarray,
    rows: slice | np.ndarray,
) -> RawRows:
    raw, factors, log_variance = take(rows), factors[rows], log_variance[rows]
    if raw.counts is None or raw.precision is None:
        return replace(raw, counts=np.ones(len(factors)), precision=factors, log_variance=log_variance)
    log_v = np.log(raw.counts / raw.precision)
    return replace(raw, precision=raw.precision * factors, log_variance=log_variance + log_v)


# --- in internal units: residuals of order one instead of targets -----------------------------------------------------

# Residuals are constant if their variance is at most this many times the variance of the targets' rounding.
_ROUNDED = 16.0
# Mini-batches are drawn from this many rows at a time, because a permutation needs memory.
_SHUFFLED_ROWS = 2**18

# From the user's units to internal ones: targets become residuals.
ToInternal = Callable[[RawRows], RawRows]


class Preparer(Protocol):
    """The part of a kernel that `Rows` needs."""

    def prepare(self, inputs: np.ndarray) -> Any:
        """Compute all that depends on the rows (n, d) only, once for all parameters."""


def block_of(
    raw: RawRows,
    kernels: Sequence[Preparer],
    to_internal: ToInternal,
    columns: Columns = slice(None),
    groups: Sequence[slice] | None = None,
) -> AnyBlock:
    """The block of some outputs of rows in the user's units.

    With groups of these outputs, it is a `SplitBlock`. ``kernels`` are those of the groups, or one.
    """
    rows = to_internal(raw).of(columns)
    blocks = []
    for kernel, own in zip(kernels, [rows] if groups is None else map(rows.of, groups), strict=True):
        prepared = kernel.prepare(own.inputs)
        # Products read columns, so each column is contiguous.
        linear = np.asfortranarray(np.hstack([own.features, own.targets]))
        block = Block(prepared, linear, own.features.shape[1])
        if own.counts is not None and own.precision is not None:
            block.counts, block.roots = own.counts, np.sqrt(own.precision)
            linear *= block.roots[:, np.newaxis]
            log_v = np.log(own.counts / own.precision) if own.log_variance is None else own.log_variance
            block.log_variance = float(own.counts @ log_v)
        blocks.append(block)
    if groups is None:
        return blocks[0]
    return SplitBlock({group.start: block for group, block in zip(groups, blocks, strict=True)})


def _as_it_is(raw: RawRows) -> RawRows:
    return raw


def _internal_moments(to_internal: ToInternal, raw: RawRows) -> tuple[Moments, Moments]:
    """Moments of the inputs, weighted by w, and of the residuals, weighted by ω."""
    rows = to_internal(raw)
    return Moments.of(rows.inputs, rows.counts), Moments.of(rows.targets, rows.precision)


@dataclass(frozen=True)
class Rows:
    """All rows of a data set in internal units."""

    # Rows in the user's units, and the function that converts them.
    source: Source
    to_internal: ToInternal
    # The outputs that are used. `residuals`, `constant` and `rounding` are those of all outputs.
    columns: Columns = field(default_factory=lambda: slice(None))
    # Share of the memory for blocks, for one of several fits at once.
    share: float = 1.0
    # The threads that work on blocks.
    threads: BlockMap = field(default_factory=BlockMap)
    # (outputs,): whether residuals are constant except for rounding. None: False.
    constant: np.ndarray | None = None
    # (outputs,): the variance of the residuals' rounding. None: 0.
    rounding: np.ndarray | None = None

    @classmethod
    def in_internal_units(cls, raw: RawRows) -> Self:
        """Rows that are in internal units already."""
        return cls(LocalSource.holding(raw), _as_it_is)

    def __len__(self) -> int:
        return self.source.n_rows

    @cached_property
    def _moments(self) -> tuple[Moments, Moments]:
        return self.source.sum(partial(_internal_moments, self.to_internal))

    @property
    def inputs(self) -> Moments:
        """Moments of the inputs' columns (d,), or (o, d) if each output has its own."""
        return self._moments[0].at(self.columns)

    @property
    def residuals(self) -> Moments:
        """Moments of the residuals of all outputs."""
        return self._moments[1]

    @property
    def total(self) -> float:
        """Σ w."""
        return self._moments[0].n

    @property
    def mean_precision(self) -> float:
        """Σ ω / Σ w, the weighted mean of 1 / v. A typical noise variance of a row is σ² divided by it."""
        return self._moments[1].n / self._moments[0].n

    def is_constant(self) -> np.ndarray:
        """Whether each output (o,) is constant."""
        n_outputs = len(self.residuals.mean)
        return (np.zeros(n_outputs, dtype=bool) if self.constant is None else self.constant)[self.columns]

    def scatter(self) -> np.ndarray:
        """The noise variance σ² (o,) that explains the variance of the residuals, `mean_precision` if constant."""
        scatter, rounding = self.residuals.variance, 0.0 if self.rounding is None else self.rounding
        varies = (scatter > _ROUNDED * rounding)[self.columns] & ~self.is_constant()
        return np.where(varies, scatter[self.columns], 1.0) * self.mean_precision

    # --- some rows or outputs -----------------------------------------------------------------------------------------

    def some(self, chosen: np.ndarray) -> RawRows:
        """Load rows by index, in internal units."""
        return self.to_internal(self.source.take(chosen)).of(self.columns)

    def chosen(self, size: int, rng: np.random.RandomState) -> np.ndarray:
        """Indices of all rows, or of ``size`` random ones, in their order."""
        if len(self) <= size:
            return np.arange(len(self))
        return np.sort(sample_without_replacement(len(self), size, random_state=rng))

    def sample(self, size: int, rng: np.random.RandomState) -> RawRows:
        """Load all rows, or ``size`` random rows in their order."""
        return self.some(self.chosen(size, rng))

    def random_subset(self, size: int, rng: np.random.RandomState) -> Rows:
        """``size`` random rows in random order, held in memory."""
        chosen = np.sort(sample_without_replacement(len(self), size, random_state=rng))
        raw, order = self.source.take(chosen), rng.permutation(size)
        return replace(self, source=LocalSource.holding(raw[order]))

    def subset(self, chosen: np.ndarray, share: float = 1.0) -> Rows:
        """Rows by index, with a share of the memory. Dask needs ascending order."""
        return replace(self, source=self.source.some(chosen), share=self.share * share)

    def outputs(self, columns: Columns, share: float = 1.0) -> Rows:
        """The same rows with some of these outputs, and a share of the memory."""
        if self.columns != slice(None):
            columns = np.arange(len(self.residuals.mean))[self.columns][columns].tolist()
        return replace(self, columns=columns, share=self.share * share)

    def noisier(self, variance: np.ndarray | None) -> Rows:
        """The same rows with noise variances (n, outputs) in units of σ². These outputs share their mean."""
        if variance is None:
            return self
        if not isinstance(self.source, LocalSource):
            raise TypeError("Rows of Dask arrays have no noise of their own.")
        own = variance[:, self.columns].mean(axis=1)
        return replace(self, source=self.source.reweighted(1.0 / own, np.log(own)))

    def counted(self, factors: np.ndarray) -> Rows:
        """The same rows, each of which counts ``factors`` (n_rows,) times as much."""
        if not isinstance(self.source, LocalSource):
            raise TypeError("Rows of Dask arrays count once.")
        return replace(self, source=self.source.counted(factors))

    def user_order(self) -> np.ndarray:
        """Indices of the rows, in the order in which the user gave them."""
        positions = self.source.positions
        return np.arange(len(self)) if positions is None else np.argsort(positions)

    # --- blocks and mini-batches --------------------------------------------------------------------------------------

    def blocks(
        self, kernel: Preparer | Sequence[Preparer], n_inducing: int, groups: tuple[slice, ...] | None = None
    ) -> Blocks:
        """Blocks for a kernel and a number of inducing points, or for groups of these outputs with a kernel each."""
        kernels = tuple(kernel) if isinstance(kernel, Sequence) else (kernel,)
        make = partial(block_of, kernels=kernels, to_internal=self.to_internal, columns=self.columns, groups=groups)
        return self.source.blocks(make, n_inducing, self.threads, self.share)

    def batches(self, kernel: Preparer, size: int, rng: np.random.RandomState) -> Iterator[Batch]:
        """Mini-batches without end. Each epoch shuffles the rows and leaves out those that do not fill a batch."""
        size = min(size, len(self))
        # Parts of nearly equal length, none of them shorter than a batch.
        ends = np.linspace(0, len(self), max(len(self) // max(_SHUFFLED_ROWS, size), 1) + 1).astype(int)
        parts = list(pairwise(ends))
        while True:
            for part in rng.permutation(len(parts)) if len(parts) > 1 else (0,):
                first, last = parts[part]
                order = first + rng.permutation(last - first)
                for begin in range(0, len(order) - size + 1, size):
                    raw = self.source.take(order[begin : begin + size])
                    yield Batch(block_of(raw, (kernel,), self.to_internal, self.columns))
