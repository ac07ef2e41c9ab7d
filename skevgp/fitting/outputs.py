"""Several outputs: plan which of them share what, and run their fits."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, combinations
from operator import index
from typing import Literal

import numpy as np

from .._linalg import NotPositiveDefiniteError
from .._progress import Monitor
from ..inference.bounds import PosteriorFamily, features_alone_bound
from ..inference.model import SparseModel
from ..inference.objectives import BoundObjective
from ..kernels.parse import KernelSpec
from ..optimizers.lbfgs import lbfgs
from ..optimizers.parameters import ParameterTable, Values
from ..rows.internal import Rows
from ..rows.source import LocalSource, Source
from ..rows.threads import BlockMap, side_by_side
from .advice import interrupted
from .inducing import Placement, are_all_rows
from .sparse import FittedOutputs, Learned, Solver, SparseTask
from .start import checked_variance, column_centre, starting_table
from .strategy import search
from .units import Units

Sharing = Literal["all", "kernel", "none", "auto"] | Sequence[Sequence[int]]
# Of what its own Gaussian process gains an output over features and noise.
_LARGEST_LOSS = 0.01
# By which groups are found: at most so many rows and points; iterations of the first fit and of others; in nats.
_SAMPLE, _POINTS = 1000, 100
_FIRST_ITERATIONS, _FURTHER_ITERATIONS, _SHORT_TOL = 60, 25, 0.1


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
    family : {"full", "diagonal"}
    placement : Placement
        Of the inducing points.
    solver : Solver
    max_iter : int
    tol : float
        In nats.
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
    tol: float
    noise_cv: int | None
    n_threads: int


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
    found = isinstance(request.sharing, str) and request.sharing == "auto"
    n_outputs = len(request.units.target_unit)
    if found and previous is not None and previous.found and len(previous.units.target_unit) == n_outputs:
        request = replace(request, sharing=previous.outputs)
    elif found:
        # With a copy: a fit with these groups given is the same fit.
        silent = Monitor()
        request = replace(request, sharing=found_groups(request, deepcopy(rng), silent))
        if silent.stopped:  # there is nothing yet to keep
            raise KeyboardInterrupt
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
    outputs, tables = [outputs for outputs, _ in _models(request)], tuple(task.table for task in tasks)
    return FittedOutputs(request.units, outputs, found, tables, tuple(learned), tuple(messages))


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
        unit, scatter = units.target_unit[outputs], rows.scatter()[outputs]
        return starting_table(
            rows.inputs, points, unit, starts, scatter, solver.rules, kernel.n_hyperparameters, variance
        )

    # The kernel starts alike in all models and without regard to the points, which may depend on it.
    alone = table_of([0], np.empty((1, 0, len(rows.inputs.mean))))
    hyperparameters = np.log(alone.values(alone.start())["hyperparameters"])
    inputs = rows.sample(placement.sample_size, rng).inputs
    points = placement.points(inputs, kernel, hyperparameters, rng)
    # Where they are all rows the bound is the likelihood: no other places are better.
    stay = request.family == "full" and len(inputs) == len(rows) and are_all_rows(points, inputs)
    first = starts.hyperparameters.value
    variance = 1.0 if first is None else checked_variance(kernel, first, points)
    # The same for all, so that outputs that share nothing are fitted as they would be alone but for rounding.
    seed = rng.randint(np.iinfo(np.int32).max)
    goes_on = previous is not None and previous.outputs == [outputs for outputs, _ in models]
    share, tasks = 1.0 / min(request.n_threads, len(models)), []
    for i, (outputs, groups) in enumerate(models):
        warm: Values | None = None
        if goes_on and previous is not None:
            warm = previous.values_in(units, rows, kernel, i)
            if isinstance(placement.method, np.ndarray):
                warm.pop("inducing_points", None)
        table = table_of(outputs, np.repeat(points[np.newaxis], len(groups), axis=0), variance)
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
                monitor.seen_as(shift=shift, outputs=_as_columns(outputs)),
                None if warm is None else table.started_at(warm).values_at_start(),
            )
        )
    return tasks


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


def found_groups(request: Request, rng: np.random.RandomState, monitor: Monitor) -> list[list[int]]:
    """Which outputs to fit together: those that one kernel serves, each of them nearly as well as one of its own.

    (The sum of their bounds, which a fit maximises, does not show it: outputs with little noise rule it.) What a kernel
    is worth is seen in short fits to a sample of the rows. The first is of all outputs. Its inducing points then stay,
    so that what follows is a matter of the kernel and not of luck: from there each output is fitted alone, and all
    together. If that costs one of them too much (`_LARGEST_LOSS`), each becomes a group, and of all pairs of groups
    those with the kernels most alike are tried first, and joined if it costs no output too much, until none is left.

    Parameters
    ----------
    request : Request
    rng : RandomState
    monitor : Monitor
        Which Ctrl-C stops.

    Returns
    -------
    groups : list of list of int
        A partition of the outputs.
    """
    everything = list(range(len(request.units.target_unit)))
    if len(everything) == 1 or request.max_iter == 0:
        return [everything]
    fits = _ShortFits.of(request, rng, monitor)
    if fits.n_free == 0:
        return [everything]
    found = side_by_side(fits.alone, everything, request.n_threads, monitor)
    own = np.array([fits.bound(o, values) for o, values in enumerate(found)])
    # A kernel of its own has more parameters, too, each worth ½ log n nats (Schwarz 1978): what gains less can be in
    # any group.
    gain, chance = own - fits.without, 0.5 * fits.n_free * np.log(fits.n_rows)
    bearable = np.maximum(_LARGEST_LOSS * gain, chance)
    learned = [o for o in everything if gain[o] > chance]

    def suits(outputs: list[int], shared: list[Values]) -> bool:
        bounds = [fits.bound(o, values) for o, values in zip(outputs, shared, strict=True)]
        return bool((own[outputs] - bounds <= bearable[outputs]).all())

    if not learned or suits(learned, fits.further(learned, fits.together)):
        return [everything]
    groups, apart = [[o] for o in learned], np.eye(len(everything), dtype=bool)
    while True:
        shapes = [fits.shape(found[group[0]]) for group in groups]
        pairs = [
            (float(shapes[i] @ shapes[j]), i, j)
            for i, j in combinations(range(len(groups)), 2)
            if not apart[np.ix_(groups[i], groups[j])].any()
        ]
        if not pairs:
            return [sorted({*groups[0], *everything}.difference(*groups[1:])), *groups[1:]]
        _, i, j = max(pairs)
        outputs = sorted(groups[i] + groups[j])
        shared = fits.further(outputs, found)
        if suits(outputs, shared):
            groups[i] = outputs
            del groups[j]
            for o, values in zip(outputs, shared, strict=True):
                found[o] = values
        else:
            apart[np.ix_(groups[i], groups[j])] = True


@dataclass(frozen=True)
class _ShortFits:
    """Fits to a sample of the rows, all with the inducing points where a first one of all outputs ended.

    A fit is told as the values of each of its outputs.

    Attributes
    ----------
    request : Request
        Of the sample and the points.
    together : list of dict
        Where the first ended.
    monitor : Monitor
    """

    request: Request
    together: list[Values]
    monitor: Monitor

    @classmethod
    def of(cls, request: Request, rng: np.random.RandomState, monitor: Monitor) -> _ShortFits:
        """With the first fit."""
        raw = Rows(request.source, lambda rows: rows).sample(_SAMPLE, rng)
        source = LocalSource.of(raw.inputs, raw.features, raw.targets)
        placement = Placement("k-means", min(request.placement.n_inducing, _POINTS))
        request = replace(request, source=source, placement=placement, sharing="all", family="full")
        (task,) = plan(request, rng, monitor, BlockMap())
        together = _short_fit(task, task.table, _FIRST_ITERATIONS, monitor)
        points = together[0]["inducing_points"][0]
        return cls(replace(request, placement=Placement(points, len(points))), together, monitor)

    @property
    def n_rows(self) -> int:
        return self.request.source.n_rows

    @property
    def n_free(self) -> int:
        """Parameters of k̃ that are not fixed."""
        return int(self._each[0].table["hyperparameters"].free.sum())

    @property
    def without(self) -> np.ndarray:
        """The bound (o,) of each output without a Gaussian process."""
        return np.array([features_alone_bound(task.blocks.linear, task.model.prior) for task in self._each])

    def alone(self, output: int) -> Values:
        """An output, from where the first fit ended."""
        return self.further([output], self.together)[0]

    def further(self, outputs: list[int], starts: list[Values]) -> list[Values]:
        """Some outputs, from the values of all: from the mean of their kernels."""
        others = [[o] for o in range(len(starts)) if o not in outputs]
        (task,) = (task for task in self._planned([outputs, *others]) if task.rows.columns == outputs)
        own = [starts[o] for o in outputs]
        values = {name: np.concatenate([one[name] for one in own]) for name in ("signal", "noise")}
        values["hyperparameters"] = np.exp(np.mean([np.log(one["hyperparameters"]) for one in own], axis=0))
        return _short_fit(task, task.table.started_at(values), _FURTHER_ITERATIONS, self.monitor)

    def bound(self, output: int, values: Values) -> float:
        """Of an output with its values; very low where it cannot be computed."""
        task = self._each[output]
        try:
            loss, _ = BoundObjective(task.model, task.table, task.blocks)(task.table.started_at(values).start())
        except NotPositiveDefiniteError:
            loss = np.inf
        return -self.n_rows * loss if np.isfinite(loss) else -np.finfo(float).max

    def shape(self, values: Values) -> np.ndarray:
        """k̃ at the points, as a vector of length 1: products are alignments (Cristianini et al. 2001)."""
        kernel, (points,) = self._each[0].model.kernel, values["inducing_points"]
        K = kernel.at(np.log(values["hyperparameters"]), points).matrix()
        return np.ravel(K) / np.linalg.norm(K)

    @cached_property
    def _each(self) -> list[SparseTask]:
        return self._planned([[o] for o in range(len(self.together))])

    def _planned(self, groups: list[list[int]]) -> list[SparseTask]:
        tasks = plan(replace(self.request, sharing=groups), np.random.RandomState(0), Monitor(), BlockMap())
        return [replace(task, table=task.table.with_fixed("inducing_points")) for task in tasks]


def _short_fit(task: SparseTask, table: ParameterTable, n_iter: int, monitor: Monitor) -> list[Values]:
    """The values of each output where so many iterations lead."""
    n_rows = len(task.rows)
    objective = BoundObjective(task.model, table, task.blocks)
    values = table.values(lbfgs(objective, table.start(), table.limits(), n_iter, _SHORT_TOL / n_rows, monitor).x)
    each = range(len(values["noise"]))
    return [values | {name: values[name][[o]] for name in ("signal", "noise")} for o in each]


def _fit_one(task: SparseTask) -> Learned:
    # A copy, with which the blocks of rows are forgotten.
    task = replace(task)
    return Learned.of(task, search(task))
