"""`Model`: some outputs that are fitted together, with their rows and parameters. It runs the solver from a start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from ..data.blocks import Blocks
from ..data.rows import Rows, of_outputs
from ..model.bounds import bounds_alone
from ..model.exact import ExactModel, LikelihoodObjective
from ..model.model import SparseModel
from ..model.objectives import BoundObjective, ElboObjective
from ..model.parameters import ParameterTable, Values
from ..model.posterior import ExactPosterior, FittedPosterior, SparsePosterior
from ..model.statistics import SufficientStatistics
from ..solvers import LBFGS
from ..solvers.base import Minimum, Objective, Tolerance
from ..utils.linalg import NotPositiveDefiniteError
from ..utils.monitor import Monitor
from . import few_rows
from .alone import best_by_likelihood, best_by_sums, features_alone, noise_left_over
from .inducing import Placement, distinct_rows, greedy_sample_size, with_more_points
from .messages import ended_early, far_from_prior, learned_too_little, mini_batches_ended
from .problem import Problem
from .rules import Rules
from .runs import FeaturesAlone, Fit, Start
from .units import may_hide_noise

# Factor by which the number of inducing points grows.
_GROWTH = 1.5
# For a higher ratio of signal to noise variance, the exact predictor is used for duplicate rows too.
_HIGH_RATIO = 1e9
# The tolerance of L-BFGS, in nats: this, or this share of the gain over features and noise alone if that is more.
LEAST_TOL, ENOUGH = 0.01, 1.5e-5
# The tolerance for a flat loss of mini-batches: in nats, or in nats per row if that is more.
_FLAT, _FLAT_PER_ROW = 0.1, 0.005
# Share of the mean noise variance. A signal this small costs almost nothing, and its gradient shows if it should grow.
LITTLE = 1e-4
# Relative size of the rounding errors in a bound on all rows.
_BOUND_ROUNDING = 1e-8
# The mode of kernel and noise is found to so many nats, in up to so many iterations, before draws around it.
_MODE_TOL, _MODE_ITER = 1e-6, 100
# Length of the natural gradient steps of q: the first, and the smallest.
_NATURAL_RATES = 0.3, 0.02


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
    # Whether the likelihood of the exact model takes the place of the bound.
    is_exact: bool = False

    @cached_property
    def rng(self) -> np.random.RandomState:
        """The only source of randomness of the fit. A model that `replace` returns draws the same numbers again."""
        return np.random.RandomState(self.seed)

    # --- the rows -----------------------------------------------------------------------------------------------------

    @property
    def outputs(self) -> list[int]:
        """Columns of y."""
        return np.arange(self.problem.n_outputs)[self.rows.columns].tolist()

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
        if self.is_exact and self.problem.solver.takes_any_objective and not self.has_few_rows:
            return self.rules.exact_samples(len(self.rows), self.n_learned + p)
        return () if self.interpolates else self.rules.samples(len(self.rows), self.n_inducing + p, width)

    @property
    def lengthscale_mask(self) -> np.ndarray:
        """Whether each hyperparameter is the length scale of one of several columns, (n_hyper,)."""
        return self.problem.spec.covariance.lengthscale_mask

    @cached_property
    def _sample(self) -> Rows:
        # An exact fit without restarts does not depend on the seed.
        return self.rows.random_subset(self.samples[-1], np.random.RandomState(0) if self.is_exact else self.rng)

    @cached_property
    def blocks(self) -> Blocks:
        """All rows as blocks."""
        return self.sparse.blocks(self.rows, self.n_inducing)

    @cached_property
    def exact(self) -> ExactModel | None:
        """The exact model of the rows, or None if a bound is maximised."""
        if not self.is_exact:
            return None
        return ExactModel.of(self.sparse, self.vague, self.rows.some(np.arange(len(self.rows))))

    @property
    def vague(self) -> np.ndarray:
        """Weights (o, p) with an infinite prior scale."""
        return self.problem.vague[self.rows.columns]

    def _count(self, n_rows: int) -> float:
        """How often each row of a sample counts: for the rows left out, but a small sample less."""
        # What inducing points say costs the same in a sample as in all rows. If rows count once, it weighs more, and
        # the optimum is elsewhere. If those of a small sample count for all rows, the kernel overfits them.
        return min(len(self.rows), n_rows**2 / self.samples[0]) / n_rows

    @property
    def keeps_metric(self) -> bool:
        """Whether a fit to more rows moves along the curvature of the sample before it.

        Samples of the exact model have no inducing points, whose cost would move their optimum.
        """
        if not self.samples:
            return False
        return self.is_exact or self._count(self.samples[-1]) * self.samples[-1] >= len(self.rows)

    def shows_signal(self, fit: Fit) -> bool:
        """Whether a fit to a sample gains more over the features alone than its learned numbers may by chance."""
        # With little signal, the likelihood of a sample may have its maximum where the kernel is as white as noise. A
        # few inducing points cannot represent such a kernel.
        free = self.table["noise"].free & self.table["signal"].free
        if not self.is_exact or fit.n_rows is None or not free.all():
            return True
        noise = self.alone.noise
        little = np.minimum(fit.values["signal"], LITTLE * noise / self.mean_precision)
        alone = self.bound_at(fit.values | {"signal": little, "noise": noise}, fit.n_rows)
        return fit.n_rows / len(self.rows) * (fit.bound - alone) > self.rules.chance * self.n_learned

    def objective(self, table: ParameterTable, n_rows: int | None = None) -> Objective:
        """Minus the bound per row and its gradient, of a sample of ``n_rows`` rows or of all.

        That of all rows has the log prior of kernel and noise, if these have one.
        """
        if n_rows is not None:
            # A smaller sample is the first part of the larger one.
            sample = self._sample.subset(np.arange(n_rows))
            if self.is_exact:
                return LikelihoodObjective(
                    ExactModel.of(self.sparse, self.vague, sample.some(np.arange(n_rows))), table
                )
            blocks = self.sparse.blocks(sample.counted(np.full(n_rows, self._count(n_rows))), self.n_inducing)
            # It only gives a start. The bound of Titsias (2009) spreads points better: what they leave out costs more.
            loose = replace(self.sparse, variant=replace(self.sparse.variant, tight=False))
            return BoundObjective(loose, table, blocks)
        objective: Objective
        if self.exact is not None:
            objective = LikelihoodObjective(self.exact, table)
        else:
            objective = BoundObjective(self.sparse, table, self.blocks)
        if self.hyper_prior is None:
            return objective
        return few_rows.WithPrior(objective, table, self.hyper_prior, self.rows.total)

    @property
    def n_learned(self) -> int:
        """Number of free hyperparameters, signal and noise variances."""
        return int(sum(self.table[name].free.sum() for name in ("hyperparameters", "signal", "noise")))

    @property
    def has_few_rows(self) -> bool:
        """Whether rows are few for the learned numbers of kernel and noise."""
        return self.max_iter > 0 and self.rows.total < self.rules.few_rows * self.n_learned

    @cached_property
    def hyper_prior(self) -> few_rows.HyperPrior | None:
        """The prior of kernel and noise. None if there are enough rows, or if there is no such prior for the model."""
        problem, table = self.problem, self.table
        unsupported = (
            not problem.solver.takes_any_objective
            or problem.noise.heavy_tails
            or problem.variant.family != "full"
            or problem.variant.n_neighbors > 0
            or (problem.variant.orthogonal and self.sparse.prior.scale.size > 0)
            or self.sparse.kernels is not None
            or self.sparse.prior.shared
        )
        if unsupported or not self.has_few_rows or not table["hyperparameters"].free.any():
            return None
        if self.rows.is_constant().all():
            return None
        weight = np.sqrt(1.0 - self.rows.total / (self.rules.few_rows * self.n_learned))
        kernel, scale = problem.spec.covariance, self.rows.inputs.scale
        return few_rows.HyperPrior.of(table, kernel, scale, self._variance_of_residuals, weight)

    @property
    def _variance_of_residuals(self) -> np.ndarray:
        """The scatter (o,), and 0 for constants."""
        return np.where(self.rows.is_constant(), 0.0, self.scatter)

    def log_hyper_prior(self, values: Values) -> float:
        """The log prior density of kernel and noise, which the objective has."""
        return 0.0 if self.hyper_prior is None else self.hyper_prior.log_density(values)

    def by_forward_selection(self) -> Values | None:
        """The start of `few_rows.forward_selection`. None if rows are not few, or if there are not several columns.

        Raises KeyboardInterrupt if the fit is to end.
        """
        prior = self.hyper_prior
        if prior is None or prior.columns is None or prior.columns.sum() < 2:
            return None
        table = self.table.changed("inducing_points", fixed=True)
        seen = partial(self.monitor.silent().iteration, 0)
        chosen = few_rows.forward_selection(self._energy(table), table, prior, self._variance_of_residuals, seen)
        return {name: chosen[name] for name in prior.means}

    def draws(self, fit: Fit) -> list[Values]:
        """Draws of kernel and noise from their posterior around the ends of a search. Empty if it was stopped."""
        assert self.hyper_prior is not None
        table, monitor = self.table.started_at(fit.values).changed("inducing_points", fixed=True), self.monitor.silent()
        objective, limits, tolerance = self.objective(table), table.limits(), Tolerance(_MODE_TOL / self.rows.total)
        # The chain moves in coordinates that do not depend on units.
        medians = {name: np.exp(mean) for name, mean in self.hyper_prior.means.items()}
        energy, origin = self._energy(table), table.started_at(medians).start()
        modes: list[np.ndarray] = []
        most = min(_MODE_ITER, self.max_iter)
        for values in fit.others or (fit.values,):
            start, curvature = np.clip(table.started_at(values).start(), *limits), (objective, table.alike())
            modes.append(LBFGS().minimise(objective, start, limits, most, tolerance, monitor, curvature).x)
        found: list[np.ndarray] = []
        with monitor.keeping_the_best():
            rng, seen = np.random.RandomState(0), partial(monitor.iteration, 0)
            shifted, edges = [mode - origin for mode in modes], (limits[0] - origin, limits[1] - origin)
            found = few_rows.drawn(lambda z: energy(origin + z), shifted, edges, rng, seen)
        return [table.values(origin + z) for z in found]

    def _energy(self, table: ParameterTable) -> Objective:
        """Minus the bound and the log prior, in nats, and its gradient."""
        objective, n_rows = self.objective(table), self.rows.total

        def energy(x: np.ndarray) -> tuple[float, np.ndarray]:
            loss, gradient = objective(x)
            return n_rows * loss, n_rows * gradient

        return energy

    def bound_at(self, values: Values, n_rows: int | None = None) -> float:
        """The bound at some values, of a sample of ``n_rows`` rows or of all. -inf if it cannot be computed."""
        table = self.table.started_at(values)
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                loss, _ = self.objective(table, n_rows)(table.start())
        except NotPositiveDefiniteError:
            return -np.inf
        return float(-self.rows.total * loss) if np.isfinite(loss) else -np.inf

    def posterior(self, values: Values, statistics: list[SufficientStatistics] | None = None) -> FittedPosterior:
        """The posterior at some values. The ``statistics`` of all rows at these are computed if they are None."""
        if self.exact is not None:
            # Fewer points than rows make predictions cheaper. The jitter of k(X_m, X_m) would show in a small std.
            distinct = self.n_inducing == len(self.rows)
            if distinct or (values["signal"] > _HIGH_RATIO * values["noise"]).any():
                return ExactPosterior.of(self.sparse, self.exact, values)
        return SparsePosterior.of(self.sparse, values, self.blocks, statistics)

    # --- the features without a Gaussian process ----------------------------------------------------------------------

    @cached_property
    def bound_alone(self) -> float:
        """The bound of the features without a Gaussian process, where noise explains all residuals."""
        sums, none = self.blocks.linear, np.zeros(len(self.sparse.prior.scale))
        return float(bounds_alone(sums, self.sparse.prior, noise_left_over(self.rows, sums), none).sum())

    @cached_property
    def alone(self) -> FeaturesAlone:
        """The bound of the features with as little Gaussian process as the limits allow."""
        hidden = may_hide_noise(self.sparse.prior, len(self.rows))
        if self.exact is not None:
            return features_alone(self.table, hidden, partial(best_by_likelihood, self.exact, self.table, hidden))
        by_sums = partial(best_by_sums, self.sparse, self.table, self.rows, self.blocks.linear, hidden)
        return features_alone(self.table, hidden, by_sums)

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
        """Random first values of kernel and noise within their limits."""
        coordinates = self.table.coordinates(self.table.start())
        for name, factor in self.rules.restart_factors.items():
            reach = np.log(factor)
            coordinates[name] = coordinates[name] + self.rng.uniform(-reach, reach, coordinates[name].shape)
        values = self.table.values(np.clip(self.table.flat(coordinates), *self.table.limits()))
        return self._placed(values, self.problem.placement) if self.table["inducing_points"].free.any() else values

    def _placed(self, values: Values, placement: Placement) -> Values:
        """The same values with inducing points placed under their kernel, equal for groups with the same kernel."""
        sample = self.rows.sample(placement.sample_size, self.rng)
        sets = []
        for group, outputs in enumerate(self.sparse.groups if self.sparse.kernels is not None else (slice(None),)):
            kernel, hyperparameters = self.sparse.kernel_of(values, group)
            inputs = of_outputs(sample.inputs, outputs)
            sets.append(placement.points(inputs, kernel, hyperparameters, self.rng))
        m = min(map(len, sets))
        points = np.array([points[:m] for points in sets])
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
                sets.append(with_more_points(points, wanted, inputs, kernel, hyperparameters))
        n_inducing = min(map(len, sets))
        if n_inducing <= self.n_inducing:
            return None
        table = self.table.changed("inducing_points", start=np.array([points[:n_inducing] for points in sets]))
        if everything and self.sparse.variant.family == "full":
            # The bound is then the likelihood, and no other points are better.
            table = table.changed("inducing_points", fixed=True)
            exact = self.problem.may_be_exact and table["hyperparameters"].start.ndim == 1
            return replace(self, table=table, sparse=replace(self.sparse, complete=True), is_exact=exact)
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
        if self.tol is not None and start.n_rows is None:
            tolerance = Tolerance(self.tol / n_rows)
        else:
            share = ENOUGH
            if start.n_rows is None and start.metric is not None:
                share *= self.rules.last_share
            tolerance = Tolerance(LEAST_TOL / n_rows, share, -self.bound_alone / n_rows)
        objective, curvature = self.objective(table, start.n_rows), None
        if not start.cold:
            # The curvature on the smallest sample, or on all rows.
            few = self.samples[0] if self.samples else None
            curvature = objective if start.n_rows == few else self.objective(table, few), table.alike()
        minimum = solver.minimise(
            objective,
            table.start(),
            table.limits(),
            start.until - spent,
            tolerance,
            self.monitor.seen_as(spent, n_rows, about=about),
            curvature,
            start.metric,
        )
        n_iter, name = spent + minimum.n_iter, type(solver).__name__
        return Fit(
            table.values(minimum.x),
            -n_rows * minimum.loss,
            start.loss_curve + [n_rows * loss for loss in minimum.loss_curve],
            minimum.converged,
            ended_early(name, minimum, n_iter, self.max_iter, self.tol, self.has_inducing_points),
            n_rows=start.n_rows,
            metric=minimum.metric,
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

    # --- messages -----------------------------------------------------------------------------------------------------

    @property
    def has_inducing_points(self) -> bool:
        """Whether the user knows of inducing points."""
        return not self.problem.placement.takes_all_rows

    def far_from_prior(self, values: Values) -> str:
        """The message of `messages.far_from_prior`. Vague weights are never far."""
        prior = self.sparse.prior.at(values)
        proper = replace(prior, reference=np.where(self.vague, 0.0, prior.reference))
        return far_from_prior(proper, self.rows, self.problem.weight_names)

    def learned_too_little(self, values: Values) -> str:
        """The message of `messages.learned_too_little`, for each group with its own columns. Empty if all is well."""
        sparse, has_points = self.sparse, self.has_inducing_points
        if self.rows.inputs.mean.ndim == 1:
            kernel, hyperparameters = sparse.kernel_of(values, 0)
            values = values | {"hyperparameters": hyperparameters}
            return learned_too_little(kernel, values, self.table, self.rows, has_points)
        messages = []
        for group, outputs in enumerate(sparse.groups):
            kernel, hyperparameters = sparse.kernel_of(values, group)
            of_group = {"hyperparameters": hyperparameters, "noise": values["noise"][outputs]}
            messages.append(learned_too_little(kernel, of_group, self.table, self.rows.outputs(outputs), has_points))
        return " ".join(dict.fromkeys(filter(None, messages)))
