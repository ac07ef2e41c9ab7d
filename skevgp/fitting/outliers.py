"""Fits whose noise has heavy tails: those of the rest, and the doubts of each row, take turns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..data.rows import LocalSource, Rows
from ..model.parameters import Values
from ..model.predictor import Predictor
from ..noise.student_t import RowScales
from .model import ENOUGH, LEAST_TOL, Model
from .search import Fit, Start, better, search

if TYPE_CHECKING:
    from .fit import FittedModel

# The first look at the rows: a fit of so many iterations to so many of them, or so many per inducing point.
_LOOK_ITERATIONS, _LOOK_ROWS, _LOOK_ROWS_PER_POINT = 30, 2000, 10
# The median of the square of a standard normal number.
_MEDIAN_SQUARE = 0.4549
# If more rows than this share seem to be outliers, none of them is taken for one to begin with.
_FEW = 0.3
# The share of the iterations before doubts are looked at anew, and then so many from one look to the next.
_BEFORE, _BETWEEN = 2.0 / 3.0, 50
# Doubts and q take turns until no E[τ] moves by more than this, or so often.
_SETTLED, _TURNS = 0.05, 5
# It ends when the rest gains less from one look to the next than so many times what ends L-BFGS.
_PATIENCE = 3.0
# Rows farther off than so many standard deviations of the others do not count for the noise of y.
_FAR = 6.0
# Rows that are predicted at once.
_ROWS_AT_ONCE = 4096


@dataclass(frozen=True)
class RowDoubts:
    """How much each row is doubted.

    Attributes
    ----------
    scales : RowScales
        q(τ) of each row.
    noise_factor : ndarray of shape (o,)
        The noise variance of rows that are no outliers, in units of σ².
    """

    scales: RowScales
    noise_factor: np.ndarray

    def weigh(self, rows: Rows) -> Rows:
        """Rows as the rest of the model sees them."""
        source = rows.source
        if not isinstance(source, LocalSource):
            raise TypeError("Rows of Dask arrays cannot be doubted.")
        return replace(rows, source=source.reweighted(self.scales.mean, self.scales.log_variance))

    def told(self, fitted: FittedModel) -> FittedModel:
        """What is said of the noise is that of rows that are no outliers; no upper bound is known."""
        predictor = replace(fitted.predictor, noise=fitted.values["noise"] * self.noise_factor)
        return replace(fitted, known_upper_bound=np.inf, predictor=predictor)

    def updated(self, fitted: FittedModel, rows: Rows) -> FittedModel:
        """Fold new rows in, which are doubted first for what is predicted of them, and then by turns with q.

        What was doubted of the rows before stays.
        """
        noise, plain = fitted.values["noise"], replace(fitted, doubts=None)
        look = look_at(rows, of_residuals(fitted.predictor))
        predicted = look.latent + np.multiply.outer(look.variance, noise)
        doubts = replace(self, scales=RowScales(len(noise), (look.errors**2 / predicted).sum(axis=1)))
        for _ in range(_TURNS):
            new = plain.updated(doubts.weigh(rows))
            before, look = doubts, look_at(rows, of_residuals(new.predictor))
            doubts = replace(self, scales=RowScales(len(noise), look.distances(noise)))
            if not doubts.differ_from(before):
                break
        return doubts.told(replace(plain.updated(doubts.weigh(rows)), doubts=doubts))

    def differ_from(self, before: RowDoubts) -> bool:
        """Whether some row is doubted more, or less, than before."""
        return bool(np.abs(self.scales.mean - before.scales.mean).max() >= _SETTLED)


def fit_doubting(model: Model, run: Callable[[Model], tuple[Model, Fit]]) -> tuple[Model, Fit, RowDoubts]:
    """Fit a model whose noise has heavy tails by coordinate ascent: no turn lowers the bound."""
    rows, doubts = model.rows, _first_doubts(model)
    first = model.max_iter - int((1.0 - _BEFORE) * model.max_iter)
    # Where no row stands out, the fit is that with Gaussian noise.
    seen = doubts.weigh(rows) if (doubts.scales.outlier > 0.5).any() else rows
    weighed, fit = run(replace(model, rows=seen, max_iter=first))
    weighed = replace(weighed, max_iter=model.max_iter)
    with model.monitor.keeping_the_best():
        while not model.monitor.stopped:
            weighed, settled, now = settle(weighed, fit, rows, doubts)
            moved, fit, doubts = now.differ_from(doubts), settled, now
            if fit.n_iter >= model.max_iter or (fit.converged and not moved):
                break
            until = min(fit.n_iter + _BETWEEN, model.max_iter)
            further = better(fit, weighed.minimise(Start(fit.values, until, fit)))
            enough = _PATIENCE * _tolerance(weighed, further)
            fit, gained = further, further.bound - fit.bound
            if gained < enough:
                fit = replace(fit, converged=True, message="")
    return weighed, fit, doubts


def _first_doubts(model: Model) -> RowDoubts:
    """From a short fit to some rows, by whose errors' median all are judged."""
    rows, size = model.rows, max(_LOOK_ROWS, _LOOK_ROWS_PER_POINT * model.n_inducing)
    some = rows.random_subset(size, model.rng) if size < len(rows) else rows
    short = replace(model, rows=some, max_iter=min(_LOOK_ITERATIONS, model.max_iter), monitor=model.monitor.silent())
    look = look_at(rows, predictor_at(short, search(short).values))
    n_outputs = look.errors.shape[1]
    scales = RowScales(n_outputs, look.distances(look.typical))
    if np.mean(scales.outlier > 0.5) > _FEW:
        scales = RowScales(n_outputs, np.zeros(len(rows)))
    return RowDoubts(scales, np.ones(n_outputs))


def settle(model: Model, fit: Fit, rows: Rows, doubts: RowDoubts) -> tuple[Model, Fit, RowDoubts]:
    """Kernel, noise and inducing points stay; doubts and q move until they hardly do.

    Parameters
    ----------
    model : Model
        With rows that are doubted.
    fit : Fit
    rows : Rows
        As they are.
    doubts : RowDoubts
        Of the model's rows.

    Returns
    -------
    model, fit, doubts
        The model with its rows doubted anew, the fit with the bound that it then has, and the doubts.
    """
    noise = fit.values["noise"]
    for _ in range(_TURNS):
        look = look_at(rows, predictor_at(model, fit.values))
        factor = np.where(model.table["noise"].free, look.clean_variance() / noise, 1.0)
        before, doubts = doubts, RowDoubts(RowScales(len(noise), look.distances(noise)), factor)
        model = replace(model, rows=doubts.weigh(rows))
        if not doubts.differ_from(before):
            break
    # Where nothing is optimised.
    return model, replace(fit, bound=model.minimise(Start(fit.values, 0)).bound), doubts


def _tolerance(model: Model, fit: Fit) -> float:
    """In nats: an iteration that gains less is not worth it."""
    return max(LEAST_TOL, ENOUGH * (fit.bound - model.bound_alone)) if model.tol is None else model.tol


def predictor_at(model: Model, values: Values) -> Predictor:
    """With q at its optimum; of residuals."""
    return of_residuals(model.sparse.at_optimum(values, model.sparse.statistics(values, model.blocks)))


def of_residuals(predictor: Predictor) -> Predictor:
    """The same without the reference that residuals are taken from."""
    return replace(predictor, offset=np.zeros_like(predictor.offset))


@dataclass(frozen=True)
class Look:
    """Rows and what is predicted of them.

    Attributes
    ----------
    errors, latent : ndarray of shape (n, o)
        What the mean leaves over, and the variance of the noise-free prediction.
    variance, counts : ndarray of shape (n,)
        v and w.
    """

    errors: np.ndarray
    latent: np.ndarray
    variance: np.ndarray
    counts: np.ndarray

    @property
    def squares(self) -> np.ndarray:
        """E(y - g)² / v, (n, o)."""
        return (self.errors**2 + self.latent) / self.variance[:, np.newaxis]

    @property
    def typical(self) -> np.ndarray:
        """A variance (o,) that no few rows can move: by the median."""
        return np.maximum(np.median(self.squares, axis=0) / _MEDIAN_SQUARE, np.finfo(float).tiny)

    def distances(self, noise: np.ndarray) -> np.ndarray:
        """The d (n,) of rows under noise variances (o,)."""
        return (self.squares / noise).sum(axis=1)

    def clean_variance(self) -> np.ndarray:
        """Mean squared errors (o,) of the rows that are no outliers."""
        variance, kept, squares = self.typical, np.zeros(len(self.errors), dtype=bool), self.squares
        while True:
            now = (squares <= _FAR**2 * variance).all(axis=1) | kept
            if (now == kept).all():
                return variance
            kept = now
            variance = np.maximum(self.counts[kept] @ squares[kept] / self.counts[kept].sum(), np.finfo(float).tiny)


def look_at(rows: Rows, predictor: Predictor) -> Look:
    """What a predictor of residuals says of each row; a pass over them."""

    def of(first: int) -> tuple[np.ndarray, ...]:
        some = rows.some(np.arange(first, min(first + _ROWS_AT_ONCE, len(rows))))
        mean, latent = predictor.predict(some.inputs, some.features, return_variance=True)
        counts = variance = np.ones(len(mean))
        if some.counts is not None and some.precision is not None:
            counts, variance = some.counts, some.counts / some.precision
        return some.targets - mean, np.zeros_like(mean) if latent is None else latent, variance, counts

    parts = rows.threads(of, range(0, len(rows), _ROWS_AT_ONCE))
    return Look(*(np.concatenate(each) for each in zip(*parts, strict=True)))
