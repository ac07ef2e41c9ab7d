"""Rows by index, sums over pieces, parts, moments; in internal units blocks, samples and mini-batches of them."""

import pickle
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from skevgp.data.blocks import Block
from skevgp.data.rows import LocalSource, Moments, RawRows, Rows, block_of, moments_of_rows
from skevgp.data.threads import BlockMap

RNG = np.random.RandomState(0)
X, H, Y = RNG.uniform(-2.0, 2.0, (400, 2)), RNG.randn(400, 3), RNG.randn(400, 2) * [1.0, 5.0]


@pytest.fixture
def source(monkeypatch):
    """Passes see seven rows at once."""
    monkeypatch.setattr("skevgp.data.rows.PASS_ROWS", 7)
    return LocalSource.holding(RawRows(X, H, Y))


def test_moments_of_pieces_are_those_of_the_whole():
    values = np.random.RandomState(1).randn(100, 3) * [1.0, 1e-3, 0.0] + [1e6, 0.0, 7.0]
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


def test_some_rows_are_a_source_of_which_some_can_be_chosen(source):
    part = source.some(np.arange(100, 131))
    assert part.n_rows == 31
    assert part.sum(lambda raw: raw.targets[:, 0].tolist()) == Y[100:131, 0].tolist()
    np.testing.assert_array_equal(part.take(np.array([0, 30])).inputs, X[[100, 130]])
    np.testing.assert_array_equal(part.some(np.array([30])).take(np.array([0])).inputs, X[[130]])
    # The rows that follow are not its own.
    np.testing.assert_array_equal(part.take(slice(28, 50)).inputs, X[128:131])


def test_blocks_are_made_of_the_loaded_rows(source):
    def make(raw):
        assert isinstance(raw, RawRows)
        return Block(raw.inputs, np.hstack([raw.features, raw.targets]), raw.features.shape[1])

    for own, expected in [(source, H), (source.some(np.arange(3, 90)), H[3:90])]:
        sums = own.blocks(make, 10, BlockMap(), 1.0).linear
        assert sums.n_rows == len(expected)
        np.testing.assert_allclose(sums.HH[0], expected.T @ expected, rtol=1e-12)


class Loads:
    def __call__(self, rows):
        return RawRows(X[rows], H[rows], Y[rows])


def test_what_is_sent_to_workers_can_be_pickled():
    part = pickle.loads(pickle.dumps(LocalSource(Loads(), 400).some(np.arange(10, 20))))
    np.testing.assert_array_equal(part.take(np.arange(10)).inputs, X[10:20])


# --- in internal units ------------------------------------------------------------------------------------------------


class Identity:
    """The only thing that rows ask of a kernel."""

    def prepare(self, inputs):
        return inputs


def halved(raw):
    """To other units."""
    return replace(raw, targets=0.5 * raw.targets)


def rows(targets=Y, **options):
    return Rows(LocalSource.holding(RawRows(X, H, targets)), halved, **options)


def test_a_block_is_of_prepared_inputs_features_and_some_residuals():
    raw = LocalSource.holding(RawRows(X, H, Y)).take(np.arange(4))
    block = block_of(raw, (Identity(),), halved, slice(1, 2))
    np.testing.assert_array_equal(block.prepared, X[:4])
    np.testing.assert_array_equal(block.features, H[:4])
    np.testing.assert_array_equal(block.residuals, 0.5 * Y[:4, 1:])
    np.testing.assert_array_equal(block_of(raw, (Identity(),), halved).residuals, 0.5 * Y[:4])


def test_moments_are_of_inputs_and_residuals_in_internal_units():
    own = rows()
    assert len(own) == own.inputs.n == 400
    np.testing.assert_allclose(own.inputs.mean, X.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(own.residuals.variance, 0.25 * Y.var(axis=0), rtol=1e-12)
    np.testing.assert_allclose(own.scatter(), 0.25 * Y.var(axis=0), rtol=1e-12)


def test_the_scatter_of_what_does_not_vary_is_1():
    np.testing.assert_array_equal(rows(np.full((400, 2), 7.0)).scatter(), 1.0)


def test_some_outputs():
    own = rows().outputs(slice(1, 2), 0.25)
    assert own.share == 0.25
    np.testing.assert_allclose(own.scatter(), 0.25 * Y[:, 1:].var(axis=0), rtol=1e-12)
    np.testing.assert_array_equal(own.some(np.array([3, 1])).targets, 0.5 * Y[[3, 1], 1:])
    np.testing.assert_allclose(own.blocks(Identity(), 6).linear.RR, np.sum((0.5 * Y[:, 1:]) ** 2, axis=0), rtol=1e-12)
    # Moments of the residuals are those of all outputs.
    assert own.residuals.mean.shape == (2,)


def test_a_subset_has_a_share_of_the_share():
    part = rows(share=0.5).subset(np.arange(20, 30), 0.1)
    assert (len(part), part.share) == (10, 0.05)
    np.testing.assert_allclose(part.blocks(Identity(), 6).linear.HH[0], H[20:30].T @ H[20:30], rtol=1e-12)


def test_a_sample_is_all_rows_or_some_in_their_order():
    rng = np.random.RandomState(0)
    state = rng.get_state()[1].tolist()
    np.testing.assert_array_equal(rows().sample(400, rng).inputs, X)
    assert rng.get_state()[1].tolist() == state  # nothing is drawn
    sample = rows().sample(40, rng).inputs
    places = [int(np.flatnonzero((row == X).all(axis=1))[0]) for row in sample]
    assert len(places) == 40
    assert (np.diff(places) > 0).all()


def test_blocks_sum_to_the_whole():
    sums = rows().blocks(Identity(), 6).linear
    np.testing.assert_allclose(sums.HR, H.T @ (0.5 * Y), rtol=1e-12)


@pytest.mark.parametrize("shuffled_rows", [40, 2**18])
def test_every_row_gets_into_mini_batches_however_many_there_are(shuffled_rows, monkeypatch):
    monkeypatch.setattr("skevgp.data.rows._SHUFFLED_ROWS", shuffled_rows)
    numbered = Rows(LocalSource.holding(RawRows(np.arange(400.0)[:, np.newaxis], H, Y)), lambda raw: raw)
    batches = numbered.batches(Identity(), 32, np.random.RandomState(0))
    seen = [batch.block.prepared[:, 0] for batch in islice(batches, 160)]
    assert {len(batch) for batch in seen} == {32}
    assert all(len(set(batch)) == 32 for batch in seen)
    assert set(np.concatenate(seen)) == set(range(400))


def test_an_epoch_has_no_row_twice():
    numbered = Rows(LocalSource.holding(RawRows(np.arange(400.0)[:, np.newaxis], H, Y)), lambda raw: raw)
    batches = numbered.batches(Identity(), 50, np.random.RandomState(0))
    for _ in range(3):
        epoch = np.concatenate([next(batches).block.prepared[:, 0] for _ in range(8)])
        assert set(epoch) == set(range(400))


def test_a_batch_larger_than_the_data_is_all_rows():
    batch = next(rows().outputs(slice(0, 1)).batches(Identity(), 1000, np.random.RandomState(0)))
    assert batch.linear.n_rows == 400
    assert batch.block.residuals.shape == (400, 1)


def test_batches_follow_the_generator():
    first, again, other = (
        next(rows().batches(Identity(), 20, np.random.RandomState(seed))).block.prepared for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_a_sample_is_some_of_the_rows_once_each_in_random_order():
    sample = rows().random_subset(60, np.random.RandomState(3))
    got = sample.some(np.arange(60))
    found = [int(np.flatnonzero((one == X).all(axis=1))[0]) for one in got.inputs]
    assert len(set(found)) == 60
    assert found != sorted(found)
    np.testing.assert_array_equal(got.features, H[found])
    np.testing.assert_array_equal(got.targets, 0.5 * Y[found])
    # Its beginning is a sample, too.
    np.testing.assert_array_equal(sample.subset(np.arange(20)).some(np.arange(20)).inputs, got.inputs[:20])
