"""Rows in blocks: what one holds, which are kept, and sums that do not depend on how."""

import os
import platform
import subprocess
import sys

import numpy as np
import pytest

from skevgp.data.blocks import CACHE_BYTES, KEEP_BYTES, Batch, Block, LinearSums, LocalBlocks, block_rows
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


def test_a_block_is_features_and_residuals_side_by_side():
    np.testing.assert_array_equal(block().features, H)
    np.testing.assert_array_equal(block().residuals, R)
    assert block().features.base is block().residuals.base is LINEAR


@pytest.mark.parametrize(("outputs", "columns"), [(slice(0, 1), [0, 1, 2, 3]), (slice(1, 2), [0, 1, 2, 4])])
def test_the_linear_part_of_some_outputs(outputs, columns):
    np.testing.assert_array_equal(block().linear_of(outputs), LINEAR[:, columns])


@pytest.mark.parametrize("outputs", [slice(0, 2), slice(None)])
def test_the_linear_part_of_all_outputs_is_no_copy(outputs):
    own = block()
    assert own.linear_of(outputs) is own.linear


def test_the_sums_that_depend_on_no_parameter():
    sums = LinearSums.of_block(block())
    assert sums.n_rows == 50
    for found, expected in [(sums.HH[0], H.T @ H), (sums.HR, H.T @ R), (sums.RR, np.sum(R**2, axis=0))]:
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_they_add():
    total = LinearSums.of_block(block())
    sums = LinearSums.of_block(block(slice(20))) + LinearSums.of_block(block(slice(20, 50)))
    for name, expected in vars(total).items():
        np.testing.assert_allclose(getattr(sums, name), expected, rtol=1e-12)


def test_a_batch_stands_for_itself():
    batch = Batch(block())
    assert batch.sum(lambda own: own) is batch.block
    assert batch.block.may_keep
    np.testing.assert_array_equal(batch.linear.HH, LinearSums.of_block(block()).HH)


@pytest.mark.parametrize("n_inducing", [0, 1, 10, 100, 1000, 10**6])
def test_a_block_fits_a_cache_and_is_worth_a_call(n_inducing):
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


@pytest.mark.parametrize("size", [1, 7, 49, 50, 1000])
def test_sums_are_over_all_rows(size):
    found, expected = blocks(size=size).linear, LinearSums.of_block(block())
    for name, value in vars(expected).items():
        np.testing.assert_allclose(getattr(found, name), value, rtol=1e-12)


def test_the_order_of_a_sum_is_that_of_the_rows():
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


def test_others_are_made_again_at_each_pass():
    made = []
    # Room for three blocks of 7 rows, whose numbers count twice: as prepared and as linear.
    own = blocks(made, share=3.5 * (2 * 8 * 7 * 5) / CACHE_BYTES)
    whole = own.sum(LinearSums.of_block)
    assert len(made) == 8
    again = own.sum(LinearSums.of_block)
    assert made[8:] == [(21, 28), (28, 35), (35, 42), (42, 49), (49, 50)]
    np.testing.assert_array_equal(again.HH, whole.HH)


def test_the_first_pass_leaves_something_for_the_second_only_where_all_of_it_fits():
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


FAULTS = """
import resource
import numpy as np

if {with_blocks}:
    import skevgp.data.blocks

def work():
    for _ in range(20):
        first = np.ones(2**17)
        second, third = first + 1.0, first + 2.0
        del first, second, third

work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
work()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of this allocator only")
def test_memory_of_one_block_serves_the_next_without_page_faults():
    """Three arrays of 1 MiB, 20 times: given back to the system each time, they would be 15 360 pages of 4 KiB."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_"))}
    faults = []
    for with_blocks in (True, False):
        code = FAULTS.format(with_blocks=with_blocks)
        run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        faults.append(int(run.stdout))
    assert faults[0] < max(0.1 * faults[1], 100)
