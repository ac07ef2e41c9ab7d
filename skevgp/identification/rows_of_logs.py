"""Correlated rows of a log: how much information they have, and which are held out together."""

from __future__ import annotations

import numpy as np

# If one group has at least this share of the rows, groups are cut into this number of blocks.
_LARGEST_SHARE, _BLOCKS = 0.8, 5


def correlation_time(errors: np.ndarray, runs: np.ndarray) -> float:
    """Return the number of rows, from 1 to n, with as much information as one independent row."""
    # This is 1 + 2 Σ ρ_k with the autocorrelations ρ_k of the errors (n,) in the order of time. The sum ends at the
    # first pair of neighbouring lags whose sum is not positive (Geyer 1992, "Practical Markov chain Monte Carlo",
    # initial positive sequence). Rows of different runs (n,) do not count as neighbours.
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


def evenly_spread(n_rows: int, most: int) -> np.ndarray:
    """Return the indices of evenly spread rows, at most the given number."""
    return np.unique(np.linspace(0, n_rows - 1, min(n_rows, most)).astype(int))


def blocks_of(groups: np.ndarray | None, n_rows: int) -> np.ndarray:
    """Return labels (n,) from 0 of rows that are held out together: whole groups, or blocks of successive rows."""
    # Blocks are used if there are fewer than three groups, or if one group has _LARGEST_SHARE of the rows or more. If
    # there are more groups than _BLOCKS, groups are joined to blocks of similar size.
    labels = np.zeros(n_rows, dtype=int) if groups is None else np.unique(groups, return_inverse=True)[1].ravel()
    sizes = np.bincount(labels)
    if len(sizes) > 2 and sizes.max() < _LARGEST_SHARE * n_rows:
        return _joined(sizes)[labels] if len(sizes) > _BLOCKS else labels
    blocks = np.zeros(n_rows, dtype=int)
    for group, size in enumerate(sizes):
        parts = max(1, min(size, round(_BLOCKS * size / n_rows)))
        blocks[labels == group] = blocks.max() + (group > 0) + np.arange(size) * parts // size
    return blocks


def groups_of(groups: np.ndarray | None, blocks: np.ndarray) -> np.ndarray:
    """Return labels (n,) of sets of rows that may differ as a whole: the groups if there are several, else blocks."""
    if groups is None or len(np.unique(groups)) < 2:
        return blocks
    return np.unique(groups, return_inverse=True)[1].ravel()


def _joined(sizes: np.ndarray) -> np.ndarray:
    """Return the block of each group. From the largest on, a group joins the block with the fewest rows."""
    blocks, rows = np.zeros(len(sizes), dtype=int), np.zeros(_BLOCKS)
    for group in np.argsort(-sizes, kind="stable"):
        blocks[group] = np.argmin(rows)
        rows[blocks[group]] += sizes[group]
    return blocks
