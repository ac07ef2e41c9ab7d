"""A data set in the user's units: rows by index, sums over pieces, parts, and the moments of columns."""

import pickle

import numpy as np
import pytest

from skevgp.data.blocks import Block
from skevgp.data.source import LocalSource, Moments, RawRows, moments_of_rows
from skevgp.data.threads import BlockMap

RNG = np.random.RandomState(0)
X, H, Y = RNG.uniform(-2.0, 2.0, (400, 2)), RNG.randn(400, 3), RNG.randn(400, 1)


@pytest.fixture
def source(monkeypatch):
    """Passes see seven rows at once."""
    monkeypatch.setattr("skevgp.data.source.PASS_ROWS", 7)
    return LocalSource.of(X, H, Y)


def test_moments_of_pieces_are_those_of_the_whole():
    values = RNG.randn(100, 3) * [1.0, 1e-3, 0.0] + [1e6, 0.0, 7.0]
    whole = Moments.of(values)
    pieces = Moments.of(values[:1]) + Moments.of(values[1:40]) + Moments.of(values[40:])
    np.testing.assert_allclose(pieces.mean, values.mean(axis=0), rtol=1e-15)
    np.testing.assert_allclose(pieces.variance, values.var(axis=0), rtol=1e-9)
    np.testing.assert_allclose(pieces.rms, np.sqrt(np.mean(values**2, axis=0)), rtol=1e-14)
    for name in ("n", "lowest", "highest"):
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name))
    np.testing.assert_array_equal(pieces.largest, np.abs(values).max(axis=0))
    assert pieces.variance[2] == 0.0
    assert pieces.mean[2] == 7.0


def test_the_mean_of_equal_numbers_is_that_number():
    """Whatever rounding makes of their sum."""
    for value in (0.1, 1 / 3, 1e20 / 7):
        moments = Moments.of(np.full((49, 1), value))
        assert moments.mean == value
        assert moments.squares == 0.0


def test_rows_are_taken_by_index_and_in_that_order(source):
    raw = source.take(np.array([5, 2, 5]))
    for found, expected in [(raw.inputs, X), (raw.features, H), (raw.targets, Y)]:
        np.testing.assert_array_equal(found, expected[[5, 2, 5]])


def test_sums_are_over_pieces_in_order(source):
    assert source.sum(lambda raw: [len(raw.inputs)]) == [7] * 57 + [1]
    assert source.sum(lambda raw: raw.inputs[:, 0].tolist()) == X[:, 0].tolist()
    for found, values in zip(source.sum(moments_of_rows), (X, H, Y), strict=True):
        np.testing.assert_allclose(found.mean, values.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(found.variance, values.var(axis=0), rtol=1e-12)


def test_a_part_is_some_rows_and_has_parts_itself(source):
    part = source.part(100, 131)
    assert part.n_rows == 31
    assert part.sum(lambda raw: raw.targets[:, 0].tolist()) == Y[100:131, 0].tolist()
    np.testing.assert_array_equal(part.take(np.array([0, 30])).inputs, X[[100, 130]])
    np.testing.assert_array_equal(part.part(30, 31).take(np.array([0])).inputs, X[[130]])
    # The rows that follow are not its own.
    np.testing.assert_array_equal(part.load(slice(28, 50)).inputs, X[128:131])


def test_blocks_are_made_of_the_loaded_rows(source):
    def make(raw):
        assert isinstance(raw, RawRows)
        return Block(raw.inputs, np.hstack([raw.features, raw.targets]), raw.features.shape[1])

    for own, expected in [(source, H), (source.part(3, 90), H[3:90])]:
        sums = own.blocks(make, 10, BlockMap(), 1.0).linear
        assert sums.n_rows == len(expected)
        np.testing.assert_allclose(sums.HH, expected.T @ expected, rtol=1e-12)


class Loads:
    def __call__(self, rows):
        return RawRows(X[rows], H[rows], Y[rows])


def test_what_is_sent_to_workers_can_be_pickled():
    part = pickle.loads(pickle.dumps(LocalSource(Loads(), 400).part(10, 20)))
    np.testing.assert_array_equal(part.take(np.arange(10)).inputs, X[10:20])
