"""The posterior averaged over draws of kernel and noise: a mixture of Gaussians with the moments of all of them.

With mean μ_s(x) and variance v_s(x) of draw s of S, the mixture has the mean μ = Σ μ_s / S and the variance

    Σ (v_s + (μ_s - μ)²) / S,

and the same for covariances between rows (the law of total variance). A `Predictor` of one group for each output has
exactly these moments. Its f is Σ_s f_s, where the f_s are independent and have the covariances c_s s² k̃(x, x'; h_s),
with s² = Σ s_s² / S and c_s = s_s² / (S s²). The points of draw s are about f_s. So [V; Hᵀ] has V = (√c_1 V_1, ...,
√c_S V_S), and s² (k̃(x, x) - |V|²) is the mean of the draws' unexplained variances. The rows of the root are those of
all draws, divided by √S, and one row (μ_s - μ) / √S for each draw. The latter rows of all outputs of a model belong to
the same draws, which makes the outputs correlated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from scipy.linalg import block_diag

from ..data.rows import Rows
from ..kernels.mixture import Mixture, StackedAt
from .model import SparseModel
from .parameters import Values
from .posterior import FittedPosterior
from .predictor import CoefficientPrior, Predictor, PredictorGroup
from .roots import BlockRoot
from .statistics import Whitening
from .weights import WeightLikelihood


@dataclass(frozen=True)
class StackedWhitening:
    """The whitenings of all draws as one of all of their points, with a block for each draw.

    It has what predictions need of a `Whitening`.
    """

    parts: tuple[Whitening, ...]
    # (S,): c_s.
    factors: np.ndarray

    @property
    def covariance(self) -> StackedAt:
        """The covariance of f = Σ_s f_s at the points."""
        return StackedAt([part.covariance for part in self.parts], self.factors.tolist())

    @property
    def L(self) -> np.ndarray:
        """The lower Cholesky factor of k(X_m, X_m)."""
        return block_diag(*(np.sqrt(c) * part.L for c, part in self._pairs()))

    @property
    def L_inv(self) -> np.ndarray:
        """The inverse of L."""
        return block_diag(*self._inverses)

    def times_inverse(self, U: np.ndarray) -> np.ndarray:
        """L⁻¹ U for U (..., m, n)."""
        return self._times(self._inverses, U)

    def times_inverse_transposed(self, U: np.ndarray) -> np.ndarray:
        """L⁻ᵀ U for U (..., m, n)."""
        return self._times(self._inverses.transpose(0, 2, 1), U)

    def solve(self, prepared: Any, out: np.ndarray) -> np.ndarray:
        """V = L⁻¹ k(X_m, X), written to ``out`` (m, n)."""
        for (c, part), own in zip(self._pairs(), self._split(out), strict=True):
            part.solve(prepared, own)
            own *= np.sqrt(c)
        return out

    def remaining(self, prepared: Any, V: np.ndarray) -> np.ndarray:
        """The variance k(x, x) - |v|² (n,) for a prediction: each draw's is clipped at its rounding error."""
        sets = zip(self._pairs(), self._split(V), strict=True)
        return np.sum([c * part.remaining(prepared, own / np.sqrt(c)) for (c, part), own in sets], axis=0)

    @cached_property
    def _inverses(self) -> np.ndarray:
        """The inverse of L as its blocks (S, m / S, m / S)."""
        return np.array([part.L_inv / np.sqrt(c) for c, part in self._pairs()])

    def _times(self, blocks: np.ndarray, U: np.ndarray) -> np.ndarray:
        """The product of a matrix with these blocks and U (..., m, n)."""
        return (blocks @ U.reshape(*U.shape[:-2], *blocks.shape[:2], -1)).reshape(U.shape)

    def _pairs(self) -> list[tuple[float, Whitening]]:
        return list(zip(self.factors.tolist(), self.parts, strict=True))

    def _split(self, U: np.ndarray) -> list[np.ndarray]:
        return np.split(U, len(self.parts), axis=-2)


def mixed(draws: Sequence[Predictor]) -> Predictor:
    """The predictor with the moments of a mixture of some draws, which have equal weights."""
    first, groups = draws[0], []
    for of_draws in zip(*(draw.groups for draw in draws), strict=True):
        outputs = np.arange(len(first.noise))[of_draws[0].outputs].tolist()
        groups += [_mixed_group(of_draws, index, output) for index, output in enumerate(outputs)]
    # The means of all outputs move together from draw to draw.
    noise = np.mean([draw.noise for draw in draws], axis=0)
    return replace(first, groups=tuple(groups), noise=noise, n_theta=len(draws))


def _mixed_group(draws: Sequence[PredictorGroup], index: int, output: int) -> PredictorGroup:
    """The group of one output, which has a place in the group of each draw."""
    n_draws, m = len(draws), len(draws[0].points)
    signals = np.array([draw.signal[index] for draw in draws])
    signal = signals.mean()
    factors = signals / (n_draws * signal)
    # The numbers of a draw multiply √c_s v_s and h(x).
    units = [np.sqrt(c) for c in factors]
    means = np.array([draw.mean[index] for draw in draws])
    mean = np.concatenate([*(own[:m] / unit for own, unit in zip(means, units, strict=True)), means[:, m:].sum(axis=0)])
    mean /= n_draws
    # Rows of zeros are left out. The last rows are the mean of each draw less that of all.
    blocks, rows = [], np.zeros((n_draws, len(mean)))
    for s, (draw, unit, row) in enumerate(zip(draws, units, rows, strict=True)):
        own = draw.root[index]
        own = own[own.any(axis=1)]
        blocks.append(np.hstack([own[:, :m] / unit, own[:, m:]]))
        row[s * m : (s + 1) * m], row[n_draws * m :] = means[s, :m] / unit, means[s, m:]
        row -= mean
    root = BlockRoot(m, tuple(blocks), rows)
    kernel, hyperparameters = draws[0].kernel, [draw.hyperparameters for draw in draws]
    return PredictorGroup(
        outputs=slice(output, output + 1),
        kernel=Mixture(kernel, n_draws),
        hyperparameters=np.concatenate([factors, *hyperparameters]),
        points=np.concatenate([draw.points for draw in draws]),
        whitening=StackedWhitening(tuple(cast("Whitening", draw.whitening) for draw in draws), factors),
        signal=np.array([signal]),
        mean=mean[np.newaxis],
        root=root * (1.0 / np.sqrt(n_draws)),
    )


def unmixed(group: PredictorGroup) -> list[PredictorGroup]:
    """The groups of all draws of a group that `mixed` made, or the group itself."""
    whitening = group.whitening
    if not isinstance(whitening, StackedWhitening):
        return [group]
    n_draws, mixture = len(whitening.parts), group.kernel
    assert isinstance(mixture, Mixture)
    (m, d), size, groups = (len(group.points) // n_draws, group.points.shape[1]), group.mean.shape[1], []
    points, root = group.points.reshape(n_draws, m, d), group.root * np.sqrt(n_draws)
    of_all = zip(mixture.draws(group.hyperparameters), points, whitening.parts, root.blocks, root.rows, strict=True)
    for s, ((c, hyperparameters), own_points, part, block, row) in enumerate(of_all):
        of_draw = np.r_[s * m : (s + 1) * m, n_draws * m : size]
        own = np.vstack([block, (row + group.mean[0])[of_draw]])
        own[:, :m] *= np.sqrt(c)
        groups.append(
            PredictorGroup(
                outputs=group.outputs,
                kernel=mixture.kernel,
                hyperparameters=hyperparameters,
                points=own_points,
                whitening=part,
                signal=n_draws * c * group.signal,
                mean=own[-1:],
                root=own[np.newaxis, :-1],
            )
        )
    return groups


@dataclass(frozen=True)
class MixturePosterior:
    """The posterior at the mode of kernel and noise, and those at draws around it, which have equal weights."""

    mode: FittedPosterior
    draws: tuple[FittedPosterior, ...]

    @property
    def sparse(self) -> SparseModel:
        """The sparse model of the mode."""
        return self.mode.sparse

    @property
    def values(self) -> Values:
        """The parameters at the mode."""
        return self.mode.values

    @property
    def bound(self) -> float:
        """Lower bound on the log marginal likelihood at the mode."""
        return self.mode.bound

    @property
    def upper_bound(self) -> float:
        """Upper bound on the same."""
        return self.mode.upper_bound

    @cached_property
    def predictor(self) -> Predictor:
        """The predictor with the mean and the variance of all draws."""
        return mixed([draw.predictor for draw in self.draws])

    @property
    def n_contrasts(self) -> np.ndarray:
        """Number of residuals (o,) whose density the bound is about."""
        return self.mode.n_contrasts

    def weight_likelihoods(
        self, prior: CoefficientPrior | None = None, rows: Rows | None = None
    ) -> list[WeightLikelihood]:
        """The likelihood of the weights of each output at the mode."""
        return self.mode.weight_likelihoods(prior, rows)

    def moved(self, prior: CoefficientPrior, rows: Rows) -> MixturePosterior:
        """The posterior for other features of the same rows, at the same values."""
        return MixturePosterior(self.mode.moved(prior, rows), tuple(draw.moved(prior, rows) for draw in self.draws))

    def updated(self, rows: Rows, weight: float, lowest_noise: np.ndarray) -> MixturePosterior:
        """The posterior with new rows."""
        draws = tuple(draw.updated(rows, weight, lowest_noise) for draw in self.draws)
        return MixturePosterior(self.mode.updated(rows, weight, lowest_noise), draws)
