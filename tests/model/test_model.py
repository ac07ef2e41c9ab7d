"""From parameters to groups of outputs, bound and predictor."""

import numpy as np
import pytest

from skevgp.model.bounds import bounds_at_optimum
from skevgp.model.objectives import BoundObjective
from skevgp.model.statistics import Whitening
from skevgp.utils.linalg import Jitter

from ..oracle import collapsed_bound, problem, relative_error


class Passes:
    """Blocks that count the passes over them."""

    def __init__(self, blocks):
        self._blocks, self.count = blocks, 0

    @property
    def linear(self):
        return self._blocks.linear

    def sum(self, function):
        self.count += 1
        return self._blocks.sum(function)


def started(family="full", shared=True, **sizes):
    model, rows, table = problem(family, shared, **sizes)
    return model, rows, table.values_at_start(), Passes(rows.blocks(model.kernel, 17))


@pytest.mark.parametrize("shared", [True, False])
def test_a_group_has_what_belongs_to_its_outputs(shared):
    model, rows, values, blocks = started(shared=shared)
    groups = list(model.groups_on(values, blocks))
    assert [group.outputs for group in groups] == list(model.groups)
    for index, group in enumerate(groups):
        np.testing.assert_array_equal(group.signal, values["signal"][group.outputs])
        np.testing.assert_array_equal(group.noise, values["noise"][group.outputs])
        np.testing.assert_array_equal(group.prior.scale, model.prior.scale[group.outputs])
        assert group.statistics.VR.shape == (6, len(group.signal))
        own = Whitening.of(model.kernel, values["hyperparameters"], values["inducing_points"][index])
        np.testing.assert_array_equal(group.whitening.L, own.L)
        np.testing.assert_allclose(group.statistics.RR, np.sum(rows.residuals[:, group.outputs] ** 2, axis=0))


def test_a_group_costs_a_pass_when_it_is_asked_for():
    model, _, values, blocks = started(shared=False)
    groups = model.groups_on(values, blocks)
    assert blocks.count == 0
    next(groups)
    assert blocks.count == 1
    next(groups)
    assert blocks.count == 2


@pytest.mark.parametrize("shared", [True, False])
def test_known_statistics_cost_no_pass(shared):
    model, _, values, blocks = started(shared=shared)
    statistics = model.statistics(values, blocks)
    n_passes = blocks.count
    for known, fresh in zip(model.groups_of(values, statistics), model.groups_on(values, blocks), strict=True):
        np.testing.assert_array_equal(known.statistics.VV, fresh.statistics.VV)
        np.testing.assert_array_equal(known.whitening.L, fresh.whitening.L)
    assert blocks.count == 2 * n_passes == 2 * len(model.groups)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_the_bound_at_the_optimum_is_that_of_the_data(family, shared):
    model, rows, values, blocks = started(family, shared)
    statistics = model.statistics(values, blocks)
    bound, predictor = model.bound(values, statistics), model.at_optimum(values, statistics)
    expected = collapsed_bound(
        values["hyperparameters"],
        values["signal"],
        values["noise"],
        values["inducing_points"],
        rows,
        model.prior,
        family,
    )
    assert bound == pytest.approx(float(expected), rel=1e-8)
    np.testing.assert_array_equal(predictor.noise, values["noise"])
    np.testing.assert_array_equal(predictor.signal, values["signal"])
    np.testing.assert_array_equal(predictor.offset, model.prior.offset)
    assert [group.outputs for group in predictor.groups] == list(model.groups)


@pytest.mark.parametrize("shared", [True, False])
def test_at_the_optimum_both_families_have_one_mean_and_the_diagonal_one_the_inverse_of_the_precisions_diagonal(shared):
    roots = {}
    for family in ("full", "diagonal"):
        model, _, values, blocks = started(family, shared)
        predictor = model.at_optimum(values, model.statistics(values, blocks))
        group = next(iter(predictor.groups))
        # In the coordinates (f_m, β): f_m = s L v, and what the root multiplies is [s V; c H].
        to_values = np.eye(9)
        to_values[:6, :6] = group.whitening.L
        roots[family] = group.mean[0], group.root[0] @ to_values.T
    np.testing.assert_allclose(roots["diagonal"][0], roots["full"][0], rtol=1e-10)
    covariances = {family: root.T @ root for family, (_, root) in roots.items()}
    np.testing.assert_allclose(
        np.diag(covariances["diagonal"]), 1.0 / np.diag(np.linalg.inv(covariances["full"])), rtol=1e-6
    )
    off_diagonal = covariances["diagonal"] - np.diag(np.diag(covariances["diagonal"]))
    assert np.abs(off_diagonal).max() < 1e-8 * covariances["diagonal"].max()


def test_sums_of_rows_that_came_later_are_those_of_all():
    """q at its optimum for the added sums is q for all rows."""
    model, rows, values, _ = started()
    blocks = rows.blocks(model.kernel, 20)
    parts = [
        type(rows)(rows.inputs[own], rows.features[own], rows.residuals[own]) for own in (slice(25), slice(25, 60))
    ]
    first, second = (model.statistics(values, part.blocks(model.kernel, 20))[0] for part in parts)
    found, expected = [first + second], model.statistics(values, blocks)
    assert model.bound(values, found) == pytest.approx(model.bound(values, expected), rel=1e-9)
    means = [model.at_optimum(values, statistics).groups[0].mean for statistics in (found, expected)]
    assert relative_error(*means) < 1e-9


@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_the_bound_is_what_the_objective_minimises(family):
    model, rows, table = problem(family)
    blocks, values = rows.blocks(model.kernel, 17), table.values_at_start()
    bound = model.bound(values, model.statistics(values, blocks))
    assert BoundObjective(model, table, blocks)(table.start())[0] == pytest.approx(-bound / len(rows), rel=1e-9)


def test_the_jitter_is_the_models():
    model, _, values, blocks = started()
    values = values | {"inducing_points": np.repeat(values["inducing_points"][:, :3], 2, axis=1)}
    factors = [
        next(type(model)(model.kernel, model.prior, "full", model.groups, jitter).whitenings(values)).L
        for jitter in (Jitter(1e-12), Jitter(1e-6))
    ]
    np.testing.assert_allclose(np.diag(factors[1])[1::2] ** 2, 2e-6, rtol=1e-3)
    assert (np.diag(factors[0])[1::2] ** 2 < 1e-10).all()
    (bound,) = bounds_at_optimum(list(model.groups_on(values, blocks)), "full")
    assert np.isfinite(bound.residuals().squares).all()
