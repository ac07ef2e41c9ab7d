"""A fitted transformer as a function of rows, without what an estimator checks.

`as_map` looks the transformer's class up in `ADAPTERS`. An adapter is a subclass of `Map` that registers itself by
``@adapts(TheTransformer)``; it overrides `value`, `jacobian` and `casadi` as far as it knows them. `Map` itself is the
adapter of all other transformers. To add a transformer, write one such class, in `sklearn.py` or `physics.py`, and add
a case to `tests/maps/test_contract.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from inspect import getattr_static
from typing import Any

import numpy as np
from scipy.sparse import issparse

from ..data.maps import Maps
from ..utils.frames import as_fitted, package_of
from ..utils.sklearn import safe_indexing
from ..utils.validation import is_frame, words_of

# The step of central differences whose errors of truncation and of rounding are about the same.
_STEP = np.cbrt(np.finfo(np.float64).eps)
# The smallest step, in units of the spacing of numbers like x.
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
    """A fitted map x -> h(x) of finite float64 rows (n, d). It validates nothing and can be pickled.

    This class knows of its transformer only `transform` and, if it has them, ``jacobian(X)`` and ``to_casadi(x)``.
    Without ``jacobian`` it takes central differences. Each column has steps of ε^⅓ times its scale, and all rows go
    through one call of `transform`. The errors are some 1e-10 of the values where the map is smooth on that scale.

    Parameters
    ----------
    transformer : transformer
        Fitted. If it was fitted to a data frame, it gets its rows as one.
    example : array-like of shape (n, d), optional
        Some of the rows that it was fitted to, of the same type. Their standard deviations are the scale of the
        columns. Without an example the scale is max(|x|, 1), and a data frame is of any package.

    Attributes
    ----------
    linear : bool
        Whether the Jacobian is known to be the same for all rows. `chain` then uses only the number of rows.
    by_example : bool
        Whether the example makes a difference.
    """

    linear = False
    by_example = True

    def __init__(self, transformer: Any, example: Any = None):
        self.transformer = transformer
        self._scale = None if example is None else _scale_of(example)
        self._package = package_of(example)

    @classmethod
    def of(cls, transformer: Any, example: Any) -> Map:
        """The map of a transformer; an adapter may leave some transformers to another class."""
        return cls(transformer, example)

    @classmethod
    def covers(cls, transformer: Any) -> bool:
        """Whether the adapter also holds for a transformer of a subclass, which may compute something else."""
        return False

    def value(self, X: np.ndarray) -> np.ndarray:
        """h(x) of each row, (n, width), or (n, n_outputs, width) of a map with a row for each output.

        What is returned may be the rows themselves.
        """
        return as_floats(self.transformer.transform(as_fitted(self.transformer, X, self._package)))

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        """dh/dx of each row, (n, width, d) or (n, n_outputs, width, d)."""
        if not unchanged(self.transformer, "jacobian", "transform"):
            return self._differences(X)
        jacobian = as_floats(self.transformer.jacobian(as_fitted(self.transformer, X, self._package)))
        if jacobian.ndim not in (3, 4) or (len(jacobian), jacobian.shape[-1]) != X.shape:
            raise ValueError(
                f"The method jacobian of {self.transformer!r} must return (n_samples, n_features_out, n_features) or, "
                f"of a map with a row for each output, (n_samples, n_outputs, n_features_out, n_features); for X of "
                f"the shape {X.shape} it returned {jacobian.shape}."
            )
        return jacobian

    def chain(self, X: np.ndarray, inner: np.ndarray) -> np.ndarray:
        """The chain rule: dh/dz where the rows X, (n, d), are functions of z with the Jacobian ``inner``, (n, d, k)."""
        outer = self.jacobian(X)
        return outer @ (inner if outer.ndim == 3 else inner[:, np.newaxis])

    def casadi(self, x: Any) -> Any:
        """h(x) of one symbolic row.

        Parameters
        ----------
        x : casadi.MX of shape (d, 1)

        Returns
        -------
        row : casadi.MX of shape (width, 1), or list of these
            A list has a row for each output.

        Raises
        ------
        NoExpressionError
            If the transformer, or a part of it, has no expression. The message names it and lists those that have one.
        """
        if hasattr(self.transformer, "to_casadi"):
            return self.transformer.to_casadi(x)
        raise NoExpressionError(f"{self.transformer!r} cannot be written in CasADi. {exportable()}")

    def _differences(self, X: np.ndarray) -> np.ndarray:
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
        return copies(np.eye(X.shape[1]), len(X))

    def chain(self, X: np.ndarray, inner: np.ndarray) -> np.ndarray:
        return inner

    def casadi(self, x: Any) -> Any:
        return x


def as_map(transformer: Any, *, example: Any = None) -> Map:
    """Read a fitted transformer.

    It is read once: after it was fitted again, it has to be read again.

    Parameters
    ----------
    transformer : transformer or None
        None and ``"passthrough"`` are the identity. A transformer whose class has no adapter is a `Map`.
    example : array-like of shape (n, d), optional
        Some of the rows that it was fitted to, of the same type. Central differences take their standard deviations
        as the scale of the columns, also behind the steps of a pipeline.

    Returns
    -------
    map : Map

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.preprocessing import PolynomialFeatures
    >>> from skevgp.maps import as_map
    >>> X = np.array([[2.0]])
    >>> as_map(PolynomialFeatures(3).fit(X)).jacobian(X)
    array([[[ 0.],
            [ 1.],
            [ 4.],
            [12.]]])
    """
    if transformer is None or isinstance(transformer, str):
        return Identity()
    own = type(transformer)
    for kind in own.__mro__:
        adapter = ADAPTERS.get(kind)
        if adapter is not None and (kind is own or adapter.covers(transformer)):
            return adapter.of(transformer, example)
    return Map(transformer, example)


def as_maps(maps: Maps) -> tuple[Map | None, Map | None]:
    """Read the feature map and the kernel map of a fitted model; None stays None.

    Raises
    ------
    ValueError
        If columns of X were not numbers.
    """
    if is_frame(maps.example) and (words := words_of(maps.example)):
        raise ValueError(
            f"The columns {words} of X are not numbers: derivatives, functions to be drawn and predictors without "
            "validation need them to be."
        )
    features, inputs = (
        None if each is None else as_map(each, example=maps.example) for each in (maps.feature_map, maps.kernel_map)
    )
    return features, inputs


def exportable() -> str:
    """What can be written in CasADi, for error messages."""
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


def copies(jacobian: np.ndarray, n_rows: int) -> np.ndarray:
    """A copy of one row's Jacobian for each of the rows."""
    found = np.empty((n_rows, *jacobian.shape))
    found[:] = jacobian
    return found


def as_floats(values: Any) -> np.ndarray:
    """What a transformer returned as a float64 array."""
    return np.asarray(values.toarray() if issparse(values) else values, dtype=np.float64)


def _scale_of(example: Any) -> np.ndarray:
    """The standard deviation of each column; of a constant column its size, or 1 if that is more."""
    if is_frame(example):  # as a whole, one of pandas with gaps may not become numbers
        columns = (safe_indexing(example, index, axis=1) for index in range(example.shape[1]))
        example = np.column_stack([np.asarray(column, dtype=np.float64) for column in columns])
    values = np.ma.masked_invalid(example)
    size, deviation = np.abs(values).max(axis=0).filled(0.0), values.std(axis=0).filled(0.0)
    return np.where(deviation > _STEP**2 * size, deviation, np.maximum(size, 1.0))
