"""Units of coordinates from the curvature of a loss."""

import numpy as np
import pytest

from skevgp.solvers.curvature import curvature_units
from skevgp.solvers.lbfgs import lbfgs
from skevgp.utils.linalg import NotPositiveDefiniteError

EACH = np.arange(4)


def quadratic(H):
    return lambda x: (0.5 * float(x @ H @ x), H @ x)


def test_the_diagonal_of_a_quadratic_is_found_exactly_whatever_the_number_of_probes():
    curvature = np.array([1.0, 4.0, 0.01, 25.0])
    for n_probes in (1, 8):
        units = curvature_units(quadratic(np.diag(curvature)), np.ones(4), EACH, n_probes)
        np.testing.assert_allclose(units, 1.0 / np.sqrt(curvature), rtol=1e-6)


def test_coordinates_that_are_alike_have_one_unit_also_where_the_curvature_is_negative():
    H = np.diag([1.0, 3.0, -2.0, -6.0])
    units = curvature_units(quadratic(H), np.ones(4), np.array([7, 7, 2, 2]), 3)
    np.testing.assert_allclose(units, [2**-0.5, 2**-0.5, 0.5, 0.5], rtol=1e-6)


def test_other_entries_of_the_hessian_do_not_make_units_longer_in_the_mean():
    rng = np.random.RandomState(0)
    A = rng.randn(60, 60)
    H = A @ A.T + 10.0 * np.eye(60)
    units = curvature_units(quadratic(H), rng.randn(60), np.zeros(60, dtype=int), 8)
    assert 0.5 * np.diag(H).mean() ** -0.5 < units[0] < 1.05 * np.diag(H).mean() ** -0.5


def test_a_flat_coordinate_has_a_long_unit_and_not_an_endless_one():
    units = curvature_units(quadratic(np.diag([0.0, 1e-12, 1.0, 1e8])), np.ones(4), EACH, 2)
    np.testing.assert_allclose(units, [100.0, 100.0, 1.0, 0.1], rtol=1e-6)


@pytest.mark.parametrize("gradient", [NotPositiveDefiniteError("no"), np.nan, np.inf])
def test_where_the_loss_cannot_be_evaluated_units_are_one(gradient):
    def objective(x):
        if isinstance(gradient, Exception):
            raise gradient
        return 0.0, np.full(4, gradient)

    np.testing.assert_array_equal(curvature_units(objective, np.ones(4), EACH, 2), np.ones(4))


def test_nothing_to_move_is_no_error():
    assert curvature_units(lambda x: (0.0, x), np.empty(0), np.empty(0, dtype=int), 2).shape == (0,)


def test_with_units_a_badly_scaled_valley_is_a_few_iterations_long():
    scale = 10.0 ** np.linspace(-1, 2, 30)

    def valley(x):
        z = x * scale
        return float(np.sum(z**2 + 0.1 * z**4)), scale * (2.0 * z + 0.4 * z**3)

    start, limits = 1.0 / scale, (np.full(30, -np.inf), np.full(30, np.inf))
    plain = lbfgs(valley, start, limits, 300, 1e-12)
    scaled = lbfgs(valley, start, limits, 300, 1e-12, units=lambda x: curvature_units(valley, x, np.arange(30), 2))
    assert plain.converged
    assert scaled.converged
    assert max(plain.loss, scaled.loss) < 1e-9
    assert scaled.n_iter < 0.7 * plain.n_iter
