"""What goes to a peer and what comes back: units and the clock."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal


def test_bounds_of_scaled_targets_are_in_the_users_units():
    from peers.jobs import Job, Scaled

    rng = np.random.RandomState(0)
    X, Y = rng.randn(20, 2), rng.randn(20, 3) * [1e-3, 1.0, 50.0]
    job = Job(X, Y, X, X[:4], np.ones(2), 0.1, "none", 10, 1.0, 0)
    scaled = Scaled(job)
    K = np.exp(-0.5 * ((X[:, np.newaxis] - X) ** 2).sum(axis=2)) + 0.1 * np.eye(20)
    for o, columns in enumerate(scaled.models):
        inside = multivariate_normal(np.zeros(20), K).logpdf(scaled.Y[:, o])
        outside = multivariate_normal(np.zeros(20), K * scaled.unit[o] ** 2).logpdf(Y[:, o])
        assert scaled.bound(inside, columns) == pytest.approx(outside, abs=1e-9)
    assert Scaled(Job(X, Y, X, X[:4], np.ones(2), 0.1, "all", 10, 1.0, 0)).models == [[0, 1, 2]]


def test_the_curve_is_the_sum_of_the_best_bounds_so_far():
    from peers.jobs import Watch

    watch = Watch(100.0, 2)
    for model, bound in ((0, -5.0), (0, -7.0), (0, -2.0), (1, -9.0), (1, -1.0)):
        watch.record(model, bound)
    seconds, cpu_seconds, bound = watch.curve()
    assert Watch(100.0, 1).curve().shape == (3, 0)
    # Model 1 counts with its first bound, -9, before it begins.
    np.testing.assert_array_equal(bound, [-14.0, -14.0, -11.0, -11.0, -3.0])
    assert (np.diff(seconds) >= 0.0).all()
    assert (np.diff(cpu_seconds) >= 0.0).all()
    assert watch.deadline(0) == pytest.approx(50.0, abs=1.0)


def test_a_fit_is_looked_at_as_it_was_at_a_time():
    from peers.jobs import Job, Scaled, Watch

    X, Y = np.array([[-1.0], [1.0]]), np.array([[2.0, 3.0], [-2.0, 3.0]])
    scaled, watch = Scaled(Job(X, Y, X, X, np.ones(1), 0.1, "none", 10, 1.0, 0)), Watch(100.0, 2)
    watch.records = [(1.0, 1.5, 0, -5.0), (2.0, 2.5, 0, -4.0), (4.0, 4.5, 1, -9.0), (5.0, 5.5, 1, -1.0)]

    def predicts(value):
        return lambda X: (np.full(len(X), value), np.full((len(X), 1), value))

    # The second model begins at 3.
    ways = [[(1.0, predicts(1.0)), (2.0, predicts(2.0))], [(3.0, predicts(3.0)), (5.0, predicts(4.0))]]
    fitted = scaled.fitted(ways, watch, bounds=[-4.0, -1.0], stop="converged")
    expected = {0.5: (1.0, -14.0, 1.0, 3.0), 2.5: (2.0, -13.0, 2.0, 3.0), 6.0: (5.0, -5.0, 2.0, 4.0)}
    for seconds, (at, bound, *values) in expected.items():
        checkpoint = fitted.at(seconds)
        assert (checkpoint.seconds, checkpoint.cpu_seconds, checkpoint.bound) == (at, at + 0.5, bound)
        for part in checkpoint.predict(X):
            np.testing.assert_allclose(part, np.multiply(values, [[2.0, 3.0]] * 2))
    for part in fitted.predict(X):
        np.testing.assert_allclose(part, [[4.0, 12.0]] * 2)
