"""The loss of mini-batches and its hand-written gradient, for each family of q."""

from dataclasses import replace
from types import SimpleNamespace

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import value_and_grad

from skevgp.data.blocks import Batch
from skevgp.model.bounds import Variant
from skevgp.model.objectives import ElboObjective
from skevgp.model.statistics import SufficientStatistics

from ..oracle import negative_elbo, problem, relative_error, whitened, with_groups

FAMILIES = ("full", "diagonal")
SHARED = (True, False)


def batch(model, rows, size, first=0):
    """A block of rows, and their sums."""
    return Batch(rows.blocks(model.kernel, size)[first])


def away_from_the_start(elbo, size=0.1):
    return elbo.table.start() + size * np.random.RandomState(1).randn(elbo.table.size)


def traced_root(elbo, family, spread, L, output):
    """R with Cov[ω] = R Rᵀ, and log |R Rᵀ|, in autograd.numpy."""
    m = len(L)
    size = m + elbo.model.prior.scale.shape[1]
    if family == "diagonal":
        half = anp.exp(0.5 * spread)
        f, zeros = anp.linalg.inv(L) * half[:m], np.zeros((m, size - m))
        root = anp.concatenate(
            [anp.concatenate([f, zeros], axis=1), anp.concatenate([zeros.T, anp.diag(half[m:])], axis=1)]
        )
        return root, anp.sum(spread) - 2.0 * anp.sum(anp.log(anp.diag(L)))
    T = anp.diag(anp.exp(spread[:size]))
    for k, (row, column) in enumerate(zip(*np.tril_indices(size, -1), strict=True)):
        place = np.zeros((size, size))
        place[row, column] = 1.0
        T = T + spread[size + k] * place
    start = elbo.family.roots(elbo.table.values_at_start(), [])[output].T
    root = start @ T
    return root, anp.linalg.slogdet(root)[1] * 2.0


def traced_loss(elbo, family, block, linear):
    """The loss per row by `negative_elbo`, on statistics in plain autograd.numpy."""
    model, table, n_rows = elbo.model, elbo.table, elbo.n_rows
    X = block.prepared[: model.kernel.n_columns].T
    points = table["inducing_points"]
    m, o = points.start.shape[1], len(model.prior.scale)

    def loss(x):
        c = table.coordinates(x)
        parts, roots, log_dets = [], [], []
        for i in range(o):
            Z = c["inducing_points"][i % len(c["inducing_points"])] * points.unit + points.origin
            L, V = whitened(anp.exp(c["hyperparameters"]), Z, X)
            left = 1.0 - anp.sum(V**2, axis=0)
            if model.variant.tight:
                ratio = anp.exp(c["signal"][i] - c["noise"][i])
                left = anp.log(1.0 + ratio * left) / ratio
            parts.append((V @ V.T, V @ block.features, V @ block.residuals, anp.sum(left)))
            root, log_det = traced_root(elbo, family, c["spread"][i], L, i)
            roots.append(root)
            log_dets.append(log_det)
        VV, VH, VR, unexplained = (anp.stack(part) for part in zip(*parts, strict=True))
        statistics = SufficientStatistics(
            linear.n_rows, VV, VH, VR, linear.HH[0], linear.HR, linear.RR, unexplained, 0.0, 0.0
        ).scaled(n_rows / linear.n_rows)
        assert VV.shape == (o, m, m)
        prior, of_factors = model.prior, 0.0
        if prior.groups is not None:
            logs = anp.concatenate([c["coef_factors"], np.zeros((o, 1))], axis=1)[np.arange(o)[:, None], prior.groups]
            prior = SimpleNamespace(scale=prior.scale * anp.exp(logs), reference=prior.reference * anp.exp(-logs))
            of_factors = 0.5 * anp.sum(c["coef_factors"] ** 2) / n_rows
        return (
            of_factors
            + negative_elbo(
                statistics,
                anp.exp(c["signal"]),
                anp.exp(c["noise"]),
                prior,
                c["mean"] * table["mean"].unit,
                anp.stack(roots),
                anp.stack(log_dets),
            )
            / n_rows
        )

    return loss


@pytest.mark.parametrize("size", [60, 25], ids=["all rows", "mini-batch"])
@pytest.mark.parametrize("shared", SHARED)
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("tight", [False, True])
def test_loss_and_gradient_agree_with_autograd(tight, family, shared, size):
    model, rows, table = problem(family, shared, n=60, m=5, p=2)
    model, table = with_groups(replace(model, variant=Variant(model.variant.family, tight)), table)
    elbo = ElboObjective(model, table, rows.blocks(model.kernel, 60))
    rows_of = batch(model, rows, size)
    x = away_from_the_start(elbo)
    value, gradient = elbo.evaluate(x, rows_of)
    expected, expected_gradient = value_and_grad(traced_loss(elbo, family, rows_of.block, rows_of.linear))(x)
    np.testing.assert_allclose(value, expected, rtol=1e-10)
    assert relative_error(gradient, expected_gradient) < 1e-9


@pytest.mark.parametrize("family", FAMILIES)
def test_without_features_and_with_fixed_weights(family):
    for p, scale in ((0, 1.0), (3, 0.0)):
        model, rows, table = problem(family, n=40, m=4, p=p)
        model.prior.scale[:] *= scale
        elbo = ElboObjective(model, table, rows.blocks(model.kernel, 40))
        rows_of = batch(model, rows, 40)
        x = away_from_the_start(elbo)
        value, gradient = elbo.evaluate(x, rows_of)
        expected, expected_gradient = value_and_grad(traced_loss(elbo, family, rows_of.block, rows_of.linear))(x)
        np.testing.assert_allclose(value, expected, rtol=1e-10)
        assert relative_error(gradient, expected_gradient) < 1e-9


def test_mini_batch_weighs_the_data_terms_by_N():
    """The paper's appendix C: the mean over all batches of an epoch is the loss of all rows."""
    model, rows, table = problem(n=60)
    elbo = ElboObjective(model, table, rows.blocks(model.kernel, 60))
    x = elbo.table.start()
    batches = [batch(model, rows, 20, i) for i in range(3)]
    step = elbo.minibatch(iter(batches))
    results = [step(x) for _ in batches]
    whole, gradient = elbo.evaluate(x, batch(model, rows, 60))
    np.testing.assert_allclose(np.mean([loss for loss, _ in results]), whole, rtol=1e-10)
    np.testing.assert_allclose(np.mean([bar for _, bar in results], axis=0), gradient, atol=1e-9)
