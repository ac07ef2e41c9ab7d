"""The rows as the inference sees them: in internal units, some outputs of them, blocks and mini-batches."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from skevgp.data.internal import MakeBlock, Rows
from skevgp.data.source import LocalSource

RNG = np.random.RandomState(0)
X, H, Y = RNG.randn(150, 2), RNG.randn(150, 3), RNG.randn(150, 2) * [1.0, 5.0]


class Identity:
    """The only thing that rows ask of a kernel."""

    def prepare(self, inputs):
        return inputs


def halved(raw):
    """To other units."""
    return replace(raw, targets=0.5 * raw.targets)


def rows(targets=Y, **options):
    return Rows(LocalSource.of(X, H, targets), halved, **options)


def test_a_block_is_of_prepared_inputs_features_and_some_residuals():
    raw = LocalSource.of(X, H, Y).take(np.arange(4))
    block = MakeBlock((Identity(),), halved, slice(1, 2))(raw)
    np.testing.assert_array_equal(block.prepared, X[:4])
    np.testing.assert_array_equal(block.features, H[:4])
    np.testing.assert_array_equal(block.residuals, 0.5 * Y[:4, 1:])
    np.testing.assert_array_equal(MakeBlock((Identity(),), halved)(raw).residuals, 0.5 * Y[:4])


def test_moments_are_of_inputs_and_residuals_in_internal_units():
    own = rows()
    assert len(own) == own.inputs.n == 150
    np.testing.assert_allclose(own.inputs.mean, X.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(own.residuals.variance, 0.25 * Y.var(axis=0), rtol=1e-12)
    np.testing.assert_allclose(own.scatter(), 0.25 * Y.var(axis=0), rtol=1e-12)


def test_the_scatter_of_what_does_not_vary_is_1():
    np.testing.assert_array_equal(rows(np.full((150, 2), 7.0)).scatter(), 1.0)


def test_some_outputs():
    own = rows().outputs(slice(1, 2), 0.25)
    assert own.share == 0.25
    np.testing.assert_allclose(own.scatter(), 0.25 * Y[:, 1:].var(axis=0), rtol=1e-12)
    np.testing.assert_array_equal(own.some(np.array([3, 1])).targets, 0.5 * Y[[3, 1], 1:])
    np.testing.assert_allclose(own.blocks(Identity(), 6).linear.RR, np.sum((0.5 * Y[:, 1:]) ** 2, axis=0), rtol=1e-12)
    # Moments of the residuals are those of all outputs.
    assert own.residuals.mean.shape == (2,)


def test_a_part_is_of_consecutive_rows_and_has_a_share_of_the_share():
    part = rows(share=0.5).part(20, 30, 0.1)
    assert (len(part), part.share) == (10, 0.05)
    np.testing.assert_allclose(part.blocks(Identity(), 6).linear.HH, H[20:30].T @ H[20:30], rtol=1e-12)


def test_a_sample_is_all_rows_or_some_in_their_order():
    rng = np.random.RandomState(0)
    state = rng.get_state()[1].tolist()
    np.testing.assert_array_equal(rows().sample(150, rng).inputs, X)
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
    monkeypatch.setattr("skevgp.data.internal._SHUFFLED_ROWS", shuffled_rows)
    numbered = Rows(LocalSource.of(np.arange(150.0)[:, np.newaxis], H, Y), lambda raw: raw)
    batches = numbered.batches(Identity(), 32, np.random.RandomState(0))
    seen = [batch.block.prepared[:, 0] for batch in islice(batches, 60)]
    assert {len(batch) for batch in seen} == {32}
    assert all(len(set(batch)) == 32 for batch in seen)
    assert set(np.concatenate(seen)) == set(range(150))


def test_an_epoch_has_no_row_twice():
    numbered = Rows(LocalSource.of(np.arange(150.0)[:, np.newaxis], H, Y), lambda raw: raw)
    batches = numbered.batches(Identity(), 50, np.random.RandomState(0))
    for _ in range(3):
        epoch = np.concatenate([next(batches).block.prepared[:, 0] for _ in range(3)])
        assert set(epoch) == set(range(150))


def test_a_batch_larger_than_the_data_is_all_rows():
    batch = next(rows().outputs(slice(0, 1)).batches(Identity(), 1000, np.random.RandomState(0)))
    assert batch.linear.n_rows == 150
    assert batch.block.residuals.shape == (150, 1)


def test_batches_follow_the_generator():
    first, again, other = (
        next(rows().batches(Identity(), 20, np.random.RandomState(seed))).block.prepared for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_a_sample_is_some_of_the_rows_once_each_in_random_order():
    sample = rows().sampled(60, np.random.RandomState(3))
    got = sample.some(np.arange(60))
    found = [int(np.flatnonzero((one == X).all(axis=1))[0]) for one in got.inputs]
    assert len(set(found)) == 60
    assert found != sorted(found)
    np.testing.assert_array_equal(got.features, H[found])
    np.testing.assert_array_equal(got.targets, 0.5 * Y[found])
    # Its beginning is a sample, too.
    np.testing.assert_array_equal(sample.part(0, 20, 1.0).some(np.arange(20)).inputs, got.inputs[:20])
