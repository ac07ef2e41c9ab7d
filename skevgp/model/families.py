"""The families of q(ω) for mini-batches: their parameters, and their terms in the paper's loss with gradients.

For each output q(ω) = N(mean, S), in the whitened coordinates of `bounds`. The covariance S (m + p, m + p) enters the
loss (the paper's eq. elbo) through ½ [Tr((I + σ⁻² PᵀP) S) - log|S|], with P = [s Vᵀ, H diag(c)] (n, m + p). Each row of
a mini-batch counts N/n times. This equals a noise variance of σ² n/N, which is a group's ``noise`` in this module.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..utils.linalg import diagonal_of, jittered_cholesky, symmetric_inverse, times_lower, triangular_inverse
from .bounds import Group, WhitenedPosterior, diagonal_root, log_variances
from .parameters import Parameter, Values


@dataclass
class SpreadTerms:
    """The terms of the covariances S in the loss of a group, and their gradients."""

    # Σ over outputs of ½ [Tr((I + σ⁻² PᵀP) S) - log|S|].
    value: float
    # Gradients in V Vᵀ (m, m), V H (m, p) and, as Lᵀ L̄, in L (m, m): see `StatisticsGradient`.
    VV: np.ndarray
    VH: np.ndarray
    factor: np.ndarray
    # (o,): gradients in log s² and log σ².
    log_signal: np.ndarray
    log_noise: np.ndarray
    # (o, k): gradients in the coordinates of the parameter ``spread``. k is 0 if there is none.
    spread: np.ndarray
    # (o, p): gradients in the logarithms of the weights' scales.
    log_scale: np.ndarray

    @classmethod
    def zeros(cls, m: int, p: int, o: int, k: int) -> SpreadTerms:
        return cls(
            value=0.0,
            VV=np.zeros((m, m)),
            VH=np.zeros((m, p)),
            factor=np.zeros((m, m)),
            log_signal=np.zeros(o),
            log_noise=np.zeros(o),
            spread=np.zeros((o, k)),
            log_scale=np.zeros((o, p)),
        )

    def add_output(self, o: int, group: Group, S_v: np.ndarray, rows: np.ndarray, penalty: float) -> None:
        """Add the terms of output o: S_v (m, m + p) of S, the diagonal of σ⁻² PᵀP S (m + p,), and Tr(S) - log|S|."""
        m, s = len(group.whitening.L), np.sqrt(group.signal[o])
        # The trace of a product of two covariances is not negative. Rounding may make it so.
        self.value += 0.5 * (max(float(rows.sum()), 0.0) + penalty)
        self.VV += (0.5 * group.signal[o] / group.noise[o]) * S_v[:, :m]
        self.VH += (s / group.noise[o]) * S_v[:, m:] * group.prior.scale[o]
        self.log_signal[o] = 0.5 * rows[:m].sum()
        self.log_noise[o] = -0.5 * rows.sum()
        self.log_scale[o] = rows[m:]


class _GradientFamily:
    """A family whose mean (o, m + p) and ``spread`` (o, k) are parameters of an optimiser."""

    # Where they start: at the optimum.
    _mean: np.ndarray
    _spread: np.ndarray

    def parameters(self, mean_unit: np.ndarray) -> list[Parameter]:
        """The parameters, with the mean in units of ``mean_unit`` (o, m + p)."""
        return [Parameter("mean", self._mean, unit=mean_unit), Parameter("spread", self._spread)]

    def mean(self, values: Values, group: Group) -> np.ndarray:
        """E[ω] (o, m + p) of a group's outputs."""
        return values["mean"][group.outputs]

    def means(self, values: Values) -> list[np.ndarray]:
        """E[ω] (m + p,) of each output."""
        return list(values["mean"])


class DiagonalFamily(_GradientFamily):
    """The paper's q, with independent inducing values and weights.

    It starts at ``optima``, the best full q of each output, which have its mean. ``L_inv`` is (m, m) for each output.
    """

    # S = blockdiag(L⁻¹ diag(d) L⁻ᵀ, diag(e)), where d (m,), in units of s², and e (p,) are variances of f_m and w.
    # Their logarithms are the spread. The outputs of a group share both products of (m, m) matrices.

    def __init__(self, optima: Sequence[WhitenedPosterior], L_inv: Sequence[np.ndarray]):
        self._mean = np.array([q.mean for q in optima])
        self._spread = np.array(
            [np.concatenate(log_variances(q.B, factor)) for q, factor in zip(optima, L_inv, strict=True)]
        )

    def terms(self, values: Values, group: Group) -> SpreadTerms:
        """The terms of the covariances in the loss of a group."""
        statistics, L_inv, m = group.statistics, group.whitening.L_inv, len(group.whitening.L)
        log_variance = values["spread"][group.outputs]
        variance = np.exp(log_variance)
        d = variance[:, :m]
        ratio = (group.signal / group.noise)[:, np.newaxis]
        VVL = times_lower(statistics.VV, L_inv)
        # (o, m + p): the terms of each variance in Tr(σ⁻² PᵀP S) and in Tr(S).
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
            value=float(value),
            VV=0.5 * (LD @ LD.T),
            VH=np.zeros_like(statistics.VH),
            factor=factor_bar,
            log_signal=0.5 * from_data[:, :m].sum(axis=1),
            log_noise=-0.5 * from_data.sum(axis=1),
            spread=0.5 * (from_data + from_prior - 1.0),
            log_scale=from_data[:, m:],
        )

    def roots(self, values: Values, L_inv: Sequence[np.ndarray]) -> list[np.ndarray]:
        """R (m + p, m + p) of each output with S = Rᵀ R."""
        m = len(L_inv[0])
        return [
            diagonal_root(spread[:m], spread[m:], factor)
            for spread, factor in zip(values["spread"], L_inv, strict=True)
        ]


class FullFamily(_GradientFamily):
    """q as one joint Gaussian of inducing values and weights. It starts at ``optima``, the best q of each output."""

    # S = R Rᵀ with R = R₀ T, all (m + p, m + p), where R₀ R₀ᵀ is the best covariance at the start. T is lower
    # triangular. The spread contains the log of its diagonal, then the entries below. A step of one size therefore
    # means the same in directions that the data fix to 1e-4 and in those that they do not fix.

    def __init__(self, optima: Sequence[WhitenedPosterior]):
        self._mean = np.array([q.mean for q in optima])
        self._start = [q.root_inv.T for q in optima]
        self._start_log_det = [2.0 * np.log(np.abs(np.diagonal(root))).sum() for root in self._start]
        self._size = len(self._start[0])
        self._below = np.tril_indices(self._size, -1)
        self._spread = np.zeros((len(self._mean), self._size * (self._size + 1) // 2))

    def terms(self, values: Values, group: Group) -> SpreadTerms:
        """The terms of the covariances in the loss of a group."""
        (m, p), size = group.statistics.VH.shape, self._size
        spread = values["spread"][group.outputs]
        terms = SpreadTerms.zeros(m, p, *spread.shape)
        for o, coordinates in enumerate(spread):
            output = group.outputs.start + o
            T = self._triangular(coordinates)
            R = self._start[output] @ T
            PP, _ = group.products(o)
            PPR = PP @ R
            PPR /= group.noise[o]
            log_det = self._start_log_det[output] + 2.0 * coordinates[:size].sum()
            rows = np.einsum("ij,ij->i", PPR, R)
            terms.add_output(o, group, R[:m] @ R.T, rows, float(np.vdot(R, R)) - log_det)
            PPR += R
            T_bar = self._start[output].T @ PPR
            terms.spread[o, :size] = np.diagonal(T_bar) * np.diagonal(T) - 1.0
            terms.spread[o, size:] = T_bar[self._below]
        return terms

    def roots(self, values: Values, L_inv: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Rᵀ of each output."""
        return [
            (start @ self._triangular(spread)).T for start, spread in zip(self._start, values["spread"], strict=True)
        ]

    def _triangular(self, coordinates: np.ndarray) -> np.ndarray:
        """T, from the spread of one output."""
        T = np.zeros((self._size, self._size))
        diagonal_of(T)[...] = np.exp(coordinates[: self._size])
        T[self._below] = coordinates[self._size :]
        return T


class NaturalFamily:
    """q as one joint Gaussian with natural gradient steps. It has a state and no parameters for an optimiser.

    The state starts at ``optima``, the best q of each output. Steps have the length ``rate`` at first, and at least
    ``least_rate``, both in (0, 1].
    """

    # The state of each output is its natural parameters Λ = S⁻¹ (m + p, m + p) and Λ mean (m + p,). A natural gradient
    # step of length ρ moves them by the share ρ to the optimum for the rows at hand (Hensman et al. 2013, section 3,
    # the updates of the canonical parameters), with B and g of `bounds`:
    #
    #     Λ <- (1 - ρ) Λ + ρ B,   Λ mean <- (1 - ρ) Λ mean + ρ g.

    def __init__(self, optima: Sequence[WhitenedPosterior], rate: float, least_rate: float):
        self.rate, self._first_rate, self._least_rate = rate, rate, least_rate
        self.precision = [q.B.copy() for q in optima]
        self.shift = [q.B @ q.mean for q in optima]
        self._mean = [q.mean for q in optima]
        self._root_inv = [q.root_inv for q in optima]

    def pace(self, share: float) -> None:
        """Set the step to ``share`` times the first: q averages over more rows as other parameters slow down."""
        self.rate = max(share * self._first_rate, self._least_rate)

    def forget(self) -> None:
        """Forget the state. From now on each step leads to the optimum for its rows."""
        self.rate = 1.0
        for state in (*self.precision, *self.shift):
            state[...] = 0.0

    def parameters(self, mean_unit: np.ndarray) -> list[Parameter]:
        """No parameters."""
        return []

    def mean(self, values: Values, group: Group) -> np.ndarray:
        """Move the state of a group's outputs by one step, and return their E[ω] (o, m + p)."""
        m = len(group.whitening.L)
        for o, output in enumerate(range(group.outputs.start, group.outputs.stop)):
            PP, Pr = group.products(o)
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
        """E[ω] (m + p,) of each output after the last step."""
        return list(self._mean)

    def terms(self, values: Values, group: Group) -> SpreadTerms:
        """The terms of the covariances in the loss of a group, after the step of `mean`."""
        m, p = group.statistics.VH.shape
        terms = SpreadTerms.zeros(m, p, len(group.signal), 0)
        for o, output in enumerate(range(group.outputs.start, group.outputs.stop)):
            root_inv = self._root_inv[output]
            S = symmetric_inverse(root_inv)
            PP, _ = group.products(o)
            rows = np.einsum("ij,ij->i", PP, S) / group.noise[o]
            log_det = 2.0 * np.log(np.diagonal(root_inv)).sum()
            terms.add_output(o, group, S[:m], rows, float(np.trace(S)) - log_det)
        return terms

    def roots(self, values: Values, L_inv: Sequence[np.ndarray]) -> list[np.ndarray]:
        """R (m + p, m + p) of each output with S = Rᵀ R."""
        return list(self._root_inv)


Family = DiagonalFamily | FullFamily | NaturalFamily
