from itertools import pairwise

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad
from scipy.optimize import approx_fprime
from scipy.stats import norm

from skevgp.estimators.bnn_model import VariationalNetwork

N_ROWS = 40
NETWORKS = [
    VariationalNetwork([3, 2], [0.7], 0.01),
    VariationalNetwork([3, 4, 1], [0.5, 1.5], 0.2),
    VariationalNetwork([2, 5, 4, 3], [1.0, 0.4, 2.0], 0.01),
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
    ("network", "scales", "slope"),
    [(NETWORKS[0], [0.7], 0.01), (NETWORKS[1], [0.5, 1.5], 0.2), (NETWORKS[2], [1.0, 0.4, 2.0], 0.01)],
    ids=lambda value: str(getattr(value, "sizes", value)),
)
def test_loss_and_gradient_agree_with_autograd(network, scales, slope):
    theta, X, Y, draws = case(network)
    expected = written_down(network, scales, slope, X, Y, draws)
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
    prior = 1.0 / np.sqrt(network._prior_precision)
    weights = network.draw(theta, n_draws, rng)
    flat = np.concatenate([w.reshape(n_draws, -1) for w in weights], axis=1)
    n = network.n_weights
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
    layers, _ = network.split(theta)
    passed = network._forward(layers, [np.exp(2.0 * layer.log_std) for layer in layers], X, draws)
    variances = [*(spread**2 for spread in passed.spreads), passed.variance]
    drawn = network.draw(theta, 40_000, np.random.default_rng(0))
    for inputs, weights, variance in zip(passed.inputs, drawn, variances, strict=True):
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


def test_draws_have_the_moments_of_the_weights():
    network = NETWORKS[1]
    theta, *_ = case(network)
    for weights, layer in zip(
        network.draw(theta, 20_000, np.random.default_rng(0)), network.split(theta)[0], strict=True
    ):
        np.testing.assert_allclose(weights.mean(axis=0), layer.mean, atol=5 * np.exp(layer.log_std).max() / 141)
        np.testing.assert_allclose(weights.std(axis=0), np.exp(layer.log_std), rtol=0.03)


def test_rows_of_zeros_have_a_finite_gradient():
    network = NETWORKS[2]
    theta = network.start(np.random.default_rng(0))
    loss, gradient = network.loss_and_gradient(theta, np.zeros((4, 2)), np.zeros((4, 3)), np.ones((4, 9)), 4)
    assert np.isfinite(loss)
    assert np.isfinite(gradient).all()


def test_the_start_is_within_the_bounds():
    for network in NETWORKS:
        theta, (lower, upper) = network.start(np.random.default_rng(0)), network.limits()
        assert (lower < theta).all()
        assert (theta < upper).all()


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
