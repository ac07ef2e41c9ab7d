"""The internal units: what the features alone explain of y is taken out of it, and what they leave is of size one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import cho_solve, eigh

from .._linalg import diagonal_of, jittered_cholesky
from ..inference.posterior import CoefficientPrior, Predictor
from ..rows.internal import Rows
from ..rows.source import Columns, Moments, RawRows, Source, times_weights
from ..rows.threads import BlockMap

# So that the lowest noise variance in the user's units is not rounded to 0.
SMALLEST_UNIT = 1e-140
# Of a feature's size: less of it than this beside the others, sums over the targets do not see.
_SEEN = 1e-6


@dataclass(frozen=True)
class _LeftOver:
    """Rows -> Hᵀl (o, p) and lᵀl (o,) of l = y - target_mean - H coefᵀ; if asked for, HᵀH, Σ ω and Σ w too.

    Where rows have weights, each product has the factor ω. HᵀH is (p, p), or (o, p, p) of features for each output.
    """

    target_mean: np.ndarray
    coef: np.ndarray
    with_products: bool = False

    def __call__(self, raw: RawRows) -> tuple[Any, ...]:
        H = raw.features
        left_over = raw.targets - self.target_mean - times_weights(H, self.coef)
        weighted, precision = left_over, raw.total
        if raw.precision is not None:
            weighted, precision = left_over * raw.precision[:, np.newaxis], float(raw.precision.sum())
        HL = weighted.T @ H if H.ndim == 2 else np.einsum("no,nop->op", weighted, H)
        sums = HL, np.einsum("no,no->o", weighted, left_over)
        if not self.with_products:
            return sums
        by_output = H if H.ndim == 2 else H.transpose(1, 0, 2)
        HW = np.swapaxes(by_output, -1, -2)
        HW = HW if raw.precision is None else HW * raw.precision
        return (*sums, HW @ by_output, precision, raw.total)


def features_alone(source: Source, target_mean: np.ndarray, prior: CoefficientPrior) -> tuple[np.ndarray, np.ndarray]:
    """The most probable w of y = target_mean + H (mean + C w) + ε, w ~ N(0, I), for each output or all of them.

    The noise variance is first negligible, then what that leaves over; two steps of iterative refinement make up for
    the rounding of the normal equations.

    Parameters
    ----------
    source : Source
        n rows with p features and o targets.
    target_mean : ndarray of shape (o,)
    prior : CoefficientPrior
        Of the weights; a scale of 0 keeps one at its mean.

    Returns
    -------
    w : ndarray of shape (o, p)
    left_over : ndarray of shape (o,)
        Root mean square of what they leave over, the noisier a row the less it counts.
    """
    (o, p), roots = prior.scale.shape, prior.roots()
    w = np.zeros((o, p))
    HL, squares, HH, total_precision, n_rows = source.sum(_LeftOver(target_mean, prior.mean, with_products=True))
    products = np.swapaxes(roots, 1, 2) @ HH @ roots
    everything = [list(range(o))] if prior.shared else [[output] for output in range(o)]
    together = [outputs for outputs in everything if squares[outputs].any() and prior.scale[outputs].any()]
    # Where outputs share their weights, what each leaves over decides how much it counts.
    shares = (1e-12, 1.0, 1.0) if prior.shared else (1e-12, 1.0)
    for share in shares if together else ():
        noise = share * squares / n_rows
        steps = [_Step.of(outputs, noise[outputs], products) for outputs in together if noise[outputs].any()]
        for _ in range(3):
            for step in steps:
                step.take(w, np.einsum("oij,oi->oj", roots, HL), cold=not w[step.outputs].any())
            HL, squares = source.sum(_LeftOver(target_mean, prior.mean + prior.times(w)))
    return w, np.sqrt(squares / total_precision)


@dataclass(frozen=True)
class _Step:
    """To the most probable w of some outputs, all the same, under fixed noise variances; in units of the least one."""

    outputs: list[int]
    least: float
    counts: np.ndarray
    precision: np.ndarray
    root: np.ndarray

    @classmethod
    def of(cls, outputs: list[int], noise: np.ndarray, products: np.ndarray) -> _Step:
        noise = np.maximum(noise, 1e-16 * noise.max())
        least = float(noise.min())
        counts = least / noise
        precision = np.einsum("o,oij->ij", counts, products[outputs])
        diagonal_of(precision)[...] += least
        return cls(outputs, least, counts, precision, jittered_cholesky(precision))

    def take(self, w: np.ndarray, from_data: np.ndarray, cold: bool) -> None:
        """From w, which is 0 if cold.

        Sums over targets from which nothing has been subtracted have rounding errors that nearly dependent features
        would blow up to weights that cancel. The first step keeps out of such directions; those after it, of what is
        then left over, do not.
        """
        first = self.outputs[0]
        wanted = self.counts @ from_data[self.outputs] - self.least * w[first]
        sizes = np.sqrt(diagonal_of(self.precision))
        if not cold or (diagonal_of(self.root) >= _SEEN * sizes).all():
            w[self.outputs] += cho_solve((self.root, True), wanted)
            return
        values, vectors = eigh(self.precision / np.multiply.outer(sizes, sizes))
        seen = values > _SEEN**2 * values[-1]
        w[self.outputs] += vectors[:, seen] @ (vectors[:, seen].T @ (wanted / sizes) / values[seen]) / sizes


def may_hide_noise(prior: CoefficientPrior, n_rows: int) -> bool:
    """Whether what the features leave over may be far below the noise.

    As many features as rows leave nothing over, and weights far from their prior leave over less than its own would.
    """
    return 2 * prior.scale.shape[1] >= n_rows or float((prior.reference**2).sum(axis=1).max(initial=0.0)) > n_rows


def noise_of_most_evidence(
    evidence: Callable[[np.ndarray], np.ndarray], least: np.ndarray, highest: np.ndarray, shared: bool
) -> tuple[float, np.ndarray]:
    """Which noise suits features best that leave over less: the evidence may be the greatest with more.

    (Rasmussen & Williams 2006, eq. 2.30, for a linear model.) All decades are tried, since it may be flat over most of
    them, then quarters of decades around the best.

    Parameters
    ----------
    evidence : callable
        Noise variances (o,) -> nats (o,) of each output.
    least, highest : ndarray of shape (o,)
        The first and the last that are tried; only the first if that is not the smaller one.
    shared : bool
        Whether all outputs are to have the same multiple of the least.

    Returns
    -------
    value : float
        The evidence, summed over outputs.
    noise : ndarray of shape (o,)
    """
    best, value = least.copy(), np.full(len(least), -np.inf)
    reach = np.log10(np.max(highest / least, initial=1.0))
    for exponents in (np.append(np.arange(0.0, reach), reach), np.arange(-0.75, 1.0, 0.25)):
        centre = best.copy()
        for exponent in exponents:
            noise = np.clip(centre * 10.0**exponent, least, np.maximum(least, highest))
            found = evidence(noise)
            if shared:
                found = np.full(len(found), found.mean())
            higher = found > value
            best[higher], value[higher] = noise[higher], found[higher]
        if (best == least).all():
            break
    return float(value.sum()), best


def check_independent(features: np.ndarray, vague: np.ndarray, shared: bool) -> None:
    """Refuse features whose vague weights the rows cannot tell apart.

    Parameters
    ----------
    features : ndarray of shape (n, p) or (n, o, p)
    vague : ndarray of shape (o, p)
        Weights with an infinite prior scale.
    shared : bool
        Whether outputs share their weights.

    Raises
    ------
    ValueError
    """
    if features.ndim == 3 and not shared:
        for output, own in enumerate(vague):
            check_independent(features[:, output], own[np.newaxis], shared)
        return
    features = features.reshape(np.prod(features.shape[:-1]), features.shape[-1])
    size = np.sqrt(np.sum(features**2, axis=0))
    scaled = features / np.where(size > 0.0, size, 1.0)
    for mask in np.unique(vague, axis=0):
        rank = np.linalg.matrix_rank(scaled[:, mask]) if mask.any() else 0
        if rank < mask.sum():
            raise ValueError(
                f"coef_scale=inf needs features that are linearly independent on the rows of X: {mask.sum()} features "
                f"have an infinite scale, but only {rank} of them are independent. Give some a finite scale."
            )


def unit_of(left_over: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """The unit of each target: the size of what is left over, not below the rounding error of the target, never 0.

    Parameters
    ----------
    left_over : ndarray of shape (o,)
        Root mean square.
    largest : ndarray of shape (o,)
        Of the target's absolute values.

    Returns
    -------
    unit : ndarray of shape (o,)
    """
    unit = np.maximum(left_over, 1e-14 * largest)
    return np.where(unit > 0.0, np.maximum(unit, SMALLEST_UNIT), 1.0)


@dataclass(frozen=True)
class Units:
    """What is subtracted from and divided out of the targets before inference.

    Attributes
    ----------
    target_mean : ndarray of shape (o,)
        Subtracted from y; part of the model (0 unless y is normalised).
    target_unit : ndarray of shape (o,)
        The size of what the features alone leave over.
    prior : CoefficientPrior
        In the user's units.
    target_scatter : ndarray of shape (o,), optional
        The targets' variance, in squared target units; not known of a model from a file.
    """

    target_mean: np.ndarray
    target_unit: np.ndarray
    prior: CoefficientPrior
    target_scatter: np.ndarray | None = None

    @classmethod
    def of(
        cls,
        source: Source,
        targets: Moments,
        target_mean: np.ndarray,
        prior: CoefficientPrior,
    ) -> Units:
        """The units of a training set, from its rows, its targets' moments, and the prior of its weights."""
        reference, left_over = features_alone(source, target_mean, prior)
        unit = unit_of(left_over, targets.largest)
        return cls(target_mean, unit, replace(prior, reference=reference), targets.variance / unit**2)

    def to_internal(self, raw: RawRows) -> RawRows:
        """The same inputs and features, and what the reference leaves of the targets, in its own units."""
        left_over = raw.targets - self.target_mean - times_weights(raw.features, self.prior.offset)
        return replace(raw, targets=left_over / self.target_unit)

    def rows(self, source: Source, threads: BlockMap | None = None) -> Rows:
        """Rows in internal units."""
        return Rows(source, self.to_internal, threads=BlockMap() if threads is None else threads)

    def internal_prior(self) -> CoefficientPrior:
        """The prior for residuals in units of ``target_unit``."""
        return self.prior.scaled(1.0 / self.target_unit)

    def log_unit(self, outputs: Columns) -> float:
        """What one row of some outputs adds to the loss on the way to the user's units."""
        return float(np.log(self.target_unit[outputs]).sum())

    def predictor(self, parts: Sequence[Predictor], outputs: Sequence[list[int]]) -> Predictor:
        """Predictors of some outputs each, in internal units -> one of all in the user's."""
        return Predictor.joined(parts, outputs, self.target_unit, self.prior.offset, self.target_mean)
