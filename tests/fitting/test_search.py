"""The decisions of a fit, one by one: which start comes next, given how the fits before it ended."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from skevgp.fitting.search import Rules
from skevgp.fitting.strategy import Attempt, Fit, Strategy, better, drawn, search
from skevgp.model.parameters import Parameter, ParameterTable
from skevgp.utils.monitor import Monitor

RULES = Rules(first_noise=1e-4, other_starts=((0.5, 1.0), (2.0, 100.0)), much_noise=1e3, stage=100)
PLACES = np.arange(4.0).reshape(1, 2, 2)


def table(noise_fixed=False, kernel_fixed=False, widest_signal=None):
    return ParameterTable(
        [
            Parameter("hyperparameters", np.array([2.0, 3.0]), "log", 1e-3, 1e3, fixed=kernel_fixed),
            Parameter("signal", np.ones(2), "log", 1e-3, 1e3, widest=widest_signal),
            Parameter("noise", np.full(2, 1e-4), "log", 1e-10, 1e2, fixed=noise_fixed),
            Parameter("inducing_points", PLACES),
        ]
    )


def strategy(**changes):
    own = {"table": table(), "max_iter": 1000, "n_restarts": 0, "scatter": np.ones(2), **changes}
    return Strategy(own.pop("rules", RULES), **own)


def place(values):
    return values | {"inducing_points": values["inducing_points"] + 10.0}


def ended(attempt, bound, noise=1e-4, n_iter=None, converged=True, signal=None):
    """How a fit from a start may have ended."""
    n_iter = attempt.until if n_iter is None else n_iter
    values = attempt.values | {"noise": np.full(2, noise)}
    if signal is not None:
        values["signal"] = np.array(signal)
    return Fit(values, bound, [0.0] * n_iter, converged, n_rows=attempt.n_rows)


def drive(strategy, *results):
    """The attempts that a strategy makes when fits end with these (bound, options); the best of these fits."""
    made, results = [], list(results)

    def minimise(attempt):
        made.append(attempt)
        bound, options = results.pop(0)
        return ended(attempt, bound, **options)

    best = search(SimpleNamespace(strategy=strategy, monitor=Monitor(), minimise=minimise))
    assert not results
    return made, best


GOOD, COLLAPSED, UNFINISHED = {}, {"noise": 0.95}, {"converged": False}


def test_a_good_fit_is_left_alone():
    made, best = drive(strategy(), (5.0, GOOD))
    assert [attempt.until for attempt in made] == [1000]
    np.testing.assert_allclose(made[0].values["hyperparameters"], [2.0, 3.0])
    assert best.bound == 5.0


def test_a_collapsed_fit_starts_again_elsewhere_until_one_learns():
    made, best = drive(strategy(), (5.0, COLLAPSED), (4.0, COLLAPSED), (9.0, GOOD))
    np.testing.assert_allclose(made[1].values["hyperparameters"], [1.0, 1.5])
    np.testing.assert_allclose(made[1].values["noise"], 1e-4)
    np.testing.assert_allclose(made[2].values["hyperparameters"], [4.0, 6.0])
    np.testing.assert_allclose(made[2].values["noise"], 1e-2)
    assert best.bound == 9.0


def test_one_output_that_collapsed_is_enough():
    own = strategy()
    fit = Fit({"noise": np.array([1e-4, 0.95])}, 5.0)
    assert own.collapsed(fit)
    assert not own.collapsed(replace(fit, values={"noise": np.array([1e-4, 0.85])}))


def test_when_nothing_learns_the_best_bound_is_kept():
    made, best = drive(strategy(), (5.0, COLLAPSED), (7.0, COLLAPSED), (6.0, COLLAPSED))
    assert len(made) == 3
    assert best.bound == 7.0


def test_a_fit_that_ended_at_a_limit_goes_on_where_that_is_wider():
    """One of two outputs is enough; a limit of the user's has none beyond."""
    at_limit, inside = {"signal": [1.0, 1e3], "n_iter": 50}, {"signal": [1.0, 900.0], "n_iter": 50}
    wide = table(widest_signal=1e5)
    made, best = drive(strategy(table=wide), (5.0, at_limit), (9.0, {"n_iter": 80}))
    assert best.bound == 9.0
    assert (made[1].after.bound, made[1].until) == (5.0, 1000)
    np.testing.assert_array_equal(made[1].values["signal"], [1.0, 1e3])
    for own in (strategy(table=wide, max_iter=50), strategy()):
        assert len(drive(own, (5.0, at_limit))[0]) == 1
    assert len(drive(strategy(table=wide), (5.0, inside))[0]) == 1


def test_a_fit_that_had_the_widest_limit_does_not_go_on_for_being_above_the_other():
    wide = table(widest_signal=1e5)
    warm = wide.values_at_start() | {"signal": np.array([2e3, 1.0])}
    own = strategy(table=wide, warm=warm)
    assert len(drive(own, (5.0, {"signal": [3e3, 1.0], "n_iter": 50}))[0]) == 1


def test_a_kernel_that_explains_less_than_noise_alone_starts_again_once_it_has_ended():
    below = strategy(alone=6.0)
    assert len(drive(below, (5.0, GOOD), (8.0, GOOD))[0]) == 2
    assert len(drive(below, (5.0, UNFINISHED))[0]) == 1


def test_what_stays_below_the_features_alone_starts_at_their_noise_at_last():
    noise = np.array([3.0, 7.0])
    own = strategy(alone=6.0, noise_alone=noise)
    made, best = drive(own, (5.0, GOOD), (4.0, GOOD), (3.0, GOOD), (6.5, GOOD))
    np.testing.assert_array_equal(made[3].values["noise"], noise)
    np.testing.assert_array_equal(made[3].values["hyperparameters"], made[0].values["hyperparameters"])
    assert (made[3].values["signal"] < 1e-3 * noise).all()
    assert best.bound == 6.5
    # So little signal is little for the rows whose noise is the least, too.
    made, _ = drive(replace(own, mean_precision=1e4), (5.0, GOOD), (4.0, GOOD), (3.0, GOOD), (6.5, GOOD))
    assert (made[3].values["signal"] < 1e-7 * noise).all()
    plain = strategy(alone=6.0, noise_alone=noise, rules=replace(RULES, last_start=False))
    assert len(drive(plain, (5.0, GOOD), (4.0, GOOD), (3.0, GOOD))[0]) == 3
    fixed = strategy(alone=6.0, noise_alone=noise, table=table(noise_fixed=True))
    made, _ = drive(fixed, (5.0, GOOD), (6.5, GOOD))
    assert (made[1].values["signal"] < 1e-3 * noise).all()
    # What has not ended may still rise, unless the noise is hidden.
    hidden = strategy(alone=6.0, noise_alone=noise, noise_hidden=True)
    assert len(drive(replace(hidden, noise_hidden=False), (5.0, UNFINISHED))[0]) == 1
    assert len(drive(hidden, (5.0, UNFINISHED), (6.5, GOOD))[0]) == 2
    # Where the kernel ends elsewhere it may be more, but not more than so much.
    unknown = replace(hidden, most_alone=8.0)
    assert len(drive(unknown, (7.0, GOOD), (6.5, GOOD))[0]) == 2
    assert len(drive(unknown, (8.0, GOOD))[0]) == 1
    assert len(drive(hidden, (7.0, GOOD))[0]) == 1
    # What is not below them has nothing to gain there.
    assert len(drive(own, (7.0, COLLAPSED), (6.5, COLLAPSED), (6.2, COLLAPSED))[0]) == 3


def test_the_last_start_comes_once_after_restarts():
    noise = np.array([3.0, 7.0])
    own = strategy(alone=6.0, noise_alone=noise, n_restarts=2, restart=lambda: table().values_at_start())
    below = [(bound, GOOD) for bound in (5.0, 4.0, 3.0)]
    made, best = drive(own, *below, *below, *below, (6.5, GOOD))
    assert [bool((attempt.values["noise"] == noise).all()) for attempt in made] == [False] * 9 + [True]
    assert best.bound == 6.5


def test_the_same_start_is_not_taken_twice():
    own = strategy(interpolates=True, rules=replace(RULES, other_starts=((1.0, RULES.much_noise), (2.0, 100.0))))
    made, _ = drive(own, (5.0, COLLAPSED), (6.0, COLLAPSED), (4.0, COLLAPSED))
    assert len({float(attempt.values["noise"][0]) for attempt in made}) == len(made) == 3


@pytest.mark.parametrize("why", ["noise is fixed", "no iterations"])
def test_other_starts_need_a_noise_that_moves(why):
    own = strategy(table=table(noise_fixed=True)) if why == "noise is fixed" else strategy(max_iter=0)
    assert len(drive(own, (5.0, COLLAPSED))[0]) == 1


def test_where_the_kernel_may_interpolate_a_high_noise_is_tried_too():
    made, best = drive(strategy(interpolates=True), (5.0, GOOD), (6.0, GOOD))
    np.testing.assert_allclose(made[1].values["noise"], 0.1)
    assert best.bound == 6.0
    # And points, as many as rows, stay.
    assert len(drive(strategy(interpolates=True, place=place), (5.0, GOOD), (4.0, GOOD))[0]) == 2


def test_points_are_placed_anew_and_the_better_of_both_fits_goes_on():
    made, best = drive(strategy(place=place), (5.0, UNFINISHED), (7.0, UNFINISHED), (6.0, UNFINISHED), (9.0, GOOD))
    assert [attempt.until for attempt in made] == [100, 200, 200, 1000]
    np.testing.assert_array_equal(made[1].values["inducing_points"], PLACES + 10.0)
    np.testing.assert_array_equal(made[2].values["inducing_points"], PLACES)
    np.testing.assert_array_equal(made[3].values["inducing_points"], PLACES + 10.0)
    assert made[1].after is made[2].after
    assert made[1].after.bound == 5.0
    assert made[3].after.bound == 7.0
    assert best.bound == 9.0


def test_bad_places_do_not_cost_the_bound():
    made, best = drive(strategy(place=place), (5.0, UNFINISHED), (1.0, UNFINISHED), (6.0, UNFINISHED), (9.0, GOOD))
    np.testing.assert_array_equal(made[3].values["inducing_points"], PLACES)
    assert best.bound == 9.0


def test_a_first_stage_that_has_ended_is_not_prolonged():
    made, best = drive(strategy(place=place), (5.0, GOOD), (4.0, GOOD))
    assert [attempt.until for attempt in made] == [100, 200]
    assert best.bound == 5.0


def test_stages_end_with_max_iter():
    made, _ = drive(strategy(place=place, max_iter=110), (5.0, UNFINISHED), (7.0, UNFINISHED), (6.0, UNFINISHED))
    assert [attempt.until for attempt in made] == [100, 110, 110]


@pytest.mark.parametrize(
    "changes", [{"max_iter": 100}, {"table": table(kernel_fixed=True)}, {"rules": replace(RULES, stage=None)}, {}]
)
def test_points_stay_where_there_is_no_second_stage(changes):
    own = strategy(place=None if changes == {} else place, **changes)
    assert len(drive(own, (5.0, UNFINISHED))[0]) == 1


def test_restarts_are_drawn_and_the_best_of_all_is_kept():
    first = table().values_at_start()
    drawn_values = iter([first | {"noise": np.full(2, 0.1)}, first | {"noise": np.full(2, 0.2)}])
    own = strategy(n_restarts=2, restart=lambda: next(drawn_values))
    made, best = drive(own, (5.0, GOOD), (8.0, GOOD), (6.0, GOOD))
    np.testing.assert_allclose(made[1].values["noise"], 0.1)
    np.testing.assert_allclose(made[2].values["noise"], 0.2)
    assert best.bound == 8.0


def test_a_restart_is_staged_on_its_own():
    own = strategy(n_restarts=1, place=place, restart=table().values_at_start)
    made, best = drive(own, (5.0, GOOD), (4.0, GOOD), (3.0, GOOD), (3.5, GOOD))
    assert [attempt.until for attempt in made] == [100, 200, 100, 200]
    # It goes on from the restart's first stage, though the fit before it was better.
    assert made[3].after.bound == 3.0
    assert best.bound == 5.0


def test_a_warm_start_whose_points_have_moved_is_not_placed_anew():
    warm = {"inducing_points": PLACES + 1.0, "noise": np.full(2, 0.3)}
    made, _ = drive(strategy(warm=warm, place=place), (5.0, UNFINISHED))
    np.testing.assert_array_equal(made[0].values["inducing_points"], PLACES + 1.0)
    np.testing.assert_allclose(made[0].values["noise"], 0.3)


@pytest.mark.parametrize("placed", [True, False])
def test_points_that_the_table_has_from_another_fit_count_as_moved(placed):
    own = strategy(warm={"inducing_points": PLACES}, placed=placed, place=place)
    assert (next(own.attempts()).until == own.max_iter) == placed


def test_a_warm_start_that_leads_nowhere_is_left_for_a_cold_one():
    warm = {"inducing_points": PLACES + 1.0, "noise": np.full(2, 0.3)}
    own = strategy(warm=warm, rules=replace(RULES, other_starts=()))
    made, best = drive(own, (5.0, COLLAPSED), (4.0, GOOD))
    np.testing.assert_allclose(made[1].values["noise"], 1e-4)
    assert best.bound == 5.0


def test_of_equal_fits_the_later_is_kept_and_any_is_better_than_none():
    first, second = Fit({}, 1.0), Fit({}, 1.0)
    assert better(first, second) is second
    assert better(None, Fit({}, -np.inf)).bound == -np.inf
    assert better(first, Fit({}, -np.inf)) is first


def test_drawn_values_stay_within_limits_and_leave_what_is_fixed():
    own, rng = table(kernel_fixed=True), np.random.RandomState(0)
    values = [drawn(own, RULES, rng) for _ in range(50)]
    noise = np.array([value["noise"] for value in values])
    assert noise.min() >= 1e-4 / 30.0 * (1 - 1e-9)
    assert noise.max() <= 1e-4 * 30.0 * (1 + 1e-9)
    assert noise.max() / noise.min() > 30.0
    np.testing.assert_allclose([value["hyperparameters"] for value in values], [[2.0, 3.0]] * 50)


class Told:
    """A task whose fits end as told; Ctrl-C after so many."""

    def __init__(self, strategy, bounds, stop_after=None):
        self.strategy, self.monitor, self.made = strategy, Monitor(), []
        self._bounds, self._stop_after = iter(bounds), stop_after

    def minimise(self, attempt):
        self.made.append(attempt)
        if len(self.made) == self._stop_after:
            self.monitor.stop()
        return ended(attempt, next(self._bounds))


def test_search_does_what_the_strategy_says_and_keeps_the_best():
    own = strategy(n_restarts=2, restart=table().values_at_start)
    task = Told(own, [1.0, 3.0, 2.0])
    assert search(task).bound == 3.0
    assert len(task.made) == 3
    assert all(isinstance(attempt, Attempt) for attempt in task.made)


def test_ctrl_c_ends_the_search_with_the_best_so_far():
    own = strategy(n_restarts=9, restart=table().values_at_start)
    task = Told(own, [4.0, 3.0, 9.0], stop_after=2)
    assert search(task).bound == 4.0
    assert len(task.made) == 2


def test_ctrl_c_while_points_are_placed_keeps_the_fit():
    def interrupted(values):
        raise KeyboardInterrupt

    task = Told(strategy(place=interrupted), [4.0])
    assert search(task).bound == 4.0
    assert task.monitor.stopped


def test_ctrl_c_before_any_fit_is_an_interrupt():
    class Interrupted(Told):
        def minimise(self, attempt):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search(Interrupted(strategy(), []))


# --- samples of the rows ----------------------------------------------------------------------------------------------


def test_a_fit_climbs_from_sample_to_sample_to_all_rows():
    own = strategy(samples=(1000, 4000), place=place)
    made, best = drive(
        own, (5.0, UNFINISHED), (4.0, UNFINISHED), (6.0, GOOD), (4.5, GOOD), (3.0, UNFINISHED), (2.0, GOOD)
    )
    # Two noises, points placed anew and the old ones; then the better on more rows, and on all.
    assert [attempt.n_rows for attempt in made] == [1000, 1000, 1000, 1000, 4000, None]
    assert [attempt.until for attempt in made] == [100, 100, 200, 200, 1000, 1000]
    np.testing.assert_allclose(made[1].values["noise"], 0.1)
    assert made[0].cold
    assert not any(attempt.cold for attempt in made[1:])
    for later in made[4:]:
        np.testing.assert_allclose(later.values["inducing_points"], PLACES + 10.0)
        assert later.after is None
    # A fit to more rows is the better one, whatever the bounds of samples.
    assert best.bound == 2.0
    assert best.n_rows is None


def test_what_collapsed_on_a_sample_starts_anew_on_more_rows():
    rules = replace(RULES, other_starts=())
    made, best = drive(
        strategy(rules=rules, samples=(1000, 4000)),
        *((5.0, COLLAPSED), (5.0, COLLAPSED)),
        *((5.0, COLLAPSED), (5.0, COLLAPSED)),
        (2.0, GOOD),
    )
    assert [attempt.n_rows for attempt in made] == [1000, 1000, 4000, 4000, None]
    for cold in made[::2]:
        np.testing.assert_allclose(cold.values["hyperparameters"], [2.0, 3.0])
        np.testing.assert_allclose(cold.values["noise"], 1e-4)
        assert cold.cold
    assert best.bound == 2.0


def test_no_iterations_need_no_sample():
    made, _ = drive(strategy(samples=(1000,), max_iter=0), (5.0, GOOD))
    assert [attempt.n_rows for attempt in made] == [None]


def test_few_iterations_are_the_most_on_a_sample_too():
    made, _ = drive(strategy(samples=(1000,), max_iter=7), (5.0, UNFINISHED), (4.0, UNFINISHED), (2.0, UNFINISHED))
    assert [attempt.until for attempt in made] == [7, 7, 7]


def test_after_ctrl_c_on_a_sample_its_best_fit_counts():
    own, made = strategy(samples=(1000,)), []

    def minimise(attempt):
        made.append(attempt)
        if len(made) == 2:
            monitor.stop()
        return ended(attempt, float(len(made)))

    monitor = Monitor()
    best = search(SimpleNamespace(strategy=own, monitor=monitor, minimise=minimise))
    assert len(made) == 2
    assert best.n_rows == 1000
    assert best.bound == 2.0


def test_what_collapses_on_all_rows_only_starts_anew_there():
    rules = replace(RULES, other_starts=(), much_noise=None)
    made, best = drive(strategy(rules=rules, samples=(1000,)), (5.0, GOOD), (2.0, COLLAPSED), (3.0, GOOD))
    assert [attempt.n_rows for attempt in made] == [1000, None, None]
    np.testing.assert_allclose(made[2].values["noise"], 1e-4)
    assert best.bound == 3.0
