"""The user's maps. They are fitted to the rows and applied to pieces of them, and the result is checked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from threading import Lock
from typing import Any

import numpy as np
from scipy.sparse import issparse
from sklearn.base import clone
from sklearn.gaussian_process.kernels import Kernel
from sklearn.pipeline import FeatureUnion, Pipeline
from sklearn.utils.validation import has_fit_parameter

from ..utils.frames import FrameColumns
from ..utils.sklearn import safe_indexing
from ..utils.validation import LARGEST, as_floats, check_magnitude, is_frame
from .rows import RawRows
from .weights import Chosen, rows_of

# A map is applied to this many rows at once.
MAP_ROWS = 16_384
# A model keeps this many rows as an example.
EXAMPLE_ROWS = 64


def fit_map(feature_map: Any, X: Any, y: np.ndarray, name: str, chosen: Chosen | None = None) -> Any:
    """Fit a clone of a transformer, or return None for None. ``name`` is the argument's name for errors."""
    if feature_map is None:
        return None
    fitted, chosen = fresh_map(feature_map, name), Chosen(len(y)) if chosen is None else chosen
    if chosen.counts is not None and has_fit_parameter(fitted, "sample_weight"):
        rows, options = chosen.positions, {"sample_weight": chosen.counts}
    else:
        rows, options = chosen.positions if chosen.unmerged is None else chosen.unmerged, {}
    return fitted.fit(rows_of(X, rows), rows_of(y, rows), **options)


def fresh_map(feature_map: Any, name: str) -> Any:
    """Clone a transformer. Raise TypeError if it is not one."""
    if isinstance(feature_map, Kernel):
        raise TypeError(f"{name}={feature_map!r} is a kernel. Pass it as kernel=.")
    if isinstance(feature_map, type) or not (hasattr(feature_map, "fit") and hasattr(feature_map, "transform")):
        raise TypeError(f"{name} must be None or a transformer instance with fit and transform; got {feature_map!r}.")
    try:
        return clone(feature_map)
    except TypeError as error:
        raise TypeError(f"{name}={feature_map!r} cannot be cloned: {error}") from error


def take_rows(X: Any, rows: slice | np.ndarray) -> Any:
    """Some rows for a map: a data frame stays one, and an array becomes float64."""
    if not is_frame(X):
        return np.asarray(X[rows], dtype=np.float64)
    # A slice of a pyarrow table must end within it.
    return safe_indexing(X, slice(*rows.indices(len(X))) if isinstance(rows, slice) else rows)


def example_of(X: Any, chosen: Chosen) -> Any:
    """A few evenly spaced rows of those that a fit uses."""
    rows = evenly_spaced(chosen.n_rows, EXAMPLE_ROWS)
    return take_rows(X, rows if chosen.positions is None else chosen.positions[rows])


def evenly_spaced(n_rows: int, n_some: int) -> np.ndarray:
    """Indices of at most ``n_some`` evenly spaced rows."""
    return np.unique(np.linspace(0, n_rows - 1, min(n_rows, n_some)).astype(int))


def apply_map(fitted_map: Any, X: Any, name: str) -> np.ndarray:
    """Apply a fitted map block by block: (n, width), or (n, n_outputs, width) if it returns a row for each output."""
    n_rows = X.shape[0]
    blocks: list[np.ndarray] = []
    for first in range(0, n_rows, MAP_ROWS):
        rows = X if n_rows <= MAP_ROWS else take_rows(X, slice(first, first + MAP_ROWS))
        values = _checked(transformed(fitted_map, rows), rows.shape[0], fitted_map, name)
        if blocks and values.shape[1:] != blocks[0].shape[1:]:
            raise ValueError(
                f"{name}={fitted_map!r} must return the same number of columns for all rows; it returned "
                f"{_shape_text(blocks[0].shape[1:])} and {_shape_text(values.shape[1:])}."
            )
        blocks.append(values)
    return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)


def transformed(fitted_map: Any, rows: Any) -> Any:
    """Transform rows by a fitted map. Unions, alone or at the end of a pipeline, are evaluated here.

    scikit-learn's unions do not accept a row for each output. For a single row, they are slower than all their parts.
    """
    if type(fitted_map) is Pipeline:
        steps = [step for _, step in fitted_map.steps if step not in (None, "passthrough")]
        if steps and type(steps[-1]) in (Pipeline, FeatureUnion):
            for step in steps[:-1]:
                rows = step.transform(rows)
            return transformed(steps[-1], rows)
    if type(fitted_map) is FeatureUnion:
        parts = [(name, part) for name, part in fitted_map.transformer_list if not isinstance(part, str)]
        found = [transformed(part, rows) for _, part in parts]
        values = [np.asarray(value.toarray() if issparse(value) else value) for value in found]
        if values and all(part.shape[:1] == rows.shape[:1] for part in values):
            if weights := fitted_map.transformer_weights:
                names = [name for name, _ in parts]
                each = [1.0 if weights.get(name) is None else weights[name] for name in names]
                values = [part * weight for part, weight in zip(values, each, strict=True)]
            return _concatenated(values)
    return fitted_map.transform(rows)


def _concatenated(parts: list[np.ndarray]) -> np.ndarray:
    """The columns of all parts. If some have a row for each output, the others are repeated for each output."""
    n_outputs = {part.shape[1] for part in parts if part.ndim == 3}
    if not n_outputs:
        return np.hstack(parts)
    if len(n_outputs) > 1:
        raise ValueError(f"Parts of a union have rows for different numbers of outputs: {sorted(n_outputs)}.")
    (o,) = n_outputs
    each = [part if part.ndim == 3 else np.repeat(part[:, np.newaxis], o, axis=1) for part in parts]
    return np.concatenate(each, axis=2)


def _checked(values: Any, n_rows: int, fitted_map: Any, name: str) -> np.ndarray:
    """What a map returned, as an array of finite floats. Errors name the map."""
    # Nearly every map returns such an array. It needs no name, which takes longer than the features to write.
    if (
        type(values) is np.ndarray
        and values.dtype == np.float64
        and values.ndim in (2, 3)
        and len(values) == n_rows
        and values.size > 0
        and np.abs(values).max() <= LARGEST  # False if there is a NaN
    ):
        return values
    called = f"{name}={fitted_map!r}"
    values = as_floats(values.toarray() if issparse(values) else values, f"What {called} returns")
    if values.ndim not in (2, 3) or len(values) != n_rows:
        raise ValueError(
            f"{called} must return one row per row of X; for {n_rows} rows it returned the shape {values.shape}."
        )
    if not np.isfinite(values).all():
        raise ValueError(f"{called} returned NaN or infinity.")
    if values.size == 0:
        raise ValueError(f"{called} returned no columns.")
    check_magnitude(values, f"What {called} returns")
    return values


def _shape_text(shape: tuple[int, ...]) -> str:
    """The number of columns, or outputs x columns, for errors."""
    return " x ".join(map(str, shape))


# --- X through both maps ----------------------------------------------------------------------------------------------

# Inputs and features of all rows are kept if they fit in this many bytes. Otherwise each pass applies the maps again.
MAPPED_BYTES = 32 * 2**20

# Shapes of a row's kernel inputs and features.
RowShapes = tuple[tuple[int, ...], tuple[int, ...]]


@dataclass(frozen=True)
class Maps:
    """The fitted maps of a model."""

    feature_map: Any
    kernel_map: Any
    # A few of the rows that they were fitted to, and number and names of the columns of X.
    example: Any = None
    n_columns: int = 0
    columns: np.ndarray | None = None
    # None: not known yet.
    shapes: RowShapes | None = None

    def __getstate__(self) -> dict[str, Any]:
        # A data frame is saved as arrays, because its package need not be installed when the file is read.
        return {**vars(self), "example": FrameColumns.of(self.example) or self.example}

    def __setstate__(self, state: dict[str, Any]) -> None:
        example = state["example"]
        vars(self).update(state, example=example.frame() if isinstance(example, FrameColumns) else example)

    def rows(self, given: Any, X: Any, rows: slice | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Kernel inputs and features of some rows. The maps see ``given``, and without a map the kernel sees X."""
        array = take_rows(X, rows)
        given = array if given is X else take_rows(given, rows)
        inputs = array if self.kernel_map is None else apply_map(self.kernel_map, given, "kernel_map")
        features = np.empty((len(array), 0))
        if self.feature_map is not None:
            features = apply_map(self.feature_map, given, "feature_map")
        shapes = inputs.shape[1:], features.shape[1:]
        if self.shapes is not None and shapes != self.shapes:
            raise ValueError(
                "kernel_map and feature_map must return the same number of columns for all rows; they returned "
                f"({', '.join(map(_shape_text, self.shapes))}) and ({', '.join(map(_shape_text, shapes))})."
            )
        return inputs, features


class MappedRows:
    """A function that loads rows: a slice or indices -> kernel inputs, features and targets y (n, o).

    ``given`` and X are as of `Maps.rows`. X may be a data frame if the kernel has a map.
    """

    def __init__(self, given: Any, X: Any, y: np.ndarray, maps: Maps, chosen: Chosen | None = None):
        self.given, self.X, self.y = given, X, y
        self.chosen = Chosen(len(X)) if chosen is None else chosen
        self._lock = Lock()
        self._kept: tuple[np.ndarray, np.ndarray] | None = None
        first = maps.rows(given, X, self._positions(slice(0, MAP_ROWS)))
        self.maps = replace(maps, shapes=(first[0].shape[1:], first[1].shape[1:]))
        n_numbers = (first[0][0].size if maps.kernel_map is not None else 0) + first[1][0].size
        n_rows = self.chosen.n_rows
        if n_numbers and 8 * n_numbers * n_rows <= MAPPED_BYTES:
            everything = self._positions(slice(0, n_rows))
            self._kept = first if n_rows <= MAP_ROWS else self.maps.rows(given, X, everything)

    def __call__(self, rows: slice | np.ndarray) -> RawRows:
        positions = self._positions(rows)
        if self._kept is not None:
            inputs, features = self._kept[0][rows], self._kept[1][rows]
        else:
            # Transformers need not be safe to call from several threads.
            with self._lock:
                inputs, features = self.maps.rows(self.given, self.X, positions)
        counts, precision = self.chosen.counts, self.chosen.precision
        return RawRows(
            inputs,
            features,
            np.asarray(self.y[positions], dtype=np.float64),
            None if counts is None else counts[rows],
            None if precision is None else precision[rows],
        )

    def _positions(self, rows: slice | np.ndarray) -> slice | np.ndarray:
        """Indices of rows in the user's X."""
        return rows if self.chosen.positions is None else self.chosen.positions[rows]

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _lock=Lock())
