"""The independent models of a problem: which outputs each has, its rows, and where it starts."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, pairwise, starmap
from operator import index
from typing import NamedTuple

import numpy as np

from ..data.rows import RawRows, Rows
from ..data.threads import BlockMap
from ..kernels.base import Covariance
from ..model.exact import n_contrasts
from ..model.model import SparseModel
from ..model.parameters import Values
from ..utils.monitor import Monitor
from .fitted import Fitted
from .inducing import are_all_rows
from .model import Model
from .problem import Problem, Sharing
from .start import centred_kernels, checked_variance, starting_table
from .units import check_independent

# The kernel of a user is checked at so many points.
_CHECKED_POINTS = 500


class Part(NamedTuple):
    """Outputs that are fitted together."""

    outputs: list[int]
    # Slices of ``outputs``, one for each set of inducing points.
    groups: tuple[slice, ...]
    # Whether rows are split by groups, because groups share weights or have their own inputs.
    split: bool = False
    # Whether groups have their own kernels.
    separate: bool = False

    @property
    def first_outputs(self) -> list[int]:
        """The first output of each set of inducing points."""
        return [self.outputs[group.start] for group in self.groups]


def parts_of(problem: Problem) -> list[Part]:
    """The outputs of each independent model. There is one model if outputs share their weights."""
    sharing, shared, per_output = problem.sharing, problem.units.prior.shared, problem.per_output
    partition = partition_of(sharing, problem.n_outputs)
    everything = sorted(chain(*partition))
    if isinstance(sharing, str) and sharing == "kernel":
        return [Part(everything, tuple(slice(o, o + 1) for o in everything), split=shared or per_output)]
    if per_output and max(map(len, partition)) > 1:
        raise ValueError(
            f"sharing={sharing!r} joins outputs by their inducing points, but kernel_map or feature_map returns a row "
            "for each output: use 'none', or 'kernel' for outputs with the same kernel."
        )
    if not shared or len(partition) == 1:
        return [Part(own, (slice(0, len(own)),)) for own in partition]
    ends = np.cumsum([0, *map(len, partition)]).tolist()
    return [Part(list(chain(*partition)), tuple(starmap(slice, pairwise(ends))), split=True, separate=True)]


def partition_of(sharing: Sharing, n_outputs: int) -> list[list[int]]:
    """The outputs of each independent model according to ``sharing``, in ascending order."""
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


def models_of(
    problem: Problem,
    rng: np.random.RandomState,
    monitor: Monitor,
    threads: BlockMap,
    previous: Fitted | None = None,
) -> list[Model]:
    """The models of a problem, each with its rows and its start. Arguments are those of `fit_model`."""
    parts = parts_of(problem)
    common = _Common.of(problem, rng, threads, len(parts))
    models = []
    for number, part in enumerate(parts):
        warm: Values = {}
        if previous is not None and previous.outputs == [other.outputs for other in parts]:
            warm = previous.values_in(problem.units, common.rows, common.kernels_of(part)[0], number)
            if isinstance(problem.placement.method, np.ndarray):
                warm.pop("inducing_points", None)
        models.append(common.model(part, warm, monitor))
    return models


@dataclass(frozen=True)
class _Common:
    """What all models of a problem have in common at their start."""

    problem: Problem
    # All rows, and those for the starts: without far outliers of y if the noise has heavy tails.
    all_rows: Rows
    rows: Rows
    # The rows among which inducing points are chosen.
    sample: RawRows
    # One for all outputs, or one for each output with inputs of its own: the kernel with its centre, and the points.
    kernels: tuple[Covariance, ...]
    points: list[np.ndarray]
    # The mean of k̃(x, x) under each kernel at the start.
    variances: np.ndarray
    # All models have the same seed: outputs that share nothing are then fitted as if each was alone.
    seed: int
    n_models: int

    @classmethod
    def of(cls, problem: Problem, rng: np.random.RandomState, threads: BlockMap, n_models: int) -> _Common:
        """Choose the first inducing points, under the kernel with which all models start."""
        rows = problem.units.rows(problem.first_source, threads)
        kernels = centred_kernels(problem.spec.covariance, rows.inputs)
        sample, points = rows.sample(problem.placement.sample_size, rng), []
        if problem.vague.any():
            check_independent(sample.features, problem.vague, problem.units.prior.shared)
        for output, kernel in enumerate(kernels):
            inputs = sample.of([output]).inputs
            table = starting_table(problem, rows.outputs([output]), np.empty((1, 0, inputs.shape[1])))
            hyperparameters = table.values_at_start()["hyperparameters"]
            points.append(problem.placement.points(inputs, kernel, hyperparameters, rng))
        given, variances = problem.spec.starts.hyperparameters.value, np.ones(len(kernels))
        if given is not None:
            for index, (kernel, candidates) in enumerate(zip(kernels, points, strict=True)):
                some = np.unique(np.linspace(0, len(candidates) - 1, _CHECKED_POINTS).astype(int))
                variances[index] = checked_variance(kernel, given, candidates[some])
        return cls(
            problem=problem,
            all_rows=problem.units.rows(problem.source, threads),
            rows=rows,
            sample=sample,
            kernels=kernels,
            points=points,
            variances=variances,
            seed=rng.randint(np.iinfo(np.int32).max),
            n_models=n_models,
        )

    def kernels_of(self, part: Part) -> tuple[Covariance, ...]:
        """The kernel of each set of inducing points."""
        return tuple(self.kernels[output % len(self.kernels)] for output in part.first_outputs)

    def model(self, part: Part, warm: Values, monitor: Monitor) -> Model:
        """The model of some outputs. ``warm`` are the values of another fit, as far as they are useful."""
        problem, units, outputs, kernels = self.problem, self.problem.units, part.outputs, self.kernels_of(part)
        start, placed = self._start(part, warm)
        complete = self._is_complete(start, part)
        exact = complete and not part.separate and problem.may_be_exact
        n_kernels = len(start) if part.separate else None
        variances = self.variances[np.array(outputs) % len(self.variances)]
        table = starting_table(problem, self.rows.outputs(outputs), start, variances, n_kernels, exact)
        if complete:
            table = table.changed("inducing_points", fixed=True)
        if problem.solver.takes_widest_limits:
            table = table.widened(("signal", "noise"))
        sparse = SparseModel(
            kernel=kernels[0],
            prior=units.internal_prior().outputs(outputs),
            groups=part.groups,
            variant=problem.variant,
            jitter=problem.rules.jitter,
            complete=complete,
            kernels=kernels if part.split else None,
        )
        share_of_memory = 1.0 / min(problem.n_threads, self.n_models)
        columns = range(outputs[0], outputs[-1] + 1)
        shown = outputs[0] if len(outputs) == 1 else outputs
        contrasts = n_contrasts(self.rows.total, problem.vague[outputs], units.prior.shared)
        return Model(
            problem=problem,
            sparse=sparse,
            rows=self.all_rows.outputs(outputs, share_of_memory).noisier(problem.row_variance),
            table=table,
            seed=self.seed,
            monitor=monitor.seen_as(
                shift=units.shift(contrasts, outputs),
                outputs=columns if len(columns) == len(outputs) else tuple(outputs),
                about="" if self.n_models == 1 else f"y[:, {shown}]",
            ),
            max_iter=problem.max_iter,
            tol=problem.tol,
            warm=table.started_at(warm).values_at_start() if warm else None,
            placed=placed,
            is_exact=exact,
        )

    def _start(self, part: Part, warm: Values) -> tuple[np.ndarray, bool]:
        """The first inducing points (g, m, d), and whether they are those of another fit."""
        sets = [self.points[output % len(self.points)] for output in part.first_outputs]
        # If the number of points is to be found, it starts from the points of the fit before.
        if self.problem.placement.max_inducing is not None and "inducing_points" in warm:
            before, most = warm["inducing_points"], min(self.problem.placement.max_inducing, len(self.rows))
            if len(before) == len(sets) and before.shape[1] <= most:
                return before, True
        m = min(map(len, sets))
        return np.array([points[:m] for points in sets]), False

    def _is_complete(self, start: np.ndarray, part: Part) -> bool:
        """Whether all rows are points. The bound is then the likelihood, and no other points are better."""
        if self.problem.placement.takes_all_rows:
            return True
        if self.problem.variant.family != "full" or len(self.sample.targets) < len(self.rows):
            return False
        inputs = (self.sample.of([output]).inputs for output in part.first_outputs)
        return all(are_all_rows(points, rows) for points, rows in zip(start, inputs, strict=True))
