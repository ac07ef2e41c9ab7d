"""Rows in blocks: what one holds, which are kept, and sums that do not depend on how."""

import numpy as np
import pytest

from skevgp.data.blocks import KEEP_BYTES, Block, LinearSums, LocalBlocks, block_rows
from skevgp.data.threads import BlockMap

RNG = np.random.RandomState(0)
H, R = RNG.randn(50, 3), RNG.randn(50, 2)
LINEAR = np.hstack([H, R])


def block(rows=slice(None)):
    return Block(LINEAR[rows], LINEAR[rows], 3)


def blocks(made=None, n_inducing=6, **options):
    """The rows above in blocks of seven; ``made`` is told the slices of those that are made."""

    def make(rows):
        if made is not None:
            made.append((rows.start, rows.stop))
        return block(rows)

    return LocalBlocks(make, 50, n_inducing, **{"size": 7, **options})


def test_sums_that_depend_on_no_parameter():
    sums = LinearSums.of_block(block())
    assert sums.n_rows == 50
    for found, expected in [(sums.HH[0], H.T @ H), (sums.HR, H.T @ R), (sums.RR, np.sum(R**2, axis=0))]:
        np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("n_inducing", [0, 1, 10, 100, 1000, 10**6])
def test_block_fits_a_cache_and_is_worth_a_call(n_inducing):
    assert 512 <= block_rows(n_inducing) <= 8192
    assert block_rows(n_inducing) * n_inducing <= max(2**16, 512 * n_inducing)


@pytest.mark.parametrize("n_inducing", [1, 10, 100, 1000])
def test_blocks_cover_all_rows_once(n_inducing):
    n = 10_001
    own = LocalBlocks(lambda rows: Block(None, np.ones((rows.stop - rows.start, 1)), 0), n, n_inducing)
    sizes = [len(own[index].linear) for index in range(len(own))]
    assert sum(sizes) == n
    assert set(sizes[:-1]) == {block_rows(n_inducing)}
    assert own.linear.n_rows == n


def test_order_of_a_sum_is_that_of_the_rows():
    assert blocks(size=1).sum(lambda own: [float(own.linear[0, 0])]) == H[:, 0].tolist()
    n = 1000  # more blocks than groups
    own = LocalBlocks(lambda rows: Block(None, np.full((1, 1), rows.start), 0), n, 6, size=1)
    assert own.sum(lambda one: [int(one.linear[0, 0])]) == list(range(n))


def test_blocks_that_memory_allows_are_made_once():
    made = []
    own = blocks(made)
    for _ in range(3):
        own.sum(LinearSums.of_block)
    assert sorted(made) == [(first, min(first + 7, 50)) for first in range(0, 50, 7)]
    assert own[0] is own[0]


def test_first_pass_leaves_something_for_the_second_only_where_all_of_it_fits():
    enough = 16 * 1000 * 50 / KEEP_BYTES
    for options, may_keep in [
        ({}, True),
        ({"keep": False}, False),
        ({"share": 1.01 * enough}, True),
        ({"share": 0.99 * enough}, False),
    ]:
        own = blocks(n_inducing=1000, **options)
        assert {own[index].may_keep for index in range(len(own))} == {may_keep}, options


@pytest.mark.parametrize("share", [1.0, 0.0])
def test_threads_do_not_change_the_bits(share):
    rows = np.random.RandomState(1).randn(30_000, 4)
    sums = []
    for n_threads in (1, 3):
        threads = BlockMap(n_threads)
        own = LocalBlocks(lambda part: Block(None, rows[part], 2), len(rows), 10, threads, share)
        sums.append(own.linear)
        threads.close()
    for name in vars(sums[0]):
        np.testing.assert_array_equal(*(getattr(own, name) for own in sums))
