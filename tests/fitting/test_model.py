"""The models of a problem: which outputs share what, where each starts, and what a search asks of one."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

from skevgp.fitting import search
from skevgp.fitting.inducing import MAX_SAMPLE, Placement
from skevgp.fitting.model import partition_of
from skevgp.fitting.search import FeaturesAlone, Fit, Search
from skevgp.model.bounds import bounds_alone
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


@pytest.mark.parametrize(
    ("sharing", "n_threads", "share"), [("none", 1, 1.0), ("none", 2, 0.5), ("none", 9, 0.5), ("all", 2, 1.0)]
)
def test_fits_at_once_share_the_memory_and_start_alike(sharing, n_threads, share):
    found = models(sharing=sharing, n_threads=n_threads)
    assert {model.rows.share for model in found} == {share}
    assert len({model.seed for model in found}) == 1
    for model in found[1:]:
        np.testing.assert_array_equal(model.table["inducing_points"].start, found[0].table["inducing_points"].start)


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
def test_a_partition_has_one_order(sharing, n_outputs, partition):
    assert partition_of(sharing, n_outputs) == partition


@pytest.mark.parametrize(
    "sharing",
    [[[0, 1]], [[0, 1], [1, 2]], [[0, 1], [2], []], [[0, 1], [3]], [[-1, 0], [1]], [0, 1, 2], [[0.0, 1.0], [2.0]], []],
    ids=str,
)
def test_what_is_no_partition_is_named(sharing):
    with pytest.raises(ValueError, match=r"sharing=\[.*must be .* partition of the outputs.*each of range\(3\)"):
        partition_of(sharing, 3)


# --- where they start -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", [LBFGS(), Adam()])
def test_the_noise_starts_where_the_rules_of_the_solver_say(solver):
    model = model_of(solver=solver)
    np.testing.assert_allclose(model.table["noise"].start, model.rules.first_noise * model.scatter)
    np.testing.assert_allclose(model.table["noise"].lower, model.rules.lowest_noise * model.scatter)
    assert model.sparse.jitter == model.rules.jitter


@pytest.mark.parametrize("sharing", SHARING)
def test_what_the_user_says_is_in_his_units(sharing):
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


def test_a_kernel_that_is_none_is_named_before_anything_is_fitted():
    with pytest.raises(ValueError, match=r"kernel: k\(X, X\) must be positive semi-definite"):
        models(kernel=lambda A, B: A @ B.T - 10.0)


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
        ({"n_inducing": N, "family": "diagonal"}, False),
        ({"placement": Placement(X[1:], N - 1)}, False),
        ({"placement": Placement(X + 1e-3, N)}, False),
        (MANY, False),
    ],
    ids=["all", "kernel", "rounding", "given", "too few", "diagonal", "all but one", "next to the rows", "a sample's"],
)
def test_points_that_are_all_rows_stay(changes, stay):
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
def test_a_fit_goes_on_where_another_ended(sharing):
    first = fitted(sharing=sharing)
    for model, before in zip(models(previous=first, sharing=sharing), first.models, strict=True):
        for name, value in before.values.items():
            np.testing.assert_allclose(model.warm[name], value, rtol=1e-10, err_msg=name)


def test_values_go_over_to_the_units_of_other_targets():
    first, other = fitted(), {"Y": 100.0 * Y}
    (model,), before = models(previous=first, **other), first.models[0].values
    ratio = units_of().target_unit ** 2 / units_of(**other).target_unit ** 2
    for name in ("signal", "noise"):
        expected = np.clip(before[name] * ratio, model.table[name].lower, model.table[name].upper)
        np.testing.assert_allclose(model.warm[name], expected, rtol=1e-9)
    np.testing.assert_allclose(model.warm["hyperparameters"], before["hyperparameters"])


def test_another_kernel_takes_over_noise_and_points_only_and_given_points_are_the_users():
    first = fitted()
    (model,), before = models(previous=first, kernel=Matern([1.0, 2.0])), first.models[0].values
    np.testing.assert_allclose(model.warm["hyperparameters"], [1.0, 2.0])
    for name in ("noise", "inducing_points"):
        np.testing.assert_allclose(model.warm[name], before[name])
    (model,) = models(previous=first, placement=Placement(X[:8], 8))
    np.testing.assert_allclose(model.warm["inducing_points"], [X[:8]])


@pytest.mark.parametrize("most", [20, 8])
def test_points_whose_number_was_found_count_as_placed(most):
    """Though the table starts at them, as it does at first points; also where they are as many as first points."""
    changes = {"placement": Placement("auto", 8, most), "max_iter": 100}
    first = fitted(**changes)
    (model,), (cold,) = models(previous=first, **changes), models(**changes)
    assert model.placed
    assert not cold.placed
    np.testing.assert_allclose(model.table["inducing_points"].start, first.models[0].values["inducing_points"])


@pytest.mark.parametrize("why", ["nothing before", "other sharing", "one output"])
def test_a_fit_that_cannot_go_on_starts_cold(why):
    first = fitted(sharing="kernel")
    changes = {
        "nothing before": {},
        "other sharing": {"sharing": "none", "previous": first},
        "one output": {"Y": Y[:, :1], "H": NO_FEATURES, "previous": first},
    }[why]
    assert all(model.warm is None for model in models(**changes))


@pytest.mark.parametrize("X", [1e3 * X + 1e4, 1e-3 * X + 1e4, np.hstack([X, X[:, :1]])], ids=["wide", "narrow", "more"])
def test_points_of_another_space_are_left_with_all_else(X):
    """It then starts from the cold values, though some of the data's range is the same."""
    (model,) = models(previous=fitted(), X=X)
    for name, value in model.table.values_at_start().items():
        np.testing.assert_array_equal(model.warm[name], value)


# --- what a search asks -----------------------------------------------------------------------------------------------


def test_a_model_knows_what_the_features_alone_explain():
    """And a fit that ended below that is tried from elsewhere."""
    model = model_of()
    r = model.rows.some(np.arange(N)).targets
    expected = bounds_alone(model.blocks.linear, model.sparse.prior, np.mean(r**2, axis=0), np.zeros(O)).sum()
    assert model.bound_alone == pytest.approx(expected, rel=1e-10)
    # The signal can be 1e-8 of the unit.
    assert model.alone.bound == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(model.alone.noise, np.mean(r**2, axis=0), rtol=1e-6)
    values, own = model.table.values_at_start(), Search(model)
    assert own.collapsed(Fit(values, model.alone.bound - 1.0))
    assert not own.collapsed(Fit(values, model.alone.bound + 1.0))


def test_where_features_may_hide_the_noise_it_is_known_which_suits_them(monkeypatch):
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


@pytest.mark.parametrize("sharing", ["all", "kernel"])
def test_places_follow_the_kernel_that_was_learned(sharing):
    """Where one column does not matter, the greedy search spreads points over the other, alike for all groups."""
    model = model_of(placement=Placement("auto", 8), sharing=sharing)
    values = model.table.values_at_start()
    placed = model.place(values | {"hyperparameters": np.array([0.5, 1e3])})
    first, *others = placed["inducing_points"]
    assert first.shape == (8, 2)
    assert {tuple(point) for point in first} <= {tuple(row) for row in X}
    assert np.abs(np.diff(np.sort(first[:, 0]))).min() > 0.1
    assert len(others) == (sharing == "kernel")
    for points in others:
        np.testing.assert_array_equal(points, first)
    assert placed["noise"] is values["noise"]
    assert model_of().place is None


def test_restarts_start_elsewhere_in_all():
    model = model_of()
    first, drawn = model.table.values_at_start(), model.restart()
    for name in ("hyperparameters", "noise", "inducing_points"):
        assert (drawn[name] != first[name]).any(), name
    lower, upper = model.table.limits()
    flat = model.table.started_at(drawn).start()
    assert ((lower <= flat) & (flat <= upper)).all()


def test_the_smaller_sample_is_part_of_the_larger_one(monkeypatch):
    monkeypatch.setattr(search, "RULES", replace(search.RULES, sample=(15, 1), growth=2))
    model = model_of(n_inducing=5)
    assert model.samples == (15, 30)
    fewer, again, more = (model.objective(model.table, size).blocks.linear for size in (15, 15, 30))
    assert (fewer.n_rows, more.n_rows) == model.samples
    np.testing.assert_array_equal(fewer.RR, again.RR)
    assert (model.blocks.linear.RR >= more.RR).all()
    assert (more.RR >= fewer.RR).all()
    assert model.objective(model.table).blocks is model.blocks
    # Points that are all rows are not fitted to a sample; nor are mini-batches.
    assert model_of(n_inducing=N).samples == model_of(solver=Adam()).samples == ()


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


@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_points_as_many_as_rows_become_the_rows(family):
    model = growing(first=45, family=family)
    more = model.with_more(model.table.values_at_start())
    np.testing.assert_array_equal(more.table["inducing_points"].start, X[np.newaxis])
    assert more.sparse.complete == (family == "full")
    assert more.table["inducing_points"].free.any() == (family == "diagonal")
    assert more.with_more(more.table.values_at_start()) is None
