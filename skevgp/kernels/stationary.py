"""Stationary covariances: functions of the scaled distance between inputs.

With r² = Σ_d ((x_d - x'_d) / ℓ_d)², each is a profile φ of the exponent E = -½ r², which for a block of rows is one
matrix product: E is linear in [x, 1, x²]. So is the way back: with W = Ū φ'(E), all gradients follow from W [x, 1, x²].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import gammaln, kve

from .covariances import Covariance, CovarianceAt, PerRow, Pull, Sums

# In units of the largest |x/ℓ|² + |z/ℓ|²: the matrix product leaves r² only 8 digits below this, ...
_NEAR = 1e-8
# ... and (x - x') / r only 8 below this: there a profile that is not smooth at r = 0 counts as flat.
_COINCIDENT = 1e-16
# Of a Matérn covariance by Bessel functions, which overflow beyond it (it is then almost a squared exponential).
LARGEST_NU = 150.0

Derivatives = tuple[np.ndarray, list[np.ndarray]]


class Profile(Protocol):
    """φ(E); parameters of its own come before the lengthscales in the vector of hyperparameters, as logarithms."""

    n_parameters: int

    @property
    def smooth(self) -> bool:
        """Whether φ'(E) is finite at E = 0."""

    def value(self, E: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """φ(E)."""

    def derivatives(self, E: np.ndarray, value: np.ndarray, parameters: np.ndarray) -> Derivatives:
        """φ'(E), and the derivative in the logarithm of each parameter; ``value`` is φ(E), which saves exponentials."""


@dataclass(frozen=True)
class Exponential:
    """φ = exp(E): the squared exponential (Rasmussen & Williams 2006, eq. 4.9)."""

    n_parameters = 0
    smooth = True

    def value(self, E: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        return np.exp(E)

    def derivatives(self, E: np.ndarray, value: np.ndarray, parameters: np.ndarray) -> Derivatives:
        return value, []


@dataclass(frozen=True)
class Matern12:
    """φ = exp(-r) (Rasmussen & Williams 2006, eq. 4.18)."""

    n_parameters = 0
    smooth = False

    def value(self, E: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        return np.exp(-np.sqrt(-2.0 * E))

    def derivatives(self, E: np.ndarray, value: np.ndarray, parameters: np.ndarray) -> Derivatives:
        return value / np.maximum(np.sqrt(-2.0 * E), 1e-150), []


@dataclass(frozen=True)
class Matern32:
    """φ = (1 + t) exp(-t), t = √3 r; φ' = 3 exp(-t) (Rasmussen & Williams 2006, eq. 4.17)."""

    n_parameters = 0
    smooth = True

    def value(self, E: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        t = np.sqrt(-6.0 * E)
        decay = np.exp(-t)
        t += 1.0
        t *= decay
        return t

    def derivatives(self, E: np.ndarray, value: np.ndarray, parameters: np.ndarray) -> Derivatives:
        t = np.sqrt(-6.0 * E)
        t += 1.0
        np.divide(value, t, out=t)
        t *= 3.0
        return t, []


@dataclass(frozen=True)
class Matern52:
    """φ = (1 + t + t²/3) exp(-t), t = √5 r; φ' = 5/3 (1 + t) exp(-t) (Rasmussen & Williams 2006, eq. 4.17)."""

    n_parameters = 0
    smooth = True

    def value(self, E: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        t = np.sqrt(-10.0 * E)
        decay = np.exp(-t)
        decay *= self._polynomial(E, t)
        return decay

    def derivatives(self, E: np.ndarray, value: np.ndarray, parameters: np.ndarray) -> Derivatives:
        t = np.sqrt(-10.0 * E)
        polynomial = self._polynomial(E, t)
        t += 1.0
        t *= 5.0 / 3.0
        t *= value
        t /= polynomial
        return t, []

    @staticmethod
    def _polynomial(E: np.ndarray, t: np.ndarray) -> np.ndarray:
        polynomial = (-10.0 / 3.0) * E
        polynomial += t
        polynomial += 1.0
        return polynomial


@dataclass(frozen=True)
class Matern:
    """φ = 2^(1-ν) / Γ(ν) t^ν K_ν(t), t = √(2ν) r (Rasmussen & Williams 2006, eq. 4.14).

    Its derivative follows from d/dt [t^ν K_ν(t)] = -t^ν K_(ν-1)(t) (DLMF 10.29.4).

    Parameters
    ----------
    nu : float
        At most `LARGEST_NU`.
    """

    nu: float
    n_parameters = 0

    @property
    def smooth(self) -> bool:
        return self.nu > 1.0

    def value(self, E: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        return self._bessel(E, self.nu, 1.0)

    def derivatives(self, E: np.ndarray, value: np.ndarray, parameters: np.ndarray) -> Derivatives:
        slope = self._bessel(E, self.nu - 1.0, 0.5 / (self.nu - 1.0) if self.smooth else 0.0)
        slope *= 2.0 * self.nu
        return slope, []

    def _bessel(self, E: np.ndarray, order: float, at_zero: float) -> np.ndarray:
        """2^(1-ν) / Γ(ν) t^order K_order(t), by logarithms: its factors overflow before it does."""
        t = np.sqrt(-4.0 * self.nu * E)
        positive = np.maximum(t, 1e-150)
        # Beyond 1e3, exp(-t) is 0 and K need not be known.
        with np.errstate(all="ignore"):
            log_bessel = np.log(kve(order, np.minimum(positive, 1e3)))
        factor = (1.0 - self.nu) * np.log(2.0) - gammaln(self.nu)
        found = np.exp(factor + order * np.log(positive) + log_bessel - positive)
        overflow = np.isinf(log_bessel) | (t == 0.0)
        found[overflow] = at_zero * self._near_zero(t[overflow], order)
        return found

    @staticmethod
    def _near_zero(t: np.ndarray, order: float) -> np.ndarray:
        """t^order K_order(t) over its value at 0, where K overflows: the first terms of DLMF 10.27.4 with 10.25.2."""
        term = total = np.ones_like(t)
        for k in range(1, min(int(order), 20)):
            term = term * (0.25 * t**2) / (k * (k - order))
            total = total + term
        return total


@dataclass(frozen=True)
class RationalQuadratic:
    """φ = (1 + r² / 2α)^(-α) (Rasmussen & Williams 2006, eq. 4.19). Parameter log α."""

    n_parameters = 1
    smooth = True

    def value(self, E: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        alpha = np.exp(parameters[0])
        log = np.log1p(self._ratio(E, alpha))
        log *= -alpha
        return np.exp(log, out=log)

    def derivatives(self, E: np.ndarray, value: np.ndarray, parameters: np.ndarray) -> Derivatives:
        alpha = np.exp(parameters[0])
        ratio = self._ratio(E, alpha)
        from_alpha = ratio / (1.0 + ratio)
        from_alpha -= np.log1p(ratio)
        from_alpha *= value
        from_alpha *= alpha
        ratio += 1.0
        return np.divide(value, ratio, out=ratio), [from_alpha]

    @staticmethod
    def _ratio(E: np.ndarray, alpha: float) -> np.ndarray:
        """r² / 2α, kept finite."""
        with np.errstate(over="ignore"):
            ratio = E / -alpha
        return np.minimum(ratio, 1e300, out=ratio)


@dataclass(frozen=True)
class ExpSineSquared:
    """φ = exp(-2 sin²(π r) / ℓ²), r = |x - x'| / period (Rasmussen & Williams 2006, eq. 4.31). Parameter log ℓ."""

    n_parameters = 1
    smooth = True

    def value(self, E: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        return np.exp(-2.0 * self._squared(np.sqrt(-2.0 * E), parameters))

    def derivatives(self, E: np.ndarray, value: np.ndarray, parameters: np.ndarray) -> Derivatives:
        r = np.sqrt(-2.0 * E)
        # d sin²(π r) / dE = -π sin(2π r) / r, finite at r = 0.
        slope = np.sinc(2.0 * r)
        slope *= value
        slope *= (2.0 * np.pi * np.exp(-parameters[0])) ** 2
        return slope, [4.0 * self._squared(r, parameters) * value]

    @staticmethod
    def _squared(r: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """sin²(π r) / ℓ²."""
        return (np.sin(np.pi * r) * np.exp(-parameters[0])) ** 2


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
    """

    profile: Profile
    n_columns: int
    isotropic: bool = False

    @property
    def n_hyperparameters(self) -> int:
        return self.profile.n_parameters + (1 if self.isotropic else self.n_columns)

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> StationaryAt:
        return StationaryAt(self.profile, hyperparameters, inducing_points)


class StationaryAt(CovarianceAt):
    """A `Stationary` with hyperparameters and inducing points (m, d) put in."""

    def __init__(self, profile: Profile, hyperparameters: np.ndarray, inducing_points: np.ndarray):
        lengthscales = np.exp(hyperparameters[profile.n_parameters :])
        self.profile, self.parameters = profile, hyperparameters[: profile.n_parameters]
        self.lengthscales = np.broadcast_to(lengthscales, inducing_points.shape[1:])
        self.isotropic = len(lengthscales) < inducing_points.shape[1]
        self.inducing_points = inducing_points
        precision = self.lengthscales**-2.0
        self._exponent = np.hstack(
            [
                inducing_points * precision,
                -0.5 * (inducing_points**2 @ precision)[:, np.newaxis],
                np.broadcast_to(-0.5 * precision, inducing_points.shape),
            ]
        )

    def matrix(self) -> np.ndarray:
        return self.profile.value(self._exponents_within(), self.parameters)

    def cross(self, prepared: np.ndarray) -> np.ndarray:
        return self.profile.value(self._exponents(prepared)[0], self.parameters)

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
        size = -2.0 * float(self._exponent[:, self.inducing_points.shape[1]].min())
        slopes, others = self._derivatives(self._exponents_within(), size, self.matrix())
        own = own + np.array([np.vdot(K_bar, other) for other in others])
        length_bar, Z_bar = self._geometry_bar(rows, K_bar * slopes)
        return np.concatenate([own, length_bar]), Z_bar

    def _geometry_bar(self, rows: np.ndarray, within: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradients in log ℓ and X_m, from Σ_rows W [x, 1, x²] (m, 2 d + 1) and the W of `matrix` (m, m)."""
        Z, d = self.inducing_points, self.inducing_points.shape[1]
        WX, W, WXX = rows[:, :d], rows[:, d, np.newaxis], rows[:, d + 1 :]
        row_sum, within_Z = within.sum(axis=1, keepdims=True), within @ Z
        # Within the inducing points each pair counts twice: as (i, j) and as (j, i).
        Z_bar = WX - W * Z + 2.0 * (within_Z - row_sum * Z)
        length_bar = (WXX - 2.0 * Z * WX + W * Z**2 + 2.0 * Z * (row_sum * Z - within_Z)).sum(axis=0)
        precision = self.lengthscales**-2.0
        length_bar = length_bar * precision
        return length_bar.sum(keepdims=True) if self.isotropic else length_bar, Z_bar * precision

    def _exponents_within(self) -> np.ndarray:
        scaled = self.inducing_points / self.lengthscales
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
        differences = (prepared[:d, j].T - self.inducing_points[i]) / self.lengthscales
        E[i, j] = -0.5 * np.einsum("pd,pd->p", differences, differences)
        return E, size

    def _derivatives(self, E: np.ndarray, size: float, value: np.ndarray) -> Derivatives:
        slopes, others = self.profile.derivatives(E, value, self.parameters)
        if not self.profile.smooth:
            slopes[-_COINCIDENT * size <= E] = 0.0
        return slopes, others


@dataclass(frozen=True, init=False)
class SquaredExponential(Stationary):
    """k̃(x, x') = exp(-½ Σ_d ((x_d - x'_d) / ℓ_d)²), hyperparameters log ℓ (Rasmussen & Williams 2006, eq. 4.9, 5.1).

    Parameters
    ----------
    n_columns : int
        d.
    isotropic : bool, default=False
        Whether one lengthscale serves all columns.
    """

    def __init__(self, n_columns: int, isotropic: bool = False):
        super().__init__(Exponential(), n_columns, isotropic)

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> SquaredExponentialAt:
        return SquaredExponentialAt(self.profile, hyperparameters, inducing_points)


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
