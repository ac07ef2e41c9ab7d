"""Covariance functions with gradients: what they have in common, and their sums and products.

Inputs and inducing points are in the user's coordinates. A covariance of differences subtracts a centre from both, so
that large coordinates cost it no digits. Gradients follow the sum and product rules; each part has its own, written by
hand.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from operator import add, itemgetter, mul
from typing import Any

import numpy as np

# A derivative per row of k(x, x): an array (n,), or one number for all rows.
PerRow = np.ndarray | float
# Rows (n, d) -> what a covariance needs of them, which depends on no parameter.
Preparation = Callable[[np.ndarray], Any]
# Takes gradients in k(X_m, X) (which it may overwrite) and in each k(x, x); returns what a block adds to the sum.
Pull = Callable[[np.ndarray, PerRow], Any]


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
        return points - self._centre

    @cached_property
    def _centre(self) -> np.ndarray | float:
        return np.array(self.centre) if self.centre else 0.0


class CovarianceAt(ABC):
    """A covariance with its hyperparameters and inducing points put in; see `statistics.KernelAt`."""

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
    def linearised(self, prepared: Any) -> tuple[np.ndarray, Pull]:
        """k(X_m, X), and the function that pulls gradients back through it."""

    def cross_pullback(self, prepared: Any, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Any:
        """What one block adds to the sum, given gradients in k(X_m, X) and in each k(x, x)."""
        return self.linearised(prepared)[1](U_bar, diagonal_bar)

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
    def preparations(self) -> tuple[Preparation, ...]:
        """What is computed once of rows; parts of a combination share what equal ones compute."""

    def prepare(self, inputs: np.ndarray) -> Any:
        """What `CovarianceAt` needs of rows (n, d): what the preparation computes, or a tuple if there are several."""
        only, *others = self.preparations
        return tuple(each(inputs) for each in (only, *others)) if others else only(inputs)

    def centred(self, centre: np.ndarray) -> Covariance:
        """The same covariance, which keeps its digits around ``centre`` (d,), however far from 0 that is."""
        return self

    @abstractmethod
    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        """k(x, x') of rows x and x' in pairs, (..., d) and (..., d): (...), at log hyperparameters (n_hyper,)."""

    @abstractmethod
    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> CovarianceAt:
        """The covariance with log hyperparameters (n_hyper,) and inducing points (m, d) put in."""


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
        return tuple(dict.fromkeys(each for part in self.parts for each in part.preparations))

    def centred(self, centre: np.ndarray) -> _Combination:
        return replace(self, parts=tuple(part.centred(centre) for part in self.parts))

    def own(self, hyperparameters: np.ndarray) -> Iterator[tuple[Covariance, np.ndarray]]:
        """Each part with its hyperparameters."""
        ends = np.cumsum([part.n_hyperparameters for part in self.parts])[:-1]
        return zip(self.parts, np.split(hyperparameters, ends), strict=True)

    def _parts_at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> list[_Part]:
        given = self.preparations
        return [
            _Part(part.at(values, inducing_points), _choice(part.preparations, given))
            for part, values in self.own(hyperparameters)
        ]


@dataclass(frozen=True)
class _Part:
    """A part put in, and which of the combination's prepared rows are its own."""

    at: CovarianceAt
    own: Callable[[Any], Any]


def _choice(wanted: tuple[Preparation, ...], given: tuple[Preparation, ...]) -> Callable[[Any], Any]:
    """From what some preparations computed to what some of them did, as `Covariance.prepare` returns it."""
    return _all_of_it if wanted == given else itemgetter(*(given.index(each) for each in wanted))


def _all_of_it(prepared: Any) -> Any:
    return prepared


class Sum(_Combination):
    """Σ k̃ᵢ(x, x')."""

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        return reduce(add, (part.paired(own, inputs, others) for part, own in self.own(hyperparameters)))

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> SumAt:
        return SumAt(self._parts_at(hyperparameters, inducing_points))


class Product(_Combination):
    """Π k̃ᵢ(x, x')."""

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        return reduce(mul, (part.paired(own, inputs, others) for part, own in self.own(hyperparameters)))

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> ProductAt:
        return ProductAt(self._parts_at(hyperparameters, inducing_points))


class _CombinationAt(CovarianceAt):
    def __init__(self, parts: list[_Part]):
        self.parts = parts

    def start_pullback(self) -> Sums:
        return Sums(part.at.start_pullback() for part in self.parts)

    def _linearised(self, prepared: Any) -> tuple[Sequence[np.ndarray], Sequence[Pull]]:
        values, pulls = zip(*(part.at.linearised(part.own(prepared)) for part in self.parts), strict=True)
        return values, pulls

    def _finish(self, total: Sums, K_bars: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        gradients = [part.at.finish_pullback(*own) for part, *own in zip(self.parts, total, K_bars, strict=True)]
        return np.concatenate([hyper_bar for hyper_bar, _ in gradients]), reduce(add, (Z_bar for _, Z_bar in gradients))


class SumAt(_CombinationAt):
    """A `Sum` with hyperparameters and inducing points put in."""

    def matrix(self) -> np.ndarray:
        return reduce(add, (part.at.matrix() for part in self.parts))

    def cross(self, prepared: Any) -> np.ndarray:
        return reduce(add, (part.at.cross(part.own(prepared)) for part in self.parts))

    def diagonal(self, prepared: Any) -> PerRow:
        return reduce(add, (part.at.diagonal(part.own(prepared)) for part in self.parts))

    def slopes(self, prepared: Any) -> np.ndarray:
        return reduce(add, (part.at.slopes(part.own(prepared)) for part in self.parts))

    def diagonal_slopes(self, prepared: Any) -> np.ndarray | float:
        return reduce(add, (part.at.diagonal_slopes(part.own(prepared)) for part in self.parts))

    def mixed_slopes(self, prepared: Any) -> np.ndarray:
        return reduce(add, (part.at.mixed_slopes(part.own(prepared)) for part in self.parts))

    def linearised(self, prepared: Any) -> tuple[np.ndarray, Pull]:
        values, pulls = self._linearised(prepared)

        def pull(U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
            # Each part may overwrite what it gets; the last one may have the original.
            own = (U_bar.copy() for _ in pulls[1:])
            return Sums(part(bar, diagonal_bar) for part, bar in zip(pulls, (*own, U_bar), strict=True))

        return reduce(add, values), pull

    def finish_pullback(self, total: Sums, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._finish(total, [K_bar] * len(self.parts))


class ProductAt(_CombinationAt):
    """A `Product` with hyperparameters and inducing points put in."""

    def matrix(self) -> np.ndarray:
        return reduce(mul, (part.at.matrix() for part in self.parts))

    def cross(self, prepared: Any) -> np.ndarray:
        return reduce(mul, (part.at.cross(part.own(prepared)) for part in self.parts))

    def diagonal(self, prepared: Any) -> PerRow:
        return reduce(mul, (part.at.diagonal(part.own(prepared)) for part in self.parts))

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

    def linearised(self, prepared: Any) -> tuple[np.ndarray, Pull]:
        values, pulls = self._linearised(prepared)

        def pull(U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
            diagonals = [part.at.diagonal(part.own(prepared)) for part in self.parts]
            return Sums(
                part(bar, own)
                for part, bar, own in zip(
                    pulls, _times_others(U_bar, values), _times_others(diagonal_bar, diagonals), strict=True
                )
            )

        return reduce(mul, values), pull

    def finish_pullback(self, total: Sums, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._finish(total, _times_others(K_bar, [part.at.matrix() for part in self.parts]))


def _times_others(bar: Any, values: Sequence[Any]) -> list[Any]:
    """The product rule: for each factor, the gradient times all other factors (none is divided out: it may be 0)."""
    return [reduce(mul, (*values[:i], *values[i + 1 :]), bar) for i in range(len(values))]
