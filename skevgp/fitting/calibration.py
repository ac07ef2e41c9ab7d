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
from dataclasses import dataclass, fields, replace
from itertools import accumulate
from operator import add
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.stats import norm
from scipy.stats import t as student_t

from ..data.blocks import AnyBlock
from ..data.rows import Rows
from ..model.bounds import Group, PosteriorFamily, bounds_at_optimum
from ..model.model import SparseModel
from ..model.parameters import Parameter, ParameterTable, Values
from ..model.statistics import SufficientStatistics, Whitening, collect
from ..utils.linalg import NotPositiveDefiniteError, diagonal_of, jittered_cholesky, triangular_inverse

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
class Calibrated:
    """Signal and noise variances (o,) after calibration."""

    signal: np.ndarray
    noise: np.ndarray
    # Number of outputs of which nothing holds for held-out groups.
    gone: int = 0
    # Whether neighbouring rows are alike.
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
) -> Calibrated:
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
    found = list(rows.threads(VarianceSearch.best, searches))
    gone, dependent, still = 0, False, rows.is_constant()
    if by.groups is not None:
        free = variances(table["signal"], at_bound, s_low, s_high)
        explained = (values["noise"] < (1.0 - _EXPLAINED) * rows.scatter()) & ~still
        groups = [by.groups[fold.predicted] for fold in folds]
        for o, own in enumerate(searches):
            little = own.without_signal() - _GAIN
            if own.loss(*found[o]) > little:
                # All of the signal does not hold for held-out groups. A part of it may.
                own = replace(own, signal=free[o])
                found[o] = own.best()
                gone += int(explained[o] and own.loss(*found[o]) > little)
            factor = own.in_doubt(*found[o], groups)
            found[o] = own.signal.clip(factor * found[o][0]), own.noise.clip(factor * found[o][1])
    elif table["noise"].free.any() and len(rows) >= _FEWEST_DEPENDENT:
        fixed = [Variance(value, value, value) for value in at_bound.tolist()]
        others = variances(table["noise"], values["noise"], np.maximum(low, np.minimum(left_over, high)), high)
        in_blocks = folds_in_order(rows.user_order(), by.n_folds, rng)
        blocks = _searches(model, values, in_blocks, rows, fixed, others)
        random = [replace(own, signal=s2, noise=n2) for own, s2, n2 in zip(searches, fixed, others, strict=True)]
        dependent = _dependent(rows, searches, found, blocks, random)
    # Held-out rows of an output that does not vary say nothing about its variances.
    at_start = np.column_stack([at_bound, values["noise"]])
    signal, noise = np.where(still[:, np.newaxis], at_start, found).T
    return Calibrated(signal, noise, gone, dependent)


def _dependent(
    rows: Rows,
    searches: list[VarianceSearch],
    found: list[tuple[float, float]],
    blocks: list[VarianceSearch],
    random: list[VarianceSearch],
) -> bool:
    """Whether blocks of consecutive rows are predicted worse than random folds: neighbouring rows are then alike."""
    worse = [block.loss(*best) - own.loss(*best) for block, own, best in zip(blocks, searches, found, strict=True)]
    if max(worse) > _WORSE and follow_a_path(rows.user_order(), lambda some: rows.some(some).inputs):
        return True
    by_blocks, by_chance = (
        np.array([noise for _, noise in rows.threads(VarianceSearch.best, own)]) for own in (blocks, random)
    )
    return bool((by_blocks > _DEPENDENT * by_chance).any())


def _left_over(model: SparseModel, values: Values, statistics: list[SufficientStatistics]) -> np.ndarray:
    """Squared error (o,) on the training rows, per degree of freedom."""
    found = np.empty(len(values["noise"]))
    for bound in bounds_at_optimum(model.groups_of(values, statistics), model.family):
        group = bound.group
        n_rows = group.statistics.n_rows
        # Rows less the trace of I - B⁻¹, the number of weights that they determine.
        freedom = [n_rows - len(q.B) + np.vdot(q.root_inv, q.root_inv) for q in bound.posteriors]
        if group.prior.shared:
            # Other outputs determine the weights too. What this output adds is the trace of σ⁻² PᵀP B⁻¹.
            for o, q in enumerate(bound.posteriors):
                own = q.root_inv @ group.products(o)[0] @ q.root_inv.T
                freedom[o] = n_rows - own.trace() / group.noise[o]
        found[group.outputs] = bound.residuals().squares / np.maximum(freedom, 1e-6 * n_rows)
    return found


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
    each = []
    for outputs, whitening in zip(model.groups, model.whitenings(values), strict=True):
        of_others = sums_of_others([collect(fold, whitening, outputs) for fold in all_of])
        seen = [fold.sum(Seen(whitening, outputs)) for fold in predicted]
        groups = [model.group(values, outputs, whitening, others) for others in of_others]
        each.append([LeftOut(group, model.family, own) for group, own in zip(groups, seen, strict=True)])
    known: list[list[Weights | None]] = [[None] * len(folds)] * len(values["noise"])
    if model.prior.shared:
        known = _known_elsewhere(each)
    outputs_of = [(group, index) for group in each for index in range(len(group[0].group.noise))]
    return [
        VarianceSearch(index, group, of_weights, signal, noise)
        for (group, index), of_weights, signal, noise in zip(outputs_of, known, signals, noises, strict=True)
    ]


def _known_elsewhere(groups: Sequence[Sequence[LeftOut]]) -> list[list[Weights | None]]:
    """For each output and fold, the knowledge of the weights from their prior and the other outputs as fitted."""
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


# --- the search for the signal and noise variances of an output -------------------------------------------------------

# Replaces squares that vanish.
_LOWEST = 1e-20
# Ratios s²/σ² are powers of 2. First these exponents are tried around the start, then steps of these sizes, and never
# more than so many doublings from the start.
_LOOK, _STEPS, _FARTHEST = (-6, 0, 6), (3.0, 1.0, 0.25), 36
# Weight of the logarithm of the root mean square error next to the log density. The density alone hardly depends on the
# mean of rows that are uncertain anyway.
_SQUARES = 0.5
# With few groups, the share of errors of a new one that lie within 2 standard deviations, and the fewest degrees of
# freedom that are assumed.
_INSIDE, _FEWEST_DEGREES = 0.97725, 3.0
# Factors on the noise variance that are tried for a ratio.
_NOISES = 2.0 ** np.arange(-3.0, 3.25, 0.5)


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
        signal, noise = self._along_ratios()
        if self.signal.low == self.signal.high or not np.isclose(signal, self.signal[1:]).any():
            return signal, noise
        # The signal ended at a limit. It stays there, and the noise is searched alone.
        return replace(self, signal=Variance(signal, signal, signal))._along_ratios()

    def loss(self, signal: float, noise: float) -> float:
        """Minus the mean log density of the held-out rows, without its constant."""
        return float(self._means(signal / noise, np.array([noise]))[0][0])

    def without_signal(self) -> float:
        """The same loss for the features alone, with a noise variance equal to their mean squared error."""
        squares = self._means(0.0, np.array([self.noise.at_bound]))[1]
        return self.loss(0.0, max(float(squares[0]), _LOWEST))

    def in_doubt(self, signal: float, noise: float, groups: Sequence[np.ndarray]) -> float:
        """The factor by which variances grow because there are few groups. ``groups`` has labels (n,) for each fold."""
        # The root mean square of a group's errors over std is one observation of the scale of std. Their mean leaves
        # ν = 1 / (2 variance) degrees of freedom. Errors of a new group then follow Student's t distribution.
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

    def _along_ratios(self) -> tuple[float, float]:
        """Search the ratio s²/σ² by steps that shrink, and the noise variance for each ratio."""
        (s2, s_low, s_high), (n2, low, high) = self.signal, self.noise
        if s_low == s_high and low == high:
            return s_low, low
        # The maximum of the bound may be far outside of the limits.
        begin = float(np.clip(np.round(np.log2(s2 / n2)), np.log2(s_low / high), np.log2(s_high / low)))
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
            return s2, n2
        # The minimum of the parabola through the losses at the last three ratios.
        step, nothing, shift = _STEPS[-1], (np.inf, np.nan), 0.0
        (here, noise), (before, noise_before), (after, noise_after) = (
            tried.get(best + side * step, nothing) for side in (0, -1, 1)
        )
        if np.isfinite(before + after):
            shift = _vertex(before, here, after)
            noise *= (noise_after / noise if shift > 0.0 else noise / noise_before) ** shift
        ratio = 2.0 ** (best + step * shift)
        if low == high:
            noise = low
        signal = ratio * noise
        if s_low == s_high:
            signal, noise = s_low, s_low / ratio
        return self.signal.clip(signal), self.noise.clip(noise)

    def _at_ratio(self, ratio: float) -> tuple[float, float]:
        """The lowest loss at a ratio s²/σ², and the noise variance there."""
        (_, s_low, s_high), (at_bound, low, high) = self.signal, self.noise
        # A fixed signal or noise is met to rounding.
        low, high = max(low, s_low / ratio * (1.0 - 1e-9)), min(high, s_high / ratio * (1.0 + 1e-9))
        if low > high:
            return np.inf, np.nan
        if high < low * 1.01:
            middle = np.array([np.sqrt(low * high)])
            return float(self._losses(ratio, middle)[0]), float(middle[0])
        noise = np.clip(at_bound, low, high)
        # If variances were proportional to the noise, this would make squared errors as large as variances.
        for _ in range(2):
            excess = float(self._means(ratio, np.array([noise]))[2][0])
            noise = np.clip(noise * max(excess, 1e-12), low, high)
        grid = np.clip(noise * _NOISES, low, high)
        losses = self._losses(ratio, grid)
        best = int(np.argmin(losses))
        if not 0 < best < len(grid) - 1 or not grid[best - 1] < grid[best] < grid[best + 1]:
            return float(losses[best]), float(grid[best])
        shift = _vertex(*losses[best - 1 : best + 2])
        noise = grid[best] * (_NOISES[1] / _NOISES[0]) ** shift
        return float(losses[best] + 0.25 * shift * (losses[best + 1] - losses[best - 1])), float(noise)

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


def _vertex(before: float, here: float, after: float) -> float:
    """Where a parabola through three points one step apart is lowest, in steps from the middle one, the lowest."""
    curvature = before - 2.0 * here + after
    return 0.0 if curvature <= 0.0 else float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))


# --- held-out rows as the other rows predict them, for any signal and noise variance ----------------------------------

# No ratio or noise variance needs a pass over the rows.
#
# For an output let ρ = s²/σ². In the whitened coordinates of `model.bounds`, with β = μ_β + C (w₀ + w), the precision
# of v given w is I + ρ V Vᵀ, (m, m). Let I + ρ₀ V Vᵀ = L Lᵀ at one ratio ρ₀, and let λ and U be the eigenvalues and
# eigenvectors of L⁻¹ L⁻ᵀ. Then
#
#     I + ρ V Vᵀ = L U D Uᵀ Lᵀ,   D = diag(λ + (ρ/ρ₀) (1 - λ)),
#
# which is diagonal for all ρ in the coordinates z = Uᵀ L⁻¹ v(x) of a row. With X = Uᵀ L⁻¹ V H, (m, p), and
# t = Uᵀ L⁻¹ V r, (m,), matrices of size p remain for w:
#
#     precision of w: I + σ⁻² Cᵀ M C,   M = HᵀH - ρ Xᵀ D⁻¹ X,   its linear term: σ⁻² Cᵀ (Hᵀr - ρ Xᵀ D⁻¹ t) - w₀.
#
# The prediction of a row is
#
#     mean: ρ zᵀ D⁻¹ t + a(x)ᵀ C w,   variance: σ² (1 + ρ (zᵀ D⁻¹ z + k̃(x, x) - |v|²)) + a(x)ᵀ C Cov[w] Cᵀ a(x),
#
# with a = h - ρ Xᵀ D⁻¹ z, the part of the features that the Gaussian process does not explain. All of this but C is the
# same for the outputs of a group. The same method makes the precision of w diagonal for all σ². With many more
# features than inducing points, I + σ⁻² Cᵀ HᵀH C is made diagonal once for all ρ, and the points change it by a matrix
# of rank m. If outputs share w, the knowledge from the other outputs replaces its prior.

# With this many times more features than inducing points, w is made diagonal once.
_MANY_FEATURES = 4


@dataclass(frozen=True)
class SeenRows:
    """Rows as a set of inducing points and its outputs see them. ``+`` joins the rows of two."""

    # (n, m) and (n,): v, and k(x, x) - |v|².
    V: np.ndarray
    unexplained: np.ndarray
    # (n, p) and (n, o).
    features: np.ndarray
    residuals: np.ndarray
    # (n,): the noise variance of each row over σ², and its weight.
    noise: np.ndarray
    counts: np.ndarray

    def __add__(self, other: SeenRows) -> SeenRows:
        each = (np.concatenate([getattr(self, field.name), getattr(other, field.name)]) for field in fields(self))
        return SeenRows(*each)


@dataclass(frozen=True)
class Seen:
    """The function block -> `SeenRows`."""

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
    """Knowledge of w: its precision (p, p), and the precision times the mean (p,). ``+`` joins the knowledge of two."""

    precision: np.ndarray
    linear: np.ndarray

    def __add__(self, other: Weights) -> Weights:
        return Weights(self.precision + other.precision, self.linear + other.linear)


@dataclass(frozen=True)
class _Diagonal:
    """Coordinates of w in which known + σ⁻² A is diagonal for all σ²."""

    # (p, p).
    basis: np.ndarray
    # (p,): as λ above, with the fitted noise in the role of ρ₀.
    eigenvalues: np.ndarray

    @classmethod
    def of(cls, matrix: np.ndarray, noise: float, known: Weights | None) -> _Diagonal:
        """The coordinates for a matrix A (p, p), the fitted noise variance, and known weights (None: I)."""
        precision = matrix / noise
        if known is None:
            diagonal_of(precision)[...] += 1.0
        else:
            precision += known.precision
        root_inv = triangular_inverse(jittered_cholesky(precision))
        from_elsewhere = root_inv if known is None else root_inv @ known.precision
        eigenvalues, W = eigh(from_elsewhere @ root_inv.T, overwrite_a=True, check_finite=False)
        return cls(W.T @ root_inv, np.clip(eigenvalues, 0.0, 1.0))


@dataclass(frozen=True)
class _AtRatio:
    """An output at one ratio ρ, for all σ²."""

    ratio: float
    # Knowledge of w from elsewhere. None: its prior.
    known: Weights | None
    # (n,): of the rows, without the part of w. The variance is in units of σ².
    error: np.ndarray
    variance: np.ndarray
    # (p,) and (n, p): λ of a `_Diagonal`, and the rows in its coordinates.
    eigenvalues: np.ndarray
    coordinates: np.ndarray
    # (p,): linear terms of w, from the output's own data in units of σ⁻², and from elsewhere.
    told: np.ndarray
    linear: np.ndarray
    # (m, p): U, where the precision is the diagonal one minus σ⁻² UᵀU.
    less: np.ndarray | None = None

    def of_weights(self, noise: np.ndarray, fitted: float) -> tuple[np.ndarray, np.ndarray]:
        """The part of w in mean and variance (n, g) of the rows, for noise variances (g,)."""
        eigenvalues = self.eigenvalues[:, np.newaxis]
        precision = eigenvalues + (1.0 - eigenvalues) * (fitted / noise)
        linear = np.outer(self.told, 1.0 / noise) + self.linear[:, np.newaxis]
        mean, variance = self.coordinates @ (linear / precision), self.coordinates**2 @ (1.0 / precision)
        if self.less is not None:
            for g in range(len(noise)):
                # (E - σ⁻² UᵀU)⁻¹ = E⁻¹ + E⁻¹ Uᵀ (σ² I - U E⁻¹ Uᵀ)⁻¹ U E⁻¹
                scaled = self.less / precision[:, g]
                inner = -(scaled @ self.less.T)
                diagonal_of(inner)[...] += noise[g]
                scaled = triangular_inverse(jittered_cholesky(inner)) @ scaled
                seen = self.coordinates @ scaled.T
                mean[:, g] += seen @ (scaled @ linear[:, g])
                variance[:, g] += np.einsum("nm,nm->n", seen, seen)
        return mean, variance


class LeftOut:
    """The held-out rows of one fold, and their prediction from the statistics of the other folds (in ``group``)."""

    def __init__(self, group: Group, family: PosteriorFamily, rows: SeenRows):
        self.group, self.rows, statistics = group, rows, group.statistics
        # ρ₀.
        self._ratio = float(np.max(group.signal / group.noise))
        B = self._ratio * statistics.VV
        diagonal_of(B)[...] += 1.0
        root_inv = triangular_inverse(jittered_cholesky(B))
        eigenvalues, U = eigh(root_inv @ root_inv.T, overwrite_a=True, check_finite=False)
        self._eigenvalues = np.clip(eigenvalues, 0.0, 1.0)
        basis = U.T @ root_inv
        # (n, m), (m, p) and (m, o): z of each row, X and t.
        self._Z, self._X, self._T = rows.V @ basis.T, basis @ statistics.VH, basis @ statistics.VR
        # Both families: squared coordinates (n, m), and their precisions (m,) as at_zero + ρ slope.
        self._squares, self._at_zero = self._Z**2, self._eigenvalues
        self._slope = (1.0 - self._eigenvalues) / self._ratio
        self._is_diagonal = family == "diagonal"
        if self._is_diagonal:
            L_inv = group.whitening.L_inv
            self._squares, self._at_zero = (rows.V @ L_inv) ** 2, np.einsum("ji,ji->i", L_inv, L_inv)
            self._slope = np.einsum("ji,jk,ki->i", L_inv, statistics.VV, L_inv, optimize=True)
        # Only the last ratio of each output is kept, since each has a matrix (n, p).
        self._last: dict[int, _AtRatio] = {}
        self._without: dict[int, tuple[Weights | None, _Diagonal]] = {}

    def says(self, output: int) -> Weights:
        """The knowledge of w that the other folds give through an output as it was fitted."""
        noise = self.group.noise[output]
        factor = self._factor(float(self.group.signal[output] / noise))
        told = self._times_root(output, self._told(output, factor))
        return Weights(self._within_root(output, self._unexplained(factor)) / noise, told / noise)

    def predicted(
        self, output: int, ratio: float, noise: np.ndarray, known: Weights | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Errors and variances of y, each (n, g) or (n, 1), for a ratio and noise variances (g,)."""
        at = self._last.get(output)
        if at is None or at.ratio != ratio or at.known is not known:
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
        """An output at a ratio."""
        rows, factor, prior = self.rows, self._factor(ratio), self.group.prior
        m, p = self._X.shape
        error = rows.residuals[:, output] - self._Z @ (factor * self._T[:, output])
        # The variance that a jitter leaves unexplained counts too: it keeps the signal from growing without end.
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
        """The coordinates of w for a model without a Gaussian process."""
        before, diagonal = self._without.get(output, (None, None))
        if diagonal is None or before is not known:
            matrix = self._within_root(output, self.group.statistics.HH)
            diagonal = _Diagonal.of(matrix, self.group.noise[output], known)
            self._without[output] = known, diagonal
        return diagonal

    def _factor(self, ratio: float) -> np.ndarray:
        """The diagonal (m,) of ρ D⁻¹."""
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
    """For each of two or more folds, the sum over all others."""
    # They are summed, not subtracted from the sum of all: what only one fold knows is then exactly unknown without it.
    before, after = list(accumulate(each[:-1])), list(accumulate(reversed(each[1:])))[::-1]
    return [after[0], *map(add, before, after[1:]), before[-1]]


def _divided(ratio: float, D: np.ndarray) -> np.ndarray:
    """ρ D⁻¹. It is 0 without a signal, even where D was rounded to 0."""
    return np.divide(ratio, D, out=np.zeros(D.shape), where=D > 0.0)


# --- folds ------------------------------------------------------------------------------------------------------------

# Fewer rows than this are not calibrated.
FEWEST_ROWS = 50
# At most this many rows are predicted in all, drawn at random. More do not improve a standard deviation.
PREDICTED_ROWS = 2000
# If one group has this share of the rows (one of two has), there are too few others to predict it from. Then blocks of
# consecutive rows are held out. This share of a block at either end is close to its neighbours and is not predicted.
_LARGEST_SHARE, _GAP = 0.5, 0.15
# Along a slow direction, the mean squared step from row to row is less than this share of the mean squared distance of
# any two rows. A sorted table may have one slow direction. No more steps than this are used.
_SLOW, _SLOW_DIRECTIONS, _MOST_STEPS = 0.1, 2, 2000
# Directions in which inputs vary less than this, in standard deviations of their columns, do not count.
_FLAT = 1e-3


@dataclass(frozen=True)
class CrossValidation:
    """How rows are held out."""

    # At most as many as there are rows or groups.
    n_folds: int
    # (n,): rows with the same label are held out together. None: random folds.
    groups: np.ndarray | None = None
    # Whether the signal may leave the limits of the fit, because the user gave none. Those keep kernels from becoming
    # long waves of huge height. Here the shape of the kernel is fixed.
    wide: bool = True

    def folds(self, order: np.ndarray, rng: np.random.RandomState) -> list[Fold]:
        """Folds of all rows, or none if there are too few. ``order`` (n,) are the rows in the user's order."""
        if len(order) < FEWEST_ROWS:
            return []
        if self.groups is None:
            return random_folds(len(order), self.n_folds, rng)
        return folds_of_groups(self.groups, self.n_folds, rng, order)


@dataclass(frozen=True)
class Fold:
    """Rows that are held out together, by index in ascending order, and those of them that are predicted."""

    rows: np.ndarray
    predicted: np.ndarray


def random_folds(n_rows: int, n_folds: int, rng: np.random.RandomState) -> list[Fold]:
    """Folds of nearly equal length, at most one per row."""
    return _thinned(np.array_split(rng.permutation(n_rows), min(n_folds, n_rows)), rng)


def folds_in_order(order: np.ndarray, n_folds: int, rng: np.random.RandomState, gap: bool = False) -> list[Fold]:
    """Folds of consecutive rows. With a gap, the ends of each are not predicted."""
    parts = [part for part in np.array_split(order, n_folds) if len(part)]
    ends = [int(_GAP * len(part)) if gap else 0 for part in parts]
    return _thinned(parts, rng, [part[end : len(part) - end] for part, end in zip(parts, ends, strict=True)])


def folds_of_groups(groups: np.ndarray, n_folds: int, rng: np.random.RandomState, order: np.ndarray) -> list[Fold]:
    """Folds of whole groups, of nearly equal numbers of rows. A group that is too large is cut by ``order`` (n,)."""
    names, own, sizes = np.unique(groups, return_inverse=True, return_counts=True)
    if sizes.max() >= _LARGEST_SHARE * len(groups):
        return folds_in_order(order[np.argsort(own[order], kind="stable")], n_folds, rng, gap=True)
    n_folds = min(n_folds, len(names))
    # The largest group first, each to the fold with the fewest rows. Equal ones come in random order.
    shuffled = rng.permutation(len(names))
    fold_of, load = np.empty(len(names), dtype=int), np.zeros(n_folds)
    for group in shuffled[np.argsort(-sizes[shuffled], kind="stable")]:
        fold_of[group] = np.argmin(load)
        load[fold_of[group]] += sizes[group]
    folds = fold_of[own]
    return _thinned([np.flatnonzero(folds == fold) for fold in range(n_folds)], rng)


def _thinned(parts: list[np.ndarray], rng: np.random.RandomState, inner: list[np.ndarray] | None = None) -> list[Fold]:
    """Folds of these rows. Of ``inner``, at most `PREDICTED_ROWS` in all are predicted, an equal share of each."""
    inner = parts if inner is None else inner
    share = min(1.0, PREDICTED_ROWS / sum(map(len, inner)))
    folds = []
    for rows, own in zip(parts, inner, strict=True):
        if share < 1.0:
            own = rng.permutation(own)[: max(round(share * len(own)), 1)]
        folds.append(Fold(np.sort(rows), np.sort(own)))
    return folds


def follow_a_path(order: np.ndarray, inputs: Callable[[np.ndarray], np.ndarray]) -> bool:
    """Whether consecutive rows are close to each other as in a trajectory, and not as in a sorted table.

    ``order`` (n,) are the rows in the user's order. ``inputs`` returns rows (n, ...) by index.
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
