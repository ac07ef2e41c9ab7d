import numpy as np
import pandas as pd
import pytest

from skevgp.data import weights as module
from skevgp.data.weights import Chosen, rows_of

RNG = np.random.RandomState(0)
X = RNG.randint(0, 3, (60, 2)).astype(float)
Y = RNG.randint(0, 2, (60, 1)).astype(float)


def seen(chosen, X=X, Y=Y):
    """The rows that a fit sees, with how often they count."""
    rows = slice(None) if chosen.positions is None else chosen.positions
    counts = np.ones(chosen.n_rows) if chosen.counts is None else chosen.counts
    return np.column_stack([X[rows], Y[rows], counts])


def test_few_rows_are_ordered_and_equal_ones_joined():
    once = Chosen.of(X, Y)
    rows = seen(once)
    distinct, counts = np.unique(np.hstack([X, Y]), axis=0, return_counts=True)
    np.testing.assert_array_equal(rows, np.column_stack([distinct, counts]))
    np.testing.assert_array_equal(once.precision, counts)
    order = RNG.permutation(60)
    np.testing.assert_array_equal(seen(Chosen.of(X[order], Y[order]), X[order], Y[order]), rows)


def test_first_of_rows_that_were_joined_is_named_and_each_finds_its_own():
    once = Chosen.of(X, Y)
    for index, position in enumerate(once.positions):
        same = np.flatnonzero((np.hstack([X, Y]) == np.hstack([X, Y])[position]).all(axis=1))
        assert position == same[0]
        np.testing.assert_array_equal(np.flatnonzero(once.as_given(np.arange(once.n_rows)) == index), same)
    np.testing.assert_array_equal(np.sort(once.unmerged), np.arange(60))


def test_rows_of_other_labels_or_noise_are_others():
    labels = RNG.randint(0, 2, 60)
    apart = Chosen.of(X, Y, groups=labels)
    assert apart.n_rows == len(np.unique(np.column_stack([X, Y, labels]), axis=0))
    for position, row in zip(apart.unmerged, apart.merged_into[apart.unmerged], strict=True):
        assert labels[position] == labels[apart.positions[row]]
    variance = 1.0 + labels
    noisy = Chosen.of(X, Y, None, variance)
    np.testing.assert_array_equal(noisy.counts, apart.counts)
    np.testing.assert_allclose(noisy.precision, noisy.counts / variance[noisy.positions])


@pytest.mark.parametrize("ordered", [True, False])
def test_many_rows_and_new_ones_stay_in_their_order(ordered, monkeypatch):
    if ordered:
        monkeypatch.setattr(module, "ORDERED_ROWS", 10)
    assert Chosen.of(X, Y, ordered=ordered) == Chosen(60)
    counts = np.tile([0.0, 2.0, 1.0], 20)
    chosen = Chosen.of(X, Y, counts, 0.5 * np.ones(60), ordered=ordered)
    np.testing.assert_array_equal(chosen.positions, np.flatnonzero(counts))
    np.testing.assert_array_equal(chosen.counts, counts[counts > 0])
    np.testing.assert_array_equal(chosen.precision, 2.0 * counts[counts > 0])
    np.testing.assert_array_equal(chosen.as_given(chosen.counts)[counts > 0], counts[counts > 0])


def test_negative_zero_is_zero_and_words_of_a_frame_are_told_apart():
    zeros = np.array([[0.0], [-0.0], [1.0]])
    assert Chosen.of(zeros, np.array([-0.0, 0.0, 0.0])).n_rows == 2
    frame = pd.DataFrame({"x": [1.0, 0.0, 1.0, 1.0], "word": ["a", "b", "a", "b"]})
    chosen = Chosen.of(frame, np.zeros(4))
    np.testing.assert_array_equal(chosen.positions, [1, 0, 3])
    np.testing.assert_array_equal(chosen.counts, [1.0, 2.0, 1.0])
    assert rows_of(frame, chosen.positions)["word"].tolist() == ["b", "a", "b"]
