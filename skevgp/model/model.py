"""The sparse model of some outputs on some rows: parameters -> groups of outputs, bound, predictor."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..data.blocks import Blocks
from ..data.rows import Rows
from ..utils.linalg import JITTER, Jitter
from .bounds import (
    Group,
    PosteriorFamily,
    WhitenedPosterior,
    bounds_at_optimum,
    optimal_posteriors,
    unsolved,
    upper_bound,
)
from .parameters import Parameter, Values
from .predictor import CoefficientPrior, Predictor, PredictorGroup, diagonal_root, log_variances
from .statistics import Kernel, SufficientStatistics, Whitening, collect, errors

# An error of the precision of q where that is 1.
_REFINABLE = 0.1


@dataclass(frozen=True)
class SparseModel:
    """Covariance, prior and family of q: all that a bound needs but the rows and the parameters.

    Its parameters are ``hyperparameters``, ``signal``, ``noise`` and ``inducing_points``.

    Attributes
    ----------
    kernel : Kernel
        k̃, of unit signal variance.
    prior : CoefficientPrior
        Of o outputs.
    family : {"full", "diagonal"}
    groups : tuple of slice
        The outputs that each set of inducing points serves.
    jitter : Jitter, default=Jitter()
        Of k(X_m, X_m).
    complete : bool, default=False
        Whether the inducing points are all rows: the bound is then the likelihood, and what is left of k(x, x) - |v|²
        is rounding.
    kernels : tuple of Kernel, optional
        If rows are split by groups, which then have inputs of their own or are joined by their weights: that of each
        group. All have the same hyperparameters, or, where these are of shape (g, n_hyper), each its own.
    """

    kernel: Kernel
    prior: CoefficientPrior
    family: PosteriorFamily
    groups: tuple[slice, ...]
    jitter: Jitter = JITTER
    complete: bool = False
    kernels: tuple[Kernel, ...] | None = None

    def kernel_of(self, values: Values, group: int) -> tuple[Kernel, np.ndarray]:
        """k̃ of a group, and its hyperparameters (n_hyper,)."""
        hyperparameters = values["hyperparameters"]
        own = hyperparameters if hyperparameters.ndim == 1 else hyperparameters[group]
        return self.kernel if self.kernels is None else self.kernels[group], own

    def set_of(self, output: int, parameter: Parameter) -> int:
        """Which row of a parameter, of all groups or of each, belongs to an output."""
        if parameter.start.ndim == 1:
            return 0
        return next(i for i, group in enumerate(self.groups) if group.start <= output < group.stop)

    def blocks(self, rows: Rows, n_inducing: int) -> Blocks:
        """The rows of its outputs as blocks."""
        if self.kernels is None:
            return rows.blocks(self.kernel, n_inducing)
        return rows.blocks(self.kernels, n_inducing, self.groups)

    def whitenings(self, values: Values) -> Iterator[Whitening]:
        """Of each set of inducing points."""
        for index, points in enumerate(values["inducing_points"]):
            yield Whitening.of(*self.kernel_of(values, index), points, self.jitter)

    def groups_on(
        self, values: Values, blocks: Blocks, whitenings: Iterable[Whitening] | None = None
    ) -> Iterator[Group]:
        """Each group with the statistics of some rows: a pass over them for each, when it is asked for."""
        for outputs, whitening in zip(self.groups, whitenings or self.whitenings(values), strict=True):
            yield self.group(values, outputs, whitening, collect(blocks, whitening, outputs))

    def groups_of(
        self,
        values: Values,
        statistics: Sequence[SufficientStatistics],
        whitenings: Iterable[Whitening] | None = None,
    ) -> Iterator[Group]:
        """Each group with its statistics, which were collected for the same hyperparameters and inducing points."""
        for outputs, whitening, own in zip(self.groups, whitenings or self.whitenings(values), statistics, strict=True):
            yield self.group(values, outputs, whitening, own)

    def group(self, values: Values, outputs: slice, whitening: Whitening, statistics: SufficientStatistics) -> Group:
        """What belongs to one set of inducing points."""
        signal, noise = values["signal"][outputs], values["noise"][outputs]
        if self.complete:
            statistics = replace(statistics, unexplained=0.0)
        return Group(outputs, whitening, statistics, signal, noise, self.prior.outputs(outputs), self.complete)

    def statistics(
        self, values: Values, blocks: Blocks, whitenings: Iterable[Whitening] | None = None
    ) -> list[SufficientStatistics]:
        """The statistics of each group.

        As they are, also where the points are all rows: after `partial_fit` they no longer will be.
        """
        sets = zip(self.groups, whitenings or self.whitenings(values), strict=True)
        return [collect(blocks, whitening, outputs) for outputs, whitening in sets]

    def bound(self, values: Values, statistics: Sequence[SufficientStatistics], blocks: Blocks | None = None) -> float:
        """The bound with q at its optimum; arguments as of `upper_bound`."""
        bounds = bounds_at_optimum(list(self.groups_of(values, statistics)), self.family)
        return sum(bound.value(bound.left_over(blocks)) for bound in bounds)

    def at_optimum(
        self,
        values: Values,
        statistics: Sequence[SufficientStatistics],
        whitenings: Iterable[Whitening] | None = None,
        blocks: Blocks | None = None,
    ) -> Predictor:
        """The predictor with q at its optimum.

        Parameters
        ----------
        values : dict
        statistics : sequence of SufficientStatistics
            What `statistics` returns for these values.
        whitenings : iterable of Whitening, default=None
            What `whitenings` yields for these values, if it is there already.
        blocks : Blocks, default=None
            All rows, for means that keep their digits in directions of which the rows say little; not for weights that
            outputs share.
        """
        groups, mean, root = list(self.groups_of(values, statistics, whitenings)), [], []
        for group, posteriors in zip(groups, optimal_posteriors(groups), strict=True):
            L_inv = group.whitening.L_inv
            for q in posteriors if blocks is None or self.prior.shared else _refined(group, posteriors, blocks):
                mean.append(q.mean)
                root.append(q.root_inv if self.family == "full" else diagonal_root(*log_variances(q.B, L_inv), L_inv))
        return self.predictor(values, [group.whitening for group in groups], mean, root)

    def upper_bound(
        self, values: Values, statistics: Sequence[SufficientStatistics], blocks: Blocks | None = None
    ) -> float:
        """No less than the log marginal likelihood: a pass over the rows for each group, if they are still there.

        Parameters
        ----------
        values, statistics
            As of `at_optimum`.
        blocks : Blocks, default=None
            All rows; without them digits cancel at high signal-to-noise ratios.
        """
        return upper_bound(list(self.groups_of(values, statistics)), blocks)

    def predictor(
        self,
        values: Values,
        whitenings: Sequence[Whitening],
        mean: Sequence[np.ndarray],
        root: Sequence[np.ndarray],
    ) -> Predictor:
        """Put q(ω) of each output, with its mean (m + p,) and covariance rootᵀ root, together with the parameters.

        Parameters
        ----------
        values : dict
        whitenings : sequence of Whitening
            What `whitenings` yields for these values.
        mean, root : sequence of ndarray
            One per output.
        """
        sets = zip(self.groups, values["inducing_points"], whitenings, strict=True)
        return Predictor(
            tuple(
                PredictorGroup.of(
                    outputs,
                    *self.kernel_of(values, index),
                    points,
                    whitening,
                    values["signal"][outputs],
                    self.prior.outputs(outputs),
                    mean[outputs],
                    root[outputs],
                )
                for index, (outputs, points, whitening) in enumerate(sets)
            ),
            values["noise"],
            self.prior.offset,
            np.zeros(len(values["noise"])),
            self.prior.shared,
        )


def _refined(group: Group, posteriors: list[WhitenedPosterior], blocks: Blocks) -> list[WhitenedPosterior]:
    """One step of iterative refinement of the means, by errors summed row by row: a pass.

    B mean = g loses digits in directions of which the rows say little: there B is about 1, and its rounding errors are
    a share of its trace. What is `unsolved` does not. Where errors of B are above `_REFINABLE` a step need not lead
    nearer, and is not taken.
    """
    weights = np.column_stack([group.weights_of(o, q.mean) for o, q in enumerate(posteriors)])
    left, found = errors(blocks, group.whitening, group.outputs, weights), []
    for q, rest in zip(posteriors, unsolved(group, posteriors, left), strict=True):
        step = q.root_inv.T @ (q.root_inv @ rest)
        refinable = np.finfo(float).eps * np.trace(q.B) < _REFINABLE
        found.append(replace(q, mean=q.mean + step) if refinable else q)
    return found
