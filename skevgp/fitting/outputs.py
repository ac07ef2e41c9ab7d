"""Several outputs: plan which of them share what, run their fits, collect what is kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from operator import index
from typing import Literal

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
from ..rows.threads import BlockMap, side_by_side
from .advice import interrupted
from .inducing import Placement, are_all_rows
from .noise.outliers import RowDoubts, fit_doubting
from .sparse import Learned, Solver, SparseTask, grown
from .start import Units, checked_variance, column_centre, starting_table
from .strategy import Fit, search

Sharing = Literal["all", "kernel", "none", "auto"] | Sequence[Sequence[int]]


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
    sharing : {"all", "kernel", "none", "auto"} or sequence of sequence of int
        `sharing.with_groups` turns ``"auto"`` into groups.
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
    found : bool, default=False
        Whether the groups were found and not given.
    heavy_tails : bool, default=False
        Whether the noise has a Student-t's tails.
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
    found: bool = False
    heavy_tails: bool = False


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
    learned : tuple of Learned
        Each model, in internal units.
    messages : tuple of str
        What the user should know of how the fits ended.
    """

    units: Units
    outputs: list[list[int]]
    found: bool
    learned: tuple[Learned, ...]
    messages: tuple[str, ...]

    @property
    def row_scales(self) -> np.ndarray | None:
        """E[τ] of each row and model, (n, n_models); None if the noise is Gaussian."""
        each = [one.doubts.scales.mean for one in self.learned if isinstance(one.doubts, RowDoubts)]
        return np.column_stack(each) if each else None

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
        model, within = self._place_of(output)
        limits = self.learned[model].table[name].value_limits()
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
        (model, within), own = self._place_of(output), [output]
        internal, n_rows = signal / self.units.target_unit[own] ** 2, self.learned[model].statistics[0].n_rows
        bound, gradient = self.learned[model].bound_at(rows.outputs(own), within, hyperparameters, internal)
        return bound - n_rows * self.units.log_unit(own), gradient

    def _place_of(self, output: int) -> tuple[int, int]:
        """Which model an output belongs to, and which of the model's it is."""
        return next((i, own.index(output)) for i, own in enumerate(self.outputs) if output in own)

    def values_in(self, units: Units, rows: Rows, kernel: Kernel, model: int) -> Values:
        """A model's values in other internal units, as far as they can serve another fit."""
        one, own, inputs = self.learned[model], self.outputs[model], rows.inputs
        values, points = one.values, one.values["inducing_points"]
        lowest, highest = inputs.lowest, inputs.highest
        if points.shape[2] != len(inputs.mean):
            return {}
        if (points < 2.0 * lowest - highest).any() or (points > 2.0 * highest - lowest).any():
            return {}
        ratio = (self.units.target_unit[own] / units.target_unit[own]) ** 2
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
        learned = side_by_side(_fit_one, tasks, at_once, monitor)
    finally:
        threads.close()
    messages = sorted({one.message for one in learned if one.message})
    if monitor.stopped:
        messages = [interrupted(max(len(one.loss_curve) for one in learned))]
    outputs = [outputs for outputs, _ in _models(request)]
    return FittedOutputs(request.units, outputs, request.found, tuple(learned), tuple(messages))


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

    def table_of(outputs: list[int], points: np.ndarray, variance: float = 1.0) -> ParameterTable:
        unit, scatter, width = units.target_unit[outputs], rows.scatter()[outputs], kernel.n_hyperparameters
        return starting_table(
            rows.inputs, points, unit, starts, scatter, solver.rules, width, variance, rows.mean_precision
        )

    # The kernel starts alike in all models and without regard to the points, which may depend on it.
    alone = table_of([0], np.empty((1, 0, len(rows.inputs.mean)))).values_at_start()
    inputs = rows.sample(placement.sample_size, rng).inputs
    points = placement.points(inputs, kernel, np.log(alone["hyperparameters"]), rng)
    first, share = starts.hyperparameters.value, 1.0 / min(request.n_threads, len(models))
    variance = 1.0 if first is None else checked_variance(kernel, first, points)
    # The same for all, so that outputs that share nothing are fitted as they would be alone but for rounding.
    seed = rng.randint(np.iinfo(np.int32).max)
    goes_on, tasks = previous is not None and previous.outputs == [outputs for outputs, _ in models], []
    for i, (outputs, groups) in enumerate(models):
        warm: Values | None = None
        if goes_on and previous is not None:
            warm = previous.values_in(units, rows, kernel, i)
            if isinstance(placement.method, np.ndarray):
                warm.pop("inducing_points", None)
        sets = _first_sets(points, len(groups), placement, warm, len(rows))
        table = table_of(outputs, sets, variance)
        # Where they are all rows the bound is the likelihood: no other places are better.
        stay = request.family == "full" and len(inputs) == len(rows) and all(are_all_rows(own, inputs) for own in sets)
        if stay:
            table = table.with_fixed("inducing_points")
        shift = rows.total * units.log_unit(outputs)
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
                monitor.seen_as(shift=shift, outputs=_as_columns(outputs), about=_shown(outputs, len(models))),
                None if warm is None else table.started_at(warm).values_at_start(),
                warm is not None and sets is warm.get("inducing_points"),
                request.heavy_tails,
            )
        )
    return tasks


def _first_sets(
    points: np.ndarray, n_groups: int, placement: Placement, warm: Values | None, n_rows: int
) -> np.ndarray:
    """Inducing points (g, m, d) of each group; where their number is to be found, those of the fit before go on."""
    found, most = None if warm is None else warm.get("inducing_points"), placement.max_inducing
    if found is None or most is None or len(found) != n_groups or found.shape[1] > min(most, n_rows):
        return np.repeat(points[np.newaxis], n_groups, axis=0)
    return found


def _models(request: Request) -> list[tuple[list[int], tuple[slice, ...]]]:
    """The outputs of each independent model, and which of these each set of inducing points serves."""
    outputs = partition_of(request.sharing, len(request.units.target_unit))
    if isinstance(request.sharing, str) and request.sharing == "kernel":
        return [(own, tuple(slice(o, o + 1) for o in range(len(own)))) for own in outputs]
    return [(own, (slice(0, len(own)),)) for own in outputs]


def partition_of(sharing: Sharing, n_outputs: int) -> list[list[int]]:
    """The outputs of each independent model, both in ascending order."""
    everything = list(range(n_outputs))
    if isinstance(sharing, str):
        return [[o] for o in everything] if sharing == "none" else [everything]
    try:
        groups = sorted(sorted(index(o) for o in group) for group in sharing)
    except TypeError:
        groups = []
    if not all(groups) or sorted(chain(*groups)) != everything:
        raise ValueError(
            f"sharing={sharing!r} must be 'all', 'kernel', 'none', 'auto' or a partition of the outputs, such as "
            f"{[everything[:1], everything[1:]] if n_outputs > 1 else [everything]}: each of range({n_outputs}) in one "
            "group."
        )
    return groups


def _as_columns(outputs: list[int]) -> Sequence[int]:
    """A range if they follow each other, else a tuple."""
    columns = range(outputs[0], outputs[-1] + 1)
    return columns if len(columns) == len(outputs) else tuple(outputs)


def _shown(outputs: list[int], n_models: int) -> str:
    """Whose line it is, where there are several models."""
    return "" if n_models == 1 else f"y[:, {outputs[0] if len(outputs) == 1 else outputs}]"


def _fit_one(task: SparseTask) -> Learned:
    # A copy, with which the blocks of rows are forgotten.
    task = replace(task)
    if task.heavy_tails:
        return fit_doubting(task, _best)
    return Learned.of(task, search(task)) if task.placement.max_inducing is None else Learned.of(*grown(task))


def _best(task: SparseTask) -> tuple[SparseTask, Fit]:
    return (task, search(task)) if task.placement.max_inducing is None else grown(task)
