"""Signal and noise variance under which rows that were left out are predicted as well as possible, std included.

The bound counts every row as new knowledge. Rows of a trajectory are alike, and what a sparse model cannot represent is
alike in all of them: the noise that the bound likes best, and with it the standard deviation of predictions, is then too
small for new trajectories. And what inducing points cannot represent is noise to the bound, while predictions count it
twice: of independent rows the noise is too large. So folds of rows are left out one after the other (Rasmussen &
Williams 2006, section 5.4.2: cross-validation), with kernel and inducing points as they are, and each output's signal
and noise variance are where their predictive density is highest,

    max over s², σ² of   mean over rows left out of log N(r | mean, variance)   -   a prior that weighs as much as one row,

log-normal around what the bound found: where the rows left out say nothing, all stays. (The squared errors left out are
then on average as large as their variances.) What predicts rows that were left out is in `inference.left_out`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..inference.bounds import bounds_at_optimum
from ..inference.left_out import LeftOut, Seen, Weights, prior_of, sums_of_others
from ..inference.model import SparseModel
from ..inference.statistics import SufficientStatistics, collect
from ..optimizers.parameters import ParameterTable, Values
from ..rows.folds import FEWEST_ROWS, Fold, folds_in_order, folds_of_groups, random_folds
from ..rows.internal import Rows

# The noise is no lower than this share of the square of what the model leaves over of its own rows, and never this low.
_LEFT_OVER, _LOWEST = 0.2, 1e-20
# Ratios s²/σ² that are tried are powers of 2: these many doublings away first, then in steps of so many, and no further
# than so many from where the bound is highest.
_LOOK, _STEPS, _FARTHEST = (-6, 0, 6), (3.0, 1.0, 0.25), 36
# The signal's limits in a fit are so many times wider here, if they are not the user's.
_WIDER = 1e4
# Noise variances that are tried for a ratio, as factors.
_NOISES = 2.0 ** np.arange(-3.0, 3.25, 0.5)
# Rows depend on those near them if the noise by blocks of consecutive rows is so many times that by random folds.
_DEPENDENT = 4.0
# Of so many rows that can be seen.
_FEWEST_DEPENDENT = 200
# The signal has gone if so little is left of what explained more than half of an output.
_GONE, _EXPLAINED = 1e-3, 0.5


@dataclass(frozen=True)
class CrossValidation:
    """How rows are left out.

    Attributes
    ----------
    n_folds : int
    groups : ndarray of shape (n,), optional
        Which rows are left out together; None: chance says.
    wide : bool, default=True
        Whether nobody set bounds for the signal: it may then leave those of the fit, which keep kernels from becoming
        long waves of huge height. Here the kernel's shape stays.
    """

    n_folds: int
    groups: np.ndarray | None = None
    wide: bool = True

    def folds(self, n_rows: int, rng: np.random.RandomState) -> list[Fold]:
        """Folds of all rows; none if these are too few."""
        if n_rows < FEWEST_ROWS:
            return []
        if self.groups is None:
            return random_folds(n_rows, self.n_folds, rng)
        return folds_of_groups(self.groups, self.n_folds, rng)


@dataclass(frozen=True)
class Calibrated:
    """What came of it.

    Attributes
    ----------
    signal, noise : ndarray of shape (o,)
        s² and σ².
    gone : int
        Outputs of which nothing that was learned holds for groups that were left out.
    dependent : bool
        Whether rows near each other are alike.
    """

    signal: np.ndarray
    noise: np.ndarray
    gone: int = 0
    dependent: bool = False


def calibrated(
    model: SparseModel,
    values: Values,
    statistics: list[SufficientStatistics],
    table: ParameterTable,
    rows: Rows,
    by: CrossValidation,
    seed: int,
) -> Calibrated | None:
    """The signal and noise variances of each output that are free; None if there are too few rows.

    Parameters
    ----------
    model : SparseModel
    values : dict
        As in `SparseModel.at_optimum`.
    statistics : list of SufficientStatistics
        Of all rows, for these values.
    table : ParameterTable
        What is free, within which limits.
    rows : Rows
    by : CrossValidation
    seed : int
        Draws folds.
    """
    rng = np.random.RandomState(seed)
    folds = by.folds(len(rows), rng)
    if len(folds) < 2:
        return None
    limits, lowest = _Limits.of(table, _WIDER if by.wide else 1.0), _left_over(model, values, statistics)
    searches = _searches(model, values, folds, rows, limits, _LEFT_OVER * lowest)
    found = np.array(list(rows.threads(_Search.best, searches)))
    signal, noise = found.T
    gone, dependent = 0, False
    if by.groups is not None:
        explained = values["noise"] < (1.0 - _EXPLAINED) * rows.scatter()
        gone = int((explained & (signal < _GONE * values["signal"])).sum())
    elif limits.free_noise and len(rows) >= _FEWEST_DEPENDENT:
        in_order = folds_in_order(np.arange(len(rows)), by.n_folds, rng)
        alone = replace(limits, free_signal=False)
        blocks = _searches(model, values, in_order, rows, alone, lowest)
        chance = [search.with_limits(alone, lowest[search.output]) for search in searches]
        each = (np.array([noise for _, noise in rows.threads(_Search.best, own)]) for own in (blocks, chance))
        dependent = bool((next(each) > _DEPENDENT * next(each)).any())
    return Calibrated(signal, noise, gone, dependent)


@dataclass(frozen=True)
class _Limits:
    """Limits of signal and noise, each (o, 2), and which of the two are free."""

    signal: np.ndarray
    noise: np.ndarray
    free_signal: bool
    free_noise: bool

    @classmethod
    def of(cls, table: ParameterTable, wider: float) -> _Limits:
        signal, noise = table["signal"], table["noise"]
        return cls(
            signal.value_limits() * [1.0 / wider, wider],
            noise.value_limits(),
            bool(signal.free.any()),
            bool(noise.free.any()),
        )


def _left_over(model: SparseModel, values: Values, statistics: list[SufficientStatistics]) -> np.ndarray:
    """The square (o,) of what the model leaves over of its own rows, per degree of freedom."""
    found = np.empty(len(values["noise"]))
    for bound in bounds_at_optimum(list(model.groups_of(values, statistics)), model.family):
        group = bound.group
        n_rows = group.statistics.n_rows
        # Rows less the trace of I - B⁻¹, the weights that they determine.
        freedom = [n_rows - len(q.B) + np.vdot(q.root_inv, q.root_inv) for q in bound.posteriors]
        found[group.outputs] = bound.residuals().squares / np.maximum(freedom, 1e-6 * n_rows)
    return found


def _searches(
    model: SparseModel, values: Values, folds: Sequence[Fold], rows: Rows, limits: _Limits, lowest: np.ndarray
) -> list[_Search]:
    """For each output, in order: a pass over the rows for each group."""
    m, share = values["inducing_points"].shape[1], 1.0 / len(folds)
    all_of = [model.blocks(rows.some_of(fold.rows, share), m) for fold in folds]
    predicted = [model.blocks(rows.some_of(fold.predicted, share), m) for fold in folds]
    each = []
    for outputs, whitening in zip(model.groups, model.whitenings(values), strict=True):
        of_others = sums_of_others([collect(fold, whitening, outputs) for fold in all_of])
        seen = [fold.sum(Seen(whitening, outputs)) for fold in predicted]
        groups = [model.group(values, outputs, whitening, others) for others in of_others]
        each.append([LeftOut(group, model.family, own) for group, own in zip(groups, seen, strict=True)])
    known: list[list[Weights | None]] = [[None] * len(folds)] * len(values["noise"])
    if model.prior.shared:
        known = _known_elsewhere(each)
    searches = []
    for group in each:
        for index in range(len(group[0].group.noise)):
            o = len(searches)
            searches.append(_Search(o, index, group, known[o], values, limits, float(lowest[o])))
    return searches


def _known_elsewhere(groups: Sequence[Sequence[LeftOut]]) -> list[list[Weights | None]]:
    """Of each output: what its prior and the other outputs, as they were fitted, say of the weights without each fold."""
    outputs = [(group, index) for group in groups for index in range(len(group[0].group.noise))]
    told = [[fold.says(index) for fold in group] for group, index in outputs]
    found: list[list[Weights | None]] = []
    for o, (group, index) in enumerate(outputs):
        own: list[Weights | None] = []
        for k, fold in enumerate(group):
            others = (each[k] for j, each in enumerate(told) if j != o)
            own.append(sum(others, start=prior_of(fold.group, index)))
        found.append(own)
    return found


@dataclass(frozen=True)
class _Search:
    """Where an output's log predictive density of rows left out is highest.

    Attributes
    ----------
    output, index : int
        Of the model's outputs, and of its group's.
    folds : list of LeftOut
        Of its group.
    known : list of Weights or None
        What is known of the weights beside the output's own rows, without each fold.
    values : dict
        Where the bound is highest.
    limits : _Limits
    lowest : float
        The noise is not lower.
    """

    output: int
    index: int
    folds: list[LeftOut]
    known: list[Weights | None]
    values: Values
    limits: _Limits
    lowest: float

    def with_limits(self, limits: _Limits, lowest: float) -> _Search:
        """The same search for less."""
        return replace(self, limits=limits, lowest=float(lowest))

    def best(self) -> tuple[float, float]:
        """Signal and noise variance."""
        signal, noise = self._along_ratios()
        if not self.limits.free_signal or not np.isclose(signal, self._range("signal")).any():
            return signal, noise
        # Along a limit of the signal the noise alone is searched.
        values = self.values | {"signal": np.full(len(self.values["signal"]), signal)}
        return replace(self, values=values, limits=replace(self.limits, free_signal=False))._along_ratios()

    def _along_ratios(self) -> tuple[float, float]:
        s2, noise = (float(self.values[name][self.output]) for name in ("signal", "noise"))
        if not self.limits.free_signal and not self.limits.free_noise:
            return s2, noise
        begin = float(np.round(np.log2(s2 / noise)))
        tried: dict[float, tuple[float, float]] = {}

        def loss(k: float) -> float:
            if abs(k - begin) > _FARTHEST:
                return np.inf
            if k not in tried:
                tried[k] = self._at_ratio(2.0**k)
            return tried[k][0]

        best = min((begin + step for step in _LOOK), key=loss)
        for step in _STEPS:
            while (k := min((best, best - step, best + step), key=loss)) != best:
                best = k
        if not np.isfinite(loss(best)):
            return s2, noise
        return self._between(best, [tried.get(best + side * step, (np.inf, np.nan)) for side in (-1, 0, 1)])

    def _between(self, k: float, near: Sequence[tuple[float, float]]) -> tuple[float, float]:
        """Where a parabola through the losses at three powers, the last step apart around k, is lowest."""
        (before, noise_before), (here, noise), (after, noise_after) = near
        shift = 0.0
        if np.isfinite(before + after):
            shift = _vertex(before, here, after)
            noise *= (noise_after / noise if shift > 0.0 else noise / noise_before) ** shift
        if not self.limits.free_noise:
            noise = float(self.values["noise"][self.output])
        ratio = 2.0 ** (k + _STEPS[-1] * shift)
        signal = ratio * noise
        if not self.limits.free_signal:
            signal = float(self.values["signal"][self.output])
            noise = signal / ratio
        return (
            float(np.clip(signal, *self._range("signal"))),
            float(np.clip(noise, *self._range("noise"))),
        )

    def _range(self, name: str) -> tuple[float, float]:
        """From where to where it may move."""
        if not getattr(self.limits, f"free_{name}"):
            return (float(self.values[name][self.output]),) * 2
        low, high = getattr(self.limits, name)[self.output]
        if name == "noise":
            low = max(low, min(self.lowest, high), _LOWEST)
        return float(low), float(high)

    def _at_ratio(self, ratio: float) -> tuple[float, float]:
        """The lowest loss at a ratio s²/σ², and the noise variance there."""
        (s_low, s_high), (low, high) = self._range("signal"), self._range("noise")
        # A signal or a noise that is fixed is met to rounding.
        low, high = max(low, s_low / ratio * (1.0 - 1e-9)), min(high, s_high / ratio * (1.0 + 1e-9))
        if low > high:
            return np.inf, np.nan
        if high < low * 1.01:
            noise = np.array([np.sqrt(low * high)])
            return float(self._losses(ratio, noise)[0]), float(noise[0])
        noise = np.clip(self.values["noise"][self.output], low, high)
        # What makes squared errors as large as variances, were these in proportion to the noise.
        for _ in range(2):
            noise = np.clip(noise * self._excess(ratio, noise), low, high)
        grid = np.clip(noise * _NOISES, low, high)
        losses = self._losses(ratio, grid)
        best = int(np.argmin(losses))
        if not 0 < best < len(grid) - 1 or not grid[best - 1] < grid[best] < grid[best + 1]:
            return float(losses[best]), float(grid[best])
        shift = _vertex(*losses[best - 1 : best + 2])
        noise = grid[best] * (_NOISES[1] / _NOISES[0]) ** shift
        return float(losses[best] + 0.25 * shift * (losses[best + 1] - losses[best - 1])), float(noise)

    def _excess(self, ratio: float, noise: float) -> float:
        """Mean square of errors in units of their std."""
        total, n = 0.0, 0
        for fold, known in zip(self.folds, self.known, strict=True):
            error, variance = fold.predicted(self.index, ratio, np.array([noise]), known)
            total += float((error**2 / variance).sum())
            n += len(variance)
        return max(total / n, 1e-12)

    def _losses(self, ratio: float, noise: np.ndarray) -> np.ndarray:
        """What is to be low (g,), in nats per row, at noise variances (g,)."""
        total, n = np.zeros(len(noise)), 0
        for fold, known in zip(self.folds, self.known, strict=True):
            error, variance = fold.predicted(self.index, ratio, noise, known)
            total += 0.5 * (np.log(variance) + error**2 / variance).sum(axis=0)
            n += len(variance)
        s2, at_bound = (self.values[name][self.output] for name in ("signal", "noise"))
        total += 0.5 * (np.log(ratio * noise / s2) ** 2 + np.log(noise / at_bound) ** 2)
        return total / n


def _vertex(before: float, here: float, after: float) -> float:
    """Where a parabola through three points, one step apart, is lowest: in steps from the middle one, the lowest."""
    curvature = before - 2.0 * here + after
    return 0.0 if curvature <= 0.0 else float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))
