"""The decisions of a search, one by one: which start comes next, given how the fits before it ended."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from skevgp.fitting.rules import Rules
from skevgp.fitting.runs import FeaturesAlone, Fit, Start, better
from skevgp.fitting.search import search
from skevgp.model.parameters import Parameter, ParameterTable
from skevgp.utils.monitor import Monitor

OWN = Rules(first_noise=1e-4, other_starts=((0.5, 1.0), (2.0, 100.0)), much_noise=1e3, stage=100)
PLACES = np.arange(4.0).reshape(1, 2, 2)


def table(noise_fixed=False, kernel_fixed=False, widest_signal=None, n_columns=2):
    return ParameterTable(
        [
            Parameter("hyperparameters", np.arange(2.0, 2.0 + n_columns), "log", 1e-3, 1e9, fixed=kernel_fixed),
            Parameter("signal", np.ones(2), "log", 1e-3, 1e3, widest=widest_signal),
            Parameter("noise", np.full(2, 1e-4), "log", 1e-10, 1e2, fixed=noise_fixed),
            Parameter("inducing_points", PLACES),
        ]
    )


def model(**changes):
    """All that a search asks of a model but the fits."""
    own = {
        "rules": OWN,
        "table": table(),
        "max_iter": 1000,
        "n_restarts": 0,
        "restart": table().values_at_start,
        "scatter": np.ones(2),
        "mean_precision": 1.0,
        "alone": FeaturesAlone(-np.inf, np.ones(2)),
        "interpolates": False,
        "samples": (),
        "keeps_metric": False,
        "shows_signal": lambda fit: True,
        "lengthscale_mask": np.array([True, False]),
        "place": None,
        "warm": None,
        "placed": False,
        "monitor": Monitor(),
        "hyper_prior": None,
        "log_hyper_prior": lambda values: 0.0,
        "by_forward_selection": lambda: None,
    }
    return SimpleNamespace(**own | changes)


def place(values):
    return values | {"inducing_points": values["inducing_points"] + 10.0}


def drive(model, *results, stop_after=None):
    """The starts that a search takes when fits end with these (bound, options), and the best; Ctrl-C after so many."""
    made, results = [], list(results)

    def minimise(start):
        made.append(start)
        if len(made) == stop_after:
            model.monitor.stop()
        bound, options = results.pop(0)
        values = start.values | {"noise": np.full(2, options.get("noise", 1e-4))}
        values["hyperparameters"] = options.get("stretch", 1.0) * values["hyperparameters"]
        if "signal" in options:
            values["signal"] = np.array(options["signal"])
        curve = [0.0] * options.get("n_iter", start.until)
        seen = {"metric": options.get("metric"), "n_rows": start.n_rows}
        return Fit(values, bound, curve, options.get("converged", True), **seen)

    # Where a bound alone is asked for, it is recorded as a fit without iterations.
    model.minimise = minimise
    model.bound_at = lambda values, n_rows=None: minimise(Start(values, 0, n_rows=n_rows)).bound
    best = search(model)
    assert not results
    return made, best


GOOD, COLLAPSED, UNFINISHED = {}, {"noise": 0.95}, {"converged": False}


# --- other starts -----------------------------------------------------------------------------------------------------


def test_good_fit_is_left_alone():
    made, best = drive(model(), (5.0, GOOD))
    assert [start.until for start in made] == [1000]
    np.testing.assert_allclose(made[0].values["hyperparameters"], [2.0, 3.0])
    assert best.bound == 5.0


def test_collapsed_fit_starts_again_elsewhere_until_one_learns():
    made, best = drive(model(), (5.0, COLLAPSED), (4.0, COLLAPSED), (9.0, GOOD))
    np.testing.assert_allclose([start.values["hyperparameters"] for start in made], [[2.0, 3.0], [1.0, 1.5], [4.0, 6]])
    np.testing.assert_allclose([start.values["noise"] for start in made], [[1e-4] * 2, [1e-4] * 2, [1e-2] * 2])
    assert best.bound == 9.0
    # When nothing learns the best bound is kept.
    assert drive(model(), (5.0, COLLAPSED), (7.0, COLLAPSED), (6.0, COLLAPSED))[1].bound == 7.0


@pytest.mark.parametrize(
    "changes", [{"table": table(noise_fixed=True)}, {"max_iter": 0}], ids=["fixed", "no iterations"]
)
def test_other_starts_need_a_noise_that_moves(changes):
    assert len(drive(model(**changes), (5.0, COLLAPSED))[0]) == 1


def test_fit_that_ended_at_a_limit_goes_on_where_that_is_wider():
    """One of two outputs is enough; a limit of the user's has none beyond."""
    at_limit, inside = {"signal": [1.0, 1e3], "n_iter": 50}, {"signal": [1.0, 900.0], "n_iter": 50}
    wide = table(widest_signal=1e5)
    made, best = drive(model(table=wide), (5.0, at_limit), (9.0, {"n_iter": 80}))
    assert best.bound == 9.0
    assert (made[1].after.bound, made[1].until) == (5.0, 1000)
    np.testing.assert_array_equal(made[1].values["signal"], [1.0, 1e3])
    for own in (model(table=wide, max_iter=50), model()):
        assert len(drive(own, (5.0, at_limit))[0]) == 1
    assert len(drive(model(table=wide), (5.0, inside))[0]) == 1
    # Nor does one that began beyond the first limit.
    warm = wide.values_at_start() | {"signal": np.array([2e3, 1.0])}
    assert len(drive(model(table=wide, warm=warm), (5.0, {"signal": [3e3, 1.0], "n_iter": 50}))[0]) == 1


# --- fits below the features alone ------------------------------------------------------------------------------------


def test_kernel_that_explains_less_than_noise_alone_starts_again_once_it_has_ended():
    below = {"alone": FeaturesAlone(6.0, np.ones(2))}
    assert len(drive(model(**below), (5.0, GOOD), (8.0, GOOD))[0]) == 2
    assert len(drive(model(**below), (5.0, UNFINISHED))[0]) == 1


# --- inducing points that are placed again ----------------------------------------------------------------------------


@pytest.mark.parametrize(("bounds", "kept"), [((5.0, 7.0, 6.0, 9.0), 10.0), ((5.0, 1.0, 6.0, 9.0), 0.0)])
def test_points_are_placed_again_and_the_better_of_both_fits_goes_on(bounds, kept):
    made, best = drive(model(place=place), *((bound, UNFINISHED) for bound in bounds[:3]), (bounds[3], GOOD))
    assert [start.until for start in made] == [100, 200, 200, 1000]
    for start, shift in zip(made, (0.0, 10.0, 0.0, kept), strict=True):
        np.testing.assert_array_equal(start.values["inducing_points"], PLACES + shift)
    assert made[1].after is made[2].after
    assert (made[1].after.bound, made[3].after.bound, best.bound) == (5.0, max(bounds[1:3]), 9.0)


# --- restarts and fits from before ------------------------------------------------------------------------------------


def test_restarts_are_drawn_and_the_best_of_all_is_kept():
    first = table().values_at_start()
    drawn_values = iter([first | {"noise": np.full(2, 0.1)}, first | {"noise": np.full(2, 0.2)}])
    own = model(n_restarts=2, restart=lambda: next(drawn_values))
    made, best = drive(own, (5.0, GOOD), (8.0, GOOD), (6.0, GOOD))
    np.testing.assert_allclose([start.values["noise"] for start in made], [[1e-4] * 2, [0.1] * 2, [0.2] * 2])
    assert best.bound == 8.0


def test_later_of_equal_fits_is_kept():
    first, second = Fit({}, 1.0), Fit({}, 1.0)
    assert better(first, second) is second
    assert better(None, Fit({}, -np.inf)).bound == -np.inf
    assert better(first, Fit({}, -np.inf)) is first


# --- interruption -----------------------------------------------------------------------------------------------------


def test_ctrl_c_ends_the_search_with_the_best_so_far():
    made, best = drive(model(n_restarts=9), (4.0, GOOD), (3.0, GOOD), stop_after=2)
    assert (len(made), best.bound) == (2, 4.0)
    made, best = drive(model(samples=(1000,)), (1.0, GOOD), (2.0, GOOD), stop_after=2)
    assert (best.n_rows, best.bound) == (1000, 2.0)


def test_ctrl_c_before_any_fit_is_an_interrupt():
    def interrupted(start):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search(SimpleNamespace(**vars(model()) | {"minimise": interrupted}))


def test_what_collapsed_on_a_sample_starts_again_on_more_rows():
    own = model(rules=replace(OWN, other_starts=()), samples=(1000, 4000))
    made, best = drive(own, *[(5.0, COLLAPSED)] * 4, (2.0, GOOD))
    assert [start.n_rows for start in made] == [1000, 1000, 4000, 4000, None]
    for cold in made[::2]:
        np.testing.assert_allclose(cold.values["hyperparameters"], [2.0, 3.0])
        np.testing.assert_allclose(cold.values["noise"], 1e-4)
        assert cold.cold
    assert best.bound == 2.0


# --- samples of the rows ----------------------------------------------------------------------------------------------


def test_sample_without_a_signal_is_left():
    own = model(rules=replace(OWN, much_noise=None), samples=(1000, 4000), shows_signal=lambda fit: fit.n_rows != 1000)
    made, best = drive(own, (5.0, {"stretch": 0.1}), (4.0, GOOD), (3.0, GOOD))
    assert [(start.n_rows, start.cold) for start in made] == [(1000, True), (4000, True), (None, False)]
    np.testing.assert_array_equal(made[1].values["hyperparameters"], made[0].values["hyperparameters"])
    assert best.bound == 3.0


def test_fit_climbs_from_sample_to_sample_to_all_rows():
    each = [(5.0, UNFINISHED), (4.0, UNFINISHED), (6.0, GOOD), (4.5, GOOD), (3.0, UNFINISHED), (2.0, GOOD)]
    made, best = drive(model(samples=(1000, 4000), place=place), *each)
    # Two noises, points placed again and the old ones; then the better on more rows, and on all.
    assert [start.n_rows for start in made] == [1000, 1000, 1000, 1000, 4000, None]
    assert [start.until for start in made] == [100, 100, 200, 200, 1000, 1000]
    np.testing.assert_allclose(made[1].values["noise"], 0.1)
    assert [start.cold for start in made] == [True] + 5 * [False]
    for later in made[4:]:
        np.testing.assert_allclose(later.values["inducing_points"], PLACES + 10.0)
        assert later.after is None
    # A fit to more rows is the better one, whatever the bounds of samples.
    assert (best.bound, best.n_rows) == (2.0, None)


@pytest.mark.parametrize("agree", [True, False])
def test_fit_to_more_rows_moves_along_the_curvature_of_a_sample_that_agrees(agree):
    own = model(rules=replace(OWN, much_noise=None), samples=(1000, 4000), keeps_metric=agree)
    made, _ = drive(own, (5.0, {"metric": "of 1000"}), (4.0, {"metric": "of 4000"}), (3.0, GOOD))
    assert [start.metric for start in made] == ([None, "of 1000", "of 4000"] if agree else 3 * [None])


def test_columns_that_more_rows_show_to_matter_get_their_first_length_scale():
    three = {"table": table(n_columns=3), "lengthscale_mask": np.array([True, True, False])}
    own, far = model(rules=replace(OWN, much_noise=None), samples=(1000, 4000), **three), {"stretch": 1e3}
    # A fit to the sample. Then the bound where it ended, and with each of two columns shorter: only the second is worth
    # it. The third hyperparameter is not a length scale. On all rows, neither is.
    tries = [(7.0, GOOD), (7.5, GOOD), (9.0, GOOD)]
    made, best = drive(own, (5.0, far), *tries, (4.0, GOOD), (3.0, GOOD), (3.5, GOOD), (2.0, GOOD))
    assert [start.until for start in made] == [200, 0, 0, 0, 1000, 0, 0, 1000]
    assert [start.n_rows for start in made] == [1000, 4000, 4000, 4000, 4000, None, None, None]
    lengths = [start.values["hyperparameters"] for start in made]
    long, short = [2e3, 3e3, 4e3], [2e3, 3.0, 4e3]
    np.testing.assert_allclose(lengths[1:5], [long, [2.0, 3e3, 4e3], short, short])
    np.testing.assert_allclose(lengths[5:], [short, [2.0, 3.0, 4e3], short])
    np.testing.assert_allclose(best.values["hyperparameters"], short)


@pytest.mark.parametrize(("bound", "starts"), [(3.0, 4), (2.0, 3)])
def test_fit_that_ended_almost_without_noise_is_tried_with_more(bound, starts):
    own = model(rules=replace(OWN, much_noise=None), samples=(1000,))
    quiet = {"noise": 1e-6, "n_iter": 50}
    ends = [(5.0, GOOD), (2.0, quiet), (bound, GOOD), (4.0, GOOD)][:starts]
    made, best = drive(own, *ends)
    np.testing.assert_allclose(made[2].values["noise"], 1e-3)
    assert [start.until for start in made] == [200, 1000, 0, 1000][:starts]
    assert best.bound == (4.0 if starts == 4 else 2.0)


@pytest.mark.parametrize(("noise", "bounds", "kept"), [(0.3, (2.0, 3.0), 1), (0.3, (2.0, 1.0), 0), (0.2, (2.0,), 0)])
def test_shorter_length_scales_are_tried_if_much_noise_is_left(noise, bounds, kept):
    own = model(rules=replace(OWN, much_noise=None, short=(0.5, 0.25)))
    made, best = drive(own, *((bound, {"noise": noise}) for bound in bounds))
    lengths = [start.values["hyperparameters"] for start in made]
    np.testing.assert_allclose(lengths, [[2.0, 3.0], [1.0, 1.5]][: len(bounds)])
    np.testing.assert_array_equal(best.values["hyperparameters"], lengths[kept])


def test_collapse_on_all_rows_restarts():
    own = model(rules=replace(OWN, other_starts=(), much_noise=None), samples=(1000,))
    made, best = drive(own, (5.0, GOOD), (2.0, COLLAPSED), (3.0, GOOD))
    assert [start.n_rows for start in made] == [1000, None, None]
    np.testing.assert_allclose(made[2].values["noise"], 1e-4)
    assert best.bound == 3.0


@pytest.mark.parametrize(
    ("n_rows", "n_inducing", "width", "sizes"),
    [
        (1999, 10, 9, ()),
        (2000, 10, 9, (1000,)),
        (36_000, 256, 9, (5120,)),
        (36_000, 100, 9, (2000, 8000)),
        (10**7, 10, 9, (1000, 4000, 16_000, 64_000)),
        (10**7, 10, 100, (1000, 4000, 16_000)),
    ],
)
def test_samples_grow_until_they_are_half_of_the_rows_or_too_large_for_memory(n_rows, n_inducing, width, sizes):
    assert replace(OWN, sample=(1000, 20)).samples(n_rows, n_inducing, width) == sizes
    assert OWN.samples(n_rows, n_inducing, width) == ()


@pytest.mark.parametrize(
    ("n_rows", "n_learned", "sizes"),
    [(353, 10, ()), (354, 10, (250,)), (1000, 10, (250, 500)), (2000, 19, (285, 546, 1045)), (2000, 200, ())],
)
def test_samples_of_an_exact_fit_are_each_about_twice_as_large(n_rows, n_learned, sizes):
    assert replace(OWN, exact_sample=(250, 15)).exact_samples(n_rows, n_learned) == sizes
    assert OWN.exact_samples(n_rows, n_learned) == ()
