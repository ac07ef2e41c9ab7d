"""Where inducing points start."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np
from sklearn.cluster import KMeans
from sklearn.exceptions import ConvergenceWarning

from ..data.rows import Moments
from ..exceptions import ignored
from ..model.statistics import Kernel, Whitening
from ..utils.validation import as_floats, check_magnitude
from .start import column_scale

# Points that there are first if their number is to be found.
_FIRST = 10
# On a sample of the rows the search costs a fraction of a second and places points as well as on all of them.
MAX_SAMPLE = 10_000
# The greedy search keeps so many numbers at most, 80 MB.
LARGEST_SEARCH = 10_000_000
# Below this share of the prior variance, what is left is rounding: it no longer tells which row is the least known.
_EXHAUSTED = 1e-10
# After the decimal point, of rows in units of their columns' scatter: those that agree in them are one and the same.
_DIGITS = 10


@dataclass(frozen=True)
class Placement:
    """How inducing points are chosen.

    Attributes
    ----------
    method : {"auto", "k-means", "greedy"} or ndarray of shape (m, d)
        ``"auto"`` starts as ``"k-means"``; or the points themselves, in the same units as the inputs.
    n_inducing : int
        At most so many points; an array brings its own number.
    max_inducing : int, optional
        At most so many in the end, if their number is to be found.
    """

    method: Literal["auto", "k-means", "greedy"] | np.ndarray
    n_inducing: int
    max_inducing: int | None = None

    @classmethod
    def of(cls, inducing_init: Any, n_inducing: int | str, max_inducing: int | None, n_columns: int) -> Placement:
        """What the arguments of these names say, for inputs of so many columns; points are checked."""
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
    def anew(self) -> Placement | None:
        """How to place them once more, when the kernel has learned something; None if they stay."""
        by_user = isinstance(self.method, np.ndarray)
        return replace(self, method="greedy") if not by_user and self.method == "auto" else None

    @property
    def sample_size(self) -> int:
        """How many rows are enough to choose from."""
        if isinstance(self.method, str) and self.method == "greedy":
            return greedy_sample_size(self.n_inducing)
        return max(MAX_SAMPLE, 10 * self.n_inducing)

    def points(
        self, inputs: np.ndarray, kernel: Kernel, hyperparameters: np.ndarray, rng: np.random.RandomState
    ) -> np.ndarray:
        """Choose the points.

        Parameters
        ----------
        inputs : ndarray of shape (n_rows, d)
            Of all rows, or of ``sample_size`` of them.
        kernel : Kernel
        hyperparameters : ndarray of shape (n_hyper,)
            As the kernel takes them; only ``"greedy"`` asks the kernel.
        rng : RandomState

        Returns
        -------
        inducing_points : ndarray of shape (m, d)
            With m = min(n_inducing, distinct rows): all distinct rows, in the order of their first appearance, if there
            are no more than ``n_inducing``. Rows that differ by rounding only are one.
        """
        if isinstance(self.method, np.ndarray):
            return self.method
        distinct = distinct_rows(inputs)
        if len(distinct) <= self.n_inducing:
            return distinct
        if self.method == "greedy":
            return _least_known(distinct[rng.permutation(len(distinct))], self.n_inducing, kernel, hyperparameters)
        return _cluster_centres(inputs, self.n_inducing, rng)


def greedy_sample_size(n_inducing: int) -> int:
    """How many rows are enough for a greedy search of so many points."""
    return max(2 * n_inducing, min(MAX_SAMPLE, LARGEST_SEARCH // n_inducing))


def distinct_rows(inputs: np.ndarray) -> np.ndarray:
    """Rows in the order of their first appearance; those that differ by rounding only are one."""
    _, first = np.unique(_rounded(inputs, Moments.of(inputs)), axis=0, return_index=True)
    return inputs[np.sort(first)]


def with_more(
    points: np.ndarray, n_inducing: int, inputs: np.ndarray, kernel: Kernel, hyperparameters: np.ndarray
) -> np.ndarray:
    """Inducing points, and after them the rows that are least known from all before.

    Parameters
    ----------
    points : ndarray of shape (m, d)
        Those that are there.
    n_inducing : int
        How many there are to be.
    inputs : ndarray of shape (n, d)
        Rows to choose from; of rows that are equally little known the first is taken.
    kernel : Kernel
    hyperparameters : ndarray of shape (n_hyper,)
        As the kernel takes them.

    Returns
    -------
    inducing_points : ndarray of shape (m + k, d)
        With k = n_inducing - m, or less where fewer rows are distinct from each other and from the points.
    """
    moments = Moments.of(inputs)
    _, first = np.unique(_rounded(np.vstack([points, inputs]), moments), axis=0, return_index=True)
    new = inputs[np.sort(first[first >= len(points)]) - len(points)]
    if len(new) > n_inducing - len(points):
        new = _least_known(new, n_inducing - len(points), kernel, hyperparameters, points)
    return np.vstack([points, new])


def are_all_rows(points: np.ndarray, inputs: np.ndarray) -> bool:
    """Whether each row (n, d) is among the points (m, d), but for rounding."""
    moments = Moments.of(inputs)
    known, rows = _rounded(points, moments), _rounded(inputs, moments)
    n_known = len(np.unique(known, axis=0))
    return n_known == len(np.unique(np.vstack([known, rows]), axis=0))


def _rounded(inputs: np.ndarray, moments: Moments) -> np.ndarray:
    """Rows in units of their columns' scatter, to the digits that count."""
    return np.round((inputs - moments.mean) / column_scale(moments), _DIGITS)


def _cluster_centres(inputs: np.ndarray, n_inducing: int, rng: np.random.RandomState) -> np.ndarray:
    """k-means, each column scaled to unit standard deviation; fewer points where rows differ by rounding only."""
    moments = Moments.of(inputs)
    scale = column_scale(moments)
    # Of rows that differ by rounding only: fewer points are then the right answer. (Other fits may warn meanwhile.)
    with ignored("Number of distinct clusters", ConvergenceWarning):
        clusters = KMeans(n_inducing, n_init=1, max_iter=30, random_state=rng).fit((inputs - moments.mean) / scale)
    # Kept in k-means++'s order, the first ones far apart: sorted, each would almost follow from the one before, and
    # Adam's steps in whitened coordinates would be smaller (its error on the pendulum grew by half).
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
    """One after the other the row whose variance given the rows before, k(x, x) - q(x, x), is the largest.

    (Burt, Rasmussen & van der Wilk 2020, "Convergence of sparse variational inference in Gaussian process regression",
    section 4.2.3: the greedy maximum of the determinant of k(X_m, X_m).) A Cholesky factorisation with pivots, O(n m²).
    Once every row follows from the chosen ones but for rounding, the row farthest from them is next. Points that are
    given count as chosen before: the Cholesky factor begins with their rows.

    Parameters
    ----------
    inputs : ndarray of shape (n, d)
        Distinct rows; of rows that are equally little known the first is taken.
    n_inducing : int
        m < n.
    kernel : Kernel
    hyperparameters : ndarray of shape (n_hyper,)
    given : ndarray of shape (k, d), optional
        Points that are none of the rows.

    Returns
    -------
    inducing_points : ndarray of shape (m, d)
    """
    prepared = kernel.prepare(inputs)
    variance = np.array(np.broadcast_to(kernel.at(hyperparameters, inputs[:1]).diagonal(prepared), len(inputs)))
    enough = _EXHAUSTED * variance.max()
    moments = Moments.of(inputs)
    scaled = (inputs - moments.mean) / column_scale(moments)
    distance = np.full(len(inputs), np.inf)
    n_given = 0 if given is None else len(given)
    rows, chosen = np.empty((n_given + n_inducing, len(inputs))), np.empty(n_inducing, dtype=int)
    if given is not None:
        whitening = Whitening.of(kernel, np.exp(hyperparameters), given)
        whitening.project(prepared, out=rows[:n_given])
        variance = whitening.unexplained(prepared, rows[:n_given])
        for point in (given - moments.mean) / column_scale(moments):
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
        # Exactly: what rounding leaves of it must not be chosen again.
        variance[pivot] = 0.0
    return inputs[chosen]
