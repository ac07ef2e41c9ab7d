"""The sparse model of some outputs on some rows: parameters -> groups of outputs, bound, predictor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .._linalg import JITTER, Jitter
from ..optimizers.parameters import Values
from ..rows.blocks import Blocks
from .bounds import BoundAtOptimum, CoefficientPrior, Group, PosteriorFamily, diagonal_root, log_variances, upper_bound
from .posterior import Predictor, PredictorGroup
from .statistics import Kernel, SufficientStatistics, Whitening, collect


@dataclass(frozen=True)
class SparseModel:
    """Covariance, prior and family of q: all that a bound needs but the rows and the parameters.

    Its parameters are ``hyperparameters``, ``signal``, ``noise`` and ``inducing_points``.

    Attributes
    ----------
    kernel : Kernel
        k̃, of unit signal variance, with hyperparameters common to all outputs.
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
    """

    kernel: Kernel
    prior: CoefficientPrior
    family: PosteriorFamily
    groups: tuple[slice, ...]
    jitter: Jitter = JITTER
    complete: bool = False

    def whitenings(self, values: Values) -> Iterator[Whitening]:
        """Of each set of inducing points."""
        for points in values["inducing_points"]:
            yield Whitening.of(self.kernel, values["hyperparameters"], points, self.jitter)

    def groups_on(self, values: Values, blocks: Blocks) -> Iterator[Group]:
        """Each group with the statistics of some rows: a pass over them for each, when it is asked for."""
        for outputs, whitening in zip(self.groups, self.whitenings(values), strict=True):
            yield self.group(values, outputs, whitening, collect(blocks, whitening, outputs))

    def groups_of(self, values: Values, statistics: Sequence[SufficientStatistics]) -> Iterator[Group]:
        """Each group with its statistics, which were collected for the same hyperparameters and inducing points."""
        for outputs, whitening, own in zip(self.groups, self.whitenings(values), statistics, strict=True):
            yield self.group(values, outputs, whitening, own)

    def group(self, values: Values, outputs: slice, whitening: Whitening, statistics: SufficientStatistics) -> Group:
        """What belongs to one set of inducing points."""
        signal, noise = values["signal"][outputs], values["noise"][outputs]
        if self.complete:
            statistics = replace(statistics, unexplained=0.0)
        return Group(outputs, whitening, statistics, signal, noise, self.prior.outputs(outputs), self.complete)

    def statistics(self, values: Values, blocks: Blocks) -> list[SufficientStatistics]:
        """The statistics of each group."""
        return [group.statistics for group in self.groups_on(values, blocks)]

    def at_optimum(self, values: Values, statistics: Sequence[SufficientStatistics]) -> tuple[float, Predictor]:
        """The bound and the predictor with q at its optimum.

        Parameters
        ----------
        values : dict
        statistics : sequence of SufficientStatistics
            What `statistics` returns for these values.
        """
        total, whitenings, mean, root = 0.0, [], [], []
        for group in self.groups_of(values, statistics):
            bound = BoundAtOptimum(group, self.family)
            total += bound.value(bound.residuals())
            whitenings.append(group.whitening)
            L_inv = group.whitening.L_inv
            for q in bound.posteriors:
                mean.append(q.mean)
                root.append(q.root_inv if self.family == "full" else diagonal_root(*log_variances(q.B, L_inv), L_inv))
        return total, self.predictor(values, whitenings, mean, root)

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
        return sum(upper_bound(group, blocks) for group in self.groups_of(values, statistics))

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
        return Predictor(
            self.kernel,
            tuple(
                PredictorGroup.of(
                    outputs,
                    values["hyperparameters"],
                    points,
                    whitening,
                    values["signal"][outputs],
                    self.prior.scale[outputs],
                    mean[outputs],
                    root[outputs],
                )
                for outputs, points, whitening in zip(self.groups, values["inducing_points"], whitenings, strict=True)
            ),
            values["noise"],
            self.prior.offset,
            np.zeros(len(values["noise"])),
        )
