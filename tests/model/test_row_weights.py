"""Rows that count w times, and whose noise variance is σ² v: against dense formulas and rows that are repeated."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from skevgp.data.blocks import Batch, LocalBlocks
from skevgp.data.rows import RawRows, block_of
from skevgp.model.bounds import bounds_alone, bounds_at_optimum, upper_bound
from skevgp.model.exact import ExactModel
from skevgp.model.model import SparseModel
from skevgp.model.objectives import BoundObjective, ElboObjective, evaluate
from skevgp.utils.linalg import Jitter

from ..kernels.cases import KERNELS
from ..kernels.test_models import model_with
from ..oracle import central_differences, problem, relative_error, squared_exponential
from . import test_exact

LOG_2PI = np.log(2.0 * np.pi)


def weighted(rows, counts=None, variance=None):
    """Rows of the oracle as `RawRows` with weights."""
    counts = np.ones(len(rows.inputs)) if counts is None else counts
    precision = counts if variance is None else counts / variance
    return RawRows(rows.inputs, rows.features, rows.residuals, counts, precision)


def blocks_of(raw, kernel, size=17):
    make = partial(block_of, kernels=(kernel,), to_internal=lambda rows: rows)
    return LocalBlocks(lambda rows: make(raw[rows]), len(raw.inputs), 6, size=size)


def drawn(n, seed=3):
    """Weights and relative variances, none of them 1."""
    rng = np.random.RandomState(seed)
    return rng.uniform(0.2, 3.0, n), np.exp(rng.randn(n))


def dense(values, raw, prior):
    """Lower bound and log marginal likelihood of rows of weight w, from (N, N) matrices, summed over outputs."""
    w, v = raw.counts, raw.counts / raw.precision
    lower = likelihood = 0.0
    ell, Z = values["hyperparameters"], values["inducing_points"][0]
    for o, (s2, noise) in enumerate(zip(values["signal"], values["noise"], strict=True)):
        K = s2 * squared_exponential(raw.inputs, raw.inputs, ell)
        U = squared_exponential(Z, raw.inputs, ell)
        Q = s2 * U.T @ np.linalg.solve(squared_exponential(Z, Z, ell), U)
        linear = raw.features @ np.diag(prior.scale[o] ** 2) @ raw.features.T + np.diag(noise * v / w)
        r = raw.targets[:, o] + raw.features @ (prior.scale[o] * prior.reference[o])
        # w copies: N(y | g, a)^w = N(y | g, a / w) (2πa)^(-(w - 1)/2) w^(-1/2).
        copies = -0.5 * ((w - 1.0) @ np.log(2.0 * np.pi * noise * v) + np.log(w).sum())

        def log_density(C, r=r):
            return -0.5 * (len(r) * LOG_2PI + np.linalg.slogdet(C)[1] + r @ np.linalg.solve(C, r))

        lower += log_density(Q + linear) + copies - 0.5 * raw.precision @ np.diag(K - Q) / noise
        likelihood += log_density(K + linear) + copies
    return lower, likelihood


@pytest.mark.parametrize("size", [60, 17])
def test_the_bounds_are_those_of_the_dense_formulas(size):
    model, rows, table = problem()
    raw, values = weighted(rows, *drawn(len(rows))), table.values_at_start()
    blocks = blocks_of(raw, model.kernel, size)
    lower, likelihood = dense(values, raw, model.prior)
    value, _ = evaluate(model, values, blocks, partial(bounds_at_optimum, family="full"))
    assert value == pytest.approx(lower, rel=1e-10)
    (group,) = model.groups_on(values, blocks)
    assert lower < likelihood < upper_bound([group], blocks)


@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_a_row_that_counts_twice_is_there_twice(family):
    model, rows, table = problem(family)
    rng = np.random.RandomState(1)
    counts = rng.randint(1, 4, len(rows))
    _, variance = drawn(len(rows))
    again = np.repeat(np.arange(len(rows)), counts)
    once = weighted(rows, counts.astype(float), variance)
    repeated = weighted(rows, None, variance)[again]
    results = []
    for raw in (once, repeated):
        blocks = blocks_of(raw, model.kernel)
        value, gradient = BoundObjective(model, table, blocks)(table.start())
        (group,) = model.groups_on(table.values_at_start(), blocks)
        (alone,) = bounds_alone(blocks.linear, model.prior, np.array([0.2]), np.zeros(1))
        results.append([value, alone, upper_bound([group], blocks), *gradient])
    np.testing.assert_allclose(*results, rtol=1e-9)


@pytest.mark.parametrize("counts", [drawn(6)[0], np.full(6, 0.1), np.array([5.0, *np.full(5, 0.1)])], ids=str)
def test_what_a_jitter_leaves_counts_as_often_as_the_row_does(counts):
    """Points that are all rows: the upper bound holds whatever the weights."""
    model, rows, table = problem(n=6)
    rows.inputs[1] = rows.inputs[0] + 1e-9
    values = table.values_at_start() | {"inducing_points": rows.inputs[np.newaxis]}
    raw = weighted(rows, counts)
    model = SparseModel(model.kernel, model.prior, "full", model.groups, complete=True)
    (group,) = model.groups_on(values, blocks_of(raw, model.kernel))
    assert group.whitening.jitter() > 0.0
    _, likelihood = dense(values | {"inducing_points": rows.inputs[np.newaxis, 1:]}, raw, model.prior)
    assert likelihood <= upper_bound([group]) + 1e-8 * abs(likelihood)


def far_apart(counts):
    """A model of rows without covariance, all of them points, with a large jitter; the first row lies far off."""
    model, rows, table = problem(n=len(counts), p=0)
    rows.inputs[:] = 100.0 * np.arange(len(counts))[:, np.newaxis]
    rows.residuals[:] = 0.0
    rows.residuals[0] = 20.0
    model = replace(model, jitter=Jitter(0.1, well_conditioned=2.0), complete=True)
    return model, weighted(rows, counts), table.values_at_start() | {"inducing_points": rows.inputs[np.newaxis]}


@pytest.mark.parametrize(
    ("often", "counts"), [(100.0, [100.0, *np.full(50, 0.01)]), (1.0, np.ones(20))], ids=["often", "once"]
)
def test_what_a_jitter_leaves_of_a_row_counts_as_often_as_the_row_may(often, counts):
    """A trace of s² j so many times: by the formula of `upper_bound`, row by row."""
    counts = np.array(counts)
    model, raw, values = far_apart(counts)
    (group,) = model.groups_on(values, blocks_of(raw, model.kernel))
    expected = 0.0
    for signal, noise, r in zip(values["signal"], values["noise"], raw.targets.T, strict=True):
        q, t = counts * signal / 1.1, often * signal * 0.1
        expected -= 0.5 * (counts.sum() * np.log(2.0 * np.pi * noise) + np.log1p(q / noise).sum())
        expected -= 0.5 * (counts * r**2 / (noise + t + q)).sum()
    assert group.whitening.jitter() == pytest.approx(0.1)
    assert upper_bound([group]) == pytest.approx(expected, rel=1e-10)
    assert dense(values, raw, model.prior)[1] < expected


def test_what_a_jitter_leaves_of_rows_that_have_been_forgotten_in_part():
    """The sums of rows that count once, a tenth of them."""
    model, raw, values = far_apart(np.ones(20))
    statistics = model.statistics(values, blocks_of(raw, model.kernel))[0].scaled(0.1)
    rows = replace(raw, counts=np.full(20, 0.1), precision=np.full(20, 0.1))
    likelihood = dense(values, rows, model.prior)[1]
    assert likelihood < model.upper_bound(values, [statistics])


@pytest.mark.parametrize("name", [name for name in KERNELS if name != "ConstantKernel"])
def test_the_gradient_agrees_with_finite_differences_for_all_kernels(name):
    model, rows, table = model_with(KERNELS[name])
    raw = weighted(rows, *drawn(len(rows)))
    objective = BoundObjective(model, table, blocks_of(raw, model.kernel))
    _, gradient = objective(table.start())
    assert relative_error(gradient, central_differences(lambda x: objective(x)[0], table.start(), 1e-5)) < 1e-5


@pytest.mark.parametrize("name", ["nested", "DotProduct", "FunctionKernel"])
def test_the_gradient_of_the_papers_loss_agrees_with_finite_differences(name):
    model, rows, table = model_with(KERNELS[name], n=30, m=4, p=2)
    raw = weighted(rows, *drawn(30))
    elbo = ElboObjective(model, table, blocks_of(raw, model.kernel, 30))
    batch = Batch(block_of(raw[:11], (model.kernel,), lambda rows: rows))
    x = elbo.table.start() + 0.1 * np.random.RandomState(1).randn(elbo.table.size)
    _, gradient = elbo.evaluate(x, batch)
    differences = central_differences(lambda x: elbo.evaluate(x, batch)[0], x, 1e-5)
    assert relative_error(gradient, differences) < 1e-5


def test_mini_batches_are_right_on_average_whatever_the_rows_weigh():
    model, rows, table = problem()
    raw = weighted(rows, *drawn(60))
    elbo = ElboObjective(model, table, blocks_of(raw, model.kernel, 60))
    x = elbo.table.start() + 0.1 * np.random.RandomState(1).randn(elbo.table.size)
    blocks = [block_of(raw[first : first + 20], (model.kernel,), lambda rows: rows) for first in range(0, 60, 20)]
    parts = [elbo.evaluate(x, Batch(block)) for block in blocks]
    loss, gradient = elbo.evaluate(x, elbo.blocks)
    assert np.mean([part[0] for part in parts]) == pytest.approx(loss, rel=1e-10)
    np.testing.assert_allclose(np.mean([part[1] for part in parts], axis=0), gradient, rtol=1e-7, atol=1e-10)


def test_at_its_optimum_the_papers_loss_is_the_bound():
    model, rows, table = problem()
    blocks = blocks_of(weighted(rows, *drawn(60)), model.kernel)
    elbo, bound = ElboObjective(model, table, blocks), BoundObjective(model, table, blocks)
    assert elbo.evaluate(elbo.table.start(), blocks)[0] == pytest.approx(bound(table.start())[0], rel=1e-10)


@pytest.mark.parametrize("vague", test_exact.VAGUE.values(), ids=test_exact.VAGUE)
def test_the_exact_likelihood_of_rows_that_count_twice_and_of_known_noise(vague):
    model, _ = test_exact.problem(vague)
    counts = np.random.RandomState(1).randint(1, 4, test_exact.N)
    _, variance = drawn(test_exact.N)
    again = np.repeat(np.arange(test_exact.N), counts)
    rows = replace(model.rows, counts=counts.astype(float), precision=counts / variance)
    repeated = replace(model.rows, counts=np.ones(test_exact.N), precision=1.0 / variance)[again]
    once, twice = (ExactModel(model.kernel, model.prior, vague, raw) for raw in (rows, repeated))
    value, gradient = once.log_likelihood(test_exact.VALUES)
    expected, expected_gradient = twice.log_likelihood(test_exact.VALUES)
    assert value == pytest.approx(expected, rel=1e-10)
    for name in ("hyperparameters", "signal", "noise"):
        np.testing.assert_allclose(gradient[name], expected_gradient[name], rtol=1e-8, atol=1e-9)
    X, H = np.random.RandomState(2).randn(5, 2), np.random.RandomState(3).randn(5, test_exact.P)
    found = [exact.predictor(test_exact.VALUES).predict(X, H, True) for exact in (once, twice)]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-7, atol=1e-9)


def test_the_exact_likelihood_is_the_dense_one_and_so_is_its_gradient():
    model, _ = test_exact.problem(test_exact.VAGUE["proper"])
    counts, variance = drawn(test_exact.N)
    raw = replace(model.rows, counts=counts, precision=counts / variance)
    model = ExactModel(model.kernel, model.prior, model.vague, raw)
    values = test_exact.VALUES
    value, gradient = model.log_likelihood(values)
    _, expected = dense(values | {"inducing_points": raw.inputs[np.newaxis, :5]}, raw, model.prior)
    assert value == pytest.approx(expected, rel=1e-10)

    def at(logs):
        moved = {"hyperparameters": np.exp(logs[:2]), "signal": np.exp(logs[2:4]), "noise": np.exp(logs[4:])}
        return model.log_likelihood(values | moved)[0]

    logs = np.log(np.concatenate([values[name] for name in ("hyperparameters", "signal", "noise")]))
    flat = np.concatenate([gradient[name] for name in ("hyperparameters", "signal", "noise")])
    assert relative_error(flat, central_differences(at, logs, 1e-5)) < 1e-6
