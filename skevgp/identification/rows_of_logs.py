"""What the rows of a log are worth: they follow each other, and signals were filtered."""

from __future__ import annotations

import numpy as np

# Groups of which one has this share of the rows say nothing of others: they are cut into so many blocks.
_LARGEST_SHARE, _BLOCKS = 0.5, 5


def correlation_time(errors: np.ndarray, runs: np.ndarray) -> float:
    """How many rows say as much as one independent row: 1 + 2 Σ ρ_k, with the autocorrelations ρ_k of the errors.

    Summed up to the first pair of neighbouring lags whose sum is not positive (Geyer 1992, "Practical Markov chain
    Monte Carlo", initial positive sequence).

    Parameters
    ----------
    errors : ndarray of shape (n,)
        In the order of time.
    runs : ndarray of shape (n,)
        Labels of the runs without gaps; no product is taken across them.

    Returns
    -------
    time : float
        In rows, from 1 to n.
    """
    total = np.zeros(0)
    for run in np.unique(runs):
        part = errors[runs == run]
        wave = np.fft.rfft(part, 2 * len(part))
        products = np.fft.irfft(wave * wave.conj(), 2 * len(part))[: len(part)]
        longer, shorter = (total, products) if len(total) > len(products) else (products, total)
        longer[: len(shorter)] += shorter
        total = longer
    if not total[0] > 0.0:
        return 1.0
    pairs = total[: len(total) // 2 * 2].reshape(-1, 2).sum(axis=1) / total[0]
    negative = np.flatnonzero(pairs <= 0.0)
    positive = pairs[: negative[0] if len(negative) else len(pairs)]
    return float(np.clip(2.0 * positive.sum() - 1.0, 1.0, len(errors)))


def blocks_of(groups: np.ndarray | None, n_rows: int) -> np.ndarray:
    """Labels (n,) from 0 of what is left out together: the groups, or blocks of rows that follow each other.

    Blocks stand in where there is one group, or one has half of the rows or more; more groups than blocks are joined.
    """
    if groups is not None:
        _, labels, sizes = np.unique(groups, return_inverse=True, return_counts=True)
        if len(sizes) > 1 and sizes.max() < _LARGEST_SHARE * n_rows:
            return labels % _BLOCKS if len(sizes) > _BLOCKS else labels
    return np.arange(n_rows) * min(_BLOCKS, n_rows) // n_rows
