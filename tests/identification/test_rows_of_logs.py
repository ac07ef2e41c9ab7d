import numpy as np
import pytest
from numpy.testing import assert_array_equal

from skevgp.identification.rows_of_logs import blocks_of, correlation_time, groups_of


def test_independent_rows_are_worth_one_each():
    errors = np.random.default_rng(0).normal(size=20_000)
    assert correlation_time(errors, np.zeros(20_000, dtype=int)) < 1.2


def test_no_product_is_taken_across_runs():
    rng = np.random.default_rng(0)
    level = np.repeat([1.0, -1.0] * 500, 2)
    runs = np.repeat(np.arange(1000), 2)
    alternating = correlation_time(level + 0.01 * rng.normal(size=2000), runs)
    assert alternating == pytest.approx(2.0, abs=0.05)  # of each run two equal rows; no lag is longer


@pytest.mark.parametrize("factor", [0.5, 0.9])
def test_autoregressive_process_has_its_known_time(factor):
    rng, errors = np.random.default_rng(0), np.zeros(100_000)
    for row in range(1, len(errors)):
        errors[row] = factor * errors[row - 1] + rng.normal()
    found = correlation_time(errors, np.repeat([0, 1], 50_000))
    assert found == pytest.approx((1.0 + factor) / (1.0 - factor), rel=0.15)


def test_blocks_are_groups_or_stand_in_for_them():
    assert set(blocks_of(None, 100)) == set(range(5))
    assert (np.diff(blocks_of(None, 100)) >= 0).all()
    groups = np.repeat([7, 3, 5], [40, 30, 30])
    found = blocks_of(groups, 100)
    assert all(len(set(found[groups == label])) == 1 for label in (7, 3, 5))
    assert len(set(found)) == 3
    two = np.tile([0, 1], 50)  # rows of two groups by turns
    found = blocks_of(two, 100)
    assert all(len(set(two[found == block])) == 1 for block in set(found))
    assert len(set(found)) >= 4
    large = np.repeat([0, 1], [90, 10])
    assert len(set(blocks_of(large, 100)[large == 0])) >= 4  # nine tenths say nothing of others
    assert_array_equal(groups_of(two, found), two)
    assert_array_equal(groups_of(None, found), found)
    assert_array_equal(groups_of(np.zeros(100), found), found)
    many = np.arange(100) // 5
    assert len(set(blocks_of(many, 100))) == 5
    assert all(len(set(blocks_of(many, 100)[many == label])) == 1 for label in range(20))
    assert set(blocks_of(None, 2)) == {0, 1}
