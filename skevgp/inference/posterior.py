"""The fitted model: mean, variance, covariance and coefficients, in the user's units."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from .bounds import CoefficientPrior
from .statistics import Kernel, KernelAt

# Of the spread of all outputs at once.
_PREDICTED_NUMBERS = 2**20


@dataclass(frozen=True)
class InducingSet:
    """Inducing points, the covariance that they belong to, and the outputs that they serve.

    Attributes
    ----------
    hyperparameters : ndarray of shape (n_hyper,)
        Of k̃.
    points : ndarray of shape (m, d)
        In the kernel's inputs.
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
        R with Cov[ω] = Rᵀ R; of lower rank in the exact model.
    """

    kernel: Kernel
    inducing: tuple[InducingSet, ...]
    signal: np.ndarray
    noise: np.ndarray
    prior: CoefficientPrior
    mean: tuple[np.ndarray, ...]
    root: tuple[np.ndarray, ...]

    @cached_property
    def rows_at_once(self) -> int:
        """How many rows to predict at once, so that memory stays small and products are large."""
        stacked = sum(len(mean) for mean in self.mean)
        return int(np.clip(_PREDICTED_NUMBERS // stacked, 256, 4096))

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
        prepared, means, variances = self.kernel.prepare(inputs), [], []
        for group in self._groups:
            P, unexplained = group.project(prepared, features)
            means.append((group.mean @ P).T)
            if return_variance:
                spread = group.root @ P
                np.multiply(spread, spread, out=spread)
                squares = spread.reshape(len(group.mean), group.rank, len(inputs)).sum(axis=1)
                variances.append((np.outer(group.signal, np.maximum(unexplained, 0.0)) + squares).T)
        mean = _side_by_side(means)
        mean += features @ self.prior.offset.T
        return mean, _side_by_side(variances) if return_variance else None

    def covariance(self, inputs: np.ndarray, features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (n, o) of the noise-free g(x), and its covariance between rows (n, n, o)."""
        mean, _ = self.predict(inputs, features)
        covariance, prepared = [], self.kernel.prepare(inputs)
        for group, own in zip(self._groups, self.inducing, strict=True):
            P, _ = group.project(prepared, features)
            V = P[: len(own.points)]
            unexplained = self.kernel.at(own.hyperparameters, inputs).matrix() - V.T @ V
            for signal, root in zip(group.signal, np.split(group.root, len(group.mean)), strict=True):
                spread = root @ P
                covariance.append(signal * unexplained + spread.T @ spread)
        return mean, np.stack(covariance, axis=2)

    @cached_property
    def _groups(self) -> tuple[_Group, ...]:
        """What does not depend on the rows, computed once: a control loop predicts one row at a time."""
        groups = []
        for own in self.inducing:
            outputs = range(len(self.signal))[own.outputs]
            m = len(own.points)
            # [s; c] turns [V; Hᵀ] into Pᵀ of each output.
            scales = [np.append(np.full(m, np.sqrt(self.signal[o])), self.prior.scale[o]) for o in outputs]
            groups.append(
                _Group(
                    self.kernel.at(own.hyperparameters, own.points),
                    own.L_inv,
                    self.signal[own.outputs],
                    np.array([self.mean[o] * scale for o, scale in zip(outputs, scales, strict=True)]),
                    np.vstack([self.root[o] * scale for o, scale in zip(outputs, scales, strict=True)]),
                )
            )
        return tuple(groups)

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


@dataclass(frozen=True)
class _Group:
    """Outputs that share inducing points, ready to predict: g(x) has the mean ``mean @ P`` and the spread ``root @ P``.

    Attributes
    ----------
    kernel : KernelAt
    L_inv : ndarray of shape (m, m)
    signal : ndarray of shape (o,)
    mean : ndarray of shape (o, m + p)
    root : ndarray of shape (o (m + p), m + p)
        Of one output above the other.
    """

    kernel: KernelAt
    L_inv: np.ndarray
    signal: np.ndarray
    mean: np.ndarray
    root: np.ndarray

    @property
    def rank(self) -> int:
        """Rows of ``root`` per output."""
        return len(self.root) // len(self.mean)

    def project(self, prepared: Any, features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """P = [V; Hᵀ] of shape (m + p, n), and k̃(x, x) - |v|² of each row."""
        m = len(self.L_inv)
        P = np.empty((m + features.shape[1], len(features)))
        V = np.matmul(self.L_inv, self.kernel.cross(prepared), out=P[:m])
        P[m:] = features.T
        return P, self.kernel.diagonal(prepared) - np.einsum("mn,mn->n", V, V)


def _side_by_side(columns: list[np.ndarray]) -> np.ndarray:
    return columns[0] if len(columns) == 1 else np.hstack(columns)
