"""The prior of the weights, and the fitted model with all that predictions need."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from ..data.rows import Columns, of_outputs, times_weights
from ..utils.linalg import covariance_root, diagonal_of, nearest_covariance
from .conditioning import Conditioned, KnownRows
from .parameters import Values
from .roots import BlockRoot, last_rows, times
from .statistics import Kernel


class AnyWhitening(Protocol):
    """What predictions need of a `Whitening`, whose methods these are."""

    @property
    def covariance(self) -> Any: ...
    @property
    def L(self) -> np.ndarray: ...
    @property
    def L_inv(self) -> np.ndarray: ...
    def times_inverse(self, U: np.ndarray) -> np.ndarray: ...
    def times_inverse_transposed(self, U: np.ndarray) -> np.ndarray: ...
    def solve(self, prepared: Any, out: np.ndarray) -> np.ndarray: ...
    def remaining(self, prepared: Any, V: np.ndarray) -> np.ndarray: ...


# Predictions of several rows at once take arrays of about this many numbers.
_PREDICTED_NUMBERS = 2**20


@dataclass(frozen=True)
class CoefficientPrior:
    """β ~ N(mean, C Cᵀ) of each of o outputs with p features, where β = mean + C (w₀ + w)."""

    # (o, p): the means and standard deviations of β.
    mean: np.ndarray
    scale: np.ndarray
    # (o, p): w₀. Residuals are y - H (mean + C w₀).
    reference: np.ndarray
    # (o, p, p): C. None: diag(scale), for independent weights.
    root: np.ndarray | None = None
    # Whether all outputs have the same w, and so the same β in the user's units. Rows of the arrays then differ by the
    # units of the outputs only.
    shared: bool = False
    # Names of the groups of weights whose scales are parameters, and (o, p) the group of each weight. -1: its scale
    # stays. C has no entries between groups.
    labels: tuple[str, ...] = ()
    groups: np.ndarray | None = None

    @property
    def n_groups(self) -> int:
        """Number of groups of weights with a scale that is learned."""
        return len(self.labels)

    def at(self, values: Values) -> CoefficientPrior:
        """The prior with the scales of groups times the factors (o, g) in ``values``, and the same offset.

        Shared weights have one row of factors.
        """
        if self.groups is None or "coef_factors" not in values:
            return self
        factors = np.broadcast_to(values["coef_factors"], (len(self.scale), self.n_groups))
        by = np.take_along_axis(np.hstack([factors, np.ones((len(factors), 1))]), self.groups, axis=1)
        root = None if self.root is None else self.root * by[:, :, np.newaxis]
        return replace(self, scale=self.scale * by, reference=self.reference / by, root=root)

    def of_groups(self, numbers: np.ndarray) -> np.ndarray:
        """Sums (o, g) over the weights of each group of numbers (o, p). Shared weights have one row, the first."""
        assert self.groups is not None
        sums = np.zeros((len(numbers), self.n_groups + 1))
        for sums_of_output, numbers_of_output, groups_of_output in zip(sums, numbers, self.groups, strict=True):
            np.add.at(sums_of_output, groups_of_output, numbers_of_output)
        return sums[:1, :-1] if self.shared else sums[:, :-1]

    @property
    def offset(self) -> np.ndarray:
        """The coefficients mean + C w₀ (o, p) at which the residuals are taken."""
        return self.mean + self.times(self.reference)

    def times(self, w: np.ndarray) -> np.ndarray:
        """C w of each output, (o, p)."""
        return self.scale * w if self.root is None else np.einsum("oij,oj->oi", self.root, w)

    def roots(self) -> np.ndarray:
        """C of each output, (o, p, p)."""
        return self.scale[:, :, np.newaxis] * np.eye(self.scale.shape[1]) if self.root is None else self.root

    def outputs(self, columns: Columns) -> CoefficientPrior:
        """The prior of some of the outputs."""
        return replace(
            self,
            mean=self.mean[columns],
            scale=self.scale[columns],
            reference=self.reference[columns],
            root=None if self.root is None else self.root[columns],
            groups=None if self.groups is None else self.groups[columns],
        )

    def scaled(self, factor: np.ndarray) -> CoefficientPrior:
        """The prior of ``factor`` (o,) times β, with the same w."""
        by = factor[:, np.newaxis]
        root = None if self.root is None else self.root * by[:, np.newaxis]
        return replace(self, mean=self.mean * by, scale=self.scale * by, root=root)


@dataclass(frozen=True)
class PredictorGroup:
    """Outputs that share m inducing points. With P = [V; Hᵀ] (m + p, n), g(x) has the mean ``mean @ P``.

    The variance of g(x) is |root @ P|² + s² (k̃(x, x) - |v|²).
    """

    # o of the outputs.
    outputs: Columns
    # k̃ and its hyperparameters (n_hyper,).
    kernel: Kernel
    hyperparameters: np.ndarray
    # (m, d), and their whitening.
    points: np.ndarray
    whitening: AnyWhitening
    # (o,): s².
    signal: np.ndarray
    # (o, m + p).
    mean: np.ndarray
    # (o, k, m + p), where k is m + p, or less in the exact model. The last p of the k rows belong to the weights.
    # Of a mixture it is a `BlockRoot`.
    root: Any
    # (o, p, m): if f is orthogonal to the features, the weights of the best fit are those of ``mean`` and ``root`` plus
    # this times the numbers of f. None: they are those of ``mean`` and ``root``.
    leak: np.ndarray | None = None
    # The rows on which the residual of the inducing points is conditioned, for one output. V, H and k̃(x, x) - |v|² are
    # then those of the differences of `conditioning`. None: there is no local part.
    near: KnownRows | None = None

    @classmethod
    def of(
        cls,
        outputs: Columns,
        kernel: Kernel,
        hyperparameters: np.ndarray,
        points: np.ndarray,
        whitening: AnyWhitening,
        signal: np.ndarray,
        prior: CoefficientPrior,
        mean: Sequence[np.ndarray],
        root: Sequence[np.ndarray],
        leaks: Sequence[np.ndarray] | None = None,
    ) -> PredictorGroup:
        """The group for q(ω) of each output, with ω = (v, w) as in `bounds`: mean (m + p,) and root (k, m + p).

        With ``leaks`` (p, m), ω = (v, w⊥) of `bounds.Group.leaks`.
        """
        m, s = len(points), np.sqrt(signal)[:, np.newaxis]
        # mean Tᵀ and root Tᵀ, with T = blockdiag(s I, C) of each output (see `bounds.Group.times_T`).
        means, roots, leak = np.array(mean), np.array(root), None
        if leaks is not None:
            # w = w⊥ - leak v, and in the predictor's coordinates β⊥ = β + (C leak / s) (s v).
            leaks_of_outputs = np.array(leaks)
            means[:, m:] -= np.einsum("opm,om->op", leaks_of_outputs, means[:, :m])
            roots[:, :, m:] -= np.einsum("okm,opm->okp", roots[:, :, :m], leaks_of_outputs)
            leak = prior.roots() @ leaks_of_outputs / s[:, np.newaxis]
        means[:, :m] *= s
        means[:, m:] = prior.times(means[:, m:])
        roots[:, :, :m] *= s[:, np.newaxis]
        roots[:, :, m:] = roots[:, :, m:] @ prior.roots().transpose(0, 2, 1)
        return cls(
            outputs=outputs,
            kernel=kernel,
            hyperparameters=hyperparameters,
            points=points,
            whitening=whitening,
            signal=signal,
            mean=means,
            root=roots,
            leak=leak,
        )

    def weight_roots(self) -> np.ndarray:
        """Roots (o, k, p) of the covariance of the weights. They are those of the best fit if f is orthogonal."""
        m = len(self.points)
        if isinstance(self.root, BlockRoot):
            return self.root.of_weights()
        roots = self.root[:, :, m:]
        return roots if self.leak is None else roots + np.einsum("okm,opm->okp", self.root[:, :, :m], self.leak)


class Projected(NamedTuple):
    """Rows as a group of outputs sees them."""

    # (n, d), and the result of the kernel's ``prepare``.
    inputs: np.ndarray
    prepared: Any
    # (m + p, n): [V; Hᵀ].
    P: np.ndarray
    # (n,): k̃(x, x) - |v|², clipped at its rounding error.
    unexplained: np.ndarray
    # (n,): the part of the mean from the nearest rows.
    from_near: np.ndarray | float = 0.0


@dataclass(frozen=True)
class Predictor:
    """Mean, variance and covariance of the noise-free g(x), and the weights (the paper's eq. prediction, for any C)."""

    # Each output is in one of them.
    groups: tuple[PredictorGroup, ...]
    # (o,): σ².
    noise: np.ndarray
    # (o, p): added to the weights of the groups.
    offset: np.ndarray
    # (o,): added to the mean.
    intercept: np.ndarray
    # Whether outputs share their weights and are therefore correlated.
    shared: bool
    # Number of rows at the end of the roots that belong to the same numbers for all outputs with own weights: those of
    # parameters θ of the features, or of the draws of a mixture.
    n_theta: int = 0

    @property
    def n_common(self) -> int:
        """Number of rows at the end of the roots that belong to the same numbers for all outputs."""
        return self.offset.shape[1] if self.shared else self.n_theta

    def with_theta(self, K: np.ndarray) -> Predictor:
        """The predictor whose outputs are correlated by the z - ẑ of `model.weights`, given K (o, d, q) of each output.

        It is the same predictor if outputs share their weights, or if those of an output do not determine z.
        """
        o, d, q = K.shape
        if o == 1 or self.shared or q == 0 or min(map(np.linalg.matrix_rank, K)) < q:
            return self
        # The weights of the last d columns are K (z - ẑ), so that z - ẑ is K⁺ times them, and has the root Δ (k, q).
        # With Δ = Q R, the last q rows of a rotated root can be those of z, and R is the same for all outputs.
        groups = []
        for group in self.groups:
            roots, of_weights = [], group.weight_roots()[:, :, -d:]
            for root, weights, K_of_output in zip(group.root, of_weights, K[group.outputs], strict=True):
                Q, R = np.linalg.qr(weights @ np.linalg.pinv(K_of_output).T, mode="complete")
                signs = np.where(np.diagonal(R) < 0.0, -1.0, 1.0)
                roots.append(np.concatenate([Q[:, q:], Q[:, :q] * signs], axis=1).T @ root)
            groups.append(replace(group, root=np.array(roots)))
        return replace(self, groups=tuple(groups), n_theta=q)

    @classmethod
    def joined(
        cls,
        parts: Sequence[Predictor],
        outputs: Sequence[list[int]],
        unit: np.ndarray,
        offset: np.ndarray,
        intercept: np.ndarray,
    ) -> Predictor:
        """One predictor from several, where ``outputs`` are those of each part.

        Each output is multiplied by ``unit`` (o,). Offset and intercept replace those of the parts.
        """
        groups, noise = [], np.empty(len(unit))
        for part, columns in zip(parts, outputs, strict=True):
            noise[columns] = part.noise * unit[columns] ** 2
            for group in part.groups:
                columns_of_group = np.array(columns)[group.outputs].tolist()
                by = unit[columns_of_group][:, np.newaxis]
                signal = group.signal * unit[columns_of_group] ** 2
                mean, root = group.mean * by, group.root * by[:, np.newaxis]
                near = None if group.near is None else group.near.scaled(float(by[0, 0]))
                groups.append(replace(group, outputs=columns_of_group, signal=signal, mean=mean, root=root, near=near))
        # Only the draws of one model are the same for all outputs.
        n_shared = parts[0].n_theta if len(parts) == 1 else 0
        return cls(tuple(groups), noise, offset, intercept, parts[0].shared, n_shared)

    @property
    def rows_at_once(self) -> int:
        """Number of rows to predict at once, so that arrays are small and matrix products large."""
        stacked = sum(group.mean.size for group in self.groups)
        return int(np.clip(_PREDICTED_NUMBERS // max(stacked, 1), 256, 4096))

    @property
    def signal(self) -> np.ndarray:
        """s² of each output, (o,)."""
        return self.in_order(group.signal for group in self.groups)

    @property
    def by_output(self) -> list[PredictorGroup]:
        """The group of each output."""
        groups = {o: group for group in self.groups for o in np.arange(len(self.noise))[group.outputs]}
        return [groups[o] for o in range(len(self.noise))]

    def predict(
        self, inputs: np.ndarray, features: np.ndarray, return_variance: bool = False
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Mean (n, o) of the noise-free g(x) and, if asked for, its variance (n, o).

        ``inputs`` of the kernel are (n, d) or (n, o, d). ``features`` h(x) are (n, p) or (n, o, p).
        """
        means, variances = [], []
        for group, rows in zip(self.groups, self.projected(inputs, features), strict=True):
            means.append(group.mean @ rows.P + rows.from_near)
            if return_variance:
                deviation = times(group.root, rows.P)
                np.multiply(deviation, deviation, out=deviation)
                squares = deviation.sum(axis=1)
                variances.append(np.outer(group.signal, rows.unexplained) + squares)
        mean = self.in_order(means).T
        mean += times_weights(features, self.offset)
        mean += self.intercept
        return mean, self.in_order(variances).T if return_variance else None

    def unexplained(self, inputs: np.ndarray, features: np.ndarray) -> np.ndarray:
        """The part s² (k̃(x, x) - |v|²) (n, o) of the variance that the inducing points do not explain."""
        pairs = zip(self.groups, self.projected(inputs, features), strict=True)
        return self.in_order(np.outer(group.signal, rows.unexplained) for group, rows in pairs).T

    def covariance(
        self, inputs: np.ndarray, features: np.ndarray, noise: np.ndarray | float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean (n, o) of g(x), and its covariance (n, n, o) between rows, for each output.

        The diagonal is the variance from `predict`. The matrices are positive semi-definite up to rounding. ``noise``
        (o,) is added to the diagonal: with σ² it is the covariance of y.
        """
        mean, covariances, sizes, common = self._own_covariances(inputs, features, noise)
        covariance = np.empty((len(mean), *mean.shape))
        for output, (matrix, size, shared) in enumerate(zip(covariances, sizes, common, strict=True)):
            covariance[:, :, output] = nearest_covariance(matrix, size) + shared.T @ shared
        return mean, covariance

    def sample(
        self,
        inputs: np.ndarray,
        features: np.ndarray,
        noise: np.ndarray | float,
        n_samples: int,
        rng: np.random.RandomState,
    ) -> np.ndarray:
        """Draws (n, o, n_samples) from the distribution with the moments of `covariance`."""
        mean, covariances, sizes, common = self._own_covariances(inputs, features, noise)
        # Outputs that share their weights share one draw of them. Their other parts are independent.
        of_weights = rng.standard_normal((common.shape[1], n_samples))
        samples = [
            mean_of_output[:, np.newaxis] + covariance_root(matrix, size) @ rng.standard_normal((len(mean), n_samples))
            for mean_of_output, matrix, size in zip(mean.T, covariances, sizes, strict=True)
        ]
        return np.stack([draws + shared.T @ of_weights for draws, shared in zip(samples, common, strict=True)], axis=1)

    def _own_covariances(
        self, inputs: np.ndarray, features: np.ndarray, noise: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Mean (n, o), covariance (o, n, n) without the part of shared weights, and the root (o, k, n) of that part.

        The third array has the sizes (o, n) of the terms on the diagonal of the covariance.
        """
        size, n = self.rows_at_once, len(inputs)
        # In parts as in `predict`, because rounding depends on the number of rows.
        parts = [self.predict(inputs[i : i + size], features[i : i + size], True) for i in range(0, n, size)]
        mean, variance = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        projected = list(self.projected(inputs, features))
        common = self._common(projected)
        covariances, sizes = np.empty((len(self.noise), n, n)), np.empty((len(self.noise), n))
        p = common.shape[1]
        for group, rows in zip(self.groups, projected, strict=True):
            V = rows.P[: len(group.points)]
            K = group.kernel.at(group.hyperparameters, rows.inputs).matrix()
            prior = diagonal_of(K)
            unexplained = K - V.T @ V if group.near is None else group.near.covariance(rows.inputs)
            matrices, terms = np.empty((len(group.signal), n, n)), np.empty((len(group.signal), n))
            deviations = times(group.root, rows.P)
            deviations = deviations[:, : deviations.shape[1] - p]
            each = zip(matrices, terms, group.signal, deviations, strict=True)
            for matrix, sizes_of_output, signal, deviation in each:
                matrix[...] = signal * unexplained + deviation.T @ deviation
                sizes_of_output[...] = signal * prior + np.square(deviation).sum(axis=0)
            covariances[group.outputs], sizes[group.outputs] = matrices, terms
        of_weights = np.square(common).sum(axis=1)
        diagonals, sizes = (variance + noise).T - of_weights, sizes + of_weights
        for matrix, diagonal in zip(covariances, diagonals, strict=True):
            diagonal_of(matrix)[...] = np.maximum(diagonal, 0.0)
        return mean, covariances, sizes, common

    def novelty(self, inputs: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Var[f(x) | data] / Var[f(x)] (n, o)."""
        parts = []
        for group, rows in zip(self.groups, self.projected(inputs, features), strict=True):
            V = rows.P[: len(group.points)]
            left = np.outer(group.signal, rows.unexplained)
            of_points = np.concatenate([V, np.zeros((len(rows.P) - len(V), V.shape[1]))])
            left += np.square(times(group.root, of_points)).sum(axis=1)
            prior = np.outer(group.signal, group.whitening.covariance.diagonal(rows.prepared) * np.ones(len(features)))
            # A linear kernel has no variance at the origin.
            parts.append(np.minimum(left / np.where(prior > 0.0, prior, np.inf), 1.0))
        return self.in_order(parts).T

    def common(self, inputs: np.ndarray, features: np.ndarray) -> np.ndarray:
        """M (k, n, o), where M_iᵀ M_j is the covariance of outputs i and j. If they share nothing, k is 0."""
        return self._common(self.projected(inputs, features)).transpose(1, 2, 0)

    def _common(self, projected: Iterable[Projected]) -> np.ndarray:
        """M of `common` as (o, k, n), for rows as each group sees them."""
        # With B⁻¹ = RᵀR and R = root_inv of `bounds`, M consists of the rows of w. The other parts of outputs are
        # independent.
        p = self.n_common
        return self.in_order(
            times(last_rows(group.root, p), rows.P) for group, rows in zip(self.groups, projected, strict=True)
        )

    def jointly(self, covariance: np.ndarray, inputs: np.ndarray, features: np.ndarray) -> np.ndarray:
        """The covariance (n o, n o) of all outputs, from those of each (n, n, o). Outputs of a row are consecutive."""
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
            inputs_of_group = of_outputs(inputs, group.outputs)
            if inputs.ndim == 3 or group.kernel is not kernel:
                kernel = group.kernel
                prepared = kernel.prepare(inputs_of_group)
            H, m = of_outputs(features, group.outputs), len(group.points)
            P = np.empty((m + H.shape[1], len(H)))
            V = group.whitening.solve(prepared, out=P[:m])
            P[m:] = H.T
            if group.near is None:
                yield Projected(inputs_of_group, prepared, P, group.whitening.remaining(prepared, V))
            else:
                yield Projected(inputs_of_group, prepared, P, *_conditioned(group.near, inputs_of_group, P))

    def coefficients(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (o, p) and covariance (o, p, p) of β."""
        (o, p), mean = self.offset.shape, self.offset.copy()
        covariance = np.empty((o, p, p))
        for group in self.groups:
            m = len(group.points)
            weights, deviation = group.mean[:, m:], group.weight_roots()
            if group.leak is not None:
                weights = weights + np.einsum("opm,om->op", group.leak, group.mean[:, :m])
            mean[group.outputs] += weights
            covariance[group.outputs] = deviation.transpose(0, 2, 1) @ deviation
        return mean, covariance

    def in_order(self, parts: Iterable[np.ndarray]) -> np.ndarray:
        """One array of all outputs (o, ...) from those of each group, in the order of the outputs."""
        first, *others = parts
        if not others:
            return first
        ordered = np.empty((len(self.noise), *first.shape[1:]))
        for group, part in zip(self.groups, (first, *others), strict=True):
            ordered[group.outputs] = part
        return ordered


def _conditioned(near: KnownRows, inputs: np.ndarray, P: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turn P = [V; Hᵀ] of rows into that of their differences, and return their variance and the mean of near rows."""
    latent, mean = np.empty(len(inputs)), np.empty(len(inputs))

    def put(rows: slice, found: Conditioned) -> None:
        P[:, rows], mean[rows], latent[rows] = found.differences[:, :-1].T, -found.differences[:, -1], found.latent

    near.for_new(put, inputs, P.T)
    return latent, mean
