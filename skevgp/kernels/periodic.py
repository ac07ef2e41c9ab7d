"""Covariances that are periodic in the distance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ive
from sklearn.gaussian_process import kernels as sk

from ..utils.casadi import casadi
from .base import no_functions, reads
from .stationary import TINY, Derivatives, Profile, Stationary

# Number of terms of the Fourier series.
_HARMONICS = 10_000


@dataclass(frozen=True)
class ExpSineSquared(Profile):
    """φ = exp(-2 sin²(π r) / ℓ²), r = |x - x'| / period (Rasmussen & Williams 2006, eq. 4.31). Parameter ℓ."""

    n_parameters = 1
    has_root = True
    scale_is_length = False  # but the period

    def value(self, E: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        return np.exp(-2.0 * self._squared(np.sqrt(-2.0 * E), parameters))

    def derivatives(self, E: np.ndarray, value: np.ndarray, parameters: np.ndarray) -> Derivatives:
        r = np.sqrt(-2.0 * E)
        # d sin²(π r) / dE = -π sin(2π r) / r, finite at r = 0.
        slope = np.sinc(2.0 * r)
        slope *= value
        slope *= (2.0 * np.pi / parameters[0]) ** 2
        return slope, [4.0 * self._squared(r, parameters) * value]

    def nearness(self, scaled: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        # Each column is a circle, whose chords have the squares 4 sin²(π r).
        return np.hstack([np.cos(2.0 * np.pi * scaled), np.sin(2.0 * np.pi * scaled)]) / parameters[0]

    @staticmethod
    def _squared(r: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Return sin²(π r) / ℓ²."""
        return (np.sin(np.pi * r) / parameters[0]) ** 2

    def spectrum(
        self, parameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray]:
        size, d = shape
        if d > 1:
            raise ValueError(no_functions(f"{type(self).__name__} of {d} columns"))
        # The Fourier series of exp(z cos(2π r)) has Bessel functions I_j(z), z = 1 / ℓ² (DLMF 10.35.2).
        share = ive(np.arange(_HARMONICS), float(parameters[0] ** -2.0))
        share[1:] *= 2.0
        harmonics = rng.choice(_HARMONICS, size, p=share / share.sum())[:, np.newaxis].astype(float)
        return 2.0 * np.pi * harmonics, np.ones(size)

    def expression(self, squared: Any, parameters: np.ndarray) -> Any:
        ca = casadi()
        return ca.exp(-2.0 * parameters[0] ** -2.0 * ca.sin(np.pi * ca.sqrt(squared + TINY)) ** 2)


@reads(sk.ExpSineSquared)
def exp_sine_squared(kernel: Any, n_columns: int) -> Stationary:
    """Return the covariance of an ExpSineSquared, whose periodicity is the length scale."""
    return Stationary(ExpSineSquared(), n_columns, isotropic=True)
