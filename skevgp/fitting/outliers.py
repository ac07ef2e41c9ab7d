"""Fits with heavy-tailed noise: fits of the model, and estimates of the noise of each row, alternate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..data.rows import RawRows, Rows
from ..model.parameters import Values
from ..model.predictor import Predictor
from ..noise.base import RowScales
from .doubts import FAR, FEW, TURNS, Look, RowDoubts, look_at, of_residuals, without
from .model import ENOUGH, LEAST_TOL, Model
from .robust import Neighbours, ordinary_variance
from .runs import Fit, Start, better
from .search import search

# The first scales come from a fit of so many iterations to so many rows, or so many per inducing point.
_LOOK_ITERATIONS, _LOOK_ROWS, _LOOK_ROWS_PER_POINT = 30, 2000, 10
# Share of the iterations before scales are estimated again, and then the number of iterations between estimates.
_BEFORE, _BETWEEN = 2.0 / 3.0, 50
# Short fits are repeated until the set of outliers stays, or so many times.
_LOOKS = 5
# The fit ends when the gain between two estimates is less than so many times the tolerance of L-BFGS.
_PATIENCE = 3.0
# In the first short fit, which outliers may pull, rows count as outliers from so many standard deviations.
_FAR_FROM_MEDIAN = 3.0
# Of 15 % of outliers at random places, 3 % are next to each other. A larger share than this is no chance.
_TOGETHER = 0.2
# Where most errors are almost 0, as of classes, the scale of errors is not below this share of the noise.
_SHARE_OF_NOISE = 0.25
# Fewer rows than this do not show which share of them is far off.
_FEWEST_ROWS = 20


def fit_doubting(model: Model, run: Callable[[Model], tuple[Model, Fit]]) -> tuple[Model, Fit, RowDoubts]:
    """Fit a model with heavy-tailed noise: fits of kernel and noise without outliers, and noise scales, alternate."""
    rows, doubts = model.rows, _first_doubts(model)
    first = model.max_iter - int((1.0 - _BEFORE) * model.max_iter)
    # Without outliers, the first fit is that with Gaussian noise.
    seen = rows if doubts.rejected is None else doubts.without_outliers(doubts.weigh(rows))
    weighed, fit = run(replace(model, rows=seen, max_iter=first))
    weighed = replace(weighed, max_iter=model.max_iter)
    with model.monitor.keeping_the_best():
        while not model.monitor.stopped:
            weighed, settled, new_doubts = settle(weighed, fit, rows, doubts)
            moved, fit, doubts = new_doubts.differ_from(doubts), settled, new_doubts
            if fit.n_iter >= model.max_iter or (fit.converged and not moved):
                break
            until = min(fit.n_iter + _BETWEEN, model.max_iter)
            others = replace(weighed, rows=doubts.without_outliers(weighed.rows))
            bound = others.bound_at(fit.values)
            fit = better(replace(fit, bound=bound), others.minimise(Start(fit.values, until, fit)))
            if fit.bound - bound < _PATIENCE * _tolerance(others, fit):
                fit = replace(fit, converged=True, message="")
    # After Ctrl-C, scales are those of an earlier fit.
    weighed = replace(weighed, rows=doubts.weigh(rows))
    if len(rows) >= _FEWEST_ROWS:
        look, std = look_at(rows, predictor_at(weighed, fit.values)), np.sqrt(fit.values["noise"])
        doubts = replace(doubts, far=float(look.far_from_median(FAR, _SHARE_OF_NOISE * std).mean()))
    return weighed, replace(fit, bound=weighed.bound_at(fit.values)), doubts


def _first_doubts(model: Model) -> RowDoubts:
    """Noise scales from short fits to some rows. Their outliers begin with those of the medians of neighbours."""
    # Medians of neighbours are wrong where a function is steep, or where few rows see it. Their outliers may then be
    # next to each other, as the rows of a bump are. In this case the outliers are those of a fit to all rows.
    rows, size = model.rows, max(_LOOK_ROWS, _LOOK_ROWS_PER_POINT * model.n_inducing)
    chosen = np.arange(len(rows))
    if size < len(rows):
        chosen = np.sort(model.rng.choice(len(rows), size, replace=False))
    short = replace(model, max_iter=min(_LOOK_ITERATIONS, model.max_iter), monitor=model.monitor.silent())
    raw = rows.some(np.arange(len(rows)))
    neighbours = Neighbours.of(raw.inputs)
    robust = _robust_doubts(short, rows, chosen, _doubts_of_medians(short, raw, neighbours))
    if robust.rejected is None or neighbours.together(robust.rejected) <= _TOGETHER:
        return robust
    every = replace(short, rows=rows.subset(chosen))
    return _first_of(look_at(rows, predictor_at(every, search(every).values)), robust.scales)


def _robust_doubts(short: Model, rows: Rows, chosen: np.ndarray, doubts: RowDoubts) -> RowDoubts:
    """Noise scales that begin with those of the medians of neighbours."""
    # Many outliers on one side pull a fit towards them, so that it does not show them. Medians of neighbours are not
    # pulled. Without the outliers that they show, a fit shows others (as the C-steps of Rousseeuw & Van Driessen 1999).
    seen = doubts.without_outliers(doubts.weigh(rows))
    values: Values | None = None
    for turn in range(_LOOKS):
        model = replace(short, rows=seen.subset(chosen))
        fit = search(model) if values is None else model.minimise(Start(values, short.max_iter))
        look, values = look_at(rows, predictor_at(model, fit.values)), fit.values
        if turn == 0:
            # The pulled fit shifts the errors of all other rows.
            far = look.far_from_median(_FAR_FROM_MEDIAN)
            seen = without(doubts.weigh(rows), far & (far.mean() <= FEW))
        else:
            before, doubts = doubts, _first_of(look, doubts.scales)
            seen = doubts.without_outliers(doubts.weigh(rows))
            if doubts.rejects_as(before):
                break
    return doubts


def _doubts_of_medians(model: Model, raw: RawRows, neighbours: Neighbours) -> RowDoubts:
    """Noise scales of a model's rows from the errors of the medians of neighbours."""
    n, o = raw.targets.shape
    errors = neighbours.errors(raw.targets)
    counts = variance = np.ones(n)
    if raw.counts is not None and raw.precision is not None:
        counts, variance = raw.counts, raw.counts / raw.precision
    look = Look(errors, np.zeros_like(errors), variance, counts)
    typical = ordinary_variance(np.sqrt(look.squares))
    # Targets of which most are equal have no scale.
    typical = np.where(typical > 0.0, typical, np.inf)
    return _first_of(look, model.problem.noise.row_scales(o, np.zeros(n)), typical)


def _first_of(look: Look, scales: RowScales, typical: np.ndarray | None = None) -> RowDoubts:
    """Noise scales from errors with a typical variance (o,), or 1 for all rows if too many seem to be outliers."""
    typical = look.typical if typical is None else typical
    distances = look.distances(typical)
    far = (scales.at(distances).outlier > 0.5) | look.beyond(typical)
    if far.mean() > FEW:
        return RowDoubts(scales.at(np.zeros(len(far))))
    return RowDoubts(scales.at(distances), far if far.any() else None)


def settle(model: Model, fit: Fit, rows: Rows, doubts: RowDoubts) -> tuple[Model, Fit, RowDoubts]:
    """Alternate noise scales and q until they converge, with kernel, noise and inducing points fixed.

    ``rows`` are the unweighted rows. Returns the model with rows weighted by the new scales, the fit with its bound,
    and the scales.
    """
    noise = fit.values["noise"]
    for _ in range(TURNS):
        look = look_at(rows, predictor_at(model, fit.values), doubts.precision(model.sparse, noise))
        before, doubts = doubts, doubts.seen_in(look, noise)
        model = replace(model, rows=doubts.weigh(rows))
        if not doubts.differ_from(before):
            break
    return model, replace(fit, bound=model.bound_at(fit.values)), doubts


def _tolerance(model: Model, fit: Fit) -> float:
    """Smallest gain of an iteration, in nats."""
    return max(LEAST_TOL, ENOUGH * (fit.bound - model.bound_alone)) if model.tol is None else model.tol


def predictor_at(model: Model, values: Values) -> Predictor:
    """The predictor of residuals with q at its optimum."""
    return of_residuals(model.sparse.at_optimum(values, model.sparse.statistics(values, model.blocks)))
