"""The rows of X and y as the inference sees them: through the user's maps, in pieces, in float64."""

from __future__ import annotations

from threading import Lock
from typing import Any

import numpy as np

from .chosen import Chosen
from .maps import MAP_ROWS, apply_map, shape_text, take_rows
from .source import RawRows

# What the maps make of all rows is kept if it fits in so many bytes; else they are applied anew at each pass.
MAPPED_BYTES = 32 * 2**20


# Of a row's kernel inputs, and of its features.
RowShapes = tuple[tuple[int, ...], tuple[int, ...]]


def check_shapes(mapped: tuple[np.ndarray, np.ndarray], shapes: RowShapes) -> None:
    """Refuse inputs and features of rows that have other columns than those before."""
    found = mapped[0].shape[1:], mapped[1].shape[1:]
    if found != shapes:
        raise ValueError(
            "kernel_map and feature_map must return the same number of columns for all rows; they returned "
            f"({', '.join(map(shape_text, shapes))}) and ({', '.join(map(shape_text, found))})."
        )


class MappedRows:
    """Loads rows: a slice or indices -> kernel inputs, features and targets.

    Parameters
    ----------
    given : array-like of shape (n, n_columns)
        What the maps see: X as the user gave it if it is a data frame, else X.
    X : ndarray of shape (n, n_columns)
        What the kernel sees; where it has a map, the data frame itself will do.
    y : ndarray of shape (n, o)
    feature_map, kernel_map : transformer or None
        Fitted.
    chosen : Chosen, optional
        Which rows of these count; None are all.
    shapes : (tuple, tuple), optional
        Of a row's inputs and features; None are those of the first row.
    """

    def __init__(
        self,
        given: Any,
        X: Any,
        y: np.ndarray,
        feature_map: Any,
        kernel_map: Any,
        chosen: Chosen | None = None,
        shapes: RowShapes | None = None,
    ):
        self.given, self.X, self.y = given, X, y
        self.chosen = Chosen(len(X)) if chosen is None else chosen
        self.feature_map, self.kernel_map = feature_map, kernel_map
        self._mapped: tuple[np.ndarray, np.ndarray] | None = None
        self._lock = Lock()
        self._shapes = shapes
        first = self._through_maps(slice(0, MAP_ROWS))
        made = (first[0][0].size if kernel_map is not None else 0) + first[1][0].size
        n_rows = self.chosen.n_rows
        if made and 8 * made * n_rows <= MAPPED_BYTES:
            self._mapped = first if n_rows <= MAP_ROWS else self._through_maps(slice(0, n_rows))

    def __call__(self, rows: slice | np.ndarray) -> RawRows:
        if self._mapped is not None:
            inputs, features = (values[rows] for values in self._mapped)
        else:
            # Transformers need not be safe to call from several threads.
            with self._lock:
                inputs, features = self._through_maps(rows)
        weights = (None if each is None else each[rows] for each in (self.chosen.counts, self.chosen.precision))
        return RawRows(inputs, features, np.asarray(self.y[self._given(rows)], dtype=np.float64), *weights)

    def _given(self, rows: slice | np.ndarray) -> slice | np.ndarray:
        """Where rows are among those that were given."""
        return rows if self.chosen.positions is None else self.chosen.positions[rows]

    def _through_maps(self, rows: slice | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The kernel's inputs and the features of rows."""
        rows = self._given(rows)
        X = take_rows(self.X, rows)
        given = X if self.given is self.X else take_rows(self.given, rows)
        mapped = map_rows(given, X, self.feature_map, self.kernel_map)
        if self._shapes is None:
            self._shapes = mapped[0].shape[1:], mapped[1].shape[1:]
        check_shapes(mapped, self._shapes)
        return mapped

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _lock=Lock())


def map_rows(given: Any, X: Any, feature_map: Any, kernel_map: Any) -> tuple[np.ndarray, np.ndarray]:
    """The kernel's inputs and the features of rows X; the maps see ``given``."""
    inputs = X if kernel_map is None else apply_map(kernel_map, given, "kernel_map")
    features = np.empty((len(X), 0)) if feature_map is None else apply_map(feature_map, given, "feature_map")
    return inputs, features
