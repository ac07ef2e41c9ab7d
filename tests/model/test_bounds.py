from dataclasses import replace

import numpy as np
import pytest
from autograd import grad
from sklearn.gaussian_process.kernels import ConstantKernel, DotProduct

from skevgp import EVGPRegressor
from skevgp.fitting.rules import Rules
from skevgp.kernels.parse import Start, Starts
from skevgp.kernels.stationary import SquaredExponential
from skevgp.model.bounds import (
    BoundAtOptimum,
    bounds_alone,
    bounds_at_optimum,
    diagonal_gap,
    equation_errors,
    log_variances,
    lost_by_rounding,
    optimal_posteriors,
    upper_bound,
)
from skevgp.model.model import SparseModel
from skevgp.model.objectives import BoundObjective
from skevgp.model.predictor import CoefficientPrior
from skevgp.model.statistics import Whitening
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS
from skevgp.utils.linalg import Jitter, NotPositiveDefiniteError

from ..oracle import (
    Dense,
    at_the_fit,
    central_differences,
    problem,
    relative_error,
    table_of,
    values_of,
    whitened,
)

FAMILIES = ("full", "diagonal")


def plain_loss(model, rows, table):
    """The loss per row as plain autograd of the flat vector."""
    dense = Dense(rows.raw, model.prior, model.variant.family)
    return lambda flat: -dense.bound(values_of(table, flat)) / len(rows)


def test_gradient_with_one_lengthscale_for_all_columns():
    model, rows, table = problem()
    model = SparseModel(SquaredExponential(2, isotropic=True), model.prior, model.groups)
    starts, points = Starts(Start(), Start(), Start()), table["inducing_points"].start
    table = table_of(rows.inputs, points, starts, np.ones(2), model.kernel, Rules(0.1))
    loss = plain_loss(model, rows, table)
    value, gradient = BoundObjective(model, table, rows.blocks(model.kernel, 17))(table.start())
    assert relative_error(gradient, grad(loss)(table.start())) < 1e-9
    np.testing.assert_allclose(value, loss(table.start()), rtol=1e-10)


@pytest.mark.parametrize("family", FAMILIES)
def test_recomputed_blocks_give_the_same_as_kept_ones(family):
    model, rows, table = problem(family)
    kept, recomputed = (
        BoundObjective(model, table, rows.blocks(model.kernel, 17, keep=keep))(table.start()) for keep in (True, False)
    )
    assert kept[0] == recomputed[0]
    np.testing.assert_array_equal(kept[1], recomputed[1])


@pytest.mark.parametrize("family", FAMILIES)
def test_block_size_does_not_matter(family):
    model, rows, table = problem(family)
    whole, whole_gradient = BoundObjective(model, table, rows.blocks(model.kernel, 1000))(table.start())
    for size in (1, 7, 60):
        value, gradient = BoundObjective(model, table, rows.blocks(model.kernel, size))(table.start())
        np.testing.assert_allclose(value, whole, rtol=1e-10)
        assert relative_error(gradient, whole_gradient) < 1e-10


def test_squares_from_statistics_are_never_negative_whatever_rounding_says():
    """Of rows that features explain to the last digit."""
    found = []
    for seed in range(20):
        model, rows, table = problem(seed=seed)
        rows.residuals[:] = rows.features @ np.full((3, 2), 30.0)
        values = table.values_at_start() | {"noise": np.full(2, 1e-10)}
        (bound,) = bounds_at_optimum(list(model.groups_on(values, rows.blocks(model.kernel, 17))))
        found.append(bound.residuals().squares)
    assert np.min(found) >= 0.0
    assert np.max(found) < 1e-6


@pytest.mark.parametrize("weights_are_shared", [False, True])
def test_factors_of_a_posterior_are_those_of_its_precision(weights_are_shared):
    model, rows, table = problem(shared=False)
    alike = {name: np.tile(getattr(model.prior, name)[:1], (2, 1)) for name in ("scale", "reference")}
    model = replace(model, prior=replace(model.prior, shared=weights_are_shared, **alike))
    groups = list(model.groups_on(table.values_at_start(), rows.blocks(model.kernel, 17)))
    for (q,) in optimal_posteriors(groups):
        np.testing.assert_allclose(q.root @ q.root.T, q.B, rtol=1e-10, atol=1e-10)
        np.testing.assert_array_equal(q.root, np.tril(q.root))
        np.testing.assert_allclose(q.root_inv @ q.root, np.eye(9), atol=1e-10)


def test_statistics_that_are_not_finite_raise_a_named_error():
    model, rows, table = problem()
    values = table.values(table.start())
    statistics = model.statistics(values, rows.blocks(model.kernel, 17))[0].scaled(np.nan)
    with pytest.raises(NotPositiveDefiniteError, match="not finite"):
        model.at_optimum(values, [statistics])


def evidence(rows, prior, output, noise):
    """log N(r | -H c w₀, H Σ_β Hᵀ + σ² I) of an output."""
    H, r = rows.features * prior.scale[output], rows.residuals[:, output]
    e, covariance = r + H @ prior.reference[output], H @ H.T + noise * np.eye(len(rows))
    quadratic = e @ np.linalg.solve(covariance, e)
    return -0.5 * (len(rows) * np.log(2 * np.pi) + np.linalg.slogdet(covariance)[1] + quadratic)


@pytest.mark.parametrize("p", [0, 3])
@pytest.mark.parametrize("trace", [0.0, 7.0])
def test_bound_of_the_features_alone_is_the_evidence_of_linear_regression(p, trace):
    """Less what the prior of f costs."""
    model, rows, _ = problem(p=p)
    noise, traces = np.array([0.3, 2.0]), np.array([trace, 2.0 * trace])
    bounds = bounds_alone(rows.blocks(model.kernel, 17).linear, model.prior, noise, traces)
    expected = [evidence(rows, model.prior, o, noise[o]) - traces[o] / (2.0 * noise[o]) for o in range(2)]
    np.testing.assert_allclose(bounds, expected, rtol=1e-10)


def test_shared_weights_with_singular_precision():
    """The feature lies in the span of the points, with 1e16 times the noise: I + Σ(F - EᵀD⁻¹E) is not positive."""
    model, rows, table = problem(p=1)
    values = table.values_at_start() | {"noise": np.full(2, 1e-16)}
    prior = CoefficientPrior(np.zeros((2, 1)), np.full((2, 1), 1e9), np.zeros((2, 1)), shared=True)
    (group,) = replace(model, prior=prior).groups_on(values, rows.blocks(model.kernel, 60))
    VV, w = group.statistics.VV, np.linspace(-1.0, 1.0, len(group.statistics.VV))
    inside = replace(group.statistics, VH=(VV @ w)[:, np.newaxis], HH=np.array([[w @ VV @ w * (1.0 - 1e-12)]]))
    for q in optimal_posteriors([replace(group, statistics=inside)])[0]:
        assert np.isfinite(q.mean).all()
        assert np.isfinite(q.root_inv).all()
        assert (np.diagonal(q.root) > 0.0).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_noise_far_below_the_signal_costs_no_digits(family):
    """1e8 in variance: e is summed row by row."""
    model, rows, table = problem(family)
    values = table.values_at_start() | {"noise": np.full(2, 1e-8)}
    small = table.started_at(values)
    value, gradient = BoundObjective(model, small, rows.blocks(model.kernel, 17))(small.start())
    loss = plain_loss(model, rows, small)
    np.testing.assert_allclose(value, loss(small.start()), rtol=1e-6)
    assert relative_error(gradient, grad(loss)(small.start())) < 1e-5


def test_negative_precision_becomes_prior_precision():
    """q of independent values: B is no less than I."""
    own = Whitening.of(SquaredExponential(1), np.ones(1), np.linspace(0, 1e-4, 4)[:, np.newaxis])
    B = np.diag([1.0, -3e30, 2.0, 1.0, -5.0])
    log_f, log_w = log_variances(B, own.L_inv)
    assert (-log_f >= np.log((own.L_inv**2).sum(axis=0)) - 1e-9).all()
    np.testing.assert_array_equal(log_w, [0.0])
    gap, B_bar, factor_bar = diagonal_gap(B, 0.0, np.zeros((5, 5)), own)
    assert gap == pytest.approx(-0.5 * (log_f.sum() + log_w.sum()) + np.log(np.diagonal(own.L)).sum(), rel=1e-9)
    assert np.isfinite(gap)
    assert np.isfinite(B_bar).all()
    assert np.isfinite(factor_bar).all()


# --- the upper bound -----------------------------------------------------------------------------------------------


def bounds_of(model, rows, values, from_rows=True):
    """The lower and the upper bound."""
    blocks = rows.blocks(model.kernel, 17)
    statistics = model.statistics(values, blocks)
    seen = blocks if from_rows else None
    return model.bound(values, statistics, seen), model.upper_bound(values, statistics, seen)


def on_rows(copies=1, n=30, p=3):
    """A problem in which each distinct row is an inducing point."""
    model, rows, table = problem(n=n, m=2, d=3, p=p)
    points = rows.inputs
    rows = type(rows)(*(np.repeat(own, copies, axis=0) for own in (points, rows.features, rows.residuals)))
    model = SparseModel(model.kernel, model.prior, model.groups, complete=True)
    return model, rows, table.values_at_start() | {"inducing_points": points[np.newaxis]}


def test_with_points_at_all_rows_the_gradient_is_that_of_the_bound_whatever_a_jitter_leaves_over():
    model, rows, table = problem(n=20, m=20)
    values = {"inducing_points": rows.inputs[np.newaxis], "hyperparameters": np.full(2, 3.0), "noise": np.full(2, 1e-2)}
    table = table.started_at(table.values_at_start() | values)
    model = replace(model, jitter=Jitter(0.03, 0.1), complete=True)
    objective = BoundObjective(model, table, rows.blocks(model.kernel, 17))
    _, gradient = objective(table.start())
    assert relative_error(gradient, central_differences(lambda x: objective(x)[0], table.start())) < 1e-5


def test_gradient_includes_jitter():
    """Three points on a line, of a linear kernel: K is singular, and a diagonal q's bound has the logarithm of what a
    jitter makes of its least eigenvalue. That is noisy: differences need wide steps."""
    x = np.append(np.zeros(7), [0.25, -0.25])[:, np.newaxis]
    kernel = ConstantKernel(1.0, "fixed") * DotProduct(1.0)
    model = EVGPRegressor(
        kernel=kernel, inducing_init=x[6:], solver=LBFGS(posterior="diagonal"), noise=Gaussian(variance=0.1), max_iter=0
    )
    y = np.random.RandomState(0).randn(9)
    one, blocks = at_the_fit(model.fit(x, y), x, y)
    objective, start = BoundObjective(one.sparse, one.table, blocks), one.table.start()
    step = 0.01 * np.eye(len(start))[0]
    slope = 9 * (objective(start + step)[0] - objective(start - step)[0]) / 0.02
    assert 9 * objective(start)[1][0] == pytest.approx(slope, abs=0.1)


def test_jitter_is_known_from_the_factor():
    model, _, values = on_rows()
    (whitening,) = model.whitenings(values)
    assert whitening.jitter() == 0.0
    twice = values | {"inducing_points": np.repeat(values["inducing_points"], 2, axis=1)}
    (whitening,) = replace(model, jitter=Jitter(1e-9)).whitenings(twice)
    assert whitening.jitter() == pytest.approx(1e-9, rel=1e-3)


def test_with_points_at_all_rows_a_jitter_does_not_take_the_upper_bound_below_the_log_likelihood():
    """Of residuals rougher than the kernel, which a jitter as large as the noise makes less likely."""
    model, rows, values = on_rows(p=0)
    values |= {"hyperparameters": np.full(3, 3.0), "noise": np.full(2, 1e-6), "signal": np.full(2, 25.0)}
    rows.residuals[:] = 0.01 * np.random.RandomState(0).randn(*rows.residuals.shape)
    jittered = replace(model, jitter=Jitter(1e-6, 0.1))
    few = values | {"inducing_points": rows.inputs[np.newaxis, :3]}
    exact = Dense(rows.raw, model.prior).likelihood(few)
    lower, upper = bounds_of(jittered, rows, values)
    assert lower < exact - 0.5
    # Nearer than with the trace, which holds for any points.
    assert exact < upper < bounds_of(replace(jittered, complete=False), rows, values)[1] - 1.0


def longdouble_upper_bound(model, rows, values):
    """With twice the digits where they cancel: the ridge solution at σ² + t by refinement, and |e|² from it."""
    total, Z = 0.0, values["inducing_points"]
    for o in range(len(model.prior.scale)):
        _, V = whitened(values["hyperparameters"], Z[o % len(Z)], rows.inputs)
        signal, noise, scale = values["signal"][o], values["noise"][o], model.prior.scale[o]
        P = np.hstack([np.sqrt(signal) * V.T, rows.features * scale]).astype(np.longdouble)
        r = (rows.residuals[:, o] + rows.features @ (scale * model.prior.reference[o])).astype(np.longdouble)
        wide = noise + signal * np.sum(1.0 - np.sum(V**2, axis=0))
        stacked = np.vstack([P.astype(float), np.sqrt(wide) * np.eye(P.shape[1])])
        omega = np.zeros(P.shape[1], dtype=np.longdouble)
        for _ in range(5):
            left = np.concatenate([r - P @ omega, -np.sqrt(wide) * omega])
            omega += np.linalg.lstsq(stacked, left.astype(float), rcond=None)[0]
        e = r - P @ omega
        singular = np.linalg.svd(P.astype(float), compute_uv=False)
        log_det = len(r) * np.log(noise) + np.log1p(singular**2 / noise).sum()
        total -= 0.5 * (len(r) * np.log(2 * np.pi) + log_det + float(e @ e / wide + omega @ omega))
    return total


@pytest.mark.parametrize("m", [6, 40])
def test_noise_far_below_the_signal_costs_the_upper_bound_no_digits(m):
    model, rows, table = problem(m=m, d=1 if m == 6 else 3, n=120)
    values = table.values_at_start() | {
        "noise": np.full(2, 1e-8),
        "hyperparameters": np.full(rows.inputs.shape[1], 0.7),
    }
    found = bounds_of(model, rows, values)[1]
    assert found == pytest.approx(longdouble_upper_bound(model, rows, values), rel=1e-7)


def test_errors_of_the_upper_bound_are_summed_row_by_row():
    """Of rows that features explain to five digits: differences of sums of squares have few of e's left."""
    model, rows, table = problem(n=120)
    rows.residuals[:] = rows.features @ np.full((3, 2), 30.0) + 1e-5 * np.random.RandomState(1).randn(120, 2)
    values = table.values_at_start() | {"noise": np.full(2, 1e-10), "signal": np.full(2, 1e-10)}
    expected = longdouble_upper_bound(model, rows, values)
    assert bounds_of(model, rows, values)[1] == pytest.approx(expected, rel=0.0, abs=1e-5)


@pytest.mark.parametrize("from_rows", [True, False])
@pytest.mark.parametrize("weights_are_shared", [False, True])
def test_loss_of_suboptimal_mean_is_known(weights_are_shared, from_rows):
    """The bound is quadratic in the mean."""
    model, rows, table = problem(shared=False)
    alike = {name: getattr(model.prior, name)[:1].repeat(2, axis=0) for name in ("mean", "scale", "reference")}
    model = replace(model, prior=replace(model.prior, shared=weights_are_shared, **alike))
    values, blocks = table.values_at_start(), rows.blocks(model.kernel, 17)
    groups = model.groups_of(values, model.statistics(values, blocks))
    best = sum(bound.value(bound.residuals(blocks)) for bound in bounds_at_optimum(groups))
    rng, bounds = np.random.RandomState(0), []
    off_w = 0.1 * rng.randn(model.prior.scale.shape[1])
    for group, posteriors in zip(groups, optimal_posteriors(groups), strict=True):
        offs = [np.concatenate([0.1 * rng.randn(len(q.mean) - len(off_w)), off_w]) for q in posteriors]
        moved = [replace(q, mean=q.mean + off) for q, off in zip(posteriors, offs, strict=True)]
        bounds.append(BoundAtOptimum(group, moved))
        if not weights_are_shared:
            rest = equation_errors(group, moved, bounds[-1].residuals(blocks))
            for q, off, found in zip(moved, offs, rest, strict=True):
                np.testing.assert_allclose(found, -q.B @ off, rtol=1e-8, atol=1e-8)
    left = [bound.residuals(blocks if from_rows else None) for bound in bounds]
    value = sum(bound.value(own) for bound, own in zip(bounds, left, strict=True))
    assert value < best - 0.1
    assert value + lost_by_rounding(bounds, left) == pytest.approx(best, rel=1e-9)


def test_upper_bound_corrects_suboptimal_mean(monkeypatch):
    """Means that something moved: the sum of squares that they leave is not the least, which the bound is made of."""
    model, rows, table = problem()
    values = table.values_at_start()
    blocks = rows.blocks(model.kernel, 17)
    groups = model.groups_of(values, model.statistics(values, blocks))
    expected = upper_bound(groups, blocks)

    def moved(groups):
        posteriors = optimal_posteriors(groups)
        return [
            BoundAtOptimum(group, [replace(q, mean=q.mean + 0.1) for q in own])
            for group, own in zip(groups, posteriors, strict=True)
        ]

    monkeypatch.setattr("skevgp.model.bounds.bounds_at_optimum", moved)
    assert upper_bound(groups, blocks) == pytest.approx(expected, rel=1e-9)
