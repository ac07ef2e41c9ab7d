"""Fit the models of a problem, and keep what came of it. `fit_model` is the whole of it, from top to bottom."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..data.rows import Rows, Source
from ..data.threads import BlockMap, side_by_side
from ..model.model import SparseModel
from ..model.parameters import ParameterTable, Values
from ..model.predictor import Predictor
from ..model.statistics import Kernel, SufficientStatistics
from ..utils.monitor import Monitor
from .calibration import calibrated
from .exact import exact_model_of_sample
from .messages import far_from_prior, interrupted, signal_gone
from .model import Model, models_of, parts_of
from .outliers import RowDoubts, fit_doubting
from .problem import Problem
from .search import Fit, Rules, Start, better, search
from .sharing import with_groups
from .start import with_signal_of_constants
from .units import Units

# Inducing points become more until that raises the bound by less than so many nats per row and output.
_GAIN = 0.01
# Points limit the kernel if it makes the rows of a sample less likely than their own kernel does, by so many nats per
# row and output.
_MISSED = 0.02
# On the way, no more iterations than this, and none that gain less than this, in nats per row and output.
_ITERATIONS, _COARSE = 60, 2e-4


def fit_model(problem: Problem, rng: np.random.RandomState, monitor: Monitor, previous: Fitted | None = None) -> Fitted:
    """Place inducing points and maximise the bound of each model.

    ``rng`` places inducing points, draws mini-batches and restarts. The monitor is told of each iteration's loss, in
    the user's units. The fit starts where ``previous`` ended, as far as shapes agree.
    """
    problem = with_groups(problem, rng, monitor, previous)
    parts = parts_of(problem)
    # One model has all threads for its blocks of rows; several have one each.
    at_once = min(problem.n_threads, len(parts))
    threads = BlockMap(problem.n_threads if len(parts) == 1 else 1)
    try:
        models = models_of(problem, rng, monitor, threads, previous)
        # Of the time that is left each has a share when its turn comes.
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
    model, share = turn
    # A copy, with which the blocks of rows are forgotten.
    model = replace(model, monitor=model.monitor.with_time(share))
    if not model.problem.noise.heavy_tails:
        return finished(*_best(model))
    model, fit, doubts = fit_doubting(model, _best)
    return finished(model, fit, doubts)


def _best(model: Model) -> tuple[Model, Fit]:
    """The best fit, and the model that it is of, whose number of inducing points may have been found."""
    return (model, search(model)) if model.problem.placement.max_inducing is None else grown(model)


def grown(model: Model) -> tuple[Model, Fit]:
    """A fit whose number of inducing points has been found, and the model that it is of.

    Half as many points again are added, the rows that are least known from those before, and the fit goes on for a few
    iterations; until that raises the bound by less than `_GAIN`. The fit before then goes on to its end. Only there
    `max_iter` counts: after too few iterations on the way, points would be credited with what further ones gain.

    With few points the noise may explain so much that half as many again show nothing of what there is to learn. Hence
    a second opinion, the kernel of the exact model of a sample: while it makes the sample likelier than the fit's by
    `_MISSED`, growth does not end, and it is tried at each step.
    """
    nats = model.rows.total * len(model.scatter)
    iterations, tol = _ITERATIONS if model.max_iter > 0 else 0, model.tol or 0.0
    coarse = replace(model, max_iter=iterations, tol=max(tol, _COARSE * nats))
    fit = search(coarse)
    with model.monitor.keeping_the_best():
        unhindered = None if model.monitor.stopped else exact_model_of_sample(model, _ITERATIONS, _COARSE)
        while not model.monitor.stopped and (more := coarse.with_more(fit.values)) is not None:
            starts, limited = [fit.values | {"inducing_points": more.table["inducing_points"].start}], False
            if unhindered is not None and unhindered.missed_by(fit.values) > _MISSED:
                starts, limited = [*starts, more.placed_under(unhindered.fit.values)], True
            # Where they start: nothing is optimised.
            start = max((more.minimise(Start(values, 0)) for values in starts), key=lambda tried: tried.bound)
            larger = more.minimise(Start(start.values, coarse.max_iter))
            if larger.bound - fit.bound < _GAIN * nats and not limited:
                break
            coarse, fit = more, larger
    model = replace(coarse, max_iter=model.max_iter, tol=model.tol)
    if model.max_iter > 0 and not model.monitor.stopped:
        fit = better(fit, model.minimise(Start(fit.values, model.max_iter)))
    return model, fit


def finished(model: Model, fit: Fit, doubts: RowDoubts | None = None) -> FittedModel:
    """What is kept of a fit; signal and noise are calibrated if the problem says so and Ctrl-C did not."""
    sparse, values, exact, by = model.sparse, fit.values, model.exact, model.problem.noise_cv
    messages, found, dependent = [fit.message, far_from_prior(sparse.prior, model.rows)], None, False
    values, changed = with_signal_of_constants(model.problem, model.rows, model.table, values)
    statistics = sparse.statistics(values, model.blocks)
    if not model.monitor.stopped and model.max_iter > 0:
        messages.append(model.learned_too_little(values))
        if by is not None:
            # The algebra of folds is the sparse model's.
            lowest = model.rules.lowest_noise * model.scatter
            noisy = values if exact is None else values | {"noise": np.maximum(values["noise"], lowest)}
            with model.monitor.keeping_the_best():
                found = calibrated(sparse, noisy, statistics, model.table, model.rows, by, model.seed)
            dependent = found is not None and found.dependent
            if exact is not None and by.groups is None:
                # What folds correct, that inducing points represent too little, is no matter here.
                found = None
    if found is not None:
        values = values | {"signal": found.signal, "noise": found.noise}
        messages.append(signal_gone(found.gone, len(found.noise)))
    # Else summed row by row, which keeps its digits where the noise is low.
    known = found is None and not changed and np.isfinite(fit.bound) and fit.n_rows is None
    if exact is None:
        bound = fit.bound if known else sparse.bound(values, statistics, model.blocks)
        upper_bound = sparse.upper_bound(values, statistics, model.blocks)
    else:
        bound = upper_bound = fit.bound if known else float(exact.log_likelihoods(values).sum())
    if exact is not None:
        # The jitter of k(X_m, X_m) would show in its std.
        predictor = exact.predictor(values)
    elif found is None and not changed and fit.predictor is not None:
        predictor = fit.predictor
    else:
        predictor = sparse.at_optimum(values, statistics, blocks=model.blocks)
    message = " ".join(part for part in messages if part)
    one = FittedModel(sparse, model.table, values, statistics, predictor, fit.loss_curve, message, dependent, doubts)
    one = replace(one, known_bound=bound, known_upper_bound=upper_bound, is_exact=exact is not None)
    return one if doubts is None else doubts.told(one)


@dataclass(frozen=True)
class FittedModel:
    """A fitted sparse model of some outputs, in internal units.

    ``table`` has its limits, and where it started. ``statistics``, one for each set of inducing points, are those at
    ``values``. ``dependent`` says that rows near each other were found to be alike. ``doubts`` are those of the rows,
    if the noise has heavy tails. The bounds are known where they are better than from the statistics. The predictor is
    that of the exact model if it ``is_exact``.
    """

    sparse: SparseModel
    table: ParameterTable
    values: Values
    statistics: list[SufficientStatistics]
    predictor: Predictor
    loss_curve: list[float]
    message: str
    dependent: bool = False
    doubts: RowDoubts | None = None
    known_bound: float | None = None
    known_upper_bound: float | None = None
    is_exact: bool = False

    @cached_property
    def bound(self) -> float:
        """On the log marginal likelihood, in nats, of the residuals in internal units."""
        return self.sparse.bound(self.values, self.statistics) if self.known_bound is None else self.known_bound

    @cached_property
    def upper_bound(self) -> float:
        """What it cannot exceed."""
        if self.known_upper_bound is not None:
            return self.known_upper_bound
        return self.sparse.upper_bound(self.values, self.statistics)

    def updated(self, rows: Rows, weight: float = 1.0) -> FittedModel:
        """Fold new rows in: same kernel and inducing points, q at its optimum for all rows so far.

        ``weight`` multiplies the log likelihood of the earlier rows.
        """
        if self.doubts is not None:
            return self.doubts.updated(self, rows)
        # Whatever its points were of the rows before.
        sparse, values = replace(self.sparse, complete=False), self.values
        if self.is_exact:
            # From here on the points are some rows of many, with the sparse model's algebra and its lowest noise.
            lowest = np.where(self.table["noise"].free, Rules.lowest_noise, 0.0)
            values = values | {"noise": np.maximum(values["noise"], lowest)}
            whitenings = list(sparse.whitenings(values))
        else:
            whitenings = [group.whitening for group in self.predictor.groups]
        new = sparse.statistics(values, sparse.blocks(rows, values["inducing_points"].shape[1]), whitenings)
        statistics = [old.scaled(weight) + more for old, more in zip(self.statistics, new, strict=True)]
        predictor = sparse.at_optimum(values, statistics, whitenings)
        return replace(
            self,
            sparse=sparse,
            values=values,
            statistics=statistics,
            predictor=predictor,
            known_bound=None,
            known_upper_bound=None,
            is_exact=False,
        )


@dataclass(frozen=True)
class Fitted:
    """The fitted models of all outputs, and the outputs of each; ``found`` says that these were not given."""

    units: Units
    outputs: list[list[int]]
    found: bool
    models: tuple[FittedModel, ...]
    messages: tuple[str, ...]

    def predictor(self) -> Predictor:
        """Of all outputs, in the user's units."""
        return self.units.predictor([one.predictor for one in self.models], self.outputs)

    def updated(self, source: Source, weight: float = 1.0, row_variance: np.ndarray | None = None) -> Fitted:
        """Fold new rows into the predictors; ``weight`` multiplies what is known of the others."""
        rows = self.units.rows(source)
        pairs = zip(self.outputs, self.models, strict=True)
        models = (one.updated(rows.outputs(own).noisier(row_variance), weight) for own, one in pairs)
        return replace(self, models=tuple(models))

    @property
    def row_scales(self) -> np.ndarray | None:
        """E[τ] of each row and model, (n, n_models); None if the noise is Gaussian."""
        each = [one.doubts.scales.mean for one in self.models if one.doubts is not None]
        return np.column_stack(each) if each else None

    @property
    def dependent(self) -> bool:
        """Whether rows near each other were found to be alike."""
        return any(one.dependent for one in self.models)

    @property
    def lower_bound(self) -> float:
        """In nats, summed over outputs."""
        return sum(one.bound for one in self.models) - self._shift

    @property
    def upper_bound(self) -> float:
        """On the log marginal likelihood, in nats, summed over outputs."""
        return sum(one.upper_bound for one in self.models) - self._shift

    @property
    def n_iter(self) -> int:
        """Iterations of the longest fit."""
        return max(len(one.loss_curve) for one in self.models)

    @property
    def loss_curve(self) -> np.ndarray:
        """Minus the bound per iteration, (n_iter,); a model that is done keeps its last value."""
        if self.n_iter == 0:
            return np.empty(0)
        # One that had nothing to learn made no iterations.
        curves = [one.loss_curve or [-one.bound] for one in self.models]
        return np.sum([np.pad(curve, (0, self.n_iter - len(curve)), "edge") for curve in curves], axis=0) + self._shift

    @property
    def _shift(self) -> float:
        # From internal units to the user's, for a loss of all rows.
        return self.models[0].statistics[0].n_rows * self.units.log_unit(slice(None))

    @property
    def n_parameters(self) -> int:
        """Free parameters of kernels, noise, inducing points and q."""
        total = 0
        for one in self.models:
            n_outputs, p = one.sparse.prior.scale.shape
            m, of_weights = one.values["inducing_points"].shape[1], p + p * (p + 1) // 2
            of_values = m + m * (m + 1) // 2 + m * p
            if one.sparse.family == "diagonal":
                of_values, of_weights = 2 * m, 2 * p
            total += one.table.size + n_outputs * of_values
            total += of_weights * (1 if one.sparse.prior.shared else n_outputs)
        return total

    @property
    def sharing(self) -> list[list[int]]:
        """Outputs by what they are fitted with: of a model, or of a group that is joined to others by weights alone."""
        found = []
        for outputs, one in zip(self.outputs, self.models, strict=True):
            separate = one.values["hyperparameters"].ndim == 2
            found += [outputs[group] for group in one.sparse.groups] if separate else [outputs]
        return sorted(found)

    def limits(self, name: str, output: int) -> np.ndarray:
        """Limits (n, 2) of an output's ``hyperparameters`` or ``signal``, in the user's units."""
        one, within = next(
            (one, own.index(output)) for own, one in zip(self.outputs, self.models, strict=True) if output in own
        )
        limits = one.table[name].value_limits()
        if name == "signal":
            # Calibrated, it may have left them.
            (low, high), signal = limits[within], one.values["signal"][within]
            return np.array([[min(low, signal), max(high, signal)]]) * self.units.target_unit[output] ** 2
        if one.table[name].start.ndim == 1:
            return limits
        return limits.reshape(*one.table[name].start.shape, 2)[one.sparse.set_of(within, one.table[name])]

    def values_in(self, units: Units, rows: Rows, kernel: Kernel, model: int) -> Values:
        """A model's values in other internal units, as far as they can serve another fit."""
        one, own, inputs = self.models[model], self.outputs[model], rows.inputs
        values, points = one.values, one.values["inducing_points"]
        if inputs.mean.ndim == 2 and one.sparse.kernels is None:
            inputs = inputs.at(own)
        if points.shape[2] != inputs.mean.shape[-1] or (inputs.mean.ndim == 2 and len(points) != len(inputs.mean)):
            return {}
        lowest, highest = (edge.reshape(-1, 1, points.shape[2]) for edge in (inputs.lowest, inputs.highest))
        outside = (points < 2.0 * lowest - highest) | (points > 2.0 * highest - lowest)
        # A few may have gone far where functions are smooth; of most it means that the rows are others.
        if outside.any(axis=-1).mean() > 0.5:
            return {}
        ratio = (self.units.target_unit[own] / units.target_unit[own]) ** 2
        found = {"noise": values["noise"] * ratio, "inducing_points": points}
        if one.sparse.kernel == kernel:
            found |= {"hyperparameters": values["hyperparameters"], "signal": values["signal"] * ratio}
        return found
