"""Profiles φ(E) of stationary covariances, E = -½ r² of the scaled distance r."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.special import gammaln, kve

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
