"""Signal and noise variance under which rows that were left out are predicted as well as possible, std included.

The bound counts every row as new knowledge. Rows of a trajectory are alike, and what a sparse model cannot represent is
alike in all of them: the noise that the bound likes best, and with it the standard deviation of predictions, is too
small for new trajectories. And what inducing points cannot represent is noise to the bound, while predictions count it
twice: of independent rows the noise is too large. So folds of rows are left out one after the other (Rasmussen &
Williams 2006, section 5.4.2: cross-validation), with kernel and inducing points as they are, and each output's signal
and noise variance are where this is highest:

    mean over rows left out of log N(r | mean, variance)  -  ½ log rms of (r - mean)  +  log prior / number of rows,

with a prior that is log-normal around what the bound found: where the rows left out say nothing, all stays. (Density
alone would give the mean away where rows are uncertain anyway.) `LeftOut` predicts them.

Groups, such as trajectories, are few: how far a new one may be from all is hardly known from a fold of them. So the
signal, by which std grows away from the data, does not fall, unless nothing of what was learned holds for groups left
out; and both variances are widened by Student's t, for as many degrees of freedom as the groups' own errors leave.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import accumulate
from operator import add

import numpy as np
from scipy.linalg import eigh
from scipy.stats import norm
from scipy.stats import t as student_t

from ..data.blocks import AnyBlock
from ..data.rows import Rows
from ..model.bounds import Group, PosteriorFamily, bounds_at_optimum, projected
from ..model.model import SparseModel
from ..model.parameters import ParameterTable, Values
from ..model.statistics import SufficientStatistics, Whitening, collect
from ..utils.linalg import NotPositiveDefiniteError, diagonal_of, jittered_cholesky, triangular_inverse

# The noise is no lower than this share of the square of what the model leaves over of its own rows: inducing points are
# where they are because of all rows, also of those that are left out.
_LEFT_OVER = 0.4
# Random folds are of no more rows than this.
_MOST_ROWS = 50_000
# The signal's limits in a fit are so many times wider here, if they are not the user's.
_WIDER = 1e4
# Rows depend on those near them if the noise by blocks of consecutive rows is so many times that by random folds. So do
# rows along a path if log density by blocks is so much lower, in nats per row. (Of a sorted table it may be, too: there
# blocks are where no other rows are.)
_DEPENDENT, _WORSE = 4.0, 0.1
# Of so many rows that can be seen.
_FEWEST_DEPENDENT = 200
# A noise that is no more than so many times its lower limit is as good as none.
_NOISELESS = 1.1
# What explained more than so much of an output holds for no other group if it gains less than this, in nats per row
# that was left out.
_EXPLAINED, _GAIN = 0.5, 0.01


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
    """The signal and noise variances of each output; None if none is free, there are too few rows, or it fails.

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
    if by.groups is None and len(rows) > _MOST_ROWS:
        # So many tell as much, and what says which rows are where does not grow with them.
        rows = rows.some_of(np.unique(np.linspace(0, len(rows) - 1, _MOST_ROWS).astype(int)), 1.0)
    folds = by.folds(rows.as_given(), rng)
    if len(folds) < 2 or not any(table[name].free.any() for name in ("signal", "noise")):
        return None
    try:
        return _by_folds(model, values, statistics, table, rows, by, folds, rng)
    except NotPositiveDefiniteError:
        # All rows could be learned from; fewer need not be.
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
) -> Calibrated:
    limits, lowest = Limits.of(table, _WIDER if by.wide else 1.0), _left_over(model, values, statistics)
    first = limits.with_signal_above(values["signal"])
    if by.groups is None:
        # Without noise, errors still fall where the signal rises, and std rises with it: it stays where it is.
        noiseless = values["noise"] <= _NOISELESS * limits.noise[:, 0]
        first = limits.with_signal_below(np.where(noiseless, values["signal"], np.inf))
    searches = _searches(model, values, folds, rows, first, _LEFT_OVER * lowest)
    found = list(rows.threads(Search.best, searches))
    # Rows left out of an output that does not vary say nothing of its variances.
    still, at_bound = rows.still(), np.column_stack([values["signal"], values["noise"]])
    gone, dependent = 0, False
    if by.groups is not None:
        explained = (values["noise"] < (1.0 - _EXPLAINED) * rows.scatter()) & ~still
        for own, is_explained in zip(searches, explained, strict=True):
            little = own.without_signal() - _GAIN
            if own.loss(*found[own.output]) > little:
                # All of it does not hold for groups left out; perhaps some does.
                found[own.output] = own.with_limits(limits, own.lowest).best()
                gone += int(is_explained and own.loss(*found[own.output]) > little)
        groups = [by.groups[fold.predicted] for fold in folds]
        found = [own.times(own.in_doubt(*best, groups), *best) for own, best in zip(searches, found, strict=True)]
    elif limits.free_noise and len(rows) >= _FEWEST_DEPENDENT:
        dependent = _dependent(model, values, rows, by, rng, searches, found, lowest)
    signal, noise = np.where(still[:, np.newaxis], at_bound, found).T
    return Calibrated(signal, noise, gone, dependent)


def _dependent(
    model: SparseModel,
    values: Values,
    rows: Rows,
    by: CrossValidation,
    rng: np.random.RandomState,
    searches: list[Search],
    found: list[tuple[float, float]],
    lowest: np.ndarray,
) -> bool:
    """Whether rows near each other are alike: left out in blocks, they are predicted worse than by ``searches``."""
    order = rows.as_given()
    alone = replace(searches[0].limits, free_signal=False)
    blocks = _searches(model, values, folds_in_order(order, by.n_folds, rng), rows, alone, lowest)
    worse = [block.loss(*best) - own.loss(*best) for block, own, best in zip(blocks, searches, found, strict=True)]
    if max(worse) > _WORSE and follow_a_path(order, lambda some: rows.some(some).inputs):
        return True
    chance = [search.with_limits(alone, lowest[search.output]) for search in searches]
    each = (np.array([noise for _, noise in rows.threads(Search.best, own)]) for own in (blocks, chance))
    return bool((next(each) > _DEPENDENT * next(each)).any())


def _left_over(model: SparseModel, values: Values, statistics: list[SufficientStatistics]) -> np.ndarray:
    """The square (o,) of what the model leaves over of its own rows, per degree of freedom."""
    found = np.empty(len(values["noise"]))
    for bound in bounds_at_optimum(list(model.groups_of(values, statistics)), model.family):
        group = bound.group
        n_rows = group.statistics.n_rows
        # Rows less the trace of I - B⁻¹, the weights that they determine.
        freedom = [n_rows - len(q.B) + np.vdot(q.root_inv, q.root_inv) for q in bound.posteriors]
        if group.prior.shared:
            # Other outputs determine them, too: the trace of σ⁻² Pᵀ P B⁻¹.
            for o, q in enumerate(bound.posteriors):
                own = q.root_inv @ projected(group, o)[0] @ q.root_inv.T
                freedom[o] = n_rows - own.trace() / group.noise[o]
        found[group.outputs] = bound.residuals().squares / np.maximum(freedom, 1e-6 * n_rows)
    return found


def _searches(
    model: SparseModel, values: Values, folds: Sequence[Fold], rows: Rows, limits: Limits, lowest: np.ndarray
) -> list[Search]:
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
    searches: list[Search] = []
    for group in each:
        for index in range(len(group[0].group.noise)):
            o = len(searches)
            searches.append(Search(o, index, group, known[o], values, limits, float(lowest[o])))
    return searches


def _known_elsewhere(groups: Sequence[Sequence[LeftOut]]) -> list[list[Weights | None]]:
    """Of each output: what its prior and the other outputs, as fitted, say of the weights without each fold."""
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


# --- where an output's signal and noise predict rows that were left out best ------------------------------------------

# In place of squares that vanish.
_LOWEST = 1e-20
# Ratios s²/σ² that are tried are powers of 2: these many doublings away first, then in steps of so many, and no further
# than so many from where the bound is highest.
_LOOK, _STEPS, _FARTHEST = (-6, 0, 6), (3.0, 1.0, 0.25), 36
# What the logarithm of the root mean square error counts beside a log density: to this the mean of rows that are
# uncertain anyway hardly matters.
_SQUARES = 0.5
# Where groups are few, as many errors of a new one as should lie within 2 standard deviations; with no fewer degrees of
# freedom than this.
_INSIDE, _FEWEST_DEGREES = 0.97725, 3.0
# Noise variances that are tried for a ratio, as factors.
_NOISES = 2.0 ** np.arange(-3.0, 3.25, 0.5)


@dataclass(frozen=True)
class Limits:
    """Limits of signal and noise, each (o, 2), and which of the two are free."""

    signal: np.ndarray
    noise: np.ndarray
    free_signal: bool
    free_noise: bool

    @classmethod
    def of(cls, table: ParameterTable, wider: float) -> Limits:
        signal, noise = table["signal"], table["noise"]
        return cls(
            signal.value_limits() * [1.0 / wider, wider],
            noise.value_limits(),
            bool(signal.free.any()),
            bool(noise.free.any()),
        )

    def with_signal_above(self, least: np.ndarray) -> Limits:
        """The same with a signal (o,) that does not fall below."""
        low, high = self.signal.T
        return replace(self, signal=np.column_stack([np.clip(least, low, high), high]))

    def with_signal_below(self, most: np.ndarray) -> Limits:
        """The same with a signal (o,) that does not rise above."""
        low, high = self.signal.T
        return replace(self, signal=np.column_stack([low, np.clip(most, low, high)]))


@dataclass(frozen=True)
class Search:
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
    limits : Limits
    lowest : float
        The noise is not lower.
    """

    output: int
    index: int
    folds: list[LeftOut]
    known: list[Weights | None]
    values: Values
    limits: Limits
    lowest: float

    def with_limits(self, limits: Limits, lowest: float) -> Search:
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

    def loss(self, signal: float, noise: float) -> float:
        """Minus the mean log density of what was left out, but for a constant."""
        density, _ = self._means(signal / noise, np.array([noise]))
        return float(density[0])

    def without_signal(self) -> float:
        """The same of the features alone, with a noise as large as what they leave over."""
        _, squares = self._means(0.0, self._at_bound("noise") * np.ones(1))
        return self.loss(0.0, max(float(squares[0]), _LOWEST))

    def in_doubt(self, signal: float, noise: float, groups: Sequence[np.ndarray]) -> float:
        """By what variances should be larger since they are known from so many groups only, (n,) of each fold.

        A group's root mean square of errors over std is one observation of the scale of std; of the mean of them, ν =
        1 / (2 variance) degrees of freedom are left. Errors of a new group are then distributed as Student's t.
        """
        means: list[np.ndarray] = []
        for fold, known, own in zip(self.folds, self.known, groups, strict=True):
            error, variance = fold.predicted(self.index, signal / noise, np.array([noise]), known)
            counts = np.bincount(own, fold.rows.counts)
            sums = np.bincount(own, fold.rows.counts * (error**2 / variance)[:, 0])
            means.append(sums[counts > 0.0] / counts[counts > 0.0])
        scale = np.sqrt(np.concatenate(means))
        spread = float(np.var(scale, ddof=1)) / max(float(np.mean(scale)) ** 2, _LOWEST)
        degrees = max(len(scale) / max(2.0 * spread, 1e-6), _FEWEST_DEGREES)
        return float((student_t.ppf(_INSIDE, degrees) / norm.ppf(_INSIDE)) ** 2)

    def times(self, factor: float, signal: float, noise: float) -> tuple[float, float]:
        """Variances times a factor, within their limits."""
        signal, noise = (
            float(np.clip(value * factor, *self._range(name))) for name, value in (("signal", signal), ("noise", noise))
        )
        return signal, noise

    def _along_ratios(self) -> tuple[float, float]:
        s2, noise = (self._at_bound(name) for name in ("signal", "noise"))
        if not self.limits.free_signal and not self.limits.free_noise:
            return s2, noise
        (s_low, s_high), (low, high) = self._range("signal"), self._range("noise")
        # Where the bound was highest may be far from what is allowed here.
        begin = float(np.clip(np.round(np.log2(s2 / noise)), np.log2(s_low / high), np.log2(s_high / low)))
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
            noise = self._at_bound("noise")
        ratio = 2.0 ** (k + _STEPS[-1] * shift)
        signal = ratio * noise
        if not self.limits.free_signal:
            signal = self._at_bound("signal")
            noise = signal / ratio
        return (
            float(np.clip(signal, *self._range("signal"))),
            float(np.clip(noise, *self._range("noise"))),
        )

    def _range(self, name: str) -> tuple[float, float]:
        """From where to where it may move."""
        if not getattr(self.limits, f"free_{name}"):
            return (self._at_bound(name),) * 2
        low, high = getattr(self.limits, name)[self.output]
        if name == "noise":
            low = max(low, min(self.lowest, high))
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
        noise = np.clip(self._at_bound("noise"), low, high)
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
        total, n = 0.0, 0.0
        for fold, known in zip(self.folds, self.known, strict=True):
            error, variance = fold.predicted(self.index, ratio, np.array([noise]), known)
            total += float((fold.rows.counts @ (error**2 / variance))[0])
            n += fold.rows.counts.sum()
        return max(total / n, 1e-12)

    def _losses(self, ratio: float, noise: np.ndarray) -> np.ndarray:
        """What is to be low (g,), in nats per row, at noise variances (g,)."""
        density, squares = self._means(ratio, noise)
        log_prior = np.log(ratio * noise / self._at_bound("signal")) ** 2 + np.log(noise / self._at_bound("noise")) ** 2
        n = sum(fold.rows.counts.sum() for fold in self.folds)
        return density + 0.5 * (log_prior / n + _SQUARES * np.log(np.maximum(squares, _LOWEST)))

    def _means(self, ratio: float, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Minus the mean log density but for a constant (g,), and the mean square error, of what was left out."""
        density, squares, n = np.zeros(len(noise)), np.zeros(1), 0.0
        for fold, known in zip(self.folds, self.known, strict=True):
            error, variance = fold.predicted(self.index, ratio, noise, known)
            counts, error = fold.rows.counts, error**2
            density += 0.5 * (counts @ (np.log(variance) + error / variance))
            squares = squares + counts @ error
            n += counts.sum()
        return density / n, squares / n

    def _at_bound(self, name: str) -> float:
        return float(self.values[name][self.output])


def _vertex(before: float, here: float, after: float) -> float:
    """Where a parabola through three points, one step apart, is lowest: in steps from the middle one, the lowest."""
    curvature = before - 2.0 * here + after
    return 0.0 if curvature <= 0.0 else float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))


# --- rows that were left out, as the others predict them, for any signal and noise: no pass over the rows for each ----

# Rows that were left out, as the others predict them, for any signal and noise variance: no pass over rows for each.
#
# Of an output let ρ = s²/σ² be the ratio of the two. In the whitened coordinates of `model.bounds`, with
# β = μ_β + C (w₀ + w), the precision of v given w is I + ρ V Vᵀ. With that at one ratio, I + ρ₀ V Vᵀ = L Lᵀ, and the
# eigenvalues λ and eigenvectors U of L⁻¹ L⁻ᵀ it is
#
#     I + ρ V Vᵀ = L U D Uᵀ Lᵀ,   D = diag(λ + (ρ/ρ₀) (1 - λ)),
#
# so that in the coordinates z = Uᵀ L⁻¹ v(x) of a row it is diagonal for all ρ. With X = Uᵀ L⁻¹ V H and t = Uᵀ L⁻¹ V r
# what is left for w are p-sized matrices,
#
#     precision of w: I + σ⁻² Cᵀ M C,   M = HᵀH - ρ Xᵀ D⁻¹ X,   its linear term: σ⁻² Cᵀ (Hᵀr - ρ Xᵀ D⁻¹ t) - w₀,
#
# and a row is predicted as
#
#     mean: ρ zᵀ D⁻¹ t + a(x)ᵀ C w,   variance: σ² (1 + ρ (zᵀ D⁻¹ z + k̃(x, x) - |v|²)) + a(x)ᵀ C Cov[w] Cᵀ a(x),
#
# with a = h - ρ Xᵀ D⁻¹ z, the part of the features that the Gaussian process does not explain. Except C, all of this is
# common to the outputs of a group, and the same trick makes the precision of w diagonal for all σ². With many more
# features than inducing points, I + σ⁻² Cᵀ HᵀH C is made diagonal once for all ρ, and the points change it by a
# matrix of rank m. Where outputs share w, the knowledge of the other outputs replaces its prior.

# Of so many times more features than inducing points, w is made diagonal once.
_MANY_FEATURES = 4


@dataclass(frozen=True)
class SeenRows:
    """Rows as a set of inducing points and its outputs see them; their sum are the rows of both.

    Attributes
    ----------
    V : ndarray of shape (n, m)
    unexplained : ndarray of shape (n,)
        k(x, x) - |v|².
    features : ndarray of shape (n, p)
    residuals : ndarray of shape (n, o)
    noise : ndarray of shape (n,)
        Of each row, relative to σ².
    counts : ndarray of shape (n,)
        How often it counts.
    """

    V: np.ndarray
    unexplained: np.ndarray
    features: np.ndarray
    residuals: np.ndarray
    noise: np.ndarray
    counts: np.ndarray

    def __add__(self, other: SeenRows) -> SeenRows:
        each = (np.concatenate([getattr(self, field.name), getattr(other, field.name)]) for field in fields(self))
        return SeenRows(*each)


@dataclass(frozen=True)
class Seen:
    """Block -> `SeenRows`."""

    whitening: Whitening
    outputs: slice

    def __call__(self, block: AnyBlock) -> SeenRows:
        block, outputs = block.of(self.outputs)
        _, V = self.whitening.project(block.prepared)
        unexplained = self.whitening.unexplained(block.prepared, V)
        features, residuals, counts = block.features, block.residuals[:, outputs], np.ones(len(unexplained))
        if block.roots is None or block.counts is None:
            return SeenRows(V.T, unexplained, features, residuals, counts, counts)
        roots = block.roots[:, np.newaxis]
        return SeenRows(
            V.T, unexplained, features / roots, residuals / roots, block.counts / block.roots**2, block.counts
        )


@dataclass(frozen=True)
class Weights:
    """What is known of w: its precision (p, p), and that times its mean (p,)."""

    precision: np.ndarray
    linear: np.ndarray

    def __add__(self, other: Weights) -> Weights:
        return Weights(self.precision + other.precision, self.linear + other.linear)


@dataclass(frozen=True)
class _Diagonal:
    """Coordinates in which a precision of w, what is known of it and σ⁻² times a matrix, is diagonal for all σ².

    Attributes
    ----------
    basis : ndarray of shape (p, p)
    eigenvalues : ndarray of shape (p,)
        As λ of the module's text, with the fitted noise as reference.
    """

    basis: np.ndarray
    eigenvalues: np.ndarray

    @classmethod
    def of(cls, matrix: np.ndarray, noise: float, known: Weights | None) -> _Diagonal:
        """``known`` None is an identity."""
        precision = matrix / noise
        if known is None:
            diagonal_of(precision)[...] += 1.0
        else:
            precision += known.precision
        root_inv = triangular_inverse(jittered_cholesky(precision))
        beside = root_inv if known is None else root_inv @ known.precision
        eigenvalues, W = eigh(beside @ root_inv.T, overwrite_a=True, check_finite=False)
        return cls(W.T @ root_inv, np.clip(eigenvalues, 0.0, 1.0))


@dataclass(frozen=True)
class _AtRatio:
    """An output at a ratio, with weights in coordinates of a `_Diagonal`.

    Attributes
    ----------
    ratio : float
    beside : Weights or None
        What is known of w beside the output's own data; None is its prior.
    error, variance : ndarray of shape (n,)
        Of the rows, but for the weights; the variance in units of σ².
    eigenvalues : ndarray of shape (p,)
    coordinates : ndarray of shape (n, p)
        Of the rows.
    told, known : ndarray of shape (p,)
        The linear terms, of the output's own data in units of σ⁻², and of what is known beside.
    less : ndarray of shape (m, p), optional
        U: the precision is the diagonal one minus σ⁻² Uᵀ U.
    """

    ratio: float
    beside: Weights | None
    error: np.ndarray
    variance: np.ndarray
    eigenvalues: np.ndarray
    coordinates: np.ndarray
    told: np.ndarray
    known: np.ndarray
    less: np.ndarray | None = None

    def of_weights(self, noise: np.ndarray, fitted: float) -> tuple[np.ndarray, np.ndarray]:
        """What w adds to mean and variance (n, g) of the rows for noise variances (g,)."""
        eigenvalues = self.eigenvalues[:, np.newaxis]
        precision = eigenvalues + (1.0 - eigenvalues) * (fitted / noise)
        linear = np.outer(self.told, 1.0 / noise) + self.known[:, np.newaxis]
        mean, variance = self.coordinates @ (linear / precision), self.coordinates**2 @ (1.0 / precision)
        if self.less is not None:
            for g in range(len(noise)):
                # (E - σ⁻² Uᵀ U)⁻¹ = E⁻¹ + E⁻¹ Uᵀ (σ² I - U E⁻¹ Uᵀ)⁻¹ U E⁻¹
                scaled = self.less / precision[:, g]
                inner = -(scaled @ self.less.T)
                diagonal_of(inner)[...] += noise[g]
                scaled = triangular_inverse(jittered_cholesky(inner)) @ scaled
                seen = self.coordinates @ scaled.T
                mean[:, g] += seen @ (scaled @ linear[:, g])
                variance[:, g] += np.einsum("nm,nm->n", seen, seen)
        return mean, variance


class LeftOut:
    """One fold of rows and what the other folds say of it.

    Parameters
    ----------
    group : Group
        With the statistics of the other folds.
    family : {"full", "diagonal"}
    rows : SeenRows
        Of the fold.
    """

    def __init__(self, group: Group, family: PosteriorFamily, rows: SeenRows):
        self.group, self.rows, statistics = group, rows, group.statistics
        self._ratio = float(np.max(group.signal / group.noise))
        B = self._ratio * statistics.VV
        diagonal_of(B)[...] += 1.0
        root_inv = triangular_inverse(jittered_cholesky(B))
        eigenvalues, U = eigh(root_inv @ root_inv.T, overwrite_a=True, check_finite=False)
        self._eigenvalues = np.clip(eigenvalues, 0.0, 1.0)
        basis = U.T @ root_inv
        self._Z, self._X, self._T = rows.V @ basis.T, basis @ statistics.VH, basis @ statistics.VR
        # Of both families: squares, and precisions as at_zero + ρ slope.
        self._squares, self._at_zero = self._Z**2, self._eigenvalues
        self._slope = (1.0 - self._eigenvalues) / self._ratio
        self._is_diagonal = family == "diagonal"
        if self._is_diagonal:
            L_inv = group.whitening.L_inv
            self._squares, self._at_zero = (rows.V @ L_inv) ** 2, np.einsum("ji,ji->i", L_inv, L_inv)
            self._slope = np.einsum("ji,jk,ki->i", L_inv, statistics.VV, L_inv, optimize=True)
        # Only the last ratio of each output is kept: each has a matrix (n, p).
        self._last: dict[int, _AtRatio] = {}
        self._without: dict[int, tuple[Weights | None, _Diagonal]] = {}

    def says(self, output: int) -> Weights:
        """What the other folds say of w through an output as it was fitted."""
        noise = self.group.noise[output]
        factor = self._factor(float(self.group.signal[output] / noise))
        told = self._times_root(output, self._told(output, factor))
        return Weights(self._within_root(output, self._unexplained(factor)) / noise, told / noise)

    def predicted(
        self, output: int, ratio: float, noise: np.ndarray, known: Weights | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Errors and variances of y, each (n, g) or (n, 1), for a ratio and noise variances (g,).

        ``known`` is what is known of w beside the output's own data; None is its prior.
        """
        at = self._last.get(output)
        if at is None or at.ratio != ratio or at.beside is not known:
            at = self._last[output] = self._at(output, ratio, known)
        error, variance = at.error[:, np.newaxis], np.multiply.outer(at.variance, noise)
        if not len(at.eigenvalues):
            return error, variance
        mean, of_weights = at.of_weights(noise, float(self.group.noise[output]))
        if self._is_diagonal:
            prior = 1.0 if known is None else np.diagonal(known.precision)[:, np.newaxis]
            own = np.diagonal(self._within_root(output, self.group.statistics.HH))[:, np.newaxis]
            of_weights = self._times_root(output, self.rows.features) ** 2 @ (1.0 / (prior + own / noise))
        return error - mean, variance + of_weights

    def _at(self, output: int, ratio: float, known: Weights | None) -> _AtRatio:
        rows, factor, prior = self.rows, self._factor(ratio), self.group.prior
        m, p = self._X.shape
        error = rows.residuals[:, output] - self._Z @ (factor * self._T[:, output])
        # What a jitter leaves unexplained counts too: it keeps the signal from growing without end.
        variance = rows.noise + self._squares @ _divided(ratio, self._at_zero + ratio * self._slope)
        variance += ratio * rows.unexplained
        if p == 0:
            none = np.empty(0)
            return _AtRatio(ratio, known, error, variance, none, np.empty((len(error), 0)), none, none)
        features = rows.features - self._Z @ (factor[:, np.newaxis] * self._X)
        less = None
        if p > _MANY_FEATURES * m:
            diagonal = self._diagonal_without(output, known)
            less = self._times_root(output, np.sqrt(factor)[:, np.newaxis] * self._X) @ diagonal.basis.T
        else:
            matrix = self._within_root(output, self._unexplained(factor))
            diagonal = _Diagonal.of(matrix, self.group.noise[output], known)
        return _AtRatio(
            ratio,
            known,
            error,
            variance,
            diagonal.eigenvalues,
            self._times_root(output, features) @ diagonal.basis.T,
            diagonal.basis @ self._times_root(output, self._told(output, factor)),
            diagonal.basis @ (-prior.reference[output] if known is None else known.linear),
            less,
        )

    def _diagonal_without(self, output: int, known: Weights | None) -> _Diagonal:
        """Of w without a Gaussian process."""
        beside, diagonal = self._without.get(output, (None, None))
        if diagonal is None or beside is not known:
            matrix = self._within_root(output, self.group.statistics.HH)
            diagonal = _Diagonal.of(matrix, self.group.noise[output], known)
            self._without[output] = known, diagonal
        return diagonal

    def _factor(self, ratio: float) -> np.ndarray:
        """ρ D⁻¹."""
        return _divided(ratio, self._eigenvalues + (ratio / self._ratio) * (1.0 - self._eigenvalues))

    def _unexplained(self, factor: np.ndarray) -> np.ndarray:
        """M (p, p), with ``factor`` = ρ D⁻¹."""
        return self.group.statistics.HH - self._X.T @ (factor[:, np.newaxis] * self._X)

    def _told(self, output: int, factor: np.ndarray) -> np.ndarray:
        """Hᵀr - ρ Xᵀ D⁻¹ t (p,) of an output."""
        return self.group.statistics.HR[:, output] - self._X.T @ (factor * self._T[:, output])

    def _times_root(self, output: int, values: np.ndarray) -> np.ndarray:
        """Rows (..., p) times C of an output."""
        prior = self.group.prior
        return values * prior.scale[output] if prior.root is None else values @ prior.root[output]

    def _within_root(self, output: int, matrix: np.ndarray) -> np.ndarray:
        """Cᵀ A C of a symmetric matrix A."""
        return self._times_root(output, self._times_root(output, matrix).T)


def prior_of(group: Group, output: int) -> Weights:
    """The prior of w."""
    return Weights(np.eye(group.prior.scale.shape[1]), -group.prior.reference[output])


def sums_of_others(each: Sequence[SufficientStatistics]) -> list[SufficientStatistics]:
    """For each entry of two or more the sum of all others.

    Summed, not subtracted from that of all: what only one knows is then exactly unknown without it.
    """
    before, after = list(accumulate(each[:-1])), list(accumulate(reversed(each[1:])))[::-1]
    return [after[0], *map(add, before, after[1:]), before[-1]]


def _divided(ratio: float, D: np.ndarray) -> np.ndarray:
    """ρ D⁻¹: nothing without a signal, where D is rounded to 0 either."""
    return np.divide(ratio, D, out=np.zeros(D.shape), where=D > 0.0)


# --- which rows are left out together ---------------------------------------------------------------------------------

# What few rows tell is told by random folds of no fewer rows than this, all together.
FEWEST_ROWS = 50
# A standard deviation needs no more than so many rows: of more, so many are drawn to be predicted.
PREDICTED_ROWS = 2000
# Groups of which one has this share of the rows, as one of two has, are no sample of groups, and too few rows are left
# to predict it from. Blocks of consecutive rows are then left out; so much of each at either end, which is like its
# neighbours, is not predicted.
_LARGEST_SHARE, _GAP = 0.5, 0.15
# Along slow directions the square of a step from row to row is this share of that between any two rows, on average. One
# direction may be slow in a sorted table. So many steps are looked at.
_SLOW, _SLOW_DIRECTIONS, _MOST_STEPS = 0.1, 2, 2000
# Directions along which inputs vary less than this, in standard deviations of their columns, say nothing.
_FLAT = 1e-3


@dataclass(frozen=True)
class CrossValidation:
    """How rows are left out.

    Attributes
    ----------
    n_folds : int
        No more than there are rows or groups.
    groups : ndarray of shape (n,), optional
        Which rows are left out together; None: chance says.
    wide : bool, default=True
        Whether nobody set bounds for the signal: it may then leave those of the fit, which keep kernels from becoming
        long waves of huge height. Here the kernel's shape stays.
    """

    n_folds: int
    groups: np.ndarray | None = None
    wide: bool = True

    def folds(self, order: np.ndarray, rng: np.random.RandomState) -> list[Fold]:
        """Folds of all rows; none if these are too few. ``order`` are the rows (n,) as they follow each other."""
        if len(order) < FEWEST_ROWS:
            return []
        if self.groups is None:
            return random_folds(len(order), self.n_folds, rng)
        return folds_of_groups(self.groups, self.n_folds, rng, order)


@dataclass(frozen=True)
class Fold:
    """Rows that are left out together.

    Attributes
    ----------
    rows : ndarray
        By index, in ascending order.
    predicted : ndarray
        Those of them that are predicted, at least one.
    """

    rows: np.ndarray
    predicted: np.ndarray


def random_folds(n_rows: int, n_folds: int, rng: np.random.RandomState) -> list[Fold]:
    """Folds of nearly equal length; as many as there are rows if these are fewer."""
    return _thinned(np.array_split(rng.permutation(n_rows), min(n_folds, n_rows)), rng)


def folds_in_order(order: np.ndarray, n_folds: int, rng: np.random.RandomState, gap: bool = False) -> list[Fold]:
    """Folds of rows that follow each other in an order; perhaps only what is inside of each is predicted."""
    parts = [part for part in np.array_split(order, n_folds) if len(part)]
    ends = [int(_GAP * len(part)) if gap else 0 for part in parts]
    return _thinned(parts, rng, [part[end : len(part) - end] for part, end in zip(parts, ends, strict=True)])


def folds_of_groups(groups: np.ndarray, n_folds: int, rng: np.random.RandomState, order: np.ndarray) -> list[Fold]:
    """Folds of whole groups, of nearly equal numbers of rows.

    Parameters
    ----------
    groups : ndarray of shape (n,)
        To which group each row belongs.
    n_folds : int
    rng : RandomState
    order : ndarray of shape (n,)
        The rows as they follow each other, by which a group is cut where it must be.
    """
    names, own, sizes = np.unique(groups, return_inverse=True, return_counts=True)
    if sizes.max() >= _LARGEST_SHARE * len(groups):
        return folds_in_order(order[np.argsort(own[order], kind="stable")], n_folds, rng, gap=True)
    n_folds = min(n_folds, len(names))
    # The largest first, each to the fold that has least; which of equal ones comes first is left to chance.
    shuffled = rng.permutation(len(names))
    fold_of, load = np.empty(len(names), dtype=int), np.zeros(n_folds)
    for group in shuffled[np.argsort(-sizes[shuffled], kind="stable")]:
        fold_of[group] = np.argmin(load)
        load[fold_of[group]] += sizes[group]
    folds = fold_of[own]
    return _thinned([np.flatnonzero(folds == fold) for fold in range(n_folds)], rng)


def _thinned(parts: list[np.ndarray], rng: np.random.RandomState, inner: list[np.ndarray] | None = None) -> list[Fold]:
    """Folds of these rows; of ``inner`` no more than `PREDICTED_ROWS` are predicted, an equal share of each."""
    inner = parts if inner is None else inner
    share = min(1.0, PREDICTED_ROWS / sum(map(len, inner)))
    folds = []
    for rows, own in zip(parts, inner, strict=True):
        if share < 1.0:
            own = rng.permutation(own)[: max(round(share * len(own)), 1)]
        folds.append(Fold(np.sort(rows), np.sort(own)))
    return folds


def follow_a_path(order: np.ndarray, inputs: Callable[[np.ndarray], np.ndarray]) -> bool:
    """Whether rows that follow each other are near each other, as in a trajectory and not as in a sorted table.

    Parameters
    ----------
    order : ndarray of shape (n,)
        The rows as they follow each other.
    inputs : callable
        Of rows by index, (n, ...).
    """
    first = np.unique(np.linspace(0, len(order) - 2, min(len(order) - 1, _MOST_STEPS)).astype(int))
    here, there = (inputs(order[rows]).reshape(len(rows), -1) for rows in (first, first + 1))
    scale = here.std(axis=0)
    here, there, scale = here[:, scale > 0.0], there[:, scale > 0.0], scale[scale > 0.0]
    steps = (there - here) / scale
    if steps.shape[1] < _SLOW_DIRECTIONS or (steps >= 0.0).all(axis=0).any() or (steps <= 0.0).all(axis=0).any():
        return False
    _, sizes, directions = np.linalg.svd((here - here.mean(axis=0)) / scale / np.sqrt(len(here)), full_matrices=False)
    kept = sizes > _FLAT
    along = steps @ (directions[kept].T / sizes[kept])
    shares = np.linalg.eigvalsh(along.T @ along / (2.0 * len(along)))
    return bool(np.sum(shares < _SLOW) >= _SLOW_DIRECTIONS)
