"""The exact model with explicit features: likelihood, gradient and posterior (Rasmussen & Williams 2006, section 2.7).

Per output, with ρ = σ²/s², L Lᵀ = K̃ + ρ I and the columns of c as prior scales, the whitened rows are z = L⁻¹ r / s
and W = L⁻¹ H diag(c) / s; β = μ_β + c (w₀ + w) and r = y - H (μ_β + c w₀) as in `bounds`. Integrating β out leaves

    -2 log p(y) = (n - k) log 2π + log |s² L Lᵀ| + log |B| + |z - W w|² + |D (w + w₀)|² - 2 Σ_vague log c,
    B = D + WᵀW,   w = B⁻¹ (Wᵀz - D w₀),   posterior of the weights: N(w, B⁻¹),

where D = I, but 0 for the k weights whose prior is vague, Σ_β → ∞: for them c is a unit, and the likelihood that of
n - k contrasts (eq. 2.45 there; the infinite log |Σ_β| left out). A QR factorisation of [W; D] gives B without squaring
its condition.

Predictions are those of a sparse model whose inducing points are the rows and whose L is the one above (eq. 2.41 and
2.42): g(x) has the mean Vᵀ(s (z - W w)) + h(x)ᵀβ and the variance s² (k̃(x, x) - |V|²) + |R⁻ᵀ (c h(x) - s Wᵀ V)|², with
V = L⁻¹ k̃(X, x) and B = RᵀR.

A row with the noise variance σ² v has ρ v in place of ρ on its diagonal. One that counts w times is a row with the
noise variance σ² v / w, but for what w copies of it have beside exp(-½ w e² / (σ² v)):

    N(y | g, σ² v)^w = N(y | g, σ² v / w) (2πσ² v)^(-(w - 1)/2) w^(-1/2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import lapack

from .._linalg import diagonal_of, jittered_cholesky, symmetric_inverse, triangular_inverse
from ..optimizers.parameters import Values
from ..rows.source import RawRows
from .bounds import LOG_2PI, CoefficientPrior
from .posterior import Predictor, PredictorGroup
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
        s, scale, reference = np.sqrt(signal), prior.scale[0], prior.reference[0]
        proper = ~vague
        self.vague, self.scale, self.relative = vague, scale, relative
        self.W = self.L_inv @ (H * (scale / s))
        z = self.L_inv @ (r / s)
        # [W; D] w = [z; -D w₀] by least squares.
        Q, self.R = np.linalg.qr(np.vstack([self.W, np.diag(proper.astype(float))]))
        self.R_inv = lapack.dtrtri(self.R)[0] if len(self.R) else self.R
        self.w = self.R_inv @ (Q.T @ np.concatenate([z, np.where(proper, -reference, 0.0)]))
        self.left_over = z - self.W @ self.w
        self.from_prior = proper * (self.w + reference)

    @property
    def log_likelihood(self) -> float:
        """Of the residuals, in nats."""
        n_contrasts = len(self.L) - self.vague.sum()
        log_det = len(self.L) * np.log(self.signal) + 2.0 * np.log(np.diagonal(self.L)).sum()
        log_det += 2.0 * (np.log(np.abs(np.diagonal(self.R))).sum() - np.log(self.scale[self.vague]).sum())
        squares = self.left_over @ self.left_over + self.from_prior @ self.from_prior
        return float(-0.5 * (n_contrasts * LOG_2PI + log_det + squares))

    def gradient(self) -> tuple[np.ndarray, float, float]:
        """Of the log likelihood in K̃ (symmetric), log s² and log σ²: ½ (α αᵀ - P) pulled back to each.

        (α = (s² L Lᵀ)⁻¹ (r - H c w); P is the inverse of y's covariance, or for vague weights its limit.)
        """
        n, s = len(self.L), np.sqrt(self.signal)
        alpha = self.L_inv.T @ self.left_over / s
        from_weights = self.L_inv.T @ (self.W @ self.R_inv)
        P = (symmetric_inverse(self.L_inv) - from_weights @ from_weights.T) / self.signal
        in_noise = alpha**2 - diagonal_of(P)
        squares = float(self.left_over @ self.left_over)
        explained = len(self.R) - float(np.sum(self.R_inv[~self.vague] ** 2))
        noise_bar = 0.5 * self.noise * float(in_noise.sum() if self.relative is None else in_noise @ self.relative)
        P *= -1.0
        P += np.multiply.outer(alpha, alpha)
        P *= 0.5 * self.signal
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
    """

    kernel: Kernel
    prior: CoefficientPrior
    vague: np.ndarray
    rows: RawRows

    def outputs(self, values: Values) -> tuple[Any, list[OutputGivenKernel]]:
        """The covariance of the rows, and each output given it."""
        at = self.kernel.at(np.log(values["hyperparameters"]), self.rows.inputs)
        K = at.matrix()
        relative = None if self.rows.precision is None else 1.0 / self.rows.precision
        return at, [
            OutputGivenKernel(
                K,
                self.rows.features,
                self.rows.targets[:, o],
                values["signal"][o],
                values["noise"][o],
                self.prior.outputs(slice(o, o + 1)),
                self.vague[o],
                relative,
            )
            for o in range(len(self.vague))
        ]

    def log_likelihood(self, values: Values) -> tuple[float, Values]:
        """Summed over outputs, and its gradient in the logarithms of the values."""
        at, outputs = self.outputs(values)
        total, gradient = self.of_copies(values), {name: np.zeros_like(value) for name, value in values.items()}
        K_bar = np.zeros((len(self.rows.inputs),) * 2)
        for o, output in enumerate(outputs):
            total += output.log_likelihood
            own, gradient["signal"][o], gradient["noise"][o] = output.gradient()
            K_bar += own
        gradient["noise"] -= 0.5 * self.n_copies
        gradient["hyperparameters"], _ = at.finish_pullback(at.start_pullback(), K_bar)
        return total, gradient

    @property
    def n_copies(self) -> float:
        """Σ (w - 1)."""
        return self.rows.total - len(self.rows.inputs)

    def of_copies(self, values: Values) -> float:
        """What rows that count w times add to the log likelihood of rows with the noise variance σ² v / w."""
        w, noise = self.rows.counts, values["noise"]
        if w is None or self.rows.precision is None:
            return 0.0
        constant = float((w - 1.0) @ (LOG_2PI + np.log(w / self.rows.precision)) + np.log(w).sum())
        return -0.5 * (len(noise) * constant + self.n_copies * float(np.log(noise).sum()))

    def predictor(self, values: Values) -> Predictor:
        """In internal units; the rows are its inducing points."""
        at, outputs = self.outputs(values)
        groups = []
        for o, output in enumerate(outputs):
            own, (mean, root) = slice(o, o + 1), output.posterior()
            groups.append(
                PredictorGroup.of(
                    own,
                    values["hyperparameters"],
                    self.rows.inputs,
                    Whitening(at, output.L, output.L_inv),
                    values["signal"][own],
                    self.prior.scale[own],
                    [mean],
                    [root],
                )
            )
        return Predictor(self.kernel, tuple(groups), values["noise"], self.prior.offset, np.zeros(len(groups)))
