"""Random functions whose mean product is a covariance: random Fourier features (Rahimi & Recht 2007).

For a covariance of differences, √2 cos(ωᵀx + b) with ω from its spectral density and b uniform. Sums of covariances
have the functions of each, products the products. What a sparse model leaves to be drawn is what inducing points cannot
follow, waves far out in the spectrum; so frequencies are drawn from wider densities too, and count in proportion
(importance sampling). Each family says in its own file which waves are its own (`Covariance.random_terms`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from operator import mul

import numpy as np

from .base import CentredSquares, Covariance


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

    @classmethod
    def drawn(
        cls, frequencies: np.ndarray, weights: np.ndarray, rows: CentredSquares, rng: np.random.RandomState
    ) -> Waves:
        """With frequencies (L, d) that count in proportion to weights (L,), and phases at random."""
        return cls(np.sqrt(2.0 * weights), rng.uniform(0.0, 2.0 * np.pi, len(weights)), frequencies, rows)

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
    return RandomFunctions(covariance.random_terms(hyperparameters, (size, n_columns), rng))


def widened(
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
