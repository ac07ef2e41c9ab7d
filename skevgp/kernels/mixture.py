"""The mean of a covariance over draws of its hyperparameters, and its values at a set of points for each draw."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from ..utils.casadi import casadi
from .base import Covariance, CovarianceAt, PerRow, Preparation

_NO_GRADIENT = "The hyperparameters of a mixture are drawn, not learned."


@dataclass(frozen=True)
class Mixture(Covariance):
    """Σ_s c_s k̃(x, x'; h_s): the covariance of f = Σ_s f_s with independent f_s. Hyperparameters (c, h_1, ..., h_S)."""

    kernel: Covariance
    n_draws: int

    @property
    def n_hyperparameters(self) -> int:
        return self.n_draws * (1 + self.kernel.n_hyperparameters)

    @property
    def rows(self) -> Preparation:
        return self.kernel.rows

    def draws(self, hyperparameters: np.ndarray) -> Iterator[tuple[float, np.ndarray]]:
        """Yield c_s and h_s of each draw."""
        factors, rest = hyperparameters[: self.n_draws], hyperparameters[self.n_draws :]
        return zip(factors.tolist(), rest.reshape(self.n_draws, -1), strict=True)

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        return reduce(add, (c * self.kernel.paired(own, inputs, others) for c, own in self.draws(hyperparameters)))

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> MixtureAt:
        draws = list(self.draws(hyperparameters))
        return MixtureAt([self.kernel.at(own, inducing_points) for _, own in draws], [c for c, _ in draws])

    def expression(self, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, Any]:
        """Return k(X_m, x) at the points of `StackedAt`, those of one draw after the other, and k(x, x)."""
        sets = np.split(points, self.n_draws)
        parts = [
            (c, self.kernel.expression(own, of_draw, x))
            for (c, own), of_draw in zip(self.draws(hyperparameters), sets, strict=True)
        ]
        diagonal = reduce(add, (c * at_row for c, (_, at_row) in parts))
        return casadi().vertcat(*(c * cross for c, (cross, _) in parts)), diagonal


class MixtureAt(CovarianceAt):
    """A `Mixture` at given hyperparameters and m points."""

    def __init__(self, parts: Sequence[CovarianceAt], factors: Sequence[float]):
        self.parts, self.factors = tuple(parts), tuple(factors)

    def matrix(self) -> np.ndarray:
        return self._sum(part.matrix() for part in self.parts)

    def cross(self, prepared: Any) -> np.ndarray:
        return self._sum(part.cross(prepared) for part in self.parts)

    def diagonal(self, prepared: Any) -> PerRow:
        return self._sum(part.diagonal(prepared) for part in self.parts)

    def slopes(self, prepared: Any) -> np.ndarray:
        return self._sum(part.slopes(prepared) for part in self.parts)

    def diagonal_slopes(self, prepared: Any) -> np.ndarray | float:
        return self._sum(part.diagonal_slopes(prepared) for part in self.parts)

    def mixed_slopes(self, prepared: Any) -> np.ndarray:
        return self._sum(part.mixed_slopes(prepared) for part in self.parts)

    def start_pullback(self) -> Any:
        raise NotImplementedError(_NO_GRADIENT)

    def cross_pullback(self, prepared: Any, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Any:
        raise NotImplementedError(_NO_GRADIENT)

    def finish_pullback(self, total: Any, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        raise NotImplementedError(_NO_GRADIENT)

    def _sum(self, values: Iterator[Any]) -> Any:
        return reduce(add, self._scaled(values))

    def _scaled(self, values: Iterator[Any]) -> list[Any]:
        return [factor * value for factor, value in zip(self.factors, values, strict=True)]


class StackedAt(MixtureAt):
    """A `Mixture` at a set of m points for each draw: the points of draw s are about f_s alone."""

    def matrix(self) -> np.ndarray:
        return block_diag(*self._scaled(part.matrix() for part in self.parts))

    def cross(self, prepared: Any) -> np.ndarray:
        return np.concatenate(self._scaled(part.cross(prepared) for part in self.parts))

    def slopes(self, prepared: Any) -> np.ndarray:
        return np.concatenate(self._scaled(part.slopes(prepared) for part in self.parts))
