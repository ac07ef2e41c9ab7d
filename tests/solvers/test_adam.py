import numpy as np
import pytest

from skevgp.solvers.adam import adam
from skevgp.utils.linalg import NotPositiveDefiniteError
from skevgp.utils.monitor import Monitor

FREE = (np.full(2, -np.inf), np.full(2, np.inf))


def noisy_bowl(scatter=1.0, seed=0):
    """|x - 3|², seen through noise in value and gradient."""
    rng = np.random.RandomState(seed)

    def bowl(x):
        return ((x - 3.0) ** 2).sum() + scatter * rng.randn(), 2.0 * (x - 3.0) + scatter * rng.randn(2)

    return bowl


def test_minimum_of_a_noisy_bowl():
    seen = []
    minimum = adam(noisy_bowl(), np.zeros(2), FREE, 2000, 0.1, monitor=Monitor(lambda *told: seen.append(told[:2])))
    np.testing.assert_allclose(minimum.x, 3.0, atol=0.1)
    assert minimum.converged
    assert [i for i, _ in seen] == list(range(1, minimum.n_iter + 1))
    assert [loss for _, loss in seen] == minimum.loss_curve


def test_first_steps_are_adams():
    """Kingma & Ba 2015, algorithm 1, written down; the cosine has hardly begun to fall."""
    gradients = np.array([[1.0, -4.0], [3.0, 0.5], [-2.0, 1.0]])
    given = iter(gradients)
    points = []

    def objective(x):
        points.append(x.copy())
        return 0.0, next(given) if len(points) <= 3 else np.full(2, np.nan)

    adam(objective, np.zeros(2), FREE, 10**6, 0.1)
    x, m, v = np.zeros(2), np.zeros(2), np.zeros(2)
    for t, gradient in enumerate(gradients, 1):
        m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2
        x = x - 0.1 * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
        np.testing.assert_allclose(points[t], x, rtol=1e-6)


@pytest.mark.parametrize("constant", [True, False])
def test_steps_fall_along_a_cosine_unless_they_are_constant(constant):
    shares = []
    adam(noisy_bowl(), np.zeros(2), FREE, 100, 0.1, pace=shares.append, constant=constant)
    expected = np.ones(100) if constant else 0.5 * (1.0 + np.cos(np.pi * np.arange(100) / 100))
    np.testing.assert_allclose(shares, expected)


def test_plateau_starts_the_last_fall():
    """A bowl this simple needs no 20,000 steps; how many it takes does not depend on how many it may take."""
    a = adam(noisy_bowl(), np.zeros(2), FREE, 20_000, 0.1)
    b = adam(noisy_bowl(), np.zeros(2), FREE, 100_000, 0.1)
    assert a.converged
    assert a.n_iter == b.n_iter < 6000
    np.testing.assert_allclose(a.x, 3.0, atol=0.1)


@pytest.mark.parametrize(("fall", "tol", "n_iter"), [(1e-2, 0.0, 6000), (1e-6, 0.0, 6000), (1e-6, 0.1, 1200)])
def test_no_plateau_while_the_loss_falls_by_more_than_chance_and_tol(fall, tol, n_iter):
    rng, steps = np.random.RandomState(0), []

    def slope(x):
        steps.append(1)
        return -fall * len(steps) + (rng.randn() if fall == 1e-2 else 0.0), np.ones(2)

    assert adam(slope, np.zeros(2), FREE, 6000, 0.1, tol=tol).n_iter == n_iter


def test_plateau_up_to_chance_needs_more_steps_than_up_to_tol():
    by_tol, by_chance = (adam(noisy_bowl(), np.zeros(2), FREE, 20_000, 0.1, tol=tol).n_iter for tol in (1.0, 0.0))
    assert by_tol < 3000 <= by_chance


def test_limits_hold_and_no_steps_keep_the_start():
    limits = np.full(2, -0.5), np.ones(2)
    np.testing.assert_array_equal(adam(lambda x: (x.sum(), np.ones(2)), np.zeros(2), limits, 100, 0.1).x, -0.5)
    none, failed = adam(noisy_bowl(), np.ones(2), FREE, 0, 0.1), adam(lambda x: (np.nan, x), np.ones(2), FREE, 9, 0.1)
    np.testing.assert_array_equal([none.x, failed.x], 1.0)
    assert (none.converged, failed.converged) == (True, False)


def bowl_with_a_wall(failure, at=300):
    calls = []

    def objective(x):
        calls.append(x.copy())
        if len(calls) > at:
            if failure is KeyboardInterrupt or failure is NotPositiveDefiniteError:
                raise failure
            return failure
        return ((x - 3.0) ** 2).sum(), 2.0 * (x - 3.0)

    return objective, calls


@pytest.mark.parametrize(
    "failure",
    [
        (np.nan, np.zeros(2)),
        (1.0, np.array([0.0, np.inf])),
        (1.0, np.array([0.0, 1e160])),
        NotPositiveDefiniteError,
        KeyboardInterrupt,
    ],
    ids=["nan", "infinite gradient", "gradient whose square overflows", "not positive definite", "Ctrl-C"],
)
@pytest.mark.parametrize("at", [8, 300])
def test_error_keeps_best_point(failure, at):
    objective, calls = bowl_with_a_wall(failure, at)
    monitor = Monitor()
    minimum = adam(objective, np.zeros(2), FREE, 1000, 0.1, monitor=monitor)
    assert monitor.stopped == (failure is KeyboardInterrupt)
    assert not minimum.converged
    assert minimum.n_iter == at
    assert any((minimum.x == x).all() for x in calls[:at])
    assert ((minimum.x - 3.0) ** 2).sum() < 0.9 * 18.0
