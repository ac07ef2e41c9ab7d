"""BayesianMLPRegressor: its network against oracles, and what a user sees of it."""

from copy import copy
from itertools import pairwise

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad
from scipy.stats import norm
from sklearn.exceptions import ConvergenceWarning

from skevgp import BayesianMLPRegressor
from skevgp.estimators.bnn import VariationalNetwork, _EarlyStopping

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
def test_loss_is_what_brute_force_over_weights_gives(network):
    """E_q[log q(w) - log p(w)] / N - E_q[log p(y | w)] per row, all by drawing weights."""
    theta, X, Y, _ = case(network)
    rng, n_draws = np.random.default_rng(1), 10_000
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
         for _ in range(500)]
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


@pytest.mark.parametrize(
    ("sizes", "count"),
    [([3, 15, 15, 2], 634), ([5, 50, 50, 4], 6008), ([5, 60, 60, 4], 8408), ([21, 250, 250, 14], 143028)],
)
def test_parameters_are_counted_as_in_the_papers_table_4(sizes, count):
    assert VariationalNetwork(sizes, [1.0] * 3, 0.01).n_parameters == count


@pytest.mark.parametrize("network", NETWORKS, ids=lambda network: str(network.sizes))
def test_weight_two_equals_repeated_row(network):
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


def test_noise_is_mean_squared_error_and_variance(linear):
    x, y, fit = linear
    left_over = y - fit.intercepts_[0] - (x - fit.X_mean_) @ fit.coefs_[0]
    unsure = (x - fit.X_mean_) ** 2 @ fit.coefs_std_[0] ** 2
    np.testing.assert_allclose(fit.noise_variance_, (left_over**2 + unsure).mean(axis=0), rtol=1e-3)


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


@pytest.mark.parametrize("hidden", [(), (4,), (4, 3)])
def test_warm_start_on_other_scales_is_the_same_network(hidden):
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


# --- learning ----------------------------------------------------------------------------------------------------


def test_warm_start_goes_on_where_the_last_fit_ended():
    m = model(warm_start=True, batch_size=120, max_iter=300).fit(X, Y)
    last = m.loss_curve_[-1]
    assert m.fit(X, Y).loss_curve_[0] < last + 0.5 < model().fit(X, Y).loss_curve_[0]
    # Other shapes: from the beginning.
    assert m.fit(X, Y[:, 0]).predict(X_NEW).shape == (50,)


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


def test_interruption_keeps_a_usable_model(monkeypatch):
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


def test_loss_that_still_falls_at_the_end_warns():
    rng = np.random.RandomState(0)
    X = rng.uniform(-2.0, 2.0, (60, 2))
    y = np.sin(X[:, 0]) + 0.1 * rng.randn(60)
    with pytest.warns(ConvergenceWarning, match="still fell when max_iter=30 "):
        BayesianMLPRegressor((5,), max_iter=30, random_state=0).fit(X, y)
    # Steps that become small lower the loss too.
    model = BayesianMLPRegressor((5,), max_iter=1500, random_state=0).fit(X, y)
    losses = model.loss_curve_
    assert model.n_iter_ == 1500
    assert np.median(losses[500:1000]) - np.median(losses[1000:]) > model.tol


def test_loss_that_does_not_stay_finite_warns(monkeypatch):
    monkeypatch.setattr(VariationalNetwork, "loss_and_gradient", lambda self, theta, *_: (np.nan, theta))
    with pytest.warns(ConvergenceWarning, match="did not stay finite"):
        model().fit(X, Y)


# --- nasty data --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"hidden_layer_sizes": (5, 0)}, r"hidden_layer_sizes.*\(5, 0\)"),
        ({"hidden_layer_sizes": (5, 2.5)}, "hidden_layer_sizes"),
        ({"hidden_layer_sizes": [[3]]}, "hidden_layer_sizes"),
        ({"hidden_layer_sizes": 0}, "hidden_layer_sizes"),
        ({"prior_scale": 0.0}, "prior_scale"),
        ({"prior_scale": [1.0]}, "or one for each of 2 layers"),
        ({"prior_scale": [1.0, -1.0]}, "from 1e-30 to 1e30"),
        ({"prior_scale": [1.0, np.nan]}, "from 1e-30 to 1e30"),
        ({"prior_scale": np.inf}, "prior_scale"),
        ({"prior_scale": 1e-200}, "from 1e-30 to 1e30"),
        ({"negative_slope": 2.0}, "negative_slope"),
        ({"batch_size": 0}, "batch_size"),
        ({"max_iter": 0}, "max_iter"),
        ({"learning_rate_init": 0.0}, "learning_rate_init"),
        ({"validation_fraction": 1.0}, "validation_fraction"),
        ({"early_stopping": True, "validation_fraction": 0.999}, "leaves no rows for training"),
        ({"n_samples": 1}, "n_samples"),
    ],
    ids=str,
)
def test_invalid_arguments_raise(arguments, message):
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
def test_invalid_data_raise(x, y, message):
    with pytest.raises(ValueError, match=message):
        model().fit(x, y)
