"""Which outputs share what, and where the fit of each model starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise, starmap
from operator import index
from typing import Any, Literal, TypeVar

import numpy as np

from ..data.internal import Rows
from ..data.source import RawRows, Source
from ..data.threads import BlockMap
from ..kernels.base import Covariance
from ..kernels.parse import KernelSpec
from ..model.bounds import PosteriorFamily
from ..model.model import SparseModel
from ..model.parameters import ParameterTable, Values
from ..utils.monitor import Monitor
from .fitted import FittedOutputs
from .folds import CrossValidation
from .inducing import Placement, are_all_rows
from .sparse import Solver, SparseTask
from .start import centred_kernels, checked_variance, starting_table
from .units import Units

T = TypeVar("T")
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
    heavy_tails : bool, default=False
        Whether the noise has a Student-t's tails.
    row_variance : ndarray of shape (n, n_outputs), optional
        Noise variances of the rows in units of σ², beside what the source knows; outputs of a model share their mean.
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
    heavy_tails: bool = False
    row_variance: np.ndarray | None = None


def plan(
    request: Request,
    rng: np.random.RandomState,
    monitor: Monitor,
    threads: BlockMap,
    previous: FittedOutputs | None = None,
) -> list[SparseTask]:
    """The models to be fitted, each with its rows and where it starts; arguments as of `fit_outputs`."""
    units, placement, solver = request.units, request.placement, request.solver
    models, rows = models_of(request), units.rows(request.source, threads)
    ground = _Ground.of(request, rows, rng)
    # The same for all, so that outputs that share nothing are fitted as they would be alone but for rounding.
    seed = rng.randint(np.iinfo(np.int32).max)
    goes_on = previous is not None and previous.outputs == [model.outputs for model in models]
    share, tasks = 1.0 / min(request.n_threads, len(models)), []
    for i, model in enumerate(models):
        outputs = model.outputs
        kernels = tuple(ground.of_output(ground.kernels, o) for o in model.first_of_groups)
        warm: Values | None = None
        if goes_on and previous is not None:
            warm = previous.values_in(units, rows, kernels[0], i)
            if isinstance(placement.method, np.ndarray):
                warm.pop("inducing_points", None)
        first = [ground.of_output(ground.points, o) for o in model.first_of_groups]
        sets = _first_sets(first, placement, warm, len(rows))
        # Where they are all rows the bound is the likelihood: no other places are better.
        stay = request.family == "full" and ground.is_all_rows(sets, model, len(rows))
        n_kernels = len(sets) if model.separate else None
        table = _table(request, rows, outputs, sets, ground.variance, n_kernels, exact=stay and not model.separate)
        if stay:
            table = table.with_fixed("inducing_points")
        shift = rows.total * units.log_unit(outputs)
        tasks.append(
            SparseTask(
                SparseModel(
                    kernels[0],
                    units.internal_prior().outputs(outputs),
                    request.family,
                    model.groups,
                    solver.rules.jitter,
                    stay,
                    kernels if model.split else None,
                ),
                rows.outputs(outputs, share).noisier(request.row_variance),
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


def _table(
    request: Request,
    rows: Rows,
    outputs: list[int],
    points: np.ndarray,
    variance: float = 1.0,
    n_kernels: int | None = None,
    exact: bool = False,
) -> ParameterTable:
    """The parameters of a model of some outputs, with inducing points (g, m, d); perhaps for the exact model."""
    units, rules = request.units, request.solver.rules
    if exact and not request.heavy_tails and rules.lowest_noise_exact is not None:
        rules = replace(rules, lowest_noise=rules.lowest_noise_exact)

    def of_these(values: np.ndarray | None, unknown: Any) -> Any:
        return unknown if values is None else values[outputs]

    return starting_table(
        rows.outputs(outputs).inputs,
        points,
        units.target_unit[outputs],
        request.spec.starts,
        rows.scatter()[outputs],
        rules,
        request.spec.covariance.n_hyperparameters,
        variance,
        rows.mean_precision,
        n_kernels,
        of_these(units.target_scatter, None),
        of_these(units.rounding, 0.0),
        of_these(units.constant, False),
    )


@dataclass(frozen=True)
class _Ground:
    """What all models start from.

    Attributes
    ----------
    kernels, points : tuple
        k̃, told around which centre it is used, and inducing points; one of each, or of each output's own inputs.
    variance : float
        The mean of k̃(x, x), where the user says where hyperparameters start.
    sample : RawRows
        From which points were chosen.
    """

    kernels: tuple[Covariance, ...]
    points: tuple[np.ndarray, ...]
    variance: float
    sample: RawRows

    @classmethod
    def of(cls, request: Request, rows: Rows, rng: np.random.RandomState) -> _Ground:
        """The kernel starts alike in all models and without regard to the points, which may depend on it."""
        kernels, placement = centred_kernels(request.spec.covariance, rows.inputs), request.placement
        sample, points = rows.sample(placement.sample_size, rng), []
        for output, kernel in enumerate(kernels):
            own = sample.of([output]).inputs
            alone = _table(request, rows, [output], np.empty((1, 0, own.shape[1]))).values_at_start()
            points.append(placement.points(own, kernel, np.log(alone["hyperparameters"]), rng))
        first = request.spec.starts.hyperparameters.value
        variance = 1.0 if first is None else checked_variance(kernels[0], first, points[0])
        return cls(kernels, tuple(points), variance, sample)

    @staticmethod
    def of_output(each: tuple[T, ...], output: int) -> T:
        """One of the kernels or sets of points."""
        return each[output % len(each)]

    def is_all_rows(self, sets: np.ndarray, model: _Model, n_rows: int) -> bool:
        """Whether the points of each group are all its rows."""
        if len(self.sample.targets) < n_rows:
            return False
        each = zip(sets, model.first_of_groups, strict=True)
        return all(are_all_rows(points, self.sample.of([o]).inputs) for points, o in each)


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


def models_of(request: Request) -> list[_Model]:
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
