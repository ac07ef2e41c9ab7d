"""Calibration: the signal and noise variances under which held-out rows are predicted best, std included.

The bound takes every row for an independent observation. Rows of one trajectory are alike, and so is the error of the
inducing points in all of them. The noise that maximises the bound, and with it the standard deviation of predictions,
is then too small for new trajectories. For independent rows the noise is too large: the bound takes the error of the
inducing points for noise, and predictions count it twice. Therefore rows are held out in folds (Rasmussen & Williams
2006, section 5.4.2), with kernel and inducing points fixed. The signal and noise variances of each output maximise

    mean over held-out rows of log N(r | mean, variance)  -  ½ log rms of (r - mean)  +  log prior / number of rows.

The prior is log-normal around the values that maximise the bound: where held-out rows say nothing, these stay. The
second term keeps the mean accurate where rows are uncertain anyway. `LeftOut` computes the predictions.

There are only a few groups, such as trajectories. One fold says little about how much a new group may differ.
Therefore the signal, by which std grows away from the data, does not fall, unless nothing that was learned holds for
held-out groups. Both variances are multiplied by a factor of Student's t distribution, with the degrees of freedom that
the errors of the groups leave.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import norm
from scipy.stats import t as student_t

from ..data.rows import Rows
from ..model.bounds import bounds_at_optimum
from ..model.left_out import LeftOut, Seen, Weights, prior_of, sums_of_others
from ..model.model import SparseModel
from ..model.parameters import Parameter, ParameterTable, Values
from ..model.statistics import SufficientStatistics, collect
from ..utils.linalg import NotPositiveDefiniteError
from .folds import CrossValidation, Fold, folds_in_order, follow_a_path

# The noise variance is at least this share of the mean squared error on the training rows: inducing points were placed
# by all rows, including those that are held out.
_LEFT_OVER = 0.4
# Random folds have no more rows than this in all.
_MOST_ROWS = 50_000
# The signal's limits of the fit are widened by this factor, unless the user gave them.
_WIDER = 1e4
# Rows depend on their neighbours if the noise from blocks of consecutive rows is this many times the noise from random
# folds. Rows along a path do too if their log density by blocks is lower by this much, in nats per row. (In a sorted
# table it may be lower for another reason: a block covers a region without other rows.)
_DEPENDENT, _WORSE = 4.0, 0.1
# Fewest rows that can show it.
_FEWEST_DEPENDENT = 200
# A noise variance below this many times its lower limit counts as no noise.
_NOISELESS = 1.1
# The fit of an output holds for no other group if it explains more than this share of the training rows, and gains less
# than this, in nats per row, on the held-out rows.
_EXPLAINED, _GAIN = 0.5, 0.01


@dataclass(frozen=True)
class Calibration:
    """Signal and noise variances (o,) after calibration."""

    signal: np.ndarray
    noise: np.ndarray
    # Number of outputs of which nothing holds for held-out groups.
    gone: int = 0
    # Whether neighbouring rows are alike.
    dependent: bool = False


def calibrate(
    model: SparseModel,
    values: Values,
    statistics: list[SufficientStatistics],
    table: ParameterTable,
    rows: Rows,
    by: CrossValidation,
    seed: int,
) -> Calibration | None:
    """Calibrate signal and noise. None if both are fixed, there are too few rows, or a matrix is not finite.

    ``statistics`` are those of all rows at ``values``. ``table`` has the limits. ``seed`` draws the folds.
    """
    rng = np.random.RandomState(seed)
    if by.groups is None and len(rows) > _MOST_ROWS:
        # More rows tell no more, and the memory for folds would grow with them.
        rows = rows.subset(np.unique(np.linspace(0, len(rows) - 1, _MOST_ROWS).astype(int)))
    folds = by.folds(rows.user_order(), rng)
    if len(folds) < 2 or not any(table[name].free.any() for name in ("signal", "noise")):
        return None
    try:
        return _by_folds(model, values, statistics, table, rows, by, folds, rng)
    except NotPositiveDefiniteError:
        # All rows sufficed for a Cholesky factor. A part of them need not.
        return None


def _by_folds(
    model: SparseModel,
    values: Values,
    statistics: list[SufficientStatistics],
    table: ParameterTable,
    rows: Rows,
    by: CrossValidation,
    folds: list[Fold],
    rng: np.random.RandomState,
) -> Calibration:
    """Search the variances of each output, then test whether groups and neighbours agree with them."""
    (s_low, s_high), (low, high) = (table[name].value_limits().T for name in ("signal", "noise"))
    wider, left_over = _WIDER if by.wide else 1.0, _left_over(model, values, statistics)
    s_low, s_high, at_bound = s_low / wider, s_high * wider, values["signal"]
    noises = variances(table["noise"], values["noise"], np.maximum(low, np.minimum(_LEFT_OVER * left_over, high)), high)
    if by.groups is None:
        # Without noise, errors still fall where the signal rises, and std rises with it: the signal stays.
        most = np.where(values["noise"] <= _NOISELESS * low, at_bound, np.inf)
        signals = variances(table["signal"], at_bound, s_low, np.clip(most, s_low, s_high))
    else:
        signals = variances(table["signal"], at_bound, np.clip(at_bound, s_low, s_high), s_high)
    searches = _searches(model, values, folds, rows, signals, noises)
    best_of = list(rows.threads(VarianceSearch.best, searches))
    gone, dependent, still = 0, False, rows.is_constant()
    if by.groups is not None:
        free = variances(table["signal"], at_bound, s_low, s_high)
        explained = (values["noise"] < (1.0 - _EXPLAINED) * rows.scatter()) & ~still
        groups = [by.groups[fold.predicted] for fold in folds]
        for o, search in enumerate(searches):
            little = search.without_signal() - _GAIN
            if search.loss(*best_of[o]) > little:
                # All of the signal does not hold for held-out groups. A part of it may.
                search = replace(search, signal=free[o])
                best_of[o] = search.best()
                gone += int(explained[o] and search.loss(*best_of[o]) > little)
            factor = search.in_doubt(*best_of[o], groups)
            best_of[o] = search.signal.clip(factor * best_of[o][0]), search.noise.clip(factor * best_of[o][1])
    elif table["noise"].free.any() and len(rows) >= _FEWEST_DEPENDENT:
        fixed = [Variance(value, value, value) for value in at_bound.tolist()]
        others = variances(table["noise"], values["noise"], np.maximum(low, np.minimum(left_over, high)), high)
        in_blocks = folds_in_order(rows.user_order(), by.n_folds, rng)
        blocks = _searches(model, values, in_blocks, rows, fixed, others)
        random = [replace(search, signal=s2, noise=n2) for search, s2, n2 in zip(searches, fixed, others, strict=True)]
        dependent = _dependent(rows, searches, best_of, blocks, random)
    # Held-out rows of an output that does not vary say nothing about its variances.
    at_start = np.column_stack([at_bound, values["noise"]])
    signal, noise = np.where(still[:, np.newaxis], at_start, best_of).T
    return Calibration(signal, noise, gone, dependent)


def _dependent(
    rows: Rows,
    searches: list[VarianceSearch],
    best_of: list[tuple[float, float]],
    blocks: list[VarianceSearch],
    random: list[VarianceSearch],
) -> bool:
    """Whether blocks of consecutive rows are predicted worse than random folds: neighbouring rows are then alike."""
    worse = [
        block.loss(*best) - search.loss(*best) for block, search, best in zip(blocks, searches, best_of, strict=True)
    ]
    if max(worse) > _WORSE and follow_a_path(rows.user_order(), lambda some: rows.some(some).inputs):
        return True
    by_blocks, by_chance = (
        np.array([noise for _, noise in rows.threads(VarianceSearch.best, of_kind)]) for of_kind in (blocks, random)
    )
    return bool((by_blocks > _DEPENDENT * by_chance).any())


def _left_over(model: SparseModel, values: Values, statistics: list[SufficientStatistics]) -> np.ndarray:
    """Squared error (o,) on the training rows, per degree of freedom."""
    squared_error = np.empty(len(values["noise"]))
    for bound in bounds_at_optimum(model.groups_of(values, statistics)):
        group = bound.group
        n_rows = group.statistics.n_rows
        # Rows less the trace of I - B⁻¹, the number of weights that they determine.
        freedom = [n_rows - len(q.B) + np.vdot(q.root_inv, q.root_inv) for q in bound.posteriors]
        if group.prior.shared:
            # Other outputs determine the weights too. What this output adds is the trace of σ⁻² PᵀP B⁻¹.
            for o, q in enumerate(bound.posteriors):
                determined = q.root_inv @ group.products(o)[0] @ q.root_inv.T
                freedom[o] = n_rows - determined.trace() / group.noise[o]
        squared_error[group.outputs] = bound.residuals().squares / np.maximum(freedom, 1e-6 * n_rows)
    return squared_error


def _searches(
    model: SparseModel,
    values: Values,
    folds: Sequence[Fold],
    rows: Rows,
    signals: Sequence[Variance],
    noises: Sequence[Variance],
) -> list[VarianceSearch]:
    """A search for each output, in order. It takes one pass over the rows for each group of outputs."""
    m, share = values["inducing_points"].shape[1], 1.0 / len(folds)
    all_of = [model.blocks(rows.subset(fold.rows, share), m) for fold in folds]
    predicted = [model.blocks(rows.subset(fold.predicted, share), m) for fold in folds]
    left_out = []
    for outputs, whitening in zip(model.groups, model.whitenings(values), strict=True):
        of_others = sums_of_others([collect(fold, whitening, outputs) for fold in all_of])
        seen = [fold.sum(Seen(whitening, outputs)) for fold in predicted]
        groups = [model.group(values, outputs, whitening, others) for others in of_others]
        left_out.append(
            [LeftOut(group, model.variant.family, rows_of) for group, rows_of in zip(groups, seen, strict=True)]
        )
    known: list[list[Weights | None]] = [[None] * len(folds)] * len(values["noise"])
    if model.prior.shared:
        known = _known_elsewhere(left_out)
    outputs_of = [(group, index) for group in left_out for index in range(len(group[0].group.noise))]
    return [
        VarianceSearch(index, group, of_weights, signal, noise)
        for (group, index), of_weights, signal, noise in zip(outputs_of, known, signals, noises, strict=True)
    ]


def _known_elsewhere(groups: Sequence[Sequence[LeftOut]]) -> list[list[Weights | None]]:
    """For each output and fold, the knowledge of the weights from their prior and the other outputs as fitted."""
    outputs = [(group, index) for group in groups for index in range(len(group[0].group.noise))]
    says = [[fold.says(index) for fold in group] for group, index in outputs]
    known: list[list[Weights | None]] = []
    for o, (group, index) in enumerate(outputs):
        of_output: list[Weights | None] = []
        for k, fold in enumerate(group):
            others = (by_fold[k] for j, by_fold in enumerate(says) if j != o)
            of_output.append(sum(others, start=prior_of(fold.group, index)))
        known.append(of_output)
    return known


# --- the search for the signal and noise variances of an output -------------------------------------------------------

# Replaces squares that vanish.
_LOWEST = 1e-20
# Logarithms of ratios s²/σ² are tried in such steps from that of the bound.
_STEP = 4.0
# Accuracy of logarithms of ratio and noise.
_CLOSE = 0.05
# Weight of the logarithm of the root mean square error next to the log density. The density alone hardly depends on the
# mean of rows that are uncertain anyway.
_SQUARES = 0.5
# With few groups, the share of errors of a new one that lie within 2 standard deviations, and the fewest degrees of
# freedom that are assumed.
_INSIDE, _FEWEST_DEGREES = 0.97725, 3.0
# The best noise for a ratio is searched up to this factor from the one that makes variances as large as squared errors.
_REACH = 8.0
# Number of noise variances tried at once.
_POINTS = 9


class Variance(NamedTuple):
    """A variance of an output: the value that maximises the bound, and the limits of the search. Fixed if equal."""

    at_bound: float
    low: float
    high: float

    def clip(self, value: float) -> float:
        """The nearest value within the limits."""
        return float(np.clip(value, self.low, self.high))


def variances(parameter: Parameter, at_bound: np.ndarray, low: np.ndarray, high: np.ndarray) -> list[Variance]:
    """The variance of each output, within limits (o,) if the parameter is free."""
    if not parameter.free.any():
        low = high = at_bound
    return [Variance(*each) for each in zip(at_bound.tolist(), low.tolist(), high.tolist(), strict=True)]


@dataclass(frozen=True)
class VarianceSearch:
    """The search for the variances of an output under which its held-out rows are most probable."""

    # Of the outputs of its group.
    index: int
    # The held-out rows of its group.
    folds: list[LeftOut]
    # For each fold, the knowledge of the weights from elsewhere. None: the prior.
    known: list[Weights | None]
    signal: Variance
    noise: Variance

    def best(self) -> tuple[float, float]:
        """The signal and noise variance with the lowest loss."""
        (signal, s_low, s_high), (noise, low, high) = self.signal, self.noise
        if s_low == s_high and low == high:
            return s_low, low
        # The maximum of the bound may be far outside of the limits.
        least, most = np.log(s_low / high), np.log(s_high / low)
        begin = float(np.clip(np.log(signal / noise), least, most))
        # The lowest loss and its noise variance, for each logarithm of a ratio.
        tried: dict[float, tuple[float, float]] = {}

        def loss(log_ratio: float) -> float:
            if log_ratio not in tried:
                tried[log_ratio] = self._at_ratio(float(np.exp(log_ratio)))
            return tried[log_ratio][0]

        def neighbours(log_ratio: float) -> list[float]:
            return np.clip([log_ratio, log_ratio - _STEP, log_ratio + _STEP], least, most).tolist()

        # There may be several minima. The lowest of a few ratios is followed by steps, and then improved.
        best = min(neighbours(begin), key=loss)
        while (lower := min(neighbours(best), key=loss)) != best:
            best = lower
        if not np.isfinite(loss(best)):
            return signal, noise
        _, *ends = neighbours(best)
        if ends[0] < ends[1]:
            minimize_scalar(loss, bounds=ends, options={"xatol": _CLOSE})
        best = min(tried, key=loss)
        ratio, noise = float(np.exp(best)), tried[best][1]
        if s_low == s_high:
            noise = s_low / ratio
        noise = self.noise.clip(noise)
        return self.signal.clip(ratio * noise), noise

    def loss(self, signal: float, noise: float) -> float:
        """Minus the mean log density of the held-out rows, without its constant."""
        return float(self._means(signal / noise, np.array([noise]))[0][0])

    def without_signal(self) -> float:
        """The same loss for the features alone, with a noise variance equal to their mean squared error."""
        squares = self._means(0.0, np.array([self.noise.at_bound]))[1]
        return self.loss(0.0, max(float(squares[0]), _LOWEST))

    def in_doubt(self, signal: float, noise: float, groups: Sequence[np.ndarray]) -> float:
        """The factor by which variances grow because there are few groups. ``groups`` has labels (n,) for each fold."""
        means: list[np.ndarray] = []
        for fold, known, labels in zip(self.folds, self.known, groups, strict=True):
            error, variance = fold.predicted(self.index, signal / noise, np.array([noise]), known)
            means.append(means_of_groups((error**2 / variance)[:, 0], fold.rows.counts, labels))
        return factor_in_doubt(np.concatenate(means))

    def _at_ratio(self, ratio: float) -> tuple[float, float]:
        """The lowest loss at a ratio s²/σ², and the noise variance there."""
        (_, s_low, s_high), (at_bound, low, high) = self.signal, self.noise
        # A fixed signal or noise is met to rounding.
        low, high = max(low, s_low / ratio * (1.0 - 1e-9)), min(high, s_high / ratio * (1.0 + 1e-9))
        if low > high:
            return np.inf, np.nan
        noise = float(np.clip(at_bound, low, high))
        if np.log(high / low) < _CLOSE:
            return float(self._losses(ratio, np.array([noise]))[0]), noise
        # If variances were proportional to the noise, this would make squared errors as large as variances.
        excess = float(self._means(ratio, np.array([noise]))[2][0])
        noise = float(np.clip(noise * max(excess, _LOWEST), low, high))
        ends = np.log(np.clip([noise / _REACH, noise * _REACH], low, high))
        log_noise, loss = lowest(lambda logs: self._losses(ratio, np.exp(logs)), *ends)
        return loss, float(np.exp(log_noise))

    def _losses(self, ratio: float, noise: np.ndarray) -> np.ndarray:
        """The objective (g,), in nats per row, at noise variances (g,)."""
        density, squares, _ = self._means(ratio, noise)
        log_prior = np.log(ratio * noise / self.signal.at_bound) ** 2 + np.log(noise / self.noise.at_bound) ** 2
        n = sum(fold.rows.counts.sum() for fold in self.folds)
        return density + 0.5 * (log_prior / n + _SQUARES * np.log(np.maximum(squares, _LOWEST)))

    def _means(self, ratio: float, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means over the held-out rows: minus log density without its constant, squared error, and that over variance.

        The second is (1,) if it does not depend on the noise (g,).
        """
        density, squares, excess, n = np.zeros(len(noise)), np.zeros(1), np.zeros(len(noise)), 0.0
        for fold, known in zip(self.folds, self.known, strict=True):
            error, variance = fold.predicted(self.index, ratio, noise, known)
            counts, error = fold.rows.counts, error**2
            scaled = error / variance
            density += 0.5 * (counts @ (np.log(variance) + scaled))
            squares = squares + counts @ error
            excess += counts @ scaled
            n += counts.sum()
        return density / n, squares / n, excess / n


def lowest(function: Callable[[np.ndarray], np.ndarray], low: float, high: float) -> tuple[float, float]:
    """The lowest point of a smooth function of many points at once, and its value there."""
    for _ in range(2):
        points = np.linspace(low, high, _POINTS)
        values = np.where(np.isnan(found := function(points)), np.inf, found)
        best = int(np.argmin(values))
        low, high = points[max(best - 1, 0)], points[min(best + 1, _POINTS - 1)]
    lowest_so_far = float(points[best]), float(values[best])
    if not 0 < best < _POINTS - 1 or not np.isfinite(values[best - 1 : best + 2]).all():
        return lowest_so_far
    # The lowest point of the parabola through three points.
    before, here, after = values[best - 1 : best + 2].tolist()
    bend = before - 2.0 * here + after
    if not bend > 0.0:
        return lowest_so_far
    point = points[best] + 0.5 * (before - after) / bend * (points[1] - points[0])
    value = float(function(np.array([point]))[0])
    return (float(point), value) if value < lowest_so_far[1] else lowest_so_far


def means_of_groups(squares: np.ndarray, counts: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """The mean of squared errors over their variances (n,), weighted by counts (n,), of each group (by labels (n,))."""
    totals, sums = np.bincount(labels, counts), np.bincount(labels, counts * squares)
    return sums[totals > 0.0] / totals[totals > 0.0]


def factor_in_doubt(means: np.ndarray) -> float:
    """The factor by which variances grow because there are few groups, given the `means_of_groups`."""
    # The root mean square of a group's errors over std is one observation of the scale of std. Their mean leaves
    # ν = 1 / (2 variance) degrees of freedom. Errors of a new group then follow Student's t distribution.
    scale = np.sqrt(means)
    spread = float(np.var(scale, ddof=1)) / max(float(np.mean(scale)) ** 2, _LOWEST)
    degrees = max(len(scale) / max(2.0 * spread, 1e-6), _FEWEST_DEGREES)
    return float((student_t.ppf(_INSIDE, degrees) / norm.ppf(_INSIDE)) ** 2)
