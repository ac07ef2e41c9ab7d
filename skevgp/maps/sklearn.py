"""Adapters of scikit-learn's transformers, and of pipelines, unions and column transformers."""

from __future__ import annotations

import operator
from collections import UserList
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.sparse import issparse
from sklearn.compose import ColumnTransformer
from sklearn.decomposition import PCA, TruncatedSVD
from sklearn.pipeline import FeatureUnion, Pipeline
from sklearn.preprocessing import (
    FunctionTransformer,
    MaxAbsScaler,
    MinMaxScaler,
    PolynomialFeatures,
    RobustScaler,
    SplineTransformer,
    StandardScaler,
)

from ..data.maps import transformed
from ..utils.casadi import casadi
from ..utils.shapes import same_for_all
from ..utils.sklearn import safe_indexing
from .base import Identity, Map, NoExpressionError, adapts, as_map, exportable

# --- transformers made of others -------------------------------------------------------------------------------------


def steps_of(pipeline: Pipeline) -> list[Any]:
    """The steps of a pipeline that do something."""
    return [step for _, step in pipeline.steps if step not in (None, "passthrough")]


class PartOfUnion(NamedTuple):
    """A transformer of a union."""

    name: str
    transformer: Any
    # Its input, its columns in the result of the union, and the number that these are multiplied by.
    rows: Any
    columns: np.ndarray
    weight: float


def parts_of_union(feature_map: Any, rows: Any) -> Iterator[PartOfUnion]:
    """The parts of a fitted union, given some rows of its input. Parts of weight 0 are left out: they return 0."""
    if isinstance(feature_map, FeatureUnion):
        start = 0
        for name, part in feature_map.transformer_list:
            if part == "drop":
                continue
            first = safe_indexing(rows, slice(0, 1))
            width = np.shape(first if part == "passthrough" else transformed(part, first))[-1]
            weight = _weight(feature_map, name)
            if weight != 0.0:
                yield PartOfUnion(name, part, rows, np.arange(start, start + width), weight)
            start += width
    elif isinstance(feature_map, ColumnTransformer):
        for name, part, columns in feature_map.transformers_:
            own = np.arange(feature_map.output_indices_[name].start, feature_map.output_indices_[name].stop)
            weight = _weight(feature_map, name)
            if len(own) and weight != 0.0:
                yield PartOfUnion(name, part, safe_indexing(rows, columns, axis=1), own, weight)


def _weight(union: Any, name: str) -> float:
    weight = (union.transformer_weights or {}).get(name)
    return 1.0 if weight is None else float(weight)


@adapts(Pipeline)
class Chained(Map):
    """A pipeline: the chain rule over its steps."""

    def __init__(self, transformer: Pipeline, example: Any = None):
        super().__init__(transformer, example)
        steps = [step for _, step in transformer.steps]
        self._steps = [as_map(step) for step in steps]
        last = max((index for index, own in enumerate(self._steps) if own.by_example), default=-1)
        for index, step in enumerate(steps[: last + 1]):
            self._steps[index] = as_map(step, example=example)
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
        behind: list[Map] = []  # steps that are not yet applied to the rows; linear steps need no rows
        for step in self._steps:
            if not step.linear:
                for earlier in behind:
                    rows = earlier.value(rows)
                behind = []
                if rows.ndim > 2:  # a row for each output, to which the chain rule does not apply
                    return super().jacobian(X) if inner is None else super().chain(X, inner)
            jacobian = step.jacobian(rows) if jacobian is None else step.chain(rows, jacobian)
            behind.append(step)
        assert jacobian is not None
        return jacobian

    def casadi(self, x: Any) -> Any:
        for step in self._steps:
            if isinstance(x, list) and not isinstance(step, Identity):
                raise NoExpressionError(
                    f"{step.transformer!r} comes after a map that returns a row for each output. {exportable()}"
                )
            x = step.casadi(x)
        return x


class _SideBySide(Map):
    """Maps whose outputs are joined, each of some columns of X and with its own weight."""

    # Part, indices of columns (None: all), weight (None: 1).
    _parts: list[tuple[Map, np.ndarray | None, float | None]]

    def __init__(self, transformer: Any, parts: list[tuple[Map, np.ndarray | None, float | None]]):
        super().__init__(transformer)
        self._parts = parts
        self.linear = all(part.linear for part, *_ in parts)
        self.by_example = any(part.by_example for part, *_ in parts)

    def value(self, X: np.ndarray) -> np.ndarray:
        parts = [_times(part.value(_taken(X, own)), weight) for part, own, weight in self._parts]
        return _joined(parts, len(X))

    def chain(self, X: np.ndarray, inner: np.ndarray) -> np.ndarray:
        parts = []
        for part, own, weight in self._parts:
            rows = X if part.linear else _taken(X, own)
            parts.append(_times(part.chain(rows, _taken(inner, own)), weight))
        return _joined(parts, len(X), inner.shape[2])

    def casadi(self, x: Any) -> Any:
        ca, parts = casadi(), []
        for part, own, weight in self._parts:
            row = part.casadi(x if own is None else chosen(x, own))
            if weight is not None:
                row = [each * float(weight) for each in row] if isinstance(row, list) else row * float(weight)
            parts.append(row)
        n_outputs = next((len(row) for row in parts if isinstance(row, list)), None)
        if n_outputs is None:
            return ca.vertcat(*parts) if parts else ca.MX(0, 1)
        each_output = ([row[o] if isinstance(row, list) else row for row in parts] for o in range(n_outputs))
        return [ca.vertcat(*rows) for rows in each_output]


@adapts(FeatureUnion)
class Union(_SideBySide):
    """A union of maps."""

    def __init__(self, transformer: FeatureUnion, example: Any = None):
        weights = transformer.transformer_weights or {}
        parts = [(name, part) for name, part in transformer.transformer_list if not _is_dropped(part)]
        super().__init__(
            transformer, [(as_map(part, example=example), None, weights.get(name)) for name, part in parts]
        )

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        parts = [_times(part.jacobian(X), weight) for part, _, weight in self._parts]
        return _joined(parts, len(X), X.shape[1])


@adapts(ColumnTransformer)
class Columns(_SideBySide):
    """Maps of some columns each."""

    def __init__(self, transformer: ColumnTransformer, example: Any = None):
        weights = transformer.transformer_weights or {}
        names = list(getattr(transformer, "feature_names_in_", []))
        parts: list[tuple[Map, np.ndarray | None, float | None]] = []
        for name, part, columns in transformer.transformers_:
            own = column_indices(columns, names, transformer.n_features_in_)
            if len(own) and not _is_dropped(part):
                rows = None if example is None else safe_indexing(example, own, axis=1)
                parts.append((as_map(part, example=rows), own, weights.get(name)))
        super().__init__(transformer, parts)

    @classmethod
    def of(cls, transformer: ColumnTransformer, example: Any) -> Map:
        of_vectors = any(np.isscalar(columns) for _, _, columns in transformer.transformers_)
        return ColumnsAsVectors(transformer, example) if of_vectors else cls(transformer, example)

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        each = np.eye(X.shape[1])
        return self.chain(X, np.broadcast_to(each, (len(X), *each.shape)))


class ColumnsAsVectors(Map):
    """A column transformer one of whose parts takes a column as a vector: it has an expression but no adapter."""

    def casadi(self, x: Any) -> Any:
        return Columns(self.transformer).casadi(x)


def _behind(step: Any, own: Map, example: Any) -> Any:
    """Return the example after a step of a pipeline, for the next step; None if the result is not a table of rows."""
    if example is None or isinstance(own, Identity):
        return example
    found = step.transform(example)
    found = found.toarray() if issparse(found) else found
    return found if len(found.shape) == 2 else None


def _is_dropped(part: Any) -> bool:
    return part is None or (isinstance(part, str) and part == "drop")


def column_indices(columns: Any, names: list[str], n_columns: int) -> np.ndarray:
    """Return indices of the columns that a column transformer was given by index, name, slice, list or mask."""
    if isinstance(columns, slice):
        if isinstance(columns.start, str) or isinstance(columns.stop, str):  # a slice of names includes the last one
            start = None if columns.start is None else names.index(columns.start)
            stop = None if columns.stop is None else names.index(columns.stop) + 1
            columns = slice(start, stop, columns.step)
        return np.arange(n_columns)[columns]
    if isinstance(columns, UserList):  # the remainder in scikit-learn 1.6, whose items warn when read
        columns = columns.data
    listed = np.atleast_1d(np.asarray(columns)).tolist()
    if not listed:
        return np.empty(0, dtype=int)
    return np.arange(n_columns)[[names.index(name) for name in listed] if isinstance(listed[0], str) else listed]


def _taken(values: np.ndarray, columns: np.ndarray | None) -> np.ndarray:
    return values if columns is None else values.take(columns, axis=1)


def _times(values: np.ndarray, weight: float | None) -> np.ndarray:
    return values if weight is None else values * weight


def _joined(parts: Sequence[np.ndarray], n_rows: int, *more: int) -> np.ndarray:
    """Join parts (n_rows, width, *more) along width; parts for all outputs are repeated if others have one for each."""
    if not parts:
        return np.empty((n_rows, 0, *more))
    for_all = 2 + len(more)
    n_outputs = next((part.shape[1] for part in parts if part.ndim > for_all), None)
    if n_outputs is not None:
        parts = [part if part.ndim > for_all else np.repeat(part[:, np.newaxis], n_outputs, axis=1) for part in parts]
    return np.concatenate(parts, axis=-1 - len(more))


def chosen(x: Any, indices: Any) -> Any:
    """Select columns of a symbolic row in the given order; returns the row itself if that is all of it."""
    indices = np.asarray(indices).tolist()
    return x if indices == list(range(x.numel())) else x[indices]


# --- scalers ---------------------------------------------------------------------------------------------------------


class Elementwise(Map):
    """A map of each column by itself: operations of a scaler in its order, then a clip to a range."""

    by_example = False

    def __init__(
        self,
        transformer: Any,
        steps: list[tuple[np.ufunc, np.ndarray | None]],
        limits: tuple[float, float] | None = None,
    ):
        # Steps with None are left out. Beyond the limits the map is constant.
        super().__init__(transformer)
        self._steps = [(step, operand) for step, operand in steps if operand is not None]
        self._limits = limits
        self.linear = limits is None
        self._slopes = np.ones(transformer.n_features_in_)
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
        jacobian = same_for_all(self._jacobian, len(X))
        return jacobian if self._limits is None else jacobian * self._inside(X)

    def chain(self, X: np.ndarray, inner: np.ndarray) -> np.ndarray:
        product = inner * self._slopes[:, np.newaxis]
        return product if self._limits is None else product * self._inside(X)

    def _inside(self, X: np.ndarray) -> np.ndarray:
        assert self._limits is not None
        values, (least, largest) = self._unlimited(X), self._limits
        return ((values >= least) & (values <= largest))[:, :, np.newaxis]

    def casadi(self, x: Any) -> Any:
        ca = casadi()
        for step, operand in self._steps:
            if step is np.divide:  # products are faster
                step, operand = np.multiply, 1.0 / np.asarray(operand, dtype=float)
            x = _OPERATIONS[step](x, ca.DM(np.array(operand, dtype=float)))
        return x if self._limits is None else ca.fmin(ca.fmax(x, self._limits[0]), self._limits[1])


_OPERATIONS: dict[np.ufunc, Callable[[Any, Any], Any]] = {
    np.add: operator.add,
    np.subtract: operator.sub,
    np.multiply: operator.mul,
}


@adapts(StandardScaler)
class Standard(Elementwise):
    """(x - mean) / std."""

    def __init__(self, transformer: StandardScaler, example: Any = None):
        mean = transformer.mean_ if transformer.with_mean else None
        super().__init__(transformer, [(np.subtract, mean), (np.divide, transformer.scale_)])


@adapts(RobustScaler)
class Robust(Elementwise):
    """(x - median) / range of the quartiles."""

    def __init__(self, transformer: RobustScaler, example: Any = None):
        super().__init__(transformer, [(np.subtract, transformer.center_), (np.divide, transformer.scale_)])


@adapts(MinMaxScaler)
class MinMax(Elementwise):
    """A scale and a shift, and a clip if the scaler has one."""

    def __init__(self, transformer: MinMaxScaler, example: Any = None):
        limits = transformer.feature_range if transformer.clip else None
        super().__init__(transformer, [(np.multiply, transformer.scale_), (np.add, transformer.min_)], limits)


@adapts(MaxAbsScaler)
class MaxAbs(Elementwise):
    """x / max |x|, and a clip if the scaler has one."""

    def __init__(self, transformer: MaxAbsScaler, example: Any = None):
        limits = (-1.0, 1.0) if getattr(transformer, "clip", False) else None  # not in all versions
        super().__init__(transformer, [(np.divide, transformer.scale_)], limits)


# --- projections -----------------------------------------------------------------------------------------------------


@adapts(PCA, TruncatedSVD)
class Projection(Map):
    """A fitted PCA or TruncatedSVD, with the same order of operations."""

    linear = True
    by_example = False

    def __init__(self, transformer: PCA | TruncatedSVD, example: Any = None):
        super().__init__(transformer)
        self._components = transformer.components_
        self._mean: np.ndarray | None = getattr(transformer, "mean_", None)
        self._centre = None if self._mean is None else np.reshape(self._mean, (1, -1)) @ self._components.T
        self._scale: np.ndarray | None = None
        if getattr(transformer, "whiten", False):
            self._scale = np.maximum(np.sqrt(transformer.explained_variance_), np.finfo(np.float64).eps)
        self._jacobian = self._components if self._scale is None else self._components / self._scale[:, np.newaxis]

    def value(self, X: np.ndarray) -> np.ndarray:
        projected = X @ self._components.T
        projected = projected if self._centre is None else projected - self._centre
        return projected if self._scale is None else projected / self._scale

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        return same_for_all(self._jacobian, len(X))

    def chain(self, X: np.ndarray, inner: np.ndarray) -> np.ndarray:
        return self._jacobian @ inner

    def casadi(self, x: Any) -> Any:
        ca = casadi()
        return ca.mtimes(ca.DM(self._jacobian), x if self._mean is None else x - ca.DM(self._mean))


# --- polynomials, splines and functions ------------------------------------------------------------------------------


@adapts(PolynomialFeatures)
class Monomials(Map):
    """Fitted PolynomialFeatures: each monomial is a monomial of one degree less times its first column."""

    by_example = False

    def __init__(self, transformer: PolynomialFeatures, example: Any = None):
        super().__init__(transformer)
        chosen = [tuple(powers) for powers in transformer.powers_.tolist()]
        known = {(0,) * transformer.n_features_in_} | set(chosen)
        for degree in range(max(map(sum, known)), 0, -1):
            known |= {less for powers in known if sum(powers) == degree for _, less in _one_less(powers)}
        ordered = sorted(known, key=sum)
        position = {powers: index for index, powers in enumerate(ordered)}
        self._n_known = len(ordered)
        self._chosen = np.array([position[powers] for powers in chosen], dtype=int)
        self._degrees = []  # of each degree: slice of its monomials, their parents, and the columns to multiply by
        for degree in range(1, sum(ordered[-1]) + 1):
            own = [powers for powers in ordered if sum(powers) == degree]
            first = position[own[0]]
            columns, less = zip(*(next(_one_less(powers)) for powers in own), strict=True)
            parents = np.array([position[powers] for powers in less])
            self._degrees.append((slice(first, first + len(own)), parents, np.array(columns)))
        # Nonzero derivatives: position, known monomial, and the power to multiply it by.
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

    def casadi(self, x: Any) -> Any:
        # Each monomial is a product of as many factors as the degree, some of them 1.
        ca, powers = casadi(), self.transformer.powers_
        one = powers.shape[1]
        factors = [np.repeat(np.arange(one), own).tolist() for own in powers]
        degree = max(map(len, factors))
        padded = np.array([own + [one] * (degree - len(own)) for own in factors], dtype=int)
        row, found = ca.vertcat(x, 1.0), ca.DM.ones(len(powers))
        for column in padded.reshape(len(powers), degree).T:
            found = found * row[column.tolist()]
        return found


def _one_less(powers: tuple[int, ...]) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Yield each column of a monomial, and the powers that remain if it is taken out once."""
    for column, power in enumerate(powers):
        if power:
            yield column, (*powers[:column], power - 1, *powers[column + 1 :])


@adapts(SplineTransformer)
class Splines(Map):
    """A fitted SplineTransformer: derivatives of B-splines are B-splines."""

    by_example = False

    @classmethod
    def of(cls, transformer: SplineTransformer, example: Any) -> Map:
        # With these options scikit-learn extrapolates the first column from another knot than the rest.
        broken_lines = transformer.extrapolation == "linear" and transformer.degree <= 1
        return Map(transformer, example) if broken_lines else cls(transformer, example)

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        splines = self.transformer.bsplines_
        n_splines = splines[0].c.shape[1]
        jacobian = np.zeros((len(X), X.shape[1], n_splines, X.shape[1]))
        for column, spline in enumerate(splines):
            least, largest = spline.t[spline.k], spline.t[-spline.k - 1]
            x = X[:, column]
            if self.transformer.extrapolation == "periodic":
                x = least + (x - least) % (largest - least) if largest > least else np.zeros_like(x)
            elif self.transformer.extrapolation in ("constant", "linear"):
                x = np.clip(x, least, largest)
            slopes = spline(x, nu=1)
            if self.transformer.extrapolation == "constant":
                slopes[x != X[:, column]] = 0.0
            jacobian[:, column, :, column] = slopes
        kept = n_splines if self.transformer.include_bias else n_splines - 1
        return jacobian[:, :, :kept].reshape(len(X), -1, X.shape[1])


@adapts(FunctionTransformer)
class Function(Map):
    """A FunctionTransformer, with an expression for some functions of NumPy; without a function it is the identity."""

    _IN_CASADI: ClassVar[dict[Any, str]] = {
        np.sin: "sin",
        np.cos: "cos",
        np.tan: "tan",
        np.tanh: "tanh",
        np.exp: "exp",
        np.log: "log",
        np.log1p: "log1p",
        np.sqrt: "sqrt",
        np.abs: "fabs",
    }

    @classmethod
    def of(cls, transformer: FunctionTransformer, example: Any) -> Map:
        return Identity() if transformer.func is None else cls(transformer, example)

    def casadi(self, x: Any) -> Any:
        function = self.transformer.func
        if function in self._IN_CASADI and not self.transformer.kw_args:
            return getattr(casadi(), self._IN_CASADI[function])(x)
        raise NoExpressionError(
            f"{self.transformer!r} cannot be written in CasADi. Only these NumPy functions can be exported: "
            f"{', '.join(known.__name__ for known in self._IN_CASADI)}. For others, write a transformer with a method "
            "to_casadi(x)."
        )
