"""Fits with a local part: a sparse fit to some rows, the local likelihood of a sample, and left-out rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from ..data.rows import LocalSource, Rows
from ..model.bounds import optimal_posteriors
from ..model.conditioning import KnownRows
from ..model.local import LocalModel, values_by_output
from ..model.parameters import ParameterTable, Values
from ..model.posterior import SparsePosterior
from ..solvers import LBFGS
from ..solvers.base import Tolerance
from ..solvers.lbfgs import Descent
from ..utils.linalg import NotPositiveDefiniteError
from .calibration import factor_in_doubt, means_of_groups
from .doubts import of_residuals
from .fitted import Fitted, FittedModel
from .folds import FEWEST_ROWS, PREDICTED_ROWS, CrossValidation, Fold
from .model import Model
from .problem import Problem
from .runs import Fit

# Inducing points and length scales come from a sparse fit to at most so many rows.
_SPARSE_ROWS = 8000
# The local likelihood is that of so many rows, first of the smaller sample, with at most so many neighbours each.
_SAMPLES, _NEIGHBOURS = (2000, 8000), 30
# The sparse fit explains by noise what the inducing points leave out, or by long length scales all of f. The likelihood
# starts from the best of these: hyperparameters of the sparse fit, or its first ones times a factor; and signal and
# noise of the sparse fit times factors, or the first signal, or the variance of y, and the first noise times a factor.
_LENGTH_FACTORS, _FACTORS, _NOISE_FACTORS = (1.0, 0.3, 0.1), ((1.0, 1.0), (2.0, 0.1), (4.0, 0.01)), (1e2, 1e3)
# The largest number of iterations, and the tolerance, in nats per row and output.
_ITERATIONS, _TOLERANCE = 30, 2e-4
# Neighbours are found again under the new length scales while this gains so many nats per row and output.
_ROUNDS, _GAIN = 2, 2e-3
# Left-out rows move the logarithm of the ratio of noise and signal up to this far, and find it to this.
_REACH, _CLOSE = 4.0, 0.1
# With so many rows, one fold is enough.
_ONE_FOLD = 2000
# What a local part would gain is estimated for fits to no fewer and no more rows than these: on this many rows of this
# many outputs, with noise variances of these ratios to the variance of the kernel. More rows would need much memory.
_FEWEST, _MOST, _JUDGED, _JUDGED_OUTPUTS, _RATIOS = 3000, 50_000, 500, 3, (1.0, 0.1, 0.01)
# Mean squared errors below this share of the mean square of the residuals are almost rounding.
_ROUNDED = 1e-10


def with_local_part(model: Model, run: Callable[[Model], tuple[Model, Fit]]) -> tuple[Model, Fit, Values]:
    """A sparse fit, its model with all rows, and the values of kernel, signal and noise for the local part."""
    fitted, fit = run(replace(model, rows=_sample(model.rows, _SPARSE_ROWS, model.seed)))
    model = replace(fitted, rows=model.rows)
    if fitted.exact is not None or model.max_iter == 0 or model.monitor.stopped:
        return model, fit, fit.values
    values = fit.values
    with model.monitor.keeping_the_best():
        values = _most_likely(model, fit.values)
    return model, fit, values


def local_model(model: Model, rows: Rows | None = None, most: int | None = None) -> LocalModel:
    """The local model of all rows, or of others, with at most so many neighbours. Rows are in random order."""
    # In the order of a path, the neighbours of a row would all be on one side (Guinness 2018).
    rows = model.rows if rows is None else rows
    k = model.problem.variant.n_neighbors
    order = np.random.RandomState(model.seed).permutation(len(rows))
    raw = rows.some(np.arange(len(rows)))
    local = LocalModel.of(model.sparse, raw, k if most is None else min(k, most), order, model.rows.threads)
    return replace(local, n_threads=model.problem.n_threads)


def _sample(rows: Rows, size: int, seed: int) -> Rows:
    """Random rows, or all of them if there are no more than ``size``."""
    return rows if len(rows) <= size else rows.random_subset(size, np.random.RandomState(seed))


class _Quick(LBFGS):
    """L-BFGS that ends at the first iteration with little gain, because an iteration takes a second."""

    descent = Descent(patience=1)


def _most_likely(model: Model, values: Values) -> Values:
    """The kernel, signal and noise of the highest local likelihood of a sample. The first sample is small."""
    table = model.table.started_at(values).changed("inducing_points", start=values["inducing_points"], fixed=True)
    if model.sparse.prior.n_groups:
        table = table.changed("coef_factors", fixed=True)
    n, n_outputs = len(model.rows), len(values["noise"])
    sizes = [size for size in _SAMPLES[:-1] if size < n] + [min(n, _SAMPLES[-1])] * _ROUNDS
    highest, last = -np.inf, None
    for number, size in enumerate(sizes):
        local = local_model(model, _sample(model.rows, size, model.seed), _NEIGHBOURS)
        neighbours = local.neighbours(local.known(values_by_output(model.sparse, table.values_at_start())))
        objective = _Objective(local, neighbours, model, table)
        starts = [table.start()] if number else _starts(local, neighbours, model, table)
        ends = [
            _Quick().minimise(
                objective,
                start,
                table.limits(),
                _ITERATIONS,
                Tolerance(_TOLERANCE * n_outputs),
                model.monitor.silent(),
            )
            for start in starts
        ]
        minimum = min(ends, key=lambda end: end.loss)
        table = table.started_at(table.values(minimum.x))
        if size == last and not -minimum.loss > highest + _GAIN * n_outputs:
            break
        highest, last = -minimum.loss, size
    return table.values_at_start()


def _starts(
    local: LocalModel, neighbours: list[np.ndarray], model: Model, table: ParameterTable
) -> Iterator[np.ndarray]:
    """The likeliest of some starts, and perhaps another one.

    Each output has its own signal and noise, and each set of inducing points its own kernel.
    """
    end, begin = table.values_at_start(), model.table.values_at_start()
    free = model.table["hyperparameters"].free.reshape(begin["hyperparameters"].shape)
    kernels = [end["hyperparameters"]] + [
        np.where(free, factor, 1.0) * begin["hyperparameters"] for factor in _LENGTH_FACTORS
    ]
    levels = [(signal * end["signal"], noise * end["noise"]) for signal, noise in _FACTORS]
    levels += [(begin["signal"], factor * begin["noise"]) for factor in _NOISE_FACTORS]
    levels += [(model.scatter / model.mean_precision, factor * begin["noise"]) for factor in _NOISE_FACTORS]
    likelihoods = np.empty((len(kernels), len(levels), len(end["noise"])))
    for index, hyperparameters in enumerate(kernels):
        for level, (signal, noise) in enumerate(levels):
            tried = end | {"hyperparameters": hyperparameters, "signal": signal, "noise": noise}
            values = table.started_at(tried).values_at_start()
            likelihoods[index, level] = _likelihoods(local, values_by_output(model.sparse, values), neighbours)

    # Any kernel explains a constant. It keeps its signal and noise.
    still = model.rows.is_constant()
    likelihoods[:, 1:, still], likelihoods[:, 0, still] = -np.inf, 0.0

    def start(n_skipped: int, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # The kernel of each set of points that is likeliest for the outputs that count, without the first kernels, and
        # the likeliest level of each output.
        highest, level_of = likelihoods[n_skipped:].max(axis=1), likelihoods[n_skipped:].argmax(axis=1)
        groups = np.array([model.sparse.group_of(output) for output in range(len(end["noise"]))])
        if end["hyperparameters"].ndim == 1:
            groups[:] = 0
        sums = [highest[:, (groups == group) & counts].sum(axis=1) for group in np.unique(groups)]
        kernel_of_group = [int(of_kernels.argmax()) for of_kernels in sums]
        hyperparameters = kernels[n_skipped + kernel_of_group[0]]
        if end["hyperparameters"].ndim == 2:
            by_group = enumerate(kernel_of_group)
            hyperparameters = np.array([kernels[n_skipped + kernel][group] for group, kernel in by_group])
        level = level_of[np.array(kernel_of_group)[groups], np.arange(len(groups))]
        signal, noise = (
            np.array([levels[chosen][part][output] for output, chosen in enumerate(level)]) for part in (0, 1)
        )
        values = end | {"hyperparameters": hyperparameters, "signal": signal, "noise": noise}
        return table.started_at(values).start(), noise

    flat, noise = start(0, np.ones(len(end["noise"]), dtype=bool))
    yield flat
    noise_alone = noise > model.rules.collapsed * model.scatter
    if noise_alone.any():
        # Under other length scales, which are worse for the other outputs now, these may be learned.
        yield start(1, noise_alone)[0]


def _likelihoods(local: LocalModel, values: Values, neighbours: list[np.ndarray]) -> np.ndarray:
    """The log likelihood of each output, -inf where it cannot be computed."""
    try:
        found = local.log_likelihoods(values, neighbours)
    except NotPositiveDefiniteError:
        return np.full(len(values["noise"]), -np.inf)
    return np.where(np.isfinite(found), found, -np.inf)


class _Objective:
    """Minus the local likelihood per row, and its gradient, as a function of the sparse model's flat vector.

    Outputs may share its parameters. Constant outputs do not count.
    """

    def __init__(self, local: LocalModel, neighbours: list[np.ndarray], model: Model, table: ParameterTable):
        self.local, self.neighbours, self.sparse, self.table = local, neighbours, model.sparse, table
        self.left_out = model.rows.is_constant()

    def __call__(self, flat: np.ndarray) -> tuple[float, np.ndarray]:
        values, n = self.table.values(flat), self.local.rows.total
        likelihood, by_output = self.local.log_likelihood(
            values_by_output(self.sparse, values), self.neighbours, self.left_out
        )
        gradient = {name: np.zeros(value.shape) for name, value in values.items()}
        gradient["signal"], gradient["noise"] = by_output["signal"], by_output["noise"]
        if values["hyperparameters"].ndim == 1:
            gradient["hyperparameters"] = by_output["hyperparameters"]
        else:
            groups = [self.sparse.group_of(output) for output in range(len(values["noise"]))]
            np.add.at(gradient["hyperparameters"], groups, by_output["hyperparameters"])
        return -likelihood / n, -self.table.gradient(gradient) / n


# --- left-out rows ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _LeftOut:
    """Rows of one output that are predicted from rows without them, at one kernel and any ratio of noise and signal."""

    # The rows that the posterior of v and β sees, and their neighbours. Their signal and noise are 1.
    local: LocalModel
    values: Values
    output: int
    seen: KnownRows
    neighbours: np.ndarray
    # The rows near the left-out rows, and for these the positions of their neighbours, inputs, and [v, h, r].
    near: KnownRows
    nearest: np.ndarray
    inputs: np.ndarray
    own: np.ndarray
    # (q,): noise variances in units of σ², weights w, and groups.
    variance: np.ndarray
    counts: np.ndarray
    labels: np.ndarray

    def predicted(self, ratio: float) -> tuple[np.ndarray, np.ndarray]:
        """Errors (q,) and variances (q,) in units of s², for the ratio σ²/s²."""
        # For features with a wide prior, errors do not depend on s², and all variances are proportional to it.
        columns, signal = slice(self.output, self.output + 1), self.values["signal"][self.output]
        seen, near = (rows.with_ratio(ratio * rows.ratio) for rows in (self.seen, self.near))
        statistics = self.local.statistics_of(self.output, ratio, seen, self.neighbours)
        noise = self.values["noise"].copy()
        noise[self.output] = ratio * signal
        group = self.local.sparse.group(self.values | {"noise": noise}, columns, seen.whitening, statistics)
        ((q,),) = optimal_posteriors([group])
        mean, root = group.times_T(0, q.mean), group.times_T(0, q.root_inv.T)
        errors, variances = np.empty(len(self.inputs)), np.empty(len(self.inputs))
        for rows in near.slices(*self.nearest.shape):
            found = near.conditioned(self.nearest[rows], self.inputs[rows], self.own[rows])
            P = found.differences[:, :-1]
            errors[rows] = found.differences[:, -1] - P @ mean
            variances[rows] = found.latent + ratio * self.variance[rows] + np.square(P @ root).sum(axis=1) / signal
        return errors, variances


def calibrated_locally(model: Model, values: Values, by: CrossValidation) -> Values:
    """The values with the signal and noise that predict left-out rows best, each from its nearest other rows.

    Without groups, rows are left out one by one, else with their group.
    """
    if len(model.rows) < FEWEST_ROWS:
        return values
    signal, noise = values["signal"].copy(), values["noise"].copy()
    limits = {name: model.table[name].value_limits() for name in ("signal", "noise")}
    free = {name: model.table[name].free for name in ("signal", "noise")}
    if by.groups is not None:
        # A few groups may say by chance that the signal is small.
        limits["signal"][:, 0] = np.minimum(signal, limits["signal"][:, 1])
    folds = [_fold(model, values, *fold) for fold in _folds(model, by)]
    if not folds:
        return values
    for output in np.flatnonzero(free["noise"] | free["signal"]):
        parts = [of_fold[output] for of_fold in folds]
        signal[output], noise[output] = _best_variances(
            parts,
            float(signal[output]),
            float(noise[output]),
            limits["signal"][output] if free["signal"][output] else np.repeat(signal[output], 2),
            limits["noise"][output] if free["noise"][output] else np.repeat(noise[output], 2),
        )
        if by.groups is not None and len(parts) > 1:
            factor = _in_doubt(parts, signal[output], noise[output])
            signal[output] = np.clip(factor * signal[output], *model.table["signal"].value_limits()[output])
            noise[output] = np.clip(factor * noise[output], *limits["noise"][output])
    return values | {"signal": signal, "noise": noise}


def _in_doubt(parts: list[_LeftOut], signal: float, noise: float) -> float:
    """The factor by which variances grow because there are few groups."""
    means = []
    for part in parts:
        errors, variances = part.predicted(noise / signal)
        means.append(means_of_groups(errors**2 / (signal * variances), part.counts, part.labels))
    return factor_in_doubt(np.concatenate(means))


def _folds(model: Model, by: CrossValidation) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, bool]]:
    """For each fold: the rows that are predicted, all other rows, labels, and whether rows are left out one by one."""
    rows, rng = model.rows, np.random.RandomState(model.seed)
    folds = by.folds(rows.user_order(), rng)
    if by.groups is None and len(rows) >= _ONE_FOLD:
        predicted = rows.chosen(min(PREDICTED_ROWS, len(rows) // max(by.n_folds, 2)), rng)
        folds = [Fold(predicted, predicted)]
    for fold in folds:
        others = np.setdiff1d(np.arange(len(rows)), fold.rows)
        if len(others):
            labels = np.arange(len(fold.predicted)) if by.groups is None else by.groups[fold.predicted]
            yield fold.predicted, others, labels, by.groups is None


def _fold(
    model: Model, values: Values, predicted: np.ndarray, others: np.ndarray, labels: np.ndarray, one_by_one: bool
) -> list[_LeftOut]:
    """Rows that are predicted from others. If ``one_by_one``, all rows but itself are neighbours of a row."""
    by_output = values_by_output(model.sparse, values)
    unit = by_output | {name: np.ones_like(values[name]) for name in ("signal", "noise")}
    local = local_model(model, _sample(model.rows.subset(others), _SAMPLES[-1], model.seed))
    seen = local.known(unit)
    rows = model.rows if one_by_one else model.rows.subset(others)
    everything = np.arange(len(rows))
    all_rows = replace(local, rows=rows.some(everything), order=everything).known(unit, [own.whitening for own in seen])
    raw, parts = model.rows.some(predicted), []
    for output, (known, neighbours) in enumerate(zip(all_rows, local.neighbours(seen), strict=True)):
        of_output = raw.of([output])
        k = min(known.n_neighbors, len(known) - one_by_one)
        nearest = replace(known, n_neighbors=k + one_by_one).nearest(of_output.inputs)
        if one_by_one:
            nearest = _without(predicted, nearest)
        distinct, places = np.unique(nearest, return_inverse=True)
        counts, precision = (
            np.ones(len(predicted)) if part is None else part for part in (of_output.counts, of_output.precision)
        )
        parts.append(
            _LeftOut(
                local=local,
                values=by_output,
                output=output,
                seen=seen[output],
                neighbours=neighbours,
                near=known.some(distinct),
                nearest=places.reshape(nearest.shape),
                inputs=of_output.inputs,
                own=np.hstack([known.whitened(of_output.inputs), of_output.features, of_output.targets]),
                variance=counts / precision,
                counts=counts,
                labels=labels,
            )
        )
    return parts


def _without(rows: np.ndarray, nearest: np.ndarray) -> np.ndarray:
    """The nearest rows (q, k) of (q, k + 1) without the row itself, or without the last one of its copies."""
    itself = nearest == rows[:, np.newaxis]
    itself[~itself.any(axis=1), -1] = True
    return nearest[~itself].reshape(len(rows), -1)


def _best_variances(
    parts: list[_LeftOut], signal: float, noise: float, signals: np.ndarray, noises: np.ndarray
) -> tuple[float, float]:
    """Signal and noise variance within limits that give left-out rows the highest density."""
    counts = np.concatenate([part.counts for part in parts])
    tried: dict[float, tuple[float, float]] = {}

    def loss(log_ratio: float) -> float:
        ratio = float(np.exp(log_ratio))
        low, high = max(signals[0], noises[0] / ratio), min(signals[1], noises[1] / ratio)
        if low > high * (1.0 + 1e-9):
            return np.inf
        try:
            predicted = [part.predicted(ratio) for part in parts]
        except NotPositiveDefiniteError:
            return np.inf
        errors, variances = (np.concatenate(arrays) for arrays in zip(*predicted, strict=True))
        squares = errors**2 / variances
        best = float(np.clip(counts @ squares / counts.sum(), low, max(low, high)))
        value = float(counts @ (np.log(best * variances) + squares / best))
        tried[value] = best, ratio
        return value

    lowest, highest = np.log([noises[0] / signals[1], noises[1] / signals[0]])
    centre = float(np.clip(np.log(noise / signal), lowest, highest))
    ends = np.clip([centre - _REACH, centre + _REACH], lowest, highest)
    loss(centre)
    if ends[1] - ends[0] > _CLOSE:
        minimize_scalar(loss, bounds=ends, options={"xatol": _CLOSE})
    if not tried:
        return signal, noise
    best, ratio = tried[min(tried)]
    return best, float(np.clip(best * ratio, *noises))


# --- what a local part would gain -------------------------------------------------------------------------------------


def gain_of_neighbours(problem: Problem, fitted: Fitted) -> float | None:
    """The share of the RMS error of some rows that their nearest rows take away from a sparse fit.

    It is the geometric mean of a few outputs. A fit with the local part finds better kernels and has more neighbours,
    so it gains more. None for few or very many rows, for rows that depend on each other, and for other kinds of models.
    """
    variant, noise, solver, source = problem.variant, problem.noise, problem.solver, problem.source
    unsupported = solver.stochastic or solver.posterior != "full" or variant.orthogonal
    if unsupported or noise.heavy_tails or noise.inputs is not None or variant.n_neighbors:
        return None
    if problem.groups is not None or fitted.dependent or not isinstance(source, LocalSource):
        return None
    if not _FEWEST <= source.n_rows <= _MOST:
        return None
    shares: list[float] = []
    for model in fitted.models:
        rows = problem.units.rows(source).outputs(model.outputs)
        outputs = np.flatnonzero(~rows.is_constant())[: _JUDGED_OUTPUTS - len(shares)]
        if isinstance(model.posterior, SparsePosterior) and len(outputs):
            shares += _errors_with_neighbours(rows, model, model.posterior, outputs)
    return 1.0 - float(np.exp(np.mean(np.log(shares)))) if shares else None


def _errors_with_neighbours(
    rows: Rows, model: FittedModel, posterior: SparsePosterior, outputs: np.ndarray
) -> list[float]:
    """The RMS error of some rows of each output from their nearest rows too, divided by that of the sparse fit.

    Errors e of the sparse fit are predicted from those of the nearest rows, wᵀ e_N with w = (K_NN + ρ I)⁻¹ K_Ni. The
    kernel and ρ are the best of a few. A sparse fit that takes details for noise has too long length scales.
    """
    # The same rows for each fit, so that the random numbers of a user are not used up.
    rng = np.random.RandomState(0)
    judged, raw = rows.chosen(_JUDGED, rng), rows.some(np.arange(len(rows)))
    end, first = posterior.values, model.table.values_at_start()["hyperparameters"]
    free = model.table["hyperparameters"].free.reshape(first.shape)
    local = LocalModel.of(posterior.sparse, raw, _NEIGHBOURS + 1, np.arange(len(rows)))
    known = [local.known(values_by_output(posterior.sparse, end))]
    # V is not used. So the whitening of the fit serves for all kernels.
    whitenings = [own.whitening for own in known[0]]
    for factor in _LENGTH_FACTORS:
        values = end | {"hyperparameters": np.where(free, factor * first, first)}
        known.append(local.known(values_by_output(posterior.sparse, values), whitenings))
    # For each output, and for each kernel.
    nearest = [
        [_without(judged, of_kernel[output].nearest(raw.of([output]).inputs[judged])) for of_kernel in known]
        for output in outputs
    ]
    used = np.unique(np.concatenate([judged, *(near.ravel() for of_output in nearest for near in of_output)]))
    mean, _ = of_residuals(posterior.predictor).predict(raw.inputs[used], raw.features[used])
    errors, places = raw.targets[used] - mean, np.searchsorted(used, judged)
    precision = np.ones(len(raw.inputs)) if raw.precision is None else raw.precision / rows.mean_precision
    shares = []
    for output, near_of_kernels in zip(outputs, nearest, strict=True):
        alone, best = errors[places, output], np.inf
        size = np.average(alone**2, weights=precision[judged])
        for of_kernel, near in zip(known, near_of_kernels, strict=True):
            own = of_kernel[output]
            sets = own.inputs[np.column_stack([near, judged])]
            K, _ = own.kernel.within(own.hyperparameters, sets)
            variance = np.maximum(np.einsum("bkk->bk", K)[:, :-1], np.finfo(float).tiny) / precision[near]
            for ratio in _RATIOS:
                covariance = K[:, :-1, :-1] + ratio * variance[:, :, np.newaxis] * np.eye(near.shape[1])
                weights = np.linalg.solve(covariance, K[:, :-1, -1:])[:, :, 0]
                left = alone - np.einsum("bk,bk->b", weights, errors[np.searchsorted(used, near), output])
                best = min(best, float(np.average(left**2, weights=precision[judged])))
        rounding = _ROUNDED * rows.residuals.rms[rows.columns][output] ** 2
        shares.append(float(np.sqrt(min(best / size, 1.0))) if size > rounding else 1.0)
    return shares
