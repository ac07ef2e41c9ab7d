"""`fit_model`: place inducing points, maximise the bound of each model, and return the result as `Fitted`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..data.threads import BlockMap, side_by_side
from ..model.parameters import log_prior
from ..utils.monitor import Monitor
from .calibration import calibrated
from .doubts import RowDoubts
from .fitted import Fitted, FittedModel
from .grown import grown
from .messages import far_from_prior, interrupted, many_outliers, signal_gone
from .model import Model, models_of, parts_of
from .outliers import fit_doubting
from .problem import Problem
from .search import Fit, search
from .sharing import with_groups
from .start import with_signal_of_constants

# For a higher ratio of signal to noise variance, the exact predictor is used for duplicate rows too.
_HIGH_RATIO = 1e9


def fit_model(problem: Problem, rng: np.random.RandomState, monitor: Monitor, previous: Fitted | None = None) -> Fitted:
    """Place inducing points and maximise the bound of each model of a problem.

    ``rng`` places inducing points, and draws mini-batches and restarts. ``monitor`` receives the loss of each iteration
    in the user's units. The fit starts from the parameters of ``previous``, as far as shapes agree.
    """
    problem = with_groups(problem, rng, monitor, previous)
    parts = parts_of(problem)
    # One model has all threads for its blocks of rows; several have one each.
    at_once = min(problem.n_threads, len(parts))
    threads = BlockMap(problem.n_threads if len(parts) == 1 else 1)
    try:
        models = models_of(problem, rng, monitor, threads, previous)
        # Each model has a share of the time that is left when it starts.
        turns = [(model, 1.0 / -(-(len(models) - i) // at_once)) for i, model in enumerate(models)]
        fitted = side_by_side(_fit_one, turns, at_once, monitor)
    finally:
        threads.close()
    messages = sorted({one.message for one in fitted if one.message})
    if monitor.stopped or monitor.out_of_time:
        n_iter, max_time = max(len(one.loss_curve) for one in fitted), None if monitor.stopped else monitor.max_time
        messages = [interrupted(n_iter, max_time)]
    return Fitted(problem.units, [part.outputs for part in parts], problem.found, tuple(fitted), tuple(messages))


def _fit_one(turn: tuple[Model, float]) -> FittedModel:
    """Fit one model, given the share of the remaining time that it has."""
    model, share = turn
    # The copy owns the blocks of rows, so that they are freed after the fit.
    model = replace(model, monitor=model.monitor.with_time(share))
    if not model.problem.noise.heavy_tails:
        return finished(*_best(model))
    model, fit, doubts = fit_doubting(model, _best)
    return finished(model, fit, doubts)


def _best(model: Model) -> tuple[Model, Fit]:
    """The best fit and its model. The model is another one if the number of inducing points was to be found."""
    return (model, search(model)) if model.problem.placement.max_inducing is None else grown(model)


def finished(model: Model, fit: Fit, doubts: RowDoubts | None = None) -> FittedModel:
    """Calibrate signal and noise, compute the bounds and make the predictor of a fit."""
    sparse, values, exact, by = model.sparse, fit.values, model.exact, model.problem.noise_cv
    messages = [fit.message, far_from_prior(sparse.prior.at(values), model.rows, model.problem.weight_names)]
    found, dependent = None, False
    values, changed = with_signal_of_constants(model.problem, model.rows, model.table, values)
    statistics = sparse.statistics(values, model.blocks)
    if not model.monitor.stopped and model.max_iter > 0:
        messages.append(model.learned_too_little(values))
        if by is not None:
            # Folds use the algebra of the sparse model, with its lowest noise.
            lowest = model.rules.lowest_noise * model.scatter
            noisy = values if exact is None else values | {"noise": np.maximum(values["noise"], lowest)}
            with model.monitor.keeping_the_best():
                rows, sums = model.rows, statistics
                if doubts is not None and doubts.rejected is not None:
                    rows = doubts.without_outliers(rows)
                    sums = sparse.statistics(values, sparse.blocks(rows, model.n_inducing))
                found = calibrated(sparse, noisy, sums, model.table, rows, by, model.seed)
            dependent = found is not None and found.dependent
            if exact is not None and by.groups is None:
                # Folds correct the error of the inducing points. The exact model has none.
                found = None
    if found is not None:
        values = values | {"signal": found.signal, "noise": found.noise}
        messages.append(signal_gone(found.gone, len(found.noise)))
    if doubts is not None:
        messages.append(many_outliers(doubts.far))
    if sparse.tight and (found is not None or changed):
        # The charge of the tight bound is that of one signal and noise.
        statistics = sparse.statistics(values, model.blocks)
    # If the bound is not known, errors are summed row by row, which keeps digits where the noise is low.
    known = found is None and not changed and np.isfinite(fit.bound) and fit.n_rows is None
    if exact is None:
        bound = fit.bound - log_prior(values) if known else sparse.bound(values, statistics, model.blocks)
        upper_bound = sparse.upper_bound(values, statistics, model.blocks)
    else:
        bound = upper_bound = fit.bound - log_prior(values) if known else float(exact.log_likelihoods(values).sum())
    # In the sparse predictor, the jitter of k(X_m, X_m) would show in the std.
    distinct = values["inducing_points"].shape[1] == len(model.rows)
    is_exact = exact is not None and (distinct or bool((values["signal"] > _HIGH_RATIO * values["noise"]).any()))
    # An f that is orthogonal to the features is not that of the fit's own predictors.
    is_exact = is_exact and not sparse.orthogonal
    if exact is not None and is_exact:
        predictor = exact.predictor(values)
    elif found is None and not changed and fit.predictor is not None and not sparse.orthogonal:
        predictor = fit.predictor
    else:
        predictor = sparse.at_optimum(values, statistics, blocks=model.blocks)
    message = " ".join(part for part in messages if part)
    fitted = FittedModel(
        sparse=sparse,
        table=model.table,
        values=values,
        statistics=statistics,
        predictor=predictor,
        loss_curve=fit.loss_curve,
        message=message,
        dependent=dependent,
        gone=0 if found is None else found.gone,
        doubts=doubts,
        known_bound=bound,
        known_upper_bound=upper_bound,
        is_exact=is_exact,
    )
    return fitted.told()
