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
from .inducing import Placement
from .strategy import Attempt, Fit, Rules, Strategy, drawn


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
    tol : float
        In nats.
    noise_cv : int, optional
        Folds of consecutive rows by which the noise is calibrated.
    seed : int
        Draws mini-batches, samples of the rows and restarts.
    monitor : Monitor
        Told of the bound in the user's units.
    warm : dict, optional
        Where another fit ended.
    """

    model: SparseModel
    rows: Rows
    table: ParameterTable
    placement: Placement
    solver: Solver
    max_iter: int
    tol: float
    noise_cv: int | None
    seed: int
    monitor: Monitor
    warm: Values | None = None

    @cached_property
    def rng(self) -> np.random.RandomState:
        """The one source of chance."""
        return np.random.RandomState(self.seed)

    @cached_property
    def blocks(self) -> Blocks:
        """All rows."""
        return self.rows.blocks(self.model.kernel, self.n_inducing)

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
            alone=features_alone_bound(self.blocks.linear, self.model.prior),
            # Points that stay are all rows, some of them perhaps the same.
            interpolates=self.n_inducing >= len(self.rows) or not self.table["inducing_points"].free.any(),
            place=None if anew is None else partial(self._placed, placement=anew),
            restart=lambda: self._placed(drawn(self.table, rules, self.rng), self.placement),
            warm=self.warm,
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


@dataclass(frozen=True)
class Learned:
    """A fitted sparse model.

    Attributes
    ----------
    model : SparseModel
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
    """

    model: SparseModel
    values: Values
    statistics: list[SufficientStatistics]
    bound: float
    upper_bound: float
    predictor: Predictor
    loss_curve: list[float]
    message: str

    @classmethod
    def of(cls, task: SparseTask, fit: Fit) -> Learned:
        """What is kept of a fit; its noise is calibrated if the task says so and Ctrl-C did not."""
        statistics = task.model.statistics(fit.values, task.blocks)
        bound, predictor = task.model.at_optimum(fit.values, statistics)
        advice = [fit.message, far_from_prior(task.model.prior, task.rows)]
        free_noise = task.table["noise"].free.any()
        if not task.monitor.stopped and task.max_iter > 0:
            advice.append(learned_too_little(task.model.kernel, fit.values, task.table, task.rows))
        learned = cls(
            task.model,
            fit.values,
            statistics,
            # Summed row by row, which keeps its digits where the noise is low.
            fit.bound if np.isfinite(fit.bound) else bound,
            task.model.upper_bound(fit.values, statistics, task.blocks),
            predictor if fit.predictor is None else fit.predictor,
            fit.loss_curve,
            " ".join(part for part in advice if part),
        )
        if task.noise_cv is not None and free_noise and not task.monitor.stopped:
            with task.monitor.keeping_the_best():
                learned = learned.calibrated(task.table, task.rows, task.noise_cv)
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
        own = slice(output, output + 1)
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
        n_inducing = self.values["inducing_points"].shape[1]
        # Whatever its points were of the rows before.
        model = replace(self.model, complete=False)
        new = model.statistics(self.values, rows.blocks(model.kernel, n_inducing))
        statistics = [old.scaled(weight) + more for old, more in zip(self.statistics, new, strict=True)]
        return replace(self, model=model, statistics=statistics)._at_optimum()

    def calibrated(self, table: ParameterTable, rows: Rows, n_folds: int) -> Learned:
        """The noise that is free from cross-validation, and q at its optimum for it."""
        limits = table["noise"].value_limits()
        noise = calibrated_noise(self.model, self.values, self.statistics, rows, limits, n_folds)
        noise = np.where(table["noise"].free, noise, self.values["noise"])
        blocks = rows.blocks(self.model.kernel, self.values["inducing_points"].shape[1])
        return replace(self, values=self.values | {"noise": noise})._at_optimum(blocks)

    def _at_optimum(self, blocks: Blocks | None = None) -> Learned:
        bound, predictor = self.model.at_optimum(self.values, self.statistics)
        upper_bound = self.model.upper_bound(self.values, self.statistics, blocks)
        return replace(self, bound=bound, upper_bound=upper_bound, predictor=predictor)
