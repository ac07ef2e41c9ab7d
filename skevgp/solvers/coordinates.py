"""Coordinates in which an optimiser moves: in units of each coordinate, or along the curvature of the loss."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import solve_triangular

# Lower and upper limits, each of the shape of x.
Limits = tuple[np.ndarray, np.ndarray]
# The gradient in x -> the gradient in other coordinates.
Pullback = Callable[[np.ndarray], np.ndarray]
# A step and the difference of the gradients at its ends.
Pair = tuple[np.ndarray, np.ndarray]
# A pair counts if the cosine of the angle between its step and its difference is larger.
_FLAT = 1e-8
# Relative change of a coordinate of which pairs still say something.
_SAME = 1e-6


class Coordinates(Protocol):
    """Coordinates z of a point x."""

    @property
    def bounds(self) -> np.ndarray | None:
        """Limits (size, 2) of z. None: there are none, because each z is a point within limits."""

    def of(self, x: np.ndarray) -> np.ndarray:
        """The coordinates of the point at which they start."""

    def at(self, z: np.ndarray) -> tuple[np.ndarray, Pullback]:
        """The point, and the pullback of gradients there."""

    def promised(self, x: np.ndarray, gradient: np.ndarray) -> float:
        """The decrease of the loss that a Newton step from x promises. Infinite if the curvature is not known."""


@dataclass(frozen=True)
class Scaled:
    """Coordinates z of x = ``unit`` z."""

    unit: np.ndarray
    limits: Limits

    @property
    def bounds(self) -> np.ndarray:
        return np.column_stack([limit / self.unit for limit in self.limits])

    def of(self, x: np.ndarray) -> np.ndarray:
        return x / self.unit

    def at(self, z: np.ndarray) -> tuple[np.ndarray, Pullback]:
        return z * self.unit, lambda gradient: gradient * self.unit

    def promised(self, x: np.ndarray, gradient: np.ndarray) -> float:
        return np.inf


@dataclass(frozen=True)
class Metric:
    """What steps s and differences y of gradients say of the curvature of a loss near a point."""

    pairs: tuple[Pair, ...]
    # The point. Where a coordinate has another value, nothing is known.
    x: np.ndarray

    def coordinates(self, unit: np.ndarray, limits: Limits, x: np.ndarray, gradient: np.ndarray) -> Curved:
        """Coordinates with the origin x. Before the first pair, the inverse Hessian is diag(unit²)."""
        free = _free(x, gradient, limits)
        known = free & (np.abs(x - self.x) <= _SAME * np.maximum(np.abs(x), 1.0))
        S, W = _factors([(np.where(known, s, 0.0), np.where(known, y, 0.0)) for s, y in self.pairs], unit)
        # The first trial step of L-BFGS has length 1. It is Newton's, but moves no coordinate of x by more than 1.
        curved = Curved(x, free, limits, unit, S, W, 1.0)
        step = curved.pulled_back(np.where(free, gradient, 0.0))
        length, farthest = float(np.linalg.norm(step)), float(np.abs(curved.moved(step)).max(initial=1.0))
        size = length / farthest
        return Curved(x, free, limits, unit, S, W, size if 0.0 < size < np.inf else 1.0)


@dataclass(frozen=True)
class Curved:
    """Coordinates z of x = origin + ``size`` L z, in which the Hessian is about a multiple of I.

    L Lᵀ is the inverse Hessian of BFGS in product form, L = (I + s_k w_kᵀ) … (I + s_1 w_1ᵀ) diag(``unit``) (Brodlie,
    Gourlay & Greenstadt 1973, "Rank-one and rank-two corrections to positive definite matrices expressed in product
    form"), which is (I + Sᵀ W) diag(unit) with the rows s_i of S and the combined rows of W. Coordinates of x that
    are not ``free`` do not move, and the others stop at their limits.
    """

    origin: np.ndarray
    free: np.ndarray
    limits: Limits
    unit: np.ndarray
    S: np.ndarray
    W: np.ndarray
    size: float
    bounds: None = None

    def of(self, x: np.ndarray) -> np.ndarray:
        return np.zeros(len(x))

    def at(self, z: np.ndarray) -> tuple[np.ndarray, Pullback]:
        x = np.where(self.free, self.origin + self.moved(z), self.origin)
        within = np.clip(x, *self.limits)
        moves = self.free & (within == x)
        return within, lambda gradient: self.pulled_back(np.where(moves, gradient, 0.0))

    def moved(self, z: np.ndarray) -> np.ndarray:
        """``size`` L z."""
        step = z * (self.size * self.unit)
        return step + (self.W @ step) @ self.S

    def pulled_back(self, gradient: np.ndarray) -> np.ndarray:
        """``size`` Lᵀ gradient."""
        return (gradient + (self.S @ gradient) @ self.W) * (self.size * self.unit)

    def promised(self, x: np.ndarray, gradient: np.ndarray) -> float:
        """½ gᵀ L Lᵀ g. Infinite if a coordinate that does not move here could."""
        free = _free(x, gradient, self.limits)
        if (free & ~self.free & (gradient != 0.0)).any():
            return np.inf
        return 0.5 * float(np.sum(np.square(self.pulled_back(np.where(free, gradient, 0.0)) / self.size)))


def _factors(pairs: list[Pair], unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """S and W (k, size) with L = (I + Sᵀ W) diag(unit)."""
    S, Y, U, W, sy, sBs = (np.empty((len(pairs), *rest)) for rest in [unit.shape] * 4 + [()] * 2)
    k = 0
    for s, y in pairs:
        inner = float(s @ y)
        if not inner > _FLAT * np.linalg.norm(s) * np.linalg.norm(y):
            continue
        # u = B s with the BFGS update of B = (L Lᵀ)⁻¹ (Nocedal & Wright 2006, eq. 6.19).
        u = s / unit**2 + (Y[:k] @ s / sy[:k]) @ Y[:k] - (U[:k] @ s / sBs[:k]) @ U[:k]
        curvature = float(s @ u)
        if not curvature > _FLAT * np.linalg.norm(s) * np.linalg.norm(u):
            continue
        S[k], Y[k], U[k], W[k], sy[k], sBs[k] = s, y, u, u / np.sqrt(inner * curvature) - y / inner, inner, curvature
        k += 1
    S, W = S[:k], W[:k]
    # Each factor sees the steps that the earlier ones added.
    return S, solve_triangular(np.eye(k) - np.tril(W @ S.T, -1), W, lower=True, unit_diagonal=True) if k else W


def _free(x: np.ndarray, gradient: np.ndarray, limits: Limits) -> np.ndarray:
    """Whether each coordinate is within its limits, or is pulled back into them."""
    return ((x > limits[0]) | (gradient < 0.0)) & ((x < limits[1]) | (gradient > 0.0))
