"""The families of q(ω) that mini-batches move: what each adds to the paper's loss, with hand-written gradients.

Per output q(ω) = N(mean, S), in the whitened coordinates of `bounds`. Its spread enters the loss (the paper's eq. elbo)
through ½ [Tr((I + σ⁻² PᵀP) S) - log|S|], P = [s Vᵀ, H diag(c)]. The rows of a mini-batch count N/n times: the same as
a noise variance of σ² n/N, which is what a group's ``noise`` is in this module.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..utils.linalg import diagonal_of, jittered_cholesky, symmetric_inverse, times_lower, triangular_inverse
from .bounds import Group, WhitenedPosterior, projected
from .parameters import Parameter, Values
from .predictor import diagonal_root, log_variances


@dataclass
class SpreadTerms:
    """What the spread of q adds to the loss of a group, and its gradients in what these names say.

    Attributes
    ----------
    value : float
        The sum over outputs of ½ [Tr((I + σ⁻² PᵀP) S) - log|S|].
    VV : ndarray of shape (m, m)
    VH : ndarray of shape (m, p)
    factor : ndarray of shape (m, m)
        As of `StatisticsGradient`.
    log_signal, log_noise : ndarray of shape (o,)
    spread : ndarray of shape (o, k)
        In the coordinates of the parameter ``spread``; of width 0 if there is none.
    """

    value: float
    VV: np.ndarray
    VH: np.ndarray
    factor: np.ndarray
    log_signal: np.ndarray
    log_noise: np.ndarray
    spread: np.ndarray

    @classmethod
    def zeros(cls, m: int, p: int, o: int, k: int) -> SpreadTerms:
        VV, VH, factor = np.zeros((m, m)), np.zeros((m, p)), np.zeros((m, m))
        return cls(0.0, VV, VH, factor, np.zeros(o), np.zeros(o), np.zeros((o, k)))


class Family(Protocol):
    """A family of q: its parameters, and what it does at a point of them."""

    def parameters(self, mean_unit: np.ndarray) -> list[Parameter]:
        """What an optimiser moves, started where q is best; the mean in units of ``mean_unit`` (o, m + p)."""

    def mean(self, values: Values, group: Group) -> np.ndarray:
        """E[ω] (o, m + p) of a group's outputs."""

    def terms(self, values: Values, group: Group) -> SpreadTerms:
        """The part of the loss that belongs to the spread; called after `mean`, once for each group."""

    def means(self, values: Values) -> list[np.ndarray]:
        """E[ω] of each output, as `mean` last found it."""

    def roots(self, values: Values, L_inv: Sequence[np.ndarray]) -> list[np.ndarray]:
        """R of each output with S = Rᵀ R; ``L_inv`` one per output."""


class DiagonalFamily:
    """The paper's q: independent inducing values and weights.

    S = blockdiag(L⁻¹ diag(d) L⁻ᵀ, diag(e)): d (in units of s²) and e are variances in the coordinates f_m and w. All
    outputs of a group share the two products of m-sized matrices.

    Parameters
    ----------
    optima : sequence of WhitenedPosterior
        The best unrestricted q of each output: the diagonal one has its mean.
    L_inv : sequence of ndarray of shape (m, m)
        One per output.
    """

    def __init__(self, optima: Sequence[WhitenedPosterior], L_inv: Sequence[np.ndarray]):
        self._mean = np.array([q.mean for q in optima])
        self._log_variances = np.array(
            [np.concatenate(log_variances(q.B, factor)) for q, factor in zip(optima, L_inv, strict=True)]
        )

    def parameters(self, mean_unit: np.ndarray) -> list[Parameter]:
        return [Parameter("mean", self._mean, unit=mean_unit), Parameter("spread", self._log_variances)]

    def mean(self, values: Values, group: Group) -> np.ndarray:
        return values["mean"][group.outputs]

    def means(self, values: Values) -> list[np.ndarray]:
        return list(values["mean"])

    def terms(self, values: Values, group: Group) -> SpreadTerms:
        statistics, L_inv, m = group.statistics, group.whitening.L_inv, len(group.whitening.L)
        log_variance = values["spread"][group.outputs]
        variance = np.exp(log_variance)
        d = variance[:, :m]
        ratio = (group.signal / group.noise)[:, np.newaxis]
        VVL = times_lower(statistics.VV, L_inv)
        # Tr(PᵀP S) / σ² is the sum of these over the variances.
        from_data = np.empty_like(variance)
        from_data[:, :m] = np.einsum("ij,ij->j", L_inv, VVL) * ratio
        from_data[:, m:] = group.prior.scale**2 * np.diagonal(statistics.HH) / group.noise[:, np.newaxis]
        from_data *= variance
        from_prior = variance.copy()
        from_prior[:, :m] *= np.einsum("ij,ij->j", L_inv, L_inv)
        weighted, total = (ratio * d).sum(axis=0), d.sum(axis=0)
        LD = L_inv * np.sqrt(weighted)
        factor_bar = -times_lower(VVL * weighted + L_inv * total, L_inv, transposed=True)
        diagonal_of(factor_bar)[...] += len(d)
        half_log_det = np.log(np.diagonal(group.whitening.L)).sum()
        value = 0.5 * (from_data.sum() + from_prior.sum() - log_variance.sum()) + len(d) * half_log_det
        return SpreadTerms(
            float(value),
            0.5 * (LD @ LD.T),
            np.zeros_like(statistics.VH),
            factor_bar,
            0.5 * from_data[:, :m].sum(axis=1),
            -0.5 * from_data.sum(axis=1),
            0.5 * (from_data + from_prior - 1.0),
        )

    def roots(self, values: Values, L_inv: Sequence[np.ndarray]) -> list[np.ndarray]:
        m = len(L_inv[0])
        return [
            diagonal_root(spread[:m], spread[m:], factor)
            for spread, factor in zip(values["spread"], L_inv, strict=True)
        ]


def _add_covariance(
    terms: SpreadTerms, o: int, group: Group, S_v: np.ndarray, rows: np.ndarray, penalty: float
) -> None:
    """Add one output's ½ [Tr((I + σ⁻² PᵀP) S) - log|S|].

    Parameters
    ----------
    terms : SpreadTerms
        To be added to.
    o : int
        The output's place in the group.
    group : Group
    S_v : ndarray of shape (m, m + p)
        The upper rows of S.
    rows : ndarray of shape (m + p,)
        The diagonal of σ⁻² PᵀP S.
    penalty : float
        Tr(S) - log|S|.
    """
    m, s = len(group.whitening.L), np.sqrt(group.signal[o])
    # The trace of a product of two covariances, whatever rounding says.
    terms.value += 0.5 * (max(float(rows.sum()), 0.0) + penalty)
    terms.VV += (0.5 * group.signal[o] / group.noise[o]) * S_v[:, :m]
    terms.VH += (s / group.noise[o]) * S_v[:, m:] * group.prior.scale[o]
    terms.log_signal[o] = 0.5 * rows[:m].sum()
    terms.log_noise[o] = -0.5 * rows.sum()


class FullFamily:
    """q as one joint Gaussian of inducing values and weights, moved by gradients.

    S = R Rᵀ, R = R₀ T: R₀ R₀ᵀ is the best covariance at the start, T lower triangular, with the log of its diagonal.
    So a step of one size means the same in directions that the data fix to 1e-4 and in those that they leave free.

    Parameters
    ----------
    optima : sequence of WhitenedPosterior
        The best q of each output.
    """

    def __init__(self, optima: Sequence[WhitenedPosterior]):
        self._mean = np.array([q.mean for q in optima])
        self._start = [q.root_inv.T for q in optima]
        self._start_log_det = [2.0 * np.log(np.abs(np.diagonal(root))).sum() for root in self._start]
        self._size = len(self._start[0])
        self._below = np.tril_indices(self._size, -1)

    def parameters(self, mean_unit: np.ndarray) -> list[Parameter]:
        spread = np.zeros((len(self._mean), self._size * (self._size + 1) // 2))
        return [Parameter("mean", self._mean, unit=mean_unit), Parameter("spread", spread)]

    def mean(self, values: Values, group: Group) -> np.ndarray:
        return values["mean"][group.outputs]

    def means(self, values: Values) -> list[np.ndarray]:
        return list(values["mean"])

    def terms(self, values: Values, group: Group) -> SpreadTerms:
        (m, p), size = group.statistics.VH.shape, self._size
        spread = values["spread"][group.outputs]
        terms = SpreadTerms.zeros(m, p, *spread.shape)
        for o, coordinates in enumerate(spread):
            output = group.outputs.start + o
            T = self._triangular(coordinates)
            R = self._start[output] @ T
            PP, _ = projected(group, o)
            PPR = PP @ R
            PPR /= group.noise[o]
            log_det = self._start_log_det[output] + 2.0 * coordinates[:size].sum()
            rows = np.einsum("ij,ij->i", PPR, R)
            _add_covariance(terms, o, group, R[:m] @ R.T, rows, float(np.vdot(R, R)) - log_det)
            PPR += R
            T_bar = self._start[output].T @ PPR
            terms.spread[o, :size] = np.diagonal(T_bar) * np.diagonal(T) - 1.0
            terms.spread[o, size:] = T_bar[self._below]
        return terms

    def roots(self, values: Values, L_inv: Sequence[np.ndarray]) -> list[np.ndarray]:
        return [
            (start @ self._triangular(spread)).T for start, spread in zip(self._start, values["spread"], strict=True)
        ]

    def _triangular(self, coordinates: np.ndarray) -> np.ndarray:
        T = np.zeros((self._size, self._size))
        diagonal_of(T)[...] = np.exp(coordinates[: self._size])
        T[self._below] = coordinates[self._size :]
        return T


class NaturalFamily:
    """q as one joint Gaussian, moved by natural gradients: no parameters for an optimiser, but a state of its own.

    The state is q's natural parameters Λ = S⁻¹ and Λ mean. A natural gradient of length ρ goes that share of the way
    to the optimum for the rows at hand (Hensman et al. 2013, section 3, the updates of the canonical parameters):
    Λ <- (1 - ρ) Λ + ρ B, Λ mean <- (1 - ρ) Λ mean + ρ g, with B and g of `bounds`.

    Parameters
    ----------
    optima : sequence of WhitenedPosterior
        The best q of each output: where the state starts.
    rate, least_rate : float
        ρ, above 0 and at most 1: the first one, and what it never falls below.
    """

    def __init__(self, optima: Sequence[WhitenedPosterior], rate: float, least_rate: float):
        self.rate, self._first_rate, self._least_rate = rate, rate, least_rate
        self.precision = [q.B.copy() for q in optima]
        self.shift = [q.B @ q.mean for q in optima]
        self._mean = [q.mean for q in optima]
        self._root_inv = [q.root_inv for q in optima]

    def pace(self, share: float) -> None:
        """Make the steps this share of the first: as the parameters slow down, q may average over more rows."""
        self.rate = max(share * self._first_rate, self._least_rate)

    def forget(self) -> None:
        """From now on go all the way at each step, wherever q was."""
        self.rate = 1.0
        for state in (*self.precision, *self.shift):
            state[...] = 0.0

    def parameters(self, mean_unit: np.ndarray) -> list[Parameter]:
        return []

    def mean(self, values: Values, group: Group) -> np.ndarray:
        """Move the state of a group's outputs by a step, and return their means."""
        m = len(group.whitening.L)
        for o, output in enumerate(range(group.outputs.start, group.outputs.stop)):
            PP, Pr = projected(group, o)
            precision, shift = self.precision[output], self.shift[output]
            PP *= self.rate / group.noise[o]
            diagonal_of(PP)[...] += self.rate
            Pr *= self.rate / group.noise[o]
            Pr[m:] -= self.rate * group.prior.reference[o]
            precision *= 1.0 - self.rate
            precision += PP
            shift *= 1.0 - self.rate
            shift += Pr
            root_inv = triangular_inverse(jittered_cholesky(precision))
            self._root_inv[output] = root_inv
            self._mean[output] = root_inv.T @ (root_inv @ shift)
        return np.array(self._mean[group.outputs])

    def means(self, values: Values) -> list[np.ndarray]:
        return list(self._mean)

    def terms(self, values: Values, group: Group) -> SpreadTerms:
        m, p = group.statistics.VH.shape
        terms = SpreadTerms.zeros(m, p, len(group.signal), 0)
        for o, output in enumerate(range(group.outputs.start, group.outputs.stop)):
            root_inv = self._root_inv[output]
            S = symmetric_inverse(root_inv)
            PP, _ = projected(group, o)
            rows = np.einsum("ij,ij->i", PP, S) / group.noise[o]
            log_det = 2.0 * np.log(np.diagonal(root_inv)).sum()
            _add_covariance(terms, o, group, S[:m], rows, float(np.trace(S)) - log_det)
        return terms

    def roots(self, values: Values, L_inv: Sequence[np.ndarray]) -> list[np.ndarray]:
        return list(self._root_inv)
