"""The user's maps: fitted to the rows, applied to them in pieces, and what comes back is checked."""

from __future__ import annotations

from dataclasses import dataclass
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

# Rows that a map sees at once.
MAP_ROWS = 16_384
# Rows that show what those of a fit are like.
EXAMPLE_ROWS = 64


def fit_map(feature_map: Any, X: Any, y: np.ndarray, name: str, chosen: Chosen | None = None) -> Any:
    """A fitted clone of a transformer, or None.

    Parameters
    ----------
    feature_map : transformer or None
    X : array-like of shape (n, d)
        As the user gave it.
    y : ndarray of shape (n,) or (n, o)
    name : str
        The argument's name, for errors.
    chosen : Chosen, optional
        The rows to fit it to; how often they count it is told if it takes a ``sample_weight``. None are all.

    Raises
    ------
    TypeError
        If it is not a transformer.
    """
    if feature_map is None:
        return None
    fitted = fresh_map(feature_map, name)
    if chosen is None:
        return fitted.fit(X, y)
    if chosen.counts is not None and has_fit_parameter(fitted, "sample_weight"):
        rows = chosen.positions
        return fitted.fit(rows_of(X, rows), rows_of(y, rows), sample_weight=chosen.counts)
    rows = chosen.positions if chosen.repeated is None else chosen.repeated
    return fitted.fit(rows_of(X, rows), rows_of(y, rows))


def fresh_map(feature_map: Any, name: str) -> Any:
    """A clone of a transformer, or a TypeError that names it."""
    if isinstance(feature_map, Kernel):
        raise TypeError(f"{name}={feature_map!r} is a kernel: give it as kernel=.")
    if isinstance(feature_map, type) or not (hasattr(feature_map, "fit") and hasattr(feature_map, "transform")):
        raise TypeError(f"{name} must be None or a transformer instance with fit and transform; got {feature_map!r}.")
    try:
        return clone(feature_map)
    except TypeError as error:
        raise TypeError(f"{name}={feature_map!r} cannot be cloned: {error}") from error


def take_rows(X: Any, rows: slice | np.ndarray) -> Any:
    """Some rows as the maps see them: of a data frame as one, of an array in float64."""
    if not is_frame(X):
        return np.asarray(X[rows], dtype=np.float64)
    # A slice of a pyarrow table must end within it.
    return safe_indexing(X, slice(*rows.indices(len(X))) if isinstance(rows, slice) else rows)


def example_of(X: Any, chosen: Chosen) -> Any:
    """A few of the rows that count, evenly spread, as the maps see them."""
    rows = spread(chosen.n_rows, EXAMPLE_ROWS)
    return take_rows(X, rows if chosen.positions is None else chosen.positions[rows])


def spread(n_rows: int, n_some: int) -> np.ndarray:
    """Positions of some rows, evenly spread; of all if they are not more."""
    return np.unique(np.linspace(0, n_rows - 1, min(n_rows, n_some)).astype(int))


def apply_map(fitted_map: Any, X: Any, name: str) -> np.ndarray:
    """What a fitted map makes of rows, block by block.

    Parameters
    ----------
    fitted_map : transformer
    X : array-like of shape (n, d)
        As the user gave it.
    name : str
        The argument's name, for errors.

    Returns
    -------
    values : ndarray of shape (n, width) or, of a map with a row per output, (n, n_outputs, width)

    Raises
    ------
    ValueError
        If it returns the wrong number of rows or of dimensions, or values that are not finite.
    """
    n_rows = X.shape[0]
    blocks: list[np.ndarray] = []
    for first in range(0, n_rows, MAP_ROWS):
        rows = X if n_rows <= MAP_ROWS else take_rows(X, slice(first, first + MAP_ROWS))
        values = transformed(fitted_map, rows)
        if not _is_good(values, rows.shape[0]):
            values = _checked(values, rows.shape[0], f"{name}={fitted_map!r}")
        if blocks and values.shape[1:] != blocks[0].shape[1:]:
            raise ValueError(
                f"{name}={fitted_map!r} must return the same number of columns for all rows; it returned "
                f"{shape_text(blocks[0].shape[1:])} and {shape_text(values.shape[1:])}."
            )
        blocks.append(values)
    return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)


def transformed(fitted_map: Any, rows: Any) -> Any:
    """What a fitted map returns of rows.

    Unions, by themselves or last in a pipeline, are put together here: scikit-learn's take no rows for each output, and
    for a row their bookkeeping takes longer than all parts.
    """
    if type(fitted_map) is Pipeline:
        steps = [step for _, step in fitted_map.steps if step not in (None, "passthrough")]
        if steps and type(steps[-1]) in (Pipeline, FeatureUnion):
            for step in steps[:-1]:
                rows = step.transform(rows)
            return transformed(steps[-1], rows)
    if type(fitted_map) is FeatureUnion:
        parts = [(name, part) for name, part in fitted_map.transformer_list if not isinstance(part, str)]
        values = [_dense(transformed(part, rows)) for _, part in parts]
        if values and all(part.shape[:1] == rows.shape[:1] for part in values):
            if weights := fitted_map.transformer_weights:
                names = [name for name, _ in parts]
                each = [1.0 if weights.get(name) is None else weights[name] for name in names]
                values = [part * weight for part, weight in zip(values, each, strict=True)]
            return _side_by_side(values)
    return fitted_map.transform(rows)


def _dense(values: Any) -> np.ndarray:
    return np.asarray(values.toarray() if issparse(values) else values)


def _side_by_side(parts: list[np.ndarray]) -> np.ndarray:
    """Columns of all parts; of parts with a row per output, and others with one for all, those of each output."""
    n_outputs = {part.shape[1] for part in parts if part.ndim == 3}
    if not n_outputs:
        return np.hstack(parts)
    if len(n_outputs) > 1:
        raise ValueError(f"Parts of a union have rows for different numbers of outputs: {sorted(n_outputs)}.")
    (o,) = n_outputs
    each = [part if part.ndim == 3 else np.repeat(part[:, np.newaxis], o, axis=1) for part in parts]
    return np.concatenate(each, axis=2)


def _is_good(values: Any, n_rows: int) -> bool:
    """Whether it needs no other check: what nearly every map returns, and a message takes longer than the features."""
    return (
        type(values) is np.ndarray
        and values.dtype == np.float64
        and values.ndim in (2, 3)
        and len(values) == n_rows
        and values.size > 0
        and bool(np.abs(values).max() <= LARGEST)  # False if there is a NaN
    )


def _checked(values: Any, n_rows: int, called: str) -> np.ndarray:
    """What a map returned as an array of floats, or an error that names the map."""
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


def shape_text(shape: tuple[int, ...]) -> str:
    """What a row has, for errors: its columns, or outputs x columns."""
    return " x ".join(map(str, shape))


# --- X and y through both maps ----------------------------------------------------------------------------------------

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


@dataclass(frozen=True)
class Maps:
    """The fitted maps of a model, an example of the rows that they were fitted to, and number and names of X's columns.

    ``shapes`` are those of a row's kernel inputs and features, once they are known.
    """

    feature_map: Any
    kernel_map: Any
    example: Any = None
    n_columns: int = 0
    columns: np.ndarray | None = None
    shapes: RowShapes | None = None

    def __getstate__(self) -> dict[str, Any]:
        # A data frame as arrays: whoever reads it need not have its package.
        return {**vars(self), "example": FrameColumns.of(self.example) or self.example}

    def __setstate__(self, state: dict[str, Any]) -> None:
        example = state["example"]
        vars(self).update(state, example=example.frame() if isinstance(example, FrameColumns) else example)

    def rows(self, given: Any, X: Any, rows: slice | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The kernel's inputs and the features of some rows, given as the maps see them and as the kernel does."""
        array = take_rows(X, rows)
        given = array if given is X else take_rows(given, rows)
        found = map_rows(given, array, self.feature_map, self.kernel_map)
        if self.shapes is not None:
            check_shapes(found, self.shapes)
        return found


def map_rows(given: Any, X: Any, feature_map: Any, kernel_map: Any) -> tuple[np.ndarray, np.ndarray]:
    """The kernel's inputs and the features of rows X; the maps see ``given``."""
    inputs = X if kernel_map is None else apply_map(kernel_map, given, "kernel_map")
    features = np.empty((len(X), 0)) if feature_map is None else apply_map(feature_map, given, "feature_map")
    return inputs, features
