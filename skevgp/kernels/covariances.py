"""Covariance functions with gradients: what they have in common, and their sums and products.

Gradients follow the sum and product rules; each part has its own, written by hand. All parts of a covariance see the
same prepared rows, [x, 1, x²], which depend on no parameter.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add, mul
from typing import Any

import numpy as np

# A derivative per row of k(x, x): an array (n,), or one number for all rows.
PerRow = np.ndarray | float
# Takes gradients in k(X_m, X) (which it may overwrite) and in each k(x, x); returns what a block adds to the sum.
Pull = Callable[[np.ndarray, PerRow], Any]


class Sums(tuple):
    """Sums over rows side by side (arrays, or `Sums` again): ``+`` adds them one by one."""

    __slots__ = ()

    def __add__(self, other: Any) -> Sums:
        return Sums(map(add, self, other))


def sum_of_rows(per_row: PerRow, n_rows: int) -> float:
    """Σ over rows."""
    return float(np.sum(per_row)) if np.ndim(per_row) else float(per_row) * n_rows


class CovarianceAt(ABC):
    """A covariance with its hyperparameters and inducing points put in; see `statistics.KernelAt`."""

    inducing_points: np.ndarray

    @abstractmethod
    def matrix(self) -> np.ndarray:
        """k(X_m, X_m) of shape (m, m), from exact differences."""

    @abstractmethod
    def cross(self, prepared: np.ndarray) -> np.ndarray:
        """k(X_m, X) of shape (m, n)."""

    def diagonal(self, prepared: np.ndarray) -> PerRow:
        """k(x, x) of each row, (n,), or one number for all."""
        return 1.0

    @abstractmethod
    def start_pullback(self) -> Any:
        """An empty sum."""

    @abstractmethod
    def linearised(self, prepared: np.ndarray) -> tuple[np.ndarray, Pull]:
        """k(X_m, X), and the function that pulls gradients back through it."""

    def cross_pullback(self, prepared: np.ndarray, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Any:
        """What one block adds to the sum, given gradients in k(X_m, X) and in each k(x, x)."""
        return self.linearised(prepared)[1](U_bar, diagonal_bar)

    @abstractmethod
    def finish_pullback(self, total: Any, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradients in the hyperparameters and the inducing points; ``K_bar``, that in `matrix`, is symmetric."""


class Covariance(ABC):
    """A covariance k̃ with positive hyperparameters, which the inference sees as their logarithms.

    Two are equal if they are the same function of hyperparameters and inputs, wherever the inputs are centred.
    """

    @property
    @abstractmethod
    def n_hyperparameters(self) -> int:
        """How many hyperparameters there are."""

    @property
    def stationary(self) -> bool:
        """Whether it depends on differences of inputs only."""
        return True

    def prepare(self, inputs: np.ndarray) -> np.ndarray:
        """[x, 1, x²] of each row as columns, (2 d + 1, n)."""
        return np.ascontiguousarray(np.hstack([inputs, np.ones((len(inputs), 1)), inputs**2]).T)

    def seen_from(self, centre: np.ndarray) -> Covariance:
        """The same covariance for inputs from which ``centre`` (d,) has been subtracted."""
        return self

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
    def stationary(self) -> bool:
        return all(part.stationary for part in self.parts)

    def seen_from(self, centre: np.ndarray) -> _Combination:
        return replace(self, parts=tuple(part.seen_from(centre) for part in self.parts))

    def _parts_at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> list[CovarianceAt]:
        ends = np.cumsum([part.n_hyperparameters for part in self.parts])[:-1]
        own = np.split(hyperparameters, ends)
        return [part.at(values, inducing_points) for part, values in zip(self.parts, own, strict=True)]


class Sum(_Combination):
    """Σ k̃ᵢ(x, x')."""

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> SumAt:
        return SumAt(self._parts_at(hyperparameters, inducing_points))


class Product(_Combination):
    """Π k̃ᵢ(x, x')."""

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> ProductAt:
        return ProductAt(self._parts_at(hyperparameters, inducing_points))


class _CombinationAt(CovarianceAt):
    def __init__(self, parts: list[CovarianceAt]):
        self.parts, self.inducing_points = parts, parts[0].inducing_points

    def start_pullback(self) -> Sums:
        return Sums(part.start_pullback() for part in self.parts)

    def _finish(self, total: Sums, K_bars: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        gradients = [part.finish_pullback(*own) for part, *own in zip(self.parts, total, K_bars, strict=True)]
        return np.concatenate([hyper_bar for hyper_bar, _ in gradients]), reduce(add, (Z_bar for _, Z_bar in gradients))


class SumAt(_CombinationAt):
    """A `Sum` with hyperparameters and inducing points put in."""

    def matrix(self) -> np.ndarray:
        return reduce(add, (part.matrix() for part in self.parts))

    def cross(self, prepared: np.ndarray) -> np.ndarray:
        return reduce(add, (part.cross(prepared) for part in self.parts))

    def diagonal(self, prepared: np.ndarray) -> PerRow:
        return reduce(add, (part.diagonal(prepared) for part in self.parts))

    def linearised(self, prepared: np.ndarray) -> tuple[np.ndarray, Pull]:
        values, pulls = zip(*(part.linearised(prepared) for part in self.parts), strict=True)

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
        return reduce(mul, (part.matrix() for part in self.parts))

    def cross(self, prepared: np.ndarray) -> np.ndarray:
        return reduce(mul, (part.cross(prepared) for part in self.parts))

    def diagonal(self, prepared: np.ndarray) -> PerRow:
        return reduce(mul, (part.diagonal(prepared) for part in self.parts))

    def linearised(self, prepared: np.ndarray) -> tuple[np.ndarray, Pull]:
        values, pulls = zip(*(part.linearised(prepared) for part in self.parts), strict=True)

        def pull(U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
            diagonals = [part.diagonal(prepared) for part in self.parts]
            return Sums(
                part(bar, own)
                for part, bar, own in zip(
                    pulls, _times_others(U_bar, values), _times_others(diagonal_bar, diagonals), strict=True
                )
            )

        return reduce(mul, values), pull

    def finish_pullback(self, total: Sums, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._finish(total, _times_others(K_bar, [part.matrix() for part in self.parts]))


def _times_others(bar: Any, values: Sequence[Any]) -> list[Any]:
    """The product rule: for each factor, the gradient times all other factors (none is divided out: it may be 0)."""
    return [reduce(mul, (*values[:i], *values[i + 1 :]), bar) for i in range(len(values))]
