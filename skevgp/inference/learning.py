"""Fit one sparse model: optimise, look at what came out, try again if it got stuck."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from .adam import adam
from .bounds import features_alone_bound
from .elbo import ElboObjective
from .inducing import Placement
from .linalg import NotPositiveDefiniteError
from .model import SparseModel, Values
from .objectives import BoundObjective
from .optimize import Minimum, Report, lbfgs
from .parameters import ParameterTable
from .posterior import Posterior
from .rows import Rows
from .start import alike_neighbours
from .statistics import SufficientStatistics
from .threads import BlockMap

# An output counts as not learned when this share of what the features alone leave over ends as noise.
_COLLAPSED = 0.9
# When no start got below this share, the user should know.
_NOTHING_LEARNED = 0.99
# y is far from its prior mean: by so many times its scatter, or by a weight so many prior standard deviations out.
_FAR, _FAR_WEIGHT = 1e4, 100.0
# Where a collapsed fit starts again: factors on the first lengthscales and the first noise variance.
_OTHER_STARTS = ((0.5, 1.0), (2.0, 100.0), (1.0, 1e3))
# With about as many inducing points as rows, a low first noise may lead to a plateau on which the kernel explains every
# row by itself: such fits, which cost little, start from a noise so many times higher too.
_INTERPOLATES, _MUCH_NOISE = 1.5, 1e3
# Relative size of the rounding errors in a bound on all rows.
_ROUNDING = 1e-8
# Length of the natural gradients' steps for q: the first, and the least.
_NATURAL_RATES = 0.3, 0.02
# A restart multiplies the first values by a number between 1 / factor and the factor, drawn log-uniformly.
_RESTART_FACTORS = {"hyperparameters": 3.0, "noise": 30.0}


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
    threads : BlockMap
    """

    solver: Literal["lbfgs", "adam"]
    max_iter: int
    tol: float
    batch_size: int
    learning_rate: float
    n_restarts: int = 0
    natural_gradient: bool = False
    threads: BlockMap = field(default_factory=BlockMap)


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
        bound, posterior = self.model.at_optimum(self.values, statistics)
        return replace(self, bound=bound, posterior=posterior, statistics=statistics)


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
    best = _learn_once(model, table, rows, options, rng, report)
    if cold is not None and not best.interrupted and options.max_iter > 0:
        alone = features_alone_bound(best.statistics[0], model.prior)
        bound = np.inf if best.message else best.bound
        if _stuck(best.values["noise"], bound, rows.scatter(), alone):
            best = _better(best, _learn_once(model, cold, rows, options, rng, report))
    for _ in range(options.n_restarts if options.max_iter > 0 and table.size > 0 else 0):
        if best.interrupted:
            break
        other = _learn_once(model, _other_start(model, table, rows, placement, rng), rows, options, rng, report)
        best = _better(best, other)
    advice = [best.message, _far_from_prior(model, rows), _nothing_learned(best, table, rows, options)]
    return replace(best, message=" ".join(part for part in advice if part))


def _better(best: Learned, other: Learned) -> Learned:
    if other.bound > best.bound:
        return other
    return replace(best, interrupted=True, message=other.message) if other.interrupted else best


def _far_from_prior(model: SparseModel, rows: Rows) -> str:
    if (rows.scatter() < _FAR**-2).any():
        return (
            f"y is more than {_FAR:g} times its scatter away from its prior mean of 0: explaining that leaves the "
            "kernel little accuracy for the rest. Set normalize_y=True, or give the feature_map an intercept."
        )
    if (np.abs(model.prior.reference) > _FAR_WEIGHT).any():
        return (
            f"Weights of features are more than {_FAR_WEIGHT:g} prior standard deviations away from their prior mean: "
            "raise coef_scale or, if it is an intercept's, set normalize_y=True."
        )
    return ""


def _nothing_learned(learned: Learned, table: ParameterTable, rows: Rows, options: Options) -> str:
    if learned.interrupted or options.max_iter == 0 or not table["noise"].free.any():
        return ""
    nothing = learned.values["noise"] > _NOTHING_LEARNED * rows.scatter()
    if nothing.any():
        # Where residuals look like noise, noise is the answer.
        nothing &= alike_neighbours(rows)
    if not nothing.any():
        return ""
    return (
        f"The noise explains everything that the features leave over of {nothing.sum()} of {len(nothing)} outputs "
        "fitted together, though neighbouring rows are alike: from no start did the Gaussian process learn any of it. "
        "Raise n_inducing or n_restarts, let kernel or noise_variance start elsewhere, or look at the scales of the "
        "kernel's columns."
    )


def _other_start(
    model: SparseModel, table: ParameterTable, rows: Rows, placement: Placement, rng: np.random.RandomState
) -> ParameterTable:
    """The same table with kernel, noise and inducing points elsewhere, within their bounds."""
    coordinates = table.coordinates(table.start())
    for name, factor in _RESTART_FACTORS.items():
        spread = np.log(factor)
        coordinates[name] = coordinates[name] + rng.uniform(-spread, spread, coordinates[name].shape)
    moved = table.values(np.clip(table.flat(coordinates), *table.bounds()))
    hyperparameters = np.log(moved["hyperparameters"])
    moved["inducing_points"] = np.array(
        [
            placement.points(rows.sample(placement.sample_size, rng).inputs, model.kernel, hyperparameters, rng)
            for _ in model.groups
        ]
    )
    # Where clusters coincide there are fewer: such a start keeps the first points.
    return table.started_at(moved)


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
    message = _message(minimum, options)
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
    minimum = _lbfgs_unless_stuck(model, objective, table, rows.scatter(), options, report)
    values = table.values(minimum.x)
    statistics = model.statistics(values, objective.blocks)
    bound, posterior = model.at_optimum(values, statistics)
    bound = -minimum.loss * n_rows if np.isfinite(minimum.loss) else bound
    curve = [n_rows * loss for loss in minimum.loss_curve]
    return Learned(model, values, bound, posterior, statistics, curve, _message(minimum, options), minimum.interrupted)


def _lbfgs_unless_stuck(
    model: SparseModel,
    objective: BoundObjective,
    table: ParameterTable,
    scatter: np.ndarray,
    options: Options,
    report: Report | None,
) -> Minimum:
    """L-BFGS from the table's start; from other starts too where that may have ended in a bad optimum."""
    linear = objective.blocks.linear
    alone = features_alone_bound(linear, model.prior)
    best: Minimum | None = None

    def descend(length_factor: float, noise_factor: float) -> Minimum:
        start = table.coordinates(table.start())
        start["hyperparameters"] = start["hyperparameters"] + np.log(length_factor)
        start["noise"] = start["noise"] + np.log(noise_factor)
        first = np.clip(table.flat(start), *table.bounds())
        minimum = lbfgs(objective, first, table.bounds(), options.max_iter, options.tol / linear.n_rows, report)
        return minimum if best is None or minimum.loss < best.loss else replace(best, interrupted=minimum.interrupted)

    best = descend(1.0, 1.0)
    if options.max_iter == 0 or not table["noise"].free.any():
        return best
    if _INTERPOLATES * table["inducing_points"].start.shape[1] >= linear.n_rows and not best.interrupted:
        best = descend(1.0, _MUCH_NOISE)
    for factors in _OTHER_STARTS:
        # A fit that has not ended yet may still be below.
        bound = -best.loss * linear.n_rows if best.converged else np.inf
        if best.interrupted or not _stuck(table.values(best.x)["noise"], bound, scatter, alone):
            break
        best = descend(*factors)
    return best


def _stuck(noise: np.ndarray, bound: float, scatter: np.ndarray, alone: float) -> bool:
    """Whether noise came to explain everything, or the kernel explains less than nothing would."""
    return bool((noise > _COLLAPSED * scatter).any()) or bound < alone


def _message(minimum: Minimum, options: Options) -> str:
    if minimum.interrupted:
        return f"The fit was interrupted after {minimum.n_iter} iterations; the best parameters so far are kept."
    if minimum.converged:
        return ""
    if minimum.n_iter < options.max_iter:
        return (
            f"L-BFGS stopped after {minimum.n_iter} iterations: rounding errors keep hiding the way up, as in data "
            "without noise. The best parameters are kept; a larger tol, fewer inducing points or a WhiteKernel with a "
            "lower bound on the noise end sooner."
        )
    return (
        f"The bound was still rising after max_iter={options.max_iter} iterations. Raise max_iter, or stop earlier on "
        f"purpose with a larger tol (now {options.tol})."
    )
