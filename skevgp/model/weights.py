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


@dataclass(frozen=True)
class WeightLikelihood:
    """M (p, p), h (p,) and q of one output."""

    M: np.ndarray
    h: np.ndarray
    q: float

    def about(self, change: np.ndarray) -> WeightLikelihood:
        """The same likelihood about b₀ + change (p,)."""
        Mc = self.M @ change
        return WeightLikelihood(self.M, self.h - Mc, self.q - float((2.0 * self.h - Mc) @ change))

    def in_units(self, unit: float) -> WeightLikelihood:
        """The likelihood of the weights times ``unit``, for a target times ``unit``."""
        return WeightLikelihood(self.M / unit**2, self.h / unit, self.q)


def weight_likelihoods(group: Group) -> list[WeightLikelihood]:
    """The likelihood of the weights of each output of a group."""
    statistics, found = group.statistics, []
    m = len(statistics.VV)
    for o, (signal, noise) in enumerate(zip(group.signal, group.noise, strict=True)):
        # Products of [H, r], and of V with them.
        HR = statistics.HR[:, [o]]
        linear = np.block([[statistics.HH, HR], [HR.T, statistics.RR[[o]][:, np.newaxis]]])
        crossed = np.hstack([statistics.VH, statistics.VR[:, [o]]])
        VV = statistics.VV
        if group.orthogonal:
            VV, crossed = group.orthogonalised(o, crossed, linear[:-1])
        D = VV * (signal / noise)
        diagonal_of(D)[...] += 1.0
        A = triangular_inverse(jittered_cholesky(D)) @ crossed if m else crossed
        total = (linear - signal / noise * (A.T @ A)) / noise
        found.append(WeightLikelihood(total[:-1, :-1], total[:-1, -1], float(total[-1, -1])))
    return found


@dataclass(frozen=True)
class ThetaStep:
    """What the data say about z at a value ẑ, with the weights β integrated out."""

    # log p(y, ẑ) without a constant.
    value: float
    # (o, q) and (o, q, q): gradient of log p(y | z) and its Gauss-Newton information, of each output. If outputs share
    # their weights, all is in the first.
    gradient: np.ndarray
    information: np.ndarray
    # (q,): ẑ.
    z: np.ndarray
    # (o, p): the posterior mean of β, and the w₀ at which it would be the offset.
    beta: np.ndarray
    reference: np.ndarray
    # (o, d, q): K, with the weights of the columns of D.
    K: np.ndarray

    @property
    def precision(self) -> np.ndarray:
        """The posterior precision (q, q) of z."""
        return np.eye(len(self.z)) + self.information.sum(axis=0)

    def newton(self) -> np.ndarray:
        """The Newton step (q,) of z."""
        return np.linalg.solve(self.precision, self.gradient.sum(axis=0) - self.z)

    def cavity(self, output: int) -> tuple[np.ndarray, np.ndarray]:
        """Mean (q,) and precision (q, q) of z - ẑ given all outputs but one: its prior in the model of this output."""
        precision = self.precision - self.information[output]
        return np.linalg.solve(precision, self.gradient.sum(axis=0) - self.gradient[output] - self.z), precision


def theta_step(
    likelihoods: Sequence[WeightLikelihood], prior: CoefficientPrior, columns: np.ndarray, z: np.ndarray
) -> ThetaStep:
    """Value, gradient and information of z for features (h, D), where h has the prior ``prior``.

    ``columns`` (d, 2) are the feature and the parameter of each column of D. The weights of D are 0 at ẑ, and those of
    h are taken from ``prior.offset``, as in the likelihoods.
    """
    # With b = (β, 0) and β = b₀ + C w', w' = w - 0 where w ~ N(-w₀, I) (see `bounds`), the precision of w is
    # S = I + Σ_o CᵀM C, its mean S⁻¹ (Σ_o Cᵀh - w₀), and log p(y) = ½ |R⁻¹ g|² - ½ log|S| - ½ Σ_o q - ½ |w₀|². The
    # derivative of H in z is that of the columns of D, so that with the residual u = h - M b,
    #
    #     d log p / dz_k = Σ_columns (u_column β̂_feature - (M Σ_β)_column,feature),   Σ_β = C S⁻¹ Cᵀ.
    (o, p), q, roots = prior.scale.shape, len(z), prior.roots()
    offset, shared = prior.offset, prior.shared
    (feature, parameter), d = columns.T, len(columns)
    every = [list(range(o))] if shared else [[output] for output in range(o)]
    value, gradient, information = -0.5 * float(z @ z), np.zeros((o, q)), np.zeros((o, q, q))
    K, beta, reference = np.zeros((o, d, q)), np.zeros((o, p)), np.zeros((o, p))
    for outputs in every:
        S, g = np.eye(p), -prior.reference[outputs[0]]
        for output in outputs:
            C, own = roots[output], likelihoods[output]
            S = S + C.T @ own.M[:p, :p] @ C
            g = g + C.T @ own.h[:p]
            value -= 0.5 * own.q
        root_inv = triangular_inverse(jittered_cholesky(S))
        half = root_inv @ g
        value += 0.5 * float(half @ half) + float(np.log(diagonal_of(root_inv)).sum())
        value -= 0.5 * float(prior.reference[outputs[0]] @ prior.reference[outputs[0]])
        w = root_inv.T @ half
        first, MDH = outputs[0], np.zeros((p, q))
        for output in outputs:
            C, own = roots[output], likelihoods[output]
            change = C @ w
            beta[output], reference[output] = offset[output] + change, prior.reference[output] + w
            CR, by = C @ root_inv.T, beta[output, feature]
            K[output, range(d), parameter] = by
            u = own.h[p:] - own.M[p:, :p] @ change
            spread = np.einsum("dk,dk->d", own.M[p:, :p] @ CR, CR[feature])
            gradient[first] += np.bincount(parameter, u * by - spread, minlength=q)
            information[first] += K[output].T @ own.M[p:, p:] @ K[output]
            MDH += root_inv @ (C.T @ own.M[:p, p:] @ K[output])
        information[first] -= MDH.T @ MDH
    return ThetaStep(value, gradient, information, z, beta, reference, K)
