"""A sparse model to be fitted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Protocol

import numpy as np

from ..data.blocks import Blocks
from ..data.internal import Rows
from ..data.source import of_outputs
from ..model.bounds import bounds_alone
from ..model.exact import ExactModel, LikelihoodObjective
from ..model.model import SparseModel
from ..model.objectives import BoundObjective
from ..model.parameters import ParameterTable, Values
from ..utils.monitor import Monitor
from .advice import learned_too_little
from .exact import ExactOptions, Unhindered
from .folds import CrossValidation
from .inducing import Placement, distinct_rows, greedy_sample_size, with_more
from .rules import Rules
from .start import LOWEST_NOISE
from .strategy import Attempt, Fit, Strategy, better, drawn, search
from .units import may_hide_noise, noise_of_most_evidence

# By what factor inducing points become more, until that raises the bound by less than so many nats per row and output.
_GROWTH, _GAIN = 1.5, 0.01
# Points limit the kernel if it makes so many rows, a sample, less likely than their own kernel does, by so many nats
# per row and output.
_SAMPLE, _MISSED = 1000, 0.02
# On the way, no more iterations than this, and none that gain less than this, in nats per row and output.
_ITERATIONS, _COARSE = 60, 2e-4
# Of a priori sums of squares: noise variances below are rounding errors beside them.
_ROUNDING = 1e-13


class Solver(Protocol):
    """What finds the parameters: one of `skevgp.solvers`."""

    @property
    def rules(self) -> Rules:
        """From where it is started."""

    @property
    def n_restarts(self) -> int:
        """Further fits from other starts."""

    def run(self, task: SparseTask, attempt: Attempt) -> Fit:
        """The way from one start."""


@dataclass(frozen=True)
class SparseTask:
    """A sparse model to be fitted: what all attempts have in common.

    Attributes
    ----------
    model : SparseModel
    rows : Rows
        Of the model's outputs, in internal units.
    table : ParameterTable
        Of `start.starting_table`.
    placement : Placement
        Of inducing points.
    solver : Solver
    max_iter : int
    tol : float or None
        In nats; None leaves it to the solver.
    noise_cv : CrossValidation, optional
        By which signal and noise are calibrated.
    seed : int
        Draws mini-batches, samples of the rows and restarts.
    monitor : Monitor
        Told of the bound in the user's units.
    warm : dict, optional
        Where another fit ended.
    placed : bool
        Whether the table's inducing points are from that fit.
    heavy_tails : bool
        Whether the noise has a Student-t's tails.
    """

    model: SparseModel
    rows: Rows
    table: ParameterTable
    placement: Placement
    solver: Solver
    max_iter: int
    tol: float | None
    noise_cv: CrossValidation | None
    seed: int
    monitor: Monitor
    warm: Values | None = None
    placed: bool = False
    heavy_tails: bool = False

    @cached_property
    def rng(self) -> np.random.RandomState:
        """The one source of chance."""
        return np.random.RandomState(self.seed)

    @cached_property
    def blocks(self) -> Blocks:
        """All rows."""
        return self.model.blocks(self.rows, self.n_inducing)

    @cached_property
    def samples(self) -> tuple[int, ...]:
        """The sizes of the samples that the fit begins with."""
        (o, p), (g, _, d) = self.model.prior.scale.shape, self.table["inducing_points"].start.shape
        width = d + p + o if self.model.kernels is None else g * (d + p) + o
        return () if self.interpolates else self.solver.rules.samples(len(self.rows), self.n_inducing + p, width)

    @cached_property
    def _sample(self) -> Rows:
        return self.rows.sampled(self.samples[-1], self.rng)

    @cached_property
    def exact(self) -> ExactModel | None:
        """The exact model of the rows, where the inducing points are all of them; None where they are not.

        The bound is then its likelihood. A jitter of k(X_m, X_m), which costs the bound nothing there, would let the
        signal grow, and with it the std: the exact model has none.
        """
        model, separate = self.model, self.table["hyperparameters"].start.ndim == 2
        if not model.complete or separate or self.heavy_tails or self.solver.rules.lowest_noise_exact is None:
            return None
        rows, kernels = self.rows.some(np.arange(len(self.rows))), None
        if model.kernels is not None:
            sets = [model.set_of(o, self.table["inducing_points"]) for o in range(len(model.prior.scale))]
            kernels = tuple(model.kernels[index] for index in sets)
        vague = np.zeros(model.prior.scale.shape, dtype=bool)
        return ExactModel(model.kernel, model.prior, vague, rows, kernels)

    def objective(self, table: ParameterTable, n_rows: int | None = None) -> BoundObjective | LikelihoodObjective:
        """What is minimised on a sample of so many rows, or on all: minus the bound per row, and its gradient."""
        if n_rows is None and self.exact is not None:
            return LikelihoodObjective(self.exact, table)
        return BoundObjective(self.model, table, self.blocks_of(n_rows))

    def blocks_of(self, n_rows: int | None) -> Blocks:
        """A sample of so many rows, of which the smaller ones are parts; None means all.

        Made anew each time: what a sample keeps from one pass to the next goes with it.
        """
        if n_rows is None:
            return self.blocks
        return self.model.blocks(self._sample.part(0, n_rows, 1.0), self.n_inducing)

    @property
    def interpolates(self) -> bool:
        """Whether there are as many inducing points as rows; points that stay are all rows, some perhaps the same."""
        return self.n_inducing >= len(self.rows) or not self.table["inducing_points"].free.any()

    @cached_property
    def alone(self) -> float:
        """The bound of the features without a Gaussian process, all that they leave over being noise."""
        none = np.zeros(len(self.model.prior.scale))
        return float(bounds_alone(self.blocks.linear, self.model.prior, self._left_over(none), none).sum())

    def _left_over(self, trace: np.ndarray) -> np.ndarray:
        """The noise variances (o,) that the features leave over, which may be nothing, and a trace of f's prior."""
        sums = self.blocks.linear
        squares = [float(sums.of(slice(o, o + 1)).RR[0]) for o in range(len(trace))]
        return np.maximum((squares + trace) / self.rows.total, LOWEST_NOISE * self.rows.mean_precision)

    @cached_property
    def _may_hide_noise(self) -> bool:
        return may_hide_noise(self.model.prior, self.blocks.linear.length)

    def _least_trace(self) -> np.ndarray:
        """The trace (o,) of f's prior with as little signal as may be, and the kernel where it starts."""
        values, signal = self.table.values_at_start(), self.table["signal"]
        points, (kernel, hyperparameters) = values["inducing_points"][0], self.model.kernel_of(values, 0)
        variance = np.mean(kernel.at(np.log(hyperparameters), points).diagonal(kernel.prepare(points)))
        little = np.where(signal.free, signal.value_limits()[:, 0], values["signal"])
        return little * variance * self.rows.total * self.rows.mean_precision

    def _best_alone(self, trace: np.ndarray) -> tuple[float, np.ndarray]:
        """The bound with q(f) at its prior, which has such a trace, and the noise variances (o,) with the highest."""
        prior, sums = self.model.prior, self.blocks.linear
        least = highest = self._left_over(trace)
        if self.max_iter > 0 and self._may_hide_noise:
            lowest, highest = self.table["noise"].value_limits().T
            # Directions that the rows do not see have a precision of 1, beside which their features are large.
            sizes = [scale**2 * np.diagonal(sums.of(slice(o, o + 1)).HH) for o, scale in enumerate(prior.scale)]
            unseen = [np.sort(own)[: max(len(own) - sums.length, 0)].sum() for own in sizes]
            least = np.maximum(lowest, _ROUNDING * np.array(unseen))
        return noise_of_most_evidence(
            lambda noise: bounds_alone(sums, prior, noise, trace), least, highest, prior.shared
        )

    @property
    def n_inducing(self) -> int:
        """Points of each set."""
        return self.table["inducing_points"].start.shape[1]

    @property
    def strategy(self) -> Strategy:
        """From where the model is fitted."""
        rules, anew = self.solver.rules, self.placement.anew
        trace = self._least_trace()
        alone, noise_alone = self._best_alone(trace)
        # The trace of a signal that stays depends on where the kernel ends.
        is_open = self._may_hide_noise and not self.table["signal"].free.all()
        return Strategy(
            rules,
            self.table,
            self.max_iter,
            self.solver.n_restarts,
            self.rows.scatter(),
            alone=alone,
            noise_alone=noise_alone,
            most_alone=self._best_alone(np.zeros(len(trace)))[0] if is_open else -np.inf,
            noise_hidden=self._may_hide_noise,
            mean_precision=self.rows.mean_precision,
            interpolates=self.interpolates,
            samples=self.samples,
            place=None if anew is None else partial(self._placed, placement=anew),
            restart=lambda: self._placed(drawn(self.table, rules, self.rng), self.placement),
            warm=self.warm,
            placed=self.placed,
        )

    @property
    def minimise(self) -> Callable[[Attempt], Fit]:
        """The solver's way from a start."""
        return partial(self.solver.run, self)

    def _placed(self, values: Values, placement: Placement) -> Values:
        """The same values with inducing points placed under their kernel, alike for groups with the same.

        Where clusters coincide there are fewer: the table then keeps those that it has.
        """
        sample = self.rows.sample(placement.sample_size, self.rng)
        sets = []
        for index, group in enumerate(self.model.groups if self.model.kernels is not None else (slice(None),)):
            kernel, hyperparameters = self.model.kernel_of(values, index)
            inputs = of_outputs(sample.inputs, group)
            sets.append(placement.points(inputs, kernel, np.log(hyperparameters), self.rng))
        m = min(map(len, sets))
        points = np.array([own[:m] for own in sets])
        return values | {"inducing_points": np.repeat(points, len(self.model.groups) // len(points), axis=0)}

    def placed_under(self, values: Values) -> Values:
        """Values of a kernel, with as many inducing points as the task has, placed greedily; all rows if they stay."""
        table = self.table
        if not table["inducing_points"].free.any():
            return values | {"inducing_points": table["inducing_points"].start}
        return self._placed(values, Placement("greedy", self.n_inducing))

    def with_more(self, values: Values) -> SparseTask | None:
        """The task of half as many points again, those of a fit among them; None if there can be no more."""
        most = self.placement.max_inducing
        if most is None or self.n_inducing >= most:
            return None
        wanted = min(int(np.ceil(_GROWTH * self.n_inducing)), most)
        sample, sets, everything = self.rows.sample(greedy_sample_size(wanted), self.rng), [], True
        for index, (group, points) in enumerate(zip(self.model.groups, values["inducing_points"], strict=True)):
            inputs = of_outputs(sample.inputs, group)
            distinct, (kernel, hyperparameters) = distinct_rows(inputs), self.model.kernel_of(values, index)
            if len(inputs) == len(self.rows) and len(distinct) <= wanted:
                sets.append(distinct)
            else:
                everything = False
                sets.append(with_more(points, wanted, inputs, kernel, np.log(hyperparameters)))
        n_inducing = min(map(len, sets))
        if n_inducing <= self.n_inducing:
            return None
        table = self.table.with_start("inducing_points", np.array([own[:n_inducing] for own in sets]))
        if everything and self.model.family == "full":
            # The bound is then the likelihood: no other places are better.
            table = table.with_fixed("inducing_points")
            return replace(self, table=table, model=replace(self.model, complete=True))
        return replace(self, table=table)

    def unhindered(self) -> Unhindered | None:
        """The exact model of a sample of the rows; None if the kernel is fixed, or groups have kernels of their own."""
        if self.max_iter == 0 or not self.table["hyperparameters"].free.any() or self.model.kernels is not None:
            return None
        sample = self.rows.sample(_SAMPLE, self.rng)
        nats = sample.total * sample.targets.shape[1]
        return Unhindered.of(
            self.model.kernel,
            self.model.prior,
            sample,
            self.table.without("inducing_points"),
            self.rows.scatter(),
            ExactOptions(self.solver.rules, _ITERATIONS, max(self.tol or 0.0, _COARSE * nats), 0),
            self.rng,
            self.monitor.silent(),
        )

    def learned_too_little(self, values: Values) -> str:
        """What `advice` says of it, of each group with columns of its own; empty if all is well."""
        if self.rows.inputs.mean.ndim == 1:
            kernel, hyperparameters = self.model.kernel_of(values, 0)
            return learned_too_little(kernel, values | {"hyperparameters": hyperparameters}, self.table, self.rows)
        told = []
        for index, group in enumerate(self.model.groups):
            kernel, hyperparameters = self.model.kernel_of(values, index)
            own = {"hyperparameters": hyperparameters, "noise": values["noise"][group]}
            told.append(learned_too_little(kernel, own, self.table, self.rows.within(group)))
        return max(told)


def grown(task: SparseTask) -> tuple[SparseTask, Fit]:
    """A fit whose number of inducing points has been found, and the task that it is of.

    Half as many points again are added, the rows that are least known from those before, and the fit goes on for a few
    iterations; until that raises the bound by less than `_GAIN`. The fit before then goes on to its end. Only there
    `max_iter` counts: after too few iterations on the way, points would be credited with what further ones gain.

    With few points the noise may explain so much that half as many again show nothing of what there is to learn. Hence
    a second opinion, the kernel of the exact model of a sample: while it makes the sample likelier than the fit's by
    `_MISSED`, growth does not end, and it is tried at each step.
    """
    nats = task.rows.total * len(task.rows.scatter())
    coarse = replace(
        task,
        max_iter=_ITERATIONS if task.max_iter > 0 else 0,
        tol=max(task.tol or 0.0, _COARSE * nats),
    )
    fit = search(coarse)
    with task.monitor.keeping_the_best():
        unhindered = None if task.monitor.stopped else task.unhindered()
        while not task.monitor.stopped and (more := coarse.with_more(fit.values)) is not None:
            starts, limited = [fit.values | {"inducing_points": more.table["inducing_points"].start}], False
            if unhindered is not None and unhindered.missed_by(fit.values) > _MISSED:
                starts, limited = [*starts, more.placed_under(unhindered.fit.values)], True
            # Where they start: nothing is optimised.
            start = max((more.minimise(Attempt(values, 0)) for values in starts), key=lambda tried: tried.bound)
            larger = more.minimise(Attempt(start.values, coarse.max_iter))
            if larger.bound - fit.bound < _GAIN * nats and not limited:
                break
            coarse, fit = more, larger
    task = replace(coarse, max_iter=task.max_iter, tol=task.tol)
    if task.max_iter > 0 and not task.monitor.stopped:
        fit = better(fit, task.minimise(Attempt(fit.values, task.max_iter)))
    return task, fit
