"""A fit from top to bottom, and what is kept of it."""

from dataclasses import replace
from threading import Event, get_ident

import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from skevgp.fitting import fit, search
from skevgp.fitting.calibration import CrossValidation
from skevgp.fitting.exact import exact_model_of_sample
from skevgp.fitting.fit import finished, grown
from skevgp.fitting.inducing import Placement
from skevgp.fitting.search import Fit, Start
from skevgp.utils.monitor import Monitor

from .cases import NO_FEATURES, H, N, O, X, Y, data_of, fitted, model_of, source_of, units_of

SHARING = ("all", "kernel", "none")


def started(model, **options):
    """A fit that ended where it started."""
    values = model.table.values_at_start()
    bound = model.sparse.bound(values, model.sparse.statistics(values, model.blocks))
    return Fit(values, **{"bound": bound, **options})


# --- all outputs ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sharing", SHARING)
def test_the_predictor_is_of_all_outputs_in_the_users_units(sharing):
    done = fitted(sharing=sharing, max_iter=50)
    predictor = done.predictor()
    mean, variance = predictor.predict(X, H, return_variance=True)
    assert mean.shape == variance.shape == (N, O)
    assert (np.mean((mean - Y) ** 2, axis=0) < 0.2 * Y.var(axis=0)).all()
    internal = np.concatenate([one.values["noise"] for one in done.models])
    np.testing.assert_allclose(predictor.noise, internal * units_of().target_unit ** 2)
    assert -done.loss_curve[-1] == pytest.approx(done.lower_bound, abs=1e-6 * abs(done.lower_bound))


@pytest.mark.parametrize("sharing", SHARING)
def test_the_bound_is_summed_and_of_the_users_targets(sharing):
    """In units a hundred times as small, the density of each row and output is a hundredth."""
    done, scaled = (
        fitted(sharing=sharing, H=NO_FEATURES, Y=factor * Y, kernel=factor**2 * RBF([1.0, 1.0]), max_iter=0)
        for factor in (1.0, 100.0)
    )
    assert scaled.lower_bound == pytest.approx(done.lower_bound - N * O * np.log(100.0), rel=1e-9)
    shift = N * np.log(units_of(H=NO_FEATURES).target_unit).sum()
    assert done.lower_bound == pytest.approx(sum(one.bound for one in done.models) - shift)


def test_the_loss_curve_is_the_sum_of_the_models_and_one_that_is_done_keeps_its_last_value():
    def with_curves(*curves):
        done = fitted(sharing="none", max_iter=0)
        models = (replace(one, loss_curve=curve) for one, curve in zip(done.models, curves, strict=True))
        return replace(done, models=tuple(models))

    shift = N * np.log(units_of().target_unit).sum()
    done, none = with_curves([5.0, 4.0, 3.5], [10.0]), with_curves([], [])
    np.testing.assert_allclose(done.loss_curve, shift + np.array([15.0, 14.0, 13.5]))
    assert done.n_iter == 3
    assert (none.loss_curve.shape, none.n_iter) == ((0,), 0)


@pytest.mark.parametrize("family", ["full", "diagonal"])
@pytest.mark.parametrize(("sharing", "n_sets", "n_kernels"), [("all", 1, 1), ("kernel", 2, 1), ("none", 2, 2)])
def test_parameters_are_counted(sharing, n_sets, n_kernels, family):
    """Points, lengthscales, s² and σ² of each output, and q's mean and covariance over 8 values and 2 weights."""
    of_q = 2 * 10 if family == "diagonal" else 10 + 10 * 11 // 2
    expected = n_sets * 8 * 2 + n_kernels * 2 + O * (2 + of_q)
    assert fitted(sharing=sharing, family=family, max_iter=0).n_parameters == expected
    kernel = 1.0 * RBF([1.0, 1.0], "fixed") + WhiteKernel(0.1, "fixed")
    fixed = fitted(sharing=sharing, family=family, max_iter=0, kernel=kernel)
    assert expected - fixed.n_parameters == 2 * n_kernels + O


@pytest.mark.parametrize("sharing", [*SHARING, [[1], [0]]])
def test_limits_are_in_the_users_units_and_those_of_the_outputs_model(sharing):
    kernel = ConstantKernel(5.0, (1.0, 20.0)) * RBF([0.7, 0.9], [(0.1, 2.0), (0.2, 3.0)])
    done = fitted(sharing=sharing, kernel=kernel, max_iter=0)
    for o in range(O):
        np.testing.assert_allclose(done.limits("signal", o), [[1.0, 20.0]])
        np.testing.assert_allclose(done.limits("hyperparameters", o), [[0.1, 2.0], [0.2, 3.0]])
    by_data = fitted(sharing=sharing, max_iter=0)
    ratio = by_data.limits("signal", 1) / by_data.limits("signal", 0)
    np.testing.assert_allclose(ratio, (units_of().target_unit[1] / units_of().target_unit[0]) ** 2)


def test_groups_are_fitted_as_they_would_be_alone():
    four = np.column_stack([Y, 3.0 * Y[:, ::-1] + X])
    done = fitted(sharing=[[1, 3], [0, 2]], max_iter=8, **data_of(four))
    mean, variance = done.predictor().predict(X, NO_FEATURES, return_variance=True)
    total = 0.0
    for own in ([0, 2], [1, 3]):
        alone = fitted(max_iter=8, **data_of(four[:, own]))
        expected_mean, expected = alone.predictor().predict(X, NO_FEATURES, return_variance=True)
        np.testing.assert_allclose(mean[:, own], expected_mean, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(variance[:, own], expected, rtol=1e-5, atol=1e-8)
        np.testing.assert_allclose(done.predictor().noise[own], alone.predictor().noise, rtol=1e-5)
        total += alone.lower_bound
    assert done.lower_bound == pytest.approx(total, rel=1e-6)


# --- side by side, and interrupted ------------------------------------------------------------------------------------


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
def test_an_error_in_one_model_is_the_fits(n_threads, monkeypatch):
    whole = fit.search

    def broken(model):
        if model.rows.columns == [1]:
            raise ZeroDivisionError("the second")
        return whole(model)

    monkeypatch.setattr(fit, "search", broken)
    with pytest.raises(ZeroDivisionError, match="the second"):
        fitted(sharing="none", n_threads=n_threads)


@pytest.mark.parametrize("n_threads", [1, 2])
def test_ctrl_c_keeps_what_each_model_has(n_threads):
    def interrupt(iteration, loss, outputs):
        if iteration == 2:
            raise KeyboardInterrupt

    done = fitted(Monitor(interrupt), sharing="none", n_threads=n_threads)
    assert len(done.models) == 2
    assert done.n_iter <= 2
    assert done.messages == (
        f"The fit was interrupted after {done.n_iter} iterations; the best parameters so far are kept.",
    )
    assert np.isfinite(done.lower_bound)


def test_what_several_models_say_alike_is_said_once():
    (message,) = fitted(sharing="none", max_iter=2, tol=1e-9).messages
    assert "still rising after max_iter=2" in message


def sampled(monkeypatch, **changes):
    """A model whose fit begins with 15, then 30 of its rows."""
    monkeypatch.setattr(search, "RULES", replace(search.RULES, sample=(15, 1), growth=2, stage=5))
    return model_of(n_inducing=5, **changes)


def test_a_fit_that_begins_with_samples_ends_with_all_rows(monkeypatch):
    model = model_of(n_inducing=5, max_iter=200)
    plain = finished(model, search.search(model))
    model = sampled(monkeypatch, max_iter=200)
    done = finished(model, search.search(model))
    assert done.bound > plain.bound - 0.02 * (plain.bound - model.bound_alone)
    at = model.sparse.statistics(done.values, model.blocks)
    assert done.bound == pytest.approx(model.sparse.bound(done.values, at), rel=1e-6)
    assert done.loss_curve[-1] == pytest.approx(-done.bound, rel=1e-9)


def test_a_fit_that_ctrl_c_ended_on_a_sample_has_the_bound_of_all_rows(monkeypatch):
    seen = []

    def interrupt(iteration, loss, outputs):
        seen.append(iteration)
        if len(seen) == 4:
            raise KeyboardInterrupt

    model = sampled(monkeypatch, monitor=Monitor(interrupt))
    found = search.search(model)
    assert found.n_rows == 15
    at = model.sparse.statistics(found.values, model.blocks)
    assert finished(model, found).bound == pytest.approx(model.sparse.bound(found.values, at))


# --- one model --------------------------------------------------------------------------------------------------------


def test_what_is_kept_is_where_the_fit_ended():
    model = model_of()
    found = started(model, loss_curve=[3.0, 2.0])
    done = finished(model, found)
    assert done.values is found.values
    assert (done.loss_curve, done.bound, done.message) == ([3.0, 2.0], found.bound, "")
    expected = model.sparse.at_optimum(found.values, done.statistics, blocks=model.blocks)
    for own, value in zip(done.predictor.predict(X, H, True), expected.predict(X, H, True), strict=True):
        np.testing.assert_array_equal(own, value)
    # The fit's bound was summed row by row, and has more digits.
    assert finished(model, replace(found, bound=found.bound + 1e-3)).bound == found.bound + 1e-3
    assert finished(model, replace(found, bound=-np.inf)).bound == pytest.approx(found.bound)


def test_a_solver_that_has_moved_q_says_where_it_is():
    model = model_of()
    found, size = started(model), 8 + 2
    whitenings = list(model.sparse.whitenings(found.values))
    own = model.sparse.predictor(found.values, whitenings, [np.zeros(size)] * O, [np.eye(size)] * O)
    done = finished(model, replace(found, predictor=own))
    assert done.predictor is own
    # Rows that come later put it at its optimum.
    moved = done.updated(model.rows).predictor
    assert np.abs(moved.groups[0].mean).max() > 0.0 == np.abs(own.groups[0].mean).max()


@pytest.mark.parametrize("stopped", [True, False])
def test_noise_that_explains_everything_is_told_unless_ctrl_c_did_it(stopped):
    monitor = Monitor()
    model = model_of(monitor)
    found = started(model, message="It ended.")
    found = replace(found, values=found.values | {"noise": model.scatter})
    if stopped:
        monitor.stop()
    message = finished(model, found).message
    assert message.startswith("It ended.")
    assert ("The noise explains everything" in message) != stopped


@pytest.mark.parametrize("family", ["full", "diagonal"])
@pytest.mark.parametrize("sharing", ["all", "kernel"])
def test_new_rows_are_added_exactly(sharing, family):
    """The sums of all rows, and q at its optimum for them; earlier rows may count less."""
    model = model_of(sharing=sharing, family=family)
    parts = [units_of().rows(source_of(X[part], H[part], Y[part])) for part in (slice(0, 25), slice(25, None))]
    first = replace(model, rows=parts[0])
    both, whole = finished(first, started(first)).updated(parts[1]), finished(model, started(model))
    assert both.bound == pytest.approx(whole.bound, rel=1e-8)
    for own, expected in zip(both.predictor.groups, whole.predictor.groups, strict=True):
        np.testing.assert_allclose(own.mean, expected.mean, rtol=1e-6, atol=1e-8)
    faded = whole.updated(model.rows, 0.5)
    for own, expected in zip(faded.statistics, whole.statistics, strict=True):
        assert own.n_rows == 1.5 * N
        np.testing.assert_allclose(own.VV, 1.5 * expected.VV, rtol=1e-12)


@pytest.mark.parametrize("why", ["nobody asked", "Ctrl-C", "the noise is fixed"])
def test_the_noise_is_calibrated_only_if_it_may(why):
    monitor, kernel = Monitor(), ConstantKernel() * RBF([1.0, 1.0])
    if why == "the noise is fixed":
        kernel += WhiteKernel(0.3, "fixed")
    model = model_of(monitor, kernel=kernel, noise_cv=None if why == "nobody asked" else CrossValidation(5))
    found = started(model)
    if why == "Ctrl-C":
        monitor.stop()
    np.testing.assert_array_equal(finished(model, found).values["noise"], found.values["noise"])


def test_calibrated_are_signal_and_noise_and_q_is_at_its_optimum_for_them():
    model = model_of(noise_cv=CrossValidation(5))
    found = started(model)
    done = finished(model, found)
    for name in ("noise", "signal"):
        assert (done.values[name] != found.values[name]).all()
    for name in ("hyperparameters", "inducing_points"):
        np.testing.assert_array_equal(done.values[name], found.values[name])
    predictor = model.sparse.at_optimum(done.values, done.statistics, blocks=model.blocks)
    assert done.bound == model.sparse.bound(done.values, done.statistics, model.blocks)
    np.testing.assert_array_equal(done.predictor.groups[0].mean, predictor.groups[0].mean)


# --- a number of inducing points that is to be found ------------------------------------------------------------------


def growing(most=1000, first=8, **changes):
    return model_of(placement=Placement("k-means", first, most), **changes)


def test_points_are_added_until_they_gain_nothing():
    """A fit with half as many again has a bound that is higher by less than 0.01 nats per row and output."""
    model, found = grown(growing(max_iter=100))
    assert found.values["inducing_points"].shape == (1, model.n_inducing, 2)
    assert 8 < model.n_inducing < N
    more = replace(model.with_more(found.values), max_iter=100)
    values = found.values | {"inducing_points": more.table["inducing_points"].start}
    assert found.bound <= more.minimise(Start(values, 100)).bound < found.bound + 0.01 * N * O
    fewer = growing(max_iter=100)
    assert found.bound > fewer.minimise(Start(fewer.table.values_at_start(), 100)).bound + 0.01 * N * O


def test_few_points_do_not_hide_what_there_is_to_learn(monkeypatch):
    """Of a fast wave, ten and fifteen points show nothing: to them it is noise."""
    rng = np.random.RandomState(0)
    x = np.sort(rng.uniform(0.0, 6.0, (200, 1)), axis=0)
    model = growing(**data_of(np.sin(15.0 * x) + 0.1 * rng.randn(200, 1), x), first=10, max_iter=200)
    more, found = grown(model)
    assert more.n_inducing > 30
    assert found.values["noise"] < 0.1 * model.scatter
    monkeypatch.setattr(fit, "exact_model_of_sample", lambda *arguments: None)
    same, found = grown(model)
    assert same.n_inducing == 10
    assert found.values["noise"] > 0.9 * model.scatter


def test_the_exact_model_of_a_sample_knows_what_other_values_miss():
    model = growing()
    unhindered = exact_model_of_sample(model, 60, 2e-4)
    by_chance, first = -0.5 * (2 + 2 * O) / (N * O), model.table.values_at_start()
    assert unhindered.missed_by(unhindered.fit.values) == pytest.approx(by_chance, rel=1e-6)
    assert unhindered.missed_by(first) > 0.0
    assert unhindered.missed_by(first | {"signal": np.full(2, np.nan)}) == np.inf
    for changes in ({"max_iter": 0}, {"kernel": ConstantKernel() * RBF([1.0, 1.0], "fixed")}):
        assert exact_model_of_sample(growing(**changes), 60, 2e-4) is None


def test_few_iterations_do_not_ask_for_points():
    """What further iterations gain is not credited to points; those on the way to their number do not count."""
    (few, found), (many, _) = (grown(growing(max_iter=max_iter)) for max_iter in (3, 200))
    assert few.n_inducing == many.n_inducing < N
    assert found.n_iter <= 3


def test_a_fit_that_was_stopped_gets_no_more_points():
    def stop(*told):
        raise StopIteration

    same, found = grown(growing(monitor=Monitor(stop)))
    assert same.n_inducing == 8
    assert np.isfinite(found.bound)


def test_without_iterations_points_are_added_under_the_kernel_as_it_starts():
    model, found = grown(growing(most=30, max_iter=0))
    assert 8 < model.n_inducing <= 30
    first = growing().table.values_at_start()
    for name in ("hyperparameters", "signal", "noise"):
        np.testing.assert_array_equal(found.values[name], first[name])
    np.testing.assert_array_equal(found.values["inducing_points"][:, :8], first["inducing_points"])
