"""The dot product: the prior of a line or a plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from sklearn.gaussian_process import kernels as sk

from ..utils.casadi import casadi
from .base import Covariance, CovarianceAt, PerRow, Sums, as_they_are, reads, sum_of_rows
from .waves import Planes


@dataclass(frozen=True)
class DotProduct(Covariance):
    """k̃(x, x') = σ₀² + xᵀx' (Rasmussen & Williams 2006, section 4.2.2). Hyperparameter σ₀."""

    n_hyperparameters = 1
    rows = staticmethod(as_they_are)

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        return np.einsum("...d,...d->...", inputs, others) + hyperparameters[0] ** 2

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> DotProductAt:
        return DotProductAt(float(hyperparameters[0] ** 2), inducing_points)

    def random_terms(
        self, hyperparameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> list[tuple[Planes]]:
        return [(Planes(rng.standard_normal(shape), hyperparameters[0] * rng.standard_normal(shape[0])),)]

    def expression(self, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, Any]:
        ca, bias = casadi(), float(hyperparameters[0] ** 2)
        return ca.mtimes(ca.DM(points), x) + bias, ca.sumsqr(x) + bias


class DotProductAt(CovarianceAt):
    """A `DotProduct` at given σ₀² and inducing points."""

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

    def cross_pullback(self, prepared: np.ndarray, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
        return Sums((U_bar.sum() + sum_of_rows(diagonal_bar, len(prepared)), U_bar @ prepared))

    def finish_pullback(self, total: Sums, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        bias_bar, points_bar = total
        hyper_bar = 2.0 * self.bias * (bias_bar + K_bar.sum())
        return np.array([hyper_bar]), points_bar + 2.0 * K_bar @ self.inducing_points


@reads(sk.DotProduct)
def dot_product(kernel: Any, n_columns: int) -> DotProduct:
    """Return the covariance of a DotProduct."""
    return DotProduct()
