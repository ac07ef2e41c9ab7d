"""Placement of inducing points at the start of a fit, and when more are added."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np
from sklearn.cluster import KMeans
from sklearn.exceptions import ConvergenceWarning

from ..data.rows import Moments
from ..exceptions import ignored
from ..model.statistics import Kernel, Whitening
from ..utils.validation import as_floats, check_magnitude

# First number of points if the number is to be found.
_FIRST = 10
# On a sample the search takes a fraction of a second, and its points are as good as those from all rows.
MAX_SAMPLE = 10_000
# Largest number of floats that the greedy search keeps: 80 MB.
LARGEST_SEARCH = 10_000_000
# Below this share of the prior variance, variances are rounding errors and do not rank rows.
_EXHAUSTED = 1e-10
# Rows are equal if they agree in so many decimal places, in standard deviations of their columns.
_DIGITS = 10


@dataclass(frozen=True)
class Placement:
    """How inducing points are chosen."""

    # The points themselves (m, d), or the name of a method. ``"auto"`` starts as ``"k-means"``. ``"all rows"`` is the
    # exact model.
    method: Literal["auto", "k-means", "greedy", "all rows"] | np.ndarray
    # Largest number of points at the start. An array has its own number.
    n_inducing: int
    # Largest number of points at the end, if their number is to be found.
    max_inducing: int | None = None

    @classmethod
    def of(cls, inducing_init: Any, n_inducing: int | str, max_inducing: int | None, n_columns: int) -> Placement:
        """The placement for the estimator's arguments, for inputs with ``n_columns``. Points are checked."""
        most = max_inducing if isinstance(n_inducing, str) else None
        first = min(_FIRST, max_inducing or _FIRST) if isinstance(n_inducing, str) else n_inducing
        if isinstance(inducing_init, str):
            return cls(cast(Literal["auto", "k-means", "greedy"], inducing_init), first, most)
        points = as_floats(inducing_init, "inducing_init")
        if points.ndim != 2 or len(points) == 0 or points.shape[1] != n_columns:
            raise ValueError(
                f"inducing_init must be 'auto', 'k-means', 'greedy' or an array of shape (m, {n_columns}): points in "
                f"the space of kernel_map; got the shape {points.shape}."
            )
        if not np.isfinite(points).all():
            raise ValueError("inducing_init must be finite; it contains NaN or infinity.")
        check_magnitude(points, "inducing_init")
        return cls(points, len(points), most)

    @property
    def takes_all_rows(self) -> bool:
        """Whether the model is the exact one."""
        return isinstance(self.method, str) and self.method == "all rows"

    @property
    def anew(self) -> Placement | None:
        """The placement for a second time, when the kernel has learned something. None if the points stay."""
        by_user = isinstance(self.method, np.ndarray)
        return replace(self, method="greedy") if not by_user and self.method == "auto" else None

    @property
    def sample_size(self) -> int:
        """Number of rows from which points are chosen."""
        if self.takes_all_rows:
            return sys.maxsize
        if isinstance(self.method, str) and self.method == "greedy":
            return greedy_sample_size(self.n_inducing)
        return max(MAX_SAMPLE, 10 * self.n_inducing)

    def points(
        self, inputs: np.ndarray, kernel: Kernel, hyperparameters: np.ndarray, rng: np.random.RandomState
    ) -> np.ndarray:
        """Choose inducing points (m, d) from rows (n, d), at most as many as there are distinct rows.

        If there are no more distinct rows than points, these are returned in the order of their first appearance. Rows
        that differ by rounding errors count as one. Only ``"greedy"`` uses the kernel and its hyperparameters
        (n_hyper,).
        """
        if isinstance(self.method, np.ndarray):
            return self.method
        if self.takes_all_rows:
            return inputs
        distinct = distinct_rows(inputs)
        if len(distinct) <= self.n_inducing:
            return distinct
        if self.method == "greedy":
            return _least_known(distinct[rng.permutation(len(distinct))], self.n_inducing, kernel, hyperparameters)
        return _cluster_centres(inputs, self.n_inducing, rng)


def greedy_sample_size(n_inducing: int) -> int:
    """Number of rows for a greedy search of so many points."""
    return max(2 * n_inducing, min(MAX_SAMPLE, LARGEST_SEARCH // n_inducing))


def distinct_rows(inputs: np.ndarray) -> np.ndarray:
    """Distinct rows in the order of their first appearance. Rows that differ by rounding errors count as one."""
    _, first = np.unique(_rounded(inputs, Moments.of(inputs)), axis=0, return_index=True)
    return inputs[np.sort(first)]


def with_more_points(
    points: np.ndarray, n_inducing: int, inputs: np.ndarray, kernel: Kernel, hyperparameters: np.ndarray
) -> np.ndarray:
    """Inducing points (m, d), followed by the rows that they predict worst, at most ``n_inducing`` in all.

    There are fewer if fewer rows are distinct from each other and from the points. Of equal rows the first is taken.
    """
    moments = Moments.of(inputs)
    _, first = np.unique(_rounded(np.vstack([points, inputs]), moments), axis=0, return_index=True)
    new = inputs[np.sort(first[first >= len(points)]) - len(points)]
    if len(new) > n_inducing - len(points):
        new = _least_known(new, n_inducing - len(points), kernel, hyperparameters, points)
    return np.vstack([points, new])


def are_all_rows(points: np.ndarray, inputs: np.ndarray) -> bool:
    """Whether each row (n, d) is one of the points (m, d), up to rounding errors."""
    moments = Moments.of(inputs)
    known, rows = _rounded(points, moments), _rounded(inputs, moments)
    n_known = len(np.unique(known, axis=0))
    return n_known == len(np.unique(np.vstack([known, rows]), axis=0))


def _rounded(inputs: np.ndarray, moments: Moments) -> np.ndarray:
    """Rows in standard deviations of their columns, rounded to the digits that count."""
    return np.round((inputs - moments.mean) / moments.scale, _DIGITS)


def _cluster_centres(inputs: np.ndarray, n_inducing: int, rng: np.random.RandomState) -> np.ndarray:
    """Centres of k-means with columns of unit standard deviation. There are fewer if rows differ by rounding only."""
    moments = Moments.of(inputs)
    scale = moments.scale
    # k-means warns if rows differ by rounding only. Fewer points are then correct.
    with ignored("Number of distinct clusters", ConvergenceWarning):
        clusters = KMeans(n_inducing, n_init=1, max_iter=30, random_state=rng).fit((inputs - moments.mean) / scale)
    # The order of k-means++ is kept: the first ones are far apart. In sorted order, each would almost follow from the
    # one before, and Adam's steps in whitened coordinates would be smaller (its error on the pendulum grew by half).
    centres = moments.mean + clusters.cluster_centers_ * scale
    _, first = np.unique(centres, axis=0, return_index=True)
    return centres[np.sort(first)]


def _least_known(
    inputs: np.ndarray,
    n_inducing: int,
    kernel: Kernel,
    hyperparameters: np.ndarray,
    given: np.ndarray | None = None,
) -> np.ndarray:
    """Choose rows one after another, each with the largest variance given the rows before.

    Rows (n, d) are distinct. ``given`` (k, d) are points that count as chosen before. Of equal variances the first row
    is taken. If all variances are rounding errors, the row farthest from the chosen ones is next.
    """
    # (Burt, Rasmussen & van der Wilk 2020, section 4.2.3: the greedy maximum of the determinant of k(X_m, X_m).) It is
    # a Cholesky factorisation with pivots, O(n m²). ``rows`` (k + m, n) is the factor; given points are its first rows.
    prepared = kernel.prepare(inputs)
    variance = np.array(np.broadcast_to(kernel.at(hyperparameters, inputs[:1]).diagonal(prepared), len(inputs)))
    enough = _EXHAUSTED * variance.max()
    moments = Moments.of(inputs)
    scaled = (inputs - moments.mean) / moments.scale
    distance = np.full(len(inputs), np.inf)
    n_given = 0 if given is None else len(given)
    rows, chosen = np.empty((n_given + n_inducing, len(inputs))), np.empty(n_inducing, dtype=int)
    if given is not None:
        whitening = Whitening.of(kernel, hyperparameters, given)
        whitening.project(prepared, out=rows[:n_given])
        variance = whitening.unexplained(prepared, rows[:n_given])
        for point in (given - moments.mean) / moments.scale:
            distance = np.minimum(distance, ((scaled - point) ** 2).sum(axis=1))
    for count in range(n_given, n_given + n_inducing):
        known = count > 0 and not variance.max() > enough
        pivot = chosen[count - n_given] = int(np.argmax(distance if known else variance))
        distance = np.minimum(distance, ((scaled - scaled[pivot]) ** 2).sum(axis=1))
        if known:
            variance[:] = 0.0
            continue
        row = kernel.at(hyperparameters, inputs[[pivot]]).cross(prepared)[0]
        rows[count] = (row - rows[:count, pivot] @ rows[:count]) / np.sqrt(variance[pivot])
        variance = np.maximum(variance - rows[count] ** 2, 0.0)
        # Exactly 0, so that rounding errors do not let the row be chosen again.
        variance[pivot] = 0.0
    return inputs[chosen]
