"""max_time: a fit ends in time, with the best so far."""

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.solvers import LBFGS
from skevgp.utils.monitor import Monitor

rng = np.random.RandomState(0)
X = rng.uniform(-2.0, 2.0, (120, 2))
Y = np.column_stack([np.sin(2.0 * X[:, 0]), X[:, 1] ** 2, X[:, 0] * X[:, 1]]) + 0.05 * rng.randn(120, 3)


class Clock:
    """Seconds that pass when they are told to."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def iterations(monitor, clock, most=100, seconds=1.0):
    """How many iterations of so many seconds each a monitor lets happen."""
    n = 0
    with monitor.keeping_the_best():
        for n in range(1, most + 1):
            clock.now += seconds
            monitor.iteration(n, 0.0)
    return n


def test_part_of_the_fit_ends_with_its_share_of_the_time_and_the_others_go_on():
    clock = Clock()
    monitor = Monitor(max_time=30.0, clock=clock)
    first = monitor.with_time(1.0 / 3.0)
    assert iterations(first.seen_as(n_before=1), clock) == 10
    assert first.stopped
    assert not monitor.stopped
    assert monitor.out_of_time
    # What the second leaves goes to the third.
    second = monitor.with_time(0.5)
    assert iterations(second, clock, most=4) == 4
    assert not second.stopped
    assert iterations(monitor.with_time(1.0), clock) == 16


@pytest.mark.parametrize("sharing", ["auto", "all", "none", [[0, 1], [2]]])
@pytest.mark.parametrize("n_jobs", [1, 2])
def test_when_it_is_over_the_best_so_far_is_kept(sharing, n_jobs):
    model = EVGPRegressor(n_inducing=10, sharing=sharing, solver=LBFGS(max_time=1e-9), n_jobs=n_jobs, random_state=0)
    with pytest.warns(ConvergenceWarning, match=r"ended at max_time=1e-09 seconds after 1 iterations"):
        model.fit(X, Y)
    assert model.n_iter_ == 1
    assert np.isfinite(model.predict(X)).all()


@pytest.mark.parametrize("max_time", [0, -1.0, "10"])
def test_invalid_max_time_raises(max_time):
    with pytest.raises((ValueError, TypeError), match="max_time of LBFGS must be"):
        EVGPRegressor(solver=LBFGS(max_time=max_time)).fit(X, Y)
    with pytest.raises(ValueError, match="The 'max_time' parameter of EGPRegressor must be"):
        EGPRegressor(max_time=max_time).fit(X, Y)
