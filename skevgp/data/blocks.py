"""Blocks of rows in internal units, each small enough for the cache of a core, and sums over them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from .threads import BlockMap, add, ordered_sum

# A block's k(X_m, X) stays in the cache of a core: about this many numbers, but not fewer rows than this.
_BLOCK_NUMBERS, _MIN_BLOCK_ROWS, _MAX_BLOCK_ROWS = 2**16, 512, 8192
# Blocks are kept within this many bytes. The others are made again at each pass.
CACHE_BYTES = 48 * 2**20
# If k(X_m, X) and [V; Hᵀ; rᵀ] of all rows fit in this many bytes, they are kept from the first pass for the second.
KEEP_BYTES = 128 * 2**20
# For a smaller k(X_m, X), handing blocks to threads costs more than it saves.
_WORTH_THREADS = 2**17
# Blocks are summed in at most this many groups, and the groups in order, for any number of threads.
_MAX_GROUPS = 64

# glibc returns freed arrays to the system, and getting them back page by page costs a quarter of the time. Freeing one
# large untouched array raises its threshold, up to 32 MiB.
np.empty(2**25 - 2**14, dtype=np.uint8)


def block_rows(n_inducing: int) -> int:
    """Number of rows of a block. It depends on the number of inducing points only."""
    return int(np.clip(_BLOCK_NUMBERS // max(n_inducing, 1), _MIN_BLOCK_ROWS, _MAX_BLOCK_ROWS))


@dataclass
class Block:
    """Consecutive rows of the data."""

    # The rows as the kernel's ``prepare`` returns them.
    prepared: Any
    # (n, p + o): h(x), then the residuals r of each output. One array, so that one product serves both sums. Best in
    # Fortran's order.
    linear: np.ndarray
    # p.
    n_features: int
    # (n,): the weight w of each row, and √ω with ω = w / v, where the row's noise variance is σ² v. ``linear`` has been
    # multiplied by √ω. None: all 1.
    counts: np.ndarray | None = None
    roots: np.ndarray | None = None
    # Σ w log v.
    log_variance: float = 0.0
    # Whether there is memory for ``kept``: the whitening, k(X_m, X), [V; Hᵀ; rᵀ] and, for the tight bound, the
    # slope (n,) of the charge of the first pass, for the second.
    may_keep: bool = False
    kept: tuple[Any, np.ndarray, np.ndarray, np.ndarray | None] | None = None

    @property
    def features(self) -> np.ndarray:
        """h(x) of each row, (n, p)."""
        return self.linear[:, : self.n_features]

    @property
    def residuals(self) -> np.ndarray:
        """The residuals of each row, (n, o)."""
        return self.linear[:, self.n_features :]

    def of(self, outputs: slice) -> tuple[Block, slice]:
        """The block that holds some outputs, and their columns in it."""
        return self, outputs

    def linear_of(self, outputs: slice) -> np.ndarray:
        """h(x), then r of some outputs, (n, p + their number). No copy if they are all."""
        residuals = self.residuals[:, outputs]
        if residuals.shape[1] == self.linear.shape[1] - self.n_features:
            return self.linear
        return np.hstack([self.features, residuals])


@dataclass
class SplitBlock:
    """Consecutive rows of the data, with inputs and features of each group of outputs.

    The key of a group's block is its first output.
    """

    parts: dict[int, Block]

    def of(self, outputs: slice) -> tuple[Block, slice]:
        """The block of a group of outputs, and all its columns."""
        return self.parts[outputs.start], slice(None)


# All blocks of a data set are of the same type.
AnyBlock = Block | SplitBlock


def parts_of(block: AnyBlock) -> dict[int, Block]:
    """The block of each group of outputs, by its first output."""
    return block.parts if isinstance(block, SplitBlock) else {0: block}


@dataclass(frozen=True)
class LinearSums:
    """Sums over rows that depend on no parameter. They are computed once per data set."""

    # N, or Σ w.
    n_rows: float
    # (g, p, p): HᵀΩH of each group of outputs that has features of its own, with Ω = diag(ω) (see `Block`).
    HH: np.ndarray
    # (p, o) and (o,): HᵀΩr and rᵀΩr of each output.
    HR: np.ndarray
    RR: np.ndarray
    # The first output of each group.
    firsts: tuple[int, ...]
    # Number of rows, whatever their weights.
    length: int
    # Σ w log v.
    log_variance: float
    # Σ max(ω, 1) - Σ w.
    surplus: float

    @classmethod
    def of_block(cls, block: AnyBlock) -> LinearSums:
        """The sums of one block."""
        parts = parts_of(block)
        totals = [part.linear.T @ part.linear for part in parts.values()]
        first = next(iter(parts.values()))
        p, length = first.n_features, len(first.linear)
        n_rows, surplus = float(length), 0.0
        if first.counts is not None and first.roots is not None:
            n_rows = float(first.counts.sum())
            surplus = float(np.maximum(first.roots**2, 1.0).sum()) - n_rows
        return cls(
            n_rows,
            np.array([total[:p, :p] for total in totals]),
            np.hstack([total[:p, p:] for total in totals]),
            np.concatenate([np.diagonal(total)[p:] for total in totals]),
            tuple(parts),
            length,
            first.log_variance,
            surplus,
        )

    def of(self, outputs: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """HᵀΩH (p, p), HᵀΩr (p, k) and rᵀΩr (k,) of k outputs of one group."""
        group = sum(first <= (outputs.start or 0) for first in self.firsts) - 1
        return self.HH[group], self.HR[:, outputs], self.RR[outputs]

    def __add__(self, other: LinearSums) -> LinearSums:
        summed = ("n_rows", "HH", "HR", "RR", "length", "log_variance", "surplus")
        return replace(self, **{name: getattr(self, name) + getattr(other, name) for name in summed})


class Blocks(Protocol):
    """Rows over which a function of a block can be summed."""

    @property
    def linear(self) -> LinearSums:
        """The sums that depend on no parameter."""

    def sum(self, function: Callable[[Any], Any]) -> Any:
        """The sum of function(block), by ``+`` (of tuples, entry by entry), in an order that never changes."""


class Batch:
    """One block as `Blocks`: a mini-batch."""

    def __init__(self, block: AnyBlock):
        self.block = block
        for part in parts_of(block).values():
            part.may_keep = True

    @cached_property
    def linear(self) -> LinearSums:
        """The sums that depend on no parameter."""
        return LinearSums.of_block(self.block)

    def sum(self, function: Callable[[Any], Any]) -> Any:
        """function(block)."""
        return function(self.block)


class LocalBlocks:
    """Blocks in this process. They are kept while memory lasts, else made again at each pass.

    ``make`` returns the block of a slice of rows. ``share`` is the share of `CACHE_BYTES` and `KEEP_BYTES` for one of
    several fits at once. ``keep`` is False if the second pass may run in another process than the first. ``size`` is
    the number of rows of a block, by default `block_rows`.
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
        parts = parts_of(first).values()
        n_bytes = sum(_nbytes((part.prepared, part.linear)) for part in parts)
        self._n_cached = int(share * CACHE_BYTES / max(n_bytes, 1))
        bytes_to_keep = 8 * n_rows * sum(2 * n_inducing + part.linear.shape[1] for part in parts)
        self._may_keep = keep and self._n_cached >= len(self._slices) and bytes_to_keep <= share * KEEP_BYTES
        for part in parts:
            part.may_keep = self._may_keep
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
            for part in parts_of(block).values():
                part.may_keep = self._may_keep
            if index < self._n_cached:
                self._made[index] = block
        return block

    @cached_property
    def linear(self) -> LinearSums:
        """The sums that depend on no parameter."""
        return self.sum(LinearSums.of_block)

    def sum(self, function: Callable[[Any], Any]) -> Any:
        """The sum of function(block) over all blocks, in order."""

        def sum_of_group(group: range) -> Any:
            total = function(self[group[0]])
            for index in group[1:]:
                total = add(total, function(self[index]))
            return total

        return ordered_sum(self._threads(sum_of_group, self._groups))


def _nbytes(value: Any) -> int:
    """Number of bytes of the arrays that an object holds."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, (tuple, list)):
        return sum(map(_nbytes, value))
    if is_dataclass(value) and not isinstance(value, type):
        return sum(_nbytes(getattr(value, field.name)) for field in fields(value))
    return 0
