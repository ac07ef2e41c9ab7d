"""The prior of the weights, and the fitted model, frozen: all that predictions need, and nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..data.rows import Columns, of_outputs, times_weights
from ..utils.linalg import covariance_root, diagonal_of, nearest_covariance
from .statistics import Kernel, Whitening

# Of the deviations of all outputs at once.
_PREDICTED_NUMBERS = 2**20


@dataclass(frozen=True)
class CoefficientPrior:
    """β ~ N(mean, C Cᵀ) for each output, and the reference that residuals are taken from.

    Attributes
    ----------
    mean, scale : ndarray of shape (o, p)
        With ``scale`` the standard deviations.
    reference : ndarray of shape (o, p)
        w₀: residuals are y - H (mean + C w₀).
    root : ndarray of shape (o, p, p), optional
        C; None means diag(scale), independent weights.
    shared : bool, default=False
        Whether all outputs have the same w, and with it the same β in the user's units: rows of the arrays then differ
        by the outputs' units only.
    """

    mean: np.ndarray
    scale: np.ndarray
    reference: np.ndarray
    root: np.ndarray | None = None
    shared: bool = False

    @property
    def offset(self) -> np.ndarray:
        """The coefficients (o, p) that the residuals are taken from."""
        return self.mean + self.times(self.reference)

    def times(self, w: np.ndarray) -> np.ndarray:
        """C w of each output, (o, p)."""
        return self.scale * w if self.root is None else np.einsum("oij,oj->oi", self.root, w)

    def roots(self) -> np.ndarray:
        """C of each output, (o, p, p)."""
        return self.scale[:, :, np.newaxis] * np.eye(self.scale.shape[1]) if self.root is None else self.root

    def outputs(self, columns: Columns) -> CoefficientPrior:
        """The prior of some of the outputs."""
        return CoefficientPrior(
            self.mean[columns],
            self.scale[columns],
            self.reference[columns],
            None if self.root is None else self.root[columns],
            self.shared,
        )

    def scaled(self, factor: np.ndarray) -> CoefficientPrior:
        """The prior of β times ``factor`` (o,), with the same w."""
        by = factor[:, np.newaxis]
        root = None if self.root is None else self.root * by[:, np.newaxis]
        return replace(self, mean=self.mean * by, scale=self.scale * by, root=root)


@dataclass(frozen=True)
class PredictorGroup:
    """Outputs that share inducing points: with P = [V; Hᵀ], g(x) has mean ``mean @ P`` and deviation ``root @ P``.

    Attributes
    ----------
    outputs : slice or list of int
        o of them.
    kernel : Kernel
        k̃.
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
        model. The last p entries of root @ P are what comes from the weights.
    """

    outputs: Columns
    kernel: Kernel
    hyperparameters: np.ndarray
    points: np.ndarray
    whitening: Whitening
    signal: np.ndarray
    mean: np.ndarray
    root: np.ndarray

    @classmethod
    def of(
        cls,
        outputs: Columns,
        kernel: Kernel,
        hyperparameters: np.ndarray,
        points: np.ndarray,
        whitening: Whitening,
        signal: np.ndarray,
        prior: CoefficientPrior,
        mean: Sequence[np.ndarray],
        root: Sequence[np.ndarray],
    ) -> PredictorGroup:
        """From q(ω) of each output, ω = (v, w) whitened as in `bounds`, with these outputs' prior."""
        m, s = len(points), np.sqrt(signal)[:, np.newaxis]
        # T turns [V; Hᵀ] into Pᵀ of each output.
        own_mean, own_root = np.array(mean), np.array(root)
        own_mean[:, :m] *= s
        own_mean[:, m:] = prior.times(own_mean[:, m:])
        own_root[:, :, :m] *= s[:, np.newaxis]
        own_root[:, :, m:] = own_root[:, :, m:] @ prior.roots().transpose(0, 2, 1)
        return cls(outputs, kernel, hyperparameters, points, whitening, signal, own_mean, own_root)

    def scaled(self, factor: np.ndarray) -> PredictorGroup:
        """The same group for outputs in other units: y times ``factor`` (o,)."""
        by = factor[:, np.newaxis]
        return replace(self, signal=self.signal * factor**2, mean=self.mean * by, root=self.root * by[:, np.newaxis])

    def project(self, prepared: object, features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """P = [V; Hᵀ] of shape (m + p, n), and k̃(x, x) - |v|² of each row, not below its rounding error."""
        m = len(self.points)
        P = np.empty((m + features.shape[1], len(features)))
        V = self.whitening.solve(prepared, out=P[:m])
        P[m:] = features.T
        return P, self.whitening.remaining(prepared, V)


class Projected(NamedTuple):
    """Rows as a group of outputs sees them.

    Attributes
    ----------
    inputs : ndarray of shape (n, d)
    prepared : object
        What the kernel makes of them.
    P : ndarray of shape (m + p, n)
        [V; Hᵀ].
    unexplained : ndarray of shape (n,)
        k̃(x, x) - |v|², not below its rounding error.
    """

    inputs: np.ndarray
    prepared: Any
    P: np.ndarray
    unexplained: np.ndarray


@dataclass(frozen=True)
class Predictor:
    """Mean, variance and covariance of the noise-free g(x), and the weights (the paper's eq. prediction, with C free).

    Attributes
    ----------
    groups : tuple of PredictorGroup
        Of all outputs, each in one of them.
    noise : ndarray of shape (o,)
        σ².
    offset : ndarray of shape (o, p)
        What the groups' weights of features are added to.
    intercept : ndarray of shape (o,)
        What is added to the mean.
    shared : bool
        Whether outputs have the same weights, and so depend on each other.
    """

    groups: tuple[PredictorGroup, ...]
    noise: np.ndarray
    offset: np.ndarray
    intercept: np.ndarray
    shared: bool

    @classmethod
    def joined(
        cls,
        parts: Sequence[Predictor],
        outputs: Sequence[list[int]],
        unit: np.ndarray,
        offset: np.ndarray,
        intercept: np.ndarray,
    ) -> Predictor:
        """Predictors of some ``outputs`` each as one: each output times ``unit``, with another offset and intercept."""
        groups, noise = [], np.empty(len(unit))
        for part, columns in zip(parts, outputs, strict=True):
            noise[columns] = part.noise * unit[columns] ** 2
            for group in part.groups:
                own = np.array(columns)[group.outputs].tolist()
                groups.append(replace(group.scaled(unit[own]), outputs=own))
        return cls(tuple(groups), noise, offset, intercept, parts[0].shared)

    @property
    def rows_at_once(self) -> int:
        """How many rows to predict at once, so that memory stays small and products are large."""
        stacked = sum(group.mean.size for group in self.groups)
        return int(np.clip(_PREDICTED_NUMBERS // max(stacked, 1), 256, 4096))

    @property
    def signal(self) -> np.ndarray:
        """s² of each output, (o,)."""
        return self.in_order(group.signal for group in self.groups)

    @property
    def by_output(self) -> list[PredictorGroup]:
        """The group of each output."""
        found = {o: group for group in self.groups for o in np.arange(len(self.noise))[group.outputs]}
        return [found[o] for o in range(len(self.noise))]

    def predict(
        self, inputs: np.ndarray, features: np.ndarray, return_variance: bool = False
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Mean and variance of the noise-free g(x).

        Parameters
        ----------
        inputs : ndarray of shape (n, d) or (n, o, d)
            The kernel's.
        features : ndarray of shape (n, p) or (n, o, p)
            h(x).
        return_variance : bool, default=False

        Returns
        -------
        mean : ndarray of shape (n, o)
        variance : ndarray of shape (n, o), or None
        """
        return self.moments(self.projected(inputs, features), features, return_variance)

    def moments(
        self, projected: Iterable[Projected], features: np.ndarray, return_variance: bool
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """What `predict` returns, of rows as each group sees them."""
        means, variances = [], []
        for group, own in zip(self.groups, projected, strict=True):
            means.append(group.mean @ own.P)
            if return_variance:
                o, k, size = group.root.shape
                deviation = group.root.reshape(o * k, size) @ own.P
                np.multiply(deviation, deviation, out=deviation)
                squares = deviation.reshape(o, k, len(features)).sum(axis=1)
                variances.append(np.outer(group.signal, own.unexplained) + squares)
        mean = self.in_order(means).T
        mean += times_weights(features, self.offset)
        mean += self.intercept
        return mean, self.in_order(variances).T if return_variance else None

    def covariance(
        self, inputs: np.ndarray, features: np.ndarray, noise: np.ndarray | float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean (n, o) of g(x), and its covariance between rows (n, n, o), of each output.

        The diagonal is what `predict` says of the variance, and nothing is indefinite by more than rounding.

        Parameters
        ----------
        inputs, features : ndarray
            As of `predict`.
        noise : ndarray of shape (o,) or float, default=0.0
            A variance of each row by itself: with σ² it is the covariance of y.

        Returns
        -------
        mean : ndarray of shape (n, o)
        covariance : ndarray of shape (n, n, o)
        """
        mean, own, common = self._own_covariances(inputs, features, noise)
        covariance = np.empty((len(mean), *mean.shape))
        for output, (matrix, shared) in enumerate(zip(own, common, strict=True)):
            covariance[:, :, output] = nearest_covariance(matrix) + shared.T @ shared
        return mean, covariance

    def sample(
        self,
        inputs: np.ndarray,
        features: np.ndarray,
        noise: np.ndarray | float,
        n_samples: int,
        rng: np.random.RandomState,
    ) -> np.ndarray:
        """Draw from the distribution that `covariance` describes; arguments as there.

        Returns
        -------
        samples : ndarray of shape (n, o, n_samples)
        """
        mean, own, common = self._own_covariances(inputs, features, noise)
        # Of outputs that share their weights, what comes from these is one draw; all else is independent.
        of_weights = rng.standard_normal((common.shape[1], n_samples))
        samples = [
            own_mean[:, np.newaxis] + covariance_root(matrix) @ rng.standard_normal((len(mean), n_samples))
            for own_mean, matrix in zip(mean.T, own, strict=True)
        ]
        return np.stack([each + shared.T @ of_weights for each, shared in zip(samples, common, strict=True)], axis=1)

    def _own_covariances(
        self, inputs: np.ndarray, features: np.ndarray, noise: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean (n, o), covariances (o, n, n) but for what outputs have in common, and the root (o, k, n) of that."""
        size, n = self.rows_at_once, len(inputs)
        # In the blocks of `predict`: rounding depends on how many rows there are.
        parts = [self.predict(inputs[i : i + size], features[i : i + size], True) for i in range(0, n, size)]
        mean, variance = (np.concatenate(each) for each in zip(*parts, strict=True))
        projected = list(self.projected(inputs, features))
        common = self._common(projected)
        covariances = np.empty((len(self.noise), n, n))
        p = common.shape[1]
        for group, own in zip(self.groups, projected, strict=True):
            V = own.P[: len(group.points)]
            unexplained = group.kernel.at(np.log(group.hyperparameters), own.inputs).matrix() - V.T @ V
            found = np.empty((len(group.signal), n, n))
            for matrix, signal, root in zip(found, group.signal, group.root, strict=True):
                deviation = root[: len(root) - p] @ own.P
                matrix[...] = signal * unexplained + deviation.T @ deviation
            covariances[group.outputs] = found
        diagonals = (variance + noise).T - np.square(common).sum(axis=1)
        for matrix, diagonal in zip(covariances, diagonals, strict=True):
            diagonal_of(matrix)[...] = np.maximum(diagonal, 0.0)
        return mean, covariances, common

    def novelty(self, inputs: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Var[f(x) | data] / Var[f(x)] of each output, (n, o)."""
        parts = []
        for group, own in zip(self.groups, self.projected(inputs, features), strict=True):
            V = own.P[: len(group.points)]
            left = np.outer(group.signal, own.unexplained)
            left += np.square(group.root[:, :, : len(V)] @ V).sum(axis=1)
            prior = np.outer(group.signal, group.whitening.covariance.diagonal(own.prepared) * np.ones(len(features)))
            # Of a linear kernel at the origin there is nothing to know.
            parts.append(np.minimum(left / np.where(prior > 0.0, prior, np.inf), 1.0))
        return self.in_order(parts).T

    def common(self, inputs: np.ndarray, features: np.ndarray) -> np.ndarray:
        """What outputs with the same weights have in common: M (k, n, o) with the covariance M_iᵀ M_j of two of them.

        (Of B⁻¹ = R Rᵀ with R⁻¹ as in `bounds`, the rows of w; all else of an output is independent of the others.)
        """
        return self._common(self.projected(inputs, features)).transpose(1, 2, 0)

    def _common(self, projected: Iterable[Projected]) -> np.ndarray:
        """The same of rows as each group sees them, (o, k, n)."""
        p = self.offset.shape[1] if self.shared else 0
        return self.in_order(
            group.root[:, group.root.shape[1] - p :] @ own.P for group, own in zip(self.groups, projected, strict=True)
        )

    def jointly(self, covariance: np.ndarray, inputs: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Covariances (n, n, o) of each output as one (n o, n o) of all, outputs of a row next to each other."""
        n, _, o = covariance.shape
        common = self.common(inputs, features)
        between = np.einsum("kni,kmj->nimj", common, common, optimize=True)
        for output in range(o):
            between[:, output, :, output] = covariance[:, :, output]
        return between.reshape(n * o, n * o)

    def projected(self, inputs: np.ndarray, features: np.ndarray) -> Iterator[Projected]:
        """Rows as each group sees them."""
        prepared, kernel = None, None
        for group in self.groups:
            own = of_outputs(inputs, group.outputs)
            if inputs.ndim == 3 or group.kernel is not kernel:
                kernel = group.kernel
                prepared = kernel.prepare(own)
            yield Projected(own, prepared, *group.project(prepared, of_outputs(features, group.outputs)))

    def coefficients(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (o, p) and covariance (o, p, p) of β."""
        (o, p), mean = self.offset.shape, self.offset.copy()
        covariance = np.empty((o, p, p))
        for group in self.groups:
            m = len(group.points)
            mean[group.outputs] += group.mean[:, m:]
            deviation = group.root[:, :, m:]
            covariance[group.outputs] = deviation.transpose(0, 2, 1) @ deviation
        return mean, covariance

    def in_order(self, parts: Iterable[np.ndarray]) -> np.ndarray:
        """What each group has of its outputs, (o, ...) each, as one array of all outputs."""
        first, *others = parts
        if not others:
            return first
        found = np.empty((len(self.noise), *first.shape[1:]))
        for group, part in zip(self.groups, (first, *others), strict=True):
            found[group.outputs] = part
        return found
