"""A fitted transformer as a function of rows, without the validation of an estimator.

`as_map` looks up the adapter of the transformer's class in `ADAPTERS`. An adapter is a subclass of `Map` that registers
itself by ``@adapts(TheTransformer)`` and overrides `value`, `jacobian` and `casadi`. To add one, write such a class in
`sklearn.py` or `physics.py`, and a case in `tests/maps/test_contract.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from inspect import getattr_static
from typing import Any

import numpy as np
from scipy.sparse import issparse

from ..data.maps import Maps
from ..utils.frames import as_fitted, package_of
from ..utils.shapes import same_for_all
from ..utils.sklearn import safe_indexing
from ..utils.validation import is_frame, words_of

# Step of central differences at which truncation and rounding errors are about equal.
_STEP = np.cbrt(np.finfo(np.float64).eps)
# Smallest step, in units of the spacing of floats near x.
_SPACINGS = 256.0

# The adapter of each class of transformers.
ADAPTERS: dict[type, type[Map]] = {}


def adapts(*kinds: type) -> Callable[[type[Map]], type[Map]]:
    """Register the decorated adapter for classes of transformers."""

    def register(adapter: type[Map]) -> type[Map]:
        ADAPTERS.update(dict.fromkeys(kinds, adapter))
        return adapter

    return register


class NoExpressionError(TypeError):
    """A transformer cannot be written in CasADi."""


class Map:
    """A fitted map x -> h(x) of finite float64 rows (n, d): the adapter of all transformers that have no other."""

    linear = False  # whether the Jacobian is the same for all rows; `chain` then uses only the number of rows
    by_example = True  # whether the example makes a difference

    def __init__(self, transformer: Any, example: Any = None):
        # The example holds some rows of `fit`, in their type. Their standard deviations are the scale of the columns.
        # Without an example the scale is max(|x|, 1), and rows become a data frame of any package if one was fitted.
        self.transformer = transformer
        self._scale = None if example is None else _scale_of(example)
        self._package = package_of(example)

    @classmethod
    def of(cls, transformer: Any, example: Any) -> Map:
        """Return the map of a transformer; an adapter may pass some transformers on to another class."""
        return cls(transformer, example)

    @classmethod
    def covers(cls, transformer: Any) -> bool:
        """Whether the adapter also holds for a transformer of a subclass, which may compute something else."""
        return False

    def value(self, X: np.ndarray) -> np.ndarray:
        """Return h(x) of each row, (n, width) or (n, n_outputs, width); it may be X itself."""
        return as_floats(self.transformer.transform(as_fitted(self.transformer, X, self._package)))

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        """Return dh/dx of each row, (n, width, d) or (n, n_outputs, width, d)."""
        if not unchanged(self.transformer, "jacobian", "transform"):
            return self._differences(X)
        jacobian = as_floats(self.transformer.jacobian(as_fitted(self.transformer, X, self._package)))
        if jacobian.ndim not in (3, 4) or (len(jacobian), jacobian.shape[-1]) != X.shape:
            raise ValueError(
                f"The method jacobian of {self.transformer!r} must return the shape (n_samples, n_features_out, "
                "n_features), or (n_samples, n_outputs, n_features_out, n_features) for a map with a row for each "
                f"output. For X of the shape {X.shape} it returned {jacobian.shape}."
            )
        return jacobian

    def chain(self, X: np.ndarray, inner: np.ndarray) -> np.ndarray:
        """Apply the chain rule: dh/dz if the rows X (n, d) are functions of z with the Jacobian ``inner`` (n, d, k)."""
        outer = self.jacobian(X)
        return outer @ (inner if outer.ndim == 3 else inner[:, np.newaxis])

    def casadi(self, x: Any) -> Any:
        """Return h(x) (width, 1) of a symbolic row (d, 1), or a list with one for each output."""
        if hasattr(self.transformer, "to_casadi"):
            return self.transformer.to_casadi(x)
        raise NoExpressionError(f"{self.transformer!r} cannot be written in CasADi. {exportable()}")

    def _differences(self, X: np.ndarray) -> np.ndarray:
        # Central differences with steps of ε^⅓ times the scale of each column; all rows go through one call of
        # `transform`. Errors are about 1e-10 of the values if the map is smooth on that scale.
        size = np.abs(X)
        steps = _STEP * (np.maximum(size, 1.0) if self._scale is None else self._scale)
        steps = np.maximum(steps, _SPACINGS * np.spacing(size))
        by_columns = []
        for column in range(X.shape[1]):
            both = np.concatenate([X, X])
            both[: len(X), column] += steps[:, column]
            both[len(X) :, column] -= steps[:, column]
            values = self.value(both)
            step = both[: len(X), column] - both[len(X) :, column]
            difference = values[: len(X)] - values[len(X) :]
            by_columns.append(difference / step.reshape(-1, *[1] * (values.ndim - 1)))
        return np.stack(by_columns, axis=-1)


class Identity(Map):
    """h(x) = x."""

    linear = True
    by_example = False

    def __init__(self) -> None:
        super().__init__(None)

    def value(self, X: np.ndarray) -> np.ndarray:
        return X

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        return same_for_all(np.eye(X.shape[1]), len(X))

    def chain(self, X: np.ndarray, inner: np.ndarray) -> np.ndarray:
        return inner

    def casadi(self, x: Any) -> Any:
        return x


def as_map(transformer: Any, *, example: Any = None) -> Map:
    """Return the map of a fitted transformer (None or "passthrough": the identity); call it again after another fit."""
    if transformer is None or isinstance(transformer, str):
        return Identity()
    own = type(transformer)
    for kind in own.__mro__:
        adapter = ADAPTERS.get(kind)
        if adapter is not None and (kind is own or adapter.covers(transformer)):
            return adapter.of(transformer, example)
    return Map(transformer, example)


def as_maps(maps: Maps) -> tuple[Map | None, Map | None]:
    """Return feature map and kernel map of a fitted model or None; ValueError if X has columns of words."""
    if is_frame(maps.example) and (words := words_of(maps.example)):
        raise ValueError(
            f"The columns {words} of X are not numbers, which derivatives, sampled functions and compiled "
            "predictors need."
        )
    features, inputs = (
        None if each is None else as_map(each, example=maps.example) for each in (maps.feature_map, maps.kernel_map)
    )
    return features, inputs


def exportable() -> str:
    """List the transformers that can be written in CasADi, for error messages."""
    names = sorted(kind.__name__ for kind, adapter in ADAPTERS.items() if adapter.casadi is not Map.casadi)
    return (
        f"These can be exported: {', '.join(names)}, and any transformer with a method to_casadi(x), from an MX of "
        "shape (n_features, 1) to one of shape (n_features_out, 1) or, of a map with a row for each output, a list of "
        "these."
    )


def unchanged(transformer: Any, name: str, *others: str) -> bool:
    """Whether a transformer has the method ``name``, and no subclass of its class has overridden the ``others``."""
    if not callable(getattr(transformer, name, None)):
        return False
    kind = type(transformer)
    home = next((base for base in kind.__mro__ if name in vars(base)), kind)
    there = ((getattr_static(owner, other, None) for owner in (home, kind)) for other in others)
    return all(at_home is None or at_home is now for at_home, now in there)


def as_floats(values: Any) -> np.ndarray:
    """Convert the result of a transformer to a float64 array."""
    return np.asarray(values.toarray() if issparse(values) else values, dtype=np.float64)


def _scale_of(example: Any) -> np.ndarray:
    """Return the standard deviation of each column, or max(|x|, 1) for a constant column."""
    if is_frame(example):  # by columns, because a whole pandas frame with gaps may not convert to numbers
        columns = (safe_indexing(example, index, axis=1) for index in range(example.shape[1]))
        example = np.column_stack([np.asarray(column, dtype=np.float64) for column in columns])
    values = np.ma.masked_invalid(example)
    size, deviation = np.abs(values).max(axis=0).filled(0.0), values.std(axis=0).filled(0.0)
    return np.where(deviation > _STEP**2 * size, deviation, np.maximum(size, 1.0))
