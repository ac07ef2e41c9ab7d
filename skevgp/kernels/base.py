"""Covariance functions: the interface of all families, sums and products, and the registry of families.

Each family is a file next to this one. It holds a `Covariance`, the `CovarianceAt` that it makes, and a function with
the decorator `reads`, which makes the `Covariance` from a scikit-learn kernel.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain, product
from operator import add, itemgetter, mul
from typing import Any, Protocol, TypeVar

import numpy as np

from ..utils.casadi import casadi

# Inputs and inducing points are in the user's coordinates. A covariance of differences subtracts a centre from both, so
# that large coordinates cost no digits. Gradients follow the sum and product rules; each family has its own by hand.
#
# ``hyperparameters`` are values here as in the whole library, such as the length scale itself. All functions take
# values. Only gradients are in the logarithms, because a fit searches there: ∂/∂ log h = h ∂/∂h.

# A derivative of k(x, x) for each row: an array (n,), or one number for all rows.
PerRow = np.ndarray | float
# Rows (n, d) -> the form in which a covariance uses them, which depends on no parameter.
Preparation = Callable[[np.ndarray], Any]


class Reader(Protocol):
    """Makes the covariance of a scikit-learn kernel of one class, for inputs with n_columns columns."""

    def __call__(self, kernel: Any, n_columns: int, /) -> Covariance:
        """Hyperparameters are those of the kernel, in its order."""


_R = TypeVar("_R", bound=Reader)
# The registry: class of kernels -> its reader; and the names of those with an expression in CasADi.
READERS: dict[type, Reader] = {}
_IN_CASADI: list[str] = []


def reads(kind: type, in_casadi: bool = True) -> Callable[[_R], _R]:
    """Register a function as the reader of a class of kernels."""

    def registered(reader: _R) -> _R:
        READERS[kind] = reader
        if in_casadi:
            _IN_CASADI.append(kind.__name__)
        return reader

    return registered


def known_kernels() -> str:
    """List the supported kernels, for messages and documentation."""
    names = ", ".join(sorted(kind.__name__ for kind in READERS))
    return f"{names}, sums and products of these, and a WhiteKernel as one of the terms of the outermost sum"


def exported_kernels() -> str:
    """List the kernels that can be exported to CasADi, for messages."""
    return f"These can be exported: {', '.join(sorted(_IN_CASADI))}, sums and products of these."


def one_lengthscale(kernel: Any, n_columns: int) -> bool:
    """Whether a kernel has one length scale for all columns; ValueError if it has neither one nor one per column."""
    if kernel.anisotropic and len(kernel.length_scale) != n_columns:
        raise ValueError(
            f"kernel={kernel!r} has {len(kernel.length_scale)} length scales, but its inputs have {n_columns} columns. "
            "Pass one length scale, or one for each column."
        )
    return not kernel.anisotropic


# --- sums over rows, and preparations of rows ----------------------------------------------------------------------


# Maps symmetric gradients in k(X_b, X_b) (b, k, k) to that in the log hyperparameters (n_hyper,).
SetsPullback = Callable[[np.ndarray], np.ndarray]


class Sums(tuple[Any, ...]):
    """Several sums over rows (arrays, or `Sums` again); ``+`` adds them one by one."""

    __slots__ = ()

    def __add__(self, other: Any) -> Sums:
        return Sums(map(add, self, other))


def sum_of_rows(per_row: PerRow, n_rows: int) -> float:
    """Sum over rows of an array (n,), or of one number for all rows."""
    return float(np.sum(per_row)) if np.ndim(per_row) else float(per_row) * n_rows


def no_columns(inputs: np.ndarray) -> np.ndarray:
    """Keep only the number of rows, as the length of an array without memory."""
    return np.empty((len(inputs), 0))


def as_they_are(inputs: np.ndarray) -> np.ndarray:
    """Return the rows themselves."""
    return np.ascontiguousarray(inputs)


@dataclass(frozen=True)
class CentredSquares:
    """Rows -> [x - c, 1, (x - c)²] as columns, (2 d + 1, n), with the centre c or 0."""

    centre: tuple[float, ...] = ()

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        n, d = inputs.shape
        columns = np.empty((2 * d + 1, n))
        columns[:d] = self.centred(inputs).T
        columns[d] = 1.0
        np.square(columns[:d], out=columns[d + 1 :])
        return columns

    def centred(self, points: np.ndarray) -> np.ndarray:
        """Subtract c from points."""
        return points - np.array(self.centre) if self.centre else points

    def symbol(self, x: Any) -> Any:
        """Subtract c from a row (d, 1) of CasADi symbols."""
        return x - casadi().DM(np.array(self.centre)) if self.centre else x


# --- a covariance --------------------------------------------------------------------------------------------------


class CovarianceAt(ABC):
    """A covariance of unit signal variance with its hyperparameters and m inducing points put in."""

    @abstractmethod
    def matrix(self) -> np.ndarray:
        """Return k(X_m, X_m) (m, m) from exact differences."""

    @abstractmethod
    def cross(self, prepared: Any) -> np.ndarray:
        """Return k(X_m, X) (m, n)."""

    def diagonal(self, prepared: Any) -> PerRow:
        """Return k(x, x) of each row, (n,), or one number for all rows."""
        return 1.0

    @abstractmethod
    def start_pullback(self) -> Any:
        """Return an empty sum over blocks of rows."""

    @abstractmethod
    def slopes(self, prepared: Any) -> np.ndarray:
        """Return ∂k(z, x) / ∂x of each inducing point and row, (m, n, d)."""

    def diagonal_slopes(self, prepared: Any) -> np.ndarray | float:
        """Return ∂k(x, x) / ∂x of each row, (n, d), or one number for all rows."""
        return 0.0

    @abstractmethod
    def mixed_slopes(self, prepared: Any) -> np.ndarray:
        """Return ∂²k(x, x') / ∂x ∂x'ᵀ at x' = x, (n, d, d): Cov[∂f/∂x]; ValueError if functions have no gradient."""

    @abstractmethod
    def cross_pullback(self, prepared: Any, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Any:
        """Return a block's part of the sum from U = k(X_m, X), its gradient (may be overwritten), that of k(x, x)."""

    @abstractmethod
    def finish_pullback(self, total: Any, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradients in log hyperparameters and in inducing points; ``K_bar``, that in `matrix`, is symmetric."""

    def hyper_gradient(self, K: np.ndarray, K_bar: np.ndarray) -> np.ndarray:
        """Return the gradient in log hyperparameters alone, given K = `matrix` (a subclass may reuse it) and K̄."""
        return self.finish_pullback(self.start_pullback(), K_bar)[0]


class Covariance(ABC):
    """A covariance k̃ with positive hyperparameters. All methods take their values; gradients are in their logarithms.

    Two are equal if they are the same function of hyperparameters and inputs, with any centre.
    """

    @property
    @abstractmethod
    def n_hyperparameters(self) -> int:
        """Number of hyperparameters."""

    @property
    def lengthscale_mask(self) -> np.ndarray:
        """Whether each hyperparameter is the length scale of one of several columns, (n_hyper,)."""
        return np.zeros(self.n_hyperparameters, dtype=bool)

    @property
    def is_length(self) -> np.ndarray:
        """Whether each hyperparameter is a length scale, of one column or of all, (n_hyper,)."""
        return self.lengthscale_mask

    @property
    @abstractmethod
    def rows(self) -> Preparation:
        """Function that prepares rows once; parts of a sum or product share it if theirs are equal."""

    def prepare(self, inputs: np.ndarray) -> Any:
        """Return rows (n, d) in the form that `CovarianceAt` takes."""
        return self.rows(inputs)

    def centred(self, centre: np.ndarray) -> Covariance:
        """Return the same covariance, accurate around ``centre`` (d,) even if that is far from 0."""
        return self

    @abstractmethod
    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Return k(x, x') of pairs of rows, (..., d) and (..., d): (...), at hyperparameters (n_hyper,)."""

    @abstractmethod
    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> CovarianceAt:
        """Return the covariance at hyperparameters (n_hyper,) and inducing points (m, d)."""

    def within(self, hyperparameters: np.ndarray, sets: np.ndarray) -> tuple[np.ndarray, SetsPullback]:
        """Return k(X_b, X_b) (b, k, k) of small sets of rows (b, k, d), and the function that pulls gradients back.

        A subclass may be faster than this loop over the sets.
        """
        parts = [self.at(hyperparameters, rows) for rows in sets]

        def pull_back(bars: np.ndarray) -> np.ndarray:
            total = np.zeros(self.n_hyperparameters)
            for part, bar in zip(parts, bars, strict=True):
                total += part.finish_pullback(part.start_pullback(), bar)[0]
            return total

        return np.array([part.matrix() for part in parts]), pull_back

    def nearness(self, hyperparameters: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Return coordinates (n, k) of rows (n, d): the closer two rows are in these, the larger is their correlation.

        There are none (k = 0) if the kernel has no distance.
        """
        return np.empty((len(inputs), 0))

    def random_terms(
        self, hyperparameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> list[tuple[Any, ...]]:
        """Return terms of random functions whose mean product is k, (L, d) each (see `waves`); may raise ValueError."""
        raise ValueError(no_functions(type(self).__name__))

    def expression(self, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, Any]:
        """Return k(X_m, x) (m, 1) and k(x, x) for a row (d, 1) of CasADi symbols, or raise ValueError."""
        raise ValueError(f"The kernel {self!r} cannot be written in CasADi. {exported_kernels()}")


def no_functions(of: str) -> str:
    """Explain why no random functions can be drawn."""
    return (
        f"No functions can be drawn from a kernel with a {of}: its spectral density is not known. sample_y draws at "
        "given rows, and rollout along paths."
    )


# --- sums and products -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Combination(Covariance):
    """At least two covariances of the same inputs; their hyperparameters follow each other."""

    parts: tuple[Covariance, ...]

    @property
    def n_hyperparameters(self) -> int:
        return sum(part.n_hyperparameters for part in self.parts)

    @property
    def lengthscale_mask(self) -> np.ndarray:
        return np.concatenate([part.lengthscale_mask for part in self.parts])

    @property
    def is_length(self) -> np.ndarray:
        return np.concatenate([part.is_length for part in self.parts])

    @property
    def preparations(self) -> tuple[Preparation, ...]:
        """Preparations of all parts, each once."""
        return tuple(dict.fromkeys(preparation for part in self.parts for preparation in _preparations(part)))

    @property
    def rows(self) -> Preparation:
        """The only preparation, or a function that returns a tuple if there are several."""
        only, *others = self.preparations
        return (lambda inputs: tuple(prepare(inputs) for prepare in (only, *others))) if others else only

    def centred(self, centre: np.ndarray) -> _Combination:
        return replace(self, parts=tuple(part.centred(centre) for part in self.parts))

    def nearness(self, hyperparameters: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        return np.hstack([part.nearness(values, inputs) for part, values in self.pairs(hyperparameters)])

    def pairs(self, hyperparameters: np.ndarray) -> Iterator[tuple[Covariance, np.ndarray]]:
        """Yield each part with its hyperparameters."""
        ends = np.cumsum([part.n_hyperparameters for part in self.parts])[:-1]
        return zip(self.parts, np.split(hyperparameters, ends), strict=True)

    def _parts_at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> list[_Part]:
        given = self.preparations
        return [
            _Part(part.at(values, inducing_points), _choice(_preparations(part), given))
            for part, values in self.pairs(hyperparameters)
        ]


@dataclass(frozen=True)
class _Part:
    """A part at given parameters, and a function that selects its prepared rows from those of the combination."""

    at: CovarianceAt
    rows_of: Callable[[Any], Any]


def _preparations(covariance: Covariance) -> tuple[Preparation, ...]:
    return covariance.preparations if isinstance(covariance, _Combination) else (covariance.rows,)


def _choice(wanted: tuple[Preparation, ...], given: tuple[Preparation, ...]) -> Callable[[Any], Any]:
    """Return a function that selects the results of the wanted preparations."""
    return _all_of_it if wanted == given else itemgetter(*(given.index(preparation) for preparation in wanted))


def _all_of_it(prepared: Any) -> Any:
    return prepared


class Sum(_Combination):
    """Σ k̃ᵢ(x, x')."""

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        return reduce(add, (part.paired(values, inputs, others) for part, values in self.pairs(hyperparameters)))

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> SumAt:
        return SumAt(self._parts_at(hyperparameters, inducing_points))

    def within(self, hyperparameters: np.ndarray, sets: np.ndarray) -> tuple[np.ndarray, SetsPullback]:
        values, pullbacks = zip(*(part.within(own, sets) for part, own in self.pairs(hyperparameters)), strict=True)

        def pull_back(bars: np.ndarray) -> np.ndarray:
            return np.concatenate([of_part(bars) for of_part in pullbacks])

        return reduce(add, values), pull_back

    def random_terms(
        self, hyperparameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> list[tuple[Any, ...]]:
        return [term for part, values in self.pairs(hyperparameters) for term in part.random_terms(values, shape, rng)]

    def expression(self, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, Any]:
        parts = [part.expression(values, points, x) for part, values in self.pairs(hyperparameters)]
        cross, diagonal = (reduce(add, terms) for terms in zip(*parts, strict=True))
        return cross, diagonal


class Product(_Combination):
    """Π k̃ᵢ(x, x')."""

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        return reduce(mul, (part.paired(values, inputs, others) for part, values in self.pairs(hyperparameters)))

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> ProductAt:
        return ProductAt(self._parts_at(hyperparameters, inducing_points))

    def within(self, hyperparameters: np.ndarray, sets: np.ndarray) -> tuple[np.ndarray, SetsPullback]:
        values, pullbacks = zip(*(part.within(own, sets) for part, own in self.pairs(hyperparameters)), strict=True)

        def pull_back(bars: np.ndarray) -> np.ndarray:
            gradients = []
            for index, of_part in enumerate(pullbacks):
                others = reduce(mul, (value for other, value in enumerate(values) if other != index))
                gradients.append(of_part(bars * others))
            return np.concatenate(gradients)

        return reduce(mul, values), pull_back

    def random_terms(
        self, hyperparameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> list[tuple[Any, ...]]:
        parts = [part.random_terms(values, shape, rng) for part, values in self.pairs(hyperparameters)]
        return [sum(chosen, ()) for chosen in product(*parts)]

    def expression(self, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, Any]:
        parts = [part.expression(values, points, x) for part, values in self.pairs(hyperparameters)]
        cross, diagonal = (reduce(mul, factors) for factors in zip(*parts, strict=True))
        return cross, diagonal


class _CombinationAt(CovarianceAt):
    # How values of two parts are combined.
    combine: Callable[[Any, Any], Any]

    def __init__(self, parts: list[_Part]):
        self.parts = parts

    def matrix(self) -> np.ndarray:
        return reduce(self.combine, (part.at.matrix() for part in self.parts))

    def cross(self, prepared: Any) -> np.ndarray:
        return reduce(self.combine, (part.at.cross(part.rows_of(prepared)) for part in self.parts))

    def diagonal(self, prepared: Any) -> PerRow:
        return reduce(self.combine, (part.at.diagonal(part.rows_of(prepared)) for part in self.parts))

    def start_pullback(self) -> Sums:
        return Sums(part.at.start_pullback() for part in self.parts)

    def cross_pullback(self, prepared: Any, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
        return self._pulled(prepared, self._values(prepared), U_bar, diagonal_bar)

    def _values(self, prepared: Any) -> list[tuple[np.ndarray, Any]]:
        """Return k(X_m, X) of each part and, if the part is a sum or product, the values of its own parts."""
        values: list[tuple[np.ndarray, Any]] = []
        for part in self.parts:
            rows = part.rows_of(prepared)
            if isinstance(part.at, _CombinationAt):
                within = part.at._values(rows)
                values.append((reduce(part.at.combine, (value for value, _ in within)), within))
            else:
                values.append((part.at.cross(rows), None))
        return values

    @abstractmethod
    def _pulled(self, prepared: Any, values: list[Any], U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
        """Do the same as `cross_pullback`, given the values of the parts."""

    def _addends(self, prepared: Any, values: list[Any], U_bars: Iterable[Any], diagonal_bars: Iterable[Any]) -> Sums:
        """Return the addends of all parts."""
        addends = []
        for part, (U, within), *bars in zip(self.parts, values, U_bars, diagonal_bars, strict=True):
            rows = part.rows_of(prepared)
            if isinstance(part.at, _CombinationAt):
                addends.append(part.at._pulled(rows, within, *bars))
            else:
                addends.append(part.at.cross_pullback(rows, U, *bars))
        return Sums(addends)

    def _finish(self, total: Sums, K_bars: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        gradients = [part.at.finish_pullback(*bars) for part, *bars in zip(self.parts, total, K_bars, strict=True)]
        return np.concatenate([hyper_bar for hyper_bar, _ in gradients]), reduce(add, (Z_bar for _, Z_bar in gradients))


class SumAt(_CombinationAt):
    """A `Sum` at given hyperparameters and inducing points."""

    combine = staticmethod(add)

    def slopes(self, prepared: Any) -> np.ndarray:
        return reduce(add, (part.at.slopes(part.rows_of(prepared)) for part in self.parts))

    def diagonal_slopes(self, prepared: Any) -> np.ndarray | float:
        return reduce(add, (part.at.diagonal_slopes(part.rows_of(prepared)) for part in self.parts))

    def mixed_slopes(self, prepared: Any) -> np.ndarray:
        return reduce(add, (part.at.mixed_slopes(part.rows_of(prepared)) for part in self.parts))

    def _pulled(self, prepared: Any, values: list[Any], U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
        # Each part may overwrite its gradient, so that all but the last get a copy.
        U_bars = chain((U_bar.copy() for _ in self.parts[1:]), [U_bar])
        return self._addends(prepared, values, U_bars, [diagonal_bar] * len(self.parts))

    def finish_pullback(self, total: Sums, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._finish(total, [K_bar] * len(self.parts))


class ProductAt(_CombinationAt):
    """A `Product` at given hyperparameters and inducing points."""

    combine = staticmethod(mul)

    def slopes(self, prepared: Any) -> np.ndarray:
        values = [part.at.cross(part.rows_of(prepared))[:, :, np.newaxis] for part in self.parts]
        return self._by_product_rule(values, [part.at.slopes(part.rows_of(prepared)) for part in self.parts])

    def diagonal_slopes(self, prepared: Any) -> np.ndarray | float:
        values = [np.asarray(part.at.diagonal(part.rows_of(prepared)))[..., np.newaxis] for part in self.parts]
        return self._by_product_rule(values, [part.at.diagonal_slopes(part.rows_of(prepared)) for part in self.parts])

    def mixed_slopes(self, prepared: Any) -> np.ndarray:
        first, *others = (self._at_the_row(part, prepared) for part in self.parts)
        for other in others:
            # ∂k/∂x = ∂k/∂x' at x' = x, because k is symmetric.
            (f, f_x, f_xx), (g, g_x, g_xx) = first, other
            outer = f_x[:, :, np.newaxis] * g_x[:, np.newaxis]
            mixed = f_xx * g[:, :, np.newaxis] + outer + outer.transpose(0, 2, 1) + f[:, :, np.newaxis] * g_xx
            first = f * g, f * g_x + f_x * g, mixed
        return first[2]

    @staticmethod
    def _at_the_row(part: _Part, prepared: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return value k (n, 1), ∂k/∂x (n, d) and ∂²k/∂x ∂x'ᵀ (n, d, d) of a part at x' = x."""
        rows = part.rows_of(prepared)
        mixed = part.at.mixed_slopes(rows)
        n, d = mixed.shape[:2]
        value = np.broadcast_to(part.at.diagonal(rows), n)[:, np.newaxis]
        return value, np.broadcast_to(0.5 * part.at.diagonal_slopes(rows), (n, d)), mixed

    @staticmethod
    def _by_product_rule(values: Sequence[Any], slopes: Sequence[Any]) -> Any:
        return reduce(add, (reduce(mul, (*values[:i], *values[i + 1 :]), slope) for i, slope in enumerate(slopes)))

    def _pulled(self, prepared: Any, values: list[Any], U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
        diagonals = [part.at.diagonal(part.rows_of(prepared)) for part in self.parts]
        U_bars = _times_others(U_bar, [value for value, _ in values])
        return self._addends(prepared, values, U_bars, _times_others(diagonal_bar, diagonals))

    def finish_pullback(self, total: Sums, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._finish(total, _times_others(K_bar, [part.at.matrix() for part in self.parts]))


def _times_others(bar: Any, values: Sequence[Any]) -> list[Any]:
    """Multiply a gradient by all other factors, for each factor (product rule without divisions by 0)."""
    return [reduce(mul, (*values[:i], *values[i + 1 :]), bar) for i in range(len(values))]
