"""Several outputs: plan which of them share what, run their fits, collect what is kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise, starmap
from operator import index
from typing import Any, Literal

import numpy as np

from .._progress import Monitor
from ..calibration.folds import CrossValidation
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
from .sparse import Learned, Solver, SparseTask, grown
from .start import centred_kernels, checked_variance, starting_table
from .strategy import search
from .units import Units

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
    noise_cv : CrossValidation or None
        By which signal and noise are calibrated.
    n_threads : int
        For independent models, or else for blocks of rows.
    per_output : bool, default=False
        Whether outputs have inputs or features of their own.
    found : bool, default=False
        Whether the groups were found and not given.
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
    noise_cv: CrossValidation | None
    n_threads: int
    per_output: bool = False
    found: bool = False


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

    def updated(self, source: Source, weight: float = 1.0) -> FittedOutputs:
        """Fold new rows into the predictors; ``weight`` multiplies what is known of the others."""
        rows = self.units.rows(source)
        learned = (one.updated(rows.outputs(own), weight) for own, one in zip(self.outputs, self.learned, strict=True))
        return replace(self, learned=tuple(learned))

    def predictor(self) -> Predictor:
        """Of all outputs, in the user's units."""
        return self.units.predictor([one.predictor for one in self.learned], self.outputs)

    @property
    def dependent(self) -> bool:
        """Whether rows near each other were found to be alike."""
        return any(one.dependent for one in self.learned)

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
            m, of_weights = one.values["inducing_points"].shape[1], p + p * (p + 1) // 2
            of_values = m + m * (m + 1) // 2 + m * p
            if one.model.family == "diagonal":
                of_values, of_weights = 2 * m, 2 * p
            total += one.table.size + n_outputs * of_values
            total += of_weights * (1 if one.model.prior.shared else n_outputs)
        return total

    @property
    def sharing(self) -> list[list[int]]:
        """Outputs by what they are fitted with: of a model, or of a group that is joined to others by weights alone."""
        found = []
        for outputs, one in zip(self.outputs, self.learned, strict=True):
            separate = one.values["hyperparameters"].ndim == 2
            found += [outputs[group] for group in one.model.groups] if separate else [outputs]
        return sorted(found)

    def limits(self, name: str, output: int) -> np.ndarray:
        """Limits (n, 2) of an output's ``hyperparameters`` or ``signal``, in the user's units."""
        model, within = self._place_of(output)
        table = self.learned[model].table
        limits = table[name].value_limits()
        if name == "signal":
            # Calibrated, it may have left them.
            (low, high), signal = limits[within], self.learned[model].values["signal"][within]
            return np.array([[min(low, signal), max(high, signal)]]) * self.units.target_unit[output] ** 2
        if table[name].start.ndim == 1:
            return limits
        return limits.reshape(*table[name].start.shape, 2)[self.learned[model].model.set_of(within, table[name])]

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
        if inputs.mean.ndim == 2 and one.model.kernels is None:
            inputs = inputs.at(own)
        if points.shape[2] != inputs.mean.shape[-1] or (inputs.mean.ndim == 2 and len(points) != len(inputs.mean)):
            return {}
        lowest, highest = (edge.reshape(-1, 1, points.shape[2]) for edge in (inputs.lowest, inputs.highest))
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
    models = _models(request)
    # One model has all threads for its blocks of rows; several have one each.
    at_once = min(request.n_threads, len(models))
    threads = BlockMap(request.n_threads if len(models) == 1 else 1)
    try:
        tasks = plan(request, rng, monitor, threads, previous)
        # Of the time that is left each has a share when its turn comes.
        turns = [(task, 1.0 / -(-(len(models) - i) // at_once)) for i, task in enumerate(tasks)]
        learned = side_by_side(_fit_one, turns, at_once, monitor)
    finally:
        threads.close()
    messages = sorted({one.message for one in learned if one.message})
    if monitor.stopped or monitor.out_of_time:
        n_iter, max_time = max(len(one.loss_curve) for one in learned), None if monitor.stopped else monitor.max_time
        messages = [interrupted(n_iter, max_time)]
    return FittedOutputs(
        request.units, [model.outputs for model in models], request.found, tuple(learned), tuple(messages)
    )


def plan(
    request: Request,
    rng: np.random.RandomState,
    monitor: Monitor,
    threads: BlockMap,
    previous: FittedOutputs | None = None,
) -> list[SparseTask]:
    """The models to be fitted, each with its rows and where it starts; arguments as of `fit_outputs`."""
    units, placement, starts, solver = request.units, request.placement, request.spec.starts, request.solver
    models, rows = _models(request), units.rows(request.source, threads)
    kernel, kernels = centred_kernels(request.spec.covariance, rows.inputs)

    def table_of(outputs: list[int], points: np.ndarray, **options: Any) -> ParameterTable:
        unit, scatter = units.target_unit[outputs], rows.scatter()[outputs]
        inputs, width = rows.outputs(outputs).inputs, kernel.n_hyperparameters
        options["precision"] = rows.mean_precision
        return starting_table(inputs, points, unit, starts, scatter, solver.rules, width, **options)

    # The kernel starts alike in all models and without regard to the points, which may depend on it.
    sample, points = rows.sample(placement.sample_size, rng), []
    for output in range(len(kernels or (kernel,))):
        own = sample.of(slice(output, output + 1)).inputs
        alone = table_of([output], np.empty((1, 0, own.shape[1]))).values_at_start()
        points.append(placement.points(own, (kernels or (kernel,))[output], np.log(alone["hyperparameters"]), rng))
    first = starts.hyperparameters.value
    variance = 1.0 if first is None else checked_variance(kernel, first, points[0])
    # The same for all, so that outputs that share nothing are fitted as they would be alone but for rounding.
    seed = rng.randint(np.iinfo(np.int32).max)
    goes_on = previous is not None and previous.outputs == [model.outputs for model in models]
    share, tasks = 1.0 / min(request.n_threads, len(models)), []
    for i, model in enumerate(models):
        outputs = model.outputs
        own_kernels = tuple((kernels or (kernel,) * len(rows.residuals.mean))[o] for o in model.first_of_groups)
        warm: Values | None = None
        if goes_on and previous is not None:
            warm = previous.values_in(units, rows, own_kernels[0], i)
            if isinstance(placement.method, np.ndarray):
                warm.pop("inducing_points", None)
        sets = _first_sets([points[o % len(points)] for o in model.first_of_groups], placement, warm, len(rows))
        table = table_of(outputs, sets, mean_variance=variance, n_kernels=len(sets) if model.separate else None)
        # Where they are all rows the bound is the likelihood: no other places are better.
        stay = request.family == "full" and len(sample.targets) == len(rows)
        stay = stay and all(
            are_all_rows(own, sample.of([o]).inputs) for own, o in zip(sets, model.first_of_groups, strict=True)
        )
        if stay:
            table = table.with_fixed("inducing_points")
        shift = rows.total * units.log_unit(outputs)
        tasks.append(
            SparseTask(
                SparseModel(
                    own_kernels[0],
                    units.internal_prior().outputs(outputs),
                    request.family,
                    model.groups,
                    solver.rules.jitter,
                    stay,
                    own_kernels if model.split else None,
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
            )
        )
    return tasks


def _first_sets(points: list[np.ndarray], placement: Placement, warm: Values | None, n_rows: int) -> np.ndarray:
    """Inducing points (g, m, d) of each group; where their number is to be found, those of the fit before go on."""
    found, most = None if warm is None else warm.get("inducing_points"), placement.max_inducing
    if found is None or most is None or len(found) != len(points) or found.shape[1] > min(most, n_rows):
        m = min(map(len, points))
        return np.array([own[:m] for own in points])
    return found


@dataclass(frozen=True)
class _Model:
    """What is fitted together.

    Attributes
    ----------
    outputs : list of int
    groups : tuple of slice
        Which of these each set of inducing points serves.
    split : bool
        Whether rows are split by groups.
    separate : bool
        Whether each group has a kernel of its own.
    """

    outputs: list[int]
    groups: tuple[slice, ...]
    split: bool = False
    separate: bool = False

    @property
    def first_of_groups(self) -> list[int]:
        return [self.outputs[group.start] for group in self.groups]


def _models(request: Request) -> list[_Model]:
    """The independent models: one, if outputs share their weights."""
    sharing, shared, per_output = request.sharing, request.units.prior.shared, request.per_output
    partition = partition_of(sharing, len(request.units.target_unit))
    everything = sorted(chain(*partition))
    singles = tuple(slice(o, o + 1) for o in everything)
    if isinstance(sharing, str) and sharing == "kernel":
        return [_Model(everything, singles, split=shared or per_output)]
    if per_output and max(map(len, partition)) > 1:
        raise ValueError(
            f"sharing={sharing!r} joins outputs by their inducing points, but kernel_map or feature_map returns a row "
            "for each output: use 'none', or 'kernel' for outputs with the same kernel."
        )
    if not shared or len(partition) == 1:
        return [_Model(own, (slice(0, len(own)),)) for own in partition]
    ends = np.cumsum([0, *map(len, partition)]).tolist()
    return [_Model(list(chain(*partition)), tuple(starmap(slice, pairwise(ends))), split=True, separate=True)]


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


def _fit_one(turn: tuple[SparseTask, float]) -> Learned:
    task, share = turn
    # A copy, with which the blocks of rows are forgotten.
    task = replace(task, monitor=task.monitor.with_time(share))
    if task.placement.max_inducing is None:
        return Learned.of(task, search(task))
    return Learned.of(*grown(task))
