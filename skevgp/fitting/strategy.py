"""Fit one sparse model: optimise, look at what came out, try again if it got stuck."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from .._linalg import NotPositiveDefiniteError
from ..inference.bounds import features_alone_bound
from ..inference.elbo import ElboObjective
from ..inference.model import SparseModel, Values
from ..inference.objectives import BoundObjective
from ..inference.posterior import Posterior
from ..inference.statistics import SufficientStatistics
from ..optimizers.adam import adam
from ..optimizers.lbfgs import Report
from ..optimizers.parameters import ParameterTable
from ..rows.internal import Rows
from ..rows.threads import BlockMap
from .advice import far_from_prior, how_it_ended, interrupted, nothing_learned
from .calibration import calibrated_noise
from .descent import interpolates, lbfgs_unless_stuck, moved_start, stuck
from .inducing import Placement

# Iterations after which inducing points are placed anew, and so many again until it shows whether that was better. By
# then lengthscales tell which columns matter; with 50 or 300 the bounds are about as good.
_STAGE = 100
# Relative size of the rounding errors in a bound on all rows.
_ROUNDING = 1e-8
# Length of the natural gradients' steps for q: the first, and the least.
_NATURAL_RATES = 0.3, 0.02


@dataclass(frozen=True)
class Options:
    """How to optimise.

    Attributes
    ----------
    solver : {"lbfgs", "adam"}
    max_iter : int
    tol : float
        In nats.
    batch_size : int
    learning_rate : float
    n_restarts : int
        Further fits from other starts.
    natural_gradient : bool
        Of Adam with the full family: q moves by natural gradients.
    noise_cv : int, optional
        Folds of consecutive rows by which the noise is calibrated.
    threads : BlockMap
    spent : int
        Iterations of ``max_iter`` that were used up before.
    """

    solver: Literal["lbfgs", "adam"]
    max_iter: int
    tol: float
    batch_size: int
    learning_rate: float
    n_restarts: int = 0
    natural_gradient: bool = False
    noise_cv: int | None = None
    threads: BlockMap = field(default_factory=BlockMap)
    spent: int = 0


@dataclass(frozen=True)
class Learned:
    """A fitted sparse model.

    Attributes
    ----------
    model : SparseModel
    values : dict
        Of ``hyperparameters``, ``signal``, ``noise`` and ``inducing_points``, in internal units.
    bound : float
        In nats, of the residuals in internal units.
    posterior : Posterior
        In internal units.
    statistics : list of SufficientStatistics
        At ``values``, one for each set of inducing points.
    loss_curve : list of float
        Minus the bound per iteration.
    message : str
        What the user should know of how the fit ended; empty if it converged.
    interrupted : bool
        Whether Ctrl-C ended it.
    """

    model: SparseModel
    values: Values
    bound: float
    posterior: Posterior
    statistics: list[SufficientStatistics]
    loss_curve: list[float]
    message: str
    interrupted: bool = False

    def updated(self, rows: Rows, weight: float = 1.0) -> Learned:
        """Fold new rows in: same kernel and inducing points, q at its optimum for all rows so far.

        ``weight`` multiplies the log likelihood of the earlier rows.
        """
        n_inducing = self.values["inducing_points"].shape[1]
        new = self.model.statistics(self.values, rows.blocks(self.model.kernel, n_inducing))
        statistics = [old.scaled(weight) + more for old, more in zip(self.statistics, new, strict=True)]
        return replace(self, statistics=statistics).at_optimum()

    def calibrated(self, table: ParameterTable, rows: Rows, n_folds: int, threads: BlockMap) -> Learned:
        """The noise that is free from cross-validation, and q at its optimum for it."""
        free = table["noise"].free
        if not free.any():
            return self
        bounds = table["noise"].value_bounds()
        noise = calibrated_noise(self.model, self.values, self.statistics, rows, bounds, n_folds, threads)
        return replace(self, values=self.values | {"noise": np.where(free, noise, self.values["noise"])}).at_optimum()

    def at_optimum(self) -> Learned:
        """With q at its optimum for values and statistics, and the bound there."""
        bound, posterior = self.model.at_optimum(self.values, self.statistics)
        return replace(self, bound=bound, posterior=posterior)


def learn(
    model: SparseModel,
    table: ParameterTable,
    rows: Rows,
    options: Options,
    placement: Placement,
    rng: np.random.RandomState,
    report: Report | None = None,
    cold: ParameterTable | None = None,
) -> Learned:
    """Maximise the bound from the table's starts, then from others; the best is kept.

    Parameters
    ----------
    model : SparseModel
    table : ParameterTable
        Of `start.starting_table`.
    rows : Rows
        In internal units.
    options : Options
    placement : Placement
        Of the inducing points of other starts.
    rng : RandomState
        Draws the mini-batches and the other starts.
    report : callable, default=None
        report(iteration, minus the bound), once per iteration.
    cold : ParameterTable, default=None
        If the table starts where another fit ended: the start without it, for when that leads nowhere.

    Returns
    -------
    learned : Learned
    """
    if cold is not None and not np.array_equal(table["inducing_points"].start, cold["inducing_points"].start):
        # Inducing points of another fit have found their places.
        best = _learn_once(model, table, rows, options, rng, report)
    else:
        best = _learn_placing(model, table, rows, options, placement, rng, report)
    if cold is not None and not best.interrupted and options.max_iter > 0:
        alone = features_alone_bound(best.statistics[0], model.prior)
        bound = np.inf if best.message else best.bound
        if stuck(best.values["noise"], bound, rows.scatter(), alone):
            best = _better(best, _learn_placing(model, cold, rows, options, placement, rng, report))
    for _ in range(options.n_restarts if options.max_iter > 0 and table.size > 0 else 0):
        if best.interrupted:
            break
        start = _other_start(model, table, rows, placement, rng)
        other = _learn_placing(model, start, rows, options, placement, rng, report)
        best = _better(best, other)
    advice = [best.message, far_from_prior(model.prior, rows)]
    if not best.interrupted and options.max_iter > 0 and table["noise"].free.any():
        advice.append(nothing_learned(best.values["noise"], rows))
    best = replace(best, message=" ".join(part for part in advice if part))
    if options.noise_cv is None or best.interrupted:
        return best
    return best.calibrated(table, rows, options.noise_cv, options.threads)


def _better(best: Learned, other: Learned) -> Learned:
    if other.bound > best.bound:
        return other
    return replace(best, interrupted=True, message=other.message) if other.interrupted else best


def _other_start(
    model: SparseModel, table: ParameterTable, rows: Rows, placement: Placement, rng: np.random.RandomState
) -> ParameterTable:
    """The same table with kernel, noise and inducing points elsewhere, within their bounds."""
    return table.started_at(_placed(moved_start(table, rng), model, rows, placement, rng))


def _placed(values: Values, model: SparseModel, rows: Rows, placement: Placement, rng: np.random.RandomState) -> Values:
    """The same values with inducing points placed under their kernel, alike for all groups.

    Where clusters coincide there are fewer: the table then keeps those that it has.
    """
    inputs = rows.sample(placement.sample_size, rng).inputs
    points = placement.points(inputs, model.kernel, np.log(values["hyperparameters"]), rng)
    return values | {"inducing_points": np.repeat(points[np.newaxis], len(model.groups), axis=0)}


def _learn_placing(
    model: SparseModel,
    table: ParameterTable,
    rows: Rows,
    options: Options,
    placement: Placement,
    rng: np.random.RandomState,
    report: Report | None = None,
) -> Learned:
    """`_learn_once`, with inducing points placed anew under the kernel that the first iterations learned.

    (Burt et al. 2020 do so until it gains nothing; once gained nearly all here.) The first places cannot know which
    columns matter, and L-BFGS moves points a little, not across the data. A stage later the better of the two, the
    fit from the new places and that which went on from the old ones, goes on. With Adam, and with about as many points
    as rows, points stay.
    """
    anew, n_inducing = placement.anew, table["inducing_points"].start.shape[1]
    if (
        anew is None
        or options.solver != "lbfgs"
        or options.max_iter <= _STAGE
        or interpolates(n_inducing, len(rows))
        or not table["hyperparameters"].free.any()
    ):
        return _learn_once(model, table, rows, options, rng, report)

    def go_on(learned: Learned, values: Values, until: int) -> Learned:
        spent = len(learned.loss_curve)
        part = replace(options, max_iter=min(until, options.max_iter), spent=spent)
        later = None if report is None else lambda iteration, loss: report(spent + iteration, loss)
        more = _learn_once(model, table.started_at(values), rows, part, rng, later)
        return replace(more, loss_curve=learned.loss_curve + more.loss_curve)

    first = _learn_once(model, table, rows, replace(options, max_iter=_STAGE), rng, report)
    if first.interrupted:
        return first
    try:
        values = _placed(first.values, model, rows, anew, rng)
    except KeyboardInterrupt:
        return replace(first, interrupted=True, message=interrupted(len(first.loss_curve)))
    best = _better(first, go_on(first, values, 2 * _STAGE))
    # Without a message it has converged.
    if first.message and not best.interrupted:
        best = _better(best, go_on(first, first.values, 2 * _STAGE))
    unfinished = best.message and not best.interrupted and len(best.loss_curve) < options.max_iter
    return go_on(best, best.values, options.max_iter) if unfinished else best


def _learn_once(
    model: SparseModel,
    table: ParameterTable,
    rows: Rows,
    options: Options,
    rng: np.random.RandomState,
    report: Report | None = None,
) -> Learned:
    """Maximise the bound from the table's starts.

    Parameters
    ----------
    model : SparseModel
    table : ParameterTable
        Of `start.starting_table`.
    rows : Rows
        In internal units.
    options : Options
    rng : RandomState
        Draws the mini-batches.
    report : callable, default=None
        report(iteration, minus the bound), once per iteration.

    Returns
    -------
    learned : Learned
    """
    n_rows = len(rows)
    per_row = None if report is None else lambda iteration, loss: report(iteration, n_rows * loss)
    if options.solver == "adam":
        return _by_adam(model, table, rows, options, rng, per_row)
    return _by_lbfgs(model, table, rows, options, per_row)


def _by_adam(
    model: SparseModel,
    table: ParameterTable,
    rows: Rows,
    options: Options,
    rng: np.random.RandomState,
    report: Report | None,
) -> Learned:
    """Adam over all parameters, or over all but q; ``report`` is per row."""
    n_rows, n_inducing = len(rows), table["inducing_points"].start.shape[1]
    blocks = rows.blocks(model.kernel, n_inducing, options.threads)
    elbo = ElboObjective(model, table, blocks, _NATURAL_RATES if options.natural_gradient else None)
    start = elbo.table.start()
    minimum = adam(
        elbo.minibatch(rows.batches(model.kernel, options.batch_size, rng)),
        start,
        elbo.table.bounds(),
        options.max_iter,
        options.learning_rate,
        options.tol / n_rows,
        report,
        elbo.pace,
    )
    # A mini-batch's loss does not tell which point is best: the bound on all rows does.
    x, (bound, posterior, statistics) = start, elbo.solution(start)
    first, reached = bound, bound if minimum.n_iter == 0 else -np.inf
    for other in (*minimum.others, minimum.x) if minimum.n_iter > 0 else ():
        try:
            solution = elbo.solution(other)
        except NotPositiveDefiniteError:
            continue
        reached = max(reached, solution[0])
        if solution[0] >= bound:
            x, (bound, posterior, statistics) = other, solution
    message = how_it_ended(minimum, options.max_iter, options.spent, options.tol)
    fell = not reached >= first - max(options.tol, _ROUNDING * abs(first))
    if fell and minimum.converged:
        message = (
            f"Adam ended with a bound below the first after all its {minimum.n_iter} steps; the best parameters are "
            "kept. Raise max_iter (steps become small only towards the end) or batch_size, or lower learning_rate (now "
            f"{options.learning_rate})."
        )
    elif not minimum.interrupted and not minimum.converged:
        message = (
            f"Adam diverged after {minimum.n_iter} steps; the best parameters so far are kept. Lower learning_rate "
            f"(now {options.learning_rate}), or raise batch_size (now {options.batch_size})."
        )
    values = {parameter.name: elbo.table.values(x)[parameter.name] for parameter in table.parameters}
    curve = [n_rows * loss for loss in minimum.loss_curve]
    return Learned(model, values, bound, posterior, statistics, curve, message, minimum.interrupted)


def _by_lbfgs(
    model: SparseModel,
    table: ParameterTable,
    rows: Rows,
    options: Options,
    report: Report | None,
) -> Learned:
    """L-BFGS over all parameters but q, which stays at its optimum; ``report`` is per row."""
    n_rows, n_inducing = len(rows), table["inducing_points"].start.shape[1]
    objective = BoundObjective(model, table, rows.blocks(model.kernel, n_inducing, options.threads))
    minimum = lbfgs_unless_stuck(
        objective,
        table,
        rows.scatter(),
        options.max_iter - options.spent,
        options.tol / n_rows,
        alone=features_alone_bound(objective.blocks.linear, model.prior) / n_rows,
        one_start=options.spent > 0,
        may_interpolate=interpolates(n_inducing, n_rows),
        report=report,
    )
    values = table.values(minimum.x)
    statistics = model.statistics(values, objective.blocks)
    bound, posterior = model.at_optimum(values, statistics)
    bound = -minimum.loss * n_rows if np.isfinite(minimum.loss) else bound
    curve = [n_rows * loss for loss in minimum.loss_curve]
    message = how_it_ended(minimum, options.max_iter, options.spent, options.tol)
    return Learned(model, values, bound, posterior, statistics, curve, message, minimum.interrupted)
