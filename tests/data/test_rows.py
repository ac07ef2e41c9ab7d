"""Rows by index, sums over pieces, parts, moments; in internal units blocks, samples and mini-batches of them."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from skevgp.data.rows import LocalSource, Moments, RawRows, Rows, block_of, moments_of_rows

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


def test_block_is_of_prepared_inputs_features_and_some_residuals():
    raw = LocalSource.holding(RawRows(X, H, Y)).take(np.arange(4))
    block = block_of(raw, (Identity(),), halved, slice(1, 2))
    np.testing.assert_array_equal(block.prepared, X[:4])
    np.testing.assert_array_equal(block.features, H[:4])
    np.testing.assert_array_equal(block.residuals, 0.5 * Y[:4, 1:])
    np.testing.assert_array_equal(block_of(raw, (Identity(),), halved).residuals, 0.5 * Y[:4])


def test_scatter_of_what_does_not_vary_is_1():
    np.testing.assert_array_equal(rows(np.full((400, 2), 7.0)).scatter(), 1.0)


def test_sample_is_all_rows_or_some_in_their_order():
    rng = np.random.RandomState(0)
    state = rng.get_state()[1].tolist()
    np.testing.assert_array_equal(rows().sample(400, rng).inputs, X)
    assert rng.get_state()[1].tolist() == state  # nothing is drawn
    sample = rows().sample(40, rng).inputs
    places = [int(np.flatnonzero((row == X).all(axis=1))[0]) for row in sample]
    assert len(places) == 40
    assert (np.diff(places) > 0).all()


@pytest.mark.parametrize("shuffled_rows", [40, 2**18])
def test_every_row_gets_into_mini_batches_however_many_there_are(shuffled_rows, monkeypatch):
    monkeypatch.setattr("skevgp.data.rows._SHUFFLED_ROWS", shuffled_rows)
    numbered = Rows(LocalSource.holding(RawRows(np.arange(400.0)[:, np.newaxis], H, Y)), lambda raw: raw)
    batches = numbered.batches(Identity(), 32, np.random.RandomState(0))
    seen = [batch.block.prepared[:, 0] for batch in islice(batches, 160)]
    assert {len(batch) for batch in seen} == {32}
    assert all(len(set(batch)) == 32 for batch in seen)
    assert set(np.concatenate(seen)) == set(range(400))
