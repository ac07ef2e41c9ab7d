"""A sparse model to be fitted, and what is kept of it, and of the models of all outputs, when that is done."""

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
from ..inference.statistics import Kernel, SufficientStatistics
from ..optimizers.parameters import ParameterTable, Values
from ..rows.blocks import Blocks
from ..rows.internal import Rows
from ..rows.source import Source
from .advice import far_from_prior, learned_too_little
from .calibration import calibrated_noise
from .inducing import Placement
from .strategy import Attempt, Fit, Rules, Strategy, drawn
from .units import Units


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
    bound : float
        In nats, of the residuals in internal units.
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
        return replace(self, values=self.values | {"noise": noise})._at_optimum()

    def _at_optimum(self) -> Learned:
        bound, predictor = self.model.at_optimum(self.values, self.statistics)
        return replace(self, bound=bound, predictor=predictor)


@dataclass(frozen=True)
class FittedOutputs:
    """The fitted sparse models of all outputs.

    Attributes
    ----------
    units : Units
    outputs : list of list of int
        Of each model.
    found : bool
        Whether which outputs share a model was found and not given.
    tables : tuple of ParameterTable
        Where each model started, and its limits.
    learned : tuple of Learned
        Each model, in internal units.
    messages : tuple of str
        What the user should know of how the fits ended.
    """

    units: Units
    outputs: list[list[int]]
    found: bool
    tables: tuple[ParameterTable, ...]
    learned: tuple[Learned, ...]
    messages: tuple[str, ...]

    def updated(self, source: Source, weight: float = 1.0) -> FittedOutputs:
        """Fold new rows into the predictors; ``weight`` multiplies what is known of the others."""
        rows = self.units.rows(source)
        learned = (one.updated(rows.outputs(own), weight) for own, one in zip(self.outputs, self.learned, strict=True))
        return replace(self, learned=tuple(learned))

    def predictor(self) -> Predictor:
        """Of all outputs, in the user's units."""
        return self.units.predictor([one.predictor for one in self.learned], self.outputs)

    @property
    def lower_bound(self) -> float:
        """In nats, summed over outputs."""
        return sum(one.bound for one in self.learned) - self._shift

    @property
    def n_iter(self) -> int:
        """Iterations of the longest fit."""
        return max(len(one.loss_curve) for one in self.learned)

    @property
    def loss_curve(self) -> np.ndarray:
        """Minus the bound per iteration, (n_iter,); a model that is done keeps its last value."""
        curves = [one.loss_curve for one in self.learned]
        if not all(curves):
            return np.empty(0)
        return np.sum([np.pad(curve, (0, self.n_iter - len(curve)), "edge") for curve in curves], axis=0) + self._shift

    @property
    def n_parameters(self) -> int:
        """Free parameters of kernels, noise, inducing points and q."""
        total = 0
        for table, one in zip(self.tables, self.learned, strict=True):
            n_outputs, p = one.model.prior.scale.shape
            size = one.values["inducing_points"].shape[1] + p
            q = 2 * size if one.model.family == "diagonal" else size + size * (size + 1) // 2
            total += table.size + q * n_outputs
        return total

    def limits(self, name: str, output: int) -> np.ndarray:
        """Limits (n, 2) of an output's ``hyperparameters`` or ``signal``, in the user's units."""
        index, within = self._place_of(output)
        limits = self.tables[index][name].value_limits()
        return limits[[within]] * self.units.target_unit[output] ** 2 if name == "signal" else limits

    def bound_at(self, rows: Rows, output: int, hyperparameters: np.ndarray, signal: float) -> tuple[float, np.ndarray]:
        """The bound of one output under another kernel, and its gradient in the kernel's logarithms.

        Parameters
        ----------
        rows : Rows
            Those of the fit.
        output : int
        hyperparameters : ndarray of shape (n_hyper,)
            Of k̃.
        signal : float
            s², in the user's units.

        Returns
        -------
        bound : float
            In nats, in the user's units.
        gradient : ndarray of shape (n_hyper + 1,)
            That in log s² last.
        """
        (index, within), own = self._place_of(output), [output]
        internal = signal / self.units.target_unit[own] ** 2
        bound, gradient = self.learned[index].bound_at(rows.outputs(own), within, hyperparameters, internal)
        return bound - len(rows) * self.units.log_unit(own), gradient

    def _place_of(self, output: int) -> tuple[int, int]:
        """Which model an output belongs to, and which of the model's it is."""
        index = next(i for i, own in enumerate(self.outputs) if output in own)
        return index, self.outputs[index].index(output)

    def values_in(self, units: Units, rows: Rows, kernel: Kernel, index: int) -> Values:
        """A model's values in other internal units, as far as they can serve another fit."""
        one, inputs = self.learned[index], rows.inputs
        values, points = one.values, one.values["inducing_points"]
        lowest, highest = inputs.lowest, inputs.highest
        if points.shape[2] != len(inputs.mean):
            return {}
        if (points < 2.0 * lowest - highest).any() or (points > 2.0 * highest - lowest).any():
            return {}
        own = self.outputs[index]
        ratio = (self.units.target_unit[own] / units.target_unit[own]) ** 2
        found = {"noise": values["noise"] * ratio, "inducing_points": points}
        if one.model.kernel == kernel:
            found |= {"hyperparameters": values["hyperparameters"], "signal": values["signal"] * ratio}
        return found

    @property
    def _shift(self) -> float:
        """From internal units to the user's, for a loss of all rows."""
        return self.learned[0].statistics[0].n_rows * self.units.log_unit(slice(None))
