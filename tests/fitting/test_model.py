"""The models of a problem: which outputs share what, where each starts, and what a search asks of one."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from skevgp.data.rows import LocalSource
from skevgp.fitting import rules
from skevgp.fitting.inducing import MAX_SAMPLE, Placement
from skevgp.fitting.parts import partition_of
from skevgp.fitting.runs import FeaturesAlone
from skevgp.model.bounds import Variant, bounds_alone
from skevgp.model.objectives import BoundObjective
from skevgp.solvers import LBFGS, Adam
from skevgp.utils.monitor import Monitor

from .cases import NO_FEATURES, H, N, O, X, Y, data_of, fitted, model_of, models, source_of, units_of

SHARING = ("all", "kernel", "none")
FOUR = data_of(np.column_stack([Y, 3.0 * Y[:, ::-1] + X]))

# --- who shares what --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sharing", "groups", "n_sets"),
    [
        ("all", [(slice(0, 2),)], 1),
        ("kernel", [(slice(0, 1), slice(1, 2))], 2),
        ("none", [(slice(0, 1),), (slice(0, 1),)], 1),
    ],
)
def test_outputs_share_as_they_are_told(sharing, groups, n_sets):
    """A set of points for each group; hyperparameters are a model's, s² and σ² an output's."""
    found = models(sharing=sharing)
    assert [model.sparse.groups for model in found] == groups
    for model in found:
        n_outputs = O // len(found)
        shapes = {own.name: own.start.shape for own in model.table.parameters}
        assert shapes == {
            "hyperparameters": (2,),
            "signal": (n_outputs,),
            "noise": (n_outputs,),
            "inducing_points": (n_sets, 8, 2),
        }
        assert model.sparse.prior.scale.shape == (n_outputs, 2)


def test_groups_are_models_of_their_outputs():
    """Of columns that do not follow each other too; a callback is told which, in the user's units."""
    told = []
    for model, own in zip(
        models(Monitor(lambda *what: told.append(what)), sharing=[[2, 0], [3, 1]], **FOUR),
        ([0, 2], [1, 3]),
        strict=True,
    ):
        rows = FOUR["units"].to_internal(source_of(Y=FOUR["Y"], H=NO_FEATURES).take(np.arange(N)))
        np.testing.assert_array_equal(model.rows.some(np.arange(N)).targets, rows.targets[:, own])
        model.monitor.iteration(3, 10.0)
        expected = 10.0 + N * np.log(FOUR["units"].target_unit[own]).sum()
        assert told.pop() == (3, pytest.approx(expected), tuple(own))
    for model in models(Monitor(lambda *what: told.append(what)), sharing="none"):
        model.monitor.iteration(1, 0.0)
    assert [columns for _, _, columns in told] == [range(0, 1), range(1, 2)]


@pytest.mark.parametrize("solver", [LBFGS(), Adam()])
def test_noise_starts_where_the_rules_of_the_solver_say(solver):
    model = model_of(solver=solver)
    np.testing.assert_allclose(model.table["noise"].start, model.rules.first_noise * model.scatter)
    np.testing.assert_allclose(model.table["noise"].lower, model.rules.lowest_noise * model.scatter)
    assert model.sparse.jitter == model.rules.jitter


@pytest.mark.parametrize(
    ("sharing", "n_outputs", "partition"),
    [
        ("all", 3, [[0, 1, 2]]),
        ("kernel", 3, [[0, 1, 2]]),
        ("none", 3, [[0], [1], [2]]),
        (((1,), (2, 0)), 3, [[0, 2], [1]]),
        (np.array([[3, 1], [0, 2]]), 4, [[0, 2], [1, 3]]),
        ([[0]], 1, [[0]]),
    ],
    ids=str,
)
def test_partition_has_one_order(sharing, n_outputs, partition):
    assert partition_of(sharing, n_outputs) == partition


# --- where they start -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sharing", SHARING)
def test_starting_values_are_in_user_units(sharing):
    kernel = ConstantKernel(5.0, (1.0, 20.0)) * RBF([0.7, 0.9]) + WhiteKernel(0.3, (0.1, 1.0))
    unit = units_of().target_unit
    tables = [model.table for model in models(sharing=sharing, kernel=kernel)]
    signal, noise = (np.concatenate([table[name].start for table in tables]) for name in ("signal", "noise"))
    np.testing.assert_allclose(signal * unit**2, 5.0)
    np.testing.assert_allclose(noise * unit**2, 0.3)
    limits = np.vstack([table["noise"].value_limits() for table in tables])
    np.testing.assert_allclose(limits * unit[:, np.newaxis] ** 2, [[0.1, 1.0]] * O)
    for table in tables:
        np.testing.assert_allclose(table["hyperparameters"].start, [0.7, 0.9])


_x = np.random.RandomState(0).randint(0, 5, (MAX_SAMPLE + 1, 1)).astype(float)
MANY = data_of(np.random.RandomState(1).randn(*_x.shape), _x) | {"n_inducing": 10}
TWICE = {"X": np.vstack([X, X * (1.0 + 1e-15)]), "H": np.vstack([H, H]), "Y": np.vstack([Y, Y])}


@pytest.mark.parametrize(
    ("changes", "stay"),
    [
        ({"n_inducing": 2 * N}, True),
        ({"n_inducing": N, "sharing": "kernel"}, True),
        ({**TWICE, "n_inducing": N}, True),
        ({**TWICE, "placement": Placement(X[::-1], N)}, True),
        ({"n_inducing": N - 1}, False),
        ({"n_inducing": N, "variant": Variant("diagonal")}, False),
        ({"placement": Placement(X[1:], N - 1)}, False),
        ({"placement": Placement(X + 1e-3, N)}, False),
        (MANY, False),
    ],
    ids=["all", "kernel", "rounding", "given", "too few", "diagonal", "all but one", "next to the rows", "a sample's"],
)
def test_points_at_all_rows_are_kept(changes, stay):
    """There the bound is the likelihood, and no other places are better. Rows that differ by rounding only are one.

    Of more rows than a sample has nobody has looked whether they are all.
    """
    model = model_of(**changes)
    assert model.table["inducing_points"].free.any() != stay
    assert model.sparse.complete == stay
    # A kernel with as many points as rows may explain each row by itself.
    assert model.interpolates == (model.n_inducing >= N)
    if stay and "placement" not in changes:
        for points in model.table["inducing_points"].start:
            np.testing.assert_array_equal(points, X)


# --- where another fit ended ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sharing", SHARING)
def test_fit_goes_on_where_another_ended(sharing):
    first = fitted(sharing=sharing)
    for model, before in zip(models(previous=first, sharing=sharing), first.models, strict=True):
        for name, value in before.values.items():
            np.testing.assert_allclose(model.warm[name], value, rtol=1e-10, err_msg=name)


@pytest.mark.parametrize("why", ["nothing before", "other sharing", "one output"])
def test_fit_that_cannot_go_on_starts_cold(why):
    first = fitted(sharing="kernel")
    changes = {
        "nothing before": {},
        "other sharing": {"sharing": "none", "previous": first},
        "one output": {"Y": Y[:, :1], "H": NO_FEATURES, "previous": first},
    }[why]
    assert all(model.warm is None for model in models(**changes))


# --- what a search asks -----------------------------------------------------------------------------------------------


def test_noise_start_with_many_features(monkeypatch):
    """With the signal at its lower limit, 1e-8 of the unit; if it is fixed, that depends on where the kernel ends."""
    monkeypatch.setattr("skevgp.fitting.model.may_hide_noise", lambda prior, n_rows: True)
    model = model_of()
    found: FeaturesAlone = model.alone
    trace = np.full(O, 1e-8 * N)
    alone = bounds_alone(model.blocks.linear, model.sparse.prior, found.noise, trace).sum()
    assert found.bound == pytest.approx(alone, rel=1e-9)
    assert found.bound >= model.bound_alone - 1e-6 * abs(model.bound_alone)
    assert (found.hidden, found.most) == (True, -np.inf)
    fixed = model_of(kernel=ConstantKernel(4.0, "fixed") * RBF([1.0, 1.0])).alone
    assert fixed.most > fixed.bound


# --- more inducing points ---------------------------------------------------------------------------------------------


def growing(most=1000, first=8, **changes):
    return model_of(placement=Placement("k-means", first, most), **changes)


@pytest.mark.parametrize("sharing", ["all", "kernel"])
def test_half_as_many_points_again_come_after_those_of_a_fit_as_far_as_they_may(sharing):
    model = growing(sharing=sharing)
    values = model.table.values_at_start()
    values["inducing_points"] = values["inducing_points"] + 0.1
    more = model.with_more(values)
    start = more.table["inducing_points"].start
    assert start.shape == (1 if sharing == "all" else 2, 12, 2)
    np.testing.assert_array_equal(start[:, :8], values["inducing_points"])
    assert np.isin(start[:, 8:], X).all()
    assert more.table["inducing_points"].free.all()
    assert growing(most=10, sharing=sharing).with_more(values).n_inducing == 10
    assert growing(most=8, sharing=sharing).with_more(values) is None
    assert model_of(sharing=sharing).with_more(values) is None


def test_rows_of_a_sample_count_for_some_that_are_left_out(monkeypatch):
    """In the smallest sample once, and in one twice as large twice. In larger ones, together as much as all rows."""
    sampled = replace(rules.RULES, few_rows=0.0, sample=(10, 1), growth=2)
    monkeypatch.setattr(rules, "RULES", sampled)
    (model,) = models(sharing="all")
    assert model.samples[:2] == (10, 20)
    assert N >= 40
    for n_rows, count in ((10, 1), (20, 2)):
        raw = model._sample.source.take(np.arange(n_rows))[np.tile(np.arange(n_rows), count)]
        repeated = replace(model.rows, source=LocalSource.holding(raw))
        blocks = model.sparse.blocks(repeated, model.n_inducing)
        x = model.table.start()
        expected = BoundObjective(model.sparse, model.table, blocks)(x)
        for found, wanted in zip(model.objective(model.table, n_rows)(x), expected, strict=True):
            np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-12)
    assert model._count(model.samples[-1]) * model.samples[-1] <= N
