"""The sparse model of some outputs: from parameters and rows to groups of outputs, bounds and predictor."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..data.blocks import Blocks
from ..data.rows import Rows
from ..utils.linalg import JITTER, Jitter
from .bounds import (
    Group,
    Variant,
    WhitenedPosterior,
    bounds_at_optimum,
    diagonal_root,
    equation_errors,
    log_variances,
    optimal_posteriors,
    upper_bound,
)
from .parameters import Parameter, Values
from .predictor import CoefficientPrior, Predictor, PredictorGroup
from .statistics import Kernel, SufficientStatistics, Whitening, collect, errors
from .weights import WeightLikelihood, weight_likelihoods


@dataclass(frozen=True)
class SparseModel:
    """Covariance, prior of the weights and variant for o outputs.

    The parameters (`Values`) are ``hyperparameters``, ``signal``, ``noise`` and ``inducing_points``. Each method that
    takes ``whitenings`` computes them if they are None.
    """

    # k̃, of unit signal variance.
    kernel: Kernel
    prior: CoefficientPrior
    # The outputs of each set of inducing points.
    groups: tuple[slice, ...]
    variant: Variant = field(default_factory=Variant)
    # Jitter of k(X_m, X_m).
    jitter: Jitter = JITTER
    # Whether the inducing points are all rows. The bound is then the likelihood, and k(x, x) - |v|² is rounding error.
    complete: bool = False
    # The kernel of each group, if groups have inputs of their own or are joined by their weights only. All have the
    # same hyperparameters (n_hyper,), or each its own row of (g, n_hyper).
    kernels: tuple[Kernel, ...] | None = None

    def kernel_of(self, values: Values, group: int) -> tuple[Kernel, np.ndarray]:
        """k̃ of a group, and its hyperparameters (n_hyper,)."""
        hyperparameters = values["hyperparameters"]
        kernel = self.kernel if self.kernels is None else self.kernels[group]
        return kernel, hyperparameters if hyperparameters.ndim == 1 else hyperparameters[group]

    def group_of(self, output: int) -> int:
        """Index of the group of an output."""
        return next(i for i, group in enumerate(self.groups) if group.start <= output < group.stop)

    def set_of(self, output: int, parameter: Parameter) -> int:
        """Index of the row of a parameter that belongs to an output: that of its group, or 0 if all share one."""
        return 0 if parameter.start.ndim == 1 else self.group_of(output)

    def blocks(self, rows: Rows, n_inducing: int) -> Blocks:
        """Rows as blocks for this model's kernels."""
        if self.kernels is None:
            return rows.blocks(self.kernel, n_inducing)
        return rows.blocks(self.kernels, n_inducing, self.groups)

    def whitenings(self, values: Values) -> Iterator[Whitening]:
        """The whitening of each set of inducing points."""
        for index, points in enumerate(values["inducing_points"]):
            yield Whitening.of(*self.kernel_of(values, index), points, self.jitter)

    def statistics(
        self, values: Values, blocks: Blocks, whitenings: Iterable[Whitening] | None = None
    ) -> list[SufficientStatistics]:
        """The statistics of each group: a pass over the rows for each."""
        # Unlike in `group`, the unexplained variance stays if the points are all rows: `partial_fit` adds rows.
        sets = zip(self.groups, whitenings or self.whitenings(values), strict=True)
        return [collect(blocks, whitening, outputs, self._ratio(values, outputs)) for outputs, whitening in sets]

    def with_loose_charge(
        self, values: Values, statistics: Sequence[SufficientStatistics]
    ) -> list[SufficientStatistics]:
        """The same statistics, with the charge of Titsias (2009) in the tight bound, which is not below its own."""
        pairs = zip(self.groups, statistics, strict=True)
        ratios = ((self._ratio(values, outputs), sums) for outputs, sums in pairs)
        return [
            sums if ratio is None else replace(sums, charge=np.outer([1, 1], ratio * sums.unexplained))
            for ratio, sums in ratios
        ]

    def _ratio(self, values: Values, outputs: slice) -> np.ndarray | None:
        """s²/σ² (o,) of a group, for the tight bound."""
        return values["signal"][outputs] / values["noise"][outputs] if self.variant.tight else None

    def group(self, values: Values, outputs: slice, whitening: Whitening, statistics: SufficientStatistics) -> Group:
        """The group of one set of inducing points."""
        signal, noise = values["signal"][outputs], values["noise"][outputs]
        if self.complete:
            statistics = replace(statistics, unexplained=0.0, charge=0.0)
        prior = self.prior.at(values).outputs(outputs)
        return Group(
            outputs=outputs,
            whitening=whitening,
            statistics=statistics,
            signal=signal,
            noise=noise,
            prior=prior,
            complete=self.complete,
            variant=self.variant.of_fit,
        )

    def groups_of(
        self,
        values: Values,
        statistics: Sequence[SufficientStatistics],
        whitenings: Iterable[Whitening] | None = None,
    ) -> list[Group]:
        """All groups, with statistics for the same hyperparameters and inducing points."""
        sets = zip(self.groups, whitenings or self.whitenings(values), statistics, strict=True)
        return [self.group(values, outputs, whitening, sums) for outputs, whitening, sums in sets]

    def groups_on(self, values: Values, blocks: Blocks, share: float = 1.0) -> Iterator[Group]:
        """Each group, with the statistics of some rows. The pass over the rows is made when the group is asked for.

        The noise variance in ``values`` is σ² times ``share``.
        """
        for outputs, whitening in zip(self.groups, self.whitenings(values), strict=True):
            ratio = None if self.complete else self._ratio(values, outputs)
            statistics = collect(blocks, whitening, outputs, None if ratio is None else share * ratio)
            yield self.group(values, outputs, whitening, statistics)

    def bound(self, values: Values, statistics: Sequence[SufficientStatistics], blocks: Blocks | None = None) -> float:
        """The lower bound with q at its optimum. Without ``blocks``, digits cancel if there is little noise."""
        bounds = bounds_at_optimum(self.groups_of(values, statistics))
        return sum(bound.value(bound.residuals(blocks)) for bound in bounds)

    def upper_bound(
        self, values: Values, statistics: Sequence[SufficientStatistics], blocks: Blocks | None = None
    ) -> float:
        """An upper bound on the log marginal likelihood. Without ``blocks``, digits cancel if there is little noise."""
        return upper_bound(self.groups_of(values, statistics), blocks)

    def at_optimum(
        self,
        values: Values,
        statistics: Sequence[SufficientStatistics],
        whitenings: Iterable[Whitening] | None = None,
        blocks: Blocks | None = None,
    ) -> Predictor:
        """The predictor with q at its optimum.

        If ``blocks`` of all rows are given, means are refined, unless outputs share their weights.
        """
        groups, mean, root = self.groups_of(values, statistics, whitenings), [], []
        leaks: list[np.ndarray] | None = None
        if self.variant.orthogonal:
            groups = [replace(group, variant=self.variant) for group in groups]
            leaks = [leak for group in groups for leak in group.leaks]
        for group, posteriors in zip(groups, optimal_posteriors(groups), strict=True):
            L_inv = group.whitening.L_inv
            for q in posteriors if blocks is None or self.prior.shared else _refined(group, posteriors, blocks):
                mean.append(q.mean)
                is_full = self.variant.family == "full"
                root.append(q.root_inv if is_full else diagonal_root(*log_variances(q.B, L_inv), L_inv))
        return self.predictor(values, [group.whitening for group in groups], mean, root, leaks)

    def weight_likelihoods(self, values: Values, statistics: Sequence[SufficientStatistics]) -> list[WeightLikelihood]:
        """The likelihood of the weights of each output, with f integrated out."""
        groups = [replace(group, variant=self.variant) for group in self.groups_of(values, statistics)]
        return [likelihood for group in groups for likelihood in weight_likelihoods(group)]

    def predictor(
        self,
        values: Values,
        whitenings: Sequence[Whitening],
        mean: Sequence[np.ndarray],
        root: Sequence[np.ndarray],
        leaks: Sequence[np.ndarray] | None = None,
    ) -> Predictor:
        """The predictor for q(ω) of each output with the given mean (m + p,) and covariance rootᵀ root.

        ``leaks`` (p, m) are given if f is orthogonal to the features.
        """
        groups = []
        sets = zip(self.groups, values["inducing_points"], whitenings, strict=True)
        for index, (outputs, points, whitening) in enumerate(sets):
            kernel, hyperparameters = self.kernel_of(values, index)
            groups.append(
                PredictorGroup.of(
                    outputs=outputs,
                    kernel=kernel,
                    hyperparameters=hyperparameters,
                    points=points,
                    whitening=whitening,
                    signal=values["signal"][outputs],
                    prior=self.prior.at(values).outputs(outputs),
                    mean=mean[outputs],
                    root=root[outputs],
                    leaks=None if leaks is None else leaks[outputs],
                )
            )
        noise = values["noise"]
        return Predictor(tuple(groups), noise, self.prior.offset, np.zeros(len(noise)), self.prior.shared)


def _refined(group: Group, posteriors: list[WhitenedPosterior], blocks: Blocks) -> list[WhitenedPosterior]:
    """Posteriors with means after one step of iterative refinement: a pass over the rows."""
    # Where the data say little about ω, B is about 1, and its rounding errors are a share of its trace. There the
    # solution of B mean = g loses digits. ρ = g - B mean, from residuals summed row by row, does not.
    weights = np.column_stack([group.times_T(o, q.mean) for o, q in enumerate(posteriors)])
    residuals = errors(blocks, group.whitening, group.outputs, weights)
    refined = []
    for q, error in zip(posteriors, equation_errors(group, posteriors, residuals), strict=True):
        refined.append(replace(q, mean=q.mean + q.root_inv.T @ (q.root_inv @ error)))
    return refined
