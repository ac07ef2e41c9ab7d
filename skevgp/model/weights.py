"""The likelihood of the weights with f integrated out, and what it says about parameters θ of the features.

For one output, y = H b + f + ε with f + ε ~ N(0, Σ), so that as a function of the weights b (p,)

    log N(y | H b, Σ) = const - ½ (b - b₀)ᵀ M (b - b₀) + hᵀ (b - b₀) - ½ q,
    M = HᵀΣ⁻¹H,   h = HᵀΣ⁻¹r,   q = rᵀΣ⁻¹r,   r = y - H b₀.

With Σ = σ² I + s² VᵀV (Titsias 2009), these come from the sums over rows (matrix inversion lemma):

    HᵀΣ⁻¹H = σ⁻² (HᵀH - s²σ⁻² HVᵀ (I + s²σ⁻² V Vᵀ)⁻¹ V H).

If h depends on θ, its columns are h(x; θ̂) and D = ∂h/∂z, where z are coordinates of θ that are standard normal a
priori. To first order, h(x; θ)ᵀβ = hᵀβ + D K (z - ẑ), where K = K(β̂) holds the weights of the columns of D.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..utils.linalg import diagonal_of, jittered_cholesky, triangular_inverse
from .bounds import Group
from .predictor import CoefficientPrior

# Information that is less than this share of that without f and the weights is a rounding error.
_ROUNDING = 1e-14


@dataclass(frozen=True)
class WeightLikelihood:
    """M (p, p), h (p,) and q of one output."""

    M: np.ndarray
    h: np.ndarray
    q: float
    # (p,): the diagonal of the first of the matrices whose difference M is. Its rounding errors are those of M.
    sizes: np.ndarray

    def in_units(self, unit: float) -> WeightLikelihood:
        """The likelihood of the weights times ``unit``, for a target times ``unit``."""
        return WeightLikelihood(self.M / unit**2, self.h / unit, self.q, self.sizes / unit**2)


def weight_likelihoods(group: Group) -> list[WeightLikelihood]:
    """The likelihood of the weights of each output of a group."""
    statistics, likelihoods = group.statistics, []
    m = len(statistics.VV)
    for o, (signal, noise) in enumerate(zip(group.signal, group.noise, strict=True)):
        # Products of [H, r], and of V with them.
        HR = statistics.HR[:, [o]]
        linear = np.block([[statistics.HH, HR], [HR.T, statistics.RR[[o]][:, np.newaxis]]])
        crossed = np.hstack([statistics.VH, statistics.VR[:, [o]]])
        VV = statistics.VV
        of_V = 1.0 + signal / noise * diagonal_of(VV)
        if group.variant.orthogonal:
            VV, crossed = group.orthogonalised(o, crossed, linear[:-1])
        D = VV * (signal / noise)
        diagonal_of(D)[...] += 1.0
        A = triangular_inverse(jittered_cholesky(D, sizes=of_V)) @ crossed if m else crossed
        total, sizes = (linear - signal / noise * (A.T @ A)) / noise, diagonal_of(statistics.HH) / noise
        likelihoods.append(WeightLikelihood(total[:-1, :-1], total[:-1, -1], float(total[-1, -1]), sizes))
    return likelihoods


def likelihood_of_whitened(H: np.ndarray, r: np.ndarray) -> WeightLikelihood:
    """The likelihood of the weights for features (n, p) and residuals (n,) that are multiplied by a root of Σ⁻¹."""
    M = H.T @ H
    return WeightLikelihood(M, H.T @ r, float(r @ r), diagonal_of(M))


@dataclass(frozen=True)
class ThetaStep:
    """What the data say about z at a value ẑ, with the weights β integrated out."""

    # log p(y, ẑ) without a constant.
    value: float
    # (o, q) and (o, q, q): gradient of log p(y | z), and F with the Gauss-Newton information FᵀF, of each output. If
    # outputs share their weights, all is in the first.
    gradient: np.ndarray
    root: np.ndarray
    # (q,): ẑ.
    z: np.ndarray
    # (o, p): the posterior mean of β, and the w₀ at which it would be the offset.
    beta: np.ndarray
    reference: np.ndarray
    # (o, d, q): K, with the weights of the columns of D.
    K: np.ndarray

    def deviation(self, but: int | None = None) -> Deviation:
        """The posterior standard deviations of z, given all outputs or all but one."""
        roots = self.root if but is None else np.delete(self.root, but, axis=0)
        return Deviation.of(roots.reshape(-1, len(self.z)))

    def newton(self) -> np.ndarray:
        """The Newton step (q,) of z."""
        return self.deviation().covariance_times(self.gradient.sum(axis=0) - self.z)

    def cavity(self, output: int) -> tuple[np.ndarray, Deviation]:
        """Mean (q,) and deviation of z - ẑ given all outputs but one: its prior in the model of this output."""
        deviation = self.deviation(but=output)
        gradient = np.delete(self.gradient, output, axis=0).sum(axis=0)
        return deviation.covariance_times(gradient - self.z), deviation

    def counted_twice(self) -> float:
        """Σ_o log p(y_o | other outputs) - log p(y), to first order, for outputs that do not share their weights."""
        # With log p(y_o | z) = c_o + g_oᵀ(z - ẑ) - ½ (z - ẑ)ᵀ P_o (z - ẑ), the integrals over z with the priors N(0, I)
        # and N(ẑ + m_o, (I + Σ_other P)⁻¹) have Σ g_o - ẑ and I + Σ P_o in common.
        deviation = self.deviation()
        total = self.gradient.sum(axis=0) - self.z
        common = float(np.log(deviation.widths).sum()) + 0.5 * float(total @ deviation.covariance_times(total))
        nats = 0.5 * float(self.z @ self.z) - common
        for output in range(len(self.gradient)):
            mean, others = self.cavity(output)
            nats += common - float(np.log(others.widths).sum())
            nats -= 0.5 * float(np.square(others.W.T @ mean / others.widths).sum())
        return nats


@dataclass(frozen=True)
class Deviation:
    """The covariance L Lᵀ of z whose precision is I + FᵀF, where F = U diag(s) Wᵀ and L = W diag(1 + s²)^(-1/2).

    In FᵀF, digits of directions about which the data say little are lost to those about which they say much.
    """

    # (q, q): the columns are orthogonal.
    W: np.ndarray
    # (q,): the standard deviations along them, at most 1.
    widths: np.ndarray

    @classmethod
    def of(cls, F: np.ndarray) -> Deviation:
        """The deviation for F (k, q)."""
        q = F.shape[1]
        # Parameters about which the data say nothing stay apart from the others.
        known = np.flatnonzero(np.abs(F).max(axis=0, initial=0.0) > 0.0)
        W, widths = np.eye(q), np.ones(q)
        if len(known):
            _, s, Wt = np.linalg.svd(F[:, known])
            W[np.ix_(known, known)] = Wt.T
            widths[known[: len(s)]] = 1.0 / np.hypot(1.0, s)
        return cls(W, widths)

    def covariance_times(self, gradient: np.ndarray) -> np.ndarray:
        """The covariance times a vector (q,)."""
        product: np.ndarray = self.W @ (self.widths**2 * (self.W.T @ gradient))
        return product

    @property
    def root(self) -> np.ndarray:
        """The symmetric root (q, q) of the covariance."""
        return (self.W * self.widths) @ self.W.T

    @property
    def covariance(self) -> np.ndarray:
        """The covariance (q, q)."""
        L = self.W * self.widths
        return L @ L.T

    @property
    def std(self) -> np.ndarray:
        """The standard deviations (q,)."""
        return np.sqrt(np.square(self.W * self.widths).sum(axis=1))


def information_root(information: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """F (q, q) with FᵀF = information, and a projector (q, q) on the directions in which it is no rounding error.

    The information is a difference of positive semi-definite matrices. ``sizes`` (q,) is the diagonal of the first.
    """
    by = np.sqrt(np.where(sizes > 0.0, sizes, 1.0))
    values, vectors = np.linalg.eigh(information / np.multiply.outer(by, by))
    kept = values > _ROUNDING
    F = np.zeros(information.shape)
    F[kept] = np.sqrt(values[kept])[:, np.newaxis] * vectors[:, kept].T * np.where(sizes > 0.0, by, 0.0)
    return F, by[:, np.newaxis] * (vectors[:, kept] @ vectors[:, kept].T) / by


def theta_step(
    likelihoods: Sequence[WeightLikelihood], prior: CoefficientPrior, columns: np.ndarray, z: np.ndarray
) -> ThetaStep:
    """Value, gradient and information of z for features (h, D), where h has the prior ``prior``.

    ``columns`` (d, 2) are the feature and the parameter of each column of D. The weights of D are 0 at ẑ, and those of
    h are taken from ``prior.offset``, as in the likelihoods.
    """
    # With b = (β, 0) and β = b₀ + C w, where w ~ N(-w₀, I) a priori (see `bounds`), the posterior precision of w is
    # S = I + Σ_o CᵀM C, its mean S⁻¹ (Σ_o Cᵀh - w₀), and log p(y) = ½ |R⁻¹ g|² - ½ log|S| - ½ Σ_o q - ½ |w₀|². The
    # derivative of H in z is that of the columns of D, so that with the residual u = h - M b,
    #
    #     d log p / dz_k = Σ_columns (u_column β̂_feature - (M Σ_β)_column,feature),   Σ_β = C S⁻¹ Cᵀ.
    (o, p), q, roots = prior.scale.shape, len(z), prior.roots()
    offset, shared = prior.offset, prior.shared
    (feature, parameter), d = columns.T, len(columns)
    every = [list(range(o))] if shared else [[output] for output in range(o)]
    value, gradient, root = -0.5 * float(z @ z), np.zeros((o, q)), np.zeros((o, q, q))
    K, beta, reference = np.zeros((o, d, q)), np.zeros((o, p)), np.zeros((o, p))
    for outputs in every:
        S, sizes, g = np.eye(p), np.ones(p), -prior.reference[outputs[0]]
        for output in outputs:
            C, likelihood = roots[output], likelihoods[output]
            S = S + C.T @ likelihood.M[:p, :p] @ C
            sizes += np.square(C).T @ likelihood.sizes[:p]
            g = g + C.T @ likelihood.h[:p]
            value -= 0.5 * likelihood.q
        root_inv = triangular_inverse(jittered_cholesky(S, sizes=sizes))
        half = root_inv @ g
        value += 0.5 * float(half @ half) + float(np.log(diagonal_of(root_inv)).sum())
        value -= 0.5 * float(prior.reference[outputs[0]] @ prior.reference[outputs[0]])
        w = root_inv.T @ half
        first, MDH, MDD = outputs[0], np.zeros((p, q)), np.zeros((q, q))
        slope, largest = np.zeros(q), np.zeros(q)
        for output in outputs:
            C, likelihood = roots[output], likelihoods[output]
            change = C @ w
            beta[output], reference[output] = offset[output] + change, prior.reference[output] + w
            CR, by = C @ root_inv.T, beta[output, feature]
            K[output, range(d), parameter] = by
            u = likelihood.h[p:] - likelihood.M[p:, :p] @ change
            spread = np.einsum("dk,dk->d", likelihood.M[p:, :p] @ CR, CR[feature])
            slope += np.bincount(parameter, u * by, minlength=q)
            gradient[first] -= np.bincount(parameter, spread, minlength=q)
            MDD += K[output].T @ likelihood.M[p:, p:] @ K[output]
            largest += np.square(K[output]).T @ likelihood.sizes[p:]
            MDH += root_inv @ (C.T @ likelihood.M[:p, p:] @ K[output])
        root[first], projector = information_root(MDD - MDH.T @ MDH, largest)
        gradient[first] += projector @ slope
    return ThetaStep(value, gradient, root, z, beta, reference, K)
