"""The rows in internal units as blocks, each small enough for a core's cache, and the sums over them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property
from typing import Any, Protocol, Self

import numpy as np

from .threads import BlockMap, add, ordered_sum

# A block's k(X_m, X) should stay in a core's cache: about this many numbers, but not fewer rows than this.
_BLOCK_NUMBERS, _MIN_BLOCK_ROWS, _MAX_BLOCK_ROWS = 2**16, 512, 8192
# Blocks that are made already are kept within this many bytes; the others are made again at each pass.
CACHE_BYTES = 48 * 2**20
# If k(X_m, X) and [V; Hᵀ; rᵀ] of all rows fit in this many bytes, they are kept from the first pass for the second.
KEEP_BYTES = 128 * 2**20
# Below this size of k(X_m, X), handing blocks to threads costs more than it saves.
_WORTH_THREADS = 2**17
# Blocks are summed in at most so many groups, and the groups in order, whatever the number of threads.
_MAX_GROUPS = 64

# A block frees arrays as large as the next one needs: given back to the system, they come again page by page, which
# takes a quarter of the time. Once memory as large as this, of which nothing is touched, was freed, glibc keeps what is
# freed later; 32 MiB is the most that it heeds.
np.empty(2**25 - 2**14, dtype=np.uint8)


def block_rows(n_inducing: int) -> int:
    """How many rows a block has; depends on nothing but the number of inducing points."""
    return int(np.clip(_BLOCK_NUMBERS // max(n_inducing, 1), _MIN_BLOCK_ROWS, _MAX_BLOCK_ROWS))


@dataclass
class Block:
    """Consecutive rows of the data.

    Attributes
    ----------
    prepared : object
        The kernel's inputs, as its ``prepare`` returns them.
    linear : ndarray of shape (n, p + o)
        h(x), then r: y minus the reference linear part, per output. One array, so that one product serves both sums;
        best in Fortran's order.
    n_features : int
        p.
    counts, roots : ndarray of shape (n,), optional
        w, how often a row counts, and √ω, which ``linear`` has been multiplied by; ω = w / v, where the row's noise
        variance is σ² v. None: 1.
    log_variance : float
        Σ w log v.
    may_keep : bool
        Whether there is room for ``kept``.
    kept : (whitening, k(X_m, X), [V; Hᵀ; rᵀ]) or None
        What the first pass left for the second.
    """

    prepared: Any
    linear: np.ndarray
    n_features: int
    counts: np.ndarray | None = None
    roots: np.ndarray | None = None
    log_variance: float = 0.0
    may_keep: bool = False
    kept: tuple[Any, np.ndarray, np.ndarray] | None = None

    @property
    def features(self) -> np.ndarray:
        return self.linear[:, : self.n_features]

    @property
    def residuals(self) -> np.ndarray:
        return self.linear[:, self.n_features :]

    def of(self, outputs: slice) -> tuple[Block, slice]:
        """The block that some outputs are in, and where in it."""
        return self, outputs

    def linear_of(self, outputs: slice) -> np.ndarray:
        """h(x), then r of some outputs, (n, p + their number); no copy if they are all."""
        residuals = self.residuals[:, outputs]
        if residuals.shape[1] == self.linear.shape[1] - self.n_features:
            return self.linear
        return np.hstack([self.features, residuals])

    @property
    def nbytes(self) -> int:
        """What it takes to keep it."""
        return _nbytes((self.prepared, self.linear))

    @property
    def width(self) -> int:
        """Columns of ``linear``."""
        return self.linear.shape[1]

    @property
    def n_parts(self) -> int:
        return 1

    def sums(self) -> LinearSums:
        """The sums that do not depend on any parameter."""
        return LinearStatistics.of_block(self)

    def keep(self) -> None:
        """There is room for what a first pass leaves."""
        self.may_keep = True


@dataclass
class SplitBlock:
    """Consecutive rows of the data, once for each group of outputs: each has its inputs, features and residuals.

    Attributes
    ----------
    parts : dict of int to Block
        By the first output of a group; of this group's outputs.
    """

    parts: dict[int, Block]

    def of(self, outputs: slice) -> tuple[Block, slice]:
        return self.parts[outputs.start], slice(None)

    @property
    def nbytes(self) -> int:
        return sum(part.nbytes for part in self.parts.values())

    @property
    def width(self) -> int:
        return max(part.width for part in self.parts.values())

    @property
    def n_parts(self) -> int:
        return len(self.parts)

    def sums(self) -> LinearSums:
        return SplitStatistics({first: LinearStatistics.of_block(part) for first, part in self.parts.items()})

    def keep(self) -> None:
        for part in self.parts.values():
            part.keep()


# One or the other, for all blocks of some rows.
AnyBlock = Block | SplitBlock


class LinearSums(Protocol):
    """The sums over rows that do not depend on any parameter: computed once per data set."""

    @property
    def n_rows(self) -> float:
        """N."""

    @property
    def length(self) -> int:
        """How many rows there are, whatever they count."""

    @property
    def log_variance(self) -> float:
        """Σ w log v."""

    def of(self, outputs: slice) -> LinearStatistics:
        """Of some outputs, all in one group."""

    def __add__(self, other: Self) -> Self: ...


@dataclass(frozen=True)
class LinearStatistics:
    """The sums over rows that do not depend on any parameter, of outputs with the same features.

    Attributes
    ----------
    n_rows : float
        Σ w: rows, each as often as it counts.
    HH : ndarray of shape (p, p)
        Hᵀ Ω H, with Ω = diag(ω) (see `Block`).
    HR : ndarray of shape (p, o)
        Hᵀ Ω r.
    RR : ndarray of shape (o,)
        rᵀ Ω r of each output.
    length : int
        Rows, however often they count.
    log_variance : float
        Σ w log v.
    surplus : float
        Σ max(ω, 1) - Σ w.
    """

    n_rows: float
    HH: np.ndarray
    HR: np.ndarray
    RR: np.ndarray
    length: int = 0
    log_variance: float = 0.0
    surplus: float = 0.0

    @classmethod
    def of_block(cls, block: Block) -> LinearStatistics:
        total, p, n = block.linear.T @ block.linear, block.n_features, len(block.linear)
        sums = total[:p, :p], total[:p, p:], np.diagonal(total)[p:].copy()
        if block.counts is None or block.roots is None:
            return cls(n, *sums, n)
        n_rows = float(block.counts.sum())
        return cls(n_rows, *sums, n, block.log_variance, float(np.maximum(block.roots**2, 1.0).sum()) - n_rows)

    def of(self, outputs: slice) -> LinearStatistics:
        RR = self.RR[outputs]
        return self if len(RR) == len(self.RR) else replace(self, HR=self.HR[:, outputs], RR=RR)

    def __add__(self, other: LinearStatistics) -> LinearStatistics:
        return LinearStatistics(*(getattr(self, field.name) + getattr(other, field.name) for field in fields(self)))


@dataclass(frozen=True)
class SplitStatistics:
    """The same of groups of outputs, each with features of its own; by the first output of each."""

    parts: dict[int, LinearStatistics]

    @property
    def n_rows(self) -> float:
        return self._first.n_rows

    @property
    def length(self) -> int:
        return self._first.length

    @property
    def log_variance(self) -> float:
        return self._first.log_variance

    @property
    def _first(self) -> LinearStatistics:
        return next(iter(self.parts.values()))

    def of(self, outputs: slice) -> LinearStatistics:
        first = max(first for first in self.parts if first <= outputs.start)
        return self.parts[first].of(slice(outputs.start - first, outputs.stop - first))

    def __add__(self, other: SplitStatistics) -> SplitStatistics:
        return SplitStatistics({first: own + other.parts[first] for first, own in self.parts.items()})


class Blocks(Protocol):
    """Rows that a function of a block can be summed over."""

    @property
    def linear(self) -> LinearSums:
        """The sums that do not depend on any parameter."""

    def sum(self, function: Callable[[Any], Any]) -> Any:
        """The sum of function(block), by ``+`` (of tuples, entry by entry), in an order that never changes."""


class Batch:
    """One block that stands for itself: a mini-batch."""

    def __init__(self, block: AnyBlock):
        self.block = block
        block.keep()

    @cached_property
    def linear(self) -> LinearSums:
        return self.block.sums()

    def sum(self, function: Callable[[Any], Any]) -> Any:
        return function(self.block)


class LocalBlocks:
    """Blocks in this process: kept while memory lasts, else made anew at each pass.

    Parameters
    ----------
    make : callable
        A slice of rows -> `Block`.
    n_rows, n_inducing : int
    threads : BlockMap
    share : float, default=1
        Of `CACHE_BYTES` and `KEEP_BYTES`, for one of several fits at once.
    keep : bool, default=True
        Whether the second pass follows in the same process as the first, with the same objects.
    size : int, default=None
        Rows per block; None means `block_rows`.
    """

    def __init__(
        self,
        make: Callable[[slice], AnyBlock],
        n_rows: int,
        n_inducing: int,
        threads: BlockMap | None = None,
        share: float = 1.0,
        keep: bool = True,
        size: int | None = None,
    ):
        size = block_rows(n_inducing) if size is None else size
        self._make = make
        self._slices = [slice(first, min(first + size, n_rows)) for first in range(0, n_rows, size)]
        first = make(self._slices[0])
        self._n_cached = int(share * CACHE_BYTES / max(first.nbytes, 1))
        all_cached = self._n_cached >= len(self._slices)
        kept_bytes = 8 * first.n_parts * (2 * n_inducing + first.width) * n_rows
        self._may_keep = keep and all_cached and kept_bytes <= share * KEEP_BYTES
        if self._may_keep:
            first.keep()
        self._made = {0: first}
        per_group = -(-len(self._slices) // _MAX_GROUPS)
        blocks = range(len(self._slices))
        self._groups = [blocks[first : first + per_group] for first in range(0, len(blocks), per_group)]
        self._threads = threads if threads is not None and n_inducing * n_rows >= _WORTH_THREADS else BlockMap()

    def __len__(self) -> int:
        return len(self._slices)

    def __getitem__(self, index: int) -> AnyBlock:
        block = self._made.get(index)
        if block is None:
            block = self._make(self._slices[index])
            if self._may_keep:
                block.keep()
            if index < self._n_cached:
                self._made[index] = block
        return block

    @cached_property
    def linear(self) -> LinearSums:
        return self.sum(sums_of)

    def sum(self, function: Callable[[Any], Any]) -> Any:
        def one(group: range) -> Any:
            total = function(self[group[0]])
            for index in group[1:]:
                total = add(total, function(self[index]))
            return total

        return ordered_sum(self._threads(one, self._groups))


def sums_of(block: AnyBlock) -> LinearSums:
    """What `Blocks.linear` sums."""
    return block.sums()


def _nbytes(value: Any) -> int:
    """Bytes of the arrays that an object holds."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, (tuple, list)):
        return sum(map(_nbytes, value))
    if is_dataclass(value) and not isinstance(value, type):
        return sum(_nbytes(getattr(value, field.name)) for field in fields(value))
    return 0
