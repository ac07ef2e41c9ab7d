import numpy as np
import pytest
from scipy.optimize import minimize, rosen, rosen_der

from skevgp.solvers import LBFGS
from skevgp.solvers import lbfgs as solver
from skevgp.solvers.base import Guarded, Tolerance
from skevgp.solvers.lbfgs import curvature_units
from skevgp.utils.linalg import NotPositiveDefiniteError
from skevgp.utils.monitor import Monitor

FREE = (np.full(2, -np.inf), np.full(2, np.inf))


def lbfgs(objective, start, limits, max_iter, tolerance, monitor=None, alike=None):
    """With ``alike``, steps are scaled by the curvature of the objective."""
    tolerance = Tolerance(tolerance) if isinstance(tolerance, float) else tolerance
    monitor, curvature = monitor or Monitor(), None if alike is None else (objective, alike)
    return LBFGS().minimise(objective, start, limits, max_iter, tolerance, monitor, curvature)


def rosenbrock(x):
    value = 100.0 * (x[1] - x[0] ** 2) ** 2 + (1 - x[0]) ** 2
    return value, np.array([-400.0 * x[0] * (x[1] - x[0] ** 2) - 2.0 * (1 - x[0]), 200.0 * (x[1] - x[0] ** 2)])


def test_lbfgs_finds_the_minimum_and_reports_each_iteration():
    seen = []
    minimum = lbfgs(rosenbrock, np.array([-1.0, 2.0]), FREE, 200, 1e-12, Monitor(lambda *told: seen.append(told[:2])))
    np.testing.assert_allclose(minimum.x, 1.0, atol=1e-5)
    assert minimum.converged
    assert [i for i, _ in seen] == list(range(1, minimum.n_iter + 1))
    assert [loss for _, loss in seen] == minimum.loss_curve
    assert (np.diff(minimum.loss_curve) <= 1e-15).all()


def test_losses_far_above_the_best_grow_as_their_logarithm_with_the_slope_to_match():
    guarded = Guarded(lambda x: (float(np.exp(x[0])), np.exp(x)), np.zeros(1))
    assert guarded(np.zeros(1))[0] == 1.0  # the best; from 20 above it, a loss is far
    for x in (2.0, 5.0, 50.0):
        excess = np.exp(x) - 1.0
        expected = excess if excess < 20.0 else 20.0 * (1.0 + np.log(excess / 20.0))
        loss, slope = guarded(np.array([x]))
        assert loss == pytest.approx(1.0 + expected, rel=1e-12)
        nearby = [guarded(np.array([x + step]))[0] for step in (-1e-5, 1e-5)]
        assert slope[0] == pytest.approx((nearby[1] - nearby[0]) / 2e-5, rel=1e-6)


def test_function_without_coordinates_is_evaluated():
    nothing = np.zeros(0)
    minimum = lbfgs(lambda x: (3.0, nothing), nothing, (nothing, nothing), 10, 1e-9)
    assert (minimum.loss, minimum.converged) == (3.0, True)


def test_lbfgs_says_that_iterations_ran_out_and_none_keep_the_start():
    minimum = lbfgs(rosenbrock, np.array([-1.0, 2.0]), FREE, 3, 1e-12)
    assert (minimum.converged, minimum.n_iter) == (False, 3)
    minimum = lbfgs(rosenbrock, np.array([-1.0, 2.0]), FREE, 0, 1e-12)
    np.testing.assert_array_equal(minimum.x, [-1.0, 2.0])
    assert minimum.converged
    assert minimum.loss == rosenbrock(minimum.x)[0]


@pytest.mark.parametrize("failure", ["raise", "overflow", "nan", "infinite gradient"])
def test_lbfgs_comes_back_from_where_the_function_cannot_be_evaluated(failure):
    """A logarithmic barrier whose line searches step over the wall."""
    pull, outside = np.array([10.0, -30.0]), []

    def barrier(x):
        if (np.abs(x) >= 1.0).any():
            outside.append(x)
            if failure == "raise":
                raise NotPositiveDefiniteError("far out")
            if failure == "overflow":
                return float(np.full(2, 1e200) @ np.full(2, 1e200)), np.full(2, 1e200) ** 2
            return (np.nan, np.zeros(2)) if failure == "nan" else (-1e9, np.full(2, np.inf))
        return -np.log(1.0 - x**2).sum() - pull @ x, 2.0 * x / (1.0 - x**2) - pull

    minimum = lbfgs(barrier, np.zeros(2), FREE, 300, 1e-12)
    np.testing.assert_allclose(minimum.x, (-1.0 + np.sqrt(1.0 + pull**2)) / pull, atol=1e-6)
    assert outside


@pytest.mark.parametrize("seed", range(6))
def test_stall_is_not_the_end(seed):
    """In a bent valley of twenty columns three small steps in a row may lie far from the minimum at 0."""
    free = (np.full(20, -np.inf), np.full(20, np.inf))
    start = np.random.RandomState(seed).uniform(-2.0, 2.0, 20)
    minimum = lbfgs(lambda x: (rosen(x), rosen_der(x)), start, free, 1000, 0.03)
    assert minimum.converged
    assert minimum.loss < 1.0


def test_ctrl_c_keeps_the_best_point_so_far():
    calls = []

    def interrupted(x):
        calls.append(x)
        if len(calls) > 8:
            raise KeyboardInterrupt
        return rosenbrock(x)

    monitor = Monitor()
    minimum = lbfgs(interrupted, np.array([-1.0, 2.0]), FREE, 100, 0.1, monitor)
    assert monitor.stopped
    assert not minimum.converged
    assert rosenbrock(minimum.x)[0] < rosenbrock(np.array([-1.0, 2.0]))[0]


@pytest.mark.parametrize("seed", range(5))
def test_rounding_errors_do_not_end_the_way(seed):
    """A loss with errors far above the tolerance, as near a singular matrix: the best is as good as they allow."""
    directions = np.random.RandomState(seed).randn(2)

    def rough(x):
        value, gradient = rosenbrock(x)
        return value + 1e-9 * np.sin(1e13 * (x @ directions)), gradient

    assert lbfgs(rough, np.array([-1.0, 2.0]), FREE, 500, 1e-12).loss < 1e-6


def test_rounding_errors_above_the_tolerance_are_not_searched_for_a_lower_one(monkeypatch):
    """The first step leads to the minimum at 0, where the loss has no error. It has one a hair away."""
    starts = []
    monkeypatch.setattr(solver, "minimize", lambda *told, **options: starts.append(0) or minimize(*told, **options))
    minimum = lbfgs(lambda x: (0.5 * x @ x + 1e-4 * (x != 0.0).any(), x), np.array([1.0, 0.0]), FREE, 500, 1e-12)
    assert minimum.converged
    assert minimum.loss == 0.0
    assert len(starts) == 1


def test_tolerance_that_is_a_share_of_the_gain_ends_a_long_way_sooner_and_near():
    def valley(x):
        return rosen(x), rosen_der(x)

    start, free = np.full(20, -1.0), (np.full(20, -np.inf), np.full(20, np.inf))
    origin = rosen(start)
    full = lbfgs(valley, start, free, 1000, 1e-9)
    near = lbfgs(valley, start, free, 1000, Tolerance(1e-9, 1e-4, origin))
    assert near.converged
    assert near.n_iter < full.n_iter
    assert origin - near.loss > 0.97 * (origin - full.loss)


# --- units of coordinates from the curvature of a loss ----------------------------------------------------------------

EACH = np.arange(4)


def quadratic(H):
    return lambda x: (0.5 * float(x @ H @ x), H @ x)


def test_diagonal_of_a_quadratic_is_found_exactly_whatever_the_number_of_probes():
    curvature = np.array([1.0, 4.0, 0.01, 25.0])
    for n_probes in (1, 8):
        units = curvature_units(quadratic(np.diag(curvature)), np.ones(4), EACH, n_probes)
        np.testing.assert_allclose(units, 1.0 / np.sqrt(curvature), rtol=1e-6)


def test_coordinates_that_are_alike_have_one_unit_also_where_the_curvature_is_negative():
    H = np.diag([1.0, 3.0, -2.0, -6.0])
    units = curvature_units(quadratic(H), np.ones(4), np.array([7, 7, 2, 2]), 3)
    np.testing.assert_allclose(units, [2**-0.5, 2**-0.5, 0.5, 0.5], rtol=1e-6)


def test_with_units_a_badly_scaled_valley_is_a_few_iterations_long():
    scale = 10.0 ** np.linspace(-1, 2, 30)

    def valley(x):
        z = x * scale
        return float(np.sum(z**2 + 0.1 * z**4)), scale * (2.0 * z + 0.4 * z**3)

    start, limits = 1.0 / scale, (np.full(30, -np.inf), np.full(30, np.inf))
    plain = lbfgs(valley, start, limits, 300, 1e-12)
    scaled = lbfgs(valley, start, limits, 300, 1e-12, alike=np.arange(30))
    assert plain.converged
    assert scaled.converged
    assert max(plain.loss, scaled.loss) < 1e-9
    assert scaled.n_iter < 0.7 * plain.n_iter
