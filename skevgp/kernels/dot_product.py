"""The dot product: the prior of a line or a plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .covariances import Covariance, CovarianceAt, PerRow, Pull, Sums, as_they_are, sum_of_rows


@dataclass(frozen=True)
class DotProduct(Covariance):
    """k̃(x, x') = σ₀² + xᵀx' (Rasmussen & Williams 2006, section 4.2.2). Hyperparameter log σ₀."""

    n_hyperparameters = 1
    preparations = (as_they_are,)

    @classmethod
    def of(cls, kernel: Any, n_columns: int) -> DotProduct:
        """The covariance of a DotProduct."""
        return cls()

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        return np.einsum("...d,...d->...", inputs, others) + np.exp(2.0 * hyperparameters[0])

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> DotProductAt:
        return DotProductAt(float(np.exp(2.0 * hyperparameters[0])), inducing_points)


class DotProductAt(CovarianceAt):
    """A `DotProduct` with σ₀² and inducing points put in."""

    def __init__(self, bias: float, inducing_points: np.ndarray):
        self.bias, self.inducing_points = bias, inducing_points

    def matrix(self) -> np.ndarray:
        return self.cross(self.inducing_points)

    def cross(self, prepared: np.ndarray) -> np.ndarray:
        U = self.inducing_points @ prepared.T
        U += self.bias
        return U

    def diagonal(self, prepared: np.ndarray) -> np.ndarray:
        return np.einsum("nd,nd->n", prepared, prepared) + self.bias

    def slopes(self, prepared: np.ndarray) -> np.ndarray:
        m, d = self.inducing_points.shape
        return np.broadcast_to(self.inducing_points[:, np.newaxis], (m, len(prepared), d))

    def diagonal_slopes(self, prepared: np.ndarray) -> np.ndarray:
        return 2.0 * prepared

    def mixed_slopes(self, prepared: np.ndarray) -> np.ndarray:
        n, d = prepared.shape
        return np.broadcast_to(np.eye(d), (n, d, d))

    def start_pullback(self) -> Sums:
        return Sums((0.0, np.zeros_like(self.inducing_points)))

    def linearised(self, prepared: np.ndarray) -> tuple[np.ndarray, Pull]:
        def pull(U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
            return Sums((U_bar.sum() + sum_of_rows(diagonal_bar, len(prepared)), U_bar @ prepared))

        return self.cross(prepared), pull

    def finish_pullback(self, total: Sums, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        bias_bar, points_bar = total
        hyper_bar = 2.0 * self.bias * (bias_bar + K_bar.sum())
        return np.array([hyper_bar]), points_bar + 2.0 * K_bar @ self.inducing_points
