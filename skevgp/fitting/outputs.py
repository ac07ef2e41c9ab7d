"""Several outputs: plan which of them share what, run their fits, collect what is kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, wait
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np

from .._progress import Monitor
from ..inference.bounds import PosteriorFamily
from ..inference.model import SparseModel
from ..inference.posterior import Predictor
from ..inference.statistics import Kernel
from ..kernels.parse import KernelSpec
from ..optimizers.parameters import ParameterTable, Values
from ..rows.internal import Rows
from ..rows.source import Source
from ..rows.threads import BlockMap, thread_pool
from .advice import interrupted
from .inducing import Placement, are_all_rows
from .sparse import Learned, Solver, SparseTask, grown
from .start import checked_variance, column_centre, starting_table
from .strategy import search
from .units import Units

Sharing = Literal["all", "kernel", "none"]
Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Request:
    """What an estimator asks for.

    Attributes
    ----------
    source : Source
        The rows, in the user's units.
    units : Units
    spec : KernelSpec
        What the user says of kernel and noise.
    sharing : {"all", "kernel", "none"}
    family : {"full", "diagonal"}
    placement : Placement
        Of the inducing points.
    solver : Solver
    max_iter : int
    tol : float or None
        In nats; None leaves it to the solver.
    noise_cv : int or None
        Folds of consecutive rows by which the noise is calibrated.
    n_threads : int
        For independent models, or else for blocks of rows.
    """

    source: Source
    units: Units
    spec: KernelSpec
    sharing: Sharing
    family: PosteriorFamily
    placement: Placement
    solver: Solver
    max_iter: int
    tol: float | None
    noise_cv: int | None
    n_threads: int


@dataclass(frozen=True)
class FittedOutputs:
    """Fitted sparse models of consecutive outputs.

    Attributes
    ----------
    units : Units
    sharing : {"all", "kernel", "none"}
    outputs : tuple of slice
        Of each model.
    learned : tuple of Learned
        Each model, in internal units.
    messages : tuple of str
        What the user should know of how the fits ended.
    """

    units: Units
    sharing: Sharing
    outputs: tuple[slice, ...]
    learned: tuple[Learned, ...]
    messages: tuple[str, ...]

    def updated(self, source: Source, weight: float = 1.0) -> FittedOutputs:
        """Fold new rows into the predictors; ``weight`` multiplies what is known of the others."""
        rows = self.units.rows(source)
        learned = (one.updated(rows.outputs(own), weight) for own, one in zip(self.outputs, self.learned, strict=True))
        return replace(self, learned=tuple(learned))

    def predictor(self) -> Predictor:
        """Of all outputs, in the user's units."""
        return self.units.predictor([one.predictor for one in self.learned])

    @property
    def lower_bound(self) -> float:
        """In nats, summed over outputs."""
        return sum(one.bound for one in self.learned) - self._shift

    @property
    def upper_bound(self) -> float:
        """On the log marginal likelihood, in nats, summed over outputs."""
        return sum(one.upper_bound for one in self.learned) - self._shift

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
        for one in self.learned:
            n_outputs, p = one.model.prior.scale.shape
            size = one.values["inducing_points"].shape[1] + p
            q = 2 * size if one.model.family == "diagonal" else size + size * (size + 1) // 2
            total += one.table.size + q * n_outputs
        return total

    def limits(self, name: str, output: int) -> np.ndarray:
        """Limits (n, 2) of an output's ``hyperparameters`` or ``signal``, in the user's units."""
        index, within = self._place_of(output)
        limits = self.learned[index].table[name].value_limits()
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
        (index, within), own = self._place_of(output), slice(output, output + 1)
        internal = signal / self.units.target_unit[own] ** 2
        bound, gradient = self.learned[index].bound_at(rows.outputs(own), within, hyperparameters, internal)
        return bound - len(rows) * self.units.log_unit(own), gradient

    def _place_of(self, output: int) -> tuple[int, int]:
        """Which model an output belongs to, and which of the model's it is."""
        index = next(i for i, own in enumerate(self.outputs) if own.start <= output < own.stop)
        return index, output - self.outputs[index].start

    def values_in(self, units: Units, rows: Rows, kernel: Kernel, index: int) -> Values:
        """A model's values in other internal units, as far as they can serve another fit."""
        one, inputs = self.learned[index], rows.inputs
        values, points = one.values, one.values["inducing_points"]
        lowest, highest = inputs.lowest, inputs.highest
        if points.shape[2] != len(inputs.mean):
            return {}
        if (points < 2.0 * lowest - highest).any() or (points > 2.0 * highest - lowest).any():
            return {}
        ratio = (self.units.target_unit[self.outputs[index]] / units.target_unit[self.outputs[index]]) ** 2
        found = {"noise": values["noise"] * ratio, "inducing_points": points}
        if one.model.kernel == kernel:
            found |= {"hyperparameters": values["hyperparameters"], "signal": values["signal"] * ratio}
        return found

    @property
    def _shift(self) -> float:
        """From internal units to the user's, for a loss of all rows."""
        return self.learned[0].statistics[0].n_rows * self.units.log_unit(slice(None))


def fit_outputs(
    request: Request, rng: np.random.RandomState, monitor: Monitor, previous: FittedOutputs | None = None
) -> FittedOutputs:
    """Place inducing points and maximise the bound of each model.

    Parameters
    ----------
    request : Request
    rng : RandomState
        Places inducing points, draws mini-batches and restarts.
    monitor : Monitor
        Told of each iteration's loss, in the user's units.
    previous : FittedOutputs, default=None
        Start where this one ended, as far as shapes agree.

    Returns
    -------
    fitted : FittedOutputs
    """
    # One model has all threads for its blocks of rows; several have one each.
    n_models = len(_models(request))
    at_once = min(request.n_threads, n_models)
    threads = BlockMap(request.n_threads if n_models == 1 else 1)
    try:
        tasks = plan(request, rng, monitor, threads, previous)
        learned = _side_by_side(_fit_one, tasks, at_once, monitor)
    finally:
        threads.close()
    messages = sorted({one.message for one in learned if one.message})
    if monitor.stopped:
        messages = [interrupted(max(len(one.loss_curve) for one in learned))]
    outputs = tuple(outputs for outputs, _ in _models(request))
    return FittedOutputs(request.units, request.sharing, outputs, tuple(learned), tuple(messages))


def plan(
    request: Request,
    rng: np.random.RandomState,
    monitor: Monitor,
    threads: BlockMap,
    previous: FittedOutputs | None = None,
) -> list[SparseTask]:
    """The models to be fitted, each with its rows and where it starts; arguments as of `fit_outputs`."""
    units, placement, starts, solver = request.units, request.placement, request.spec.starts, request.solver
    models = _models(request)
    rows = units.rows(request.source, threads)
    kernel = request.spec.covariance.centred(column_centre(rows.inputs))

    def table_of(outputs: slice, points: np.ndarray, variance: float = 1.0) -> ParameterTable:
        unit, scatter = units.target_unit[outputs], rows.scatter()[outputs]
        return starting_table(
            rows.inputs, points, unit, starts, scatter, solver.rules, kernel.n_hyperparameters, variance
        )

    # The kernel starts alike in all models and without regard to the points, which may depend on it.
    alone = table_of(slice(0, 1), np.empty((1, 0, len(rows.inputs.mean))))
    hyperparameters = np.log(alone.values(alone.start())["hyperparameters"])
    inputs = rows.sample(placement.sample_size, rng).inputs
    points = placement.points(inputs, kernel, hyperparameters, rng)
    first = starts.hyperparameters.value
    variance = 1.0 if first is None else checked_variance(kernel, first, points)
    # The same for all, so that outputs that share nothing are fitted as they would be alone but for rounding.
    seed = rng.randint(np.iinfo(np.int32).max)
    goes_on = previous is not None and previous.outputs == tuple(outputs for outputs, _ in models)
    share, tasks = 1.0 / min(request.n_threads, len(models)), []
    for index, (outputs, groups) in enumerate(models):
        warm: Values | None = None
        if goes_on and previous is not None:
            warm = previous.values_in(units, rows, kernel, index)
            if isinstance(placement.method, np.ndarray):
                warm.pop("inducing_points", None)
        sets = _first_sets(points, len(groups), placement, warm)
        table = table_of(outputs, sets, variance)
        # Where they are all rows the bound is the likelihood: no other places are better.
        stay = request.family == "full" and len(inputs) == len(rows) and all(are_all_rows(own, inputs) for own in sets)
        if stay:
            table = table.with_fixed("inducing_points")
        shift = len(rows) * units.log_unit(outputs)
        tasks.append(
            SparseTask(
                SparseModel(
                    kernel, units.internal_prior().outputs(outputs), request.family, groups, solver.rules.jitter, stay
                ),
                rows.outputs(outputs, share),
                table,
                placement,
                solver,
                request.max_iter,
                request.tol,
                request.noise_cv,
                seed,
                monitor.seen_as(shift=shift, outputs=range(outputs.start, outputs.stop)),
                None if warm is None else table.started_at(warm).values_at_start(),
            )
        )
    return tasks


def _first_sets(points: np.ndarray, n_groups: int, placement: Placement, warm: Values | None) -> np.ndarray:
    """Inducing points (g, m, d) of each group; where their number is to be found, those of the fit before go on."""
    found = None if warm is None or placement.max_inducing is None else warm.get("inducing_points")
    return np.repeat(points[np.newaxis], n_groups, axis=0) if found is None or len(found) != n_groups else found


def _models(request: Request) -> list[tuple[slice, tuple[slice, ...]]]:
    """The outputs of each independent model, and of these the outputs of each set of inducing points."""
    n_outputs = len(request.units.target_unit)
    each = tuple(slice(o, o + 1) for o in range(n_outputs))
    if request.sharing == "none":
        return [(outputs, (slice(0, 1),)) for outputs in each]
    return [(slice(0, n_outputs), (slice(0, n_outputs),) if request.sharing == "all" else each)]


def _fit_one(task: SparseTask) -> Learned:
    # A copy, with which the blocks of rows are forgotten.
    task = replace(task)
    if task.placement.max_inducing is None:
        return Learned.of(task, search(task))
    return Learned.of(*grown(task))


def _side_by_side(one: Callable[[Job], Result], jobs: Sequence[Job], n_threads: int, monitor: Monitor) -> list[Result]:
    """Each job's result; Ctrl-C stops the monitor, upon which jobs end with what they have."""
    results: list[Result] = []
    if n_threads < 2:
        for job in jobs:
            results.append(one(job))
        return results
    futures: list[Future[Result]] = []
    with thread_pool(n_threads) as pool:
        with monitor.keeping_the_best():
            for job in jobs:
                futures.append(pool.submit(one, job))
            done, _ = wait(futures, return_when=FIRST_EXCEPTION)
            if any(future.exception() for future in done):
                # The error is the result: nobody waits for the others.
                monitor.stop()
                pool.shutdown(wait=False, cancel_futures=True)
                next(future for future in futures if future in done and future.exception()).result()
        futures += [pool.submit(one, job) for job in jobs[len(futures) :]]
        return [future.result() for future in futures]
