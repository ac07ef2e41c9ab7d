"""Stationary covariances: functions of the scaled distance between inputs.

With r² = Σ_d ((x_d - x'_d) / ℓ_d)², each is a profile φ of the exponent E = -½ r², which for a block of rows is one
matrix product: E is linear in [x, 1, x²]. So is the way back: with W = Ū φ'(E), all gradients follow from W [x, 1, x²].
There x is centred: r² is a small difference of squares that would be large far from 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from .covariances import CentredSquares, Covariance, CovarianceAt, PerRow, Pull, Sums
from .profiles import (
    LARGEST_NU,
    Derivatives,
    Exponential,
    ExpSineSquared,
    Matern,
    Matern12,
    Matern32,
    Matern52,
    Profile,
    RationalQuadratic,
)

# In units of the largest |x/ℓ|² + |z/ℓ|²: the matrix product leaves r² only 8 digits below this, ...
_NEAR = 1e-8
# ... and (x - x') / r only 8 below this: there a profile that is not smooth at r = 0 counts as flat.
_COINCIDENT = 1e-16
_MATERN: dict[float, Profile] = {0.5: Matern12(), 1.5: Matern32(), 2.5: Matern52()}


@dataclass(frozen=True)
class Stationary(Covariance):
    """k̃(x, x') = φ(-½ Σ_d ((x_d - x'_d) / ℓ_d)²); hyperparameters: those of φ, then log ℓ.

    Parameters
    ----------
    profile : Profile
        φ.
    n_columns : int
        d.
    isotropic : bool, default=False
        Whether one lengthscale serves all columns.
    rows : CentredSquares
        What is computed once of rows.
    """

    profile: Profile
    n_columns: int
    isotropic: bool = False
    rows: CentredSquares = field(default=CentredSquares(), compare=False)

    @property
    def n_hyperparameters(self) -> int:
        return self.profile.n_parameters + (1 if self.isotropic else self.n_columns)

    @property
    def preparations(self) -> tuple[CentredSquares]:
        return (self.rows,)

    def centred(self, centre: np.ndarray) -> Stationary:
        return replace(self, rows=CentredSquares(tuple(centre.tolist())))

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        own, lengths = np.split(hyperparameters, [self.profile.n_parameters])
        scaled = (inputs - others) * np.exp(-lengths)
        return self.profile.value(-0.5 * np.einsum("...d,...d->...", scaled, scaled), own)

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> StationaryAt:
        return StationaryAt(self.profile, hyperparameters, self.rows.centred(inducing_points))


class StationaryAt(CovarianceAt):
    """A `Stationary` with hyperparameters and centred inducing points (m, d) put in."""

    def __init__(self, profile: Profile, hyperparameters: np.ndarray, points: np.ndarray):
        lengthscales = np.exp(hyperparameters[profile.n_parameters :])
        self.profile, self.parameters = profile, hyperparameters[: profile.n_parameters]
        self.isotropic = len(lengthscales) < points.shape[1]
        d, self.points = points.shape[1], points
        self.lengthscales = np.full(d, lengthscales)
        precision = self.lengthscales**-2.0
        self._exponent = np.empty((len(points), 2 * d + 1))
        self._exponent[:, :d] = points * precision
        self._exponent[:, d] = -0.5 * (points**2 @ precision)
        self._exponent[:, d + 1 :] = -0.5 * precision

    def matrix(self) -> np.ndarray:
        return self.profile.value(self._exponents_within(), self.parameters)

    def cross(self, prepared: np.ndarray) -> np.ndarray:
        return self.profile.value(self._exponents(prepared)[0], self.parameters)

    def slopes(self, prepared: np.ndarray) -> np.ndarray:
        rows = prepared[: self.points.shape[1]].T
        slopes, _ = self._derivatives(*self._exponents(prepared), self.cross(prepared))
        precision = self.lengthscales**-2.0
        return slopes[:, :, np.newaxis] * ((self.points * precision)[:, np.newaxis] - rows * precision)

    def mixed_slopes(self, prepared: np.ndarray) -> np.ndarray:
        if not self.profile.smooth:
            raise ValueError("A function of a Matern kernel with nu up to 1 has no gradient.")
        slope = self.profile.derivatives(np.zeros(1), np.ones(1), self.parameters)[0]
        d = self.points.shape[1]
        return np.broadcast_to(np.diag(slope * self.lengthscales**-2.0), (prepared.shape[1], d, d))

    def start_pullback(self) -> Any:
        return Sums((np.zeros_like(self._exponent), np.zeros(self.profile.n_parameters)))

    def linearised(self, prepared: np.ndarray) -> tuple[np.ndarray, Pull]:
        U = self.cross(prepared)
        return U, lambda U_bar, diagonal_bar: self.cross_pullback(prepared, U, U_bar, diagonal_bar)

    def cross_pullback(self, prepared: np.ndarray, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Any:
        slopes, others = self._derivatives(*self._exponents(prepared), U)
        own = np.array([np.vdot(U_bar, other) for other in others])
        np.multiply(U_bar, slopes, out=U_bar)
        return Sums((U_bar @ prepared.T, own))

    def finish_pullback(self, total: Any, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows, own = total
        size = -2.0 * float(self._exponent[:, self.points.shape[1]].min())
        slopes, others = self._derivatives(self._exponents_within(), size, self.matrix())
        own = own + np.array([np.vdot(K_bar, other) for other in others])
        length_bar, Z_bar = self._geometry_bar(rows, K_bar * slopes)
        return np.concatenate([own, length_bar]), Z_bar

    def _geometry_bar(self, rows: np.ndarray, within: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradients in log ℓ and X_m, from Σ_rows W [x, 1, x²] (m, 2 d + 1) and the W of `matrix` (m, m)."""
        Z, d = self.points, self.points.shape[1]
        WX, W, WXX = rows[:, :d], rows[:, d, np.newaxis], rows[:, d + 1 :]
        # Within the inducing points each pair counts twice: as (i, j) and as (j, i).
        Z_bar = WX - W * Z + 2.0 * (within @ Z - within.sum(axis=1, keepdims=True) * Z)
        length_bar = (WXX - Z * (WX + Z_bar)).sum(axis=0)
        precision = self.lengthscales**-2.0
        length_bar = length_bar * precision
        return length_bar.sum(keepdims=True) if self.isotropic else length_bar, Z_bar * precision

    def _exponents_within(self) -> np.ndarray:
        scaled = self.points / self.lengthscales
        return -0.5 * cdist(scaled, scaled, "sqeuclidean")

    def _exponents(self, prepared: np.ndarray) -> tuple[np.ndarray, float]:
        """E (m, n), and ½ (|x/ℓ|² + |z/ℓ|²) at its largest, which its rounding errors are relative to."""
        E = self._exponent @ prepared
        np.minimum(E, 0.0, out=E)
        if self.profile.smooth:
            return E, 0.0
        d = len(prepared) // 2
        size = -float((self._exponent[0, d + 1 :] @ prepared[d + 1 :]).min() + self._exponent[:, d].min())
        i, j = np.nonzero(-_NEAR * size < E)
        differences = (prepared[:d, j].T - self.points[i]) / self.lengthscales
        E[i, j] = -0.5 * np.einsum("pd,pd->p", differences, differences)
        return E, size

    def _derivatives(self, E: np.ndarray, size: float, value: np.ndarray) -> Derivatives:
        slopes, others = self.profile.derivatives(E, value, self.parameters)
        if not self.profile.smooth:
            slopes[-_COINCIDENT * size <= E] = 0.0
        return slopes, others


@dataclass(frozen=True)
class SquaredExponential(Stationary):
    """k̃(x, x') = exp(-½ Σ_d ((x_d - x'_d) / ℓ_d)²), hyperparameters log ℓ (Rasmussen & Williams 2006, eq. 4.9, 5.1).

    Parameters
    ----------
    n_columns : int
        d.
    isotropic : bool, default=False
        Whether one lengthscale serves all columns.
    rows : CentredSquares
        What is computed once of rows.
    """

    profile: Profile = field(default=Exponential(), init=False)

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> SquaredExponentialAt:
        return SquaredExponentialAt(self.profile, hyperparameters, self.rows.centred(inducing_points))


class SquaredExponentialAt(StationaryAt):
    """A `SquaredExponential` put in: its own derivative, so that k(X_m, X) serves the way back."""

    def cross(self, prepared: np.ndarray) -> np.ndarray:
        U, _ = self._exponents(prepared)
        return np.exp(U, out=U)

    def start_pullback(self) -> np.ndarray:
        return np.zeros_like(self._exponent)

    def cross_pullback(
        self, prepared: np.ndarray, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow
    ) -> np.ndarray:
        np.multiply(U_bar, U, out=U_bar)
        return U_bar @ prepared.T

    def finish_pullback(self, total: np.ndarray, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._geometry_bar(total, K_bar * self.matrix())


# --- from scikit-learn's kernels ---------------------------------------------------------------------------------


def squared_exponential(kernel: Any, n_columns: int) -> SquaredExponential:
    """The covariance of an RBF (or of a Matern with nu = inf)."""
    return SquaredExponential(n_columns, one_lengthscale(kernel, n_columns))


def matern(kernel: Any, n_columns: int) -> Stationary:
    """The covariance of a Matern."""
    if kernel.nu == np.inf:
        return squared_exponential(kernel, n_columns)
    if not 0.0 < kernel.nu <= LARGEST_NU:
        raise ValueError(f"kernel={kernel!r}: nu must be above 0 and at most {LARGEST_NU:g}, or inf; got {kernel.nu}.")
    profile = _MATERN.get(kernel.nu, Matern(float(kernel.nu)))
    return Stationary(profile, n_columns, one_lengthscale(kernel, n_columns))


def rational_quadratic(kernel: Any, n_columns: int) -> Stationary:
    """The covariance of a RationalQuadratic."""
    return Stationary(RationalQuadratic(), n_columns, isotropic=True)


def exp_sine_squared(kernel: Any, n_columns: int) -> Stationary:
    """The covariance of an ExpSineSquared, whose periodicity is the lengthscale."""
    return Stationary(ExpSineSquared(), n_columns, isotropic=True)


def one_lengthscale(kernel: Any, n_columns: int) -> bool:
    """Whether a kernel has one lengthscale for all columns; an error if it has neither one nor one per column."""
    if kernel.anisotropic and len(kernel.length_scale) != n_columns:
        raise ValueError(
            f"kernel={kernel!r} has {len(kernel.length_scale)} length scales, but its inputs have {n_columns} columns: "
            "give one length scale, or one per column."
        )
    return not kernel.anisotropic
