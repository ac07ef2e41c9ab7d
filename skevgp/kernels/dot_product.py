"""The dot product: the prior of a line or a plane."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from .covariances import Covariance, CovarianceAt, PerRow, Pull, Sums, sum_of_rows


@dataclass(frozen=True)
class DotProduct(Covariance):
    """k̃(x, x') = σ₀² + xᵀx' (Rasmussen & Williams 2006, section 4.2.2). Hyperparameter log σ₀.

    Parameters
    ----------
    centre : ndarray of shape (d,), default=None
        What has been subtracted from the inputs.
    """

    centre: np.ndarray | None = field(default=None, compare=False)
    n_hyperparameters = 1
    stationary = False

    @classmethod
    def of(cls, kernel: Any, n_columns: int) -> DotProduct:
        """The covariance of a DotProduct."""
        return cls()

    def seen_from(self, centre: np.ndarray) -> DotProduct:
        return replace(self, centre=centre)

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> DotProductAt:
        centre = np.zeros(inducing_points.shape[1]) if self.centre is None else self.centre
        return DotProductAt(float(np.exp(2.0 * hyperparameters[0])), inducing_points, centre)


class DotProductAt(CovarianceAt):
    """A `DotProduct` with σ₀² and inducing points put in."""

    def __init__(self, bias: float, inducing_points: np.ndarray, centre: np.ndarray):
        self.bias, self.inducing_points, self.centre = bias, inducing_points, centre
        self._points = inducing_points + centre
        self._linear = np.hstack([self._points, (self._points @ centre + bias)[:, np.newaxis]])

    def matrix(self) -> np.ndarray:
        return self._points @ self._points.T + self.bias

    def cross(self, prepared: np.ndarray) -> np.ndarray:
        return self._linear @ prepared[: len(self.centre) + 1]

    def diagonal(self, prepared: np.ndarray) -> np.ndarray:
        x = prepared[: len(self.centre)] + self.centre[:, np.newaxis]
        return np.einsum("dn,dn->n", x, x) + self.bias

    def start_pullback(self) -> Sums:
        return Sums((np.zeros_like(self._linear), 0.0))

    def linearised(self, prepared: np.ndarray) -> tuple[np.ndarray, Pull]:
        def pull(U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
            return Sums((U_bar @ prepared[: len(self.centre) + 1].T, sum_of_rows(diagonal_bar, prepared.shape[1])))

        return self.cross(prepared), pull

    def finish_pullback(self, total: Sums, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows, from_diagonal = total
        n_bar = rows[:, -1]
        bias_bar = n_bar.sum() + from_diagonal + K_bar.sum()
        points_bar = rows[:, :-1] + np.outer(n_bar, self.centre) + 2.0 * K_bar @ self._points
        return np.array([2.0 * self.bias * bias_bar]), points_bar
