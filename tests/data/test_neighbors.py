"""Nearest rows against sorting all distances."""

import numpy as np
import pytest

from skevgp.data.neighbors import NONE, NearestRows, nearest_earlier

RNG = np.random.RandomState(0)


def sorted_distances(rows, others):
    return np.sort(np.linalg.norm(rows[:, np.newaxis] - others, axis=2), axis=1)


@pytest.mark.parametrize("d", [1, 3, 8, 20])
def test_nearest_rows_are_almost_as_near_as_the_nearest(d):
    rows, new = RNG.randn(700, d), RNG.randn(40, d)
    for k in (1, 10, 699, 700, 900):
        found = NearestRows(rows).of(new, k)
        assert found.shape == (40, min(k, 700))
        assert all(len(set(chosen)) == len(chosen) for chosen in found.tolist())
        distances = np.sort(np.linalg.norm(rows[found] - new[:, np.newaxis], axis=2), axis=1)
        assert (distances <= 1.5 * sorted_distances(new, rows)[:, : found.shape[1]] + 1e-12).all()


@pytest.mark.parametrize("k", [0, 1, 7, 150])
@pytest.mark.parametrize("first", [0, 600, 1199])
def test_earlier_rows(k, first):
    """Only earlier ones, as many as there are, and almost the nearest. For k of all earlier rows they are all."""
    rows = RNG.randn(1200, 3)
    found = nearest_earlier(rows, k, first)
    assert found.shape == (1200 - first, k)
    for row, chosen in zip(range(first, 1200), found, strict=True):
        chosen = chosen[chosen != NONE]
        assert len(set(chosen)) == len(chosen) == min(k, row)
        assert (chosen < row).all()
        if len(chosen):
            farthest = np.linalg.norm(rows[chosen] - rows[row], axis=1).max()
            assert farthest <= 1.5 * sorted_distances(rows[[row]], rows[:row])[0, len(chosen) - 1]


def test_rows_without_coordinates_or_with_copies():
    np.testing.assert_array_equal(nearest_earlier(np.empty((3, 0)), 2), [[NONE, NONE], [0, NONE], [0, 1]])
    found = nearest_earlier(np.zeros((900, 2)), 5)
    assert ((found < np.arange(900)[:, np.newaxis]) & (found >= NONE)).all()
    assert (found[5:] != NONE).all()
