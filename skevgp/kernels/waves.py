"""Random functions whose mean product is a covariance: random Fourier features (Rahimi & Recht 2007)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from operator import mul

import numpy as np

from .base import CentredSquares, Covariance

# For a covariance of differences they are √2 cos(ωᵀx + b), with ω from its spectral density and b uniform. A sum of
# covariances has the functions of each; a product has the products of functions. The residual of a sparse model
# consists of waves far out in the spectrum, which inducing points cannot represent. So frequencies are drawn from wider
# densities too, with weights (importance sampling). Each family defines its waves in `Covariance.random_terms`.


class Factor(ABC):
    """L functions of x."""

    @abstractmethod
    def value(self, X: np.ndarray) -> np.ndarray:
        """Return values (L, n) at rows (n, d)."""

    @abstractmethod
    def slopes(self, X: np.ndarray) -> np.ndarray:
        """Return ∂/∂x, (L, n, d)."""


@dataclass(frozen=True)
class Waves(Factor):
    """Functions a cos(ωᵀ(x - c) + b)."""

    sizes: np.ndarray  # a, (L,)
    phases: np.ndarray  # b, (L,)
    frequencies: np.ndarray  # ω, (L, d)
    rows: CentredSquares  # with c

    @classmethod
    def drawn(
        cls, frequencies: np.ndarray, weights: np.ndarray, rows: CentredSquares, rng: np.random.RandomState
    ) -> Waves:
        """Make waves with frequencies (L, d) that count in proportion to weights (L,), and random phases."""
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
    """Functions aᵀx + b, with gradients a (L, d) and levels b (L,)."""

    gradients: np.ndarray
    levels: np.ndarray

    def value(self, X: np.ndarray) -> np.ndarray:
        return self.gradients @ X.T + self.levels[:, np.newaxis]

    def slopes(self, X: np.ndarray) -> np.ndarray:
        return np.repeat(self.gradients[:, np.newaxis], len(X), axis=1)


@dataclass(frozen=True)
class RandomFunctions:
    """L functions for each term, Φ, with k(x, x') = E[Σ φ(x) φ(x')]; a term is the product of its factors."""

    terms: list[tuple[Factor, ...]]

    def value(self, X: np.ndarray) -> np.ndarray:
        """Return Φ at rows (n, d), (L * n_terms, n)."""
        values = np.concatenate([reduce(mul, (factor.value(X) for factor in term)) for term in self.terms])
        return values * self._scale(values)

    def slopes(self, X: np.ndarray) -> np.ndarray:
        """Return ∂Φ/∂x, (L * n_terms, n, d)."""
        slopes = np.concatenate([_product_rule(term, X) for term in self.terms])
        return slopes * self._scale(slopes)

    def _scale(self, functions: np.ndarray) -> float:
        return float(np.sqrt(len(self.terms) / len(functions)))


def _product_rule(factors: tuple[Factor, ...], X: np.ndarray) -> np.ndarray:
    values = [factor.value(X)[:, :, np.newaxis] for factor in factors] if len(factors) > 1 else []
    parts = (reduce(mul, (*values[:i], *values[i + 1 :]), factor.slopes(X)) for i, factor in enumerate(factors))
    return sum(parts)  # type: ignore[return-value]


def random_functions(
    covariance: Covariance, hyperparameters: np.ndarray, size: int, n_columns: int, rng: np.random.RandomState
) -> RandomFunctions:
    """Draw L = size functions whose mean product is the covariance; ValueError if its spectral density is not known."""
    return RandomFunctions(covariance.random_terms(hyperparameters, (size, n_columns), rng))


def widened(
    frequencies: np.ndarray, log_density: Callable[[np.ndarray], np.ndarray], widths: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Widen frequencies (L, d) by the widths alternately; return them with their importance weights (L,)."""
    # The weight is the density over that of the mixture, which is at most the number of widths. log_density is the
    # logarithm of the density as a function of |ω|², up to a constant.
    size, d = frequencies.shape
    frequencies = frequencies * widths[np.arange(size) % len(widths), np.newaxis]
    squares = np.einsum("ld,ld->l", frequencies, frequencies)
    log_densities = log_density(squares[:, np.newaxis] / widths**2) - d * np.log(widths)
    return frequencies, len(widths) * np.exp(log_density(squares) - np.logaddexp.reduce(log_densities, axis=1))
