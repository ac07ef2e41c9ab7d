"""Values and Jacobians of fitted feature maps and kernel maps, for plain arrays and without validation.

A map is read once into a `DirectMap`; pipelines, unions and column transformers into one of their parts, to which the
chain rule is applied. What is not known here is asked by its `transform`, and differentiated by central differences.
"""

from __future__ import annotations

from collections import UserList
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.sparse import issparse
from sklearn.compose import ColumnTransformer
from sklearn.pipeline import FeatureUnion, Pipeline
from sklearn.preprocessing import FunctionTransformer

from ..data.maps import Maps
from ..utils.sklearn import safe_indexing
from ..utils.validation import is_frame, words_of
from .elementary import DirectMap, Foreign, Identity, elementary


def direct_maps(maps: Maps) -> tuple[DirectMap | None, DirectMap | None]:
    """Feature map and kernel map of a fitted model, and None for one that it does not have.

    Raises
    ------
    ValueError
        If columns of X were no numbers.
    """
    if is_frame(maps.example) and (words := words_of(maps.example)):
        raise ValueError(
            f"The columns {words} of X are not numbers: derivatives, functions to be drawn and predictors without "
            "validation need them to be."
        )
    features, inputs = (
        None if each is None else direct_map(each, example=maps.example) for each in (maps.feature_map, maps.kernel_map)
    )
    return features, inputs


def direct_map(transformer: Any, *, example: Any = None) -> DirectMap:
    """Read a fitted map.

    Parameters
    ----------
    transformer : transformer or None
        Exactly known are ours, scikit-learn's StandardScaler, MinMaxScaler, MaxAbsScaler, RobustScaler,
        PolynomialFeatures, SplineTransformer, PCA and FunctionTransformer without a function, and Pipeline,
        FeatureUnion and ColumnTransformer of any maps. Any other map is used by its `transform`, and by its
        ``jacobian(X)`` if it has one, else by central differences: see `Foreign`. None and ``"passthrough"`` are the
        identity. It is read now: fit it again, and it has to be read again.
    example : array-like of shape (n, d), optional
        Some rows of those that it was fitted to, of the same type: central differences take their deviations for a
        unit, also of what the rows become inside a pipeline.

    Returns
    -------
    direct : DirectMap

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.preprocessing import PolynomialFeatures
    >>> from skevgp.maps.maps import direct_map
    >>> X = np.array([[2.0]])
    >>> direct_map(PolynomialFeatures(3).fit(X)).jacobian(X)
    array([[[ 0.],
            [ 1.],
            [ 4.],
            [12.]]])
    """
    kind = type(transformer)
    if transformer is None or isinstance(transformer, str):
        return Identity()
    if kind is FunctionTransformer and transformer.func is None:
        return Identity()
    if kind is Pipeline:
        return Chained(transformer, example)
    if kind is FeatureUnion:
        return SideBySide(transformer, example)
    if kind is ColumnTransformer and not any(np.isscalar(columns) for _, _, columns in transformer.transformers_):
        return OfColumns(transformer, example)
    return elementary(transformer, example)


class Chained(DirectMap):
    """A pipeline."""

    def __init__(self, pipeline: Pipeline, example: Any):
        self._whole = Foreign(pipeline, example)
        steps = [step for _, step in pipeline.steps]
        self._steps = [direct_map(step) for step in steps]
        last = max((index for index, own in enumerate(self._steps) if own.by_example), default=-1)
        for index, step in enumerate(steps[: last + 1]):
            self._steps[index] = direct_map(step, example=example)
            example = _behind(step, self._steps[index], example) if index < last else None
        self.by_example = last >= 0
        self.linear = all(step.linear for step in self._steps)

    def value(self, X: np.ndarray) -> np.ndarray:
        for step in self._steps:
            X = step.value(X)
        return X

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        return self._onward(X, None)

    def chain(self, X: np.ndarray, inner: np.ndarray) -> np.ndarray:
        return self._onward(X, inner)

    def _onward(self, X: np.ndarray, inner: np.ndarray | None) -> np.ndarray:
        jacobian, rows = inner, X
        behind: list[DirectMap] = []  # steps through which the rows have yet to go: linear ones need them not
        for step in self._steps:
            if not step.linear:
                for earlier in behind:
                    rows = earlier.value(rows)
                behind = []
                if rows.ndim > 2:  # a row per output, and no rule for what is made of them
                    return self._whole.jacobian(X) if inner is None else self._whole.chain(X, inner)
            jacobian = step.jacobian(rows) if jacobian is None else step.chain(rows, jacobian)
            behind.append(step)
        assert jacobian is not None
        return jacobian


class SideBySide(DirectMap):
    """A union: the columns of its parts, times their weights."""

    def __init__(self, union: FeatureUnion, example: Any):
        weights = union.transformer_weights or {}
        parts = [(name, part) for name, part in union.transformer_list if not _is_dropped(part)]
        self._parts = [(direct_map(part, example=example), weights.get(name)) for name, part in parts]
        self.linear = all(part.linear for part, _ in self._parts)
        self.by_example = any(part.by_example for part, _ in self._parts)

    def value(self, X: np.ndarray) -> np.ndarray:
        return _joined([_times(part.value(X), weight) for part, weight in self._parts], len(X))

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        parts = [_times(part.jacobian(X), weight) for part, weight in self._parts]
        return _joined(parts, len(X), X.shape[1])

    def chain(self, X: np.ndarray, inner: np.ndarray) -> np.ndarray:
        parts = [_times(part.chain(X, inner), weight) for part, weight in self._parts]
        return _joined(parts, len(X), inner.shape[2])


class OfColumns(DirectMap):
    """A column transformer: the columns of its parts, each of some columns of X."""

    def __init__(self, transformer: ColumnTransformer, example: Any):
        weights = transformer.transformer_weights or {}
        names = list(getattr(transformer, "feature_names_in_", []))
        self._parts = []
        for name, part, columns in transformer.transformers_:
            chosen = column_indices(columns, names, transformer.n_features_in_)
            if len(chosen) and not _is_dropped(part):
                own = direct_map(part, example=None if example is None else safe_indexing(example, chosen, axis=1))
                self._parts.append((own, chosen, weights.get(name)))
        self.linear = all(part.linear for part, *_ in self._parts)
        self.by_example = any(part.by_example for part, *_ in self._parts)

    def value(self, X: np.ndarray) -> np.ndarray:
        parts = [_times(part.value(X.take(own, axis=1)), weight) for part, own, weight in self._parts]
        return _joined(parts, len(X))

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        each = np.eye(X.shape[1])
        return self.chain(X, np.broadcast_to(each, (len(X), *each.shape)))

    def chain(self, X: np.ndarray, inner: np.ndarray) -> np.ndarray:
        parts = []
        for part, own, weight in self._parts:
            rows = X if part.linear else X.take(own, axis=1)
            parts.append(_times(part.chain(rows, inner.take(own, axis=1)), weight))
        return _joined(parts, len(X), inner.shape[2])


def _behind(step: Any, direct: DirectMap, example: Any) -> Any:
    """What a step of a pipeline makes of an example, as the next one sees it; None if these are no rows."""
    if example is None or isinstance(direct, Identity):
        return example
    found = step.transform(example)
    found = found.toarray() if issparse(found) else found
    return found if len(found.shape) == 2 else None


def _is_dropped(part: Any) -> bool:
    return part is None or (isinstance(part, str) and part == "drop")


def column_indices(columns: Any, names: list[str], n_columns: int) -> np.ndarray:
    """Indices of the columns that a column transformer was given: by index or name, a slice, a list or a mask."""
    if isinstance(columns, slice):
        if isinstance(columns.start, str) or isinstance(columns.stop, str):  # names: the last is taken too
            start = None if columns.start is None else names.index(columns.start)
            stop = None if columns.stop is None else names.index(columns.stop) + 1
            columns = slice(start, stop, columns.step)
        return np.arange(n_columns)[columns]
    if isinstance(columns, UserList):  # the rest, in scikit-learn 1.6: to look into it would warn
        columns = columns.data
    listed = np.atleast_1d(np.asarray(columns)).tolist()
    if not listed:
        return np.empty(0, dtype=int)
    return np.arange(n_columns)[[names.index(name) for name in listed] if isinstance(listed[0], str) else listed]


def _times(values: np.ndarray, weight: float | None) -> np.ndarray:
    return values if weight is None else values * weight


def _joined(parts: Sequence[np.ndarray], n_rows: int, *more: int) -> np.ndarray:
    """Parts (n_rows, width, *more) by their columns; with one for all outputs repeated, if others have one for each."""
    if not parts:
        return np.empty((n_rows, 0, *more))
    for_all = 2 + len(more)
    n_outputs = next((part.shape[1] for part in parts if part.ndim > for_all), None)
    if n_outputs is not None:
        parts = [part if part.ndim > for_all else np.repeat(part[:, np.newaxis], n_outputs, axis=1) for part in parts]
    return np.concatenate(parts, axis=-1 - len(more))
