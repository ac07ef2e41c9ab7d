from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from skevgp import InverseDynamics
from skevgp.identification.joint_residual import _share
from tests.test_inverse_dynamics import trajectory


def gear(X):
    """A torque that no rigid body has."""
    return np.sin(2.0 * X[:, 0]) * np.tanh(X[:, 1])


def torque(X, size):
    return X[:, 2] / 4.0 + 9.81 / 2.0 * np.sin(X[:, 0]) + 0.3 * np.tanh(X[:, 1] / 0.01) + size * gear(X)


def fit(sizes, seed=0, **options):
    """Fit a pendulum with one move for each size of the gear's torque."""
    X = np.concatenate([trajectory(1, 100 * seed + move, dt=0.05) for move in range(len(sizes))])
    moves = np.repeat(np.arange(len(sizes)), len(X) // len(sizes))
    y = torque(X, np.array(sizes)[moves]) + 0.1 * np.random.default_rng(seed).normal(size=len(X))
    return InverseDynamics("pendulum", random_state=0, **options).fit(X, y, groups=moves)


@pytest.fixture(scope="module")
def useful():
    return fit(6 * [1.0], n_inducing=20)


@pytest.mark.parametrize("sizes", [6 * [0.0], 3 * [1.0, -1.0]], ids=["white", "another sign in each move"])
def test_residual_that_other_moves_do_not_have_is_hardly_predicted(sizes):
    model, physics = fit(sizes, n_inducing=10, max_iter=10), fit(sizes, n_inducing=0)
    X = trajectory(1, 9999)
    (mean, std), (expected, scale) = (one.predict(X, return_std=True) for one in (model, physics))
    assert np.sqrt(np.mean((mean - expected) ** 2)) < 0.2 * scale.mean()
    assert std.mean() < 1.05 * scale.mean()


def test_residual_that_all_moves_have_is_predicted_on_a_new_one(useful):
    X = trajectory(1, 9999, dt=0.05)
    truth = torque(X, 1.0)

    def error(model):
        return np.sqrt(np.mean((model.predict(X) - truth) ** 2))

    (joint,) = useful._joints
    assert joint.share >= 0.7
    assert joint.noise.variance < 0.05  # 0.01, and what a few moves leave open; the gear has 0.2
    assert error(useful) < 0.5 * error(fit(6 * [1.0], n_inducing=0))
    mean, std = useful.predict(X, return_std=True, include_noise=False)
    assert np.mean(np.abs(mean - truth) < 3.0 * std) > 0.8


def test_mean_is_less_where_it_is_uncertain_and_0_far_from_rows(useful):
    (whole,) = useful._joints
    assert_array_equal(useful.residual_std_, whole.signal)
    joint = replace(whole, share=0.3 * whole.share)
    assert joint.signal == pytest.approx(0.3 * whole.signal)
    X = trajectory(1, 9999, dt=0.05)
    x = np.column_stack([X, torque(X, 0.0)])
    near, far = x, x + [[100.0, 0.0, 0.0, 0.0]]
    size = joint.model.kernel_.k1.constant_value
    mean, variance = joint.moments(far)
    assert_allclose(mean, 0.0, atol=1e-9)
    assert_allclose(variance, joint.share**2 * size, rtol=1e-6)
    # Between rows and nowhere, the mean of f is multiplied by 1 - v / s², with variances v and s² of f after and before
    # data.
    between = x + np.linspace(0.0, 10.0, len(x))[:, np.newaxis] * [1.0, 0.0, 0.0, 0.0]
    for rows in (near, between):
        mean, variance = joint.moments(rows)
        f, std = joint.model.predict(rows, return_std=True, include_noise=False)
        assert_allclose(mean, joint.share * (1.0 - std**2 / size) * f, rtol=1e-6, atol=1e-9)
        assert_allclose(variance, (joint.share * std) ** 2, rtol=1e-6, atol=1e-12)


def test_share_is_that_of_left_out_moves_and_little_by_chance():
    rng, moves = np.random.default_rng(0), np.repeat(np.arange(5), 40)

    def share(size, truths):
        mean = size * np.repeat(rng.normal(size=20), 10)
        missed = np.repeat(truths, len(mean) // len(truths)) * mean + rng.normal(size=len(mean))
        return _share(missed, mean, np.ones(len(mean)), moves)

    assert np.mean([share(10.0, [0.6]) for _ in range(20)]) == pytest.approx(0.6, abs=0.03)
    assert np.mean([share(10.0, [0.0]) for _ in range(20)]) < 0.01
    assert np.mean([share(1.0, [0.0]) for _ in range(100)]) < 0.05
    # It helps in some moves and hurts in others.
    assert np.mean([share(3.0, [1.0, -0.5, 1.0, 0.0, -0.5]) for _ in range(100)]) < 0.1
    # All moves agree, so the small improvement is real.
    assert np.mean([share(0.5, [1.0]) for _ in range(100)]) > 0.25
    assert _share(np.ones(10), np.ones(10), np.ones(10), np.zeros(10)) == 0.0  # nothing was held out
    assert _share(rng.normal(size=200), np.zeros(200), np.ones(200), moves) == 0.0
    # Errors of exactly 0 in one move do not decide alone.
    mean = rng.normal(size=200)
    assert _share(np.where(moves == 0, 0.0, 3.0 * mean), np.where(moves == 0, 1e-9, mean), np.ones(200), moves) > 0.8
