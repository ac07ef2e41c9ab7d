"""A fit from top to bottom, and what is kept of it."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from skevgp.fitting import rules, search
from skevgp.fitting.fit import finished
from skevgp.fitting.folds import CrossValidation
from skevgp.fitting.grown import exact_model_of_sample, grown
from skevgp.fitting.inducing import Placement
from skevgp.fitting.runs import Fit
from skevgp.utils.monitor import Monitor

from .cases import NO_FEATURES, N, O, X, Y, data_of, fitted, model_of, units_of

SHARING = ("all", "kernel", "none")


def started(model, **options):
    """A fit that ended where it started."""
    values = model.table.values_at_start()
    bound = model.sparse.bound(values, model.sparse.statistics(values, model.blocks))
    return Fit(values, **{"bound": bound, **options})


# --- all outputs ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sharing", SHARING)
def test_bound_is_summed_and_of_the_users_targets(sharing):
    """In units a hundred times as small, the density of each row and output is a hundredth."""
    done, scaled = (
        fitted(sharing=sharing, H=NO_FEATURES, Y=factor * Y, kernel=factor**2 * RBF([1.0, 1.0]), max_iter=0)
        for factor in (1.0, 100.0)
    )
    assert scaled.lower_bound == pytest.approx(done.lower_bound - N * O * np.log(100.0), rel=1e-9)
    shift = N * np.log(units_of(H=NO_FEATURES).target_unit).sum()
    assert done.lower_bound == pytest.approx(sum(one.bound for one in done.models) - shift)


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


@pytest.mark.parametrize("n_threads", [1, 2])
def test_ctrl_c_keeps_what_each_model_has(n_threads):
    def interrupt(iteration, loss, outputs):
        if iteration == 2:
            raise KeyboardInterrupt

    done = fitted(Monitor(interrupt), sharing="none", n_threads=n_threads)
    assert len(done.models) == 2
    assert done.n_iter <= 2
    assert done.messages == (
        f"The fit was interrupted after {done.n_iter} iterations. The best parameters so far are kept.",
    )
    assert np.isfinite(done.lower_bound)


@pytest.fixture
def _many_rows(monkeypatch):
    """Rows count as many, so that there is no prior of kernel and noise."""
    monkeypatch.setattr(rules, "RULES", replace(rules.RULES, few_rows=0.0))


def sampled(monkeypatch, **changes):
    """A model whose fit begins with 15, then 30 of its rows."""
    monkeypatch.setattr(rules, "RULES", replace(rules.RULES, sample=(15, 1), growth=2, stage=5))
    return model_of(n_inducing=5, **changes)


@pytest.mark.usefixtures("_many_rows")
def test_fit_that_begins_with_samples_ends_with_all_rows(monkeypatch):
    model = model_of(n_inducing=5, max_iter=200, tol=0.01)
    plain = finished(model, search.search(model))
    model = sampled(monkeypatch, max_iter=200, tol=0.01)
    done = finished(model, search.search(model))
    assert done.bound > plain.bound - 0.02 * (plain.bound - model.bound_alone)
    at = model.sparse.statistics(done.values, model.blocks)
    assert done.bound == pytest.approx(model.sparse.bound(done.values, at), rel=1e-6)
    assert done.loss_curve[-1] == pytest.approx(-done.bound, rel=1e-9)


# --- one model --------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("_many_rows")
def test_calibrated_are_signal_and_noise_and_q_is_at_its_optimum_for_them():
    model = model_of(noise_cv=CrossValidation(5))
    found = started(model)
    done = finished(model, found)
    for name in ("noise", "signal"):
        assert (done.values[name] != found.values[name]).all()
    for name in ("hyperparameters", "inducing_points"):
        np.testing.assert_array_equal(done.values[name], found.values[name])
    predictor = model.sparse.at_optimum(done.values, done.posterior.statistics, blocks=model.blocks)
    assert done.bound == model.sparse.bound(done.values, done.posterior.statistics, model.blocks)
    np.testing.assert_array_equal(done.predictor.groups[0].mean, predictor.groups[0].mean)


# --- a number of inducing points that is to be found ------------------------------------------------------------------


def growing(most=1000, first=8, **changes):
    return model_of(placement=Placement("k-means", first, most), **changes)


def test_number_of_points_grows_from_few(monkeypatch):
    """Of a fast wave, ten and fifteen points show nothing: to them it is noise."""
    rng = np.random.RandomState(0)
    x = np.sort(rng.uniform(0.0, 6.0, (200, 1)), axis=0)
    model = growing(**data_of(np.sin(15.0 * x) + 0.1 * rng.randn(200, 1), x), first=10, max_iter=60)
    more, found = grown(model)
    assert more.n_inducing > 30
    assert found.values["noise"] < 0.1 * model.scatter
    monkeypatch.setattr("skevgp.fitting.grown.exact_model_of_sample", lambda *arguments: None)
    same, found = grown(model)
    assert same.n_inducing == 10
    assert found.values["noise"] > 0.9 * model.scatter


def test_exact_sample_start_is_better():
    model = growing()
    unhindered = exact_model_of_sample(model, 60, 2e-4)
    by_chance, first = -0.5 * (2 + 2 * O) / (N * O), model.table.values_at_start()
    assert unhindered.missed_by(unhindered.fit.values) == pytest.approx(by_chance, rel=1e-6)
    assert unhindered.missed_by(first) > 0.0
    assert unhindered.missed_by(first | {"signal": np.full(2, np.nan)}) == np.inf
    for changes in ({"max_iter": 0}, {"kernel": ConstantKernel() * RBF([1.0, 1.0], "fixed")}):
        assert exact_model_of_sample(growing(**changes), 60, 2e-4) is None
