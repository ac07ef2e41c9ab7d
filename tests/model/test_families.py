"""The families of q that mini-batches move: where they start, what they add to the loss, how natural gradients step."""

import numpy as np
import pytest

from skevgp.data.blocks import Batch
from skevgp.model.bounds import optimal_posteriors
from skevgp.model.families import DiagonalFamily, FullFamily, NaturalFamily
from skevgp.model.objectives import BoundObjective, ElboObjective
from skevgp.model.parameters import ParameterTable

from ..oracle import central_differences, problem, relative_error

SHARED = (True, False)
M, P, O = 6, 3, 2  # noqa: E741
SIZE = M + P


def batch(model, rows, size, first=0):
    """A block of rows, and their sums."""
    return Batch(rows.blocks(model.kernel, size)[first])


def started(kind, shared=True):
    """A family that starts at the optimum, the groups of all rows, and the best q of each output."""
    model, rows, table = problem("diagonal" if kind is DiagonalFamily else "full", shared)
    groups = list(model.groups_on(table.values_at_start(), rows.blocks(model.kernel, 60)))
    optima = [q for own in optimal_posteriors(groups) for q in own]
    L_inv = [group.whitening.L_inv for group in groups for _ in group.signal]
    family = DiagonalFamily(optima, L_inv) if kind is DiagonalFamily else kind(optima)
    return family, groups, optima, L_inv


def table_of(family):
    return ParameterTable(family.parameters(np.ones((O, SIZE))))


def covariances(family, values, L_inv):
    return [root.T @ root for root in family.roots(values, L_inv)]


# --- where they start ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shared", SHARED)
@pytest.mark.parametrize("kind", [DiagonalFamily, FullFamily])
def test_family_that_gradients_move_starts_at_the_best_q(kind, shared):
    family, groups, optima, L_inv = started(kind, shared)
    values = table_of(family).values_at_start()
    for mean, best in zip(family.means(values), optima, strict=True):
        np.testing.assert_allclose(mean, best.mean, rtol=1e-12)
    for group in groups:
        np.testing.assert_array_equal(family.mean(values, group), values["mean"][group.outputs])
    for S, best, factor in zip(covariances(family, values, L_inv), optima, L_inv, strict=True):
        if kind is FullFamily:
            np.testing.assert_allclose(S, np.linalg.inv(best.B), rtol=1e-8, atol=1e-12)
        else:
            # Independent in the coordinates (f_m, β), with the inverse of the diagonal of the precision.
            T = np.eye(SIZE)
            T[:M, :M] = np.linalg.inv(factor)
            precision = np.linalg.inv(T).T @ best.B @ np.linalg.inv(T)
            np.testing.assert_allclose(T @ S @ T.T, np.diag(1.0 / np.diag(precision)), atol=1e-10)


def test_mean_is_moved_in_the_units_one_says():
    family, *_ = started(FullFamily)
    unit = 0.5 + np.arange(O * SIZE, dtype=float).reshape(O, SIZE)
    table = ParameterTable(family.parameters(unit))
    flat = table.start()
    flat[: O * SIZE] += 1.0
    np.testing.assert_allclose(table.values(flat)["mean"] - table.values_at_start()["mean"], unit)


# --- what the spread adds to the loss ------------------------------------------------------------------------------


def away(family, seed=1):
    table = table_of(family)
    return table, table.start() + 0.2 * np.random.RandomState(seed).randn(table.size)


@pytest.mark.parametrize("shared", SHARED)
@pytest.mark.parametrize("kind", [DiagonalFamily, FullFamily])
def test_spreads_terms_are_traces_and_a_determinant(kind, shared):
    """½ [Tr((I + σ⁻² PᵀP) S) - log |S|], written down."""
    family, groups, _, L_inv = started(kind, shared)
    table, flat = away(family)
    values = table.values(flat)
    S = covariances(family, values, L_inv)
    for group in groups:
        expected = 0.0
        for o, output in enumerate(range(group.outputs.start, group.outputs.stop)):
            precision = np.eye(SIZE) + group.products(o)[0] / group.noise[o]
            expected += 0.5 * (np.vdot(precision, S[output]) - np.linalg.slogdet(S[output])[1])
        assert family.terms(values, group).value == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("shared", SHARED)
@pytest.mark.parametrize("kind", [DiagonalFamily, FullFamily])
def test_their_gradient_in_the_spread_agrees_with_finite_differences(kind, shared):
    family, groups, *_ = started(kind, shared)
    table, flat = away(family)

    def value(flat):
        return sum(family.terms(table.values(flat), group).value for group in groups)

    spread = np.concatenate([family.terms(table.values(flat), group).spread for group in groups])
    found = table.gradient({"mean": np.zeros((O, SIZE)), "spread": spread})
    assert relative_error(found, central_differences(value, flat)) < 1e-6


@pytest.mark.parametrize("shared", SHARED)
@pytest.mark.parametrize("kind", ["full", "diagonal"])
def test_any_other_q_has_a_lower_bound(kind, shared):
    model, rows, table = problem(kind, shared)
    elbo = ElboObjective(model, table, rows.blocks(model.kernel, 17))
    blocks = rows.blocks(model.kernel, 17)
    start = elbo.table.start()
    best, _ = elbo.evaluate(start, blocks)
    rng = np.random.RandomState(0)
    for name in ("mean", "spread"):
        for size in (1e-3, 0.1, 1.0):
            coordinates = elbo.table.coordinates(start)
            coordinates[name] = coordinates[name] + size * rng.randn(*coordinates[name].shape)
            assert elbo.evaluate(elbo.table.flat(coordinates), blocks)[0] > best


# --- natural gradients ---------------------------------------------------------------------------------------------


def natural(rate=0.3, least=0.02):
    _, groups, optima, _ = started(FullFamily)
    return NaturalFamily(optima, rate, least), groups, optima


def test_at_the_optimum_a_step_goes_nowhere():
    family, groups, optima = natural()
    for mean, best in zip(family.mean({}, groups[0]), optima, strict=True):
        np.testing.assert_allclose(mean, best.mean, rtol=1e-8)
    for precision, best in zip(family.precision, optima, strict=True):
        np.testing.assert_allclose(precision, best.B, rtol=1e-10)


@pytest.mark.parametrize(("share", "rate"), [(1.0, 0.3), (0.5, 0.15), (1e-3, 0.02)])
def test_steps_shorten_with_adams_but_not_to_nothing(share, rate):
    family, *_ = natural()
    family.pace(share)
    assert family.rate == pytest.approx(rate)


@pytest.mark.parametrize("shared", SHARED)
def test_natural_gradient_of_length_1_on_all_rows_is_the_closed_form(shared):
    """Hensman et al. 2013: from anywhere to the optimum in one step; then the gradient is the collapsed bound's."""
    model, rows, table = problem("full", shared)
    elbo = ElboObjective(model, table, rows.blocks(model.kernel, 17), natural_rates=(1.0, 1.0))
    rng = np.random.RandomState(0)
    for precision, shift in zip(elbo.family.precision, elbo.family.shift, strict=True):
        precision += np.diag(rng.rand(len(precision)))
        shift += rng.randn(len(shift))
    blocks = rows.blocks(model.kernel, 17)
    x = elbo.table.start() + 0.1 * np.random.RandomState(1).randn(elbo.table.size)
    loss, gradient = elbo.evaluate(x, blocks)
    expected, expected_gradient = BoundObjective(model, table, rows.blocks(model.kernel, 17))(x)
    np.testing.assert_allclose(loss, expected, rtol=1e-8)
    assert relative_error(gradient, expected_gradient) < 1e-8
    values = table.values(x)
    optima = [q for own in optimal_posteriors(list(model.groups_on(values, blocks))) for q in own]
    for mean, best in zip(elbo.family.means(values), optima, strict=True):
        np.testing.assert_allclose(mean, best.mean, rtol=1e-8, atol=1e-8 * np.abs(best.mean).max())
    for root, best in zip(elbo.family.roots(values, []), optima, strict=True):
        np.testing.assert_allclose(root.T @ root, best.root_inv.T @ best.root_inv, rtol=1e-8, atol=1e-8)


def test_natural_gradient_goes_a_share_of_the_way():
    """Of the way in natural parameters, from where q is to the optimum for the rows at hand."""
    model, rows, table = problem("full")
    elbo = ElboObjective(model, table, rows.blocks(model.kernel, 60), natural_rates=(0.25, 0.25))
    x = elbo.table.start() + 0.1 * np.random.RandomState(1).randn(elbo.table.size)
    before, shift_before = [part.copy() for part in elbo.family.precision], [part.copy() for part in elbo.family.shift]
    rows_of = batch(model, rows, 20, 1)
    elbo.evaluate(x, rows_of)
    there = ElboObjective(model, table, rows.blocks(model.kernel, 60), natural_rates=(1.0, 1.0))
    there.evaluate(x, rows_of)
    for o in range(2):
        np.testing.assert_allclose(
            elbo.family.precision[o], 0.75 * before[o] + 0.25 * there.family.precision[o], rtol=1e-10, atol=1e-10
        )
        np.testing.assert_allclose(
            elbo.family.shift[o], 0.75 * shift_before[o] + 0.25 * there.family.shift[o], rtol=1e-10, atol=1e-10
        )


def test_gradient_at_a_q_that_natural_gradients_moved():
    """It is that of the loss with q held where the step put it."""
    model, rows, table = problem("full", shared=False, n=30, m=4, p=2)
    natural = ElboObjective(model, table, rows.blocks(model.kernel, 30), natural_rates=(0.5, 0.5))
    rows_of = batch(model, rows, 12)
    x = table.start()
    loss, gradient = natural.evaluate(x, rows_of)
    # The same q as a point of the family that gradients move.
    held = ElboObjective(model, table, rows.blocks(model.kernel, 30))
    coordinates = held.table.coordinates(held.table.start())
    values = table.values(x)
    coordinates["mean"] = np.array(natural.family.means(values)) / held.table["mean"].unit
    below, starts = np.tril_indices(6, -1), held.family.roots(held.table.values_at_start(), [])
    for o, root in enumerate(natural.family.roots(values, [])):
        start = starts[o].T
        T = np.linalg.cholesky(np.linalg.solve(start, root.T @ root) @ np.linalg.inv(start).T)
        coordinates["spread"][o] = np.concatenate([np.log(np.diag(T)), T[below]])
    expected, expected_gradient = held.evaluate(held.table.flat(coordinates), rows_of)
    np.testing.assert_allclose(loss, expected, rtol=1e-9)
    assert relative_error(gradient, expected_gradient[: len(x)]) < 1e-9
