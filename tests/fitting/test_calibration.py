from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import solve_triangular

from skevgp.fitting.calibration import calibrated_noise, left_out_scores
from skevgp.inference.model import SparseModel
from skevgp.inference.posterior import CoefficientPrior
from skevgp.kernels.stationary import SquaredExponential
from skevgp.rows.internal import Rows
from skevgp.rows.source import LocalSource
from skevgp.rows.threads import BlockMap

from ..oracle import ArrayRows, problem, relative_error, whitened


def rows_of(rows, threads=None):
    """Rows whose internal units are the user's."""
    source = LocalSource.of(rows.inputs, rows.features, rows.residuals)
    return Rows(source, lambda raw: raw, threads=threads or BlockMap())


def edges_of(n, n_folds):
    return np.linspace(0, n, n_folds + 1).astype(int)


def refitted_scores(model, values, rows, o, noise, n_folds):
    """Σ r² / (latent variance + σ²) of one output: a posterior per fold from the data, by QR of [P / σ; I]."""
    prior, signal = model.prior, values["signal"][o]
    Z = values["inducing_points"][o % len(values["inducing_points"])]
    L, V = whitened(values["hyperparameters"], Z, rows.inputs)
    P = np.hstack([np.sqrt(signal) * V.T, rows.features * prior.scale[o]])
    size, m = P.shape[1], len(L)
    prior_mean = np.append(np.zeros(m), -prior.reference[o])
    edges, total = edges_of(len(P), n_folds), 0.0
    for first, end in pairwise(edges):
        out = np.zeros(len(P), dtype=bool)
        out[first:end] = True
        stacked = np.vstack([P[~out] / np.sqrt(noise), np.eye(size)])
        Q, R = np.linalg.qr(stacked)
        target = np.append(rows.residuals[~out, o] / np.sqrt(noise), prior_mean)
        mean = P[out] @ solve_triangular(R, Q.T @ target)
        if model.family == "full":
            latent = np.sum(solve_triangular(R, P[out].T, trans=1) ** 2, axis=0)
        else:
            # (f_m / s, β / c) = T⁻¹ ω
            T = np.eye(size)
            T[:m, :m] = np.linalg.inv(L)
            precision = np.sum((R @ T) ** 2, axis=0)
            latent = np.sum((P[out] @ T) ** 2 / precision, axis=1)
        unexplained = signal * np.maximum(1.0 - np.sum(V[:, out] ** 2, axis=0), 0.0)
        total += np.sum((rows.residuals[out, o] - mean) ** 2 / (latent + unexplained + noise))
    return total


def scores(model, values, rows, grid, n_folds, threads=None):
    """`left_out_scores` of all outputs, (o, g)."""
    edges = edges_of(len(rows), n_folds)
    folds = [rows_of(rows).part(*ends, 1.0).blocks(model.kernel, 6) for ends in pairwise(edges)]
    groups = model.groups_on(values, rows_of(rows).blocks(model.kernel, 6))
    found = [left_out_scores(own, model.family, folds, grid[own.outputs], threads or BlockMap()) for own in groups]
    return np.concatenate(found)


def calibrated(model, values, rows, n_folds, bounds=(1e-10, 1e2), threads=None):
    rows = rows_of(rows, threads)
    statistics = model.statistics(values, rows.blocks(model.kernel, 6))
    bounds = np.tile(bounds, (len(values["noise"]), 1))
    return calibrated_noise(model, values, statistics, rows, bounds, n_folds)


@pytest.mark.parametrize(("features", "n_folds"), [(3, 2), (0, 7), (3, 60)])
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_left_out_rows_are_predicted_as_by_refits_without_their_fold(family, shared, features, n_folds):
    model, rows, table = problem(family, shared, p=features)
    values = table.values(table.start())
    grid = values["noise"][:, np.newaxis] * np.array([1e-4, 0.3, 1.0, 5.0, 1e4])
    expected = [[refitted_scores(model, values, rows, o, s2, n_folds) for s2 in grid[o]] for o in range(2)]
    np.testing.assert_allclose(scores(model, values, rows, grid, n_folds), expected, rtol=1e-8)


@pytest.mark.parametrize("noise", [1e-4, 1e-8])
def test_a_feature_of_one_fold_and_a_wide_prior_cost_no_digits(noise):
    """Its sums over the other folds, as differences from those of all rows, would be rounding errors."""
    model, rows, table = problem(n=200)
    rows.features[:, 0] *= np.where(np.arange(200) < 40, 1e3, 1e-6)
    rows.features[:, 1] *= 1e3
    prior = CoefficientPrior(model.prior.mean, np.full((2, 3), 1e6), np.zeros((2, 3)))
    model = SparseModel(model.kernel, prior, model.family, model.groups)
    values = table.values(table.start()) | {"noise": np.full(2, noise), "signal": np.ones(2)}
    grid = np.full((2, 1), noise)
    expected = [refitted_scores(model, values, rows, o, noise, 5) for o in range(2)]
    np.testing.assert_allclose(scores(model, values, rows, grid, 5)[:, 0], expected, rtol=1e-5)


def too_sure(family="full", shared=True):
    """Rows in an order in which neighbours are alike, and a kernel so low that it leaves much of them to the noise."""
    model, rows, table = problem(family, shared, n=120)
    order, values = np.argsort(rows.inputs.sum(axis=1)), table.values(table.start())
    rows = ArrayRows(rows.inputs[order], rows.features[order], rows.residuals[order])
    return model, rows, values | {"signal": 1e-2 * values["signal"]}


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_at_the_calibrated_noise_squared_errors_are_as_large_as_variances(family, shared):
    model, rows, values = too_sure(family, shared)
    noise = calibrated(model, values, rows, 6)
    means = [refitted_scores(model, values, rows, o, noise[o], 6) / 120 for o in range(2)]
    np.testing.assert_allclose(means, 1.0, rtol=0.01)


def test_where_the_noise_was_does_not_matter():
    model, rows, values = too_sure()
    low, high = (calibrated(model, values | {"noise": factor * values["noise"]}, rows, 6) for factor in (1e-2, 1.0))
    assert relative_error(low, high) < 0.01


@pytest.mark.parametrize(("bounds", "expected"), [((10.0, 20.0), 10.0), ((1e-10, 1e-6), 1e-6)])
def test_the_noise_stays_within_its_bounds(bounds, expected):
    model, rows, table = problem()
    np.testing.assert_allclose(calibrated(model, table.values(table.start()), rows, 5, bounds), expected)


def test_folds_that_know_nothing_of_each_other_do_not_lower_the_noise_below_what_is_left_over():
    rng = np.random.RandomState(0)
    X = np.repeat([-100.0, 100.0], 100)[:, np.newaxis] + rng.uniform(-1.0, 1.0, (200, 1))
    r = 0.1 * rng.randn(200, 1)
    model = SparseModel(SquaredExponential(1), CoefficientPrior(*np.empty((3, 1, 0))), "full", (slice(0, 1),))
    Z = np.array([[[-100.5], [-99.5], [99.5], [100.5]]])
    values = {"hyperparameters": np.ones(1), "signal": np.ones(1), "noise": np.full(1, 0.01), "inducing_points": Z}
    rows = Rows(LocalSource.of(X, np.empty((200, 0)), r), lambda raw: raw)
    statistics = model.statistics(values, rows.blocks(model.kernel, 4))
    noise = calibrated_noise(model, values, statistics, rows, np.array([[1e-10, 1e2]]), 2)
    np.testing.assert_allclose(noise, 0.01, rtol=0.2)


@pytest.mark.parametrize("shared", [True, False])
def test_bits_do_not_depend_on_the_number_of_threads(shared, monkeypatch):
    monkeypatch.setattr("skevgp.rows.blocks._WORTH_THREADS", 0)
    model, rows, table = problem(shared=shared, n=3000)
    values, threads = table.values(table.start()), BlockMap(3)
    try:
        found = calibrated(model, values, rows, 4, threads=threads)
    finally:
        threads.close()
    np.testing.assert_array_equal(found, calibrated(model, values, rows, 4))
