"""Random functions whose mean product is a covariance: random Fourier features (Rahimi & Recht 2007).

For a covariance of differences, √2 cos(ωᵀx + b) with ω from its spectral density and b uniform. Sums of covariances
have the functions of each, products the products. What a sparse model leaves to be drawn is what inducing points cannot
follow, waves far out in the spectrum; so frequencies are drawn from wider densities too, and count in proportion
(importance sampling).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce, singledispatch
from itertools import product
from operator import mul
from typing import Any

import numpy as np
from scipy.special import ive, kve

from .constant import Constant
from .cosine import Wave
from .covariances import CentredSquares, Covariance, Product, Sum
from .dot_product import DotProduct
from .profiles import Exponential, ExpSineSquared, Matern, Matern12, Matern32, Matern52, RationalQuadratic
from .stationary import Stationary

# How much wider than by the spectral density frequencies are drawn too: one that falls fast, or with heavy tails.
_WIDER, _MUCH_WIDER = np.array([1.0, 1.5, 2.0]), 2.0 ** np.arange(10)
# Above this a rational quadratic is as a squared exponential, and its density's Bessel functions overflow.
_LARGE_ALPHA = 50.0
_NU: dict[type, float] = {Matern12: 0.5, Matern32: 1.5, Matern52: 2.5}
# Of the Fourier series of a periodic covariance.
_HARMONICS = 10_000


class Factor(ABC):
    """L functions of x side by side."""

    @abstractmethod
    def value(self, X: np.ndarray) -> np.ndarray:
        """Of rows (n, d): (L, n)."""

    @abstractmethod
    def slopes(self, X: np.ndarray) -> np.ndarray:
        """∂/∂x, (L, n, d)."""


@dataclass(frozen=True)
class Waves(Factor):
    """a cos(ωᵀ(x - c) + b).

    Attributes
    ----------
    sizes, phases : ndarray of shape (L,)
        a and b.
    frequencies : ndarray of shape (L, d)
        ω.
    rows : CentredSquares
        Which knows c.
    """

    sizes: np.ndarray
    phases: np.ndarray
    frequencies: np.ndarray
    rows: CentredSquares

    def value(self, X: np.ndarray) -> np.ndarray:
        return self.sizes[:, np.newaxis] * np.cos(self._angles(X))

    def slopes(self, X: np.ndarray) -> np.ndarray:
        steepness = -self.sizes[:, np.newaxis] * np.sin(self._angles(X))
        return steepness[:, :, np.newaxis] * self.frequencies[:, np.newaxis]

    def _angles(self, X: np.ndarray) -> np.ndarray:
        return self.frequencies @ self.rows.centred(X).T + self.phases[:, np.newaxis]


@dataclass(frozen=True)
class Planes(Factor):
    """aᵀx + b, with gradients a (L, d) and levels b (L,)."""

    gradients: np.ndarray
    levels: np.ndarray

    def value(self, X: np.ndarray) -> np.ndarray:
        return self.gradients @ X.T + self.levels[:, np.newaxis]

    def slopes(self, X: np.ndarray) -> np.ndarray:
        return np.repeat(self.gradients[:, np.newaxis], len(X), axis=1)


@dataclass(frozen=True)
class RandomFunctions:
    """L functions for each term, Φ, with k(x, x') = E[Σ φ(x) φ(x')].

    Attributes
    ----------
    terms : list of tuple of Factor
        Each the product of its factors.
    """

    terms: list[tuple[Factor, ...]]

    def value(self, X: np.ndarray) -> np.ndarray:
        """Φ of rows (n, d): (L * n_terms, n)."""
        found = np.concatenate([reduce(mul, (each.value(X) for each in term)) for term in self.terms])
        return found * self._scale(found)

    def slopes(self, X: np.ndarray) -> np.ndarray:
        """∂Φ/∂x, (L * n_terms, n, d)."""
        found = np.concatenate([_product_rule(term, X) for term in self.terms])
        return found * self._scale(found)

    def _scale(self, found: np.ndarray) -> float:
        return float(np.sqrt(len(self.terms) / len(found)))


def _product_rule(factors: tuple[Factor, ...], X: np.ndarray) -> np.ndarray:
    values = [each.value(X)[:, :, np.newaxis] for each in factors] if len(factors) > 1 else []
    parts = (reduce(mul, (*values[:i], *values[i + 1 :]), each.slopes(X)) for i, each in enumerate(factors))
    return sum(parts)  # type: ignore[return-value]


def random_functions(
    covariance: Covariance, hyperparameters: np.ndarray, size: int, n_columns: int, rng: np.random.RandomState
) -> RandomFunctions:
    """Draw functions whose mean product is the covariance.

    Parameters
    ----------
    covariance : Covariance
    hyperparameters : ndarray of shape (n_hyper,)
        Logarithms.
    size : int
        L.
    n_columns : int
        d.
    rng : RandomState

    Raises
    ------
    ValueError
        If the covariance has no spectral density that is known here, as that of a user's function.
    """
    return RandomFunctions(_terms(covariance, hyperparameters, (size, n_columns), rng))


@singledispatch
def _terms(
    covariance: Any, hyperparameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
) -> list[tuple[Factor, ...]]:
    raise ValueError(
        f"No functions can be drawn of a kernel with a {type(covariance).__name__}: its spectral density is not known. "
        "sample_y draws at given rows, and rollout along paths."
    )


@_terms.register
def _(covariance: Sum, hyperparameters: Any, shape: Any, rng: Any) -> list[tuple[Factor, ...]]:
    return [term for part, own in covariance.own(hyperparameters) for term in _terms(part, own, shape, rng)]


@_terms.register
def _(covariance: Product, hyperparameters: Any, shape: Any, rng: Any) -> list[tuple[Factor, ...]]:
    parts = [_terms(part, own, shape, rng) for part, own in covariance.own(hyperparameters)]
    return [sum(chosen, ()) for chosen in product(*parts)]


@_terms.register
def _(covariance: Constant, hyperparameters: Any, shape: Any, rng: Any) -> list[tuple[Factor, ...]]:
    return [(Planes(np.zeros(shape), np.full(shape[0], np.exp(0.5 * hyperparameters[0]))),)]


@_terms.register
def _(covariance: DotProduct, hyperparameters: Any, shape: Any, rng: Any) -> list[tuple[Factor, ...]]:
    return [(Planes(rng.standard_normal(shape), np.exp(hyperparameters[0]) * rng.standard_normal(shape[0])),)]


@_terms.register
def _(covariance: Wave, hyperparameters: Any, shape: Any, rng: Any) -> list[tuple[Factor, ...]]:
    frequencies = np.repeat(covariance.frequencies(hyperparameters)[np.newaxis], shape[0], axis=0)
    return [(_waves(frequencies, np.ones(shape[0]), covariance.rows, rng),)]


@_terms.register
def _(covariance: Stationary, hyperparameters: Any, shape: Any, rng: Any) -> list[tuple[Factor, ...]]:
    own, lengths = np.split(hyperparameters, [covariance.profile.n_parameters])
    frequencies, weights = _spectrum(covariance.profile, own, shape, rng)
    return [(_waves(frequencies * np.exp(-lengths), weights, covariance.rows, rng),)]


def _waves(frequencies: np.ndarray, weights: np.ndarray, rows: CentredSquares, rng: np.random.RandomState) -> Waves:
    return Waves(np.sqrt(2.0 * weights), rng.uniform(0.0, 2.0 * np.pi, len(weights)), frequencies, rows)


def _spectrum(
    profile: Any, parameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (L, d) for lengthscales of 1, and how much each counts (L,), 1 in the mean."""
    (size, d), normals = shape, rng.standard_normal(shape)
    if isinstance(profile, Exponential):
        return _widened(normals, lambda squares: -0.5 * squares, _WIDER)
    if isinstance(profile, Matern12 | Matern32 | Matern52 | Matern):
        # A Student-t with 2ν degrees of freedom (Rasmussen & Williams 2006, eq. 4.15).
        degrees = 2.0 * (profile.nu if isinstance(profile, Matern) else _NU[type(profile)])
        drawn = normals / np.sqrt(rng.chisquare(degrees, size) / degrees)[:, np.newaxis]
        return _widened(drawn, lambda squares: -0.5 * (degrees + d) * np.log1p(squares / degrees), _MUCH_WIDER)
    ones = np.ones(size)
    if isinstance(profile, RationalQuadratic):
        # A mixture of squared exponentials over 1/ℓ² (eq. 4.20 there): of normals, with a gamma's variance.
        alpha = float(np.exp(parameters[0]))
        drawn = normals * np.sqrt(rng.gamma(alpha, 1.0 / alpha, size))[:, np.newaxis]
        return (drawn, ones) if alpha > _LARGE_ALPHA else _widened(drawn, _variance_gamma(alpha, d), _MUCH_WIDER)
    if isinstance(profile, ExpSineSquared) and d == 1:
        share = ive(np.arange(_HARMONICS), float(np.exp(-2.0 * parameters[0])))
        share[1:] *= 2.0
        return 2.0 * np.pi * rng.choice(_HARMONICS, size, p=share / share.sum())[:, np.newaxis].astype(float), ones
    raise ValueError(
        f"No functions can be drawn of a kernel with a {type(profile).__name__} of {d} columns: its spectral density "
        "is not known. sample_y draws at given rows, and rollout along paths."
    )


def _widened(
    frequencies: np.ndarray, log_density: Callable[[np.ndarray], np.ndarray], widths: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (L, d) spread by widths in turns, and density over that of the mixture, (L,): at most their number.

    The logarithm of their density, of |ω|² but for a constant, is ``log_density``.
    """
    size, d = frequencies.shape
    frequencies = frequencies * widths[np.arange(size) % len(widths), np.newaxis]
    squares = np.einsum("ld,ld->l", frequencies, frequencies)
    each = log_density(squares[:, np.newaxis] / widths**2) - d * np.log(widths)
    return frequencies, len(widths) * np.exp(log_density(squares) - np.logaddexp.reduce(each, axis=1))


def _variance_gamma(alpha: float, d: int) -> Callable[[np.ndarray], np.ndarray]:
    """Of normals (d,) with a variance from the gamma distribution of shape and rate α: the density's logarithm."""
    order = alpha - 0.5 * d

    def log_density(squares: np.ndarray) -> np.ndarray:
        x = np.sqrt(2.0 * alpha * np.maximum(squares, 1e-12))
        return order * np.log(x) + np.log(kve(order, x)) - x

    return log_density
