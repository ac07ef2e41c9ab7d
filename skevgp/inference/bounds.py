"""The bounds as pure functions of the sufficient statistics.

Per output, in whitened coordinates: f_m = s L v with K = s² L Lᵀ, and β = μ_β + c (w₀ + w) with Σ_β = diag(c²), so
that v ~ N(0, I), w ~ N(-w₀, I) a priori. Here r = y - H (μ_β + c w₀): the reference w₀ is any fixed vector; put
near the solution it keeps rᵀr, and with it the rounding errors of the sums, small. With P = [s Vᵀ, H diag(c)] the
model is r = P ω + ε, ω = (v, w), and all that follows is Bayesian linear regression (Rasmussen & Williams 2006,
sections 2.1.1 and 2.7) plus the trace term of Titsias (2009), eq. 9:

    B = I + σ⁻² PᵀP,   g = σ⁻² Pᵀr - (0, w₀),   posterior of ω: N(B⁻¹ g, B⁻¹).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from .._linalg import diagonal_of, jittered_cholesky, symmetric_inverse, triangular_inverse
from ..rows.blocks import Blocks, LinearStatistics
from ..rows.source import Columns
from .statistics import Residuals, StatisticsGradient, SufficientStatistics, Whitening, errors

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

    def outputs(self, columns: Columns) -> CoefficientPrior:
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

    @property
    def log_det(self) -> float:
        """log|B|."""
        return 2.0 * float(np.log(diagonal_of(self.root)).sum())


@dataclass(frozen=True)
class Group:
    """One set of inducing points and the outputs that it serves, at one point of the parameters.

    Attributes
    ----------
    outputs : slice
        Which of the model's outputs, o of them.
    whitening : Whitening
        Of the m inducing points.
    statistics : SufficientStatistics
        Of these outputs.
    signal, noise : ndarray of shape (o,)
        s² and σ².
    prior : CoefficientPrior
        Of these outputs, with p features.
    complete : bool, default=False
        Whether the inducing points are all rows, so that they leave nothing unexplained.
    """

    outputs: slice
    whitening: Whitening
    statistics: SufficientStatistics
    signal: np.ndarray
    noise: np.ndarray
    prior: CoefficientPrior
    complete: bool = False

    @cached_property
    def scales(self) -> np.ndarray:
        """What makes Pᵀ of [V; Hᵀ] for each output, (o, m + p)."""
        (o, p), m = self.prior.scale.shape, len(self.statistics.VV)
        scales = np.empty((o, m + p))
        scales[:, :m] = np.sqrt(self.signal)[:, np.newaxis]
        scales[:, m:] = self.prior.scale
        return scales


def projected(group: Group, index: int) -> tuple[np.ndarray, np.ndarray]:
    """PᵀP (m + p, m + p) and Pᵀr (m + p,) of a group's output."""
    statistics, scales = group.statistics, group.scales[index]
    PP = np.multiply.outer(scales, scales)
    PP *= statistics.joint
    return PP, scales * np.concatenate([statistics.VR[:, index], statistics.HR[:, index]])


def optimal_posterior(group: Group, index: int) -> WhitenedPosterior:
    """The posterior of ω of a group's output given the kernel (Titsias 2009, eq. 10, with explicit features).

    Raises
    ------
    NotPositiveDefiniteError
        If the sums are not finite.
    """
    m, noise = len(group.statistics.VV), group.noise[index]
    B, g = projected(group, index)
    B /= noise
    diagonal_of(B)[...] += 1.0
    g /= noise
    g[m:] -= group.prior.reference[index]
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

    (Of rows with weights w and relative noise variances v, N is Σ w, products have the factor ω = w / v, and the
    constant Σ w log v stands beside N log 2πσ²: the rows of P and r are multiplied by √ω.)

    With e summed row by row (`statistics.pull_back`) no digits cancel at any signal-to-noise ratio; `residuals` gives
    the same sums as differences of the statistics.

    Parameters
    ----------
    group : Group
    family : {"full", "diagonal"}

    Attributes
    ----------
    posteriors : list of WhitenedPosterior
        One per output.
    weights : ndarray of shape (m + p, o)
        e = r - [V; Hᵀ]ᵀ weights.
    gradient : StatisticsGradient
        Of the bound.

    Raises
    ------
    NotPositiveDefiniteError
        If the sums are not finite.
    """

    def __init__(self, group: Group, family: PosteriorFamily):
        statistics, scales, noise = group.statistics, group.scales, group.noise
        joint, m = statistics.joint, len(statistics.VV)
        self.group = group
        self.posteriors = [optimal_posterior(group, o) for o in range(len(noise))]
        mean = np.array([q.mean for q in self.posteriors])
        self.weights = (scales * mean).T
        joint_bar, L_bar = np.zeros(joint.shape), np.zeros((m, m))
        # Of each output: log|B| (and twice the gap), and derivatives of the bound in log s² and log 1/σ² by way of B.
        log_det, from_signal, from_noise = np.empty((3, len(noise)))
        for o, q in enumerate(self.posteriors):
            log_det[o] = q.log_det
            B_bar = -0.5 * symmetric_inverse(q.root_inv)
            if family == "diagonal":
                gap, gap_B_bar, gap_L_bar = _diagonal_gap(q, log_det[o], B_bar, group.whitening)
                log_det[o] += 2.0 * gap
                B_bar -= gap_B_bar
                L_bar -= gap_L_bar
            B_bar *= np.multiply.outer(scales[o] / noise[o], scales[o])
            joint_bar += B_bar
            from_signal[o], from_noise[o] = np.vdot(B_bar[:m], joint[:m]), np.vdot(B_bar, joint)
        unexplained_bar = -0.5 * group.signal / noise
        self.gradient = StatisticsGradient(
            joint_bar[:m, :m],
            2.0 * joint_bar[:m, m:],
            self.weights[:m] / noise,
            0.0 if group.complete else unexplained_bar.sum(),
            L_bar,
        )
        unexplained = unexplained_bar * statistics.unexplained
        mean[:, m:] += group.prior.reference
        penalty = np.einsum("ok,ok->o", mean, mean)
        # What does not depend on e, and its derivatives in log s² and log σ².
        log_noise = statistics.n_rows * (LOG_2PI + np.log(noise)) + statistics.log_variance
        self._value = unexplained - 0.5 * (log_noise + log_det + penalty)
        self._log_signal = from_signal + unexplained
        self._log_noise = -0.5 * statistics.n_rows - from_noise - unexplained

    def residuals(self) -> Residuals:
        """eᵀe and V e from the statistics: good while the signal is not above about 1e4 times the noise."""
        statistics, m = self.group.statistics, len(self.group.statistics.VV)
        f, b = self.weights[:m], self.weights[m:]
        VE = statistics.VR - statistics.VV @ f - statistics.VH @ b
        HE = statistics.HR - statistics.VH.T @ f - statistics.HH @ b
        squares = statistics.RR - ((statistics.VR + VE) * f).sum(axis=0) - ((statistics.HR + HE) * b).sum(axis=0)
        return Residuals(np.maximum(squares, 0.0), VE)

    def value(self, residuals: Residuals) -> float:
        """The bound, in nats."""
        return float((self._value - 0.5 * residuals.squares / self.group.noise).sum())

    def finish(self, residuals: Residuals) -> tuple[float, dict[str, np.ndarray]]:
        """The bound, and its gradients (o,) in log s² and log σ²."""
        signal = self._log_signal + 0.5 * (self.gradient.VE * residuals.VE).sum(axis=0)
        noise = self._log_noise + 0.5 * residuals.squares / self.group.noise
        return self.value(residuals), {"signal": signal, "noise": noise}


def upper_bound(group: Group, blocks: Blocks | None = None) -> float:
    """No less than the log marginal likelihood at these parameters, summed over outputs, whatever q is.

    With Q = UᵀK⁻¹U + HΣ_βHᵀ, r = y - Hμ_β and t = Σ(k(x, x) - q(x, x)), the trace of what the inducing points leave of
    the covariance, which is no less than its largest eigenvalue,

        -½ [N log 2π + log|Q + σ²I| + rᵀ (Q + (σ² + t) I)⁻¹ r]

    (Titsias 2014, "Variational inference for Gaussian and determinantal point processes"; HΣ_βHᵀ is on both sides).
    The last term is the least of |r - Pω|² / (σ² + t) + |ω|², so that it is that of the bound with a noise of σ² + t.
    Inducing points that are all rows leave only what a jitter j makes of K: K - K (K + jI)⁻¹ K has no eigenvalue above
    j, and a row that comes or counts often makes that so many times larger.

    Parameters
    ----------
    group : Group
    blocks : Blocks, default=None
        The rows, for errors summed row by row (see `BoundAtOptimum`); None takes them from the statistics.

    Returns
    -------
    bound : float
        In nats.
    """
    statistics, left_over = group.statistics, group.statistics.unexplained
    if group.complete:
        left_over = group.whitening.jitter() * max(statistics.n_rows + statistics.surplus - len(statistics.VV) + 1, 1)
    noise = group.noise + group.signal * left_over
    # The likelihood with this noise and without a trace term, but for its determinant.
    wide = BoundAtOptimum(replace(group, noise=noise, statistics=replace(statistics, unexplained=0.0)), "full")
    left = wide.residuals() if blocks is None else errors(blocks, group.whitening, group.outputs, wide.weights)
    log_dets = [q.log_det - optimal_posterior(group, o).log_det for o, q in enumerate(wide.posteriors)]
    return wide.value(left) + 0.5 * float((statistics.n_rows * np.log(noise / group.noise) + log_dets).sum())


def features_alone_bound(sums: LinearStatistics | SufficientStatistics, prior: CoefficientPrior) -> float:
    """The bound without a Gaussian process, all that the features leave over being noise; summed over outputs."""
    noise = np.maximum(sums.RR / sums.n_rows, 1e-20)  # of targets that they explain to the last digit
    if prior.scale.shape[1] == 0:
        return float(-0.5 * (sums.n_rows * (LOG_2PI + 1.0 + np.log(noise)) + sums.log_variance).sum())
    o, p = prior.scale.shape
    empty = np.zeros((0, 0))
    statistics = SufficientStatistics(
        sums.n_rows, empty, np.zeros((0, p)), np.zeros((0, o)), sums.HH, sums.HR, sums.RR, 0.0, sums.log_variance
    )
    bound = BoundAtOptimum(
        Group(slice(0, o), Whitening(None, empty, empty), statistics, np.ones(o), noise, prior), "full"
    )
    return bound.value(bound.residuals())


def log_variances(B: np.ndarray, L_inv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log variances 1/Λ_ii of the optimal diagonal q: of f_m (in units of s²) and of w."""
    m = len(L_inv)
    precision = np.einsum("ji,jk,ki->i", L_inv, B[:m, :m], L_inv, optimize=True)
    return -np.log(precision), -np.log(np.diagonal(B)[m:])


def diagonal_root(log_f: np.ndarray, log_w: np.ndarray, L_inv: np.ndarray) -> np.ndarray:
    """R with Cov[ω] = Rᵀ R for diagonal covariances of f_m and β."""
    m = len(L_inv)
    root = np.zeros((m + len(log_w), m + len(log_w)))
    root[:m, :m] = (L_inv * np.exp(0.5 * log_f)).T
    root[m:, m:] = np.diag(np.exp(0.5 * log_w))
    return root


def _diagonal_gap(
    q: WhitenedPosterior, log_det: float, log_det_bar: np.ndarray, whitening: Whitening
) -> tuple[float, np.ndarray, np.ndarray]:
    """½ (Σᵢ log Λ_ii - log|Λ|), and its gradients in B and L; ``log_det_bar`` is -½ B⁻¹.

    In the coordinates (f_m, β) = (s L v, c w), Λ = T⁻ᵀ B T⁻¹ with T = blockdiag(s L, diag c); s and c cancel.
    """
    L, L_inv, m = whitening.L, whitening.L_inv, len(whitening.L)
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
