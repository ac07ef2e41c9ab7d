"""Rows that count w times, and whose noise variance is σ² v: against dense formulas and rows that are repeated."""

from dataclasses import replace

import numpy as np
import pytest

from skevgp.data.blocks import Batch
from skevgp.data.rows import RawRows, block_of
from skevgp.model.bounds import bounds_alone, upper_bound
from skevgp.model.model import SparseModel
from skevgp.model.objectives import BoundObjective, ElboObjective
from skevgp.utils.linalg import Jitter

from ..kernels.cases import KERNELS
from ..kernels.test_models import model_with
from ..oracle import Dense, blocks_of, central_differences, problem, relative_error


def weighted(rows, counts=None, variance=None):
    """Rows of the oracle as `RawRows` with weights."""
    counts = np.ones(len(rows.inputs)) if counts is None else counts
    precision = counts if variance is None else counts / variance
    return RawRows(rows.inputs, rows.features, rows.residuals, counts, precision)


def drawn(n, seed=3):
    """Weights and relative variances, none of them 1."""
    rng = np.random.RandomState(seed)
    return rng.uniform(0.2, 3.0, n), np.exp(rng.randn(n))


@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_weight_two_equals_repeated_row(family):
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
def test_upper_bound_holds_with_jitter_and_weights(counts):
    """Points that are all rows: the upper bound holds whatever the weights."""
    model, rows, table = problem(n=6)
    rows.inputs[1] = rows.inputs[0] + 1e-9
    values = table.values_at_start() | {"inducing_points": rows.inputs[np.newaxis]}
    raw = weighted(rows, counts)
    model = SparseModel(model.kernel, model.prior, model.groups, complete=True)
    (group,) = model.groups_on(values, blocks_of(raw, model.kernel))
    assert group.whitening.jitter() > 0.0
    likelihood = Dense(raw, model.prior).likelihood(values)
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
def test_upper_bound_weights_jitter_by_row(often, counts):
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
    assert Dense(raw, model.prior).likelihood(values) < expected


def test_upper_bound_holds_after_forgetting():
    """The sums of rows that count once, a tenth of them."""
    model, raw, values = far_apart(np.ones(20))
    statistics = model.statistics(values, blocks_of(raw, model.kernel))[0].scaled(0.1)
    rows = replace(raw, counts=np.full(20, 0.1), precision=np.full(20, 0.1))
    likelihood = Dense(rows, model.prior).likelihood(values)
    assert likelihood < model.upper_bound(values, [statistics])


@pytest.mark.parametrize("name", [name for name in KERNELS if name != "ConstantKernel"])
def test_gradient_agrees_with_finite_differences_for_all_kernels(name):
    model, rows, table = model_with(KERNELS[name], n=25, m=3, p=1)
    raw = weighted(rows, *drawn(len(rows)))
    objective = BoundObjective(model, table, blocks_of(raw, model.kernel))
    _, gradient = objective(table.start())
    # Along a few directions that no parameter is left out of: the kernels' own gradients are seen one by one elsewhere.
    ways = np.random.RandomState(0).randn(4, table.size)
    differences = central_differences(lambda t: objective(table.start() + t @ ways)[0], np.zeros(4), 1e-5)
    assert relative_error(ways @ gradient, differences) < 1e-5


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
