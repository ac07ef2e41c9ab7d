"""A constant: the prior of an unknown offset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from sklearn.gaussian_process import kernels as sk

from ..utils.casadi import casadi
from .base import Covariance, CovarianceAt, PerRow, no_columns, reads, sum_of_rows
from .waves import Planes


@dataclass(frozen=True)
class Constant(Covariance):
    """k̃(x, x') = c: the prior of an unknown offset. Hyperparameter c."""

    n_hyperparameters = 1
    rows = staticmethod(no_columns)

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        return np.full(np.broadcast_shapes(inputs.shape, others.shape)[:-1], hyperparameters[0])

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> ConstantAt:
        return ConstantAt(float(hyperparameters[0]), inducing_points.shape)

    def random_terms(
        self, hyperparameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> list[tuple[Planes]]:
        return [(Planes(np.zeros(shape), np.full(shape[0], np.sqrt(hyperparameters[0]))),)]

    def expression(self, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, float]:
        value = float(hyperparameters[0])
        return casadi().DM.ones(len(points)) * value, value


class ConstantAt(CovarianceAt):
    """A `Constant` at a given value."""

    def __init__(self, constant: float, shape: tuple[int, ...]):
        self.constant, self.shape = constant, shape

    def matrix(self) -> np.ndarray:
        return np.full((self.shape[0],) * 2, self.constant)

    def cross(self, prepared: np.ndarray) -> np.ndarray:
        # A view of one number in the shape of a matrix.
        return np.broadcast_to(self.constant, (self.shape[0], len(prepared)))

    def diagonal(self, prepared: np.ndarray) -> float:
        return self.constant

    def slopes(self, prepared: np.ndarray) -> np.ndarray:
        return np.zeros((self.shape[0], len(prepared), self.shape[1]))

    def mixed_slopes(self, prepared: np.ndarray) -> np.ndarray:
        return np.zeros((len(prepared), self.shape[1], self.shape[1]))

    def start_pullback(self) -> np.ndarray:
        return np.zeros(1)

    def cross_pullback(
        self, prepared: np.ndarray, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow
    ) -> np.ndarray:
        return np.array([self.constant * (U_bar.sum() + sum_of_rows(diagonal_bar, len(prepared)))])

    def finish_pullback(self, total: np.ndarray, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return total + self.constant * K_bar.sum(), np.zeros(self.shape)


@reads(sk.ConstantKernel)
def constant(kernel: Any, n_columns: int) -> Constant:
    """Return the covariance of a ConstantKernel."""
    return Constant()
