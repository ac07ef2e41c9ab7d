"""Roots of covariances of the numbers that multiply [V; Hᵀ], and their products."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class BlockRoot:
    """A root (1, k, S m + p) of one output of a mixture, as a block of each draw. The array would be S times as large.

    The block (q, m + p) of a draw is about its own m points and the p features. Its other entries are 0. The last rows
    (S, S m + p) are about the points of all draws.
    """

    # m.
    n_points: int
    blocks: tuple[np.ndarray, ...]
    rows: np.ndarray

    @property
    def shape(self) -> tuple[int, int, int]:
        """The shape of the array."""
        return 1, sum(map(len, self.blocks)) + len(self.rows), self.rows.shape[1]

    def times(self, P: np.ndarray) -> np.ndarray:
        """The product (1, k, n) with P (S m + p, n)."""
        m, of_features = self.n_points, P[self._all_points :]
        parts = [
            block[:, :m] @ P[s * m : (s + 1) * m] + block[:, m:] @ of_features for s, block in enumerate(self.blocks)
        ]
        return np.concatenate([*parts, self.rows @ P])[np.newaxis]

    def transposed_times(self, D: np.ndarray) -> np.ndarray:
        """The product (1, S m + p, n) of the transpose with D (1, k, n)."""
        m, (*parts, last) = self.n_points, np.split(D[0], np.cumsum([len(block) for block in self.blocks]))
        found = self.rows.T @ last
        for s, (block, part) in enumerate(zip(self.blocks, parts, strict=True)):
            found[s * m : (s + 1) * m] += block[:, :m].T @ part
            found[self._all_points :] += block[:, m:].T @ part
        return found[np.newaxis]

    def of_weights(self) -> np.ndarray:
        """The columns (1, k, p) of the features."""
        blocks = [block[:, self.n_points :] for block in self.blocks]
        return np.concatenate([*blocks, self.rows[:, self._all_points :]])[np.newaxis]

    def dense(self) -> np.ndarray:
        """The array (1, k, S m + p)."""
        return self.transposed_times(np.eye(self.shape[1])[np.newaxis]).transpose(0, 2, 1)

    def __mul__(self, factor: Any) -> BlockRoot:
        by = float(np.reshape(factor, ()))
        return BlockRoot(self.n_points, tuple(by * block for block in self.blocks), by * self.rows)

    @property
    def _all_points(self) -> int:
        return self.n_points * len(self.blocks)


def times(root: np.ndarray | BlockRoot, P: np.ndarray) -> np.ndarray:
    """The product (o, k, n) of roots (o, k, m + p) with P (m + p, n)."""
    if isinstance(root, BlockRoot):
        return root.times(P)
    o, k, size = root.shape
    return (root.reshape(o * k, size) @ P).reshape(o, k, P.shape[1])


def transposed_times(root: np.ndarray | BlockRoot, D: np.ndarray) -> np.ndarray:
    """The products (o, m + p, n) of the transposes of roots (o, k, m + p) with D (o, k, n)."""
    return root.transposed_times(D) if isinstance(root, BlockRoot) else root.transpose(0, 2, 1) @ D


def dense(root: np.ndarray | BlockRoot) -> np.ndarray:
    """The roots as one array (o, k, m + p)."""
    return root.dense() if isinstance(root, BlockRoot) else root


def last_rows(root: np.ndarray | BlockRoot, p: int) -> np.ndarray:
    """The last p rows of roots as an array (o, p, m + p). Those of a mixture are none, or those of all draws."""
    if isinstance(root, BlockRoot):
        return root.rows[np.newaxis, len(root.rows) - p :]
    return root[:, root.shape[1] - p :]
