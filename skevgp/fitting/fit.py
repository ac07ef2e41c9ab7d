"""`fit_model`: place inducing points, maximise the bound of each model, and return the result as `Fitted`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..data.threads import BlockMap, side_by_side
from ..model.mixture import MixturePosterior
from ..model.parameters import Values, log_prior
from ..model.posterior import FittedPosterior, LocalPosterior, SparsePosterior
from ..model.statistics import SufficientStatistics
from ..utils.monitor import Monitor
from .calibration import Calibration, calibrate
from .doubts import RowDoubts
from .fitted import Fitted, FittedModel
from .folds import CrossValidation
from .grown import grown
from .local import calibrated_locally, local_model, with_local_part
from .messages import interrupted, many_outliers, signal_gone
from .model import Model
from .outliers import fit_doubting
from .parts import models_of, parts_of
from .problem import Problem
from .runs import Fit
from .search import search
from .sharing import with_groups
from .start import with_signal_of_constants


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
        # Each model has a share of the time that is left when it starts: one of the rounds that are left.
        rounds = [-(-n_left // at_once) for n_left in range(len(models), 0, -1)]
        fitted = side_by_side(_fit_one, [*zip(models, rounds, strict=True)], at_once, monitor)
    finally:
        threads.close()
    messages = sorted({model.message for model in fitted if model.message})
    if monitor.stopped or monitor.out_of_time:
        n_iter, max_time = max(len(model.loss_curve) for model in fitted), None if monitor.stopped else monitor.max_time
        messages = [interrupted(n_iter, max_time)]
    return Fitted(problem.units, problem.sharing_found, tuple(fitted), tuple(messages))


def _fit_one(turn: tuple[Model, int]) -> FittedModel:
    """Fit one model, given the number of rounds that share the remaining time."""
    model, rounds = turn
    # The copy owns the blocks of rows, so that they are freed after the fit.
    model = replace(model, monitor=model.monitor.with_time(1.0 / rounds))
    if model.problem.variant.n_neighbors:
        return _with_local_part(model)
    if not model.problem.noise.heavy_tails:
        return finished(*_best(model))
    model, fit, doubts = fit_doubting(model, _best)
    return finished(model, fit, doubts)


def _best(model: Model) -> tuple[Model, Fit]:
    """The best fit and its model. The model is another one if the number of inducing points was to be found."""
    return (model, search(model)) if model.problem.placement.max_inducing is None else grown(model)


def _with_local_part(model: Model) -> FittedModel:
    """Fit the sparse model, then signal, noise and kernel with the local part."""
    model, fit, values = with_local_part(model, _best)
    if model.exact is not None:
        return finished(model, fit)
    messages, folds, dependent = [fit.message, model.far_from_prior(fit.values)], model.problem.noise_cv, False
    if folds is not None and model.max_iter > 0 and not model.monitor.stopped:
        with model.monitor.keeping_the_best():
            statistics = model.sparse.statistics(fit.values, model.blocks)
            of_sparse = _calibration(model, fit.values, statistics, folds, None)
            dependent = of_sparse is not None and of_sparse.dependent
            values = calibrated_locally(model, values, folds)
    values, _ = with_signal_of_constants(model.problem, model.rows, model.table, values)
    posterior = LocalPosterior.of(model.sparse, values, local_model(model))
    message = " ".join(part for part in messages if part)
    return FittedModel(model.outputs, posterior, model.table, fit.loss_curve, message, dependent, few=_few(model))


def finished(model: Model, fit: Fit, doubts: RowDoubts | None = None) -> FittedModel:
    """Calibrate signal and noise of a fit, and compute its posterior."""
    values, changed = with_signal_of_constants(model.problem, model.rows, model.table, fit.values)
    messages, calibration, statistics = [fit.message, model.far_from_prior(fit.values)], None, None
    if model.max_iter > 0 and not model.monitor.stopped:
        messages.append(model.learned_too_little(values))
        if model.problem.noise_cv is not None and (model.hyper_prior is None or model.problem.groups is not None):
            statistics = model.sparse.statistics(values, model.blocks)
            with model.monitor.keeping_the_best():
                calibration = _calibration(model, values, statistics, model.problem.noise_cv, doubts)
    dependent, gone = calibration is not None and calibration.dependent, 0
    # Folds without groups correct the error of the inducing points. The exact model has none.
    if calibration is not None and (model.exact is None or model.problem.groups is not None):
        values, changed = values | {"signal": calibration.signal, "noise": calibration.noise}, True
        gone = calibration.gone
        messages.append(signal_gone(gone, len(values["noise"])))
    if doubts is not None:
        messages.append(many_outliers(doubts.far))
    if changed and model.sparse.variant.tight:
        # The charge of the tight bound is that of one signal and noise.
        statistics = None
    posterior = model.posterior(values, statistics)
    if fit.predictor is not None and not changed and isinstance(posterior, SparsePosterior):
        posterior = posterior.with_q(fit.predictor, fit.bound - log_prior(values))
    posterior = _averaged(model, fit, posterior)
    message = " ".join(part for part in messages if part)
    few = _few(model)
    return FittedModel(model.outputs, posterior, model.table, fit.loss_curve, message, dependent, gone, doubts, few)


def _few(model: Model) -> tuple[int, int] | None:
    """The numbers of rows and of learned numbers of kernel and noise, if the rows are few for these."""
    return (len(model.rows), model.n_learned) if model.has_few_rows else None


def _averaged(model: Model, fit: Fit, posterior: FittedPosterior) -> FittedPosterior:
    """The posterior averaged over draws of kernel and noise, if rows are few.

    The draws' signal and noise are calibrated by the same factors as those of the mode.
    """
    if model.hyper_prior is None or not model.problem.averages or model.monitor.stopped:
        return posterior
    factors = {name: posterior.values[name] / fit.values[name] for name in ("signal", "noise")}
    draws = [draw | {name: draw[name] * by for name, by in factors.items()} for draw in model.draws(fit)]
    return MixturePosterior(posterior, tuple(map(model.posterior, draws))) if draws else posterior


def _calibration(
    model: Model,
    values: Values,
    statistics: list[SufficientStatistics],
    folds: CrossValidation,
    doubts: RowDoubts | None,
) -> Calibration | None:
    """Signal and noise that predict held-out rows best. Outliers do not count."""
    rows = model.rows
    if model.exact is not None:
        # Folds use the algebra of the sparse model, with its lowest noise.
        values = values | {"noise": np.maximum(values["noise"], model.rules.lowest_noise * model.scatter)}
    if doubts is not None and doubts.rejected is not None:
        rows = doubts.without_outliers(rows)
        statistics = model.sparse.statistics(values, model.sparse.blocks(rows, model.n_inducing))
    return calibrate(model.sparse, values, statistics, model.table, rows, folds, model.seed)
