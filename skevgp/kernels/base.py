"""Covariance functions: what all families have in common, their sums and products, and the registry of families.

Each family is a file next to this one. It holds a `Covariance`, the `CovarianceAt` that this makes, and a function
under the decorator `reads`, which makes the `Covariance` of a scikit-learn kernel.

Inputs and inducing points are in the user's coordinates. A covariance of differences subtracts a centre from both, so
that large coordinates cost it no digits. Gradients follow the sum and product rules; each family has its own, written
by hand.
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

# A derivative per row of k(x, x): an array (n,), or one number for all rows.
PerRow = np.ndarray | float
# Rows (n, d) -> what a covariance needs of them, which depends on no parameter.
Preparation = Callable[[np.ndarray], Any]


class Reader(Protocol):
    """Makes the covariance of a scikit-learn kernel of one class, in so many columns."""

    def __call__(self, kernel: Any, n_columns: int, /) -> Covariance:
        """The hyperparameters are the kernel's, in its order."""


_R = TypeVar("_R", bound=Reader)
# The registry: a class of kernels -> who reads it, and whether its covariance has an expression in CasADi.
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
    """Which kernels work, for people."""
    names = ", ".join(kind.__name__ for kind in READERS)
    return f"{names}, sums and products of these, and a WhiteKernel as one of the terms of the outermost sum"


def exported_kernels() -> str:
    """Which kernels can be exported to CasADi, for people."""
    return f"These can be exported: {', '.join(_IN_CASADI)}, sums and products of these."


def one_lengthscale(kernel: Any, n_columns: int) -> bool:
    """Whether a kernel has one lengthscale for all columns; an error if it has neither one nor one per column."""
    if kernel.anisotropic and len(kernel.length_scale) != n_columns:
        raise ValueError(
            f"kernel={kernel!r} has {len(kernel.length_scale)} length scales, but its inputs have {n_columns} columns: "
            "give one length scale, or one per column."
        )
    return not kernel.anisotropic


# --- sums over rows, and what is computed once of rows -------------------------------------------------------------


class Sums(tuple[Any, ...]):
    """Sums over rows side by side (arrays, or `Sums` again): ``+`` adds them one by one."""

    __slots__ = ()

    def __add__(self, other: Any) -> Sums:
        return Sums(map(add, self, other))


def sum_of_rows(per_row: PerRow, n_rows: int) -> float:
    """Σ over rows."""
    return float(np.sum(per_row)) if np.ndim(per_row) else float(per_row) * n_rows


def no_columns(inputs: np.ndarray) -> np.ndarray:
    """How many rows there are, as the length of an array that takes no memory."""
    return np.empty((len(inputs), 0))


def as_they_are(inputs: np.ndarray) -> np.ndarray:
    """The rows themselves."""
    return np.ascontiguousarray(inputs)


@dataclass(frozen=True)
class CentredSquares:
    """Rows -> [x - c, 1, (x - c)²] as columns, (2 d + 1, n).

    Parameters
    ----------
    centre : tuple of d floats, default=()
        c; 0 if there are none.
    """

    centre: tuple[float, ...] = ()

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        n, d = inputs.shape
        found = np.empty((2 * d + 1, n))
        found[:d] = self.centred(inputs).T
        found[d] = 1.0
        np.square(found[:d], out=found[d + 1 :])
        return found

    def centred(self, points: np.ndarray) -> np.ndarray:
        """The same points, seen from c."""
        return points - np.array(self.centre) if self.centre else points

    def symbol(self, x: Any) -> Any:
        """The same of a row x of symbols in CasADi, (d, 1)."""
        return x - casadi().DM(np.array(self.centre)) if self.centre else x


# --- a covariance --------------------------------------------------------------------------------------------------


class CovarianceAt(ABC):
    """A covariance of unit signal variance with its hyperparameters and m inducing points put in."""

    @abstractmethod
    def matrix(self) -> np.ndarray:
        """k(X_m, X_m) of shape (m, m), from exact differences."""

    @abstractmethod
    def cross(self, prepared: Any) -> np.ndarray:
        """k(X_m, X) of shape (m, n)."""

    def diagonal(self, prepared: Any) -> PerRow:
        """k(x, x) of each row, (n,), or one number for all."""
        return 1.0

    @abstractmethod
    def start_pullback(self) -> Any:
        """An empty sum."""

    @abstractmethod
    def slopes(self, prepared: Any) -> np.ndarray:
        """∂k(z, x) / ∂x of each inducing point and row, (m, n, d)."""

    def diagonal_slopes(self, prepared: Any) -> np.ndarray | float:
        """∂k(x, x) / ∂x of each row, (n, d), or one number for all."""
        return 0.0

    @abstractmethod
    def mixed_slopes(self, prepared: Any) -> np.ndarray:
        """∂²k(x, x') / ∂x ∂x'ᵀ of each row at x' = x, (n, d, d): the covariance of the gradient of a function.

        Raises
        ------
        ValueError
            If functions of this covariance have none.
        """

    @abstractmethod
    def cross_pullback(self, prepared: Any, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Any:
        """What one block adds to the sum, given U = k(X_m, X) and gradients in it and in each k(x, x).

        It may overwrite ``U_bar``, and not U.
        """

    @abstractmethod
    def finish_pullback(self, total: Any, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradients in the hyperparameters and the inducing points; ``K_bar``, that in `matrix`, is symmetric."""


class Covariance(ABC):
    """A covariance k̃ with positive hyperparameters, which the inference sees as their logarithms.

    Two are equal if they are the same function of hyperparameters and inputs, whatever is subtracted on the way.
    """

    @property
    @abstractmethod
    def n_hyperparameters(self) -> int:
        """How many hyperparameters there are."""

    @property
    @abstractmethod
    def rows(self) -> Preparation:
        """What is computed once of rows; parts of a sum or product share what equal ones compute."""

    def prepare(self, inputs: np.ndarray) -> Any:
        """What `CovarianceAt` needs of rows (n, d)."""
        return self.rows(inputs)

    def centred(self, centre: np.ndarray) -> Covariance:
        """The same covariance, which keeps its digits around ``centre`` (d,), however far from 0 that is."""
        return self

    @abstractmethod
    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        """k(x, x') of rows x and x' in pairs, (..., d) and (..., d): (...), at log hyperparameters (n_hyper,)."""

    @abstractmethod
    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> CovarianceAt:
        """The covariance with log hyperparameters (n_hyper,) and inducing points (m, d) put in."""

    def random_terms(
        self, hyperparameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> list[tuple[Any, ...]]:
        """Terms of random functions whose mean product is k, (L, d) of each; see `waves`.

        Raises
        ------
        ValueError
            If no spectral density is known.
        """
        raise ValueError(no_functions(type(self).__name__))

    def expression(self, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, Any]:
        """k(X_m, x), (m, 1), and k(x, x) of a row x of symbols in CasADi, (d, 1).

        Raises
        ------
        ValueError
            If it cannot be written in CasADi.
        """
        raise ValueError(f"The kernel {self!r} cannot be written in CasADi. {exported_kernels()}")


def no_functions(of: str) -> str:
    """Why no random functions can be drawn."""
    return (
        f"No functions can be drawn of a kernel with a {of}: its spectral density is not known. sample_y draws at "
        "given rows, and rollout along paths."
    )


# --- sums and products -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Combination(Covariance):
    """Several covariances of the same inputs; their hyperparameters one after the other.

    Parameters
    ----------
    parts : tuple of Covariance
        At least two.
    """

    parts: tuple[Covariance, ...]

    @property
    def n_hyperparameters(self) -> int:
        return sum(part.n_hyperparameters for part in self.parts)

    @property
    def preparations(self) -> tuple[Preparation, ...]:
        """Those of all parts, each once."""
        return tuple(dict.fromkeys(each for part in self.parts for each in _preparations(part)))

    @property
    def rows(self) -> Preparation:
        """What the only preparation computes, or a tuple if there are several."""
        only, *others = self.preparations
        return (lambda inputs: tuple(each(inputs) for each in (only, *others))) if others else only

    def centred(self, centre: np.ndarray) -> _Combination:
        return replace(self, parts=tuple(part.centred(centre) for part in self.parts))

    def own(self, hyperparameters: np.ndarray) -> Iterator[tuple[Covariance, np.ndarray]]:
        """Each part with its hyperparameters."""
        ends = np.cumsum([part.n_hyperparameters for part in self.parts])[:-1]
        return zip(self.parts, np.split(hyperparameters, ends), strict=True)

    def _parts_at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> list[_Part]:
        given = self.preparations
        return [
            _Part(part.at(values, inducing_points), _choice(_preparations(part), given))
            for part, values in self.own(hyperparameters)
        ]


@dataclass(frozen=True)
class _Part:
    """A part put in, and which of the combination's prepared rows are its own."""

    at: CovarianceAt
    own: Callable[[Any], Any]


def _preparations(covariance: Covariance) -> tuple[Preparation, ...]:
    return covariance.preparations if isinstance(covariance, _Combination) else (covariance.rows,)


def _choice(wanted: tuple[Preparation, ...], given: tuple[Preparation, ...]) -> Callable[[Any], Any]:
    """From what some preparations computed to what some of them did, as a part takes it."""
    return _all_of_it if wanted == given else itemgetter(*(given.index(each) for each in wanted))


def _all_of_it(prepared: Any) -> Any:
    return prepared


class Sum(_Combination):
    """Σ k̃ᵢ(x, x')."""

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        return reduce(add, (part.paired(own, inputs, others) for part, own in self.own(hyperparameters)))

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> SumAt:
        return SumAt(self._parts_at(hyperparameters, inducing_points))

    def random_terms(
        self, hyperparameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> list[tuple[Any, ...]]:
        return [term for part, own in self.own(hyperparameters) for term in part.random_terms(own, shape, rng)]

    def expression(self, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, Any]:
        parts = [part.expression(own, points, x) for part, own in self.own(hyperparameters)]
        cross, diagonal = (reduce(add, each) for each in zip(*parts, strict=True))
        return cross, diagonal


class Product(_Combination):
    """Π k̃ᵢ(x, x')."""

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        return reduce(mul, (part.paired(own, inputs, others) for part, own in self.own(hyperparameters)))

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> ProductAt:
        return ProductAt(self._parts_at(hyperparameters, inducing_points))

    def random_terms(
        self, hyperparameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> list[tuple[Any, ...]]:
        parts = [part.random_terms(own, shape, rng) for part, own in self.own(hyperparameters)]
        return [sum(chosen, ()) for chosen in product(*parts)]

    def expression(self, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, Any]:
        parts = [part.expression(own, points, x) for part, own in self.own(hyperparameters)]
        cross, diagonal = (reduce(mul, each) for each in zip(*parts, strict=True))
        return cross, diagonal


class _CombinationAt(CovarianceAt):
    # How values are combined.
    combine: Callable[[Any, Any], Any]

    def __init__(self, parts: list[_Part]):
        self.parts = parts

    def matrix(self) -> np.ndarray:
        return reduce(self.combine, (part.at.matrix() for part in self.parts))

    def cross(self, prepared: Any) -> np.ndarray:
        return reduce(self.combine, (part.at.cross(part.own(prepared)) for part in self.parts))

    def diagonal(self, prepared: Any) -> PerRow:
        return reduce(self.combine, (part.at.diagonal(part.own(prepared)) for part in self.parts))

    def start_pullback(self) -> Sums:
        return Sums(part.at.start_pullback() for part in self.parts)

    def cross_pullback(self, prepared: Any, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
        return self._pulled(prepared, self._values(prepared), U_bar, diagonal_bar)

    def _values(self, prepared: Any) -> list[tuple[np.ndarray, Any]]:
        """k(X_m, X) of each part and, if the part is a sum or product, the same of its own parts."""
        found: list[tuple[np.ndarray, Any]] = []
        for part in self.parts:
            own = part.own(prepared)
            if isinstance(part.at, _CombinationAt):
                within = part.at._values(own)
                found.append((reduce(part.at.combine, (value for value, _ in within)), within))
            else:
                found.append((part.at.cross(own), None))
        return found

    @abstractmethod
    def _pulled(self, prepared: Any, values: list[Any], U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
        """As `cross_pullback`, with the values of the parts."""

    def _each(self, prepared: Any, values: list[Any], U_bars: Iterable[Any], diagonal_bars: Iterable[Any]) -> Sums:
        """What each part adds to the sum."""
        found = []
        for part, (U, within), *bars in zip(self.parts, values, U_bars, diagonal_bars, strict=True):
            own = part.own(prepared)
            if isinstance(part.at, _CombinationAt):
                found.append(part.at._pulled(own, within, *bars))
            else:
                found.append(part.at.cross_pullback(own, U, *bars))
        return Sums(found)

    def _finish(self, total: Sums, K_bars: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        gradients = [part.at.finish_pullback(*own) for part, *own in zip(self.parts, total, K_bars, strict=True)]
        return np.concatenate([hyper_bar for hyper_bar, _ in gradients]), reduce(add, (Z_bar for _, Z_bar in gradients))


class SumAt(_CombinationAt):
    """A `Sum` with hyperparameters and inducing points put in."""

    combine = staticmethod(add)

    def slopes(self, prepared: Any) -> np.ndarray:
        return reduce(add, (part.at.slopes(part.own(prepared)) for part in self.parts))

    def diagonal_slopes(self, prepared: Any) -> np.ndarray | float:
        return reduce(add, (part.at.diagonal_slopes(part.own(prepared)) for part in self.parts))

    def mixed_slopes(self, prepared: Any) -> np.ndarray:
        return reduce(add, (part.at.mixed_slopes(part.own(prepared)) for part in self.parts))

    def _pulled(self, prepared: Any, values: list[Any], U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
        # Each part may overwrite what it gets; the last one may have the original.
        U_bars = chain((U_bar.copy() for _ in self.parts[1:]), [U_bar])
        return self._each(prepared, values, U_bars, [diagonal_bar] * len(self.parts))

    def finish_pullback(self, total: Sums, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._finish(total, [K_bar] * len(self.parts))


class ProductAt(_CombinationAt):
    """A `Product` with hyperparameters and inducing points put in."""

    combine = staticmethod(mul)

    def slopes(self, prepared: Any) -> np.ndarray:
        values = [part.at.cross(part.own(prepared))[:, :, np.newaxis] for part in self.parts]
        return self._by_product_rule(values, [part.at.slopes(part.own(prepared)) for part in self.parts])

    def diagonal_slopes(self, prepared: Any) -> np.ndarray | float:
        values = [np.asarray(part.at.diagonal(part.own(prepared)))[..., np.newaxis] for part in self.parts]
        return self._by_product_rule(values, [part.at.diagonal_slopes(part.own(prepared)) for part in self.parts])

    def mixed_slopes(self, prepared: Any) -> np.ndarray:
        first, *others = (self._at_the_row(part, prepared) for part in self.parts)
        for other in others:
            # With ∂k/∂x = ∂k/∂x' at x' = x, since k is symmetric.
            (f, f_x, f_xx), (g, g_x, g_xx) = first, other
            outer = f_x[:, :, np.newaxis] * g_x[:, np.newaxis]
            mixed = f_xx * g[:, :, np.newaxis] + outer + outer.transpose(0, 2, 1) + f[:, :, np.newaxis] * g_xx
            first = f * g, f * g_x + f_x * g, mixed
        return first[2]

    @staticmethod
    def _at_the_row(part: _Part, prepared: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Value k (n, 1), ∂k/∂x (n, d) and ∂²k/∂x ∂x'ᵀ (n, d, d) of a part at x' = x."""
        own = part.own(prepared)
        mixed = part.at.mixed_slopes(own)
        n, d = mixed.shape[:2]
        value = np.broadcast_to(part.at.diagonal(own), n)[:, np.newaxis]
        return value, np.broadcast_to(0.5 * part.at.diagonal_slopes(own), (n, d)), mixed

    @staticmethod
    def _by_product_rule(values: Sequence[Any], slopes: Sequence[Any]) -> Any:
        return reduce(add, (reduce(mul, (*values[:i], *values[i + 1 :]), own) for i, own in enumerate(slopes)))

    def _pulled(self, prepared: Any, values: list[Any], U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
        diagonals = [part.at.diagonal(part.own(prepared)) for part in self.parts]
        U_bars = _times_others(U_bar, [value for value, _ in values])
        return self._each(prepared, values, U_bars, _times_others(diagonal_bar, diagonals))

    def finish_pullback(self, total: Sums, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._finish(total, _times_others(K_bar, [part.at.matrix() for part in self.parts]))


def _times_others(bar: Any, values: Sequence[Any]) -> list[Any]:
    """The product rule: for each factor, the gradient times all other factors (none is divided out: it may be 0)."""
    return [reduce(mul, (*values[:i], *values[i + 1 :]), bar) for i in range(len(values))]
