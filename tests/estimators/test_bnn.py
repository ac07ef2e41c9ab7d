"""BayesianMLPRegressor: its network against oracles, and what a user sees of it."""

import pickle
from copy import copy
from itertools import pairwise

import autograd.numpy as anp
import numpy as np
import pandas as pd
import pytest
from autograd import grad
from scipy.optimize import approx_fprime
from scipy.stats import norm
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning, NotFittedError
from sklearn.metrics import r2_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from skevgp import BayesianMLPRegressor
from skevgp.estimators.bnn import VariationalNetwork, _EarlyStopping
from skevgp.metrics import containing_ratios

# --- the network -----------------------------------------------------------------------------------------------------


N_ROWS = 40
SCALES = [[0.7], [0.5, 1.5], [1.0, 0.4, 2.0]]
NETWORKS = [
    VariationalNetwork(sizes, scales, slope)
    for sizes, scales, slope in zip([[3, 2], [3, 4, 1], [2, 5, 4, 3]], SCALES, [0.01, 0.2, 0.01], strict=True)
]


def case(network, n=8, seed=0):
    """Parameters with uncertain weights, rows, targets and draws."""
    rng = np.random.RandomState(seed)
    theta = 0.5 * rng.randn(network.n_parameters)
    for layer in network.split(theta)[0]:
        layer.log_std[:] -= 0.7
    X, Y = rng.randn(n, network.sizes[0]), rng.randn(n, network.sizes[-1])
    return theta, X, Y, rng.randn(n, network.n_hidden)


def written_down(network, scales, slope, X, Y, draws):
    """Equations 6 and 7 of Kingma et al. (2015), and the divergence of normals, for autograd."""
    sizes = network.sizes

    def loss(theta):
        shapes = list(pairwise(sizes))
        parts, start = [], 0
        for shape in [*shapes, *shapes, *[(o,) for _, o in shapes], (sizes[-1],)]:
            parts.append(anp.reshape(theta[start : start + int(np.prod(shape))], shape))
            start += int(np.prod(shape))
        k = len(shapes)
        inputs, used, divergence = X, 0, 0.0
        for i in range(k):
            mean, std, bias = parts[i], anp.exp(parts[k + i]), parts[2 * k + i]
            divergence += anp.sum(anp.log(scales[i] / std) + (std**2 + mean**2) / (2 * scales[i] ** 2) - 0.5)
            m, v = anp.dot(inputs, mean) + bias, anp.dot(inputs**2, std**2)
            if i < k - 1:
                z = m + anp.sqrt(v) * draws[:, used : used + sizes[i + 1]]
                inputs, used = anp.where(z > 0, z, slope * z), used + sizes[i + 1]
        density = anp.log(2 * np.pi) + parts[-1] + ((Y - m) ** 2 + v) / anp.exp(parts[-1])
        return anp.sum(density) / (2 * len(X)) + divergence / N_ROWS

    return loss


@pytest.mark.parametrize(
    ("network", "scales"), [*zip(NETWORKS, SCALES, strict=True)], ids=lambda value: str(getattr(value, "sizes", ""))
)
def test_loss_and_gradient_agree_with_autograd(network, scales):
    theta, X, Y, draws = case(network)
    expected = written_down(network, scales, network.slope, X, Y, draws)
    loss, gradient = network.loss_and_gradient(theta, X, Y, draws, N_ROWS)
    assert loss == pytest.approx(expected(theta), rel=1e-12)
    np.testing.assert_allclose(gradient, grad(expected)(theta), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("network", NETWORKS, ids=lambda network: str(network.sizes))
def test_the_gradient_agrees_with_finite_differences(network):
    theta, X, Y, draws = case(network)
    _, gradient = network.loss_and_gradient(theta, X, Y, draws, N_ROWS)
    differences = approx_fprime(theta, lambda t: network.loss_and_gradient(t, X, Y, draws, N_ROWS)[0], 1e-7)
    np.testing.assert_allclose(gradient, differences, rtol=1e-4, atol=2e-6)


@pytest.mark.parametrize("network", NETWORKS, ids=lambda network: str(network.sizes))
def test_the_loss_is_what_brute_force_over_weights_gives(network):
    """E_q[log q(w) - log p(w)] / N - E_q[log p(y | w)] per row, all by drawing weights."""
    theta, X, Y, _ = case(network)
    rng, n_draws = np.random.default_rng(1), 20_000
    _, log_noise = network.split(theta)
    prior = np.repeat(np.exp(network.prior_log_stds), [layer.mean.size for layer in network.split(theta)[0]])
    weights = network.draw(theta, n_draws, rng)
    flat = np.concatenate([w.reshape(n_draws, -1) for w in weights], axis=1)
    n = flat.shape[1]
    divergence = norm.logpdf(flat, theta[:n], np.exp(theta[n : 2 * n])) - norm.logpdf(flat, 0.0, prior)
    likelihood = norm.logpdf(Y, network.functions(theta, weights, X), np.exp(0.5 * log_noise))
    brute = divergence.sum(axis=1) / N_ROWS - likelihood.sum(axis=2).mean(axis=1)

    losses = np.array(
        [network.loss_and_gradient(theta, X, Y, rng.standard_normal((len(X), network.n_hidden)), N_ROWS)[0]
         for _ in range(1000)]
    )  # fmt: skip
    error = np.hypot(brute.std() / np.sqrt(n_draws), losses.std() / np.sqrt(len(losses)))
    assert losses.mean() == pytest.approx(brute.mean(), abs=4.0 * error)
    assert error < 0.1 * abs(brute.mean())


def test_local_reparameterisation_gives_the_variance_of_pre_activations_and_outputs():
    network = NETWORKS[2]
    theta, X, _, draws = case(network)
    all_inputs, _, spreads, _, variance = network._forward(network.split(theta)[0], X, draws)
    variances = [*(spread**2 for spread in spreads), variance]
    drawn = network.draw(theta, 40_000, np.random.default_rng(0))
    for inputs, weights, variance in zip(all_inputs, drawn, variances, strict=True):
        np.testing.assert_allclose((inputs @ weights).var(axis=0), variance, rtol=0.04)


@pytest.mark.parametrize("network", NETWORKS, ids=lambda network: str(network.sizes))
def test_mini_batches_average_to_the_whole(network):
    theta, X, Y, draws = case(network)
    halves = [
        network.loss_and_gradient(theta, X[half], Y[half], draws[half], N_ROWS) for half in (slice(0, 4), slice(4, 8))
    ]
    loss, gradient = network.loss_and_gradient(theta, X, Y, draws, N_ROWS)
    assert np.mean([half[0] for half in halves]) == pytest.approx(loss, rel=1e-12)
    np.testing.assert_allclose(np.mean([half[1] for half in halves], axis=0), gradient, rtol=1e-9, atol=1e-12)


def test_the_expected_log_likelihood_is_the_loss_without_divergence():
    network = NETWORKS[1]
    theta, X, Y, draws = case(network)
    loss, _ = network.loss_and_gradient(theta, X, Y, draws, 10**15)
    assert network.expected_log_likelihood(theta, X, Y, draws) == pytest.approx(-loss, rel=1e-9)


@pytest.mark.parametrize(
    ("sizes", "count"),
    [([3, 15, 15, 2], 634), ([5, 50, 50, 4], 6008), ([5, 60, 60, 4], 8408), ([21, 250, 250, 14], 143028)],
)
def test_parameters_are_counted_as_in_the_papers_table_4(sizes, count):
    assert VariationalNetwork(sizes, [1.0] * 3, 0.01).n_parameters == count


def test_functions_are_those_of_a_network():
    network = NETWORKS[2]
    theta, X, _, _ = case(network)
    layers, _ = network.split(theta)
    weights = network.draw(theta, 3, np.random.default_rng(0))
    for s, outputs in enumerate(network.functions(theta, weights, X)):
        first = X @ weights[0][s] + layers[0].bias
        second = np.where(first > 0, first, 0.01 * first) @ weights[1][s] + layers[1].bias
        expected = np.where(second > 0, second, 0.01 * second) @ weights[2][s] + layers[2].bias
        np.testing.assert_allclose(outputs, expected, rtol=1e-12)


@pytest.mark.parametrize("n_draws", [1, 4, 5])
def test_mirrored_draws_cancel(n_draws):
    network = NETWORKS[1]
    theta, *_ = case(network)
    for weights, layer in zip(
        network.draw(theta, n_draws, np.random.default_rng(0), mirrored=True), network.split(theta)[0], strict=True
    ):
        assert weights.shape == (n_draws, *layer.mean.shape)
        half = (n_draws + 1) // 2
        pairs = n_draws - half
        np.testing.assert_allclose(
            (weights[:pairs] + weights[half:]) / 2, np.broadcast_to(layer.mean, weights[half:].shape)
        )


def test_rows_of_zeros_have_a_finite_gradient():
    network = NETWORKS[2]
    theta = network.start(np.random.default_rng(0))
    loss, gradient = network.loss_and_gradient(theta, np.zeros((4, 2)), np.zeros((4, 3)), np.ones((4, 9)), 4)
    assert np.isfinite(loss)
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("network", NETWORKS, ids=lambda network: str(network.sizes))
def test_a_row_that_counts_twice_is_there_twice(network):
    theta, X, Y, draws = case(network)
    counts = np.array([1, 2, 1, 3, 1, 1, 2, 1])
    again, weights = np.repeat(np.arange(8), counts), counts / counts.mean()
    loss, gradient = network.loss_and_gradient(theta, X, Y, draws, N_ROWS, weights)
    expected, expected_gradient = network.loss_and_gradient(theta, X[again], Y[again], draws[again], N_ROWS)
    assert loss == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(gradient, expected_gradient, rtol=1e-9, atol=1e-12)
    found = network.expected_log_likelihood(theta, X, Y, draws, weights)
    assert found == pytest.approx(network.expected_log_likelihood(theta, X[again], Y[again], draws[again]), rel=1e-12)


def test_early_stopping_keeps_the_best_and_waits():
    scores = iter([1.0, 3.0, 3.05, 2.0, 2.0])
    watch = _EarlyStopping(lambda theta: next(scores), 2, 0.1, 3)
    ended = [watch(np.array([step])) for step in range(10)]
    assert ended == [False] * 9 + [True]
    assert watch.scores == [1.0, 3.0, 3.05, 2.0, 2.0]
    assert watch.theta == [5]


# --- the estimator ---------------------------------------------------------------------------------------------------


def smooth(n=120, noise=0.1, seed=0):
    rng = np.random.RandomState(seed)
    X = rng.uniform(-2, 2, (n, 2))
    Y = np.column_stack([np.sin(2 * X[:, 0]) + X[:, 1], 3 * np.cos(X[:, 1]) * X[:, 0]])
    return X, Y + noise * rng.randn(*Y.shape)


X, Y = smooth()
X_NEW, Y_NEW = smooth(50, seed=1)


def model(hidden_layer_sizes=(8,), **arguments):
    """Quick; with so large a tolerance it never warns."""
    return BayesianMLPRegressor(hidden_layer_sizes, **{"max_iter": 20, "tol": 1e9, "random_state": 0} | arguments)


FITTED = model().fit(X, Y)


# --- shapes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("y", "shape"), [(Y[:, 0], (50,)), (Y[:, :1], (50,)), (Y, (50, 2))], ids=["one output", "one column", "two outputs"]
)
def test_shapes_follow_scikit_learns_gaussian_process(y, shape):
    m = model().fit(X, y)
    mean, std = m.predict(X_NEW, return_std=True)
    again, cov = m.predict(X_NEW, return_cov=True)
    assert mean.shape == std.shape == shape
    assert cov.shape == (50, *shape)
    assert m.sample_y(X_NEW, 3).shape == (*shape, 3)
    np.testing.assert_allclose(m.predict(X_NEW), mean, rtol=1e-12)
    np.testing.assert_allclose(again, mean, rtol=1e-12)
    np.testing.assert_allclose(np.einsum("ii...->i...", cov), std**2, rtol=1e-9)


@pytest.mark.parametrize("hidden", [(), (4,), [4, 3], 5, np.array([2, 2])], ids=str)
def test_shapes_of_attributes(hidden):
    m = model(hidden).fit(X, Y)
    sizes = [2, *np.atleast_1d(hidden).astype(int), 2]
    assert [w.shape for w in m.coefs_] == [w.shape for w in m.coefs_std_] == list(pairwise(sizes))
    assert [b.shape for b in m.intercepts_] == [(o,) for o in sizes[1:]]
    assert m.noise_variance_.shape == (2,)
    assert m.n_parameters_ == 2 * sum(w.size for w in m.coefs_) + sum(b.size for b in m.intercepts_) + 2
    assert m.loss_curve_.shape == (m.n_iter_,) == (20,)
    assert m.validation_scores_ is None
    for y in (Y[:, 0], Y[:, :1]):
        assert isinstance(m.fit(X, y).noise_variance_, float)


def test_std_and_covariance_together_are_refused():
    with pytest.raises(ValueError, match="At most one"):
        FITTED.predict(X, return_std=True, return_cov=True)


def test_noise_is_included_unless_told_otherwise():
    _, with_noise = FITTED.predict(X_NEW, return_std=True)
    _, without = FITTED.predict(X_NEW, return_std=True, include_noise=False)
    np.testing.assert_allclose(with_noise**2 - without**2, np.broadcast_to(FITTED.noise_variance_, (50, 2)), rtol=1e-9)


# --- the mathematics ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def linear():
    """A linear-Gaussian problem with correlated inputs, and variational inference for it."""
    rng = np.random.RandomState(1)
    x = rng.randn(150, 3) @ [[1.0, 0.6, 0.0], [0.0, 1.0, 0.3], [0.0, 0.0, 2.0]] + [3.0, 0.0, -1.0]
    y = x @ [[1.0, -2.0], [0.5, 0.0], [0.0, 3.0]] + [5.0, -5.0] + rng.randn(150, 2) * [0.5, 2.0]
    fit = BayesianMLPRegressor((), batch_size=150, max_iter=4000, tol=1.0, learning_rate_init=0.05, random_state=0)
    return x, y, fit.fit(x, y)


@pytest.mark.long
def test_without_hidden_layers_means_are_the_exact_posteriors_and_variances_the_mean_field_optimum(linear):
    """Λ = XᵀX / σ² + I / s², of centred inputs; optimal independent variances are 1 / Λ_ii (Bishop 2006, 10.1.2)."""
    x, y, fit = linear
    x, centred = x - x.mean(axis=0), y - y.mean(axis=0)
    np.testing.assert_allclose(fit.intercepts_[0], y.mean(axis=0), rtol=1e-3)
    for o in range(2):
        # 1 / sqrt(fan in) for standardised inputs and targets.
        prior = y[:, o].std() / x.std(axis=0) / np.sqrt(3)
        precision = x.T @ x / fit.noise_variance_[o] + np.diag(prior**-2)
        mean = np.linalg.solve(precision, x.T @ centred[:, o] / fit.noise_variance_[o])
        np.testing.assert_allclose(fit.coefs_[0][:, o], mean, atol=0.02 / np.sqrt(np.diag(precision)).min())
        np.testing.assert_allclose(fit.coefs_std_[0][:, o], np.diag(precision) ** -0.5, rtol=1e-3)


def test_the_noise_is_what_the_fit_leaves_over_and_is_unsure_of(linear):
    x, y, fit = linear
    left_over = y - fit.intercepts_[0] - (x - fit.X_mean_) @ fit.coefs_[0]
    unsure = (x - fit.X_mean_) ** 2 @ fit.coefs_std_[0] ** 2
    np.testing.assert_allclose(fit.noise_variance_, (left_over**2 + unsure).mean(axis=0), rtol=1e-3)


def test_predictions_of_the_linear_model_have_the_moments_of_its_weights(linear):
    x, _, fit = linear
    # Mirrored draws: of a linear model already two have the mean of all.
    np.testing.assert_allclose(fit.predict(x), fit.intercepts_[0] + (x - fit.X_mean_) @ fit.coefs_[0], rtol=1e-9)
    fit = copy(fit)
    fit._weights = fit._network.draw(fit._theta, 4000, np.random.default_rng(0), mirrored=True)
    _, std = fit.predict(x, return_std=True, include_noise=False)
    np.testing.assert_allclose(std**2, (x - fit.X_mean_) ** 2 @ fit.coefs_std_[0] ** 2, rtol=0.1)


def test_attributes_are_of_a_network_in_the_users_units():
    m = model((6, 5), n_samples=4).fit(1e3 * X + 7.0, 1e-3 * Y + 2.0)
    # With certain weights a draw is the network of the means.
    m._weights = [layer.mean[np.newaxis] for layer in m._network.split(m._theta)[0]]
    values = 1e3 * X_NEW + 7.0 - m.X_mean_
    for k, (weights, bias) in enumerate(zip(m.coefs_, m.intercepts_, strict=True)):
        values = values @ weights + bias
        values = np.where(values > 0.0, values, 0.01 * values) if k < 2 else values
    np.testing.assert_allclose(values, m.predict(1e3 * X_NEW + 7.0), rtol=1e-9)


def test_loss_and_predictions_are_those_of_weights_drawn_from_the_attributes():
    """In the users' units, with the prior's, and nothing of the implementation."""
    x, y = 1e3 * X[:50] + 7.0, Y[:50] * [1e-3, 10.0]
    m = model((6,), prior_scale=[0.7, 0.4], max_iter=400, batch_size=50, n_samples=4000).fit(x, y)
    means, stds, rng, n = m.coefs_, m.coefs_std_, np.random.RandomState(0), 4000
    first, second = (mean + std * rng.randn(n, *mean.shape) for mean, std in zip(means, stds, strict=True))
    hidden = (x - m.X_mean_) @ first + m.intercepts_[0]
    functions = np.where(hidden > 0.0, hidden, 0.01 * hidden) @ second + m.intercepts_[1]
    likelihood = norm.logpdf(y, functions, np.sqrt(m.noise_variance_)).sum(axis=2).mean()
    priors = 0.7 / x.std(axis=0)[:, np.newaxis], 0.4 * y.std(axis=0)
    divergence = sum(
        np.sum(np.log(prior / std) + (mean**2 + std**2) / (2.0 * prior**2) - 0.5)
        for prior, mean, std in zip(priors, means, stds, strict=True)
    )
    assert np.mean(m.loss_curve_[-50:]) == pytest.approx(divergence / 50 - likelihood, abs=0.02)
    predicted, std = m.predict(x, return_std=True)
    np.testing.assert_allclose(predicted / y.std(axis=0), functions.mean(axis=0) / y.std(axis=0), atol=0.01)
    np.testing.assert_allclose(std**2, functions.var(axis=0) + m.noise_variance_, rtol=0.05)


def test_samples_have_the_predicted_moments():
    m = clone(FITTED).set_params(n_samples=4000).fit(X, Y)
    samples = m.sample_y(X_NEW[:4], 4000, random_state=0)
    mean, cov = m.predict(X_NEW[:4], return_cov=True)
    std = m.predict(X_NEW[:4], return_std=True)[1]
    assert (np.abs(samples.mean(axis=2) - mean) < 6 * std / np.sqrt(4000)).all()
    np.testing.assert_allclose(np.cov(samples[:, 0]), cov[:, :, 0], atol=0.15 * cov[:, :, 0].max())
    np.testing.assert_array_equal(samples, m.sample_y(X_NEW[:4], 4000, random_state=0))
    assert (m.sample_y(X_NEW[:4], 3, random_state=1) != samples[:, :, :3]).all()


# --- learning ----------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_it_learns_and_is_calibrated():
    x, y = smooth(600)
    m = BayesianMLPRegressor((20,), batch_size=100, max_iter=250, tol=0.5, random_state=0).fit(x, y)
    assert m.score(X_NEW, Y_NEW) > 0.97
    x_new, y_new = smooth(500, seed=2)
    mean, std = m.predict(x_new, return_std=True)
    np.testing.assert_allclose(containing_ratios(y_new, mean, std), [0.683, 0.954, 0.997], atol=0.08)
    assert m.loss_curve_[-1] < m.loss_curve_[0] - 1.0


def test_the_loss_is_in_the_users_units():
    a, b = (model().fit(X, unit * Y) for unit in (1.0, 2.0**10))
    np.testing.assert_allclose(b.loss_curve_ - a.loss_curve_, 2 * np.log(2.0**10), rtol=1e-9)


def test_early_stopping_keeps_what_explains_the_rows_held_back_best():
    m = model(early_stopping=True, n_iter_no_change=3, tol=0.5, max_iter=500).fit(X, Y)
    assert m.n_iter_ < 500
    assert m.validation_scores_.shape == (m.n_iter_,)
    assert (m.validation_scores_[-3:] <= m.validation_scores_[:-3].max() + 0.5).all()


def test_a_warm_start_goes_on_where_the_last_fit_ended():
    m = model(warm_start=True, batch_size=120, max_iter=300).fit(X, Y)
    last = m.loss_curve_[-1]
    assert m.fit(X, Y).loss_curve_[0] < last + 0.5 < model().fit(X, Y).loss_curve_[0]
    # Other shapes: from the beginning.
    assert m.fit(X, Y[:, 0]).predict(X_NEW).shape == (50,)


@pytest.mark.parametrize("hidden", [(), (4,), (4, 3)])
def test_a_warm_start_on_other_scales_is_the_same_network(hidden):
    m = model(hidden, warm_start=True).fit(X * [1.0, 1e9] + [5.0, 0.0], Y * [1e-6, 1e6])
    before = copy(m)
    # Steps that go nowhere.
    m.set_params(learning_rate_init=1e-12, max_iter=3, batch_size=120)
    m.fit(2.0 * X * [1.0, 1e9] + [7.0, 1e9], 3.0 * Y * [1e-6, 1e6] - [1.0, 0.0])
    for name in ("coefs_", "coefs_std_"):
        for a, b in zip(getattr(m, name), getattr(before, name), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9)
    np.testing.assert_allclose(m.noise_variance_, before.noise_variance_, rtol=1e-9)
    # Biases of the first layer are those at X = 0.
    at_zero = [fit.intercepts_[0] - fit.X_mean_ @ fit.coefs_[0] for fit in (m, before)]
    np.testing.assert_allclose(*at_zero, rtol=1e-6)
    for a, b in zip(m.intercepts_[1:], before.intercepts_[1:], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_held_out_rows_are_not_learned_from(monkeypatch):
    learned, scored = set(), set()
    for name, seen in (("loss_and_gradient", learned), ("expected_log_likelihood", scored)):
        original = getattr(VariationalNetwork, name)

        def look(self, theta, X, *arguments, original=original, seen=seen):
            seen.update(X[:, 0])
            return original(self, theta, X, *arguments)

        monkeypatch.setattr(VariationalNetwork, name, look)
    m = model(early_stopping=True, validation_fraction=0.25, max_iter=3, batch_size=7).fit(X, Y)
    assert (len(learned), len(scored), len(learned & scored)) == (90, 30, 0)
    assert len(m.loss_curve_) == len(m.validation_scores_) == 3


def test_weighted_rows_are_repeated_rows():
    """Without hidden layers nothing is drawn during the fit, and all rows are in each step."""
    counts = np.random.RandomState(0).randint(0, 4, 120)
    again = np.repeat(np.arange(120), counts)
    weighted = model((), batch_size=120, max_iter=50).fit(X, Y, sample_weight=counts)
    repeated = model((), batch_size=len(again), max_iter=50).fit(X[again], Y[again])
    for name in ("coefs_", "coefs_std_", "intercepts_"):
        np.testing.assert_allclose(getattr(weighted, name)[0], getattr(repeated, name)[0], rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(weighted.loss_curve_, repeated.loss_curve_, rtol=1e-8)
    np.testing.assert_allclose(weighted.X_mean_, repeated.X_mean_, rtol=1e-12)


def test_a_loss_that_does_not_stay_finite_is_told(monkeypatch):
    monkeypatch.setattr(VariationalNetwork, "loss_and_gradient", lambda self, theta, *_: (np.nan, theta))
    with pytest.warns(ConvergenceWarning, match="did not stay finite"):
        model().fit(X, Y)


def test_a_loss_that_still_falls_is_told():
    with pytest.warns(ConvergenceWarning, match=r"max_iter=30 epochs.*Raise max_iter"):
        model(max_iter=30, tol=0.0, batch_size=20).fit(X, Y)


def test_an_interruption_keeps_a_usable_model(monkeypatch):
    original, calls = VariationalNetwork.loss_and_gradient, []

    def interrupted(self, *arguments):
        calls.append(1)
        if len(calls) == 10:
            raise KeyboardInterrupt
        return original(self, *arguments)

    monkeypatch.setattr(VariationalNetwork, "loss_and_gradient", interrupted)
    with pytest.warns(ConvergenceWarning, match="interrupted"):
        m = model().fit(X, Y)
    assert m.n_iter_ == 9
    assert np.isfinite(m.predict(X_NEW)).all()


def test_progress_is_printed(capsys):
    model(verbose=2, max_iter=3).fit(X, Y)
    assert capsys.readouterr().out.count("bound") == 3


# --- reproducibility ---------------------------------------------------------------------------------------------


def test_the_same_random_state_gives_the_same_bits():
    for a, b in zip(FITTED.predict(X_NEW, True), model().fit(X, Y).predict(X_NEW, True), strict=True):
        np.testing.assert_array_equal(a, b)
    assert (model(random_state=1).fit(X, Y).predict(X_NEW) != FITTED.predict(X_NEW)).all()


def test_a_rows_prediction_depends_neither_on_its_neighbours_nor_on_the_call(monkeypatch):
    whole = FITTED.predict(X_NEW, return_std=True)
    for part, again in zip(whole, FITTED.predict(X_NEW, return_std=True), strict=True):
        np.testing.assert_array_equal(part, again)
    for part, row in zip(whole, FITTED.predict(X_NEW[3:4], return_std=True), strict=True):
        np.testing.assert_allclose(row[0], part[3], rtol=1e-12)
    monkeypatch.setattr("skevgp.estimators.bnn._NUMBERS_AT_ONCE", 100 * 8 * 7)
    for part, blocks in zip(whole, FITTED.predict(X_NEW, return_std=True), strict=True):
        np.testing.assert_allclose(blocks, part, rtol=1e-12)


def test_it_can_be_pickled_and_cloned():
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(FITTED)).predict(X_NEW), FITTED.predict(X_NEW))
    with pytest.raises(NotFittedError):
        clone(FITTED).predict(X_NEW)


def test_data_frames_and_pipelines():
    frame = pd.DataFrame(X, columns=["a", "b"])
    m = make_pipeline(StandardScaler().set_output(transform="pandas"), model()).fit(frame, Y)
    assert list(m[-1].feature_names_in_) == ["a", "b"]
    assert m.predict(frame).shape == Y.shape


# --- nasty data --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("power", [-40, 40])
def test_scales_do_not_matter(power):
    """1e-12 and 1e12, nearly: scaled by a power of 2, all numbers are the same but for the exponent."""
    m = model().fit(2.0**power * X, 2.0**-power * Y)
    for part, expected in zip(m.predict(2.0**power * X_NEW, True), FITTED.predict(X_NEW, True), strict=True):
        np.testing.assert_allclose(part, 2.0**-power * expected, rtol=1e-9)


@pytest.mark.parametrize("constant", [0.0, 3.0, 1e-12, -1e12])
def test_constant_columns(constant):
    x, y = np.column_stack([X, np.full(120, constant)]), np.column_stack([Y, np.full(120, constant)])
    m = model(max_iter=300).fit(x, y)
    mean, std = m.predict(x, return_std=True)
    assert np.isfinite(std).all()
    np.testing.assert_allclose(mean[:, 2], constant, atol=0.3 * (abs(constant) or 1.0))
    assert r2_score(Y, mean[:, :2]) > 0.5


@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_rows(n):
    assert np.isfinite(model().fit(X[:n], Y[:n]).predict(X_NEW, return_std=True)).all()


@pytest.mark.parametrize("rate", [1.0, 1e6])
def test_steps_that_are_much_too_large_stay_finite(rate):
    m = model(learning_rate_init=rate).fit(X, Y)
    assert np.isfinite(m.predict(X_NEW, return_std=True)).all()


@pytest.mark.parametrize("unit", [1e-130, 1.0, 1e99])
def test_predictions_stay_finite_however_far_away(unit):
    m = model().fit(unit * X, Y)
    assert np.isfinite(m.predict(np.full((3, 2), 1e100), return_std=True)).all()
    assert np.isfinite(m.predict(np.full((3, 2), -1e100), return_cov=True)[1]).all()


def test_targets_without_noise_and_rows_on_top_of_each_other():
    x = np.repeat(X[:20], 5, axis=0)
    m = model((), max_iter=2000, learning_rate_init=0.05).fit(x, x @ [[1.0], [2.0]])
    assert m.score(x, x @ [1.0, 2.0]) > 0.9999
    assert m.noise_variance_ < 1e-4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"hidden_layer_sizes": (5, 0)}, r"hidden_layer_sizes.*\(5, 0\)"),
        ({"hidden_layer_sizes": (5, 2.5)}, "hidden_layer_sizes"),
        ({"hidden_layer_sizes": [[3]]}, "hidden_layer_sizes"),
        ({"hidden_layer_sizes": 0}, "hidden_layer_sizes"),
        ({"prior_scale": 0.0}, "prior_scale"),
        ({"prior_scale": [1.0]}, "or 2, one a layer"),
        ({"prior_scale": [1.0, -1.0]}, "from 1e-30 to 1e30"),
        ({"prior_scale": [1.0, np.nan]}, "from 1e-30 to 1e30"),
        ({"prior_scale": np.inf}, "prior_scale"),
        ({"prior_scale": 1e-200}, "from 1e-30 to 1e30"),
        ({"negative_slope": 2.0}, "negative_slope"),
        ({"batch_size": 0}, "batch_size"),
        ({"max_iter": 0}, "max_iter"),
        ({"learning_rate_init": 0.0}, "learning_rate_init"),
        ({"validation_fraction": 1.0}, "validation_fraction"),
        ({"early_stopping": True, "validation_fraction": 0.999}, "leaves none to learn from"),
        ({"n_samples": 0}, "n_samples"),
    ],
    ids=str,
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        model(**arguments).fit(X, Y)


@pytest.mark.parametrize(
    ("x", "y", "message"),
    [
        (np.full((5, 1), np.nan), np.ones(5), "NaN"),
        (np.ones((5, 1)), np.full(5, np.inf), "infinity"),
        (np.full((5, 1), 1e101), np.ones(5), "X must not exceed"),
        (np.ones((5, 1)), np.full(5, 1e-200), "y must be 0 or exceed"),
        (np.ones((5, 1)), np.ones(4), "inconsistent"),
    ],
)
def test_bad_data_are_named(x, y, message):
    with pytest.raises(ValueError, match=message):
        model().fit(x, y)


def test_bad_data_for_predictions_are_named():
    with pytest.raises(ValueError, match="3 features"):
        FITTED.predict(np.ones((2, 3)))
    with pytest.raises(ValueError, match="NaN"):
        FITTED.predict(np.full((2, 2), np.nan))
    with pytest.raises(ValueError, match="n_samples must be at least 1"):
        FITTED.sample_y(X_NEW, 0)


def test_a_fit_that_fails_leaves_the_model_as_it_was():
    m = model().fit(X, Y)
    before = m.predict(X_NEW)
    with pytest.raises(ValueError, match="prior_scale"):
        m.set_params(prior_scale=[1.0]).fit(X[:, :1], Y[:, 0])
    np.testing.assert_array_equal(m.predict(X_NEW), before)
