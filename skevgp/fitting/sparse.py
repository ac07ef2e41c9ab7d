"""A sparse model to be fitted, and what is kept of it when that is done."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Protocol

import numpy as np

from .._progress import Monitor
from ..inference.bounds import BoundAtOptimum, features_alone_bound
from ..inference.model import SparseModel
from ..inference.objectives import evaluate
from ..inference.posterior import Predictor
from ..inference.statistics import SufficientStatistics
from ..optimizers.parameters import ParameterTable, Values
from ..rows.blocks import Blocks
from ..rows.internal import Rows
from .advice import far_from_prior, learned_too_little
from .calibration import calibrated_noise
from .exact import ExactOptions, Unhindered
from .inducing import Placement, distinct_rows, greedy_sample_size, with_more
from .strategy import Attempt, Fit, Rules, Strategy, better, drawn, search

# By what factor inducing points become more, until that raises the bound by less than so many nats per row and output.
_GROWTH, _GAIN = 1.5, 0.01
# Points limit the kernel if it makes so many rows, a sample, less likely than their own kernel does, by so many nats
# per row and output.
_SAMPLE, _MISSED = 1000, 0.02
# On the way, no more iterations than this, and none that gain less than this, in nats per row and output.
_ITERATIONS, _COARSE = 60, 2e-4


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


class Doubts(Protocol):
    """How much each row is doubted (`noise.outliers`)."""

    def weigh(self, rows: Rows) -> Rows:
        """Rows as the rest of the model sees them."""

    def told(self, learned: Learned) -> Learned:
        """What is said of the noise is that of rows that are no outliers."""

    def updated(self, learned: Learned, rows: Rows) -> Learned:
        """Fold new rows in, which are doubted as well."""


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
    noise_cv : int, optional
        Folds of consecutive rows by which the noise is calibrated.
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
    noise_cv: int | None
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
        return self.rows.blocks(self.model.kernel, self.n_inducing)

    @cached_property
    def samples(self) -> tuple[int, ...]:
        """The sizes of the samples that the fit begins with."""
        (o, p), d = self.model.prior.scale.shape, self.table["inducing_points"].start.shape[2]
        return () if self.interpolates else self.solver.rules.samples(len(self.rows), self.n_inducing + p, d + p + o)

    @cached_property
    def _sample(self) -> Rows:
        return self.rows.sampled(self.samples[-1], self.rng)

    def blocks_of(self, n_rows: int | None) -> Blocks:
        """A sample of so many rows, of which the smaller ones are parts; None means all.

        Made anew each time: what a sample keeps from one pass to the next goes with it.
        """
        if n_rows is None:
            return self.blocks
        return self._sample.part(0, n_rows, 1.0).blocks(self.model.kernel, self.n_inducing)

    @property
    def interpolates(self) -> bool:
        """Whether there are as many inducing points as rows; points that stay are all rows, some perhaps the same."""
        return self.n_inducing >= len(self.rows) or not self.table["inducing_points"].free.any()

    @cached_property
    def alone(self) -> float:
        """The bound of the features without a Gaussian process."""
        return features_alone_bound(self.blocks.linear, self.model.prior)

    @property
    def n_inducing(self) -> int:
        """Points of each set."""
        return self.table["inducing_points"].start.shape[1]

    @property
    def strategy(self) -> Strategy:
        """From where the model is fitted."""
        rules, anew = self.solver.rules, self.placement.anew
        return Strategy(
            rules,
            self.table,
            self.max_iter,
            self.solver.n_restarts,
            self.rows.scatter(),
            alone=self.alone,
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
        """The same values with inducing points placed under their kernel, alike for all groups.

        Where clusters coincide there are fewer: the table then keeps those that it has.
        """
        inputs = self.rows.sample(placement.sample_size, self.rng).inputs
        points = placement.points(inputs, self.model.kernel, np.log(values["hyperparameters"]), self.rng)
        return values | {"inducing_points": np.repeat(points[np.newaxis], len(self.model.groups), axis=0)}

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
        inputs = self.rows.sample(greedy_sample_size(wanted), self.rng).inputs
        distinct, points = distinct_rows(inputs), values["inducing_points"]
        everything = len(inputs) == len(self.rows) and len(distinct) <= wanted
        if everything:
            sets = [distinct] * len(points)
        else:
            hyperparameters = np.log(values["hyperparameters"])
            sets = [with_more(own, wanted, inputs, self.model.kernel, hyperparameters) for own in points]
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
        """The exact model of a sample of the rows; None if the kernel is fixed."""
        if self.max_iter == 0 or not self.table["hyperparameters"].free.any():
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
        monitor=task.monitor.seen_as(is_last=False),
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
    task = replace(coarse, max_iter=task.max_iter, tol=task.tol, monitor=task.monitor)
    if task.max_iter > 0 and not task.monitor.stopped:
        fit = better(fit, task.minimise(Attempt(fit.values, task.max_iter)))
    return task, fit


@dataclass(frozen=True)
class Learned:
    """A fitted sparse model.

    Attributes
    ----------
    model : SparseModel
    table : ParameterTable
        Where it started, and its limits.
    values : dict
        Of the model's parameters, in internal units.
    statistics : list of SufficientStatistics
        At ``values``, one for each set of inducing points.
    bound, upper_bound : float
        On the log marginal likelihood, in nats, of the residuals in internal units.
    predictor : Predictor
        In internal units.
    loss_curve : list of float
        Minus the bound per iteration.
    message : str
        What the user should know of how the fit ended; empty if all is well.
    doubts : Doubts, optional
        Of the rows, if the noise has heavy tails.
    """

    model: SparseModel
    table: ParameterTable
    values: Values
    statistics: list[SufficientStatistics]
    bound: float
    upper_bound: float
    predictor: Predictor
    loss_curve: list[float]
    message: str
    doubts: Doubts | None = None

    @classmethod
    def of(cls, task: SparseTask, fit: Fit, doubts: Doubts | None = None) -> Learned:
        """What is kept of a fit; its noise is calibrated if the task says so and Ctrl-C did not."""
        statistics = task.model.statistics(fit.values, task.blocks)
        bound, predictor = task.model.at_optimum(fit.values, statistics)
        advice = [fit.message, far_from_prior(task.model.prior, task.rows)]
        free_noise = task.table["noise"].free.any()
        if not task.monitor.stopped and task.max_iter > 0:
            advice.append(learned_too_little(task.model.kernel, fit.values, task.table, task.rows))
        learned = cls(
            task.model,
            task.table,
            fit.values,
            statistics,
            # Summed row by row, which keeps its digits where the noise is low.
            fit.bound if np.isfinite(fit.bound) and fit.n_rows is None else bound,
            task.model.upper_bound(fit.values, statistics, task.blocks),
            predictor if fit.predictor is None else fit.predictor,
            fit.loss_curve,
            " ".join(part for part in advice if part),
        )
        if doubts is not None:
            learned = doubts.told(replace(learned, doubts=doubts))
        if task.noise_cv is not None and free_noise and not task.monitor.stopped:
            with task.monitor.keeping_the_best():
                learned = learned.calibrated(task.rows, task.noise_cv)
        return learned

    def bound_at(
        self, rows: Rows, output: int, hyperparameters: np.ndarray, signal: np.ndarray
    ) -> tuple[float, np.ndarray]:
        """The bound of one output under another kernel, and its gradient in the kernel's logarithms.

        Noise and inducing points are the fitted ones, and q is at its optimum.

        Parameters
        ----------
        rows : Rows
            Those of the fit, of this output.
        output : int
            Of the model's outputs.
        hyperparameters : ndarray of shape (n_hyper,)
            Of k̃.
        signal : ndarray of shape (1,)
            s².

        Returns
        -------
        bound : float
        gradient : ndarray of shape (n_hyper + 1,)
            That in log s² last.
        """
        own, rows = slice(output, output + 1), rows if self.doubts is None else self.doubts.weigh(rows)
        index = next(i for i, group in enumerate(self.model.groups) if group.start <= output < group.stop)
        points = self.values["inducing_points"][[index]]
        values = {
            "hyperparameters": hyperparameters,
            "signal": signal,
            "noise": self.values["noise"][own],
            "inducing_points": points,
        }
        model = replace(self.model, prior=self.model.prior.outputs(own), groups=(slice(0, 1),))
        blocks = rows.blocks(model.kernel, points.shape[1])
        bound, gradient = evaluate(model, values, blocks, partial(BoundAtOptimum, family=model.family))
        return bound, np.append(gradient["hyperparameters"], gradient["signal"])

    def updated(self, rows: Rows, weight: float = 1.0) -> Learned:
        """Fold new rows in: same kernel and inducing points, q at its optimum for all rows so far.

        ``weight`` multiplies the log likelihood of the earlier rows.
        """
        if self.doubts is not None:
            return self.doubts.updated(self, rows)
        n_inducing = self.values["inducing_points"].shape[1]
        # Whatever its points were of the rows before.
        model = replace(self.model, complete=False)
        new = model.statistics(self.values, rows.blocks(model.kernel, n_inducing))
        statistics = [old.scaled(weight) + more for old, more in zip(self.statistics, new, strict=True)]
        return replace(self, model=model, statistics=statistics)._at_optimum()

    def calibrated(self, rows: Rows, n_folds: int) -> Learned:
        """The noise that is free from cross-validation, and q at its optimum for it."""
        limits = self.table["noise"].value_limits()
        noise = calibrated_noise(self.model, self.values, self.statistics, rows, limits, n_folds)
        noise = np.where(self.table["noise"].free, noise, self.values["noise"])
        blocks = rows.blocks(self.model.kernel, self.values["inducing_points"].shape[1])
        return replace(self, values=self.values | {"noise": noise})._at_optimum(blocks)

    def _at_optimum(self, blocks: Blocks | None = None) -> Learned:
        bound, predictor = self.model.at_optimum(self.values, self.statistics)
        upper_bound = self.model.upper_bound(self.values, self.statistics, blocks)
        learned = replace(self, bound=bound, upper_bound=upper_bound, predictor=predictor)
        return learned if self.doubts is None else self.doubts.told(learned)
