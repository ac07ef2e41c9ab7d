"""The rows of a data set as the inference sees them: residuals in place of targets, of order one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from sklearn.utils.random import sample_without_replacement

from .blocks import AnyBlock, Batch, Block, Blocks, SplitBlock
from .source import Columns, LocalSource, Moments, RawRows, Source
from .threads import BlockMap

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
