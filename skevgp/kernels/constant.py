"""A constant: the prior of an unknown offset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .covariances import Covariance, CovarianceAt, PerRow, Pull, no_columns, sum_of_rows


@dataclass(frozen=True)
class Constant(Covariance):
    """k̃(x, x') = c: the prior of an unknown offset. Hyperparameter log c."""

    n_hyperparameters = 1
    preparations = (no_columns,)

    @classmethod
    def of(cls, kernel: Any, n_columns: int) -> Constant:
        """The covariance of a ConstantKernel."""
        return cls()

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        return np.full(np.broadcast_shapes(inputs.shape, others.shape)[:-1], np.exp(hyperparameters[0]))

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> ConstantAt:
        return ConstantAt(float(np.exp(hyperparameters[0])), inducing_points.shape)


class ConstantAt(CovarianceAt):
    """A `Constant` with its value put in."""

    def __init__(self, constant: float, shape: tuple[int, ...]):
        self.constant, self.shape = constant, shape

    def matrix(self) -> np.ndarray:
        return np.full((self.shape[0],) * 2, self.constant)

    def cross(self, prepared: np.ndarray) -> np.ndarray:
        # One number that looks like a matrix.
        return np.broadcast_to(self.constant, (self.shape[0], len(prepared)))

    def diagonal(self, prepared: np.ndarray) -> float:
        return self.constant

    def slopes(self, prepared: np.ndarray) -> np.ndarray:
        return np.zeros((self.shape[0], len(prepared), self.shape[1]))

    def mixed_slopes(self, prepared: np.ndarray) -> np.ndarray:
        return np.zeros((len(prepared), self.shape[1], self.shape[1]))

    def start_pullback(self) -> np.ndarray:
        return np.zeros(1)

    def linearised(self, prepared: np.ndarray) -> tuple[np.ndarray, Pull]:
        def pull(U_bar: np.ndarray, diagonal_bar: PerRow) -> np.ndarray:
            return np.array([self.constant * (U_bar.sum() + sum_of_rows(diagonal_bar, len(prepared)))])

        return self.cross(prepared), pull

    def finish_pullback(self, total: np.ndarray, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return total + self.constant * K_bar.sum(), np.zeros(self.shape)
