"""The internal units: what the features alone explain of y is taken out of it, and what they leave is of size one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import svd

from ..data.rows import Columns, Moments, RawRows, Rows, Source, times_weights
from ..data.threads import BlockMap
from ..model.predictor import CoefficientPrior, Predictor
from ..utils.linalg import diagonal_of, jittered_cholesky, triangular_inverse

# So that the lowest noise variance in the user's units is not rounded to 0.
SMALLEST_UNIT = 1e-140
# What residuals have of rounding errors, as a share of the target's largest value.
_TARGET_ROUNDING = 1e-14
# Of a feature's size: where it adds less than this to the others, sums of products leave few of its digits.
_SEEN = 1e-6
# Where it adds less than this, refinement would not converge.
_ROUNDING = 1e-12


def _products(raw: RawRows, basis: np.ndarray | None = None) -> np.ndarray:
    """HᵀH of rows times the basis (k, p, p), k = 1 or o: (p, p), or (o, p, p) of features for each output.

    Where rows have weights, each product has the factor ω; so it has below.
    """
    H = raw.features if raw.features.ndim == 2 else raw.features.transpose(1, 0, 2)
    if basis is not None:
        H = H @ (basis[0] if H.ndim == 2 else basis)
    HW = np.swapaxes(H, -1, -2)
    HW = HW if raw.precision is None else HW * raw.precision
    return HW @ H


@dataclass(frozen=True)
class _LeftOver:
    """Rows -> Hᵀl (o, p) and lᵀl (o,) of l = y - target_mean - H coefᵀ; if asked for, HᵀH, Σ ω and Σ w too."""

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
    """Rows -> HᵀH in a basis, alone in a tuple."""

    basis: np.ndarray

    def __call__(self, raw: RawRows) -> tuple[np.ndarray]:
        return (_products(raw, self.basis),)


def _triangles(source: Source, HH: np.ndarray) -> np.ndarray:
    """Upper R (k, p, p) with RᵀR = HᵀH, of features (k = 1), or of those for each output (k = o).

    Where features nearly depend on each other, as powers of a column far from 0 do, their sums of products are those of
    the basis R⁻¹ too: an R of these puts back the digits that the first one lacks (shifted Cholesky QR; Fukaya,
    Kannan, Nakatsukasa, Yamamoto, Yanagisawa 2020; without their third factor, which makes Q orthogonal to the last
    digit: Q is not used).
    """
    R, lower, sizes = _triangles_of(HH)
    if all((diagonal_of(L) >= _SEEN).all() for L in lower):
        return R
    basis = np.array([triangular_inverse(L).T for L in lower])
    (again,) = source.sum(_ProductsIn(basis / np.where(sizes > 0.0, sizes, 1.0)[:, :, np.newaxis]))
    return _triangles_of(again)[0] @ R


def _triangles_of(products: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Upper factors (k, p, p) of HᵀH, the lower ones of H with columns of size 1, and these columns' sizes (k, p)."""
    products = products if products.ndim == 3 else products[np.newaxis]
    sizes = np.sqrt(np.einsum("kii->ki", products))
    by = np.where(sizes > 0.0, sizes, 1.0)
    lower = []
    for each in products / (by[:, :, np.newaxis] * by[:, np.newaxis]):
        diagonal_of(each)[...] = 1.0
        lower.append(jittered_cholesky(each))
    return np.array([L.T for L in lower]) * sizes[:, np.newaxis], lower, sizes


def features_alone(source: Source, target_mean: np.ndarray, prior: CoefficientPrior) -> tuple[np.ndarray, np.ndarray]:
    """The most probable w of y = target_mean + H (mean + C w) + ε, w ~ N(0, I), for each output or all of them.

    The noise variance is first negligible, then what that leaves over; two steps of iterative refinement make up for
    the rounding of sums over targets.

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
    everything = [list(range(o))] if prior.shared else [[output] for output in range(o)]
    together = [outputs for outputs in everything if squares[outputs].any() and prior.scale[outputs].any()]
    if not together:
        return w, np.sqrt(squares / total_precision)
    triangles = _triangles(source, HH) @ roots
    # Where outputs share their weights, what each leaves over decides how much it counts.
    for share in (1e-12, 1.0, 1.0) if prior.shared else (1e-12, 1.0):
        noise = share * squares / n_rows
        steps = [_Step.of(outputs, noise[outputs], triangles) for outputs in together if noise[outputs].any()]
        for _ in range(3):
            for step in steps:
                step.take(w, np.einsum("oij,oi->oj", roots, HL))
            HL, squares = source.sum(_LeftOver(target_mean, prior.mean + prior.times(w)))
    return w, np.sqrt(squares / total_precision)


@dataclass(frozen=True)
class _Step:
    """To the most probable w of some outputs, all the same, under fixed noise variances; in units of the least one.

    ``root`` is a B (p, k) with B Bᵀ the inverse of the precision of w, but for directions that rounding hides.
    ``told`` (p, p), where features nearly depend on each other, takes from Cᵀ Hᵀ l what is rounding: that in directions
    in which they do not vary, where the prior decides.
    """

    outputs: list[int]
    least: float
    counts: np.ndarray
    root: np.ndarray
    told: np.ndarray | None = None

    @classmethod
    def of(cls, outputs: list[int], noise: np.ndarray, triangles: np.ndarray) -> _Step:
        """From the R C (o, p, p) of all outputs: the precision is not formed, which would square its condition."""
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
        """From w, with Cᵀ Hᵀ l of what it leaves over."""
        wanted = self.counts @ from_data[self.outputs]
        wanted = wanted if self.told is None else self.told @ wanted
        wanted -= self.least * w[self.outputs[0]]
        w[self.outputs] += self.root @ (self.root.T @ wanted)


def _varying(upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Singular values (k,) above rounding, and their right vectors (k, p)."""
    try:
        _, values, vectors = svd(upper, full_matrices=False)
    except np.linalg.LinAlgError:
        # The faster method by halves does not always converge.
        _, values, vectors = svd(upper, full_matrices=False, lapack_driver="gesvd")
    kept = values >= _ROUNDING * values[0]
    return values[kept], vectors[kept]


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
                "An infinite scale of CoefPrior needs features that are linearly independent on the rows of X: "
                f"{mask.sum()} features have an infinite scale, but only {rank} of them are independent. Give some a "
                "finite scale."
            )


def unit_of(left_over: np.ndarray, targets: Moments, from_features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unit of each target, and which targets are constant with nothing left over.

    The unit is the size of what is left over, but not below the rounding error of the target. A constant of which
    nothing is left over says nothing of a size: its unit is 1, as in scikit-learn's scalers.

    Parameters
    ----------
    left_over : ndarray of shape (o,)
        Root mean square.
    targets : Moments
    from_features : ndarray of shape (o,)
        The largest number that a feature adds a priori. It is what rounds where the target is 0.

    Returns
    -------
    unit : ndarray of shape (o,)
        Above 0.
    constant : ndarray of bool of shape (o,)
    """
    rounding = _TARGET_ROUNDING * np.where(targets.largest > 0.0, targets.largest, from_features)
    constant = (left_over <= rounding) & (np.sqrt(targets.variance) <= rounding)
    unit = np.maximum(np.where(constant, 1.0, left_over), rounding)
    return np.maximum(unit, SMALLEST_UNIT), constant


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
    target_scatter, rounding : ndarray of shape (o,)
        The targets' variance, and that of the rounding of their largest value, in squared target units.
    constant : ndarray of bool of shape (o,)
        Targets that do not vary and of which nothing is left over (`unit_of`).
    """

    target_mean: np.ndarray
    target_unit: np.ndarray
    prior: CoefficientPrior
    target_scatter: np.ndarray
    rounding: np.ndarray
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
        """The units of a training set: its rows, moments of its features and targets, and the prior of its weights."""
        reference, left_over = features_alone(source, target_mean, prior)
        largest = np.max(np.abs(prior.mean) * features.largest, axis=1, initial=0.0)
        unit, constant = unit_of(left_over, targets, largest)
        rounding = (np.finfo(float).eps * targets.largest / unit) ** 2
        return cls(
            target_mean, unit, replace(prior, reference=reference), targets.variance / unit**2, rounding, constant
        )

    def to_internal(self, raw: RawRows) -> RawRows:
        """The same inputs and features, and what the reference leaves of the targets, in its own units."""
        left_over = raw.targets - self.target_mean - times_weights(raw.features, self.prior.offset)
        return replace(raw, targets=left_over / self.target_unit)

    def rows(self, source: Source, threads: BlockMap | None = None) -> Rows:
        """Rows in internal units."""
        threads = BlockMap() if threads is None else threads
        return Rows(source, self.to_internal, threads=threads, constant=self.constant, rounding=self.rounding)

    def internal_prior(self) -> CoefficientPrior:
        """The prior for residuals in units of ``target_unit``."""
        return self.prior.scaled(1.0 / self.target_unit)

    def log_unit(self, outputs: Columns) -> float:
        """What one row of some outputs adds to the loss on the way to the user's units."""
        return float(np.log(self.target_unit[outputs]).sum())

    def predictor(self, parts: Sequence[Predictor], outputs: Sequence[list[int]]) -> Predictor:
        """Predictors of some outputs each, in internal units -> one of all in the user's."""
        return Predictor.joined(parts, outputs, self.target_unit, self.prior.offset, self.target_mean)
