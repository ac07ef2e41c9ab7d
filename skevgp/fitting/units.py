"""Internal units: the fit of the features alone is subtracted from y, and the residuals are divided by their size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import svd

from ..data.rows import SMALLEST_UNIT, Columns, Moments, RawRows, Rows, Source, times_weights
from ..data.threads import BlockMap
from ..model.predictor import CoefficientPrior, Predictor
from ..utils.linalg import diagonal_of, jittered_cholesky, triangular_inverse

# Size of the rounding errors of residuals, as a share of the target's largest value.
_TARGET_ROUNDING = 1e-14
# If a smaller share of a feature is independent of the others, sums of products keep few of its digits.
_SEEN = 1e-6
# With a smaller share than this, refinement would not converge.
_ROUNDING = 1e-12


def _products(raw: RawRows, basis: np.ndarray | None = None) -> np.ndarray:
    """HᵀΩH of features times the basis (k, p, p): (p, p), or (o, p, p) if each output has its own features."""
    H = raw.features if raw.features.ndim == 2 else raw.features.transpose(1, 0, 2)
    if basis is not None:
        H = H @ (basis[0] if H.ndim == 2 else basis)
    HW = np.swapaxes(H, -1, -2)
    HW = HW if raw.precision is None else HW * raw.precision
    return HW @ H


@dataclass(frozen=True)
class LeftOver:
    """Maps rows to HᵀΩl (o, p) and lᵀΩl (o,), with l = y - target_mean - H coefᵀ. Optionally also HᵀΩH, Σω, Σw."""

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
        return (*sums, _products(raw), precision, raw.total) if self.with_products else sums


@dataclass(frozen=True)
class _ProductsIn:
    """Maps rows to (HᵀΩH in a basis,)."""

    basis: np.ndarray

    def __call__(self, raw: RawRows) -> tuple[np.ndarray]:
        return (_products(raw, self.basis),)


def _feature_products(raw: RawRows) -> tuple[np.ndarray, float]:
    """HᵀΩH and Σω."""
    return _products(raw), raw.total if raw.precision is None else float(raw.precision.sum())


def triangles_of_features(source: Source) -> tuple[np.ndarray, float]:
    """Upper triangular R (k, p, p) with RᵀR = HᵀΩH (see `_triangles`), and Σω."""
    HH, total_precision = source.sum(_feature_products)
    return _triangles(source, HH), total_precision


def _triangles(source: Source, HH: np.ndarray) -> np.ndarray:
    """Upper triangular R (k, p, p) with RᵀR = HᵀΩH. k is the number of outputs if each has its own features, else 1."""
    # Features may be nearly collinear, as powers of a column far from 0. Then the products are summed again in the
    # basis R⁻¹. Their own R restores the digits that the first one lacks (shifted Cholesky QR; Fukaya, Kannan,
    # Nakatsukasa, Yamamoto & Yanagisawa 2020). Their third factor makes Q orthogonal to the last digit. Q is not used
    # here.
    R, lower, sizes = _triangles_of(HH)
    if all((diagonal_of(L) >= _SEEN).all() for L in lower):
        return R
    basis = np.array([triangular_inverse(L).T for L in lower])
    (again,) = source.sum(_ProductsIn(basis / np.where(sizes > 0.0, sizes, 1.0)[:, :, np.newaxis]))
    return _triangles_of(again)[0] @ R


def _triangles_of(products: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Upper factors (k, p, p) of HᵀΩH, lower factors for columns of length 1, and the lengths (k, p) of the columns."""
    products = products if products.ndim == 3 else products[np.newaxis]
    sizes = np.sqrt(np.einsum("kii->ki", products))
    by = np.where(sizes > 0.0, sizes, 1.0)
    lower = []
    for each in products / (by[:, :, np.newaxis] * by[:, np.newaxis]):
        diagonal_of(each)[...] = 1.0
        lower.append(jittered_cholesky(each))
    return np.array([L.T for L in lower]) * sizes[:, np.newaxis], lower, sizes


def features_alone(source: Source, target_mean: np.ndarray, prior: CoefficientPrior) -> tuple[np.ndarray, np.ndarray]:
    """The posterior mode w (o, p) of y = target_mean + H (mean + C w) + ε, w ~ N(0, I), and the residuals' rms (o,).

    The rms weighs rows by ω.
    """
    # The noise variance is first negligible, then the mean squared residual of that fit. Two steps of iterative
    # refinement correct the rounding of sums over targets.
    (o, p), roots = prior.scale.shape, prior.roots()
    w = np.zeros((o, p))
    HL, squares, HH, total_precision, n_rows = source.sum(LeftOver(target_mean, prior.mean, with_products=True))
    everything = [list(range(o))] if prior.shared else [[output] for output in range(o)]
    together = [outputs for outputs in everything if squares[outputs].any() and prior.scale[outputs].any()]
    if not together:
        return w, np.sqrt(squares / total_precision)
    triangles = _triangles(source, HH) @ roots
    # If outputs share their weights, the residuals of each decide how much it counts.
    for share in (1e-12, 1.0, 1.0) if prior.shared else (1e-12, 1.0):
        noise = share * squares / n_rows
        steps = [_Step.of(outputs, noise[outputs], triangles) for outputs in together if noise[outputs].any()]
        for _ in range(3):
            for step in steps:
                step.take(w, np.einsum("oij,oi->oj", roots, HL))
            HL, squares = source.sum(LeftOver(target_mean, prior.mean + prior.times(w)))
    return w, np.sqrt(squares / total_precision)


@dataclass(frozen=True)
class _Step:
    """A Newton step of the w that some outputs share, for fixed noise variances, in units of the smallest one."""

    outputs: list[int]
    # The smallest noise variance, and its ratio (k,) to that of each output.
    least: float
    counts: np.ndarray
    # (p, k): a B with B Bᵀ the inverse of the precision of w, without directions that are lost in rounding.
    root: np.ndarray
    # (p, p): for nearly collinear features, removes rounding errors from Cᵀ Hᵀ l: its part in directions in which the
    # features do not vary, where the prior decides.
    told: np.ndarray | None = None

    @classmethod
    def of(cls, outputs: list[int], noise: np.ndarray, triangles: np.ndarray) -> _Step:
        """Prepare the step from R C (o, p, p) of all outputs and their noise variances."""
        # The precision itself is not formed: that would square its condition number.
        noise = np.maximum(noise, 1e-16 * noise.max())
        least = float(noise.min())
        counts, p = least / noise, triangles.shape[-1]
        rows = (np.sqrt(counts)[:, np.newaxis, np.newaxis] * triangles[outputs]).reshape(-1, p)
        upper = np.linalg.qr(np.concatenate([rows, np.sqrt(least) * np.eye(p)])).R
        sizes = np.abs(upper).max(axis=0)
        if (np.abs(diagonal_of(upper)) >= _SEEN * sizes).all():
            return cls(outputs, least, counts, triangular_inverse(upper.T).T)
        values, vectors = _varying(upper / sizes)
        root = (vectors / values[:, np.newaxis] / sizes).T
        _, vectors = _varying(rows / sizes)
        return cls(outputs, least, counts, root, (vectors * sizes).T @ (vectors / sizes))

    def take(self, w: np.ndarray, from_data: np.ndarray) -> None:
        """Move w (o, p) in place, given Cᵀ Hᵀ l (o, p) of its residuals l."""
        wanted = self.counts @ from_data[self.outputs]
        wanted = wanted if self.told is None else self.told @ wanted
        wanted -= self.least * w[self.outputs[0]]
        w[self.outputs] += self.root @ (self.root.T @ wanted)


def _varying(upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Singular values (k,) above rounding errors, and their right vectors (k, p)."""
    try:
        _, values, vectors = svd(upper, full_matrices=False)
    except np.linalg.LinAlgError:
        # The faster divide-and-conquer method does not always converge.
        _, values, vectors = svd(upper, full_matrices=False, lapack_driver="gesvd")
    kept = values >= _ROUNDING * values[0]
    return values[kept], vectors[kept]


def may_hide_noise(prior: CoefficientPrior, n_rows: int) -> bool:
    """Whether the residuals of the features may be far below the noise.

    They vanish with as many features as rows. They are also too small if weights are far from their prior.
    """
    return 2 * prior.scale.shape[1] >= n_rows or float((prior.reference**2).sum(axis=1).max(initial=0.0)) > n_rows


def noise_of_most_evidence(
    evidence: Callable[[np.ndarray], np.ndarray], least: np.ndarray, highest: np.ndarray, shared: bool
) -> tuple[float, np.ndarray]:
    """The highest evidence of a linear model, summed over outputs, and the noise variances (o,) that reach it.

    ``evidence`` maps noise variances (o,) to nats (o,) (Rasmussen & Williams 2006, eq. 2.30). The search goes from
    ``least`` to ``highest``, both (o,). If ``shared``, all outputs have the same multiple of ``least``.
    """
    # The evidence may be flat over most decades: all are tried, then quarters of decades around the best.
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
    """Raise a ValueError if features with an infinite prior scale are collinear on the rows.

    Features are (n, p) or (n, o, p), and ``vague`` (o, p) says which weights have an infinite scale.
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
                "An infinite scale of CoefPrior needs features that are linearly independent on the rows of X: "
                f"{mask.sum()} features have an infinite scale, but only {rank} of them are independent. Pass a "
                "finite scale for some of them."
            )


def unit_of(left_over: np.ndarray, targets: Moments, from_features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unit (o,) of each target, and whether it is a constant that the features explain, (o,).

    ``left_over`` (o,) is the rms of the residuals. ``from_features`` (o,) is the largest prior mean of a feature's
    contribution, which gives the size of rounding errors where the target is 0.
    """
    # The unit is the size of the residuals, but not below the rounding error of the target.
    rounding = _TARGET_ROUNDING * np.where(targets.largest > 0.0, targets.largest, from_features)
    # A constant that the features explain says nothing about a size: its unit is 1, as in scikit-learn's scalers.
    constant = (left_over <= rounding) & (np.sqrt(targets.variance) <= rounding)
    unit = np.maximum(np.where(constant, 1.0, left_over), rounding)
    return np.maximum(unit, SMALLEST_UNIT), constant


@dataclass(frozen=True)
class Units:
    """The shift and scale of the targets, and the prior of the weights."""

    # (o,): subtracted from y, and part of the model. 0 unless y is normalised.
    target_mean: np.ndarray
    # (o,): the size of the residuals of the features alone.
    target_unit: np.ndarray
    # In the user's units.
    prior: CoefficientPrior
    # (o,): the targets' variance, and the rounding variance of their largest value, in squared target units.
    target_scatter: np.ndarray
    rounding: np.ndarray
    # (o,): whether a target is constant and the features explain it.
    constant: np.ndarray

    @classmethod
    def of(
        cls,
        source: Source,
        features: Moments,
        targets: Moments,
        target_mean: np.ndarray,
        prior: CoefficientPrior,
    ) -> Units:
        """The units of training rows, given the moments of their features and targets, and the prior of the weights."""
        reference, left_over = features_alone(source, target_mean, prior)
        largest = np.max(np.abs(prior.mean) * features.largest, axis=1, initial=0.0)
        unit, constant = unit_of(left_over, targets, largest)
        rounding = (np.finfo(float).eps * targets.largest / unit) ** 2
        return cls(
            target_mean, unit, replace(prior, reference=reference), targets.variance / unit**2, rounding, constant
        )

    def to_internal(self, raw: RawRows) -> RawRows:
        """The same inputs and features, with the residuals in internal units for targets."""
        left_over = raw.targets - self.target_mean - times_weights(raw.features, self.prior.offset)
        return replace(raw, targets=left_over / self.target_unit)

    def rows(self, source: Source, threads: BlockMap | None = None) -> Rows:
        """Rows in internal units."""
        threads = BlockMap() if threads is None else threads
        return Rows(source, self.to_internal, threads=threads, constant=self.constant, rounding=self.rounding)

    def internal_prior(self) -> CoefficientPrior:
        """The prior of the weights in internal units."""
        return self.prior.scaled(1.0 / self.target_unit)

    def shift(self, n_contrasts: np.ndarray, outputs: Columns) -> float:
        """The loss of some outputs in the user's units less that in internal ones. ``n_contrasts`` are (o,)."""
        return float(n_contrasts @ np.log(self.target_unit[outputs]))

    def predictor(self, parts: Sequence[Predictor], outputs: Sequence[list[int]]) -> Predictor:
        """The predictor of all outputs in the user's units, from predictors of some outputs each in internal units."""
        return Predictor.joined(parts, outputs, self.target_unit, self.prior.offset, self.target_mean)
