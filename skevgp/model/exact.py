"""The exact model with explicit features: likelihood, gradient and posterior (Rasmussen & Williams 2006, section 2.7).

For each output, let ρ = σ²/s², L Lᵀ = K̃ + ρ I (n, n) and Σ_β = C Cᵀ (p, p). As in `bounds`, β = μ_β + C (w₀ + w) and
r = y - H (μ_β + C w₀). The whitened rows are z = L⁻¹ r / s (n,) and W = L⁻¹ H C / s (n, p). Integrating β out gives

    -2 log p(y) = (n - k) log 2π + log|s² L Lᵀ| + log|B| + |z - W w|² + |D (w + w₀)|² - 2 Σ_vague log c,
    B = D + WᵀW (p, p),   w = B⁻¹ (Wᵀz - D w₀) (p,),   posterior of the weights: N(w, B⁻¹).

D is I, with zeros for the k weights whose prior is vague, Σ_β → ∞. For these, c is a unit, and the likelihood is that
of n - k contrasts (eq. 2.45 there, without the infinite log|Σ_β|). A QR factorisation of [W; D] gives B without
squaring its condition number. If outputs share their weights, their W and z are stacked.

Predictions are those of a sparse model whose inducing points are the rows and whose factor is the L above (eq. 2.41 and
2.42). With V = L⁻¹ k̃(X, x) and B = RᵀR,

    mean of g(x): Vᵀ (s (z - W w)) + h(x)ᵀβ,
    variance of g(x): s² (k̃(x, x) - |V|²) + |R⁻ᵀ (Cᵀ h(x) - s Wᵀ V)|².

A row with the noise variance σ² v has ρ v instead of ρ on the diagonal. A row that counts w times equals a row with the
noise variance σ² v / w, times the constant factor by which w copies of it differ:

    N(y | g, σ² v)^w = N(y | g, σ² v / w) (2πσ² v)^(-(w - 1)/2) w^(-1/2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import lapack

from ..data.rows import RawRows
from ..utils.linalg import (
    NotPositiveDefiniteError,
    diagonal_of,
    jittered_cholesky,
    symmetric_inverse,
    triangular_inverse,
)
from .bounds import LOG_2PI
from .model import SparseModel
from .parameters import ParameterTable, Values, log_prior
from .predictor import CoefficientPrior, Predictor, PredictorGroup
from .statistics import Kernel, Whitening
from .weights import WeightLikelihood, likelihood_of_whitened


class OutputGivenKernel:
    """Likelihood and posterior of one output, given K̃ (n, n), H (n, p) and the residuals r (n,).

    ``vague`` (p,) marks weights with Σ_β → ∞. ``relative`` (n,) are noise variances v / w in units of σ². None: all 1.
    `join` must be called before anything is asked.
    """

    # Set by `join`. R (p, p) with B = RᵀR, its inverse, and w (p,).
    R: np.ndarray
    R_inv: np.ndarray
    w: np.ndarray
    # z - W w (n,) and D (w + w₀) (p,).
    errors: np.ndarray
    from_prior: np.ndarray
    # Whether terms of w count for this output. If outputs share w, they count for the first.
    is_first: bool

    def __init__(
        self,
        K: np.ndarray,
        H: np.ndarray,
        r: np.ndarray,
        signal: float,
        noise: float,
        prior: CoefficientPrior,
        vague: np.ndarray,
        relative: np.ndarray | None = None,
    ):
        self.signal, self.noise, self.ratio = signal, noise, noise / signal
        shifted = K.copy()
        diagonal_of(shifted)[...] += self.ratio if relative is None else self.ratio * relative
        self.L = jittered_cholesky(shifted)
        self.L_inv = triangular_inverse(self.L)
        s = np.sqrt(signal)
        self.vague, self.scale, self.reference, self.relative = vague, prior.scale[0], prior.reference[0], relative
        self.W = self.L_inv @ (H * (self.scale / s) if prior.root is None else H @ (prior.root[0] / s))
        self.z = self.L_inv @ (r / s)

    @staticmethod
    def join(outputs: Sequence[OutputGivenKernel]) -> None:
        """Compute the weights w that some outputs share, from all of their rows."""
        proper, reference = ~outputs[0].vague, outputs[0].reference
        if not len(proper):
            for output in outputs:
                output.R = output.R_inv = np.empty((0, 0))
                output.w = output.from_prior = np.empty(0)
                output.errors, output.is_first = output.z, output is outputs[0]
            return
        # [W; D] w = [z; -D w₀] by least squares.
        Q, R = np.linalg.qr(np.vstack([*(output.W for output in outputs), np.diag(proper.astype(float))]))
        R_inv = lapack.dtrtri(R)[0]
        wanted = Q.T @ np.concatenate([*(output.z for output in outputs), np.where(proper, -reference, 0.0)])
        # A solve instead of the inverse: features of 1e16 times the noise would multiply the errors of the inverse.
        w = lapack.dtrtrs(R, wanted)[0]
        for output in outputs:
            output.R, output.R_inv, output.w, output.is_first = R, R_inv, w, output is outputs[0]
            output.errors = output.z - output.W @ w
            output.from_prior = proper * (w + reference)

    @property
    def log_likelihood(self) -> float:
        """The log likelihood of the residuals, in nats."""
        n_contrasts = len(self.L)
        log_det = len(self.L) * np.log(self.signal) + 2.0 * np.log(np.diagonal(self.L)).sum()
        squares = self.errors @ self.errors
        if self.is_first:
            n_contrasts -= self.vague.sum()
            log_det += 2.0 * (np.log(np.abs(np.diagonal(self.R))).sum() - np.log(self.scale[self.vague]).sum())
            squares += self.from_prior @ self.from_prior
        return float(-0.5 * (n_contrasts * LOG_2PI + log_det + squares))

    def gradient(self) -> tuple[np.ndarray, float, float]:
        """Gradients of the log likelihood in K̃ (n, n), which is symmetric, in log s² and in log σ²."""
        # In y's covariance the gradient is ½ (α αᵀ - P), with α = (s² L Lᵀ)⁻¹ (r - H C w) (n,) and P (n, n) the inverse
        # of the covariance of this output's rows, or its limit for vague weights. Here α and P are in units of 1/s and
        # 1/s². In their own units, α² may overflow.
        alpha, n = self.L_inv.T @ self.errors, len(self.L)
        P, explained = symmetric_inverse(self.L_inv), 0.0
        if len(self.R):
            WR = self.W @ self.R_inv
            from_weights, explained = self.L_inv.T @ WR, float(np.vdot(WR, WR))
            P -= from_weights @ from_weights.T
        in_noise = alpha**2 - diagonal_of(P)
        squares = float(self.errors @ self.errors)
        noise_bar = 0.5 * self.ratio * float(in_noise.sum() if self.relative is None else in_noise @ self.relative)
        P *= -1.0
        P += np.multiply.outer(alpha, alpha)
        P *= 0.5
        return P, 0.5 * (squares - n + explained) - noise_bar, noise_bar

    def posterior(self) -> tuple[np.ndarray, np.ndarray]:
        """The mean (n + p,) of ω = (v, w), and a root (max(p, 1), n + p) of its covariance."""
        root = np.zeros((1, len(self.L)))
        if len(self.R):
            root = np.hstack([-(self.W @ self.R_inv).T, self.R_inv.T])
        return np.concatenate([self.errors, self.w]), root


# The kernel at the rows with its matrix, for all outputs or for each, and each output given it.
OutputsGivenKernel = tuple[list[tuple[Any, np.ndarray]], list[OutputGivenKernel]]


@dataclass(frozen=True)
class ExactModel:
    """Covariance, prior and rows of o outputs: likelihood, gradient and posterior at given parameters."""

    # k̃, common to all outputs.
    kernel: Kernel
    # If weights are vague, their prior scale is a unit.
    prior: CoefficientPrior
    # (o, p): whether the prior of each weight is vague.
    vague: np.ndarray
    # All rows, in internal units.
    rows: RawRows
    # k̃ of each output, if outputs have inputs of their own.
    kernels: tuple[Kernel, ...] | None = None

    @classmethod
    def of(cls, sparse: SparseModel, vague: np.ndarray, rows: RawRows) -> ExactModel:
        """The exact model of the same kernel and weights, of which some are ``vague`` (o, p), for all ``rows``."""
        kernels = None
        if sparse.kernels is not None and rows.inputs.ndim == 3:
            kernels = tuple(sparse.kernels[sparse.group_of(output)] for output in range(len(vague)))
        return cls(sparse.kernel, sparse.prior, vague, rows, kernels)

    @property
    def n_contrasts(self) -> np.ndarray:
        """Number of residuals (o,) whose density the likelihood is: a vague weight uses up one of them."""
        return n_contrasts(self.rows.total, self.vague, self.prior.shared)

    def with_fewer_features(self) -> ExactModel:
        """The model of the same likelihood with at most as many features as rows in each group of weights.

        Shared or vague weights stay.
        """
        # With the QR factorisation H C = Rᵀ Qᵀ of a group, Q (p, n) and R (n, n), the rows depend on Qᵀ w ~ N(-Qᵀ w₀,
        # I) only. So Rᵀ replaces H, and Qᵀ w₀ replaces w₀. The group's factor multiplies both.
        (o, p), n = self.prior.scale.shape, len(self.rows.inputs)
        groups = np.full((o, p), -1) if self.prior.groups is None else self.prior.groups
        largest = max(np.count_nonzero(row == group) for row in groups for group in np.unique(row)) if p else 0
        if largest <= n or self.prior.shared or self.vague.any():
            return self
        reduced: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        for index, (scale, w0) in enumerate(zip(self.prior.scale, self.prior.reference, strict=True)):
            H = self.rows.of(slice(index, index + 1)).features
            A = (H * scale if self.prior.root is None else H @ self.prior.root[index]).T
            parts = []
            for group in np.unique(groups[index]):
                members = np.flatnonzero(groups[index] == group)
                features, reference = A[members].T, w0[members]
                if len(members) > n:
                    # With large rows first, each row keeps its digits (Higham 2002, section 19.4).
                    members = members[np.argsort(-np.abs(A[members]).max(axis=1))]
                    Q, R = np.linalg.qr(A[members])
                    features, reference = R.T, Q.T @ w0[members]
                parts.append((features, reference, np.full(len(reference), group)))
            every_feature, every_reference, every_group = zip(*parts, strict=True)
            reduced.append(
                (np.concatenate(every_feature, axis=1), np.concatenate(every_reference), np.concatenate(every_group))
            )
        # Outputs may have different numbers of features: others are 0.
        width = max(len(reference) for _, reference, _ in reduced)
        features, reference = np.zeros((n, o, width)), np.zeros((o, width))
        labels = np.full((o, width), -1)
        for index, (H, w0, groups_of_output) in enumerate(reduced):
            k = len(w0)
            features[:, index, :k], reference[index, :k], labels[index, :k] = H, w0, groups_of_output
        prior = CoefficientPrior(
            np.zeros((o, width)),
            np.ones((o, width)),
            reference,
            labels=self.prior.labels,
            groups=None if self.prior.groups is None else labels,
        )
        rows = replace(self.rows, features=features)
        return replace(self, prior=prior, vague=np.zeros((o, width), dtype=bool), rows=rows)

    def outputs(self, values: Values) -> OutputsGivenKernel:
        """The kernel at the rows with its matrix, for all outputs or for each, and each output given it."""
        hyperparameters, o = values["hyperparameters"], len(self.vague)
        prior = self.prior.at(values)
        rows_by_output = [self.rows.of(slice(output, output + 1)) for output in range(o)]
        relative = None if self.rows.precision is None else 1.0 / self.rows.precision
        covariances = [
            kernel.at(hyperparameters, rows.inputs)
            for kernel, rows in zip(self.kernels or (self.kernel,), rows_by_output, strict=False)
        ]
        matrices = [(at, at.matrix()) for at in covariances]
        outputs = [
            OutputGivenKernel(
                K=matrices[index % len(matrices)][1],
                H=rows.features,
                r=rows.targets[:, 0],
                signal=values["signal"][index],
                noise=values["noise"][index],
                prior=prior.outputs(slice(index, index + 1)),
                vague=self.vague[index],
                relative=relative,
            )
            for index, rows in enumerate(rows_by_output)
        ]
        for together in [outputs] if self.prior.shared else [[output] for output in outputs]:
            OutputGivenKernel.join(together)
        return matrices, outputs

    def log_likelihoods(self, values: Values, outputs: OutputsGivenKernel | None = None) -> np.ndarray:
        """The log likelihood (o,) of each output, in nats, or -inf if it cannot be computed.

        Shared weights count for the first output. ``outputs`` are computed if they are None.
        """
        try:
            _, given_kernel = self.outputs(values) if outputs is None else outputs
            return np.array([output.log_likelihood for output in given_kernel]) + self._of_copies(values)
        except NotPositiveDefiniteError:
            return np.full(len(self.vague), -np.inf)

    def log_likelihood(self, values: Values) -> tuple[float, Values]:
        """The log likelihood of all outputs, in nats, and its gradient in the logarithms of the values."""
        covariances, outputs = self.outputs(values)
        total = float(self._of_copies(values).sum())
        gradient = {name: np.zeros_like(value) for name, value in values.items()}
        K_bars = np.zeros((len(covariances), *outputs[0].L.shape))
        for index, output in enumerate(outputs):
            total += output.log_likelihood
            K_bar, gradient["signal"][index], gradient["noise"][index] = output.gradient()
            K_bars[index % len(K_bars)] += K_bar
            if "coef_factors" in values and (output.is_first or not self.prior.shared):
                # E[z²] - 1 of each weight, as in `bounds.BoundAtOptimum`.
                factors = output.from_prior**2 + (output.R_inv**2).sum(axis=1) - 1.0
                of_groups = self.prior.outputs(slice(index, index + 1)).of_groups(factors[np.newaxis])
                gradient["coef_factors"][0 if self.prior.shared else index] += of_groups[0]
        # The factor for copies of rows has the power -Σ (w - 1) / 2 of σ².
        gradient["noise"] -= 0.5 * (self.rows.total - len(self.rows.inputs))
        for (at, K), K_bar in zip(covariances, K_bars, strict=True):
            gradient["hyperparameters"] += at.hyper_gradient(K, K_bar)
        return total, gradient

    def _of_copies(self, values: Values) -> np.ndarray:
        """The log (o,) of the constant factor for rows that count w times (see the top of this file)."""
        w, noise = self.rows.counts, values["noise"]
        if w is None or self.rows.precision is None:
            return np.zeros(len(noise))
        constant = float((w - 1.0) @ (LOG_2PI + np.log(w / self.rows.precision)) + np.log(w).sum())
        return -0.5 * (constant + (self.rows.total - len(self.rows.inputs)) * np.log(noise))

    def weight_likelihoods(self, values: Values) -> list[WeightLikelihood]:
        """The likelihood of the weights of each output, with f integrated out."""
        likelihoods = []
        for index, output in enumerate(self.outputs(values)[1]):
            rows, root_inv = self.rows.of(slice(index, index + 1)), output.L_inv / np.sqrt(output.signal)
            likelihoods.append(likelihood_of_whitened(root_inv @ rows.features, root_inv @ rows.targets[:, 0]))
        return likelihoods

    def predictor(self, values: Values, outputs: OutputsGivenKernel | None = None) -> Predictor:
        """The predictor in internal units. Its inducing points are the rows. ``outputs`` are computed if None."""
        covariances, given_kernel = self.outputs(values) if outputs is None else outputs
        groups = []
        for index, output in enumerate(given_kernel):
            columns, (mean, root) = slice(index, index + 1), output.posterior()
            groups.append(
                PredictorGroup.of(
                    outputs=columns,
                    kernel=self.kernel if self.kernels is None else self.kernels[index],
                    hyperparameters=values["hyperparameters"],
                    points=self.rows.of(columns).inputs,
                    whitening=Whitening(covariances[index % len(covariances)][0], output.L, output.L_inv),
                    signal=values["signal"][columns],
                    prior=self.prior.at(values).outputs(columns),
                    mean=[mean],
                    root=[root],
                )
            )
        offset = self.prior.offset
        return Predictor(tuple(groups), values["noise"], offset, np.zeros(len(groups)), self.prior.shared)


def n_contrasts(n_rows: float, vague: np.ndarray, shared: bool) -> np.ndarray:
    """Number of contrasts (o,) of rows, of which each weight that is vague (o, p) uses up one (see the top)."""
    used = vague.sum(axis=1)
    # Shared weights count for the first output.
    return n_rows - (np.where(np.arange(len(used)) == 0, used, 0) if shared else used)


class LikelihoodObjective:
    """Minus the log marginal likelihood, per row, and its gradient, as a function of the flat vector."""

    def __init__(self, model: ExactModel, table: ParameterTable):
        self.model, self.table = model.with_fewer_features(), table

    def __call__(self, flat: np.ndarray) -> tuple[float, np.ndarray]:
        values = self.table.values(flat)
        likelihood, gradient = self.model.log_likelihood(values)
        likelihood += log_prior(values, gradient)
        n_rows = self.model.rows.total
        return -likelihood / n_rows, -self.table.gradient(gradient) / n_rows
