import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import lfilter
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import DotProduct

from skevgp.identification import moves
from skevgp.identification.moves import MoveEffects, free_effects, of_move, terms, variation
from skevgp.identification.stiction import JointNoise
from skevgp.identification.weights import Rows


def errors(n, factor, rng):
    """Autoregressive errors with variance 1."""
    return lfilter([np.sqrt(1.0 - factor**2)], [1.0, -factor], rng.normal(size=n + 200))[200:]


class Moves:
    """Errors of many moves of a joint, whose effects have the given variances."""

    def __init__(self, variances, n_moves=60, n_rows=200, variance=0.02, factor=0.0):
        rng, t = np.random.default_rng(0), np.linspace(0.0, 10.0, n_rows)
        waves = [np.cos(rng.uniform(0.5, 3.0, (2, 1)) * t + rng.uniform(0.0, 6.0, (2, 1))) for _ in range(n_moves)]
        self.speed, torque = np.hstack(waves) * [[1.0], [3.0]]
        self.move = np.repeat(np.arange(n_moves), n_rows)
        self.z = terms(self.speed, torque, 0.05)
        self.effects = np.sqrt(variances) * rng.normal(size=(n_moves, 4))
        noise = np.concatenate([errors(n_rows, factor, rng) for _ in range(n_moves)])
        self.missed = np.sum(self.z * self.effects[self.move], axis=1) + np.sqrt(variance) * noise

    def variation(self, n_moves=60, usual=(0.0, 0.0, 0.0, 0.0)):
        noise = JointNoise(float(np.mean(self.missed**2)), 0.0, 0.05)
        column = self.missed[:, np.newaxis]
        rows = Rows(column[:, np.newaxis], column, self.speed[:, np.newaxis], *3 * [self.move], n_moves)
        found = variation(self.z, self.missed, self.speed, noise, np.zeros(len(column)), rows, np.array(usual))
        return np.diag(found.effects.covariance), found.noise.variance, noise.variance


def test_effects_of_a_move_are_those_of_the_bayesian_linear_model(monkeypatch):
    rng, n = np.random.default_rng(0), 120
    speed, noise, runs = 0.05 * rng.normal(size=n), JointNoise(0.04, 0.5, 0.02), np.arange(n) // 50
    z, variances = terms(speed, 3.0 * rng.normal(size=n), 0.02), np.array([0.3, 0.0, 0.05, 0.01])
    assert_allclose(z[:, 2], np.tanh(speed / 0.02))
    missed = z @ [0.5, 0.0, -0.2, 0.1] + np.sqrt(noise.of(speed)) * rng.normal(size=n)
    times = []

    def known_time(errors, labels):
        times.append(labels)
        return 3.7

    monkeypatch.setattr(moves, "correlation_time", known_time)
    found = of_move(MoveEffects(np.zeros(4), np.diag(variances)), z, missed, speed, noise, runs)
    assert_array_equal(times[-1], runs)
    # With d = √t u and u ~ N(0, I), the model is a Gaussian process whose kernel is a dot product.
    gpr = GaussianProcessRegressor(DotProduct(0.0, "fixed"), alpha=3.7 * noise.of(speed), optimizer=None)
    mean, covariance = gpr.fit(z * np.sqrt(variances), missed).predict(np.diag(np.sqrt(variances)), return_cov=True)
    assert_allclose(found.mean, mean, rtol=1e-6, atol=1e-9)
    assert_allclose(found.covariance, covariance, rtol=1e-5, atol=1e-9)
    assert_allclose(found.moments(z[:5])[1], np.diag(z[:5] @ covariance @ z[:5].T), rtol=1e-5, atol=1e-9)
    # With a wide prior the effects are those of least squares.
    wide = of_move(MoveEffects(np.zeros(4), 1e6 * np.eye(4)), z, missed, speed, noise, runs)
    for free, limit in zip(free_effects(z, missed, np.sqrt(noise.of(speed)), runs), wide[:2], strict=True):
        assert_allclose(free, limit, rtol=1e-3, atol=1e-6)


def test_offset_of_a_move_is_not_taken_for_slow_noise():
    rng, n, std = np.random.default_rng(0), 150, 0.1
    z, noise, runs = terms(rng.normal(size=n), rng.normal(size=n), 0.02), JointNoise(std**2, 0.0, 0.02), np.zeros(n)
    missed = 1.0 + std * rng.normal(size=n)
    found = of_move(MoveEffects(np.zeros(4), np.diag([1.0, 0.0, 0.0, 0.0])), z, missed, z[:, 1], noise, runs)
    for mean, covariance in (found[:2], free_effects(z, missed, np.full(n, std), runs)):
        assert mean[0] == pytest.approx(1.0, abs=0.05)
        assert np.sqrt(covariance[0, 0]) == pytest.approx(std / np.sqrt(n), rel=0.5)


@pytest.mark.parametrize(
    "variances",
    [
        pytest.param([0.0, 0.0, 0.0, 0.002], id="gain"),
        pytest.param([0.05, 0.0, 0.0, 0.0], id="offset"),
        pytest.param([0.05, 0.0, 0.02, 0.002], id="three"),
    ],
)
def test_variances_of_effects_are_found_from_many_moves(variances):
    log = Moves(variances)
    found, left, total = log.variation()
    mean_squares = np.mean(log.effects**2, axis=0)
    assert_allclose(found, mean_squares, rtol=0.25, atol=0.02 * total / np.mean(log.z**2, axis=0).max())
    assert left == pytest.approx(0.02, rel=0.25)
    assert left + np.mean(log.z**2 @ found) == pytest.approx(total, rel=0.05)


def test_variance_of_an_effect_that_no_single_move_determines_is_found(monkeypatch):
    monkeypatch.setattr(moves, "_update", lambda *arguments: None)  # of each move: another subject
    log = Moves([0.0, 0.0, 0.0, 0.0005], n_moves=400, n_rows=10)
    found, _, _ = log.variation(400)
    assert found[3] == pytest.approx(np.mean(log.effects[:, 3] ** 2), rel=0.5)


def test_slow_errors_within_a_move_are_no_effects():
    log = Moves([0.0, 0.0, 0.0, 0.0], factor=0.8)
    found, left, total = log.variation()
    assert np.mean(log.z**2 @ found) < 0.1 * total
    assert left > 0.9 * total


def test_variances_of_few_moves_are_multiplied():
    log = Moves([0.0, 0.0, 0.0, 0.01], n_moves=5)
    found, left, _ = log.variation(1000)
    for n_moves, factor, blocks in ((1, 3.0, 1.5), (2, 2.0, 1.25), (3, 1.0 + 2.0 / 3.0, 1.0), (10, 1.2, 1.0)):
        more, noise, _ = log.variation(n_moves)
        assert_allclose(more, factor * blocks / 1.002 * found)
        assert noise == pytest.approx(blocks * left)


def test_usual_variances_are_added():
    log, usual = Moves([0.0, 0.0, 0.0, 0.0], n_moves=5), np.array([0.3, 0.2, 0.1, 0.05])
    found, left, _ = log.variation(5)
    more, noise, _ = log.variation(5, usual)
    assert_allclose(more - found, usual**2, rtol=1e-6)
    assert noise == left


def test_terms_that_are_zero_have_no_effects():
    log = Moves([0.0, 0.0, 0.0, 0.0], n_moves=5)
    log.z[:, 1:3] = log.speed[:] = 0.0  # without a robot there are no speeds
    found, left, _ = log.variation(5)
    assert_array_equal(found[1:3], 0.0)
    assert np.isfinite([*found, left]).all()
    own, noise = log.z[:100], JointNoise(left, 0.0, 0.05)
    for mean, covariance in (
        of_move(
            MoveEffects(np.zeros(4), np.diag(found)), own, log.missed[:100], log.speed[:100], noise, log.move[:100]
        )[:2],
        free_effects(own, log.missed[:100], np.full(100, 0.1), log.move[:100]),
    ):
        assert_allclose(mean[1:3], 0.0, atol=1e-9)
        assert_allclose(covariance[1:3], 0.0, atol=1e-9)
        assert np.isfinite(covariance).all()
