"""The exact model with explicit features: likelihood, gradient and posterior (Rasmussen & Williams 2006, section 2.7).

Per output, with ρ = σ²/s², L Lᵀ = K̃ + ρ I and Σ_β = C Cᵀ, the whitened rows are z = L⁻¹ r / s and
W = L⁻¹ H C / s; β = μ_β + C (w₀ + w) and r = y - H (μ_β + C w₀) as in `bounds`. Integrating β out leaves

    -2 log p(y) = (n - k) log 2π + log |s² L Lᵀ| + log |B| + |z - W w|² + |D (w + w₀)|² - 2 Σ_vague log c,
    B = D + WᵀW,   w = B⁻¹ (Wᵀz - D w₀),   posterior of the weights: N(w, B⁻¹),

where D = I, but 0 for the k weights whose prior is vague, Σ_β → ∞: for them c is a unit, and the likelihood that of
n - k contrasts (eq. 2.45 there; the infinite log |Σ_β| left out). A QR factorisation of [W; D] gives B without squaring
its condition. Outputs that share their weights are stacked: W and z are then those of all of them, one below the other.

Predictions are those of a sparse model whose inducing points are the rows and whose L is the one above (eq. 2.41 and
2.42): g(x) has the mean Vᵀ(s (z - W w)) + h(x)ᵀβ and the variance s² (k̃(x, x) - |V|²) + |R⁻ᵀ (Cᵀ h(x) - s Wᵀ V)|²,
with V = L⁻¹ k̃(X, x) and B = RᵀR.

A row with the noise variance σ² v has ρ v in place of ρ on its diagonal. One that counts w times is a row with the
noise variance σ² v / w, but for what w copies of it have beside exp(-½ w e² / (σ² v)):

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
from .parameters import ParameterTable, Values
from .predictor import CoefficientPrior, Predictor, PredictorGroup
from .statistics import Kernel, Whitening


class OutputGivenKernel:
    """Likelihood and posterior of one output, given K̃.

    Parameters
    ----------
    K : ndarray of shape (n, n)
        k̃(X, X).
    H : ndarray of shape (n, p)
    r : ndarray of shape (n,)
        Residuals.
    signal, noise : float
        s² and σ².
    prior : CoefficientPrior
        Of this output.
    vague : ndarray of shape (p,)
        Weights with Σ_β → ∞; their prior scale is a unit.
    relative : ndarray of shape (n,), optional
        Noise variances v / w in units of σ²; None are ones.
    """

    # Of `join`.
    R: np.ndarray
    R_inv: np.ndarray
    w: np.ndarray
    left_over: np.ndarray
    from_prior: np.ndarray
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
        """Find w from all of some outputs, which share it; what belongs to it is counted with the first of them."""
        proper, reference = ~outputs[0].vague, outputs[0].reference
        # [W; D] w = [z; -D w₀] by least squares.
        Q, R = np.linalg.qr(np.vstack([*(own.W for own in outputs), np.diag(proper.astype(float))]))
        R_inv = lapack.dtrtri(R)[0] if len(R) else R
        wanted = Q.T @ np.concatenate([*(own.z for own in outputs), np.where(proper, -reference, 0.0)])
        # Not by the inverse: what it loses, features of 1e16 times the noise would multiply.
        w = lapack.dtrtrs(R, wanted)[0] if len(R) else wanted
        for own in outputs:
            own.R, own.R_inv, own.w, own.is_first = R, R_inv, w, own is outputs[0]
            own.left_over = own.z - own.W @ w
            own.from_prior = proper * (w + reference)

    @property
    def log_likelihood(self) -> float:
        """Of the residuals, in nats."""
        n_contrasts = len(self.L)
        log_det = len(self.L) * np.log(self.signal) + 2.0 * np.log(np.diagonal(self.L)).sum()
        squares = self.left_over @ self.left_over
        if self.is_first:
            n_contrasts -= self.vague.sum()
            log_det += 2.0 * (np.log(np.abs(np.diagonal(self.R))).sum() - np.log(self.scale[self.vague]).sum())
            squares += self.from_prior @ self.from_prior
        return float(-0.5 * (n_contrasts * LOG_2PI + log_det + squares))

    def gradient(self) -> tuple[np.ndarray, float, float]:
        """Of the log likelihood in K̃ (symmetric), log s² and log σ²: ½ (α αᵀ - P) pulled back to each.

        (α = (s² L Lᵀ)⁻¹ (r - H C w); P is the inverse of y's covariance, of this output's rows, or for vague weights
        its limit.)
        """
        # α and P in units of 1/s and 1/s²: in their own α² may overflow.
        alpha, n = self.L_inv.T @ self.left_over, len(self.L)
        WR = self.W @ self.R_inv
        from_weights = self.L_inv.T @ WR
        P = symmetric_inverse(self.L_inv) - from_weights @ from_weights.T
        in_noise = alpha**2 - diagonal_of(P)
        squares = float(self.left_over @ self.left_over)
        explained = float(np.vdot(WR, WR))
        noise_bar = 0.5 * self.ratio * float(in_noise.sum() if self.relative is None else in_noise @ self.relative)
        P *= -1.0
        P += np.multiply.outer(alpha, alpha)
        P *= 0.5
        return P, 0.5 * (squares - n + explained) - noise_bar, noise_bar

    def posterior(self) -> tuple[np.ndarray, np.ndarray]:
        """Of ω = (v, w): its mean (n + p,) and a root (max(p, 1), n + p) of its covariance."""
        root = np.zeros((1, len(self.L)))
        if len(self.R):
            root = np.hstack([-(self.W @ self.R_inv).T, self.R_inv.T])
        return np.concatenate([self.left_over, self.w]), root


@dataclass(frozen=True)
class ExactModel:
    """Covariance, prior and rows: θ -> likelihood, gradient and posterior.

    Attributes
    ----------
    kernel : Kernel
        k̃, common to all outputs.
    prior : CoefficientPrior
    vague : ndarray of shape (o, p)
        Weights with an infinite prior scale; in ``prior`` theirs is a unit.
    rows : RawRows
        All of them, in internal units.
    kernels : tuple of Kernel, optional
        k̃ of each output, where outputs have inputs of their own.
    """

    kernel: Kernel
    prior: CoefficientPrior
    vague: np.ndarray
    rows: RawRows
    kernels: tuple[Kernel, ...] | None = None

    def with_fewer_features(self) -> ExactModel:
        """The same likelihood with no more features than rows n, where there are more.

        Of H C = Rᵀ Qᵀ rows see Qᵀ w ~ N(-Qᵀ w₀, I) alone, and no other direction of w has a likelihood: Rᵀ (n, n) takes
        the place of H. Not where outputs share their weights, or some are vague.
        """
        (o, p), n = self.prior.scale.shape, len(self.rows.inputs)
        if p <= n or self.prior.shared or self.vague.any():
            return self
        features, reference = np.empty((n, o, n)), np.empty((o, n))
        for index, (scale, w0) in enumerate(zip(self.prior.scale, self.prior.reference, strict=True)):
            H = self.rows.of(slice(index, index + 1)).features
            A = (H * scale if self.prior.root is None else H @ self.prior.root[index]).T
            # The large rows first: so each keeps its own digits (Higham 2002, section 19.4).
            order = np.argsort(-np.abs(A).max(axis=1))
            Q, R = np.linalg.qr(A[order])
            features[:, index], reference[index] = R.T, Q.T @ w0[order]
        prior = CoefficientPrior(np.zeros((o, n)), np.ones((o, n)), reference)
        rows = replace(self.rows, features=features)
        return replace(self, prior=prior, vague=np.zeros((o, n), dtype=bool), rows=rows)

    def outputs(self, values: Values) -> tuple[list[Any], list[OutputGivenKernel]]:
        """The covariance of the rows, of all outputs or of each, and each output given it."""
        hyperparameters, o = np.log(values["hyperparameters"]), len(self.vague)
        each = [self.rows.of(slice(output, output + 1)) for output in range(o)]
        relative = None if self.rows.precision is None else 1.0 / self.rows.precision
        covariances = [
            kernel.at(hyperparameters, own.inputs)
            for kernel, own in zip(self.kernels or (self.kernel,), each, strict=False)
        ]
        matrices = [at.matrix() for at in covariances]
        outputs = [
            OutputGivenKernel(
                matrices[index % len(matrices)],
                own.features,
                own.targets[:, 0],
                values["signal"][index],
                values["noise"][index],
                self.prior.outputs(slice(index, index + 1)),
                self.vague[index],
                relative,
            )
            for index, own in enumerate(each)
        ]
        for together in [outputs] if self.prior.shared else [[own] for own in outputs]:
            OutputGivenKernel.join(together)
        return covariances, outputs

    def log_likelihoods(self, values: Values) -> np.ndarray:
        """Of each output, (o,), with what its rows' counts add; -inf where it cannot be computed.

        Shared weights are counted with the first.
        """
        try:
            return np.array([output.log_likelihood for output in self.outputs(values)[1]]) + self._of_copies(values)
        except NotPositiveDefiniteError:
            return np.full(len(self.vague), -np.inf)

    def log_likelihood(self, values: Values) -> tuple[float, Values]:
        """Summed over outputs, and its gradient in the logarithms of the values."""
        covariances, outputs = self.outputs(values)
        total = float(self._of_copies(values).sum())
        gradient = {name: np.zeros_like(value) for name, value in values.items()}
        K_bars = np.zeros((len(covariances), *outputs[0].L.shape))
        for index, output in enumerate(outputs):
            total += output.log_likelihood
            own, gradient["signal"][index], gradient["noise"][index] = output.gradient()
            K_bars[index % len(K_bars)] += own
        gradient["noise"] -= 0.5 * self.n_copies
        for at, K_bar in zip(covariances, K_bars, strict=True):
            gradient["hyperparameters"] += at.finish_pullback(at.start_pullback(), K_bar)[0]
        return total, gradient

    @property
    def n_copies(self) -> float:
        """Σ (w - 1)."""
        return self.rows.total - len(self.rows.inputs)

    def _of_copies(self, values: Values) -> np.ndarray:
        """What rows that count w times add to the log likelihood of rows with the noise variance σ² v / w."""
        w, noise = self.rows.counts, values["noise"]
        if w is None or self.rows.precision is None:
            return np.zeros(len(noise))
        constant = float((w - 1.0) @ (LOG_2PI + np.log(w / self.rows.precision)) + np.log(w).sum())
        return -0.5 * (constant + self.n_copies * np.log(noise))

    def predictor(self, values: Values) -> Predictor:
        """In internal units; the rows are its inducing points."""
        covariances, outputs = self.outputs(values)
        groups = []
        for index, output in enumerate(outputs):
            own, (mean, root) = slice(index, index + 1), output.posterior()
            groups.append(
                PredictorGroup.of(
                    own,
                    self.kernel if self.kernels is None else self.kernels[index],
                    values["hyperparameters"],
                    self.rows.of(own).inputs,
                    Whitening(covariances[index % len(covariances)], output.L, output.L_inv),
                    values["signal"][own],
                    self.prior.outputs(own),
                    [mean],
                    [root],
                )
            )
        offset = self.prior.offset
        return Predictor(tuple(groups), values["noise"], offset, np.zeros(len(groups)), self.prior.shared)


class LikelihoodObjective:
    """θ -> minus the log marginal likelihood, per row, and its gradient: what L-BFGS minimises.

    Parameters
    ----------
    model : ExactModel
    table : ParameterTable
    """

    def __init__(self, model: ExactModel, table: ParameterTable):
        self.model, self.table = model.with_fewer_features(), table

    def __call__(self, flat: np.ndarray) -> tuple[float, np.ndarray]:
        likelihood, gradient = self.model.log_likelihood(self.table.values(flat))
        n_rows = self.model.rows.total
        return -likelihood / n_rows, -self.table.gradient(gradient) / n_rows
