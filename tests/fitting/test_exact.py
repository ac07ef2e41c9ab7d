"""The exact model's fit: units of its likelihood, where it starts, what it refuses and says."""

import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from skevgp.fitting import exact
from skevgp.fitting.exact import fit_exact, log_units_of_contrasts
from skevgp.utils.monitor import Monitor

from .cases import NO_FEATURES, H, N, O, X, Y, problem_of, units_of

KERNEL = ConstantKernel(1.4, (0.1, 200.0)) * RBF([0.9, 1.6], [(0.1, 9.0), (0.2, 8.0)]) + WhiteKernel(0.2)


def fitted(kernel=KERNEL, H=H, Y=Y, vague=False, max_iter=0, n_restarts=0, monitor=None, tol=0.01):
    vague = np.broadcast_to(vague, (Y.shape[1], H.shape[1]))
    problem = problem_of(kernel=kernel, H=H, Y=Y, vague=vague, max_iter=max_iter)
    monitor = Monitor() if monitor is None else monitor
    return fit_exact(problem, np.random.RandomState(0), monitor, n_restarts, tol)


def test_without_iterations_the_likelihood_is_scikit_learns():
    done = fitted(H=NO_FEATURES)
    gpr = GaussianProcessRegressor(KERNEL, optimizer=None)
    expected = sum(gpr.fit(X, y).log_marginal_likelihood_value_ for y in Y.T)
    assert done.log_marginal_likelihood == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(
        done.predictor().predict(X, NO_FEATURES)[0], np.column_stack([gpr.fit(X, y).predict(X) for y in Y.T]), rtol=1e-6
    )


def test_with_features_the_likelihood_is_that_of_y_with_their_weights_integrated_out():
    done, prior, expected = fitted(), units_of().prior, 0.0
    for o in range(O):
        features = H * prior.scale[o]
        covariance = KERNEL(X) + features @ features.T
        r = Y[:, o] - H @ prior.mean[o]
        expected -= 0.5 * (
            r @ np.linalg.solve(covariance, r) + np.linalg.slogdet(covariance)[1] + N * np.log(2 * np.pi)
        )
    assert done.log_marginal_likelihood == pytest.approx(expected, rel=1e-9)


def test_the_loss_curve_ends_at_minus_the_likelihood_and_is_what_the_monitor_is_told():
    told = []
    done = fitted(max_iter=200, monitor=Monitor(lambda number, loss, outputs: told.append(loss)))
    assert -done.loss_curve.min() == pytest.approx(done.log_marginal_likelihood, abs=0.1)
    assert done.log_marginal_likelihood > fitted().log_marginal_likelihood
    assert all(np.abs(np.array(told) - loss).min() < 1e-9 for loss in done.loss_curve)


@pytest.mark.parametrize(
    ("vague", "contrasts"), [(False, [N, N]), (True, [N - 2, N - 2]), ([[True, False], [False, False]], [N - 1, N])]
)
def test_each_contrast_has_a_unit(vague, contrasts):
    done = fitted(vague=vague)
    expected = np.dot(contrasts, np.log(units_of().target_unit))
    assert log_units_of_contrasts(done.units, done.model).sum() == pytest.approx(expected)


def test_values_start_where_the_user_says_and_limits_are_in_his_units():
    done = fitted()
    unit = units_of().target_unit
    np.testing.assert_allclose(done.fit.values["hyperparameters"], [0.9, 1.6])
    np.testing.assert_allclose(done.fit.values["signal"] * unit**2, 1.4)
    np.testing.assert_allclose(done.fit.values["noise"] * unit**2, 0.2)
    for o in range(O):
        np.testing.assert_allclose(done.limits("signal", o), [[0.1, 200.0]])
        np.testing.assert_allclose(done.limits("hyperparameters", o), [[0.1, 9.0], [0.2, 8.0]])


@pytest.mark.parametrize("bounds", ["fixed", (1e-5, 1e5)])
def test_of_a_signal_that_stays_features_may_alone_be_likelier_than_with_it(bounds, monkeypatch):
    """As likely as without a Gaussian process: where the kernel ends is not known before."""
    tasks, search = [], exact.search
    monkeypatch.setattr(exact, "may_hide_noise", lambda prior, n_rows: True)
    monkeypatch.setattr(exact, "search", lambda task: tasks.append(task) or search(task))
    noise = np.random.RandomState(1).randn(N, O)
    fitted(kernel=ConstantKernel(4.0, bounds) * RBF([1.0, 1.0]), Y=noise, max_iter=2)
    alone = tasks[0].alone
    assert alone.hidden
    assert (alone.most > alone.bound) == (bounds == "fixed")


def test_restarts_keep_the_likeliest():
    alone, several = (fitted(kernel=None, max_iter=1, n_restarts=n) for n in (0, 5))
    assert several.log_marginal_likelihood > alone.log_marginal_likelihood


def test_features_that_rows_cannot_tell_apart_are_refused_if_nothing_is_known_of_their_weights():
    twice = np.column_stack([H[:, 0], 2.0 * H[:, 0]])
    with pytest.raises(
        ValueError, match=r"An infinite scale .* needs .* 2 features have an infinite scale, but only 1 of them"
    ):
        fitted(H=twice, vague=True)
    assert np.isfinite(fitted(H=twice, vague=[[True, False], [False, True]]).log_marginal_likelihood)


def test_all_is_well_or_it_says_why():
    assert fitted(max_iter=200).messages == ()
    (message,) = fitted(max_iter=1, tol=1e-9).messages
    assert "likelihood was still rising after max_iter=1" in message


def test_ctrl_c_keeps_the_best_so_far():
    def interrupt(number, loss, outputs):
        if number == 3:
            raise KeyboardInterrupt

    done = fitted(max_iter=200, monitor=Monitor(interrupt))
    (message,) = done.messages
    assert message.startswith("The fit was interrupted after 3 iterations")
    assert done.log_marginal_likelihood >= fitted().log_marginal_likelihood


def test_y_far_from_its_prior_mean_is_told_but_a_vague_weight_has_none():
    """An intercept that explains it, and of which nothing is known, is as near as can be."""
    far = Y + 1e3
    assert any("prior standard deviations away" in message for message in fitted(Y=far, max_iter=50).messages)
    assert not any("prior" in message for message in fitted(Y=far, max_iter=50, vague=True).messages)
