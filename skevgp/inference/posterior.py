"""The fitted model, frozen: all that predictions need, and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .statistics import Kernel, Whitening

# Of the deviations of all outputs at once.
_PREDICTED_NUMBERS = 2**20


@dataclass(frozen=True)
class PredictorGroup:
    """Outputs that share inducing points: with P = [V; Hᵀ], g(x) has mean ``mean @ P`` and deviation ``root @ P``.

    Attributes
    ----------
    outputs : slice
        o of them.
    hyperparameters : ndarray of shape (n_hyper,)
        Of k̃.
    points : ndarray of shape (m, d)
    whitening : Whitening
        Of k̃ at the points.
    signal : ndarray of shape (o,)
        s².
    mean : ndarray of shape (o, m + p)
    root : ndarray of shape (o, k, m + p)
        The variance of g(x) is |root @ P|² and what the points leave of s² k̃(x, x); k is m + p, or less in the exact
        model.
    """

    outputs: slice
    hyperparameters: np.ndarray
    points: np.ndarray
    whitening: Whitening
    signal: np.ndarray
    mean: np.ndarray
    root: np.ndarray

    @classmethod
    def of(
        cls,
        outputs: slice,
        hyperparameters: np.ndarray,
        points: np.ndarray,
        whitening: Whitening,
        signal: np.ndarray,
        scale: np.ndarray,
        mean: Sequence[np.ndarray],
        root: Sequence[np.ndarray],
    ) -> PredictorGroup:
        """From q(ω) of each output, ω = (v, w) whitened as in `bounds`, with the prior's scales (o, p)."""
        s = np.broadcast_to(np.sqrt(signal)[:, np.newaxis], (len(signal), len(points)))
        # [s; c] turns [V; Hᵀ] into Pᵀ of each output.
        scales = np.hstack([s, scale])
        return cls(
            outputs,
            hyperparameters,
            points,
            whitening,
            signal,
            np.array(mean) * scales,
            np.array(root) * scales[:, np.newaxis],
        )

    def scaled(self, factor: np.ndarray) -> PredictorGroup:
        """The same group for outputs in other units: y times ``factor`` (o,)."""
        by = factor[:, np.newaxis]
        return replace(self, signal=self.signal * factor**2, mean=self.mean * by, root=self.root * by[:, np.newaxis])

    def project(self, prepared: object, features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """P = [V; Hᵀ] of shape (m + p, n), and k̃(x, x) - |v|² of each row."""
        m = len(self.points)
        P = np.empty((m + features.shape[1], len(features)))
        _, V = self.whitening.project(prepared, out=P[:m])
        P[m:] = features.T
        return P, self.whitening.unexplained(prepared, V)


@dataclass(frozen=True)
class Predictor:
    """Mean, variance and covariance of the noise-free g(x), and the weights (the paper's eq. prediction, with C free).

    Attributes
    ----------
    kernel : Kernel
        k̃.
    groups : tuple of PredictorGroup
        Of all outputs, in their order.
    noise : ndarray of shape (o,)
        σ².
    offset : ndarray of shape (o, p)
        What the groups' weights of features are added to.
    intercept : ndarray of shape (o,)
        What is added to the mean.
    """

    kernel: Kernel
    groups: tuple[PredictorGroup, ...]
    noise: np.ndarray
    offset: np.ndarray
    intercept: np.ndarray

    @classmethod
    def joined(
        cls, parts: Sequence[Predictor], unit: np.ndarray, offset: np.ndarray, intercept: np.ndarray
    ) -> Predictor:
        """Predictors of consecutive outputs as one, each output times ``unit``, with another offset and intercept."""
        groups, first = [], 0
        for part in parts:
            for group in part.groups:
                outputs = slice(first, first + len(group.signal))
                groups.append(replace(group.scaled(unit[outputs]), outputs=outputs))
                first = outputs.stop
        noise = np.concatenate([part.noise for part in parts]) * unit**2
        return cls(parts[0].kernel, tuple(groups), noise, offset, intercept)

    @property
    def rows_at_once(self) -> int:
        """How many rows to predict at once, so that memory stays small and products are large."""
        stacked = sum(group.mean.size for group in self.groups)
        return int(np.clip(_PREDICTED_NUMBERS // stacked, 256, 4096))

    @property
    def signal(self) -> np.ndarray:
        """s² of each output, (o,)."""
        return np.concatenate([group.signal for group in self.groups])

    def predict(
        self, inputs: np.ndarray, features: np.ndarray, return_variance: bool = False
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Mean and variance of the noise-free g(x).

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
        for group in self.groups:
            P, unexplained = group.project(prepared, features)
            means.append((group.mean @ P).T)
            if return_variance:
                o, k, size = group.root.shape
                deviation = group.root.reshape(o * k, size) @ P
                np.multiply(deviation, deviation, out=deviation)
                squares = deviation.reshape(o, k, len(inputs)).sum(axis=1)
                variances.append((np.outer(group.signal, unexplained) + squares).T)
        mean = _side_by_side(means)
        mean += features @ self.offset.T
        mean += self.intercept
        return mean, _side_by_side(variances) if return_variance else None

    def covariance(self, inputs: np.ndarray, features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (n, o) of the noise-free g(x), and its covariance between rows (n, n, o)."""
        mean, _ = self.predict(inputs, features)
        covariance, prepared = [], self.kernel.prepare(inputs)
        for group in self.groups:
            P, _ = group.project(prepared, features)
            V = P[: len(group.points)]
            unexplained = self.kernel.at(np.log(group.hyperparameters), inputs).matrix() - V.T @ V
            for signal, root in zip(group.signal, group.root, strict=True):
                deviation = root @ P
                covariance.append(signal * unexplained + deviation.T @ deviation)
        return mean, np.stack(covariance, axis=2)

    def coefficients(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (o, p) and covariance (o, p, p) of β."""
        mean, covariance = self.offset.copy(), []
        for group in self.groups:
            m = len(group.points)
            mean[group.outputs] += group.mean[:, m:]
            deviation = group.root[:, :, m:]
            covariance.append(deviation.transpose(0, 2, 1) @ deviation)
        return mean, np.concatenate(covariance)


def _side_by_side(columns: list[np.ndarray]) -> np.ndarray:
    return columns[0] if len(columns) == 1 else np.hstack(columns)
