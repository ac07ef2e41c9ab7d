"""Bounds on the log marginal likelihood as pure functions of the sufficient statistics.

For each output, with m inducing points and p features, f_m = s L v with K = s² L Lᵀ, and β = μ_β + C (w₀ + w) with
Σ_β = C Cᵀ. A priori, v ~ N(0, I) and w ~ N(-w₀, I). The residuals are r = y - H (μ_β + C w₀). The reference w₀ may be
any fixed vector. If it is near the solution, rᵀr is small, and with it the rounding errors of the sums.

With P = [s Vᵀ, H C] (n, m + p) and ω = (v, w), the model is r = P ω + ε. The rest is Bayesian linear regression
(Rasmussen & Williams 2006, sections 2.1.1 and 2.7) and the trace term of Titsias (2009), eq. 9:

    B = I + σ⁻² PᵀP,   g = σ⁻² Pᵀr - (0, w₀),   posterior of ω: N(B⁻¹ g, B⁻¹).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from ..data.blocks import Blocks, LinearSums
from ..utils.linalg import (
    diagonal_of,
    jittered_cholesky,
    semidefinite_inverse,
    symmetric_inverse,
    times_lower,
    triangular_inverse,
)
from .predictor import CoefficientPrior
from .statistics import Residuals, StatisticsGradient, SufficientStatistics, Whitening, errors

PosteriorFamily = Literal["full", "diagonal"]


@dataclass(frozen=True)
class Variant:
    """The variant of a sparse model: it is handed from the estimator to each group of outputs."""

    # The family of q.
    family: PosteriorFamily = "full"
    # Whether the bound is the tight one of Titsias (2025), not that of Titsias (2009) (see `BoundAtOptimum`).
    tight: bool = False
    # Whether f is orthogonal to the features (see `Group.leaks`). Fits are those of the free f.
    orthogonal: bool = False
    # Number of nearest rows on which the residual of the inducing points is conditioned (see `conditioning`).
    n_neighbors: int = 0

    @property
    def of_fit(self) -> Variant:
        """The variant whose bound is maximised."""
        return replace(self, orthogonal=False)


LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class Group:
    """A set of m inducing points and its o outputs, at one point of the parameters."""

    # The place of these outputs among all of the model.
    outputs: slice
    whitening: Whitening
    # Sums of these outputs.
    statistics: SufficientStatistics
    # (o,): s² and σ².
    signal: np.ndarray
    noise: np.ndarray
    # The prior of these outputs, with p features.
    prior: CoefficientPrior
    # Whether the inducing points are all rows, so that they explain the whole variance.
    complete: bool = False
    # If the bound is the tight one, ``statistics`` have the charge at ``signal`` and ``noise``. If f is orthogonal to
    # the features, it is so in the sum over the rows of the statistics.
    variant: Variant = field(default_factory=Variant)

    def charges(self) -> np.ndarray:
        """Twice the nats (o,) that the bound loses for what the points do not explain, and their slopes in log s²."""
        loose = self.signal / self.noise * self.statistics.unexplained
        return np.broadcast_to(self.statistics.charge if self.variant.tight else loose, (2, len(self.noise)))

    @cached_property
    def scales(self) -> np.ndarray:
        """(o, m + p): the diagonal of T of each output (see `times_T`), if the weights are independent a priori."""
        (o, p), m = self.prior.scale.shape, len(self.statistics.VV)
        scales = np.empty((o, m + p))
        scales[:, :m] = np.sqrt(self.signal)[:, np.newaxis]
        scales[:, m:] = self.prior.scale
        return scales

    def times_T(self, index: int, A: np.ndarray, transposed: bool = False) -> np.ndarray:
        """T A, or Tᵀ A, of an output, for A (m + p,) or (m + p, k). P = [Vᵀ, H] T.

        T = blockdiag(s I, C), or this times [I, 0; -leak, I] if f is orthogonal to the features.
        """
        m = len(self.statistics.VV)
        if self.variant.orthogonal and not transposed:
            A = A.copy()
            A[m:] -= self.leaks[index] @ A[:m]
        product = (self.scales[index] * A.T).T
        if self.prior.root is not None:
            C = self.prior.root[index]
            product[m:] = (C.T if transposed else C) @ A[m:]
        if self.variant.orthogonal and transposed:
            product[:m] -= self.leaks[index].T @ product[m:]
        return product

    # A discrepancy f that is orthogonal to the features has the kernel k⊥ = k - k_h G⁻¹ k_hᵀ of Plumlee (2017), here
    # with sums over the rows: f⊥ = f - A (AᵀA)⁺ Aᵀ f(X) on the rows, A = H C. With f = s Vᵀ v, f⊥ is the same function
    # minus A leak v, leak = (AᵀA)⁺ Aᵀ Vᵀ s (p, m). So f⊥ and the weights w⊥ of the best fit in least squares are a
    # change of coordinates: f⊥ + A w⊥ = f + A (w⊥ - leak v).

    @cached_property
    def leaks(self) -> list[np.ndarray]:
        """The matrix (p, m) of each output that maps v to the weights of the best fit of f by the features."""
        statistics, leaks = self.statistics, []
        for output, signal in enumerate(self.signal):
            C = self.prior.roots()[output]
            AA, AV = C.T @ statistics.HH @ C, C.T @ statistics.VH.T
            sizes = np.square(C).T @ diagonal_of(statistics.HH)
            leaks.append(np.sqrt(signal) * (semidefinite_inverse(AA, sizes) @ AV))
        return leaks

    def orthogonalised(self, index: int, crossed: np.ndarray, linear: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """V⊥ V⊥ᵀ (m, m) and V⊥ [H, r] of an output, from V [H, r] and Hᵀ [H, r], where V⊥ has no part along A."""
        C, s = self.prior.roots()[index], np.sqrt(self.signal[index])
        leak, VA = self.leaks[index] / s, self.statistics.VH @ C
        return self.statistics.VV - VA @ leak, crossed - leak.T @ (C.T @ linear)

    def products(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """PᵀP (m + p, m + p) and Pᵀr (m + p,) of an output."""
        statistics, scales = self.statistics, self.scales[index]
        sums = np.concatenate([statistics.VR[:, index], statistics.HR[:, index]])
        if self.prior.root is not None or self.variant.orthogonal:
            # Tᵀ (Tᵀ J)ᵀ = Tᵀ J T, with J = [V; Hᵀ] [Vᵀ, H].
            TJ = self.times_T(index, statistics.joint, transposed=True)
            return self.times_T(index, TJ.T, transposed=True), self.times_T(index, sums, transposed=True)
        PP = np.multiply.outer(scales, scales)
        PP *= statistics.joint
        return PP, scales * sums

    def sizes(self, index: int) -> np.ndarray | None:
        """The diagonal (m + p,) of B of an output if no terms cancelled. None: they do not."""
        # V⊥ V⊥ᵀ is a difference, and so are features times correlated C: rounding errors of V Vᵀ and HᵀH stay.
        if self.prior.root is None and not self.variant.orthogonal:
            return None
        of_V = self.signal[index] * diagonal_of(self.statistics.VV)
        of_H = np.square(self.prior.roots()[index]).T @ diagonal_of(self.statistics.HH)
        return 1.0 + np.concatenate([of_V, of_H]) / self.noise[index]


# --- the optimal posterior --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class WhitenedPosterior:
    """The optimal q(ω) of one output: N(mean, B⁻¹)."""

    # (m + p, m + p): the precision, its lower Cholesky factor, and the inverse of the factor.
    B: np.ndarray
    root: np.ndarray
    root_inv: np.ndarray
    # (m + p,).
    mean: np.ndarray
    # Number of leading coordinates that count for this output. It is m if w is shared and counts for another output.
    n_own: int

    @property
    def log_det(self) -> float:
        """log|B|, or the log determinant of the precision of v given w if w counts for another output."""
        return 2.0 * float(np.log(diagonal_of(self.root)[: self.n_own]).sum())


def optimal_posteriors(groups: Sequence[Group]) -> list[list[WhitenedPosterior]]:
    """The optimal posterior of each output, by group (Titsias 2009, eq. 10, with explicit features).

    Raises `NotPositiveDefiniteError` if the sums are not finite.
    """
    if groups[0].prior.shared:
        return _with_shared_weights(groups)
    posteriors = []
    for group in groups:
        m, posteriors_of_group = len(group.statistics.VV), []
        for o, noise in enumerate(group.noise):
            # B = I + σ⁻² PᵀP (m + p, m + p) and g = σ⁻² Pᵀr - (0, w₀) (m + p,). With B = R Rᵀ, the mean is R⁻ᵀ R⁻¹ g.
            B, g = group.products(o)
            B /= noise
            diagonal_of(B)[...] += 1.0
            g /= noise
            g[m:] -= group.prior.reference[o]
            root = jittered_cholesky(B, sizes=group.sizes(o))
            root_inv = triangular_inverse(root)
            posteriors_of_group.append(WhitenedPosterior(B, root, root_inv, root_inv.T @ (root_inv @ g), len(B)))
        posteriors.append(posteriors_of_group)
    return posteriors


def _with_shared_weights(groups: Sequence[Group]) -> list[list[WhitenedPosterior]]:
    """The optimal posterior of each output, given the data of all outputs, which share their weights."""
    # There is one w for all outputs and a v for each. B is then an arrowhead matrix. Let
    #
    #     B_j = [D_j, E_j; E_jᵀ, F_j],   D_j: (m, m), E_j: (m, p), F_j: (p, p),
    #
    # be the matrix of output j alone. B has the blocks D_j on its diagonal, E_j in the columns of w, and
    # I + Σ (F_j - I) in the corner. The precision of w is the Schur complement of the corner,
    #
    #     S = I + Σ (F_j - I - E_jᵀ D_j⁻¹ E_j),   (p, p),
    #
    # so that log|B| = Σ log|D_j| + log|S|, and the precision of (v_j, w) is [D_j, E_j; E_jᵀ, S + E_jᵀ D_j⁻¹ E_j]. The
    # inverses of these contain all of B⁻¹ that predictions, the gradient of the bound and covariances of outputs need.
    p = groups[0].prior.scale.shape[1]
    parts, S, sizes, g_w = [], np.eye(p), np.ones(p), -groups[0].prior.reference[0]
    for group in groups:
        m = len(group.statistics.VV)
        for o, noise in enumerate(group.noise):
            # B_j - blockdiag(0, I), and with D_j = R Rᵀ: A = R⁻¹ E_j (m, p) and z = R⁻¹ g_v (m,).
            PP, g = group.products(o)
            PP /= noise
            g /= noise
            diagonal_of(PP)[:m] += 1.0
            D_root = jittered_cholesky(PP[:m, :m], sizes=None if (of_B := group.sizes(o)) is None else of_B[:m])
            D_root_inv = triangular_inverse(D_root)
            A, z = D_root_inv @ PP[:m, m:], D_root_inv @ g[:m]
            S += PP[m:, m:] - A.T @ A
            sizes += diagonal_of(PP)[m:]
            g_w += g[m:] - A.T @ z
            parts.append((PP, D_root, D_root_inv, A, z))
    S_root = jittered_cholesky(S, sizes=sizes)
    # S includes the jitter, if there is one.
    S = S_root @ S_root.T
    S_root_inv = triangular_inverse(S_root)
    w = S_root_inv.T @ (S_root_inv @ g_w)
    posteriors = []
    for index, (B, D_root, D_root_inv, A, z) in enumerate(parts):
        # The Cholesky factor of the precision of (v_j, w) is [R, 0; Aᵀ, S_root].
        m = len(D_root)
        B[m:, m:] = S + A.T @ A
        root, root_inv = np.zeros(B.shape), np.zeros(B.shape)
        root[:m, :m], root[m:, :m], root[m:, m:] = D_root, A.T, S_root
        root_inv[:m, :m], root_inv[m:, m:] = D_root_inv, S_root_inv
        root_inv[m:, :m] = -S_root_inv @ (A.T @ D_root_inv)
        mean = np.concatenate([D_root_inv.T @ (z - A @ w), w])
        # w counts for the first output.
        posteriors.append(WhitenedPosterior(B, root, root_inv, mean, m if index else m + p))
    in_order = iter(posteriors)
    return [[next(in_order) for _ in group.noise] for group in groups]


# --- the paper's q: independent inducing values and weights -----------------------------------------------------------


def log_variances(B: np.ndarray, L_inv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log variances -log Λ_ii of the optimal diagonal q: of f_m in units of s² (m,), and of w (p,)."""
    m = len(L_inv)
    precision = np.einsum("ji,jk,ki->i", L_inv, B[:m, :m], L_inv, optimize=True)
    # B is at least I. Rounding may make it smaller.
    precision = np.maximum(precision, np.einsum("ji,ji->i", L_inv, L_inv))
    return -np.log(precision), -np.log(np.maximum(np.diagonal(B)[m:], 1.0))


def diagonal_root(log_f: np.ndarray, log_w: np.ndarray, L_inv: np.ndarray) -> np.ndarray:
    """R (m + p, m + p) with Cov[ω] = RᵀR, for independent f_m and w with these log variances."""
    m = len(L_inv)
    root = np.zeros((m + len(log_w), m + len(log_w)))
    root[:m, :m] = (L_inv * np.exp(0.5 * log_f)).T
    root[m:, m:] = np.diag(np.exp(0.5 * log_w))
    return root


def diagonal_gap(
    B: np.ndarray, log_det: float, log_det_bar: np.ndarray, whitening: Whitening
) -> tuple[float, np.ndarray, np.ndarray]:
    """½ (Σᵢ log Λ_ii - log|Λ|), and its gradients in B and (as Lᵀ L̄) in L. ``log_det_bar`` is -½ B⁻¹."""
    # In the coordinates (f_m, β) = (s L v, c w), the precision is Λ = T⁻ᵀ B T⁻¹ with T = blockdiag(s L, diag c), all
    # (m + p, m + p). The factors s and c cancel.
    L, L_inv, m = whitening.L, whitening.L_inv, len(whitening.L)
    BL = times_lower(B[:m, :m], L_inv)
    f_diagonal = np.maximum(np.einsum("ji,ji->i", L_inv, BL), np.einsum("ji,ji->i", L_inv, L_inv))
    coef_diagonal = np.maximum(np.diagonal(B)[m:], 1.0)
    gap = 0.5 * (np.log(f_diagonal).sum() + np.log(coef_diagonal).sum() - log_det) + np.log(np.diagonal(L)).sum()
    B_bar = log_det_bar.copy()
    B_bar[:m, :m] += 0.5 * times_lower(L_inv / f_diagonal, L_inv, transposed=True)
    diagonal_of(B_bar)[m:] += 0.5 / coef_diagonal
    factor_bar = -times_lower(BL / f_diagonal, L_inv, transposed=True)
    diagonal_of(factor_bar)[...] += 1.0
    return float(gap), B_bar, factor_bar


# --- the evidence lower bound -----------------------------------------------------------------------------------------


def bounds_at_optimum(groups: Sequence[Group]) -> list[BoundAtOptimum]:
    """The lower bound of each group of a model. Groups may share their weights."""
    return [
        BoundAtOptimum(group, posteriors) for group, posteriors in zip(groups, optimal_posteriors(groups), strict=True)
    ]


class BoundAtOptimum:
    """The evidence lower bound of a group with q at its optimum, summed over outputs, and its gradient.

    It is complete once the residuals e are known: from `residuals`, or from the second pass over the rows.
    """

    # ``family="full"`` is the collapsed bound (Titsias 2009, eq. 9, with kernel k + h Σ_β hᵀ and mean hᵀμ_β),
    #
    #     log N(y | H μ_β, UᵀK⁻¹U + H Σ_β Hᵀ + σ² I) - Tr(k(X, X) - UᵀK⁻¹U) / 2σ².
    #
    # ``family="diagonal"`` is the paper's q(f_m) = N(a, diag A), q(β) = N(b, diag B). It has the same means, and the
    # variances 1/Λ_ii, where Λ is the precision in the coordinates (f_m, β). Its bound is lower by the gap
    # ½ (Σᵢ log Λ_ii - log|Λ|).
    #
    # At the optimum the derivative in the mean vanishes. Value and gradient can therefore be written with the residuals
    # e = r - P mean, (n,):
    #
    #     bound = -½ [N log 2πσ² + log|B| + eᵀe/σ² + |v|² + |w + w₀|² + s² Σ(k̃ - |v(x)|²)/σ²].
    #
    # If rows have weights w and relative noise variances v, N is Σ w, products have the factor ω = w / v since the rows
    # of P and r are multiplied by √ω, and Σ w log v is added to N log 2πσ².
    #
    # The last term is the charge of Titsias (2009) for the variance d_i = s² (k̃ - |v(x)|²) of row i that the inducing
    # points do not explain. It comes from q(f|u) = p(f|u), which has the covariance R² in units of the noise. R (n, n)
    # is symmetric. The tight bound (Titsias 2025, arXiv 2502.08730; Bui, Ashman & Turner 2025, arXiv 2502.04750) takes
    # R diag(a) R in its place, with the same mean. With x_i = (R²)_ii = d_i / (σ² v_i), the terms with a are
    #
    #     -½ Tr(R diag(a) R) - KL[q(f|u) || p(f|u)] = ½ Σ (log a_i - a_i + 1 - a_i x_i).
    #
    # Their maximum is -½ Σ log(1 + x_i) ≥ -½ Σ x_i, at a_i = 1 / (1 + x_i). All other terms, and so q(v, w), are the
    # same. A row of weight w ≥ 1 counts w times. If w < 1, its likelihood has the factor w, but the divergence has not.
    # The maximum is then -½ log(1 + w x_i). Both are -½ ŵ log(1 + w x_i / ŵ), ŵ = max(w, 1). The derivative in d_i is
    # -½ (w / (σ² v_i)) / (1 + w x_i / ŵ). In log s² it is -½ Σ w x_i / (1 + w x_i / ŵ), and minus that in log σ².
    #
    # The tight bound is at most the log likelihood, but unlike the other one it may fall if a point is added.
    #
    # If e is summed row by row, as in `statistics.pull_back`, no digits cancel at any signal-to-noise ratio.

    def __init__(self, group: Group, posteriors: list[WhitenedPosterior]):
        statistics, scales, noise = group.statistics, group.scales, group.noise
        joint, m = statistics.joint, len(statistics.VV)
        self.group, self.posteriors = group, posteriors
        # (m + p, o): e = r - [V; Hᵀ]ᵀ weights.
        mean = np.array([q.mean for q in posteriors])
        self.weights = (scales * mean).T
        if group.prior.root is not None:
            self.weights[m:] = group.prior.times(mean[:, m:]).T
        joint_bar, factor_bar = np.zeros(joint.shape), np.zeros((m, m))
        # (o, p): the variances of w.
        spread = np.empty(group.prior.scale.shape)
        # (o,) each: log|B| plus twice the gap, and the derivatives of the bound in log s² and log 1/σ² through B.
        log_det, from_signal, from_noise = np.empty((3, len(noise)))
        for o, q in enumerate(posteriors):
            log_det[o] = q.log_det
            B_bar = -0.5 * symmetric_inverse(q.root_inv)
            spread[o] = -2.0 * np.diagonal(B_bar)[m:]
            if group.variant.family == "diagonal":
                spread[o] = 1.0 / np.maximum(np.diagonal(q.B)[m:], 1.0)
                gap, gap_B_bar, gap_factor_bar = diagonal_gap(q.B, log_det[o], B_bar, group.whitening)
                log_det[o] += 2.0 * gap
                B_bar -= gap_B_bar
                factor_bar -= gap_factor_bar
            # B = I + σ⁻² Tᵀ J T, so that J̄ = σ⁻² T B̄ Tᵀ, (m + p, m + p).
            if group.prior.root is None:
                B_bar *= np.multiply.outer(scales[o] / noise[o], scales[o])
            else:
                B_bar = group.times_T(o, group.times_T(o, B_bar).T) / noise[o]
            joint_bar += B_bar
            from_signal[o], from_noise[o] = np.vdot(B_bar[:m], joint[:m]), np.vdot(B_bar, joint)
        unexplained_bar = -0.5 * group.signal / noise
        self.gradient = StatisticsGradient(
            joint_bar[:m, :m],
            2.0 * joint_bar[:m, m:],
            self.weights[:m] / noise,
            0.0 if group.complete else unexplained_bar.sum(),
            factor_bar,
            group.signal / noise if group.variant.tight else None,
        )
        unexplained, unexplained_slope = -0.5 * group.charges()
        # |v|² + |w + w₀|² of each output. Shared weights count once.
        mean[:, m:] += group.prior.reference
        # At the optimum of q(f_m, β) the bound depends on the prior's standard deviation c of a weight only through
        # KL[q(β) || p(β)]. With z = w + w₀ the derivative in log c is E[z²] - 1.
        self._factors = mean[:, m:] ** 2 + spread - 1.0
        if group.prior.shared:
            for mean_of_output, factors, q in zip(mean, self._factors, posteriors, strict=True):
                mean_of_output[q.n_own :] = 0.0
                factors[q.n_own - m :] = 0.0
        penalty = np.einsum("ok,ok->o", mean, mean)
        # (o,) each: the bound without eᵀe, and its derivatives in log s² and log σ².
        log_noise = statistics.n_rows * (LOG_2PI + np.log(noise)) + statistics.log_variance
        self._value = unexplained - 0.5 * (log_noise + log_det + penalty)
        self._log_signal = from_signal + unexplained_slope
        self._log_noise = -0.5 * statistics.n_rows - from_noise - unexplained_slope

    def residuals(self, blocks: Blocks | None = None) -> Residuals:
        """Sums of e over the rows or, without rows, differences of the statistics.

        The differences are accurate up to a signal of about 1e4 times the noise.
        """
        if blocks is not None:
            return errors(blocks, self.group.whitening, self.group.outputs, self.weights)
        statistics, m = self.group.statistics, len(self.group.statistics.VV)
        f, b = self.weights[:m], self.weights[m:]
        VE = statistics.VR - statistics.VV @ f - statistics.VH @ b
        HE = statistics.HR - statistics.VH.T @ f - statistics.HH @ b
        squares = statistics.RR - ((statistics.VR + VE) * f).sum(axis=0) - ((statistics.HR + HE) * b).sum(axis=0)
        return Residuals(np.maximum(squares, 0.0), VE, HE)

    def value(self, residuals: Residuals) -> float:
        """The bound, in nats."""
        return float((self._value - 0.5 * residuals.squares / self.group.noise).sum())

    def finish(self, residuals: Residuals) -> tuple[float, dict[str, np.ndarray]]:
        """The bound, and its gradients in the logarithms of s² (o,), σ² (o,) and factors of scales (o, g)."""
        signal = self._log_signal + 0.5 * (self.gradient.VE * residuals.VE).sum(axis=0)
        noise = self._log_noise + 0.5 * residuals.squares / self.group.noise
        gradients = {"signal": signal, "noise": noise}
        if self.group.prior.n_groups:
            gradients["coef_factors"] = self.group.prior.of_groups(self._factors)
        return self.value(residuals), gradients


def equation_errors(group: Group, posteriors: Sequence[WhitenedPosterior], residuals: Residuals) -> list[np.ndarray]:
    """The error ρ = g - B mean (m + p,) of each output, with the residuals under these means."""
    # As ρ = σ⁻² Pᵀe - mean - (0, w₀) it keeps the digits that B, g and the mean have lost (Higham 2002, section 12.1).
    PE, m = np.concatenate([residuals.VE, residuals.HE]), len(residuals.VE)
    errors_by_output = []
    for o, q in enumerate(posteriors):
        prior = q.mean + np.concatenate([np.zeros(m), group.prior.reference[o]])
        prior[q.n_own :] = 0.0
        errors_by_output.append(group.times_T(o, PE[:, o], transposed=True) / group.noise[o] - prior)
    return errors_by_output


def lost_by_rounding(bounds: Sequence[BoundAtOptimum], residuals: Sequence[Residuals]) -> float:
    """The nats ½ ρᵀB⁻¹ρ that bounds lose because rounding moves their means, with ρ of `equation_errors`."""
    halves = []
    for bound, sums in zip(bounds, residuals, strict=True):
        for q, error in zip(bound.posteriors, equation_errors(bound.group, bound.posteriors, sums), strict=True):
            halves.append(np.split(q.root_inv @ error, [len(sums.VE)]))
    of_v, of_w = zip(*halves, strict=True)
    # If outputs share w, its error is the sum over outputs.
    of_w = (np.sum(of_w, axis=0),) if bounds[0].group.prior.shared else of_w
    return 0.5 * float(sum(half @ half for half in (*of_v, *of_w)))


# --- other bounds -----------------------------------------------------------------------------------------------------


def upper_bound(groups: Sequence[Group], blocks: Blocks | None = None) -> float:
    """An upper bound on the log marginal likelihood of all outputs, in nats. It holds for any q.

    The residuals are summed over the rows or, without rows, taken from the statistics (see `BoundAtOptimum`).
    """
    # Let Q = UᵀK⁻¹U + H Σ_β Hᵀ (n, n) and r = y - H μ_β. Let t = Σ (k(x, x) - q(x, x)) be the trace of the covariance
    # that the inducing points do not explain. It is at least the largest eigenvalue, and the upper bound is
    #
    #     -½ [N log 2π + log|Q + σ² I| + rᵀ (Q + (σ² + t) I)⁻¹ r]
    #
    # (Titsias 2014, "Variational inference for Gaussian and determinantal point processes", with H Σ_β Hᵀ on both
    # sides). The last term is the minimum over ω of |r - P ω|² / (σ² + t) + |ω|². So it equals that of the lower bound
    # with the noise variance σ² + t. An ω that rounding moves from the minimum makes this bound too low. That loss is
    # added. (log|B| is as accurate as the sums.)
    #
    # If the inducing points are all rows, only a jitter j remains of K: K - K (K + j I)⁻¹ K has no eigenvalue above j.
    # A row that appears or counts several times makes this as many times larger. If outputs share their weights, y, σ²
    # and t are stacked over outputs.
    wide, log_ratio = [], 0.0
    for group in groups:
        statistics, trace = group.statistics, group.statistics.unexplained
        if group.complete:
            n_repeated = statistics.n_rows + statistics.surplus - len(statistics.VV)
            trace = group.whitening.jitter() * max(n_repeated + 1, 1)
        noise = group.noise + group.signal * trace
        wide.append(replace(group, noise=noise, statistics=replace(statistics, unexplained=0.0), variant=Variant()))
        log_ratio += float(statistics.n_rows * np.log(noise / group.noise).sum())
    # The log likelihood with the noise variance σ² + t, with the determinant for σ².
    bounds = bounds_at_optimum(wide)
    residuals = [bound.residuals(blocks) for bound in bounds]
    total = sum(bound.value(sums) for bound, sums in zip(bounds, residuals, strict=True))
    total += lost_by_rounding(bounds, residuals)
    log_det = log_ratio + sum(q.log_det for bound in bounds for q in bound.posteriors)
    log_det -= sum(q.log_det for posteriors in optimal_posteriors(groups) for q in posteriors)
    return total + 0.5 * log_det


def bounds_alone(sums: LinearSums, prior: CoefficientPrior, noise: np.ndarray, trace: np.ndarray) -> np.ndarray:
    """The lower bound (o,) of each output, in nats, with q(f) at its prior: the features alone explain the rows.

    ``noise`` (o,) is σ², and ``trace`` (o,) is Σ ω k(x, x). If outputs share their weights, these count for the first.
    """
    p, groups = prior.scale.shape[1], []
    VV, VH, VR = np.zeros((0, 0)), np.zeros((0, p)), np.zeros((0, 1))
    for index, (variance, unexplained) in enumerate(zip(noise, trace, strict=True)):
        output = slice(index, index + 1)
        HH, HR, RR = sums.of(output)
        statistics = SufficientStatistics(
            n_rows=sums.n_rows,
            VV=VV,
            VH=VH,
            VR=VR,
            HH=HH,
            HR=HR,
            RR=RR,
            unexplained=float(unexplained),
            log_variance=sums.log_variance,
            surplus=sums.surplus,
        )
        whitening = Whitening(None, VV, VV)
        groups.append(Group(output, whitening, statistics, np.ones(1), np.array([variance]), prior.outputs(output)))
    return np.array([bound.value(bound.residuals()) for bound in bounds_at_optimum(groups)])
