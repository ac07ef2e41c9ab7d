"""A sparse model to be fitted, and what is kept of it."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from skevgp.data.threads import BlockMap
from skevgp.fitting.calibration import CrossValidation
from skevgp.fitting.inducing import Placement
from skevgp.fitting.learned import Learned
from skevgp.fitting.plan import plan
from skevgp.fitting.sparse import SparseTask, grown
from skevgp.fitting.strategy import Attempt, Fit, search
from skevgp.model.bounds import bounds_alone
from skevgp.solvers import LBFGS, Adam
from skevgp.utils.monitor import Monitor

from .cases import NO_FEATURES, H, N, O, X, Y, request, source_of, units_of


def task_of(monitor=None, seed=0, **changes):
    """The one task of a request whose outputs share everything."""
    monitor = Monitor() if monitor is None else monitor
    (task,) = plan(request(**changes), np.random.RandomState(seed), monitor, BlockMap())
    return task


def started(task, **options):
    """A fit that ended where it started."""
    values = task.table.values_at_start()
    bound = task.model.bound(values, task.model.statistics(values, task.blocks))
    return Fit(values, **{"bound": bound, **options})


# --- a task --------------------------------------------------------------------------------------------------------


def test_a_task_knows_its_points_and_blocks():
    task = task_of(n_inducing=7)
    assert task.n_inducing == 7
    assert task.blocks is task.blocks
    assert task.blocks.linear.n_rows == len(X)


def test_chance_is_the_seeds():
    task = task_of()
    first, again = (replace(task).rng.rand() for _ in range(2))
    assert first == again != replace(task, seed=task.seed + 1).rng.rand()
    assert task.rng is task.rng


def test_the_strategy_is_the_solvers_and_the_estimators():
    solver = LBFGS(n_restarts=3)
    own = task_of(solver=solver, max_iter=77).strategy
    assert own.rules is LBFGS.rules
    assert (own.max_iter, own.n_restarts) == (77, 3)
    assert own.warm is None
    np.testing.assert_allclose(own.scatter, units_of().rows(source_of()).scatter())


def test_the_strategy_knows_what_the_features_alone_explain():
    """And a fit that ended below that is tried from elsewhere."""
    task = task_of()
    own = task.strategy
    r = task.rows.some(np.arange(len(task.rows))).targets
    alone = bounds_alone(task.blocks.linear, task.model.prior, np.mean(r**2, axis=0), np.zeros(r.shape[1])).sum()
    assert task.alone == pytest.approx(alone, rel=1e-10)
    # The signal can be 1e-8 of the unit.
    assert own.alone == pytest.approx(alone, rel=1e-6)
    np.testing.assert_allclose(own.noise_alone, np.mean(r**2, axis=0), rtol=1e-6)
    values = task.table.values_at_start()
    assert own.collapsed(Fit(values, own.alone - 1.0))
    assert not own.collapsed(Fit(values, own.alone + 1.0))


def test_where_features_may_hide_the_noise_it_is_known_which_suits_them(monkeypatch):
    """With the signal at its lower limit, 1e-8 of the unit."""
    monkeypatch.setattr("skevgp.fitting.sparse.may_hide_noise", lambda prior, n_rows: True)
    task = task_of()
    own = task.strategy
    trace = np.full(len(own.noise_alone), 1e-8 * len(task.rows))
    alone = bounds_alone(task.blocks.linear, task.model.prior, own.noise_alone, trace).sum()
    assert own.alone == pytest.approx(alone, rel=1e-9)
    assert own.alone >= task.alone - 1e-6 * abs(task.alone)


@pytest.mark.parametrize(("n_inducing", "interpolates"), [(N - 1, False), (N, True), (2 * N, True)])
def test_the_kernel_may_interpolate_where_points_are_as_many_as_rows(n_inducing, interpolates):
    assert task_of(n_inducing=n_inducing).strategy.interpolates == interpolates


@pytest.mark.parametrize(
    ("placement", "moves"),
    [("auto", True), ("k-means", False), ("greedy", False), (X[:5], False)],
    ids=["auto", "k-means", "greedy", "the user's"],
)
def test_points_are_placed_anew_only_if_nobody_said_where(placement, moves):
    own = task_of(placement=Placement(placement, 5)).strategy
    assert (own.place is not None) == moves


def test_places_follow_the_kernel_that_was_learned():
    """Where one column does not matter, the greedy search spreads points over the other."""
    task = task_of(placement=Placement("auto", 8))
    values = task.table.values_at_start()
    placed = task.strategy.place(values | {"hyperparameters": np.array([0.5, 1e3])})
    assert placed["inducing_points"].shape == values["inducing_points"].shape
    assert {tuple(point) for point in placed["inducing_points"][0]} <= {tuple(row) for row in X}
    assert np.abs(np.diff(np.sort(placed["inducing_points"][0, :, 0]))).min() > 0.1
    assert placed["noise"] is values["noise"]


def test_each_group_has_the_placed_points():
    task = task_of(placement=Placement("auto", 8), sharing="kernel")
    placed = task.strategy.place(task.table.values_at_start())["inducing_points"]
    assert placed.shape == (2, 8, 2)
    np.testing.assert_array_equal(placed[0], placed[1])


def test_restarts_start_elsewhere_in_all():
    task = task_of()
    first, drawn = task.table.values_at_start(), task.strategy.restart()
    for name in ("hyperparameters", "noise", "inducing_points"):
        assert (drawn[name] != first[name]).any(), name
    lower, upper = task.table.limits()
    flat = task.table.started_at(drawn).start()
    assert ((lower <= flat) & (flat <= upper)).all()


def test_an_attempt_is_the_solvers():
    seen = []

    class Told(LBFGS):
        def run(self, task, attempt):
            seen.append((task, attempt))
            return started(task)

    task = task_of(solver=Told())
    attempt = Attempt(task.table.values_at_start(), 5)
    assert task.minimise(attempt).bound == started(task).bound
    assert seen == [(task, attempt)]


# --- what is kept --------------------------------------------------------------------------------------------------


def test_what_is_kept_is_where_the_fit_ended():
    task = task_of()
    fit = started(task, loss_curve=[3.0, 2.0])
    learned = Learned.of(task, fit)
    assert learned.model is task.model
    assert learned.values is fit.values
    assert learned.loss_curve == [3.0, 2.0]
    assert learned.bound == fit.bound
    assert learned.message == ""
    expected = task.model.at_optimum(fit.values, learned.statistics, blocks=task.blocks)
    for found, value in zip(learned.predictor.predict(X, H, True), expected.predict(X, H, True), strict=True):
        np.testing.assert_array_equal(found, value)


def test_the_bound_is_that_of_the_fit_unless_it_has_none():
    """That was summed row by row, and has more digits."""
    task = task_of()
    fit = started(task)
    assert Learned.of(task, replace(fit, bound=fit.bound + 1e-3)).bound == fit.bound + 1e-3
    assert Learned.of(task, replace(fit, bound=-np.inf)).bound == pytest.approx(fit.bound)


def test_a_solver_that_has_moved_q_says_where_it_is():
    task = task_of()
    fit = started(task)
    size = 8 + 2
    own = task.model.predictor(
        fit.values, list(task.model.whitenings(fit.values)), [np.zeros(size)] * O, [np.eye(size)] * O
    )
    learned = Learned.of(task, replace(fit, predictor=own))
    assert learned.predictor is own
    # Rows that come later put it at its optimum.
    moved = learned.updated(task.rows).predictor
    assert np.abs(moved.groups[0].mean).max() > 0.0 == np.abs(own.groups[0].mean).max()


def test_sentences_for_the_user_are_joined():
    task = task_of(H=NO_FEATURES, Y=Y + [0.0, 1e9])
    message = Learned.of(task, replace(started(task), message="It ended.")).message
    assert message.startswith("It ended. y is more than")


@pytest.mark.parametrize("stopped", [True, False])
def test_noise_that_explains_everything_is_told_unless_ctrl_c_did_it(stopped):
    monitor = Monitor()
    task = task_of(monitor)
    fit = started(task)
    fit = replace(fit, values=fit.values | {"noise": task.rows.scatter()})
    if stopped:
        monitor.stop()
    assert Learned.of(task, fit).message.startswith("The noise explains everything") != stopped


# --- rows that come later ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", ["full", "diagonal"])
@pytest.mark.parametrize("sharing", ["all", "kernel"])
def test_new_rows_are_added_exactly(sharing, family):
    """The sums of all rows, and q at its optimum for them."""
    task = task_of(sharing=sharing, family=family)
    values, units = task.table.values_at_start(), units_of()
    parts = [units.rows(source_of(X[part], H[part], Y[part])) for part in (slice(0, 25), slice(25, None))]
    first = replace(task, rows=parts[0])
    both = Learned.of(first, started(first)).updated(parts[1])
    whole = Learned.of(task, started(task))
    assert both.bound == pytest.approx(whole.bound, rel=1e-8)
    for own, expected in zip(both.predictor.groups, whole.predictor.groups, strict=True):
        np.testing.assert_allclose(own.mean, expected.mean, rtol=1e-6, atol=1e-8)
    assert both.values.keys() == values.keys()


def test_earlier_rows_may_count_less():
    task = task_of()
    learned = Learned.of(task, started(task))
    faded = learned.updated(task.rows, 0.5)
    assert faded.statistics[0].n_rows == 1.5 * len(X)
    np.testing.assert_allclose(faded.statistics[0].VV, 1.5 * learned.statistics[0].VV, rtol=1e-12)


# --- calibration ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("why", ["nobody asked", "Ctrl-C", "the noise is fixed"])
def test_the_noise_is_calibrated_only_if_it_may(why):
    monitor, kernel = Monitor(), ConstantKernel() * RBF([1.0, 1.0])
    if why == "the noise is fixed":
        kernel += WhiteKernel(0.3, "fixed")
    task = task_of(monitor, kernel=kernel, noise_cv=None if why == "nobody asked" else CrossValidation(5))
    fit = started(task)
    if why == "Ctrl-C":
        monitor.stop()
    np.testing.assert_array_equal(Learned.of(task, fit).values["noise"], fit.values["noise"])


def test_calibrated_are_signal_and_noise_and_q_is_at_its_optimum_for_them():
    task = task_of(noise_cv=CrossValidation(5))
    fit = started(task)
    learned = Learned.of(task, fit)
    plain = Learned.of(replace(task, noise_cv=None), fit)
    for name in ("noise", "signal"):
        assert (learned.values[name] != fit.values[name]).all()
    for name in ("hyperparameters", "inducing_points"):
        np.testing.assert_array_equal(learned.values[name], fit.values[name])
    bound = task.model.bound(learned.values, learned.statistics, task.blocks)
    predictor = task.model.at_optimum(learned.values, learned.statistics, blocks=task.blocks)
    assert learned.bound == bound
    np.testing.assert_array_equal(learned.predictor.groups[0].mean, predictor.groups[0].mean)
    assert learned.loss_curve == plain.loss_curve


# --- more inducing points ------------------------------------------------------------------------------------------


def growing(most=1000, first=8, **changes):
    return task_of(placement=Placement("k-means", first, most), **changes)


@pytest.mark.parametrize("sharing", ["all", "kernel"])
def test_half_as_many_points_again_come_after_those_of_a_fit(sharing):
    task = growing(sharing=sharing)
    values = task.table.values_at_start()
    values["inducing_points"] = values["inducing_points"] + 0.1
    more = task.with_more(values)
    start = more.table["inducing_points"].start
    assert start.shape == (1 if sharing == "all" else 2, 12, 2)
    np.testing.assert_array_equal(start[:, :8], values["inducing_points"])
    assert np.isin(start[:, 8:], X).all()
    assert more.n_inducing == 12
    assert more.table["inducing_points"].free.all()
    assert not more.model.complete


def test_no_more_points_than_allowed_nor_without_leave():
    assert growing(most=10).with_more(growing().table.values_at_start()).n_inducing == 10
    assert growing(most=8).with_more(growing().table.values_at_start()) is None
    assert task_of(n_inducing=8).with_more(growing().table.values_at_start()) is None


@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_points_as_many_as_rows_become_the_rows(family):
    task = growing(first=45, family=family)
    more = task.with_more(task.table.values_at_start())
    np.testing.assert_array_equal(more.table["inducing_points"].start, X[np.newaxis])
    assert more.model.complete == (family == "full")
    assert more.table["inducing_points"].free.any() == (family == "diagonal")
    assert more.with_more(more.table.values_at_start()) is None


def test_the_exact_model_of_a_sample_knows_what_other_values_miss():
    task = growing()
    unhindered = task.unhindered()
    by_chance = -0.5 * (2 + 2 * O) / (N * O)
    assert unhindered.missed_by(unhindered.fit.values) == pytest.approx(by_chance, rel=1e-6)
    assert unhindered.missed_by(task.table.values_at_start()) > 0.0
    assert unhindered.missed_by(task.table.values_at_start() | {"signal": np.full(2, np.nan)}) == np.inf


def test_a_kernel_that_is_fixed_or_not_to_be_optimised_is_not_fitted_exactly():
    assert growing(max_iter=0).unhindered() is None
    assert growing(kernel=ConstantKernel() * RBF([1.0, 1.0], "fixed")).unhindered() is None


def test_points_are_added_until_they_gain_nothing():
    """A fit with half as many again has a bound that is higher by less than 0.01 nats per row and output."""
    task, fit = grown(growing(max_iter=100))
    assert fit.values["inducing_points"].shape == (1, task.n_inducing, 2)
    assert 8 < task.n_inducing < N
    more = replace(task.with_more(fit.values), max_iter=100)
    values = fit.values | {"inducing_points": more.table["inducing_points"].start}
    assert fit.bound <= more.minimise(Attempt(values, 100)).bound < fit.bound + 0.01 * N * O
    fewer = LBFGS().run(growing(max_iter=100), Attempt(growing().table.values_at_start(), 100))
    assert fit.bound > fewer.bound + 0.01 * N * O


def test_few_points_do_not_hide_what_there_is_to_learn(monkeypatch):
    """Of a fast wave, ten and fifteen points show nothing: to them it is noise."""
    rng = np.random.RandomState(0)
    x = np.sort(rng.uniform(0.0, 6.0, (200, 1)), axis=0)
    wave = {"X": x, "H": np.empty((200, 0)), "Y": np.sin(15.0 * x) + 0.1 * rng.randn(200, 1)}
    task = growing(**wave, units=units_of(**wave), first=10, max_iter=200)
    found, fit = grown(task)
    assert found.n_inducing > 30
    assert fit.values["noise"] < 0.1 * task.rows.scatter()
    monkeypatch.setattr(SparseTask, "unhindered", lambda self: None)
    found, fit = grown(task)
    assert found.n_inducing == 10
    assert fit.values["noise"] > 0.9 * task.rows.scatter()


def test_few_iterations_do_not_ask_for_points():
    """What further iterations gain is not credited to points; those on the way to their number do not count."""
    (few, fit), (many, _) = (grown(growing(max_iter=max_iter)) for max_iter in (3, 200))
    assert few.n_inducing == many.n_inducing < N
    assert fit.n_iter <= 3


def test_a_fit_that_was_stopped_gets_no_more_points():
    def stop(*told):
        raise StopIteration

    task = growing(monitor=Monitor(stop))
    same, fit = grown(task)
    assert same.n_inducing == 8
    assert np.isfinite(fit.bound)


def test_without_iterations_points_are_added_under_the_kernel_as_it_starts():
    task, fit = grown(growing(most=30, max_iter=0))
    assert 8 < task.n_inducing <= 30
    first = growing().table.values_at_start()
    for name in ("hyperparameters", "signal", "noise"):
        np.testing.assert_array_equal(fit.values[name], first[name])
    np.testing.assert_array_equal(fit.values["inducing_points"][:, :8], first["inducing_points"])


# --- samples of the rows --------------------------------------------------------------------------------------------


def sampled(**changes):
    """A task whose fit begins with 15, then 30 of its rows."""
    rules = replace(LBFGS.rules, sample=(15, 1), growth=2, stage=5)
    solver = type("LBFGS", (LBFGS,), {"rules": rules})()
    return task_of(n_inducing=5, solver=solver, **changes)


def test_the_smaller_sample_is_part_of_the_larger_one():
    task = sampled()
    assert task.samples == (15, 30)
    assert task.strategy.samples == task.samples
    for size in task.samples:
        assert task.blocks_of(size).linear.n_rows == size
    assert task.blocks_of(None) is task.blocks
    fewer, again, more = (task.blocks_of(size).linear for size in (15, 15, 30))
    np.testing.assert_array_equal(fewer.RR, again.RR)
    assert (more.RR >= fewer.RR).all()
    assert (task.blocks.linear.RR >= more.RR).all()


def test_points_that_are_all_rows_are_not_fitted_to_a_sample():
    assert task_of(n_inducing=len(X), solver=sampled().solver).samples == ()
    assert task_of(solver=Adam(), max_iter=1).samples == ()


def test_a_fit_that_begins_with_samples_ends_with_all_rows():
    task = sampled(max_iter=200)
    plain = replace(task, solver=type("LBFGS", (LBFGS,), {"rules": replace(LBFGS.rules, sample=None)})())
    fits = [Learned.of(own, search(own)) for own in (task, plain)]
    assert fits[0].bound > fits[1].bound - 0.02 * (fits[1].bound - task.alone)
    at = task.model.statistics(fits[0].values, task.blocks)
    assert fits[0].bound == pytest.approx(task.model.bound(fits[0].values, at), rel=1e-6)
    assert fits[0].loss_curve[-1] == pytest.approx(-fits[0].bound, rel=1e-9)


def test_a_fit_that_ctrl_c_ended_on_a_sample_has_the_bound_of_all_rows():
    seen = []

    def interrupt(iteration, loss, outputs):
        seen.append(iteration)
        if len(seen) == 4:
            raise KeyboardInterrupt

    task = sampled(monitor=Monitor(interrupt))
    fit = search(task)
    assert fit.n_rows == 15
    learned = Learned.of(task, fit)
    at = task.model.statistics(fit.values, task.blocks)
    assert learned.bound == pytest.approx(task.model.bound(fit.values, at))
