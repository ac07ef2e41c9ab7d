import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad

from skevgp.inference.blocks import Batch
from skevgp.inference.bounds import BoundAtOptimum
from skevgp.inference.linalg import NotPositiveDefiniteError
from skevgp.inference.model import SparseModel
from skevgp.inference.objectives import BoundObjective, ElboObjective

from .oracle import collapsed_bound, problem, whitened

FAMILIES = ("full", "diagonal")
SHARED = (True, False)


def central_differences(function, x, step=1e-6):
    return np.array([(function(x + step * e) - function(x - step * e)) / (2 * step) for e in np.eye(len(x))])


def relative_error(actual, expected):
    return np.abs(actual - expected).max() / np.abs(expected).max()


def plain_loss(model, rows, table):
    """The loss per row as plain autograd of the flat vector."""
    unit = table["inducing_points"].unit

    def loss(flat):
        c = table.coordinates(flat)
        bound = collapsed_bound(
            anp.exp(c["hyperparameters"]),
            anp.exp(c["signal"]),
            anp.exp(c["noise"]),
            c["inducing_points"] * unit,
            rows,
            model.prior,
            model.family,
        )
        return -bound / len(rows)

    return loss


@pytest.mark.parametrize("shared", SHARED)
@pytest.mark.parametrize("family", FAMILIES)
def test_bound_and_gradient_agree_with_plain_autograd(family, shared):
    model, rows, table = problem(family, shared)
    loss = plain_loss(model, rows, table)
    value, gradient = BoundObjective(model, table, rows.blocks(model.kernel, 17))(table.start())
    np.testing.assert_allclose(value, loss(table.start()), rtol=1e-10)
    assert relative_error(gradient, grad(loss)(table.start())) < 1e-9


@pytest.mark.parametrize("shared", SHARED)
@pytest.mark.parametrize("family", FAMILIES)
def test_gradient_agrees_with_finite_differences(family, shared):
    model, rows, table = problem(family, shared)
    objective = BoundObjective(model, table, rows.blocks(model.kernel, 17))
    _, gradient = objective(table.start())
    assert relative_error(gradient, central_differences(lambda x: objective(x)[0], table.start())) < 1e-5


def test_gradient_with_one_lengthscale_for_all_columns():
    from skevgp.inference.parameters import Start
    from skevgp.inference.start import Starts, starting_table
    from skevgp.kernels import SquaredExponential

    model, rows, table = problem()
    model = SparseModel(SquaredExponential(2, isotropic=True), model.prior, "full", model.groups)
    table = starting_table(
        np.ones(2), table["inducing_points"].start, np.ones(2), Starts(Start(), Start(), Start()), np.ones(2), 0.1, 1
    )
    loss = plain_loss(model, rows, table)
    value, gradient = BoundObjective(model, table, rows.blocks(model.kernel, 17))(table.start())
    assert relative_error(gradient, grad(loss)(table.start())) < 1e-9
    np.testing.assert_allclose(value, loss(table.start()), rtol=1e-10)


@pytest.mark.parametrize("family", FAMILIES)
def test_recomputed_blocks_give_the_same_as_kept_ones(family, monkeypatch):
    model, rows, table = problem(family)
    kept = BoundObjective(model, table, rows.blocks(model.kernel, 17))(table.start())
    monkeypatch.setattr("skevgp.inference.blocks.KEEP_BYTES", 0)
    recomputed = BoundObjective(model, table, rows.blocks(model.kernel, 17))(table.start())
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


@pytest.mark.parametrize("shared", SHARED)
@pytest.mark.parametrize("family", FAMILIES)
def test_loss_at_the_optimal_q_is_minus_the_bound(family, shared):
    """The paper's loss with q at its closed-form optimum (Titsias 2009, eq. 10)."""
    model, rows, table = problem(family, shared)
    elbo = ElboObjective(model, table, rows.blocks(model.kernel, 17))
    blocks = rows.blocks(model.kernel, 17)
    # ElboObjective starts q at its optimum.
    loss = elbo._loss(elbo.table.start(), blocks) / len(rows)
    np.testing.assert_allclose(
        loss, BoundObjective(model, table, rows.blocks(model.kernel, 17))(table.start())[0], rtol=1e-8
    )
    values = table.values(table.start())
    bound, _ = model.at_optimum(values, model.statistics(values, blocks))
    np.testing.assert_allclose(-bound / len(rows), loss, rtol=1e-8)


@pytest.mark.parametrize("shared", SHARED)
@pytest.mark.parametrize("family", FAMILIES)
def test_any_other_q_has_a_lower_bound(family, shared):
    model, rows, table = problem(family, shared)
    elbo = ElboObjective(model, table, rows.blocks(model.kernel, 17))
    blocks = rows.blocks(model.kernel, 17)
    start = elbo.table.start()
    best = elbo._loss(start, blocks)
    rng = np.random.RandomState(0)
    for name in ("mean", "spread"):
        for size in (1e-3, 0.1, 1.0):
            coordinates = elbo.table.coordinates(start)
            coordinates[name] = coordinates[name] + size * rng.randn(*coordinates[name].shape)
            assert elbo._loss(elbo.table.flat(coordinates), blocks) > best


@pytest.mark.parametrize("shared", SHARED)
@pytest.mark.parametrize("family", FAMILIES)
def test_elbo_gradient_agrees_with_finite_differences(family, shared):
    model, rows, table = problem(family, shared, n=30, m=4, p=2)
    elbo = ElboObjective(model, table, rows.blocks(model.kernel, 30))
    block = rows.blocks(model.kernel, 30)[0]
    objective = elbo.minibatch(iter([Batch(block)] * 1000))
    x = elbo.table.start() + 0.1 * np.random.RandomState(1).randn(elbo.table.size)
    _, gradient = objective(x)
    assert relative_error(gradient, central_differences(lambda x: objective(x)[0], x)) < 1e-5


@pytest.mark.parametrize("shared", SHARED)
@pytest.mark.parametrize("family", FAMILIES)
def test_elbo_agrees_with_the_papers_formula_in_plain_autograd(family, shared):
    """Value and gradient in all parameters, from the data, term by term (the paper's eq. elbo)."""
    model, rows, table = problem(family, shared, n=30, m=4, p=2)
    elbo = ElboObjective(model, table, rows.blocks(model.kernel, 30))
    o, size, m = len(model.prior.scale), 6, 4
    unit, mean_unit = table["inducing_points"].unit, elbo.table["mean"].unit

    def loss(x):
        c = elbo.table.coordinates(x)
        total = 0.0
        for i in range(o):
            Z = c["inducing_points"][i % len(c["inducing_points"])] * unit
            L, V = whitened(anp.exp(c["hyperparameters"]), Z, rows.inputs)
            s2, noise = anp.exp(c["signal"][i]), anp.exp(c["noise"][i])
            mean = c["mean"][i] * mean_unit[i]
            if family == "diagonal":
                variance = anp.exp(c["spread"][i])
                f = anp.linalg.solve(L, anp.diag(variance[:m])) @ anp.linalg.inv(L).T
                covariance = anp.concatenate(
                    [
                        anp.concatenate([f, np.zeros((m, size - m))], axis=1),
                        anp.concatenate([np.zeros((size - m, m)), anp.diag(variance[m:])], axis=1),
                    ]
                )
            else:
                rows_, columns = np.tril_indices(size, -1)
                T = anp.diag(anp.exp(c["spread"][i][:size]))
                for k, (row, column) in enumerate(zip(rows_, columns, strict=True)):
                    place = np.zeros((size, size))
                    place[row, column] = 1.0
                    T = T + c["spread"][i][size + k] * place
                root = elbo.root_start[i] @ T
                covariance = root @ root.T
            prior = model.prior
            P = anp.concatenate([anp.sqrt(s2) * V.T, rows.features * prior.scale[i]], axis=1)
            e = rows.residuals[:, i] - P @ mean
            log_likelihood = -0.5 * (len(rows) * anp.log(2 * np.pi * noise) + e @ e / noise)
            traces = anp.trace(P @ covariance @ P.T) / noise + s2 * anp.sum(1 - anp.sum(V**2, axis=0)) / noise
            shift = mean + np.concatenate([np.zeros(m), prior.reference[i]])
            divergence = 0.5 * (anp.trace(covariance) + shift @ shift - size - anp.linalg.slogdet(covariance)[1])
            total = total - log_likelihood + 0.5 * traces + divergence
        return total / len(rows)

    block = rows.blocks(model.kernel, 30)[0]
    objective = elbo.minibatch(iter([Batch(block)]))
    x = elbo.table.start() + 0.1 * np.random.RandomState(1).randn(elbo.table.size)
    value, gradient = objective(x)
    np.testing.assert_allclose(value, loss(x), rtol=1e-9)
    assert relative_error(gradient, grad(loss)(x)) < 1e-9


def test_a_mini_batch_weighs_the_data_terms_by_N():
    """The paper's appendix C: the mean over all batches of an epoch is the loss of all rows."""
    model, rows, table = problem(n=60)
    elbo = ElboObjective(model, table, rows.blocks(model.kernel, 60))
    x = elbo.table.start()
    whole = rows.blocks(model.kernel, 60)
    batches = rows.blocks(model.kernel, 20)
    losses = [elbo.minibatch(iter([Batch(block)]))(x)[0] for block in batches]
    np.testing.assert_allclose(np.mean(losses), elbo._loss(x, whole) / 60, rtol=1e-10)


def test_residuals_from_statistics_agree_with_those_from_rows():
    model, rows, table = problem()
    values = table.values(table.start())
    blocks = rows.blocks(model.kernel, 17)
    statistics = model.statistics(values, blocks)[0]
    bound = BoundAtOptimum(statistics, values["signal"], values["noise"], model.prior)
    _, V = whitened(values["hyperparameters"], values["inducing_points"][0], rows.inputs)
    e = rows.residuals - V.T @ bound.fitted[:6] - rows.features @ bound.fitted[6:]
    np.testing.assert_allclose(bound.residuals().squares, (e**2).sum(axis=0), rtol=1e-8)
    np.testing.assert_allclose(bound.residuals().VE, V @ e, rtol=1e-6, atol=1e-8)


def test_statistics_that_are_not_finite_raise_a_named_error():
    model, rows, table = problem()
    values = table.values(table.start())
    statistics = model.statistics(values, rows.blocks(model.kernel, 17))[0].scaled(np.nan)
    with pytest.raises(NotPositiveDefiniteError, match="not finite"):
        BoundAtOptimum(statistics, values["signal"], values["noise"], model.prior)
