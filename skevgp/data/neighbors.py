"""Nearest rows: those of new rows among all, and those of each row among the rows before it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from sklearn.neighbors import NearestNeighbors

# Rows before this many are compared with all earlier rows.
_COMPARED = 512
# So many nearest rows are asked for, in units of the wanted number, and some more. About half or more come earlier.
_ASKED, _MORE = 3, 16
# If rows spread over more dimensions than this, a tree visits almost all of them.
_MOST_DIMENSIONS = 12
# Rows in a leaf of the tree, and how much farther than the nearest rows those found may be. This saves two thirds of
# the time, and in eight columns the farthest of 60 rows is 0.3 % farther.
_LEAF, _FARTHER = 64, 0.5
# Neighbours of so many rows are looked for at once.
_AT_ONCE = 16_384
# No neighbour.
NONE = -1


@dataclass(frozen=True)
class NearestRows:
    """Finds the nearest of n rows, in coordinates (n, d)."""

    coordinates: np.ndarray

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.coordinates, leafsize=_LEAF)

    @cached_property
    def _dimension(self) -> float:
        """The number of columns over which the rows spread. Columns with a long length scale hardly count."""
        # Of at most so many rows. Quartiles do not depend on a few rows that are far away.
        rows = self.coordinates[:: max(len(self.coordinates) // _AT_ONCE, 1)]
        squares = np.square(np.subtract(*np.quantile(rows, [0.75, 0.25], axis=0)))
        # This is d for equal spreads, and 1 if all but one are 0.
        return float(squares.sum() ** 2 / max(np.square(squares).sum(), np.finfo(float).tiny))

    @cached_property
    def _brute_force(self) -> NearestNeighbors:
        return NearestNeighbors(algorithm="brute").fit(self.coordinates)

    def of(self, coordinates: np.ndarray, k: int, n_threads: int = 1) -> np.ndarray:
        """The k nearest rows (q, k), or all of them if there are fewer, from near to far."""
        (n, d), q = self.coordinates.shape, len(coordinates)
        k = min(k, n)
        if k == n or d == 0:
            # Without a distance, all rows are equally near.
            return np.broadcast_to(np.arange(k), (q, k))
        if k == 0:
            return np.empty((q, 0), dtype=int)
        if self._dimension > _MOST_DIMENSIONS:
            return np.asarray(self._brute_force.kneighbors(coordinates, k, return_distance=False))
        _, nearest = self._tree.query(coordinates, np.arange(1, k + 1), eps=_FARTHER, workers=n_threads)
        return np.asarray(nearest)

    def __getstate__(self) -> dict[str, Any]:
        # The index is built again.
        return {"coordinates": self.coordinates}


def nearest_earlier(coordinates: np.ndarray, k: int, first: int = 0, n_threads: int = 1) -> np.ndarray:
    """The k nearest earlier rows of each row from ``first`` on: (n - first, k), filled up with `NONE`.

    If there are fewer than k other rows, k is their number.

    They are exact for the first rows, for k of all earlier rows, and almost always else: of the nearest rows, early or
    late, a few times k are looked at.
    """
    n = len(coordinates)
    k = min(k, n - 1)
    neighbours = np.full((n - first, k), NONE, dtype=np.int32)
    end, asked = n, _ASKED * k + _MORE
    while end > first and k > 0:
        # All earlier rows of the rows in [start, end), or the nearest of the rows before ``end``.
        exactly = end <= max(_COMPARED, asked)
        start = first if exactly else max(end // 2, first)
        rows = NearestRows(coordinates[:end])
        for some in range(start, end, _AT_ONCE):
            last = min(some + _AT_ONCE, end)
            if exactly:
                candidates = _by_distance(coordinates[:end], some, last)
            else:
                candidates = rows.of(coordinates[some:last], asked, n_threads)
            earlier = candidates < np.arange(some, last)[:, np.newaxis]
            # A stable sort leaves the earlier ones first, from near to far.
            order = np.argsort(~earlier, axis=1, kind="stable")[:, :k]
            found = np.take_along_axis(np.where(earlier, candidates, NONE), order, axis=1)
            neighbours[some - first : last - first, : found.shape[1]] = found
        end = start
    return neighbours


def _by_distance(coordinates: np.ndarray, first: int, last: int) -> np.ndarray:
    """The order (last - first, n) of all rows by their distance from some of them."""
    differences = coordinates[first:last, np.newaxis] - coordinates
    return np.argsort(np.einsum("qnd,qnd->qn", differences, differences), axis=1, kind="stable")
