"""Fits with heavy-tailed noise: fits of the model, and estimates of the noise of each row, alternate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import t as student_t

from ..data.rows import LocalSource, RawRows, Rows
from ..model.model import SparseModel
from ..model.parameters import Values
from ..model.predictor import Predictor
from ..noise.base import RowScales
from .model import ENOUGH, LEAST_TOL, Model
from .robust import Neighbours, ordinary_variance
from .search import Fit, Start, better, search

if TYPE_CHECKING:
    from .fit import FittedModel

# The first scales come from a fit of so many iterations to so many rows, or so many per inducing point.
_LOOK_ITERATIONS, _LOOK_ROWS, _LOOK_ROWS_PER_POINT = 30, 2000, 10
# The median of the square of a standard normal number.
_MEDIAN_SQUARE = 0.4549
# If more than this share of the rows seem to be outliers, the first scales are all 1.
_FEW = 0.2
# Share of the iterations before scales are estimated again, and then the number of iterations between estimates.
_BEFORE, _BETWEEN = 2.0 / 3.0, 50
# Scales and q alternate until no E[τ] changes by more than this share, or so many times.
_SETTLED, _TURNS = 0.05, 5
# Smaller E[τ] are all alike.
_LEAST_SCALE = 1e-200
# The weight of an outlier in fits of kernel and noise. (It must not be 0.)
_NOTHING = 1e-9
# Short fits are repeated until the set of outliers stays, or so many times.
_LOOKS = 5
# The fit ends when the gain between two estimates is less than so many times the tolerance of L-BFGS.
_PATIENCE = 3.0
# Rows with larger errors than so many standard deviations of the others do not count for the noise of y.
_FAR = 6.0
# In the first short fit, which outliers may pull, rows count as outliers from so many standard deviations.
_FAR_FROM_MEDIAN = 3.0
# Outliers follow a Student-t with so many degrees of freedom, that is so many times as wide as the noise.
_OUTLIER_DEGREES, _OUTLIER_WIDTH = 4.0, 30.0
# Of 15 % of outliers at random places, 3 % are next to each other. A larger share than this is no chance.
_TOGETHER = 0.2
# Fewer rows than this do not show which share of them is far off.
_FEWEST_ROWS = 20
# Number of rows that are predicted at once.
_ROWS_AT_ONCE = 4096


@dataclass(frozen=True)
class RowDoubts:
    """The noise scale of each row."""

    # q(τ) of each row.
    scales: RowScales
    # (o,): the noise variance of rows that are not outliers, in units of σ².
    noise_factor: np.ndarray
    # (n,): rows with errors that are too large for the noise, whatever its model. None: no row.
    rejected: np.ndarray | None = None
    # Share of the rows with errors far from the median error.
    far: float = 0.0

    def __getstate__(self) -> dict[str, Any]:
        # Copies and pickles of a model hold no rows.
        return {**vars(self), "rejected": None}

    def seen_in(self, look: Look, noise: np.ndarray, free: np.ndarray) -> RowDoubts:
        """The doubts for other errors, with noise variances (o,), of which some may be ``free`` (o,)."""
        scales = self.scales.at(look.distances(noise))
        rejected = (scales.outlier > 0.5) | look.beyond(noise * self.noise_factor)
        factor = np.where(free, look.clean_variance(rejected) / noise, 1.0)
        return RowDoubts(scales, factor, rejected if 0.0 < rejected.mean() <= _FEW else None)

    def weigh(self, rows: Rows) -> Rows:
        """The rows weighted by their noise scales."""
        return replace(rows, source=_local(rows).reweighted(self.scales.mean, self.scales.log_variance))

    def without_outliers(self, rows: Rows) -> Rows:
        """The same rows, with rejected ones that have almost no weight, for a fit of kernel and noise."""
        # A far outlier adds (ν + o) σ² to the sum of E[τ] times squared errors, where another row adds o σ². One in ten
        # rows would raise σ² by half and more, and with it the distance at which a row is an outlier.
        return rows if self.rejected is None else _without(rows, self.rejected)

    def precision(self, sparse: SparseModel, noise: np.ndarray) -> np.ndarray | None:
        """E[τ]/σ² (o, n) of each output and row, if the bound is the tight one."""
        return self.scales.mean / noise[:, np.newaxis] if sparse.tight else None

    def told(self, fitted: FittedModel) -> FittedModel:
        """A fitted model with the noise variance of rows that are not outliers. No upper bound is known."""
        predictor = replace(fitted.predictor, noise=fitted.values["noise"] * self.noise_factor)
        return replace(fitted, known_upper_bound=np.inf, predictor=predictor)

    def updated(self, fitted: FittedModel, rows: Rows) -> FittedModel:
        """A fitted model with new rows, whose noise scales and q alternate. The scales of earlier rows stay.

        The first scales come from the predictions before the update.
        """
        noise, plain = fitted.values["noise"], replace(fitted, doubts=None)
        look = look_at(rows, of_residuals(fitted.predictor))
        predicted = look.latent + np.multiply.outer(look.variance, noise)
        doubts = replace(self, scales=self.scales.at((look.errors**2 / predicted).sum(axis=1)))
        for _ in range(_TURNS):
            new = plain.updated(doubts.weigh(rows))
            before, look = doubts, look_at(rows, of_residuals(new.predictor), doubts.precision(fitted.sparse, noise))
            doubts = replace(self, scales=self.scales.at(look.distances(noise)))
            if not doubts.differ_from(before):
                break
        return doubts.told(replace(plain.updated(doubts.weigh(rows)), doubts=doubts))

    def rejects_as(self, other: RowDoubts) -> bool:
        """Whether both reject the same rows."""
        if self.rejected is None or other.rejected is None:
            return self.rejected is other.rejected
        return bool((self.rejected == other.rejected).all())

    def differ_from(self, before: RowDoubts) -> bool:
        """Whether the scale of some row has changed."""
        # A far outlier has E[τ] near σ² / error²: only a relative change shows that σ² is still too large.
        now, then = (np.maximum(doubts.scales.mean, _LEAST_SCALE) for doubts in (self, before))
        return bool(np.abs(np.log(now / then)).max() >= _SETTLED)


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
            weighed, settled, now = settle(weighed, fit, rows, doubts)
            moved, fit, doubts = now.differ_from(doubts), settled, now
            if fit.n_iter >= model.max_iter or (fit.converged and not moved):
                break
            until = min(fit.n_iter + _BETWEEN, model.max_iter)
            others = replace(weighed, rows=doubts.without_outliers(weighed.rows))
            bound = others.minimise(Start(fit.values, 0)).bound
            fit = better(replace(fit, bound=bound), others.minimise(Start(fit.values, until, fit)))
            if fit.bound - bound < _PATIENCE * _tolerance(others, fit):
                fit = replace(fit, converged=True, message="")
    # After Ctrl-C, scales are those of an earlier fit. No iteration: only the bound is computed.
    weighed = replace(weighed, rows=doubts.weigh(rows))
    if len(rows) >= _FEWEST_ROWS:
        doubts = replace(doubts, far=look_at(rows, predictor_at(weighed, fit.values)).far_from_median(_FAR).mean())
    return weighed, replace(fit, bound=weighed.minimise(Start(fit.values, 0)).bound), doubts


def _first_doubts(model: Model) -> RowDoubts:
    """Noise scales from short fits to some rows: with outliers from medians, or without any, whichever is likelier."""
    # Medians of neighbours are also wrong where a function is steep, or where few rows see it. So a fit to all rows,
    # whose outliers are those that it shows by itself, is tried too. It is kept if the outliers of the medians are next
    # to each other, as the rows of a bump are.
    rows, size = model.rows, max(_LOOK_ROWS, _LOOK_ROWS_PER_POINT * model.n_inducing)
    chosen = np.arange(len(rows))
    if size < len(rows):
        chosen = np.sort(model.rng.choice(len(rows), size, replace=False))
    short = replace(model, max_iter=min(_LOOK_ITERATIONS, model.max_iter), monitor=model.monitor.silent())
    raw = rows.some(np.arange(len(rows)))
    neighbours = Neighbours.of(raw.inputs)
    robust, from_robust = _robust_doubts(short, rows, chosen, _doubts_of_medians(short, raw, neighbours))
    if robust.rejected is None:
        return robust
    fit = search(replace(short, rows=rows.subset(chosen)))
    look = look_at(rows, predictor_at(short, fit.values))
    plain = _first_of(look, robust.scales)
    if neighbours.together(robust.rejected) > _TOGETHER:
        return plain
    scores = [
        _evidence(short, rows, chosen, doubts, values)
        for doubts, values in ((robust, from_robust), (plain, fit.values))
    ]
    return robust if scores[0] > scores[1] else plain


def _evidence(model: Model, rows: Rows, chosen: np.ndarray, doubts: RowDoubts, values: Values) -> float:
    """The bound of the rows that are not rejected, plus the log density of the others as outliers, in nats."""
    rejected = np.zeros(len(chosen), dtype=bool) if doubts.rejected is None else doubts.rejected[chosen]
    seen = rows.subset(chosen)
    fit = replace(model, rows=_without(seen, rejected)).minimise(Start(values, model.max_iter))
    if not rejected.any():
        return fit.bound
    look = look_at(seen, predictor_at(model, fit.values))
    share, scale = rejected.mean(), _OUTLIER_WIDTH * np.sqrt(fit.values["noise"])
    wide = student_t.logpdf(np.sqrt(look.squares[rejected]) / scale, _OUTLIER_DEGREES) - np.log(scale)
    n_others = len(chosen) - rejected.sum()
    return float(fit.bound + n_others * np.log1p(-share) + rejected.sum() * np.log(share) + wide.sum())


def _robust_doubts(short: Model, rows: Rows, chosen: np.ndarray, doubts: RowDoubts) -> tuple[RowDoubts, Values]:
    """Noise scales that begin with those of the medians of neighbours, and the values of the last short fit."""
    # Many outliers on one side pull a fit towards them, so that it does not show them. Medians of neighbours are not
    # pulled. Without the outliers that they show, a fit shows others (as the C-steps of Rousseeuw & Van Driessen 1999).
    seen = doubts.without_outliers(doubts.weigh(rows))
    values: Values | None = None
    for turn in range(_LOOKS):
        own = replace(short, rows=seen.subset(chosen))
        fit = search(own) if values is None else own.minimise(Start(values, short.max_iter))
        look, values = look_at(rows, predictor_at(own, fit.values)), fit.values
        if turn == 0:
            # The pulled fit shifts the errors of all other rows.
            far = look.far_from_median(_FAR_FROM_MEDIAN)
            seen = _without(doubts.weigh(rows), far & (far.mean() <= _FEW))
        else:
            before, doubts = doubts, _first_of(look, doubts.scales)
            seen = doubts.without_outliers(doubts.weigh(rows))
            if doubts.rejects_as(before):
                break
    assert values is not None
    return doubts, values


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
    if far.mean() > _FEW:
        return RowDoubts(scales.at(np.zeros(len(far))), np.ones(len(typical)))
    return RowDoubts(scales.at(distances), np.ones(len(typical)), far if far.any() else None)


def _without(rows: Rows, outlier: np.ndarray) -> Rows:
    """The same rows, of which some (n,) have almost no weight."""
    return replace(rows, source=_local(rows).repeated(np.where(outlier, _NOTHING, 1.0)))


def _local(rows: Rows) -> LocalSource:
    if not isinstance(rows.source, LocalSource):
        raise TypeError("Rows of Dask arrays cannot be doubted.")
    return rows.source


def settle(model: Model, fit: Fit, rows: Rows, doubts: RowDoubts) -> tuple[Model, Fit, RowDoubts]:
    """Alternate noise scales and q until they converge, with kernel, noise and inducing points fixed.

    ``rows`` are the unweighted rows. Returns the model with rows weighted by the new scales, the fit with its bound,
    and the scales.
    """
    noise = fit.values["noise"]
    for _ in range(_TURNS):
        look = look_at(rows, predictor_at(model, fit.values), doubts.precision(model.sparse, noise))
        before, doubts = doubts, doubts.seen_in(look, noise, model.table["noise"].free)
        model = replace(model, rows=doubts.weigh(rows))
        if not doubts.differ_from(before):
            break
    # No iteration: only the bound is computed.
    return model, replace(fit, bound=model.minimise(Start(fit.values, 0)).bound), doubts


def _tolerance(model: Model, fit: Fit) -> float:
    """Smallest gain of an iteration, in nats."""
    return max(LEAST_TOL, ENOUGH * (fit.bound - model.bound_alone)) if model.tol is None else model.tol


def predictor_at(model: Model, values: Values) -> Predictor:
    """The predictor of residuals with q at its optimum."""
    return of_residuals(model.sparse.at_optimum(values, model.sparse.statistics(values, model.blocks)))


def of_residuals(predictor: Predictor) -> Predictor:
    """The same predictor for residuals."""
    return replace(predictor, offset=np.zeros_like(predictor.offset))


@dataclass(frozen=True)
class Look:
    """Rows and their predictions."""

    # (n, o): errors of the mean, and variances of the noise-free prediction.
    errors: np.ndarray
    latent: np.ndarray
    # (n,): v and w.
    variance: np.ndarray
    counts: np.ndarray

    @property
    def squares(self) -> np.ndarray:
        """E(y - g)² / v, (n, o)."""
        return (self.errors**2 + self.latent) / self.variance[:, np.newaxis]

    def far_from_median(self, most: float) -> np.ndarray:
        """Whether an error of a row (n,) is more than ``most`` standard deviations away from the median error."""
        distance = np.abs(self.errors - np.median(self.errors, axis=0)) / np.sqrt(self.variance)[:, np.newaxis]
        scale = np.median(distance, axis=0) / np.sqrt(_MEDIAN_SQUARE)
        return np.asarray(np.any(distance > most * scale, axis=1))

    def beyond(self, variance: np.ndarray) -> np.ndarray:
        """Whether an error of a row (n,) is too large for noise variances (o,)."""
        return np.asarray(np.any(self.squares > _FAR**2 * variance, axis=1))

    @property
    def typical(self) -> np.ndarray:
        """A robust variance (o,), from the median."""
        return np.maximum(np.median(self.squares, axis=0) / _MEDIAN_SQUARE, np.finfo(float).tiny)

    def distances(self, noise: np.ndarray) -> np.ndarray:
        """The squared Mahalanobis distance (n,) of rows, for noise variances (o,)."""
        return (self.squares / noise).sum(axis=1)

    def clean_variance(self, rejected: np.ndarray) -> np.ndarray:
        """Mean squared errors (o,) of the rows that are not rejected."""
        kept = ~rejected
        if not kept.any():
            return self.typical
        squares = self.counts[kept] @ self.squares[kept] / self.counts[kept].sum()
        return np.maximum(squares, np.finfo(float).tiny)


def look_at(rows: Rows, predictor: Predictor, precision: np.ndarray | None = None) -> Look:
    """Predict each row by a predictor of residuals, in one pass.

    For the tight bound, ``precision`` (o, n) is E[τ]/σ² of each output and row.
    """
    # The charge of the tight bound, -½ ŵ log(1 + x) with ŵ = max(w, 1) and x = w τ d / (ŵ σ² v), is convex in E[τ] (see
    # `model.bounds.BoundAtOptimum`). Its tangent at the present E[τ] is below it. The tangent has the slope
    # -½ w d' / (σ² v) with d' = d / (1 + x). So the best q(τ) for d' in place of d raises the bound.

    def of(first: int) -> tuple[np.ndarray, ...]:
        some = rows.some(np.arange(first, min(first + _ROWS_AT_ONCE, len(rows))))
        mean, latent = predictor.predict(some.inputs, some.features, return_variance=True)
        counts = variance = np.ones(len(mean))
        if some.counts is not None and some.precision is not None:
            counts, variance = some.counts, some.counts / some.precision
        if precision is not None and latent is not None:
            d = predictor.unexplained(some.inputs, some.features)
            x = d * precision[:, first : first + len(d)].T * (np.minimum(counts, 1.0) / variance)[:, np.newaxis]
            latent = np.maximum(latent - d * (x / (1.0 + x)), 0.0)
        return some.targets - mean, np.zeros_like(mean) if latent is None else latent, variance, counts

    parts = rows.threads(of, range(0, len(rows), _ROWS_AT_ONCE))
    return Look(*(np.concatenate(each) for each in zip(*parts, strict=True)))
