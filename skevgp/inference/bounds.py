"""The bounds as pure functions of the sufficient statistics.

Per output, in whitened coordinates: f_m = s L v with K = s² L Lᵀ, and β = μ_β + c (w₀ + w) with Σ_β = diag(c²), so
that v ~ N(0, I), w ~ N(-w₀, I) a priori. Here r = y - H (μ_β + c w₀): the reference w₀ is any fixed vector; put
near the solution it keeps rᵀr, and with it the rounding errors of the sums, small. With P = [s Vᵀ, H diag(c)] the
model is r = P ω + ε, ω = (v, w), and all that follows is Bayesian linear regression (Rasmussen & Williams 2006,
sections 2.1.1 and 2.7) plus the trace term of Titsias (2009), eq. 9:

    B = I + σ⁻² PᵀP,   g = σ⁻² Pᵀr - (0, w₀),   posterior of ω: N(B⁻¹ g, B⁻¹).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from .._linalg import diagonal_of, jittered_cholesky, symmetric_inverse, triangular_inverse
from ..rows.blocks import LinearStatistics
from .statistics import SufficientStatistics

PosteriorFamily = Literal["full", "diagonal"]

LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class CoefficientPrior:
    """β ~ N(mean, diag(scale²)) for each output, and the reference that residuals are taken from.

    Attributes
    ----------
    mean, scale : ndarray of shape (o, p)
    reference : ndarray of shape (o, p)
        w₀: residuals are y - H (mean + scale * w₀).
    """

    mean: np.ndarray
    scale: np.ndarray
    reference: np.ndarray

    @property
    def offset(self) -> np.ndarray:
        """The coefficients (o, p) that the residuals are taken from."""
        return self.mean + self.scale * self.reference

    def outputs(self, columns: slice) -> CoefficientPrior:
        """The prior of some of the outputs."""
        return CoefficientPrior(self.mean[columns], self.scale[columns], self.reference[columns])


@dataclass(frozen=True)
class WhitenedPosterior:
    """The optimal q(ω) of one output: N(mean, B⁻¹).

    Attributes
    ----------
    B, root, root_inv : ndarray of shape (m + p, m + p)
        Precision, its lower Cholesky factor, and the inverse of that.
    mean : ndarray of shape (m + p,)
    """

    B: np.ndarray
    root: np.ndarray
    root_inv: np.ndarray
    mean: np.ndarray


@dataclass(frozen=True)
class Residuals:
    """What the posterior mean leaves over, e = r - P mean, summed over rows.

    Attributes
    ----------
    squares : ndarray of shape (o,)
        eᵀe of each output.
    VE : ndarray of shape (m, o)
        V e of each output.
    """

    squares: np.ndarray
    VE: np.ndarray


@dataclass(frozen=True)
class StatisticsGradient:
    """Gradients of a bound in the statistics of these names, and in L; ``VE`` multiplies V e, not V r."""

    VV: np.ndarray
    VH: np.ndarray
    VE: np.ndarray
    unexplained: float
    L: np.ndarray


def projected(statistics: SufficientStatistics, index: int, signal: float, scale: np.ndarray) -> tuple[Any, Any]:
    """PᵀP (m + p, m + p) and Pᵀr (m + p,) of one output."""
    m, s = len(statistics.VV), np.sqrt(signal)
    size = m + len(scale)
    PP, Pr = np.empty((size, size)), np.empty(size)
    np.multiply(statistics.VV, signal, out=PP[:m, :m])
    np.multiply(statistics.VR[:, index], s, out=Pr[:m])
    if len(scale):
        np.multiply(statistics.VH, s * scale, out=PP[:m, m:])
        PP[m:, :m] = PP[:m, m:].T
        np.multiply(statistics.HH, np.multiply.outer(scale, scale), out=PP[m:, m:])
        np.multiply(statistics.HR[:, index], scale, out=Pr[m:])
    return PP, Pr


def optimal_posterior(
    statistics: SufficientStatistics, index: int, signal: float, noise: float, prior: CoefficientPrior
) -> WhitenedPosterior:
    """The posterior of ω of one output given the kernel (Titsias 2009, eq. 10, with explicit features).

    Parameters
    ----------
    statistics : SufficientStatistics
    index : int
        The output.
    signal, noise : float
        s² and σ².
    prior : CoefficientPrior

    Returns
    -------
    posterior : WhitenedPosterior

    Raises
    ------
    NotPositiveDefiniteError
        If the sums are not finite.
    """
    m = len(statistics.VV)
    B, g = projected(statistics, index, signal, prior.scale[index])
    B /= noise
    diagonal_of(B)[...] += 1.0
    g /= noise
    g[m:] -= prior.reference[index]
    root = jittered_cholesky(B)
    root_inv = triangular_inverse(root)
    return WhitenedPosterior(B, root, root_inv, root_inv.T @ (root_inv @ g))


class BoundAtOptimum:
    """The evidence lower bound with q at its optimum, summed over outputs, and its gradient.

    ``family="full"`` is the collapsed bound (Titsias 2009, eq. 9, with kernel k + hΣ_βhᵀ and mean hᵀμ_β):
    log N(y | Hμ_β, UᵀK⁻¹U + HΣ_βHᵀ + σ²I) - Tr(k(X, X) - UᵀK⁻¹U) / 2σ². ``family="diagonal"``, the paper's
    q(f_m) = N(a, diag A), q(β) = N(b, diag B), has the same means and variances 1/Λ_ii, where Λ is the precision in the
    coordinates (f_m, β), so that its bound is lower by ½ (Σᵢ log Λ_ii - log|Λ|).

    At the optimum the mean's own derivative vanishes, so that value and gradient can be written with what it leaves
    over, e = r - P mean:

        bound = -½ [N log 2πσ² + log|B| + eᵀe/σ² + |v|² + |w + w₀|² + s² Σ(k̃ - |v|²)/σ²].

    With e summed row by row (`pull_back`) no digits cancel at any signal-to-noise ratio; `residuals` gives the same
    sums as differences of the statistics.

    Parameters
    ----------
    statistics : SufficientStatistics
        With m inducing points, p features and o outputs.
    signal, noise : ndarray of shape (o,)
        s² and σ².
    prior : CoefficientPrior
    family : {"full", "diagonal"}, default="full"
    L, L_inv : ndarray of shape (m, m)
        Cholesky factor of k̃(X_m, X_m) and its inverse; only the diagonal family needs them.

    Attributes
    ----------
    posteriors : list of WhitenedPosterior
        One per output.
    fitted : ndarray of shape (m + p, o)
        e = r - [V; Hᵀ]ᵀ fitted.

    Raises
    ------
    NotPositiveDefiniteError
        If the sums are not finite.
    """

    def __init__(
        self,
        statistics: SufficientStatistics,
        signal: np.ndarray,
        noise: np.ndarray,
        prior: CoefficientPrior,
        family: PosteriorFamily = "full",
        L: np.ndarray | None = None,
        L_inv: np.ndarray | None = None,
    ):
        m, p = statistics.VH.shape
        self.statistics, self.signal, self.noise, self.prior = statistics, signal, noise, prior
        self.posteriors: list[WhitenedPosterior] = []
        self.fitted = np.empty((m + p, len(signal)))
        self.gradient = StatisticsGradient(
            np.zeros((m, m)),
            np.zeros((m, p)),
            np.empty((m, len(signal))),
            -0.5 * (signal / noise).sum(),
            np.zeros((m, m)),
        )
        # Terms of each output that do not depend on e, and their derivatives in log s² and log σ².
        self._value, self._log_signal, self._log_noise = np.empty((3, len(signal)))
        for o, (s2, sigma2) in enumerate(zip(signal, noise, strict=True)):
            s, scale = np.sqrt(s2), prior.scale[o]
            q = optimal_posterior(statistics, o, s2, sigma2, prior)
            self.posteriors.append(q)
            self.fitted[:m, o], self.fitted[m:, o] = s * q.mean[:m], scale * q.mean[m:]
            log_det = 2.0 * float(np.log(diagonal_of(q.root)).sum())
            penalty = float(q.mean @ q.mean)
            if p:
                penalty += float(prior.reference[o] @ (2.0 * q.mean[m:] + prior.reference[o]))
            unexplained = s2 * statistics.unexplained / sigma2
            value = -0.5 * (statistics.n_rows * (LOG_2PI + np.log(sigma2)) + log_det + penalty + unexplained)
            B_bar = -0.5 * symmetric_inverse(q.root_inv)
            if family == "diagonal":
                assert L is not None
                assert L_inv is not None
                gap, gap_B_bar, gap_L_bar = _diagonal_gap(q, log_det, B_bar, L, L_inv)
                value -= gap
                B_bar -= gap_B_bar
                self.gradient.L[...] -= gap_L_bar
            VV_bar, VH_bar = B_bar[:m, :m] * (s2 / sigma2), B_bar[:m, m:] * scale * (2.0 * s / sigma2)
            self.gradient.VV[...] += VV_bar
            self.gradient.VH[...] += VH_bar
            self.gradient.VE[:, o] = q.mean[:m] * (s / sigma2)
            self._value[o] = value
            self._log_signal[o] = (
                np.vdot(VV_bar, statistics.VV) + 0.5 * np.vdot(VH_bar, statistics.VH) - 0.5 * unexplained
            )
            from_B = np.vdot(B_bar, q.B) - diagonal_of(B_bar).sum()
            self._log_noise[o] = 0.5 * (unexplained - statistics.n_rows) - from_B

    def residuals(self) -> Residuals:
        """eᵀe and V e from the statistics: good while the signal is not above about 1e4 times the noise."""
        statistics, m = self.statistics, len(self.statistics.VV)
        f, b = self.fitted[:m], self.fitted[m:]
        VE = statistics.VR - statistics.VV @ f - statistics.VH @ b
        HE = statistics.HR - statistics.VH.T @ f - statistics.HH @ b
        squares = statistics.RR - ((statistics.VR + VE) * f).sum(axis=0) - ((statistics.HR + HE) * b).sum(axis=0)
        return Residuals(np.maximum(squares, 0.0), VE)

    def value(self, residuals: Residuals) -> float:
        """The bound, in nats."""
        return float((self._value - 0.5 * residuals.squares / self.noise).sum())

    def log_gradients(self, residuals: Residuals) -> tuple[np.ndarray, np.ndarray]:
        """Gradients (o,) in log s² and log σ²."""
        from_mean = 0.5 * (self.gradient.VE * residuals.VE).sum(axis=0)
        return self._log_signal + from_mean, self._log_noise + 0.5 * residuals.squares / self.noise


def features_alone_bound(sums: LinearStatistics | SufficientStatistics, prior: CoefficientPrior) -> float:
    """The bound without a Gaussian process, all that the features leave over being noise; summed over outputs."""
    noise = np.maximum(sums.RR / sums.n_rows, 1e-20)  # of targets that they explain to the last digit
    if prior.scale.shape[1] == 0:
        return float(-0.5 * sums.n_rows * (LOG_2PI + 1.0 + np.log(noise)).sum())
    o, p = prior.scale.shape
    nothing = SufficientStatistics(
        sums.n_rows, np.zeros((0, 0)), np.zeros((0, p)), np.zeros((0, o)), sums.HH, sums.HR, sums.RR, 0.0
    )
    bound = BoundAtOptimum(nothing, np.ones(o), noise, prior)
    return bound.value(bound.residuals())


def _diagonal_gap(
    q: WhitenedPosterior, log_det: float, log_det_bar: np.ndarray, L: np.ndarray, L_inv: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """½ (Σᵢ log Λ_ii - log|Λ|), and its gradients in B and L; ``log_det_bar`` is -½ B⁻¹.

    In the coordinates (f_m, β) = (s L v, c w), Λ = T⁻ᵀ B T⁻¹ with T = blockdiag(s L, diag c); s and c cancel.
    """
    m = len(L)
    B_vv = q.B[:m, :m]
    precision = L_inv.T @ B_vv @ L_inv
    f_diagonal, coef_diagonal = np.diagonal(precision), np.diagonal(q.B)[m:]
    log_det_L = np.log(np.diagonal(L)).sum()
    gap = 0.5 * (np.log(f_diagonal).sum() + np.log(coef_diagonal).sum() - log_det) + log_det_L
    B_bar = log_det_bar.copy()
    weighted = L_inv / f_diagonal
    B_bar[:m, :m] += 0.5 * weighted @ L_inv.T
    np.einsum("ii->i", B_bar[m:, m:])[...] += 0.5 / coef_diagonal
    L_bar = -np.tril((weighted @ precision).T)
    diagonal_of(L_bar)[...] += 1.0 / np.diagonal(L)
    return float(gap), B_bar, L_bar
