"""Coordinates along the curvature that an earlier search saw."""

import numpy as np
import pytest

from skevgp.solvers import LBFGS
from skevgp.solvers.base import Tolerance
from skevgp.solvers.coordinates import Metric
from skevgp.utils.monitor import Monitor

RNG = np.random.RandomState(0)
D = 6
ROOT = RNG.standard_normal((D, D)) * 10.0 ** np.linspace(-1.0, 1.0, D)
HESSIAN = ROOT @ ROOT.T
UNIT = 10.0 ** RNG.uniform(-1.0, 1.0, D)
FREE = (np.full(D, -np.inf), np.full(D, np.inf))


def quadratic(x):
    return 0.5 * float(x @ HESSIAN @ x), HESSIAN @ x


def pairs_of(steps):
    return tuple((s, HESSIAN @ s) for s in steps)


def metric_of(n_pairs, x):
    return Metric(pairs_of(RNG.standard_normal((n_pairs, D))), x)


def inverse_hessian(coordinates):
    """L Lᵀ from the pullbacks of unit gradients."""
    columns = np.array([coordinates.pulled_back(e) for e in np.eye(D)]) / coordinates.size
    return columns @ columns.T


def test_inverse_hessian_is_that_of_bfgs():
    """The textbook's update (Nocedal & Wright 2006, eq. 6.17). A pair without positive curvature does not count."""
    x, steps = RNG.standard_normal(D), RNG.standard_normal((10, D))
    pairs = (*pairs_of(steps[:5]), (steps[5], -steps[5]), *pairs_of(steps[6:]))
    expected = np.diag(UNIT**2)
    for s, y in pairs:
        if s @ y > 0.0:
            left = np.eye(D) - np.outer(s, y) / (s @ y)
            expected = left @ expected @ left.T + np.outer(s, s) / (s @ y)
    coordinates = Metric(pairs, x).coordinates(UNIT, FREE, x, HESSIAN @ x)
    np.testing.assert_allclose(inverse_hessian(coordinates), expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())
    gradient = RNG.standard_normal(D)
    assert coordinates.promised(x, gradient) == pytest.approx(0.5 * gradient @ expected @ gradient, rel=1e-6)


def test_coordinates_that_changed_since_keep_their_unit():
    x = RNG.standard_normal(D)
    metric = metric_of(8, x)
    moved = x + np.eye(D)[2]
    found = inverse_hessian(metric.coordinates(UNIT, FREE, moved, np.ones(D)))
    np.testing.assert_allclose(found[2], UNIT[2] ** 2 * np.eye(D)[2], rtol=1e-12)


def test_points_stay_within_limits_and_gradients_follow_them():
    """One coordinate is at its limit and pulled outwards, and another one meets its limit on the way."""
    x = RNG.standard_normal(D)
    gradient = HESSIAN @ x
    limits = x - 10.0, x + 10.0
    limits[0][1] = limits[1][1] = x[1]
    coordinates = metric_of(8, x).coordinates(UNIT, limits, x, gradient)
    z = 0.1 * RNG.standard_normal(D)
    limits[1][3] = x[3] + 0.5 * abs(coordinates.at(z)[0][3] - x[3])
    limits[0][3] = x[3] - 0.5 * abs(coordinates.at(z)[0][3] - x[3])
    point, pull_back = coordinates.at(z)
    assert point[1] == x[1]
    assert point[3] in (limits[0][3], limits[1][3])
    assert (limits[0] <= point).all()
    assert (point <= limits[1]).all()
    numeric = [
        (quadratic(coordinates.at(z + h)[0])[0] - quadratic(coordinates.at(z - h)[0])[0]) / 2e-5
        for h in 1e-5 * np.eye(D)
    ]
    np.testing.assert_allclose(pull_back(HESSIAN @ point), numeric, rtol=1e-5, atol=1e-6 * np.abs(numeric).max())
    # No coordinate moves by more than 1 in the first trial step, which has length 1.
    first = coordinates.at(np.zeros(D))[1](gradient)
    assert np.abs(coordinates.moved(first / np.linalg.norm(first))).max() <= 1.0 + 1e-12


def test_search_that_continues_needs_few_evaluations_and_may_leave_a_limit():
    """From the end of a search of nearly the same function, whose optimum has a coordinate at its limit."""
    target = RNG.standard_normal(D)
    limits = (FREE[0].copy(), FREE[1].copy())
    limits[1][0] = target[0] - 0.5
    calls = []

    def near(shift):
        def function(x):
            calls.append(x)
            loss, gradient = quadratic(x - target - shift)
            return loss + 0.01 * float(np.sum((x - target) ** 4)), gradient + 0.04 * (x - target) ** 3

        return function

    def search(function, start, metric):
        calls.clear()
        curvature = (function, np.arange(D))
        found = LBFGS().minimise(function, start, limits, 200, Tolerance(1e-9), Monitor(), curvature, metric)
        return found, len(calls)

    first, _ = search(near(0.0), np.zeros(D), None)
    assert first.x[0] == limits[1][0]
    # The second function has its optimum within the limits.
    shift = np.r_[-1.0, np.full(D - 1, 0.05)]
    cold, n_cold = search(near(shift), first.x, None)
    warm, n_warm = search(near(shift), first.x, first.metric)
    assert warm.converged
    assert warm.x[0] < limits[1][0]
    assert warm.loss == pytest.approx(cold.loss, abs=1e-7)
    assert n_warm < 0.7 * n_cold


def test_coordinate_at_its_limit_is_released_before_the_end():
    """Along the curvature, the second coordinate is at its optimum at once. The first one leaves its limit later."""

    def function(x):
        loss = x[0] * (1.0 - 1000.0 * x[1]) + 0.5 * x[0] ** 2 + 0.5 * (x[1] - 0.01) ** 2
        return float(loss), np.array([1.0 - 1000.0 * x[1] + x[0], x[1] - 0.01 - 1000.0 * x[0]])

    limits, pair = (np.zeros(2), np.array([10.0, 1.0])), np.array([0.0, 1e-3])
    metric, curvature = Metric(((pair, pair),), np.zeros(2)), (function, np.arange(2))
    found = LBFGS().minimise(function, np.zeros(2), limits, 200, Tolerance(1e-4), Monitor(), curvature, metric)
    assert found.converged
    np.testing.assert_allclose(found.x, [10.0, 1.0])
