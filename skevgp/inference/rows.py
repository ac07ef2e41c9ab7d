"""The data as blocks of rows."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

# A block's k(X_m, X) should stay in a core's cache: about this many numbers, but not fewer rows than this.
_BLOCK_NUMBERS, _MIN_BLOCK_ROWS, _MAX_BLOCK_ROWS = 2**15, 512, 4096


class Preparer(Protocol):
    """What `Rows` needs of a kernel."""

    def prepare(self, inputs: np.ndarray) -> Any:
        """What the kernel computes once of rows (n, d)."""


def block_rows(n_inducing: int) -> int:
    """How many rows a block has; depends on nothing but the number of inducing points."""
    return int(np.clip(_BLOCK_NUMBERS // max(n_inducing, 1), _MIN_BLOCK_ROWS, _MAX_BLOCK_ROWS))


@dataclass(frozen=True)
class Block:
    """Consecutive rows of the data.

    Attributes
    ----------
    prepared : object
        The kernel's inputs, as its ``prepare`` returns them.
    linear : ndarray of shape (n, p + o)
        h(x), then r: y minus the reference linear part, per output. One array, so that one product serves both sums.
    n_features : int
        p.
    """

    prepared: Any
    linear: np.ndarray
    n_features: int

    @property
    def features(self) -> np.ndarray:
        return self.linear[:, : self.n_features]

    @property
    def residuals(self) -> np.ndarray:
        return self.linear[:, self.n_features :]


@dataclass(frozen=True)
class LinearStatistics:
    """The sums over rows that do not depend on any parameter: computed once per data set.

    Attributes
    ----------
    n_rows : int
    HH : ndarray of shape (p, p)
        HᵀH.
    HR : ndarray of shape (p, o)
        Hᵀr.
    RR : ndarray of shape (o,)
        rᵀr of each output.
    """

    n_rows: int
    HH: np.ndarray
    HR: np.ndarray
    RR: np.ndarray

    @classmethod
    def of(cls, blocks: Iterable[Block]) -> LinearStatistics:
        """Sum over at least one block."""
        parts = [(len(b.linear), b.linear.T @ b.linear, b.n_features) for b in blocks]
        total, p = sum(part[1] for part in parts), parts[0][2]
        return cls(sum(part[0] for part in parts), total[:p, :p], total[:p, p:], np.diagonal(total)[p:].copy())


@dataclass(frozen=True)
class Rows:
    """All rows of a data set, as an estimator hands them to the inference.

    Attributes
    ----------
    inputs : ndarray of shape (n, d)
        The kernel's, centred.
    features : ndarray of shape (n, p)
        h(x).
    residuals : ndarray of shape (n, o)
        y minus the reference linear part, in units of its own size.
    """

    inputs: np.ndarray
    features: np.ndarray
    residuals: np.ndarray

    def __len__(self) -> int:
        return len(self.inputs)

    def scatter(self) -> np.ndarray:
        """Variance (o,) of the residuals; 1 where they do not vary."""
        scatter = self.residuals.var(axis=0)
        return np.where(scatter > 0.0, scatter, 1.0)

    def blocks(self, kernel: Preparer, size: int) -> list[Block]:
        """Blocks of at most ``size`` rows, in order."""
        return [self._block(kernel, slice(first, first + size)) for first in range(0, len(self), size)]

    def batches(
        self, kernel: Preparer, size: int, rng: np.random.RandomState
    ) -> Iterator[tuple[Block, LinearStatistics]]:
        """Mini-batches without end: each epoch shuffles the rows anew and leaves out what does not fill a batch."""
        size = min(size, len(self))
        while True:
            order = rng.permutation(len(self))
            for first in range(0, len(self) - size + 1, size):
                block = self._block(kernel, order[first : first + size])
                yield block, LinearStatistics.of([block])

    def outputs(self, columns: slice) -> Rows:
        """The same rows with some of the outputs."""
        return Rows(self.inputs, self.features, self.residuals[:, columns])

    def _block(self, kernel: Preparer, rows: slice | np.ndarray) -> Block:
        linear = np.hstack([self.features[rows], self.residuals[rows]])
        return Block(kernel.prepare(self.inputs[rows]), linear, self.features.shape[1])
