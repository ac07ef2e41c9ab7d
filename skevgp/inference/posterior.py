"""The fitted model: mean, variance, covariance and coefficients, in the user's units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .bounds import CoefficientPrior
from .statistics import Kernel


@dataclass(frozen=True)
class InducingSet:
    """Inducing points, the covariance that they belong to, and the outputs that they serve.

    Attributes
    ----------
    hyperparameters : ndarray of shape (n_hyper,)
        Of k̃.
    points : ndarray of shape (m, d)
        In the kernel's (centred) inputs.
    L_inv : ndarray of shape (m, m)
        Inverse of the Cholesky factor of k̃(X_m, X_m).
    outputs : slice
    """

    hyperparameters: np.ndarray
    points: np.ndarray
    L_inv: np.ndarray
    outputs: slice


@dataclass(frozen=True)
class Posterior:
    """q(ω) of each output, ω = (v, w) whitened as in `bounds`, and what turns it into predictions.

    Attributes
    ----------
    kernel : Kernel
        k̃.
    inducing : tuple of InducingSet
    signal, noise : ndarray of shape (o,)
        s² and σ².
    prior : CoefficientPrior
    mean : tuple of o ndarrays of shape (m + p,)
        E[ω].
    root : tuple of o ndarrays of shape (m + p, m + p)
        R with Cov[ω] = Rᵀ R.
    """

    kernel: Kernel
    inducing: tuple[InducingSet, ...]
    signal: np.ndarray
    noise: np.ndarray
    prior: CoefficientPrior
    mean: tuple[np.ndarray, ...]
    root: tuple[np.ndarray, ...]

    def predict(
        self, inputs: np.ndarray, features: np.ndarray, return_variance: bool = False
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Mean and variance of the noise-free g(x) (the paper's eq. prediction, with C free).

        Parameters
        ----------
        inputs : ndarray of shape (n, d)
            The kernel's.
        features : ndarray of shape (n, p)
            h(x).
        return_variance : bool, default=False

        Returns
        -------
        mean : ndarray of shape (n, o)
        variance : ndarray of shape (n, o), or None
        """
        mean = features @ self.prior.offset.T
        variance = np.empty_like(mean) if return_variance else None
        prepared = self.kernel.prepare(inputs)
        for group in self.inducing:
            kernel = self.kernel.at(group.hyperparameters, group.points)
            V = group.L_inv @ kernel.cross(prepared)
            if variance is not None:
                unexplained = np.maximum(kernel.diagonal(prepared) - np.einsum("mn,mn->n", V, V), 0.0)
            for o in range(len(self.signal))[group.outputs]:
                P = self._projection(V, features, o)
                mean[:, o] += self.mean[o] @ P
                if variance is not None:
                    spread = self.root[o] @ P
                    variance[:, o] = self.signal[o] * unexplained + np.einsum("mn,mn->n", spread, spread)
        return mean, variance

    def covariance(self, inputs: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Covariance of the noise-free g(x) between rows, of shape (n, n, o)."""
        covariance = np.empty((len(inputs), len(inputs), len(self.signal)))
        prepared = self.kernel.prepare(inputs)
        for group in self.inducing:
            V = group.L_inv @ self.kernel.at(group.hyperparameters, group.points).cross(prepared)
            unexplained = self.kernel.at(group.hyperparameters, inputs).matrix() - V.T @ V
            for o in range(len(self.signal))[group.outputs]:
                spread = self.root[o] @ self._projection(V, features, o)
                covariance[:, :, o] = self.signal[o] * unexplained + spread.T @ spread
        return covariance

    def coefficients(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (o, p) and covariance (o, p, p) of β."""
        p = self.prior.scale.shape[1]
        mean, covariance = self.prior.offset.copy(), np.empty((len(self.signal), p, p))
        for o, (omega, root) in enumerate(zip(self.mean, self.root, strict=True)):
            first = len(omega) - p
            mean[o] += self.prior.scale[o] * omega[first:]
            spread = root[:, first:] * self.prior.scale[o]
            covariance[o] = spread.T @ spread
        return mean, covariance

    def _projection(self, V: np.ndarray, features: np.ndarray, output: int) -> np.ndarray:
        """Pᵀ: [s V; diag(c) Hᵀ] (m + p, n)."""
        return np.vstack([np.sqrt(self.signal[output]) * V, (features * self.prior.scale[output]).T])
