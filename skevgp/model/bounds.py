"""The bounds as pure functions of the sufficient statistics.

Per output, in whitened coordinates: f_m = s L v with K = s² L Lᵀ, and β = μ_β + C (w₀ + w) with Σ_β = C Cᵀ, so
that v ~ N(0, I), w ~ N(-w₀, I) a priori. Here r = y - H (μ_β + C w₀): the reference w₀ is any fixed vector; put
near the solution it keeps rᵀr, and with it the rounding errors of the sums, small. With P = [s Vᵀ, H C] the
model is r = P ω + ε, ω = (v, w), and all that follows is Bayesian linear regression (Rasmussen & Williams 2006,
sections 2.1.1 and 2.7) plus the trace term of Titsias (2009), eq. 9:

    B = I + σ⁻² PᵀP,   g = σ⁻² Pᵀr - (0, w₀),   posterior of ω: N(B⁻¹ g, B⁻¹).

Outputs that share their weights have one w and a v each. B is then an arrowhead: with B_j = [D_j, E_j; E_jᵀ, F_j] the
matrix of output j alone, its blocks are D_j on the diagonal, E_j in the columns of w, and I + Σ (F_j - I) in the
corner. What is left of that, the Schur complement S = I + Σ (F_j - I - E_jᵀ D_j⁻¹ E_j), is the precision of w, so that

    log|B| = Σ log|D_j| + log|S|,   precision of (v_j, w): [D_j, E_j; E_jᵀ, S + E_jᵀ D_j⁻¹ E_j],

and all of B⁻¹ that predictions, the bound's gradient and the covariance between outputs need is in the inverses of
these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from ..data.blocks import Blocks, LinearSums
from ..utils.linalg import diagonal_of, jittered_cholesky, symmetric_inverse, triangular_inverse
from .predictor import CoefficientPrior, diagonal_gap
from .statistics import Residuals, StatisticsGradient, SufficientStatistics, Whitening, errors

PosteriorFamily = Literal["full", "diagonal"]

LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class WhitenedPosterior:
    """The optimal q(ω) of one output: N(mean, B⁻¹).

    Attributes
    ----------
    B, root, root_inv : ndarray of shape (m + p, m + p)
        Precision, its lower Cholesky factor, and the inverse of that.
    mean : ndarray of shape (m + p,)
    n_own : int
        How many of the first coordinates are counted here: m if w is shared and counted with another output.
    """

    B: np.ndarray
    root: np.ndarray
    root_inv: np.ndarray
    mean: np.ndarray
    n_own: int

    @property
    def log_det(self) -> float:
        """log|B|; where w is counted elsewhere, that of v given w."""
        return 2.0 * float(np.log(diagonal_of(self.root)[: self.n_own]).sum())


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
        """What makes Pᵀ of [V; Hᵀ] for each output, (o, m + p), where the weights are independent a priori."""
        (o, p), m = self.prior.scale.shape, len(self.statistics.VV)
        scales = np.empty((o, m + p))
        scales[:, :m] = np.sqrt(self.signal)[:, np.newaxis]
        scales[:, m:] = self.prior.scale
        return scales

    def weights_of(self, index: int, omega: np.ndarray) -> np.ndarray:
        """T ω, (m + p) or (m + p, k), with P = [Vᵀ, H] T of an output: what [V; Hᵀ] is multiplied by."""
        return self._times(index, omega, lambda root: root)

    def pulled_back(self, index: int, sums: np.ndarray) -> np.ndarray:
        """Tᵀ of sums over [V; Hᵀ], (m + p) or (m + p, k): those over Pᵀ."""
        return self._times(index, sums, np.transpose)

    def _times(self, index: int, given: np.ndarray, root_of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        found = (self.scales[index] * given.T).T
        if self.prior.root is not None:
            m = len(self.statistics.VV)
            found[m:] = root_of(self.prior.root[index]) @ given[m:]
        return found


def projected(group: Group, index: int) -> tuple[np.ndarray, np.ndarray]:
    """PᵀP (m + p, m + p) and Pᵀr (m + p,) of a group's output."""
    statistics, scales = group.statistics, group.scales[index]
    sums = np.concatenate([statistics.VR[:, index], statistics.HR[:, index]])
    if group.prior.root is not None:
        return group.pulled_back(index, group.pulled_back(index, statistics.joint).T), group.pulled_back(index, sums)
    PP = np.multiply.outer(scales, scales)
    PP *= statistics.joint
    return PP, scales * sums


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
    return WhitenedPosterior(B, root, root_inv, root_inv.T @ (root_inv @ g), len(B))


def optimal_posteriors(groups: Sequence[Group]) -> list[list[WhitenedPosterior]]:
    """The posterior of each output, by group; of outputs that share their weights, from the data of all of them."""
    if not groups[0].prior.shared:
        return [[optimal_posterior(group, o) for o in range(len(group.noise))] for group in groups]
    p = groups[0].prior.scale.shape[1]
    each, S, sizes, g_w = [], np.eye(p), np.ones(p), -groups[0].prior.reference[0]
    for group in groups:
        m = len(group.statistics.VV)
        for o, noise in enumerate(group.noise):
            PP, g = projected(group, o)
            PP /= noise
            g /= noise
            diagonal_of(PP)[:m] += 1.0
            D_root = jittered_cholesky(PP[:m, :m])
            D_root_inv = triangular_inverse(D_root)
            A, z = D_root_inv @ PP[:m, m:], D_root_inv @ g[:m]
            S += PP[m:, m:] - A.T @ A
            sizes += diagonal_of(PP)[m:]
            g_w += g[m:] - A.T @ z
            each.append((PP, D_root, D_root_inv, A, z))
    S_root = jittered_cholesky(S, sizes=sizes)
    # With the jitter, if it needed one.
    S = S_root @ S_root.T
    S_root_inv = triangular_inverse(S_root)
    w = S_root_inv.T @ (S_root_inv @ g_w)
    found = []
    for index, (B, D_root, D_root_inv, A, z) in enumerate(each):
        m = len(D_root)
        B[m:, m:] = S + A.T @ A
        root, root_inv = np.zeros(B.shape), np.zeros(B.shape)
        root[:m, :m], root[m:, :m], root[m:, m:] = D_root, A.T, S_root
        root_inv[:m, :m], root_inv[m:, m:] = D_root_inv, S_root_inv
        root_inv[m:, :m] = -S_root_inv @ (A.T @ D_root_inv)
        mean = np.concatenate([D_root_inv.T @ (z - A @ w), w])
        found.append(WhitenedPosterior(B, root, root_inv, mean, m if index else m + p))
    in_order = iter(found)
    return [[next(in_order) for _ in group.noise] for group in groups]


def bounds_at_optimum(groups: Sequence[Group], family: PosteriorFamily) -> list[BoundAtOptimum]:
    """The bound of each group of a model's outputs, which perhaps share their weights."""
    posteriors = optimal_posteriors(groups)
    return [BoundAtOptimum(group, family, own) for group, own in zip(groups, posteriors, strict=True)]


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
    posteriors : list of WhitenedPosterior, default=None
        One per output, of `optimal_posteriors`; None where no other group shares the weights.

    Attributes
    ----------
    posteriors : list of WhitenedPosterior
    weights : ndarray of shape (m + p, o)
        e = r - [V; Hᵀ]ᵀ weights.
    gradient : StatisticsGradient
        Of the bound.

    Raises
    ------
    NotPositiveDefiniteError
        If the sums are not finite.
    """

    def __init__(self, group: Group, family: PosteriorFamily, posteriors: list[WhitenedPosterior] | None = None):
        posteriors = optimal_posteriors([group])[0] if posteriors is None else posteriors
        statistics, scales, noise = group.statistics, group.scales, group.noise
        joint, m = statistics.joint, len(statistics.VV)
        self.group, self.posteriors = group, posteriors
        mean = np.array([q.mean for q in posteriors])
        self.weights = (scales * mean).T
        if group.prior.root is not None:
            self.weights[m:] = group.prior.times(mean[:, m:]).T
        joint_bar, factor_bar = np.zeros(joint.shape), np.zeros((m, m))
        # Of each output: log|B| (and twice the gap), and derivatives of the bound in log s² and log 1/σ² by way of B.
        log_det, from_signal, from_noise = np.empty((3, len(noise)))
        for o, q in enumerate(posteriors):
            log_det[o] = q.log_det
            B_bar = -0.5 * symmetric_inverse(q.root_inv)
            if family == "diagonal":
                gap, gap_B_bar, gap_factor_bar = diagonal_gap(q.B, log_det[o], B_bar, group.whitening)
                log_det[o] += 2.0 * gap
                B_bar -= gap_B_bar
                factor_bar -= gap_factor_bar
            if group.prior.root is None:
                B_bar *= np.multiply.outer(scales[o] / noise[o], scales[o])
            else:
                B_bar = group.weights_of(o, group.weights_of(o, B_bar).T) / noise[o]
            joint_bar += B_bar
            from_signal[o], from_noise[o] = np.vdot(B_bar[:m], joint[:m]), np.vdot(B_bar, joint)
        unexplained_bar = -0.5 * group.signal / noise
        self.gradient = StatisticsGradient(
            joint_bar[:m, :m],
            2.0 * joint_bar[:m, m:],
            self.weights[:m] / noise,
            0.0 if group.complete else unexplained_bar.sum(),
            factor_bar,
        )
        unexplained = unexplained_bar * statistics.unexplained
        mean[:, m:] += group.prior.reference
        if group.prior.shared:
            for own, q in zip(mean, posteriors, strict=True):
                own[q.n_own :] = 0.0
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
        return Residuals(np.maximum(squares, 0.0), VE, HE)

    def left_over(self, blocks: Blocks | None) -> Residuals:
        """The same from the rows, where no digits cancel; from the statistics if these are all there is."""
        seen = self.group.whitening, self.group.outputs, self.weights
        return self.residuals() if blocks is None else errors(blocks, *seen)

    def value(self, residuals: Residuals) -> float:
        """The bound, in nats."""
        return float((self._value - 0.5 * residuals.squares / self.group.noise).sum())

    def finish(self, residuals: Residuals) -> tuple[float, dict[str, np.ndarray]]:
        """The bound, and its gradients (o,) in log s² and log σ²."""
        signal = self._log_signal + 0.5 * (self.gradient.VE * residuals.VE).sum(axis=0)
        noise = self._log_noise + 0.5 * residuals.squares / self.group.noise
        return self.value(residuals), {"signal": signal, "noise": noise}


def unsolved(group: Group, posteriors: Sequence[WhitenedPosterior], left: Residuals) -> list[np.ndarray]:
    """What each mean, by the errors that it leaves, is short of as the solution of B mean = g: g - B mean (m + p,).

    As σ⁻² Pᵀe - mean - (0, w₀) it keeps the digits that B, g and their solution have lost (Higham 2002, section 12.1).
    """
    PE, m, found = np.concatenate([left.VE, left.HE]), len(left.VE), []
    for o, q in enumerate(posteriors):
        prior = q.mean + np.concatenate([np.zeros(m), group.prior.reference[o]])
        prior[q.n_own :] = 0.0
        found.append(group.pulled_back(o, PE[:, o]) / group.noise[o] - prior)
    return found


def shortfall(bounds: Sequence[BoundAtOptimum], left: Sequence[Residuals]) -> float:
    """By how much rounding keeps the bounds' means from their least squares, in nats: ½ ρᵀB⁻¹ρ, with ρ = g - B mean."""
    halves = []
    for bound, own in zip(bounds, left, strict=True):
        for q, rest in zip(bound.posteriors, unsolved(bound.group, bound.posteriors, own), strict=True):
            halves.append(np.split(q.root_inv @ rest, [len(own.VE)]))
    of_v, of_w = zip(*halves, strict=True)
    # Weights that outputs share have the sum of what these say.
    of_w = (np.sum(of_w, axis=0),) if bounds[0].group.prior.shared else of_w
    return 0.5 * float(sum(half @ half for half in (*of_v, *of_w)))


def upper_bound(groups: Sequence[Group], blocks: Blocks | None = None) -> float:
    """No less than the log marginal likelihood at these parameters, summed over outputs, whatever q is.

    With Q = UᵀK⁻¹U + HΣ_βHᵀ, r = y - Hμ_β and t = Σ(k(x, x) - q(x, x)), the trace of what the inducing points leave of
    the covariance, which is no less than its largest eigenvalue,

        -½ [N log 2π + log|Q + σ²I| + rᵀ (Q + (σ² + t) I)⁻¹ r]

    (Titsias 2014, "Variational inference for Gaussian and determinantal point processes"; HΣ_βHᵀ is on both sides).
    The last term is the least of |r - Pω|² / (σ² + t) + |ω|², so that it is that of the bound with a noise of σ² + t.
    An ω that rounding keeps from there makes it lower: what that costs is added. (log|B| is good to what sums hold.)
    Inducing points that are all rows leave only what a jitter j makes of K: K - K (K + jI)⁻¹ K has no eigenvalue above
    j, and a row that comes or counts often makes that so many times larger. (Where outputs share their weights, y, σ²
    and t are those of all outputs, one after the other.)

    Parameters
    ----------
    groups : sequence of Group
        Of all outputs of a model.
    blocks : Blocks, default=None
        The rows, for errors summed row by row (see `BoundAtOptimum`); None takes them from the statistics.

    Returns
    -------
    bound : float
        In nats.
    """
    wide, log_ratio = [], 0.0
    for group in groups:
        statistics, left_over = group.statistics, group.statistics.unexplained
        if group.complete:
            n_left = statistics.n_rows + statistics.surplus - len(statistics.VV)
            left_over = group.whitening.jitter() * max(n_left + 1, 1)
        noise = group.noise + group.signal * left_over
        wide.append(replace(group, noise=noise, statistics=replace(statistics, unexplained=0.0)))
        log_ratio += float(statistics.n_rows * np.log(noise / group.noise).sum())
    # The likelihood with this noise and without a trace term, but for its determinant.
    bounds = bounds_at_optimum(wide, "full")
    left = [bound.left_over(blocks) for bound in bounds]
    total = sum(bound.value(own) for bound, own in zip(bounds, left, strict=True)) + shortfall(bounds, left)
    log_det = log_ratio + sum(q.log_det for bound in bounds for q in bound.posteriors)
    log_det -= sum(q.log_det for own in optimal_posteriors(groups) for q in own)
    return total + 0.5 * log_det


def bounds_alone(sums: LinearSums, prior: CoefficientPrior, noise: np.ndarray, trace: np.ndarray) -> np.ndarray:
    """The bound (o,) of each output with q(f) at its prior, all that the features leave over being noise.

    Parameters
    ----------
    sums : LinearSums
    prior : CoefficientPrior
    noise : ndarray of shape (o,)
        Its variance.
    trace : ndarray of shape (o,)
        Σ ω k(x, x).

    Returns
    -------
    bounds : ndarray of shape (o,)
        In nats; where outputs share their weights, these are counted with the first.
    """
    p, groups = prior.scale.shape[1], []
    VV, VH, VR = np.zeros((0, 0)), np.zeros((0, p)), np.zeros((0, 1))
    for index, (variance, left) in enumerate(zip(noise, trace, strict=True)):
        output = slice(index, index + 1)
        products = VV, VH, VR, *sums.of(output)
        statistics = SufficientStatistics(sums.n_rows, *products, float(left), sums.log_variance, sums.surplus)
        whitening = Whitening(None, VV, VV)
        groups.append(Group(output, whitening, statistics, np.ones(1), np.array([variance]), prior.outputs(output)))
    return np.array([bound.value(bound.residuals()) for bound in bounds_at_optimum(groups, "full")])
