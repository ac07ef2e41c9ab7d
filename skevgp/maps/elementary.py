"""Fitted maps without what an estimator checks: values and Jacobians of rows, of maps that have no parts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.util import find_spec
from inspect import getattr_static
from sys import modules
from typing import Any

import numpy as np
from scipy.sparse import issparse
from sklearn.decomposition import PCA
from sklearn.preprocessing import (
    MaxAbsScaler,
    MinMaxScaler,
    PolynomialFeatures,
    RobustScaler,
    SplineTransformer,
    StandardScaler,
)

from ..utils.sklearn import safe_indexing
from ..utils.validation import is_frame

# The step of central differences whose errors of truncation and of rounding are about the same.
_STEP = np.cbrt(np.finfo(np.float64).eps)
# And what it is at least, in units of the spacing of numbers like x.
_SPACINGS = 256.0
# Packages of data frames, and what they call the names of columns.
_FRAMES = (("pandas", "columns"), ("polars", "schema"))


class DirectMap:
    """A fitted map x -> h(x) of finite float64 rows (n, d), for control loops: it checks nothing and may be pickled.

    What `value` returns may be the rows themselves.

    Attributes
    ----------
    linear : bool
        Whether its Jacobian is known to be the same for all rows; `chain` then uses nothing of them but their number.
    by_example : bool
        Whether rows that are an example say how it is used.
    """

    linear = False
    by_example = False

    def value(self, X: np.ndarray) -> np.ndarray:
        """h(x) of each row, (n, width); of a map with a row for each output (n, n_outputs, width)."""
        raise NotImplementedError

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        """dh/dx of each row, (n, width, d) or (n, n_outputs, width, d)."""
        raise NotImplementedError

    def chain(self, X: np.ndarray, inner: np.ndarray) -> np.ndarray:
        """The chain rule: dh/dz where the rows X, (n, d), are functions of z with the Jacobian ``inner``, (n, d, k)."""
        outer = self.jacobian(X)
        return outer @ (inner if outer.ndim == 3 else inner[:, np.newaxis])


class Identity(DirectMap):
    """h(x) = x."""

    linear = True

    def value(self, X: np.ndarray) -> np.ndarray:
        return X

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        return _copies(np.eye(X.shape[1]), len(X))

    def chain(self, X: np.ndarray, inner: np.ndarray) -> np.ndarray:
        return inner


class Elementwise(DirectMap):
    """Each column by itself: what a scaler does, in its own order of operations, then clipped to a range.

    Parameters
    ----------
    steps : list of (ufunc, ndarray or None)
        What is done with the columns by turns; a step with None is left out.
    n_columns : int
    limits : tuple of 2 floats, optional
        Beyond which the map is constant.
    """

    def __init__(
        self, steps: list[tuple[np.ufunc, np.ndarray | None]], n_columns: int, limits: tuple[float, float] | None = None
    ):
        self._steps = [(step, operand) for step, operand in steps if operand is not None]
        self._limits = limits
        self.linear = limits is None
        self._slopes = np.ones(n_columns)
        for step, operand in self._steps:
            if step in (np.multiply, np.divide):
                self._slopes = step(self._slopes, operand)
        self._jacobian = np.diag(self._slopes)

    def value(self, X: np.ndarray) -> np.ndarray:
        values = self._unlimited(X)
        return values if self._limits is None else np.clip(values, *self._limits)

    def _unlimited(self, X: np.ndarray) -> np.ndarray:
        for step, operand in self._steps:
            X = step(X, operand)
        return X

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        jacobian = _copies(self._jacobian, len(X))
        return jacobian if self._limits is None else jacobian * self._inside(X)

    def chain(self, X: np.ndarray, inner: np.ndarray) -> np.ndarray:
        product = inner * self._slopes[:, np.newaxis]
        return product if self._limits is None else product * self._inside(X)

    def _inside(self, X: np.ndarray) -> np.ndarray:
        assert self._limits is not None
        values, (least, largest) = self._unlimited(X), self._limits
        return ((values >= least) & (values <= largest))[:, :, np.newaxis]


class Projection(DirectMap):
    """What a fitted PCA does, in its own order of operations."""

    linear = True

    def __init__(self, pca: PCA):
        self._components = pca.components_
        self._centre = np.reshape(pca.mean_, (1, -1)) @ pca.components_.T
        self._scale: np.ndarray | None = None
        if pca.whiten:
            self._scale = np.maximum(np.sqrt(pca.explained_variance_), np.finfo(np.float64).eps)
        self._jacobian = self._components if self._scale is None else self._components / self._scale[:, np.newaxis]

    def value(self, X: np.ndarray) -> np.ndarray:
        centred = X @ self._components.T - self._centre
        return centred if self._scale is None else centred / self._scale

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        return _copies(self._jacobian, len(X))

    def chain(self, X: np.ndarray, inner: np.ndarray) -> np.ndarray:
        return self._jacobian @ inner


class Monomials(DirectMap):
    """What fitted PolynomialFeatures do: each monomial is one of a degree less times its first column."""

    def __init__(self, polynomial: PolynomialFeatures):
        chosen = [tuple(powers) for powers in polynomial.powers_.tolist()]
        known = {(0,) * polynomial.n_features_in_} | set(chosen)
        for degree in range(max(map(sum, known)), 0, -1):
            known |= {less for powers in known if sum(powers) == degree for _, less in _one_less(powers)}
        ordered = sorted(known, key=sum)
        position = {powers: index for index, powers in enumerate(ordered)}
        self._n_known = len(ordered)
        self._chosen = np.array([position[powers] for powers in chosen], dtype=int)
        self._degrees = []  # of each: where its monomials are, those of a degree less, and the columns they lack
        for degree in range(1, sum(ordered[-1]) + 1):
            own = [powers for powers in ordered if sum(powers) == degree]
            first = position[own[0]]
            columns, less = zip(*(next(_one_less(powers)) for powers in own), strict=True)
            parents = np.array([position[powers] for powers in less])
            self._degrees.append((slice(first, first + len(own)), parents, np.array(columns)))
        # Derivatives that are not 0: where, and which known monomial times which power.
        entries = [
            (row * len(powers) + column, position[less], powers[column])
            for row, powers in enumerate(chosen)
            for column, less in _one_less(powers)
        ]
        self._entries, self._reduced, self._powers = np.array(entries, dtype=int).reshape(-1, 3).T

    def _all(self, X: np.ndarray) -> np.ndarray:
        values = np.ones((len(X), self._n_known))
        for own, parents, columns in self._degrees:
            values[:, own] = values.take(parents, axis=1) * X.take(columns, axis=1)
        return values

    def value(self, X: np.ndarray) -> np.ndarray:
        return self._all(X).take(self._chosen, axis=1)

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        jacobian = np.zeros((len(X), len(self._chosen) * X.shape[1]))
        jacobian[:, self._entries] = self._all(X).take(self._reduced, axis=1) * self._powers
        return jacobian.reshape(len(X), -1, X.shape[1])


def _one_less(powers: tuple[int, ...]) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Each column of a monomial, and the powers of what is left without it once."""
    for column, power in enumerate(powers):
        if power:
            yield column, (*powers[:column], power - 1, *powers[column + 1 :])


class Foreign(DirectMap):
    """A map of which only `transform` is known and, if it has one, `jacobian`; else its Jacobian is by differences.

    Central differences of a column by steps of ε^⅓ times its scale, all rows in one call of `transform`: they err by
    some 1e-10 of the values where the map is smooth on that scale.

    Parameters
    ----------
    transformer : transformer
        Fitted. One that was fitted to a data frame gets its rows as one.
    example : array-like of shape (n, d), optional
        Some rows of those that it was fitted to, of the same type: their deviations are the scale. By default it is
        max(|x|, 1), and a data frame is of any package.
    """

    by_example = True

    def __init__(self, transformer: Any, example: Any = None):
        self._transformer = transformer
        self._scale = None if example is None else _scale_of(example)
        self._package = package_of(example)

    def value(self, X: np.ndarray) -> np.ndarray:
        return _as_floats(self._transformer.transform(as_fitted(self._transformer, X, self._package)))

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        if not _fits(self._transformer, "jacobian", "transform"):
            return self._differences(X)
        jacobian = _as_floats(self._transformer.jacobian(as_fitted(self._transformer, X, self._package)))
        if jacobian.ndim not in (3, 4) or (len(jacobian), jacobian.shape[-1]) != X.shape:
            raise ValueError(
                f"The method jacobian of {self._transformer!r} must return (n_samples, n_features_out, n_features) or, "
                f"of a map with a row for each output, (n_samples, n_outputs, n_features_out, n_features); for X of "
                f"the shape {X.shape} it returned {jacobian.shape}."
            )
        return jacobian

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


class Splines(Foreign):
    """A fitted SplineTransformer: derivatives of B-splines are B-splines."""

    by_example = False

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        splines = self._transformer.bsplines_
        n_splines = splines[0].c.shape[1]
        jacobian = np.zeros((len(X), X.shape[1], n_splines, X.shape[1]))
        for column, spline in enumerate(splines):
            least, largest = spline.t[spline.k], spline.t[-spline.k - 1]
            x = X[:, column]
            if self._transformer.extrapolation == "periodic":
                x = least + (x - least) % (largest - least) if largest > least else np.zeros_like(x)
            elif self._transformer.extrapolation in ("constant", "linear"):
                x = np.clip(x, least, largest)
            slopes = spline(x, nu=1)
            if self._transformer.extrapolation == "constant":
                slopes[x != X[:, column]] = 0.0
            jacobian[:, column, :, column] = slopes
        kept = n_splines if self._transformer.include_bias else n_splines - 1
        return jacobian[:, :, :kept].reshape(len(X), -1, X.shape[1])


class Own(DirectMap):
    """One of our transformers, without its validation."""

    def __init__(self, transformer: Any):
        self._transformer = transformer

    def value(self, X: np.ndarray) -> np.ndarray:
        return self._transformer._values(X)

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        return self._transformer._slopes(X)


def _is_own(transformer: Any) -> bool:
    """Whether a transformer has a value and a Jacobian beneath what validates them, as ours do."""
    return hasattr(transformer, "_values") and _fits(transformer, "_jacobian", "transform", "jacobian")


def _fits(transformer: Any, name: str, *others: str) -> bool:
    """Whether a transformer has a method, and no class below the one that brings it has changed what it belongs to."""
    if not callable(getattr(transformer, name, None)):
        return False
    kind = type(transformer)
    home = next((base for base in kind.__mro__ if name in vars(base)), kind)
    there = ((getattr_static(owner, other, None) for owner in (home, kind)) for other in others)
    return all(at_home is None or at_home is now for at_home, now in there)


def elementary(transformer: Any, example: Any = None) -> DirectMap:
    """The direct map of a fitted transformer that has no parts.

    Parameters
    ----------
    transformer : transformer
        Ours, or a class of scikit-learn in the registry; what is below such a class may do something else, so that it
        is `Foreign` as all others are.
    example : array-like of shape (n, d), optional
        For `Foreign`.
    """
    if _is_own(transformer):
        return Own(transformer)
    known = _KNOWN.get(type(transformer))
    if known is None or (known is Splines and transformer.extrapolation == "linear" and transformer.degree <= 1):
        # Such splines go on from another knot in the first column than in the rest.
        return Foreign(transformer, example)
    return known(transformer)


_KNOWN: dict[type, Callable[[Any], DirectMap]] = {
    StandardScaler: lambda t: Elementwise(
        [(np.subtract, t.mean_ if t.with_mean else None), (np.divide, t.scale_ if t.with_std else None)],
        t.n_features_in_,
    ),
    MinMaxScaler: lambda t: Elementwise(
        [(np.multiply, t.scale_), (np.add, t.min_)], t.n_features_in_, t.feature_range if t.clip else None
    ),
    MaxAbsScaler: lambda t: Elementwise(
        [(np.divide, t.scale_)], t.n_features_in_, (-1.0, 1.0) if getattr(t, "clip", False) else None
    ),
    RobustScaler: lambda t: Elementwise(
        [(np.subtract, t.center_ if t.with_centering else None), (np.divide, t.scale_ if t.with_scaling else None)],
        t.n_features_in_,
    ),
    PCA: Projection,
    PolynomialFeatures: Monomials,
    SplineTransformer: Splines,
}


def _copies(jacobian: np.ndarray, n_rows: int) -> np.ndarray:
    copies = np.empty((n_rows, *jacobian.shape))
    copies[:] = jacobian
    return copies


def _as_floats(values: Any) -> np.ndarray:
    return np.asarray(values.toarray() if issparse(values) else values, dtype=np.float64)


def _scale_of(example: Any) -> np.ndarray:
    """Of each column its standard deviation; its size, or 1 if that is more, if it is constant."""
    if is_frame(example):  # as a whole, one of pandas with gaps may not become numbers
        columns = (safe_indexing(example, index, axis=1) for index in range(example.shape[1]))
        example = np.column_stack([np.asarray(column, dtype=np.float64) for column in columns])
    values = np.ma.masked_invalid(example)
    size, deviation = np.abs(values).max(axis=0).filled(0.0), values.std(axis=0).filled(0.0)
    return np.where(deviation > _STEP**2 * size, deviation, np.maximum(size, 1.0))


def package_of(values: Any) -> str:
    """Where the class of some values is from."""
    return type(values).__module__.partition(".")[0]


def as_fitted(estimator: Any, X: np.ndarray, package: str) -> Any:
    """Rows as an estimator takes them: as a data frame if it was fitted to one.

    It is of the package, if that is one of data frames, else of one that is in use, or installed; rows are as they are
    if there is none.
    """
    names = getattr(estimator, "feature_names_in_", None)
    if names is None:
        return X
    for name, keyword in sorted(_FRAMES, key=lambda frame: (frame[0] != package, frame[0] not in modules)):
        if name in modules or find_spec(name) is not None:
            return import_module(name).DataFrame(X, **{keyword: list(names)})
    return X
