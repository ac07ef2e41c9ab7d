"""Folds, what the others say of each, and where signal and noise predict it best."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag, solve_triangular

from skevgp.data.rows import LocalSource, RawRows, Rows
from skevgp.data.threads import BlockMap
from skevgp.fitting.calibration import VarianceSearch, calibrated, variances
from skevgp.fitting.folds import (
    PREDICTED_ROWS,
    CrossValidation,
    folds_in_order,
    folds_of_groups,
    follow_a_path,
    random_folds,
)
from skevgp.model.left_out import LeftOut, Seen, prior_of, sums_of_others
from skevgp.model.predictor import CoefficientPrior
from skevgp.model.statistics import collect

from ..oracle import problem, whitened

# --- which rows are left out together ---------------------------------------------------------------------------------


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


# --- what the other folds say of rows, against a posterior per fold from the data -------------------------------------


def rows_of(rows, chosen, counts=None, precision=None):
    """Some rows whose internal units are the user's."""
    weights = (None, None) if counts is None else (counts[chosen], precision[chosen])
    raw = RawRows(rows.inputs[chosen], rows.features[chosen], rows.residuals[chosen], *weights)
    return Rows(LocalSource.holding(raw), lambda raw: raw)


def left_out(model, values, rows, folds, **weights):
    """For each group of outputs a LeftOut of each fold."""
    m, groups = values["inducing_points"].shape[1], []
    blocks = [model.blocks(rows_of(rows, fold, **weights), m) for fold in folds]
    for outputs, whitening in zip(model.groups, model.whitenings(values), strict=True):
        others = sums_of_others([collect(own, whitening, outputs) for own in blocks])
        seen = [own.sum(Seen(whitening, outputs)) for own in blocks]
        known = [model.group(values, outputs, whitening, sums) for sums in others]
        groups.append([LeftOut(group, model.family, own) for group, own in zip(known, seen, strict=True)])
    return groups


def refitted(model, values, rows, outputs, signal, noise, out, counts=None, relative=None):
    """Errors and variances of the first of some outputs, which share w: by QR of all rows but some, and the prior."""
    prior, n = model.prior, len(rows)
    counts, relative = (np.ones(n) if own is None else own for own in (counts, relative))
    stacked, targets, designs = [], [], []
    p, sizes, Ls = rows.features.shape[1], [], []
    for o in outputs:
        Z = values["inducing_points"][o % len(values["inducing_points"])]
        L, V = whitened(values["hyperparameters"], Z, rows.inputs)
        Ls.append((L, V))
        sizes.append(len(L))
    total = sum(sizes) + p
    for k, o in enumerate(outputs):
        P = np.zeros((n, total))
        first = sum(sizes[:k])
        P[:, first : first + sizes[k]] = np.sqrt(signal[k]) * Ls[k][1].T
        P[:, total - p :] = rows.features @ prior.roots()[o]
        root = np.sqrt(counts / (noise[k] * relative))[:, np.newaxis]
        stacked.append((P * root)[~out])
        targets.append((rows.residuals[:, [o]] * root)[~out, 0])
        designs.append(P)
    o = outputs[0]
    Q, R = np.linalg.qr(np.vstack([*stacked, np.eye(total)]))
    mean_before = np.append(np.zeros(total - p), -prior.reference[o])
    mean = solve_triangular(R, Q.T @ np.concatenate([*targets, mean_before]))
    design, V = designs[0][out], Ls[0][1][:, out]
    if model.family == "full":
        latent = np.sum(solve_triangular(R, design.T, trans=1) ** 2, axis=0)
    else:
        # Diagonal in the coordinates (f_m, w) of the output, whatever is not known of other outputs.
        own = np.r_[0 : sizes[0], total - p : total]
        precision = np.linalg.inv(np.linalg.inv(R.T @ R)[np.ix_(own, own)])
        T = block_diag(np.linalg.inv(Ls[0][0]), np.eye(p))
        latent = np.sum((design[:, own] @ T) ** 2 / np.diagonal(T.T @ precision @ T), axis=1)
    unexplained = signal[0] * np.maximum(1.0 - np.sum(V**2, axis=0), 0.0)
    return rows.residuals[out, o] - design @ mean, latent + unexplained + noise[0] * relative[out]


def parts(n, n_folds, seed=3):
    return [np.sort(own) for own in np.array_split(np.random.RandomState(seed).permutation(n), n_folds)]


def assert_as_refitted(model, values, rows, folds, joint=False, rtol=1e-8, **weights):
    """At signal and noise variances around and far from those of ``values``."""
    groups, n_outputs = left_out(model, values, rows, folds, **weights), len(values["noise"])
    where = [(group, index) for group in groups for index in range(len(group[0].group.noise))]
    relative = {}
    if weights:
        relative = {"counts": weights["counts"], "relative": weights["counts"] / weights["precision"]}
    for k, fold in enumerate(folds):
        out = np.isin(np.arange(len(rows)), fold)
        for o, (group, index) in enumerate(where):
            others = [other for other in range(n_outputs) if other != o] if joint else []
            known = prior_of(group[k].group, index)
            for other in others:
                known = known + where[other][0][k].says(where[other][1])
            for factor in (1e-4, 1.0, 30.0):
                signal = 0.4 * factor * values["signal"][o]
                noise = values["noise"][o] * np.array([1e-3, 1.0, 20.0])
                for s2 in noise:
                    ratio = signal / s2
                    found = group[k].predicted(index, ratio, noise, known)
                    for i, n2 in enumerate(noise):
                        expected = refitted(
                            model,
                            values,
                            rows,
                            [o, *others],
                            [ratio * n2, *values["signal"][others]],
                            [n2, *values["noise"][others]],
                            out,
                            **relative,
                        )
                        for own, oracle in zip(found, expected, strict=True):
                            np.testing.assert_allclose(own[:, min(i, own.shape[1] - 1)], oracle, rtol=rtol, atol=1e-9)


@pytest.mark.parametrize(("features", "n_folds"), [(3, 2), (0, 3), (3, 60)])
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_left_out_rows_are_predicted_as_by_refits_without_their_fold(family, shared, features, n_folds):
    model, rows, table = problem(family, shared, p=features)
    folds = parts(len(rows), n_folds)
    assert_as_refitted(
        model,
        table.values(table.start()),
        rows,
        folds if n_folds < 60 else folds[:2] + [np.sort(np.concatenate(folds[2:]))],
    )


@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_weights_of_rows_and_their_noise(family):
    model, rows, table = problem(family)
    rng = np.random.RandomState(1)
    counts, relative = rng.randint(1, 4, len(rows)).astype(float), rng.uniform(0.2, 3.0, len(rows))
    weights = {"counts": counts, "precision": counts / relative}
    assert_as_refitted(model, table.values(table.start()), rows, parts(len(rows), 3), **weights)


@pytest.mark.parametrize("joint", [True, False])
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_correlated_weights_and_weights_that_outputs_share(family, shared, joint):
    model, rows, table = problem(family, shared)
    root = np.tril(0.3 + np.random.RandomState(2).rand(3, 3))
    prior = model.prior
    roots = np.array([root, root if joint else 2.0 * root])
    scale = np.sqrt(np.einsum("oij,oij->oi", roots, roots))
    reference = np.repeat(prior.reference[:1], 2, axis=0) if joint else prior.reference
    model = replace(model, prior=CoefficientPrior(prior.mean, scale, reference, roots, joint))
    assert_as_refitted(model, table.values(table.start()), rows, parts(len(rows), 3), joint=joint)


@pytest.mark.parametrize("noise", [1e-4, 1e-8])
def test_feature_of_one_fold_and_a_wide_prior_cost_no_digits(noise):
    """Its sums over the other folds, as differences from those of all rows, would be rounding errors."""
    model, rows, table = problem(n=200)
    rows.features[:, 0] *= np.where(np.arange(200) < 40, 1e3, 1e-6)
    rows.features[:, 1] *= 1e3
    prior = CoefficientPrior(model.prior.mean, np.full((2, 3), 1e6), np.zeros((2, 3)))
    model = replace(model, prior=prior)
    values = table.values(table.start()) | {"noise": np.full(2, noise), "signal": np.ones(2)}
    folds = np.split(np.arange(200), 5)
    ((*each,),) = left_out(model, values, rows, folds)
    total, expected = 0.0, 0.0
    for fold, own in zip(folds, each, strict=True):
        error, variance = own.predicted(0, 1.0 / noise, np.array([noise]))
        total += np.sum(error**2 / variance)
        error, variance = refitted(model, values, rows, [0], [1.0], [noise], np.isin(np.arange(200), fold))
        expected += np.sum(error**2 / variance)
    np.testing.assert_allclose(total, expected, rtol=1e-5)


# --- where signal and noise end ---------------------------------------------------------------------------------------


def small(n=300, **changes):
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
