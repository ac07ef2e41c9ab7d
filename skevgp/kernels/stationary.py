"""Stationary covariances: functions of the scaled distance between inputs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import reduce
from math import factorial
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import gammaln, kve
from sklearn.gaussian_process import kernels as sk

from ..utils.casadi import casadi
from .base import (
    CentredSquares,
    Covariance,
    CovarianceAt,
    PerRow,
    SetsPullback,
    Sums,
    exported_kernels,
    no_functions,
    one_lengthscale,
    reads,
)
from .waves import Waves, widened

# With r² = Σ_d ((x_d - x'_d) / ℓ_d)², each covariance is a profile φ of the exponent E = -½ r². E is linear in
# [x, 1, x²], so that it is one matrix product for a block of rows. The way back is too: with W = Ū φ'(E), all gradients
# follow from W [x, 1, x²]. Here x is centred, because r² is a small difference of squares that are large far from 0.
#
# In CasADi, distances under a root are kept away from 0. Otherwise derivatives would be NaN if x is an inducing point.

# Largest ν of a Matérn covariance, which is then almost a squared exponential; Bessel functions overflow above.
LARGEST_NU = 150.0
# In units of the largest |x/ℓ|² + |z/ℓ|²: below this, the matrix product leaves r² fewer than 8 digits, ...
_NEAR = 1e-8
# ... and below this (x - x') / r has fewer than 8. A profile that is not smooth at r = 0 then counts as flat.
_COINCIDENT = 1e-16
# Added to r² under a root in CasADi: too small to change a value, and large enough for accurate second derivatives.
TINY = 1e-18
# Largest ν - ½ of a Matérn in CasADi, which is the number of terms of a sum.
_MOST_TERMS = 20
# Factors by which frequencies are drawn wider than the spectral density, if it falls fast or has heavy tails.
_WIDER, _MUCH_WIDER = np.array([1.0, 1.5, 2.0]), 2.0 ** np.arange(10)
# Above this α, a rational quadratic is almost a squared exponential, and the Bessel functions of its density overflow.
_LARGE_ALPHA = 50.0

Derivatives = tuple[np.ndarray, list[np.ndarray]]


# --- profiles φ(E), E = -½ r² -------------------------------------------------------------------------------------


class Profile(ABC):
    """φ(E); its own parameters come before the length scales in the vector of hyperparameters."""

    # A subclass sets only what differs from these.
    n_parameters: ClassVar[int] = 0
    # Whether φ takes the root of r², which then needs all its digits.
    has_root: ClassVar[bool] = False
    # Whether distances are in units of length scales.
    scale_is_length: ClassVar[bool] = True

    @property
    def smooth(self) -> bool:
        """Whether φ'(E) is finite at E = 0."""
        return True

    @abstractmethod
    def value(self, E: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Return φ(E)."""

    @abstractmethod
    def derivatives(self, E: np.ndarray, value: np.ndarray, parameters: np.ndarray) -> Derivatives:
        """Return φ'(E) and the derivative in the logarithm of each parameter, given φ(E)."""

    def nearness(self, scaled: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Return coordinates (n, k) in which near rows have a large φ, from rows (n, d) in length scales."""
        return scaled

    def spectrum(
        self, parameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return frequencies (L, d) for length scales of 1, and their weights (L,) with mean 1, or raise ValueError."""
        raise ValueError(no_functions(type(self).__name__))

    def expression(self, squared: Any, parameters: np.ndarray) -> Any:
        """Return φ for CasADi symbols r², or raise ValueError."""
        raise ValueError(f"The kernel {self!r} cannot be written in CasADi. {exported_kernels()}")


@dataclass(frozen=True)
class Exponential(Profile):
    """φ = exp(E): the squared exponential (Rasmussen & Williams 2006, eq. 4.9)."""

    def value(self, E: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        return np.exp(E)

    def derivatives(self, E: np.ndarray, value: np.ndarray, parameters: np.ndarray) -> Derivatives:
        return value, []

    def spectrum(
        self, parameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray]:
        return widened(rng.standard_normal(shape), lambda squares: -0.5 * squares, _WIDER)

    def expression(self, squared: Any, parameters: np.ndarray) -> Any:
        return casadi().exp(-0.5 * squared)


@dataclass(frozen=True)
class Matern(Profile):
    """φ = 2^(1-ν) / Γ(ν) t^ν K_ν(t), t = √(2ν) r, ν up to `LARGEST_NU` (Rasmussen & Williams 2006, eq. 4.14)."""

    nu: float
    has_root = True

    @property
    def smooth(self) -> bool:
        return self.nu > 1.0

    def value(self, E: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        return self._bessel(E, self.nu, 1.0)

    def derivatives(self, E: np.ndarray, value: np.ndarray, parameters: np.ndarray) -> Derivatives:
        # d/dt [t^ν K_ν(t)] = -t^ν K_(ν-1)(t) (DLMF 10.29.4).
        slope = self._bessel(E, self.nu - 1.0, 0.5 / (self.nu - 1.0) if self.smooth else 0.0)
        slope *= 2.0 * self.nu
        return slope, []

    def _bessel(self, E: np.ndarray, order: float, at_zero: float) -> np.ndarray:
        """Return 2^(1-ν) / Γ(ν) t^order K_order(t), by logarithms because its factors overflow."""
        t = np.sqrt(-4.0 * self.nu * E)
        positive = np.maximum(t, 1e-150)
        # Beyond 1e3, exp(-t) is 0, whatever K is.
        with np.errstate(all="ignore"):
            log_bessel = np.log(kve(order, np.minimum(positive, 1e3)))
        factor = (1.0 - self.nu) * np.log(2.0) - gammaln(self.nu)
        values = np.exp(factor + order * np.log(positive) + log_bessel - positive)
        overflow = np.isinf(log_bessel) | (t == 0.0)
        values[overflow] = at_zero * self._near_zero(t[overflow], order)
        return values

    @staticmethod
    def _near_zero(t: np.ndarray, order: float) -> np.ndarray:
        """Return t^order K_order(t) relative to t = 0, where K overflows: first terms of DLMF 10.27.4 with 10.25.2."""
        term = total = np.ones_like(t)
        for k in range(1, min(int(order), 20)):
            term = term * (0.25 * t**2) / (k * (k - order))
            total = total + term
        return total

    def spectrum(
        self, parameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray]:
        return _student_t(self.nu, shape, rng)

    def expression(self, squared: Any, parameters: np.ndarray) -> Any:
        # exp(-t) times a polynomial (Rasmussen & Williams 2006, eq. 4.16).
        n = int(self.nu - 0.5)
        if n != self.nu - 0.5 or n > _MOST_TERMS:
            raise ValueError(
                f"The kernel Matern(nu={self.nu:g}) cannot be written in CasADi, which has no Bessel functions: nu "
                f"must be a half-integer up to {_MOST_TERMS + 0.5:g}, or inf. {exported_kernels()}"
            )
        first = factorial(n) / factorial(2 * n)
        coefficients = [
            first * factorial(n + i) / (factorial(i) * factorial(n - i)) * 2.0 ** (n - i) for i in range(n + 1)
        ]
        ca = casadi()
        t = ca.sqrt(2.0 * self.nu * (squared + TINY))
        return reduce(lambda total, coefficient: total * t + coefficient, coefficients) * ca.exp(-t)


@dataclass(frozen=True)
class Matern12(Matern):
    """φ = exp(-r) (Rasmussen & Williams 2006, eq. 4.18)."""

    nu: float = field(default=0.5, init=False)

    def value(self, E: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        return np.exp(-np.sqrt(-2.0 * E))

    def derivatives(self, E: np.ndarray, value: np.ndarray, parameters: np.ndarray) -> Derivatives:
        return value / np.maximum(np.sqrt(-2.0 * E), 1e-150), []

    def expression(self, squared: Any, parameters: np.ndarray) -> Any:
        # A lower limit of r² above 0 keeps derivatives from being NaN.
        ca = casadi()
        return ca.exp(-ca.sqrt(ca.fmax(squared, 1e-60)))


@dataclass(frozen=True)
class Matern32(Matern):
    """φ = (1 + t) exp(-t), t = √3 r; φ' = 3 exp(-t) (Rasmussen & Williams 2006, eq. 4.17)."""

    nu: float = field(default=1.5, init=False)

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
class Matern52(Matern):
    """φ = (1 + t + t²/3) exp(-t), t = √5 r; φ' = 5/3 (1 + t) exp(-t) (Rasmussen & Williams 2006, eq. 4.17)."""

    nu: float = field(default=2.5, init=False)

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
class RationalQuadratic(Profile):
    """φ = (1 + r² / 2α)^(-α) (Rasmussen & Williams 2006, eq. 4.19). Parameter α."""

    n_parameters = 1

    def value(self, E: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        alpha = parameters[0]
        log = np.log1p(self._ratio(E, alpha))
        log *= -alpha
        return np.exp(log, out=log)

    def derivatives(self, E: np.ndarray, value: np.ndarray, parameters: np.ndarray) -> Derivatives:
        alpha = parameters[0]
        ratio = self._ratio(E, alpha)
        from_alpha = ratio / (1.0 + ratio)
        from_alpha -= np.log1p(ratio)
        from_alpha *= value
        from_alpha *= alpha
        ratio += 1.0
        return np.divide(value, ratio, out=ratio), [from_alpha]

    @staticmethod
    def _ratio(E: np.ndarray, alpha: float) -> np.ndarray:
        """Return r² / 2α, kept finite."""
        with np.errstate(over="ignore"):
            ratio = E / -alpha
        return np.minimum(ratio, 1e300, out=ratio)

    def spectrum(
        self, parameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray]:
        # A mixture of squared exponentials over 1/ℓ² (eq. 4.20 there): normals whose variance has a gamma distribution.
        (size, d), alpha, normals = shape, float(parameters[0]), rng.standard_normal(shape)
        drawn = normals * np.sqrt(rng.gamma(alpha, 1.0 / alpha, size))[:, np.newaxis]
        if alpha > _LARGE_ALPHA:
            return drawn, np.ones(size)
        return widened(drawn, _variance_gamma(alpha, d), _MUCH_WIDER)

    def expression(self, squared: Any, parameters: np.ndarray) -> Any:
        ca, alpha = casadi(), float(parameters[0])
        return ca.exp(-alpha * ca.log1p(squared / (2.0 * alpha)))


def _student_t(nu: float, shape: tuple[int, int], rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    """Draw from the spectrum of a Matérn: a Student-t with 2ν degrees of freedom (Rasmussen & Williams 2006, 4.15)."""
    (size, d), degrees, normals = shape, 2.0 * nu, rng.standard_normal(shape)
    drawn = normals / np.sqrt(rng.chisquare(degrees, size) / degrees)[:, np.newaxis]
    return widened(drawn, lambda squares: -0.5 * (degrees + d) * np.log1p(squares / degrees), _MUCH_WIDER)


def _variance_gamma(alpha: float, d: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return the log density of normals (d,) whose variance has a gamma distribution of shape and rate α."""
    order = alpha - 0.5 * d

    def log_density(squares: np.ndarray) -> np.ndarray:
        x = np.sqrt(2.0 * alpha * np.maximum(squares, 1e-12))
        return order * np.log(x) + np.log(kve(order, x)) - x

    return log_density


# --- covariances --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stationary(Covariance):
    """k̃(x, x') = φ(-½ Σ_d ((x_d - x'_d) / ℓ_d)²); hyperparameters: those of φ, then ℓ."""

    profile: Profile  # φ
    n_columns: int
    isotropic: bool = False  # whether all columns have the same length scale
    rows: CentredSquares = field(default=CentredSquares(), compare=False)

    @property
    def n_hyperparameters(self) -> int:
        return self.profile.n_parameters + (1 if self.isotropic else self.n_columns)

    @property
    def lengthscale_mask(self) -> np.ndarray:
        is_length = np.arange(self.n_hyperparameters) >= self.profile.n_parameters
        return is_length & (not self.isotropic)

    @property
    def is_length(self) -> np.ndarray:
        after_parameters = np.arange(self.n_hyperparameters) >= self.profile.n_parameters
        return after_parameters & self.profile.scale_is_length

    def centred(self, centre: np.ndarray) -> Stationary:
        return replace(self, rows=CentredSquares(tuple(centre.tolist())))

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        parameters, lengthscales = self._split(hyperparameters)
        scaled = (inputs - others) / lengthscales
        return self.profile.value(-0.5 * np.einsum("...d,...d->...", scaled, scaled), parameters)

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> StationaryAt:
        points = self.rows.centred(inducing_points)
        return StationaryAt(self.profile, *self._split(hyperparameters), points, self.isotropic)

    def within(self, hyperparameters: np.ndarray, sets: np.ndarray) -> tuple[np.ndarray, SetsPullback]:
        parameters, lengthscales = self._split(hyperparameters)
        # Around a row of each set, small differences keep their digits.
        scaled = (sets - sets[:, -1:]) / lengthscales
        if self.profile.smooth:
            squares = -0.5 * np.einsum("bkd,bkd->bk", scaled, scaled)
            E = scaled @ scaled.transpose(0, 2, 1)
            E += squares[:, :, np.newaxis]
            E += squares[:, np.newaxis]
            np.minimum(E, 0.0, out=E)
        else:
            E = np.zeros((*scaled.shape[:2], scaled.shape[1]))
            for column in np.moveaxis(scaled, 2, 0):
                E -= 0.5 * np.square(column[:, :, np.newaxis] - column[:, np.newaxis])
        value = self.profile.value(E, parameters)

        def pull_back(bars: np.ndarray) -> np.ndarray:
            slopes, others = self.profile.derivatives(E, value, parameters)
            if not self.profile.smooth:
                slopes = np.where(E == 0.0, 0.0, slopes)
            # ∂E/∂log ℓ = ((x - x') / ℓ)², and the weights W of all pairs are symmetric.
            W = bars * slopes
            by_row = np.einsum("bkd,bkd,bk->d", scaled, scaled, W.sum(axis=2))
            length_bar = 2.0 * (by_row - np.einsum("bkd,bkd->d", W @ scaled, scaled))
            parameter_bar = [np.vdot(bars, other) for other in others]
            return np.append(parameter_bar, length_bar.sum() if self.isotropic else length_bar)

        return value, pull_back

    def nearness(self, hyperparameters: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        parameters, lengthscales = self._split(hyperparameters)
        return self.profile.nearness(self.rows.centred(inputs) / lengthscales, parameters)

    def random_terms(
        self, hyperparameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> list[tuple[Waves]]:
        parameters, lengthscales = self._split(hyperparameters)
        frequencies, weights = self.profile.spectrum(parameters, shape, rng)
        return [(Waves.drawn(frequencies / lengthscales, weights, self.rows, rng),)]

    def expression(self, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, float]:
        ca, x = casadi(), self.rows.symbol(x)
        parameters, lengthscales = self._split(hyperparameters)
        scaled = self.rows.centred(points) / lengthscales
        if self.profile.has_root:
            # Differences keep all digits if r² is small.
            squared = ca.sum2((ca.DM(scaled) - ca.repmat((x / ca.DM(lengthscales)).T, len(scaled), 1)) ** 2)
        else:
            # One product that is linear in [x, x²], as in predictions, has small derivatives.
            factor = np.hstack([-2.0 * scaled / lengthscales, np.broadcast_to(lengthscales**-2.0, scaled.shape)])
            squared = ca.mtimes(ca.DM(factor), ca.vertcat(x, x**2)) + ca.DM((scaled**2).sum(axis=1))
        return self.profile.expression(squared, parameters), 1.0

    def _split(self, hyperparameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the parameters of φ, and the length scale of each column (d,)."""
        n_parameters = self.profile.n_parameters
        return hyperparameters[:n_parameters], np.full(self.n_columns, hyperparameters[n_parameters:])


class StationaryAt(CovarianceAt):
    """A `Stationary` at given parameters of φ, length scales (d,) and centred inducing points (m, d)."""

    def __init__(
        self, profile: Profile, parameters: np.ndarray, lengthscales: np.ndarray, points: np.ndarray, isotropic: bool
    ):
        self.profile, self.parameters, self.lengthscales = profile, parameters, lengthscales
        self.points, self.isotropic = points, isotropic
        d, precision = points.shape[1], lengthscales**-2.0
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
            raise ValueError(
                "A function of this kernel has no gradient. It is as rough as one of a Matern kernel with nu up to 1."
            )
        slope = self.profile.derivatives(np.zeros(1), np.ones(1), self.parameters)[0]
        d = self.points.shape[1]
        return np.broadcast_to(np.diag(slope * self.lengthscales**-2.0), (prepared.shape[1], d, d))

    def start_pullback(self) -> Any:
        return Sums((np.zeros_like(self._exponent), np.zeros(self.profile.n_parameters)))

    def cross_pullback(self, prepared: np.ndarray, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Any:
        slopes, others = self._derivatives(*self._exponents(prepared), U)
        parameters_bar = np.array([np.vdot(U_bar, other) for other in others])
        np.multiply(U_bar, slopes, out=U_bar)
        return Sums((U_bar @ prepared.T, parameters_bar))

    def finish_pullback(self, total: Any, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows, parameters_bar = total
        size = -2.0 * float(self._exponent[:, self.points.shape[1]].min())
        slopes, others = self._derivatives(self._exponents_within(), size, self.matrix())
        parameters_bar = parameters_bar + np.array([np.vdot(K_bar, other) for other in others])
        length_bar, Z_bar = self._geometry_bar(rows, K_bar * slopes)
        return np.concatenate([parameters_bar, length_bar]), Z_bar

    def _geometry_bar(self, rows: np.ndarray, within: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradients in log ℓ and X_m from Σ_rows W [x, 1, x²] (m, 2 d + 1) and the W of `matrix` (m, m)."""
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
        """Return E (m, n), and the largest ½ (|x/ℓ|² + |z/ℓ|²), which its rounding errors are relative to."""
        E = self._exponent @ prepared
        np.minimum(E, 0.0, out=E)
        if self.profile.smooth or not len(self.points):
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
    """k̃(x, x') = exp(-½ Σ_d ((x_d - x'_d) / ℓ_d)²), hyperparameters ℓ (Rasmussen & Williams 2006, eq. 4.9)."""

    profile: Profile = field(default=Exponential(), init=False)

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> SquaredExponentialAt:
        points = self.rows.centred(inducing_points)
        return SquaredExponentialAt(self.profile, *self._split(hyperparameters), points, self.isotropic)


class SquaredExponentialAt(StationaryAt):
    """A `SquaredExponential` at given parameters. φ' = φ, so that gradients reuse k(X_m, X)."""

    def matrix(self) -> np.ndarray:
        scaled = self.points / self.lengthscales
        return np.exp(-0.5 * cdist(scaled, scaled, "sqeuclidean"))

    def cross(self, prepared: np.ndarray) -> np.ndarray:
        E = self._exponent @ prepared
        np.minimum(E, 0.0, out=E)
        return np.exp(E, out=E)

    def start_pullback(self) -> np.ndarray:
        return np.zeros_like(self._exponent)

    def cross_pullback(
        self, prepared: np.ndarray, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow
    ) -> np.ndarray:
        np.multiply(U_bar, U, out=U_bar)
        return U_bar @ prepared.T

    def finish_pullback(self, total: np.ndarray, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._geometry_bar(total, K_bar * self.matrix())

    def hyper_gradient(self, K: np.ndarray, K_bar: np.ndarray) -> np.ndarray:
        return self._geometry_bar(self.start_pullback(), K_bar * K)[0]


# --- from scikit-learn's kernels ---------------------------------------------------------------------------------


@reads(sk.RBF)
def squared_exponential(kernel: Any, n_columns: int) -> SquaredExponential:
    """Return the covariance of an RBF (or of a Matern with nu = inf)."""
    return SquaredExponential(n_columns, one_lengthscale(kernel, n_columns))


@reads(sk.Matern)
def matern(kernel: Any, n_columns: int) -> Stationary:
    """Return the covariance of a Matern."""
    if kernel.nu == np.inf:
        return squared_exponential(kernel, n_columns)
    if not 0.0 < kernel.nu <= LARGEST_NU:
        raise ValueError(f"kernel={kernel!r}: nu must be above 0 and at most {LARGEST_NU:g}, or inf; got {kernel.nu}.")
    special: dict[float, Profile] = {0.5: Matern12(), 1.5: Matern32(), 2.5: Matern52()}
    profile = special.get(kernel.nu, Matern(float(kernel.nu)))
    return Stationary(profile, n_columns, one_lengthscale(kernel, n_columns))


@reads(sk.RationalQuadratic)
def rational_quadratic(kernel: Any, n_columns: int) -> Stationary:
    """Return the covariance of a RationalQuadratic."""
    return Stationary(RationalQuadratic(), n_columns, isotropic=True)
