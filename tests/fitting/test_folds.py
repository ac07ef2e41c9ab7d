"""Which rows are held out together."""

import numpy as np
import pytest

from skevgp.fitting.folds import (
    PREDICTED_ROWS,
    folds_in_order,
    folds_of_groups,
    follow_a_path,
    random_folds,
)


def rng():
    return np.random.RandomState(0)


def of_groups(groups, n_folds):
    return folds_of_groups(groups, n_folds, rng(), np.arange(len(groups)))


def assert_parts(folds, n_rows):
    """Each row is left out once, and all that is predicted is left out."""
    np.testing.assert_array_equal(np.sort(np.concatenate([fold.rows for fold in folds])), np.arange(n_rows))
    for fold in folds:
        assert (np.diff(fold.rows) > 0).all()
        assert (np.diff(fold.predicted) > 0).all()
        assert np.isin(fold.predicted, fold.rows).all()
        assert len(fold.predicted) > 0


@pytest.mark.parametrize(("n_rows", "n_folds", "found"), [(103, 5, 5), (60, 60, 60), (7, 10, 7)])
def test_random_folds_are_of_nearly_equal_length(n_rows, n_folds, found):
    folds = random_folds(n_rows, n_folds, rng())
    assert_parts(folds, n_rows)
    sizes = [len(fold.rows) for fold in folds]
    assert len(sizes) == found
    assert max(sizes) - min(sizes) <= 1
    assert all(len(fold.predicted) == len(fold.rows) for fold in folds)


def test_many_rows_are_subsampled():
    n_rows = 10 * PREDICTED_ROWS
    for folds in (random_folds(n_rows, 4, rng()), folds_in_order(np.arange(n_rows)[::-1], 4, rng())):
        assert_parts(folds, n_rows)
        assert sum(len(fold.predicted) for fold in folds) == PREDICTED_ROWS
    np.testing.assert_array_equal(folds[0].rows, np.arange(0.75 * n_rows, n_rows))


def test_groups_stay_whole_and_folds_are_of_nearly_equal_length():
    groups = np.repeat(np.arange(23), rng().randint(1, 40, 23))
    groups = rng().permutation(groups)
    folds = of_groups(groups, 5)
    assert_parts(folds, len(groups))
    assert sorted(np.concatenate([np.unique(groups[fold.rows]) for fold in folds]).tolist()) == list(range(23))
    sizes = [len(fold.rows) for fold in folds]
    assert max(sizes) <= 1.1 * min(sizes)
    assert len(of_groups(np.repeat(["a", "b", "c"], 20), 10)) == 3


@pytest.mark.parametrize("names", [["only"], ["one", "other"]])
def test_fewer_than_three_groups_are_left_out_in_blocks_of_which_the_inside_is_predicted(names):
    groups = np.array(names * (200 // len(names)))
    given = rng().permutation(200)
    order = given[np.argsort(groups[given], kind="stable")]
    folds = folds_of_groups(groups, 4, rng(), given)
    assert_parts(folds, 200)
    for fold, expected in zip(folds, np.split(order, 4), strict=True):
        np.testing.assert_array_equal(fold.rows, np.sort(expected))
        np.testing.assert_array_equal(fold.predicted, np.sort(expected[7:-7]))


def _walks(n, columns):
    """Smooth, and an input that is drawn for each row anew."""
    t = np.linspace(0.0, 20.0, n)[:, np.newaxis]
    slow = np.sin(t * np.linspace(1.0, 1.7, columns) + np.arange(columns))
    return np.hstack([slow, rng().randn(n, 1)])


def _sorted_by_first(X):
    return X[np.argsort(X[:, 0])]


TABLE = rng().randn(400, 3)
GRID = np.stack(np.meshgrid(np.arange(30.0), np.arange(30.0)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize(
    ("inputs", "expected"),
    [
        (_walks(400, 2), True),
        (_walks(400, 2)[:, [0, 1, 0, 2]] * [1.0, 1e6, 1e-3, 1.0], True),
        (np.hstack([_walks(400, 3), np.ones((400, 1))]), True),
        (_walks(5000, 2), True),
        (_walks(400, 2)[rng().permutation(400)], False),
        (_walks(400, 1), False),
        (TABLE, False),
        (_sorted_by_first(TABLE), False),
        (_sorted_by_first(TABLE) @ [[1.0, 5.0, 5.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], False),
        (_sorted_by_first(TABLE)[::-1] * [1.0, 1.0, 0.0], False),
        (_sorted_by_first(TABLE)[:, [0, 0, 0]] ** [1, 2, 3], False),
        (GRID, False),
        (np.ones((400, 2)), False),
    ],
    ids=[
        *("a walk", "its columns twice", "a constant", "long", "shuffled", "one slow column", "a table", "sorted"),
        *("correlated", "backwards", "powers", "a grid", "all the same"),
    ],
)
def test_path_is_no_sorted_table(inputs, expected):
    order = rng().permutation(len(inputs))
    kept = np.empty_like(inputs)
    kept[order] = inputs
    assert follow_a_path(order, lambda rows: kept[rows]) == expected
