"""Where inducing points start."""

from __future__ import annotations

import warnings

import numpy as np
from sklearn.cluster import KMeans
from sklearn.exceptions import ConvergenceWarning

from .source import Moments
from .start import spread_of

# k-means on a sample of the rows costs a fraction of a second and places points as well as on all of them.
MAX_SAMPLE = 10_000


def sample_size(n_inducing: int) -> int:
    """How many rows are enough to place so many points."""
    return max(MAX_SAMPLE, 10 * n_inducing)


def initial_inducing_points(inputs: np.ndarray, n_inducing: int, rng: np.random.RandomState) -> np.ndarray:
    """Cluster centres of the kernel's inputs, each column scaled to unit standard deviation.

    Parameters
    ----------
    inputs : ndarray of shape (n_rows, d)
        Centred; of all rows, or of `sample_size` of them.
    n_inducing : int
        At most so many points.
    rng : RandomState

    Returns
    -------
    inducing_points : ndarray of shape (m, d)
        With m = min(n_inducing, distinct rows): all distinct rows, in the order of their first appearance, if there
        are no more than ``n_inducing``.
    """
    _, first = np.unique(inputs, axis=0, return_index=True)
    if len(first) <= n_inducing:
        return inputs[np.sort(first)]
    scale = spread_of(Moments.of(inputs))
    with warnings.catch_warnings():
        # Of rows that differ by rounding only: fewer points are then the right answer.
        warnings.simplefilter("ignore", ConvergenceWarning)
        clusters = KMeans(n_inducing, n_init=1, max_iter=30, random_state=rng).fit(inputs / scale)
    # Kept in k-means++'s order, the first ones far apart: sorted, each would almost follow from the one before, and
    # Adam's steps in whitened coordinates would be smaller (its error on the pendulum grew by half).
    _, first = np.unique(clusters.cluster_centers_, axis=0, return_index=True)
    return clusters.cluster_centers_[np.sort(first)] * scale
