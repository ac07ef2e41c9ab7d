"""Where signal and noise predict held-out rows best."""

from dataclasses import replace

import numpy as np
import pytest

from skevgp.data.threads import BlockMap
from skevgp.fitting.calibration import VarianceSearch, calibrate, lowest, variances
from skevgp.fitting.folds import (
    CrossValidation,
    random_folds,
)

from ..oracle import left_out, problem, rows_of


def small(n=150, **changes):
    """A problem whose signal is far too low."""
    model, rows, table = problem(n=n, **changes)
    values = table.values(table.start())
    return model, rows, table, values | {"signal": 0.01 * values["signal"]}


def search_of(output, model, rows, table, values):
    folds = random_folds(len(rows), 4, np.random.RandomState(0))
    groups = left_out(model, values, rows, [fold.rows for fold in folds])
    where = [(group, index) for group in groups for index in range(len(group[0].group.noise))]
    group, index = where[output]
    s_low, s_high = table["signal"].value_limits().T
    low, high = table["noise"].value_limits().T
    signals = variances(table["signal"], values["signal"], 1e-4 * s_low, 1e4 * s_high)
    noises = variances(table["noise"], values["noise"], np.maximum(low, 1e-6), high)
    return VarianceSearch(index, group, [None] * 4, signals[output], noises[output])


def assert_best(search, signals=(0.5, 0.8, 1.0, 1.25, 2.0), noises=(0.5, 0.8, 1.0, 1.25, 2.0), slack=1e-4):
    """Nowhere near is better, as far as these may move."""
    signal, noise = search.best()

    def loss(signal, noise):
        return search._losses(signal / noise, np.array([noise]))[0]

    for s2 in signal * np.array(signals):
        for n2 in np.maximum(noise * np.array(noises), search.noise.low):
            assert loss(s2, n2) > loss(signal, noise) - slack
    return signal, noise


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_nowhere_near_is_better(family, shared):
    for output in range(2):
        search = search_of(output, *small(family=family, shared=shared))
        signal, noise = assert_best(search)
        assert search.loss(0.01 * signal, noise) > search.loss(signal, noise) + 0.01


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


@pytest.mark.parametrize("fixed", [False, True])
@pytest.mark.parametrize(("first", "lowest"), [(None, 0.5), (1e-7, 0.1)])
def test_noise_is_not_below_its_lowest_also_if_it_began_there(first, lowest, fixed):
    model, rows, table, values = small()
    table = table.changed("signal", fixed=True) if fixed else table
    values = values if first is None else values | {"noise": np.full(2, first)}
    search = search_of(0, model, rows, table, values)
    search = replace(search, noise=search.noise._replace(low=lowest))
    assert assert_best(search, signals=(1.0,), slack=1e-3)[1] >= lowest


def calibrated_rows(model, rows, table, values, by, threads=None):
    rows = replace(rows_of(rows, np.arange(len(rows))), threads=threads or BlockMap())
    statistics = model.statistics(values, model.blocks(rows, 6))
    return calibrate(model, values, statistics, table, rows, by, 0)


@pytest.mark.parametrize("groups", [None, np.repeat(np.arange(15), 10)])
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


@pytest.mark.parametrize("wall", [np.inf, np.nan])
def test_lowest_point_is_exact_for_a_parabola_and_finite_beside_a_wall(wall):
    point, value = lowest(lambda z: 2.0 + (z - 0.3) ** 2, -2.0, 2.0)
    assert (point, value) == (pytest.approx(0.3, abs=1e-9), pytest.approx(2.0, abs=1e-12))
    point, value = lowest(lambda z: np.where(z < 0.1, wall, (z - 0.12) ** 2), -2.0, 2.0)
    assert abs(point - 0.12) < 0.1
    assert value == pytest.approx((point - 0.12) ** 2)
    assert lowest(lambda z: z, -2.0, 2.0) == (-2.0, -2.0)
