"""Several outputs: which share what, where each starts, and what is told of all of them."""

from dataclasses import replace
from threading import Event, get_ident

import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

from skevgp.data.threads import BlockMap
from skevgp.fitting.inducing import MAX_SAMPLE, Placement
from skevgp.fitting.outputs import fit_outputs
from skevgp.fitting.plan import partition_of, plan
from skevgp.solvers import LBFGS, Adam
from skevgp.utils.monitor import Monitor

from .cases import NO_FEATURES, H, N, O, X, Y, data_of, request, source_of, units_of

SHARING = ("all", "kernel", "none")


def planned(monitor=None, seed=0, previous=None, **changes):
    monitor = Monitor() if monitor is None else monitor
    return plan(request(**changes), np.random.RandomState(seed), monitor, BlockMap(), previous)


def fitted(monitor=None, seed=0, previous=None, **changes):
    monitor = Monitor() if monitor is None else monitor
    return fit_outputs(request(**changes), np.random.RandomState(seed), monitor, previous)


# --- who shares what -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sharing", "groups", "n_sets"),
    [
        ("all", [(slice(0, 2),)], 1),
        ("kernel", [(slice(0, 1), slice(1, 2))], 2),
        ("none", [(slice(0, 1),), (slice(0, 1),)], 1),
    ],
)
def test_outputs_share_as_they_are_told(sharing, groups, n_sets):
    """A task for each model, a set of points for each group; hyperparameters are a model's, s² and σ² an output's."""
    tasks = planned(sharing=sharing)
    assert [task.model.groups for task in tasks] == groups
    for task in tasks:
        n_outputs = O // len(tasks)
        shapes = {own.name: own.start.shape for own in task.table.parameters}
        assert shapes == {
            "hyperparameters": (2,),
            "signal": (n_outputs,),
            "noise": (n_outputs,),
            "inducing_points": (n_sets, 8, 2),
        }
        assert task.model.prior.scale.shape == (n_outputs, 2)
        assert task.rows.scatter().shape == (n_outputs,)


def test_models_that_share_nothing_have_their_own_outputs_and_start_alike():
    tasks, units = planned(sharing="none"), units_of()
    for o, task in enumerate(tasks):
        np.testing.assert_array_equal(task.model.prior.scale[0], units.internal_prior().scale[o])
        internal = units.to_internal(source_of().take(np.arange(N))).targets[:, [o]]
        np.testing.assert_array_equal(task.rows.some(np.arange(N)).targets, internal)
    assert len({task.seed for task in tasks}) == 1
    points, again = (task.table["inducing_points"].start for task in tasks)
    np.testing.assert_array_equal(points, again)


@pytest.mark.parametrize(
    ("sharing", "n_threads", "share"), [("none", 1, 1.0), ("none", 2, 0.5), ("none", 9, 0.5), ("all", 2, 1.0)]
)
def test_fits_at_once_share_the_memory(sharing, n_threads, share):
    assert {task.rows.share for task in planned(sharing=sharing, n_threads=n_threads)} == {share}


def test_options_reach_each_task():
    solver, placement = Adam(batch_size=7), Placement("greedy", 5)
    for task in planned(
        sharing="none", solver=solver, placement=placement, max_iter=3, tol=0.7, noise_cv=4, family="diagonal"
    ):
        assert (task.solver, task.placement, task.max_iter, task.tol, task.noise_cv) == (solver, placement, 3, 0.7, 4)
        assert task.model.family == "diagonal"
        assert task.model.jitter == solver.rules.jitter


@pytest.mark.parametrize("sharing", SHARING)
def test_each_model_tells_of_its_outputs_in_the_users_units(sharing):
    told = []
    tasks = planned(Monitor(lambda *what: told.append(what)), sharing=sharing)
    unit = units_of().target_unit
    for task in tasks:
        task.monitor.iteration(3, 10.0)
    columns = [range(0, 1), range(1, 2)] if sharing == "none" else [range(0, 2)]
    for (number, loss, own), expected in zip(told, columns, strict=True):
        assert (number, own) == (3, expected)
        assert loss == pytest.approx(10.0 + N * np.log(unit[list(expected)]).sum())


def test_ctrl_c_in_one_model_stops_all():
    tasks = planned(sharing="none")
    tasks[0].monitor.stop()
    with pytest.raises(KeyboardInterrupt):
        tasks[1].monitor.iteration(1, 0.0)


# --- where they start ----------------------------------------------------------------------------------------------


def test_the_noise_starts_where_the_solver_says():
    for solver in (LBFGS(), Adam()):
        (task,) = planned(solver=solver)
        scatter = task.rows.scatter()
        np.testing.assert_allclose(task.table["noise"].start, solver.rules.first_noise * scatter)
        np.testing.assert_allclose(task.table["noise"].lower, solver.rules.lowest_noise * scatter)


@pytest.mark.parametrize("sharing", SHARING)
def test_what_the_user_says_is_in_his_units(sharing):
    kernel = ConstantKernel(5.0, (1.0, 20.0)) * RBF([0.7, 0.9]) + WhiteKernel(0.3, (0.1, 1.0))
    unit = units_of().target_unit
    tables = [task.table for task in planned(sharing=sharing, kernel=kernel)]
    signal, noise = (np.concatenate([table[name].start for table in tables]) for name in ("signal", "noise"))
    np.testing.assert_allclose(signal * unit**2, 5.0)
    np.testing.assert_allclose(noise * unit**2, 0.3)
    limits = np.vstack([table["noise"].value_limits() for table in tables])
    np.testing.assert_allclose(limits * unit[:, np.newaxis] ** 2, [[0.1, 1.0]] * O)
    for table in tables:
        np.testing.assert_allclose(table["hyperparameters"].start, [0.7, 0.9])


def test_a_kernel_that_is_none_is_named_before_anything_is_fitted():
    with pytest.raises(ValueError, match=r"kernel: k\(X, X\) must be positive semi-definite"):
        planned(kernel=lambda A, B: A @ B.T - 10.0)


def is_fixed(**changes):
    (task,) = planned(**changes)
    return not task.table["inducing_points"].free.any()


@pytest.mark.parametrize("sharing", ["all", "kernel"])
def test_points_that_are_all_rows_stay(sharing):
    """There the bound is the likelihood, and no other places are better."""
    assert is_fixed(n_inducing=N, sharing=sharing)
    assert is_fixed(n_inducing=2 * N, sharing=sharing)
    (task,) = planned(n_inducing=N, sharing=sharing)
    for points in task.table["inducing_points"].start:
        np.testing.assert_array_equal(points, X)


def test_points_at_all_distinct_rows_stay_too():
    """Rows that differ by rounding only are one."""
    twice = {"X": np.vstack([X, X * (1.0 + 1e-15)]), "H": np.vstack([H, H]), "Y": np.vstack([Y, Y])}
    assert is_fixed(**twice, n_inducing=N)
    assert is_fixed(**twice, n_inducing=N, placement=Placement(X[::-1], N))


@pytest.mark.parametrize(
    "changes",
    [
        {"n_inducing": N - 1},
        {"n_inducing": N, "family": "diagonal"},
        {"placement": Placement(X[1:], N - 1)},
        {"placement": Placement(X + 1e-3, N)},
    ],
    ids=["too few", "diagonal", "all rows but one", "beside the rows"],
)
def test_other_points_move(changes):
    assert not is_fixed(**changes)


def test_points_that_are_all_rows_of_a_sample_move():
    """Nobody has looked whether they are all rows."""
    n = MAX_SAMPLE + 1
    rng = np.random.RandomState(0)
    X = rng.randint(0, 5, (n, 1)).astype(float)
    many = {"X": X, "H": np.empty((n, 0)), "Y": rng.randn(n, 1)}
    (task,) = planned(**many, n_inducing=10, units=units_of(**many))
    assert task.n_inducing == 5
    assert task.table["inducing_points"].free.all()


def test_a_fit_does_not_move_them():
    done = fitted(n_inducing=N, kernel=ConstantKernel() * RBF([1.0, 1.0]))
    np.testing.assert_allclose(done.predictor().groups[0].points, X, rtol=1e-14)
    assert done.n_iter > 0


# --- where another fit ended ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("sharing", SHARING)
def test_a_fit_goes_on_where_another_ended(sharing):
    first = fitted(sharing=sharing)
    for task, learned in zip(planned(previous=first, sharing=sharing), first.learned, strict=True):
        for name, value in learned.values.items():
            np.testing.assert_allclose(task.warm[name], value, rtol=1e-10, err_msg=name)


def test_values_go_over_to_the_units_of_other_targets():
    first, other = fitted(), {"Y": 100.0 * Y}
    (task,) = planned(previous=first, **other)
    unit, new_unit = units_of().target_unit, units_of(**other).target_unit
    for name in ("signal", "noise"):
        expected = np.clip(
            first.learned[0].values[name] * unit**2 / new_unit**2, task.table[name].lower, task.table[name].upper
        )
        np.testing.assert_allclose(task.warm[name], expected, rtol=1e-9)
    np.testing.assert_allclose(task.warm["hyperparameters"], first.learned[0].values["hyperparameters"])


def test_another_kernel_takes_over_noise_and_points_only():
    first = fitted()
    (task,) = planned(previous=first, kernel=Matern([1.0, 2.0]))
    np.testing.assert_allclose(task.warm["hyperparameters"], [1.0, 2.0])
    np.testing.assert_allclose(task.warm["noise"], first.learned[0].values["noise"])
    np.testing.assert_allclose(task.warm["inducing_points"], first.learned[0].values["inducing_points"])


def test_given_points_are_where_the_user_says():
    first = fitted()
    (task,) = planned(previous=first, placement=Placement(X[:8], 8))
    np.testing.assert_allclose(task.warm["inducing_points"], [X[:8]])


@pytest.mark.parametrize("most", [20, 8])
def test_points_whose_number_was_found_are_not_placed_anew(most):
    """Though the table starts at them, as it does at first points; also where they are as many as first points."""
    changes = {"placement": Placement("auto", 8, most), "max_iter": 100}
    first = fitted(**changes)
    (task,), (cold,) = planned(previous=first, **changes), planned(**changes)
    attempt = next(task.strategy.attempts())
    np.testing.assert_allclose(attempt.values["inducing_points"], first.learned[0].values["inducing_points"])
    assert attempt.until == 100 > next(cold.strategy.attempts()).until


@pytest.mark.parametrize("why", ["nothing before", "other sharing", "one output"])
def test_a_fit_that_cannot_go_on_starts_cold(why):
    first = fitted(sharing="kernel")
    changes = {
        "nothing before": {},
        "other sharing": {"sharing": "none", "previous": first},
        "one output": {"Y": Y[:, :1], "previous": first},
    }[why]
    assert all(task.warm is None for task in planned(**changes))


@pytest.mark.parametrize("scale", [1e3, 1e-3])
def test_points_of_another_space_are_left_with_all_else(scale):
    """It then starts from the cold values, though some of the data's range is the same."""
    (task,) = planned(previous=fitted(), X=scale * X + 1e4)
    cold = task.table.values_at_start()
    for name, value in cold.items():
        np.testing.assert_array_equal(task.warm[name], value)


def test_points_of_other_columns_are_left():
    (task,) = planned(previous=fitted(), X=np.hstack([X, X[:, :1]]))
    assert task.warm["inducing_points"].shape == (1, 8, 3)


# --- what is kept --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sharing", SHARING)
def test_the_predictor_is_of_all_outputs_in_the_users_units(sharing):
    done = fitted(sharing=sharing, max_iter=50)
    predictor = done.predictor()
    mean, variance = predictor.predict(X, H, return_variance=True)
    assert mean.shape == variance.shape == (N, O)
    assert (np.mean((mean - Y) ** 2, axis=0) < 0.2 * Y.var(axis=0)).all()
    internal = np.concatenate([one.values["noise"] for one in done.learned])
    np.testing.assert_allclose(predictor.noise, internal * units_of().target_unit ** 2)


@pytest.mark.parametrize("sharing", SHARING)
def test_the_bound_is_summed_and_of_the_users_targets(sharing):
    """In units a hundred times as small, the density of each row and output is a hundredth."""
    kernel = {"kernel": ConstantKernel(1.0) * RBF([1.0, 1.0]), "max_iter": 0}
    done, scaled = (
        fitted(sharing=sharing, H=NO_FEATURES, Y=factor * Y, **kernel | {"kernel": factor**2 * RBF([1.0, 1.0])})
        for factor in (1.0, 100.0)
    )
    assert scaled.lower_bound == pytest.approx(done.lower_bound - N * O * np.log(100.0), rel=1e-9)
    shift = N * np.log(units_of(H=NO_FEATURES).target_unit).sum()
    assert done.lower_bound == pytest.approx(sum(one.bound for one in done.learned) - shift)


def with_curves(*curves):
    done = fitted(sharing="none", max_iter=0)
    return replace(
        done, learned=tuple(replace(one, loss_curve=curve) for one, curve in zip(done.learned, curves, strict=True))
    )


def test_the_loss_curve_is_the_sum_of_the_models_and_one_that_is_done_keeps_its_last_value():
    shift = N * np.log(units_of().target_unit).sum()
    done = with_curves([5.0, 4.0, 3.5], [10.0])
    np.testing.assert_allclose(done.loss_curve, shift + np.array([15.0, 14.0, 13.5]))
    assert done.n_iter == 3


def test_without_iterations_there_is_no_loss_curve():
    done = with_curves([], [])
    assert done.loss_curve.shape == (0,)
    assert done.n_iter == 0


@pytest.mark.parametrize("sharing", SHARING)
def test_the_loss_curve_ends_at_minus_the_bound(sharing):
    done = fitted(sharing=sharing, max_iter=15)
    assert -done.loss_curve[-1] == pytest.approx(done.lower_bound, abs=1e-6 * abs(done.lower_bound))


@pytest.mark.parametrize("family", ["full", "diagonal"])
@pytest.mark.parametrize(("sharing", "n_sets", "n_kernels"), [("all", 1, 1), ("kernel", 2, 1), ("none", 2, 2)])
def test_parameters_are_counted(sharing, n_sets, n_kernels, family):
    """Points, lengthscales, s² and σ² of each output, and q's mean and covariance over 8 values and 2 weights."""
    of_q = 2 * 10 if family == "diagonal" else 10 + 10 * 11 // 2
    expected = n_sets * 8 * 2 + n_kernels * 2 + O * (2 + of_q)
    assert fitted(sharing=sharing, family=family, max_iter=0).n_parameters == expected


def test_what_is_fixed_does_not_count():
    free, fixed = (
        fitted(kernel=1.0 * RBF([1.0, 1.0], bounds) + WhiteKernel(0.1, bounds), max_iter=0).n_parameters
        for bounds in ((1e-3, 1e3), "fixed")
    )
    assert free - fixed == 2 + O


@pytest.mark.parametrize("sharing", SHARING)
def test_limits_are_in_the_users_units_and_those_of_the_outputs_model(sharing):
    kernel = ConstantKernel(5.0, (1.0, 20.0)) * RBF([0.7, 0.9], [(0.1, 2.0), (0.2, 3.0)])
    done = fitted(sharing=sharing, kernel=kernel, max_iter=0)
    for o in range(O):
        np.testing.assert_allclose(done.limits("signal", o), [[1.0, 20.0]])
        np.testing.assert_allclose(done.limits("hyperparameters", o), [[0.1, 2.0], [0.2, 3.0]])
    by_data = fitted(sharing=sharing, max_iter=0)
    ratio = by_data.limits("signal", 1) / by_data.limits("signal", 0)
    np.testing.assert_allclose(ratio, (units_of().target_unit[1] / units_of().target_unit[0]) ** 2)


@pytest.mark.parametrize("sharing", SHARING)
def test_new_rows_go_to_each_model(sharing):
    done = fitted(sharing=sharing, max_iter=5)
    twice = done.updated(source_of())
    assert twice.units is done.units
    for one, before in zip(twice.learned, done.learned, strict=True):
        for own, old in zip(one.statistics, before.statistics, strict=True):
            np.testing.assert_allclose(own.RR, 2.0 * old.RR, rtol=1e-12)
    # Twice the same rows is what is known of them with half the noise.
    faded = done.updated(source_of(), 0.0)
    np.testing.assert_allclose(faded.predictor().predict(X, H)[0], done.predictor().predict(X, H)[0], rtol=1e-6)


# --- side by side --------------------------------------------------------------------------------------------------


def test_threads_do_not_change_the_bits():
    alone, side_by_side = (fitted(sharing="none", n_threads=n, max_iter=5).predictor() for n in (1, 2))
    np.testing.assert_array_equal(alone.predict(X, H)[0], side_by_side.predict(X, H)[0])


def test_models_run_at_once_if_there_are_threads():
    """Each waits in its first iteration for the other's."""
    both, seen = [Event(), Event()], set()

    def meet(iteration, loss, outputs):
        seen.add(get_ident())
        both[outputs.start].set()
        assert both[1 - outputs.start].wait(60.0)

    fitted(Monitor(meet), sharing="none", n_threads=2, max_iter=2)
    assert len(seen) == 2
    assert get_ident() not in seen


@pytest.mark.parametrize("n_threads", [1, 2])
def test_an_error_in_one_model_is_the_fits(n_threads):
    class Broken(LBFGS):
        def run(self, task, attempt):
            if len(task.rows.scatter()) and task.rows.columns == [1]:
                raise ZeroDivisionError("the second")
            return super().run(task, attempt)

    with pytest.raises(ZeroDivisionError, match="the second"):
        fitted(sharing="none", solver=Broken(), n_threads=n_threads)


@pytest.mark.parametrize("n_threads", [1, 2])
def test_ctrl_c_keeps_what_each_model_has(n_threads):
    def interrupt(iteration, loss, outputs):
        if iteration == 2:
            raise KeyboardInterrupt

    done = fitted(Monitor(interrupt), sharing="none", n_threads=n_threads)
    assert len(done.learned) == 2
    assert done.n_iter <= 2
    assert done.messages == (
        f"The fit was interrupted after {done.n_iter} iterations; the best parameters so far are kept.",
    )
    assert np.isfinite(done.lower_bound)


def test_what_several_models_say_alike_is_said_once():
    done = fitted(sharing="none", max_iter=2, tol=1e-9)
    assert len(done.messages) == 1
    assert "still rising after max_iter=2" in done.messages[0]


# --- groups --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sharing", "n_outputs", "partition"),
    [
        ("all", 3, [[0, 1, 2]]),
        ("kernel", 3, [[0, 1, 2]]),
        ("none", 3, [[0], [1], [2]]),
        ([[2, 0], [1]], 3, [[0, 2], [1]]),
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


FOUR = data_of(np.column_stack([Y, 3.0 * Y[:, ::-1] + X]))


def of_four(columns):
    return data_of(FOUR["Y"][:, columns])


def test_groups_are_models_of_their_outputs():
    """Of columns that do not follow each other too; a callback is told which."""
    told = []
    tasks = planned(Monitor(lambda *what: told.append(what)), sharing=[[2, 0], [3, 1]], **FOUR)
    for task, own in zip(tasks, ([0, 2], [1, 3]), strict=True):
        assert task.model.groups == (slice(0, 2),)
        rows = FOUR["units"].to_internal(source_of(Y=FOUR["Y"], H=NO_FEATURES).take(np.arange(N)))
        np.testing.assert_array_equal(task.rows.some(np.arange(N)).targets, rows.targets[:, own])
        assert task.table["inducing_points"].start.shape == (1, 8, 2)
        task.monitor.iteration(1, 0.0)
    assert [columns for _, _, columns in told] == [(0, 2), (1, 3)]
    assert [loss for _, loss, _ in told] == [
        pytest.approx(N * np.log(FOUR["units"].target_unit[own]).sum()) for own in ([0, 2], [1, 3])
    ]


def test_groups_are_fitted_as_they_would_be_alone():
    done = fitted(sharing=[[1, 3], [0, 2]], max_iter=8, **FOUR)
    mean, variance = done.predictor().predict(X, NO_FEATURES, return_variance=True)
    total = 0.0
    for own in ([0, 2], [1, 3]):
        alone = fitted(max_iter=8, **of_four(own))
        expected_mean, expected = alone.predictor().predict(X, NO_FEATURES, return_variance=True)
        np.testing.assert_allclose(mean[:, own], expected_mean, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(variance[:, own], expected, rtol=1e-5, atol=1e-8)
        np.testing.assert_allclose(done.predictor().noise[own], alone.predictor().noise, rtol=1e-5)
        total += alone.lower_bound
    assert done.lower_bound == pytest.approx(total, rel=1e-6)


def test_limits_and_bounds_of_groups_are_those_of_the_outputs():
    done = fitted(sharing=[[0, 2], [1, 3]], max_iter=3, **FOUR)
    rows, predictor = FOUR["units"].rows(source_of(Y=FOUR["Y"], H=NO_FEATURES)), done.predictor()
    bounds = [
        done.bound_at(rows, o, np.append(group.hyperparameters, predictor.signal[o]))[0]
        for o, group in enumerate(predictor.by_output)
    ]
    assert sum(bounds) == pytest.approx(done.lower_bound, rel=1e-9)
    for o in range(4):
        alone = fitted(max_iter=0, **of_four([o]))
        np.testing.assert_allclose(done.limits("signal", o), alone.limits("signal", 0), rtol=1e-10)
