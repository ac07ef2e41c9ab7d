"""From parameters to groups of outputs, bound and predictor."""

import numpy as np
import pytest

from skevgp.model.statistics import Whitening

from ..oracle import problem, relative_error


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
def test_group_has_what_belongs_to_its_outputs(shared):
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


def test_group_costs_a_pass_when_it_is_asked_for():
    model, _, values, blocks = started(shared=False)
    groups = model.groups_on(values, blocks)
    assert blocks.count == 0
    next(groups)
    assert blocks.count == 1
    next(groups)
    assert blocks.count == 2


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
