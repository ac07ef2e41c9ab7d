"""Where inducing points start."""

from __future__ import annotations

import numpy as np
from sklearn.cluster import KMeans

# k-means on a sample of the rows costs a fraction of a second and places points as well as on all of them.
MAX_SAMPLE = 10_000


def initial_inducing_points(inputs: np.ndarray, n_inducing: int, rng: np.random.RandomState) -> np.ndarray:
    """Cluster centres of the kernel's inputs, each column scaled to unit standard deviation.

    Parameters
    ----------
    inputs : ndarray of shape (n_rows, d)
    n_inducing : int
        At most so many points.
    rng : RandomState

    Returns
    -------
    inducing_points : ndarray of shape (m, d)
        With m = min(n_inducing, distinct rows): all distinct rows, in the order of their first appearance, if there
        are no more than ``n_inducing``.
    """
    if len(inputs) > MAX_SAMPLE:
        inputs = inputs[np.sort(rng.choice(len(inputs), MAX_SAMPLE, replace=False))]
    _, first = np.unique(inputs, axis=0, return_index=True)
    if len(first) <= n_inducing:
        return inputs[np.sort(first)]
    scale = inputs.std(axis=0)
    scale[scale == 0.0] = 1.0
    clusters = KMeans(n_inducing, n_init=1, max_iter=30, random_state=rng).fit(inputs / scale)
    return clusters.cluster_centers_ * scale
