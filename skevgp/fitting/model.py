"""The independent models of a problem: which outputs each has, its rows, its starts, and one run of the solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain, pairwise, starmap
from operator import index
from typing import Any, NamedTuple

import numpy as np

from ..data.blocks import Blocks
from ..data.rows import Rows, of_outputs
from ..data.threads import BlockMap
from ..model.bounds import bounds_alone
from ..model.exact import ExactModel, LikelihoodObjective, exact_twin
from ..model.model import SparseModel
from ..model.objectives import BoundObjective, ElboObjective
from ..model.parameters import ParameterTable, Values
from ..solvers.base import Minimum, Tolerance
from ..utils.linalg import NotPositiveDefiniteError
from ..utils.monitor import Monitor
from .fitted import Fitted
from .inducing import Placement, are_all_rows, distinct_rows, greedy_sample_size, with_more
from .messages import ended_early, learned_too_little, mini_batches_ended
from .problem import Problem, Sharing
from .rules import Rules
from .search import FeaturesAlone, Fit, Start, drawn
from .start import LOWEST_NOISE, centred_kernels, checked_variance, starting_table
from .units import may_hide_noise, noise_of_most_evidence

# Factor by which the number of inducing points grows.
_GROWTH = 1.5
# Noise variances below this share of the prior sum of squares are lost in rounding.
_ROUNDING = 1e-13
# The tolerance of L-BFGS, in nats: this, or this share of the gain over features and noise alone if that is more.
LEAST_TOL, ENOUGH = 0.01, 1.5e-5
# The tolerance for a flat loss of mini-batches: in nats, or in nats per row if that is more.
_FLAT, _FLAT_PER_ROW = 0.1, 0.005
# Relative size of the rounding errors in a bound on all rows.
_BOUND_ROUNDING = 1e-8
# Length of the natural gradient steps of q: the first, and the smallest.
_NATURAL_RATES = 0.3, 0.02


class Part(NamedTuple):
    """Outputs that are fitted together."""

    outputs: list[int]
    # Slices of ``outputs``, one for each set of inducing points.
    groups: tuple[slice, ...]
    # Whether rows are split by groups, because groups share weights or have their own inputs.
    split: bool = False
    # Whether groups have their own kernels.
    separate: bool = False


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
    units, placement, parts = problem.units, problem.placement, parts_of(problem)
    rows, everything = units.rows(problem.first_source, threads), units.rows(problem.source, threads)

    # All models start with the same kernel. If outputs have their own inputs, kernels have own centres and points.
    kernels = centred_kernels(problem.spec.covariance, rows.inputs)
    sample, points = rows.sample(placement.sample_size, rng), []
    for output, kernel in enumerate(kernels):
        inputs = sample.of([output]).inputs
        alone = starting_table(problem, rows.outputs([output]), np.empty((1, 0, inputs.shape[1]))).values_at_start()
        points.append(placement.points(inputs, kernel, alone["hyperparameters"], rng))
    first = problem.spec.starts.hyperparameters.value
    variance = 1.0 if first is None else checked_variance(kernels[0], first, points[0])

    # All models have the same seed: outputs that share nothing are then fitted as if each was alone.
    seed = rng.randint(np.iinfo(np.int32).max)
    goes_on = previous is not None and previous.outputs == [part.outputs for part in parts]
    models = []
    for i, part in enumerate(parts):
        heads = [part.outputs[group.start] for group in part.groups]
        own_kernels = tuple(kernels[o % len(kernels)] for o in heads)
        warm: Values | None = None
        if goes_on and previous is not None:
            warm = previous.values_in(units, rows, own_kernels[0], i)
            if isinstance(placement.method, np.ndarray):
                warm.pop("inducing_points", None)
        sets, found = [points[o % len(points)] for o in heads], None if warm is None else warm.get("inducing_points")
        most = placement.max_inducing
        # If the number of points is to be found, it starts from the points of the fit before.
        placed = (
            found is not None
            and most is not None
            and len(found) == len(sets)
            and found.shape[1] <= min(most, len(rows))
        )
        start = found if placed else np.array([own[: min(map(len, sets))] for own in sets])
        assert start is not None
        # If all rows are points, the bound is the likelihood, and no other points are better.
        stay = (
            problem.family == "full"
            and len(sample.targets) >= len(rows)
            and all(are_all_rows(own, sample.of([o]).inputs) for own, o in zip(start, heads, strict=True))
        )
        share = 1.0 / min(problem.n_threads, len(parts))
        n_kernels, exact = (
            len(start) if part.separate else None,
            stay and not part.separate and not problem.noise.heavy_tails,
        )
        table = starting_table(problem, rows.outputs(part.outputs), start, variance, n_kernels, exact)
        if stay:
            table = table.changed("inducing_points", fixed=True)
        columns = range(part.outputs[0], part.outputs[-1] + 1)
        shown = part.outputs[0] if len(part.outputs) == 1 else part.outputs
        sparse = SparseModel(
            kernel=own_kernels[0],
            prior=units.internal_prior().outputs(part.outputs),
            family=problem.family,
            groups=part.groups,
            jitter=problem.rules.jitter,
            complete=stay,
            kernels=own_kernels if part.split else None,
            tight=problem.tight,
            orthogonal=problem.orthogonal,
        )
        model = Model(
            problem=problem,
            sparse=sparse,
            rows=everything.outputs(part.outputs, share).noisier(problem.row_variance),
            table=table,
            seed=seed,
            monitor=monitor.seen_as(
                shift=rows.total * units.log_unit(part.outputs),
                outputs=columns if len(columns) == len(part.outputs) else tuple(part.outputs),
                about="" if len(parts) == 1 else f"y[:, {shown}]",
            ),
            max_iter=problem.max_iter,
            tol=problem.tol,
            warm=None if warm is None else table.started_at(warm).values_at_start(),
            placed=placed,
        )
        models.append(model)
    return models


@dataclass(frozen=True)
class Model:
    """Some outputs that are fitted together: rows, parameters, starts, and one run of the solver."""

    problem: Problem
    sparse: SparseModel
    rows: Rows
    # The parameters with first values and limits.
    table: ParameterTable
    seed: int
    monitor: Monitor
    max_iter: int
    # In nats. None: relative to the gain over features and noise alone.
    tol: float | None
    # First values from another fit, and whether the table has its inducing points.
    warm: Values | None = None
    placed: bool = False

    @cached_property
    def rng(self) -> np.random.RandomState:
        """The only source of randomness of the fit."""
        return np.random.RandomState(self.seed)

    # --- the rows -----------------------------------------------------------------------------------------------------

    @property
    def n_inducing(self) -> int:
        """Number of inducing points of each set."""
        return self.table["inducing_points"].start.shape[1]

    @property
    def scatter(self) -> np.ndarray:
        """Noise variances (o,) that would explain all of the residuals."""
        return self.rows.scatter()

    @property
    def mean_precision(self) -> float:
        """Mean precision of the rows, in units of 1/σ²."""
        return self.rows.mean_precision

    @property
    def interpolates(self) -> bool:
        """Whether there are as many inducing points as rows. Fixed points are all rows, without duplicates."""
        return self.n_inducing >= len(self.rows) or not self.table["inducing_points"].free.any()

    @cached_property
    def samples(self) -> tuple[int, ...]:
        """Sizes of the samples that the fit begins with."""
        (o, p), (g, _, d) = self.sparse.prior.scale.shape, self.table["inducing_points"].start.shape
        width = d + p + o if self.sparse.kernels is None else g * (d + p) + o
        return () if self.interpolates else self.rules.samples(len(self.rows), self.n_inducing + p, width)

    @property
    def lengthscale_mask(self) -> np.ndarray:
        """Whether each hyperparameter is the length scale of one of several columns, (n_hyper,)."""
        return self.problem.spec.covariance.lengthscale_mask

    @cached_property
    def _sample(self) -> Rows:
        return self.rows.random_subset(self.samples[-1], self.rng)

    @cached_property
    def blocks(self) -> Blocks:
        """All rows as blocks."""
        return self.sparse.blocks(self.rows, self.n_inducing)

    @cached_property
    def exact(self) -> ExactModel | None:
        """The exact model of the rows if all rows are inducing points, else None."""
        sparse, separate = self.sparse, self.table["hyperparameters"].start.ndim == 2
        if not sparse.complete or separate or self.problem.noise.heavy_tails or self.rules.lowest_noise_exact is None:
            return None
        return exact_twin(sparse, self.table, self.rows)

    def objective(self, table: ParameterTable, n_rows: int | None = None) -> BoundObjective | LikelihoodObjective:
        """Minus the bound per row and its gradient, of a sample of ``n_rows`` rows or of all."""
        if n_rows is not None:
            # A smaller sample is the first part of the larger one.
            blocks = self.sparse.blocks(self._sample.subset(np.arange(n_rows)), self.n_inducing)
            # It only gives a start. The bound of Titsias (2009) spreads points better: what they leave out costs more.
            return BoundObjective(replace(self.sparse, tight=False), table, blocks)
        if self.exact is not None:
            return LikelihoodObjective(self.exact, table)
        return BoundObjective(self.sparse, table, self.blocks)

    # --- the features without a Gaussian process ----------------------------------------------------------------------

    @cached_property
    def bound_alone(self) -> float:
        """The bound of the features without a Gaussian process, where noise explains all residuals."""
        none = np.zeros(len(self.sparse.prior.scale))
        return float(bounds_alone(self.blocks.linear, self.sparse.prior, self._left_over(none), none).sum())

    @cached_property
    def alone(self) -> FeaturesAlone:
        """The bound of the features with as little Gaussian process as the limits allow."""
        values, signal, rows = self.table.values_at_start(), self.table["signal"], self.rows
        points, (kernel, hyperparameters) = values["inducing_points"][0], self.sparse.kernel_of(values, 0)
        variance = np.mean(kernel.at(hyperparameters, points).diagonal(kernel.prepare(points)))
        little = np.where(signal.free, signal.value_limits()[:, 0], values["signal"])
        trace = little * variance * rows.total * rows.mean_precision
        hidden = may_hide_noise(self.sparse.prior, self.blocks.linear.length)
        bound, noise = self._best_alone(trace, hidden)
        # The trace of a fixed signal depends on the end of the kernel.
        is_open = hidden and not signal.free.all()
        most = self._best_alone(np.zeros(len(trace)), hidden)[0] if is_open else -np.inf
        return FeaturesAlone(bound, noise, most, hidden)

    def _left_over(self, trace: np.ndarray) -> np.ndarray:
        """Noise variances (o,) equal to the mean squared residuals of the features, plus a trace of f's prior."""
        squares = self.blocks.linear.RR
        return np.maximum((squares + trace) / self.rows.total, LOWEST_NOISE * self.rows.mean_precision)

    def _best_alone(self, trace: np.ndarray, hidden: bool) -> tuple[float, np.ndarray]:
        """The highest bound with q(f) at its prior, which has a given trace, and the noise variances (o,) for it."""
        prior, sums = self.sparse.prior, self.blocks.linear
        least = highest = self._left_over(trace)
        if self.max_iter > 0 and hidden:
            lowest, highest = self.table["noise"].value_limits().T
            # Directions without data have a precision of 1, which is lost in rounding next to large features.
            sizes = [scale**2 * np.diagonal(sums.of(slice(o, o + 1))[0]) for o, scale in enumerate(prior.scale)]
            unseen = [np.sort(own)[: max(len(own) - sums.length, 0)].sum() for own in sizes]
            least = np.maximum(lowest, _ROUNDING * np.array(unseen))
        return noise_of_most_evidence(
            lambda noise: bounds_alone(sums, prior, noise, trace), least, highest, prior.shared
        )

    # --- starts -------------------------------------------------------------------------------------------------------

    @property
    def rules(self) -> Rules:
        """The rules of the search."""
        return self.problem.rules

    @property
    def n_restarts(self) -> int:
        """Number of further fits from random starts."""
        return self.problem.solver.n_restarts

    @property
    def place(self) -> Callable[[Values], Values] | None:
        """The function that places inducing points again under the kernel of its argument. None if they stay."""
        anew = self.problem.placement.anew
        return None if anew is None else partial(self._placed, placement=anew)

    def restart(self) -> Values:
        """Random first values."""
        return self._placed(drawn(self.table, self.rules, self.rng), self.problem.placement)

    def _placed(self, values: Values, placement: Placement) -> Values:
        """The same values with inducing points placed under their kernel, equal for groups with the same kernel."""
        sample = self.rows.sample(placement.sample_size, self.rng)
        sets = []
        for group, outputs in enumerate(self.sparse.groups if self.sparse.kernels is not None else (slice(None),)):
            kernel, hyperparameters = self.sparse.kernel_of(values, group)
            inputs = of_outputs(sample.inputs, outputs)
            sets.append(placement.points(inputs, kernel, hyperparameters, self.rng))
        m = min(map(len, sets))
        points = np.array([own[:m] for own in sets])
        return values | {"inducing_points": np.repeat(points, len(self.sparse.groups) // len(points), axis=0)}

    def placed_under(self, values: Values) -> Values:
        """Values of a kernel with the model's number of inducing points, placed greedily."""
        if not self.table["inducing_points"].free.any():
            return values | {"inducing_points": self.table["inducing_points"].start}
        return self._placed(values, Placement("greedy", self.n_inducing))

    def with_more(self, values: Values) -> Model | None:
        """The model with half as many points again, including those of a fit. None if there cannot be more."""
        most = self.problem.placement.max_inducing
        if most is None or self.n_inducing >= most:
            return None
        wanted = min(int(np.ceil(_GROWTH * self.n_inducing)), most)
        sample, sets, everything = self.rows.sample(greedy_sample_size(wanted), self.rng), [], True
        for group, (outputs, points) in enumerate(zip(self.sparse.groups, values["inducing_points"], strict=True)):
            inputs = of_outputs(sample.inputs, outputs)
            distinct, (kernel, hyperparameters) = distinct_rows(inputs), self.sparse.kernel_of(values, group)
            if len(inputs) == len(self.rows) and len(distinct) <= wanted:
                sets.append(distinct)
            else:
                everything = False
                sets.append(with_more(points, wanted, inputs, kernel, hyperparameters))
        n_inducing = min(map(len, sets))
        if n_inducing <= self.n_inducing:
            return None
        table = self.table.changed("inducing_points", start=np.array([own[:n_inducing] for own in sets]))
        if everything and self.sparse.family == "full":
            # The bound is then the likelihood, and no other points are better.
            table = table.changed("inducing_points", fixed=True)
            return replace(self, table=table, sparse=replace(self.sparse, complete=True))
        return replace(self, table=table)

    # --- the way from a start -----------------------------------------------------------------------------------------

    def minimise(self, start: Start) -> Fit:
        """Run the solver from a start."""
        table = self.table.started_at(start.values)
        return (
            self._by_mini_batches(table, start) if self.problem.solver.stochastic else self._by_all_rows(table, start)
        )

    def _by_all_rows(self, table: ParameterTable, start: Start) -> Fit:
        """Run a solver that sees all rows."""
        solver: Any = self.problem.solver
        spent, n_rows = len(start.loss_curve), self.rows.total
        about = "all rows" if start.n_rows is None else f"{start.n_rows:,} of {len(self.rows):,} rows"
        if self.problem.placement.max_inducing is not None:
            about = f"{self.n_inducing} points, {about}"
        tolerance = Tolerance(LEAST_TOL / n_rows, ENOUGH, -self.bound_alone / n_rows)
        if self.tol is not None and start.n_rows is None:
            tolerance = Tolerance(self.tol / n_rows)
        curvature = None
        if not start.cold:
            # The curvature on the smallest sample, or on all rows.
            curvature = self.objective(table, self.samples[0] if self.samples else None), table.alike()
        minimum = solver.minimise(
            self.objective(table, start.n_rows),
            table.start(),
            table.limits(),
            start.until - spent,
            tolerance,
            self.monitor.seen_as(spent, n_rows, about=about),
            curvature,
        )
        return Fit(
            table.values(minimum.x),
            -n_rows * minimum.loss,
            start.loss_curve + [n_rows * loss for loss in minimum.loss_curve],
            minimum.converged,
            ended_early(type(solver).__name__, minimum, spent + minimum.n_iter, self.max_iter, self.tol),
            n_rows=start.n_rows,
        )

    def _by_mini_batches(self, table: ParameterTable, start: Start) -> Fit:
        """Run a solver that sees mini-batches."""
        solver: Any = self.problem.solver
        n_rows, tol = self.rows.total, LEAST_TOL if self.tol is None else self.tol
        flat = max(_FLAT, _FLAT_PER_ROW * n_rows) if self.tol is None else tol
        elbo = ElboObjective(self.sparse, table, self.blocks, _NATURAL_RATES if solver.natural_gradient else None)
        first = elbo.table.start()
        minimum: Minimum = solver.minimise(
            elbo.minibatch(self.rows.batches(self.sparse.kernel, solver.batch_size, self.rng)),
            first,
            elbo.table.limits(),
            start.until,
            flat / n_rows,
            self.monitor.seen_as(factor=n_rows),
            elbo.pace,
        )
        # The loss of a mini-batch is too noisy to choose the best point. The bound on all rows is not.
        x, (bound, predictor) = first, elbo.solution(first)
        at_start, reached = bound, bound if minimum.n_iter == 0 else -np.inf
        for other in (*minimum.others, minimum.x) if minimum.n_iter > 0 else ():
            try:
                solution = elbo.solution(other)
            except NotPositiveDefiniteError:
                continue
            reached = max(reached, solution[0])
            if solution[0] >= bound:
                x, (bound, predictor) = other, solution
        values = elbo.table.values(x)
        fell = not reached >= at_start - max(tol, _BOUND_ROUNDING * abs(at_start))
        return Fit(
            {name: values[name] for name in start.values},
            bound,
            [n_rows * loss for loss in minimum.loss_curve],
            minimum.converged,
            mini_batches_ended(type(solver).__name__, minimum, fell, solver.learning_rate, solver.batch_size),
            predictor,
        )

    def learned_too_little(self, values: Values) -> str:
        """The message of `messages.learned_too_little`, for each group with its own columns. Empty if all is well."""
        if self.rows.inputs.mean.ndim == 1:
            kernel, hyperparameters = self.sparse.kernel_of(values, 0)
            return learned_too_little(kernel, values | {"hyperparameters": hyperparameters}, self.table, self.rows)
        told = []
        for group, outputs in enumerate(self.sparse.groups):
            kernel, hyperparameters = self.sparse.kernel_of(values, group)
            own = {"hyperparameters": hyperparameters, "noise": values["noise"][outputs]}
            told.append(learned_too_little(kernel, own, self.table, self.rows.outputs(outputs)))
        return max(told)
