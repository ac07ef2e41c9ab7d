"""Where signal and noise end, and what is said of it; what predicts is tested in test_left_out."""

from dataclasses import replace

import numpy as np
import pytest

from skevgp.data.threads import BlockMap
from skevgp.fitting.calibration import calibrated
from skevgp.fitting.calibration import Limits, Search
from skevgp.fitting.calibration import CrossValidation, random_folds

from ..oracle import problem
from .test_left_out import left_out, rows_of


def small(n=300, **changes):
    """A problem whose signal is far too low."""
    model, rows, table = problem(n=n, **changes)
    values = table.values(table.start())
    return model, rows, table, values | {"signal": 0.01 * values["signal"]}


def search_of(output, model, rows, table, values, wider=1e4):
    folds = random_folds(len(rows), 4, np.random.RandomState(0))
    each = [fold for group in left_out(model, values, rows, [fold.rows for fold in folds]) for fold in [group]]
    where = [(group, index) for group in each for index in range(len(group[0].group.noise))]
    group, index = where[output]
    return Search(output, index, group, [None] * 4, values, Limits.of(table, wider), 1e-6)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_nowhere_near_is_better(family, shared):
    for output in range(2):
        search = search_of(output, *small(family=family, shared=shared))
        signal, noise = search.best()
        best = search._losses(signal / noise, np.array([noise]))[0]
        for factor in (0.5, 0.8, 1.25, 2.0):
            for s2, n2 in ((factor * signal, noise), (signal, factor * noise), (factor * signal, factor * noise)):
                assert search._losses(s2 / n2, np.array([n2]))[0] > best - 1e-4
        assert best < search._losses(0.01 * signal / noise, np.array([noise]))[0] - 0.01


@pytest.mark.parametrize("which", ["signal", "noise"])
def test_what_is_fixed_is_left_and_the_other_is_best_for_it(which):
    model, rows, table, values = small()
    search = search_of(0, model, rows, table.with_fixed(which), values)
    signal, noise = search.best()
    assert {"signal": signal, "noise": noise}[which] == values[which][0]
    best = search._losses(signal / noise, np.array([noise]))[0]
    for factor in (0.7, 1.4):
        s2, n2 = (signal, factor * noise) if which == "signal" else (factor * signal, noise)
        assert search._losses(s2 / n2, np.array([n2]))[0] > best - 1e-4


def test_at_a_limit_of_the_signal_the_noise_is_best():
    model, rows, table, values = small()
    free, _ = search_of(0, model, rows, table, values).best()
    search = search_of(0, model, rows, table, values)
    limits = replace(search.limits, signal=np.array([[1e-9, 0.3 * free]] * 2))
    search = replace(search, limits=limits)
    signal, noise = search.best()
    assert signal == pytest.approx(0.3 * free)
    best = search._losses(signal / noise, np.array([noise]))[0]
    for factor in (0.7, 1.4):
        n2 = factor * noise
        assert search._losses(signal / n2, np.array([n2]))[0] > best - 1e-3


def test_the_noise_is_not_below_its_lowest():
    model, rows, table, values = small()
    search = replace(search_of(0, model, rows, table, values), lowest=0.5)
    assert search.best()[1] >= 0.5


@pytest.mark.parametrize("fixed", [False, True])
def test_nor_if_it_began_far_below(fixed):
    model, rows, table, values = small()
    table = table.with_fixed("signal") if fixed else table
    values = values | {"noise": np.full(2, 1e-7)}
    search = replace(search_of(0, model, rows, table, values), lowest=0.1)
    signal, noise = search.best()
    assert noise >= 0.1
    best = search._losses(signal / noise, np.array([noise]))[0]
    for n2 in {0.1, max(0.1, 0.7 * noise), 1.4 * noise}:
        assert search._losses(signal / n2, np.array([n2]))[0] > best - 1e-3


def test_variances_of_few_groups_are_larger_the_less_groups_agree():
    search = search_of(0, *small())
    rows = [fold.rows.residuals.shape[0] for fold in search.folds]
    alone = [np.arange(n) for n in rows]
    many = search.in_doubt(*search.best(), alone)
    few = search.in_doubt(*search.best(), [np.full(n, i) for i, n in enumerate(rows)])
    assert 1.0 < many < 1.1
    assert few >= 1.0
    # A fold whose errors are ten times as large.
    odd = search.folds[0]
    odd.rows = replace(odd.rows, residuals=10.0 * odd.rows.residuals)
    assert search.in_doubt(*search.best(), [np.full(n, i) for i, n in enumerate(rows)]) > few + 0.1


def test_where_the_bound_was_is_a_prior_that_few_rows_move_less():
    found = []
    for n in (60, 600):
        model, rows, table, values = small(n)
        found.append(search_of(0, model, rows, table, values).best()[0] / values["signal"][0])
    assert 1.0 < found[0] < found[1]


def calibrated_rows(model, rows, table, values, by, threads=None):
    rows = replace(rows_of(rows, np.arange(len(rows))), threads=threads or BlockMap())
    statistics = model.statistics(values, model.blocks(rows, 6))
    return calibrated(model, values, statistics, table, rows, by, 0)


@pytest.mark.parametrize("groups", [None, np.repeat(np.arange(30), 10)])
def test_bits_do_not_depend_on_the_number_of_threads(groups, monkeypatch):
    monkeypatch.setattr("skevgp.data.blocks._WORTH_THREADS", 0)
    by, threads = CrossValidation(4, groups), BlockMap(3)
    try:
        found = calibrated_rows(*small(), by, threads)
    finally:
        threads.close()
    expected = calibrated_rows(*small(), by)
    np.testing.assert_array_equal(found.signal, expected.signal)
    np.testing.assert_array_equal(found.noise, expected.noise)


def test_few_rows_and_what_is_fixed_are_left():
    assert calibrated_rows(*small(49), CrossValidation(5)) is None
    model, rows, table, values = small()
    fixed = table.with_fixed("signal").with_fixed("noise")
    assert calibrated_rows(model, rows, fixed, values, CrossValidation(5)) is None
