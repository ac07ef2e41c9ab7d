import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import least_squares

from skevgp.robots import (
    from_pseudo_inertia,
    inertial_parameters,
    load_robot,
    nearest_consistent,
    physical_consistency,
)

UR10 = inertial_parameters(load_robot("ur10"))[:3]
SIZES = 0.5 * (np.abs(UR10).ravel() + 0.02)


def estimate(seed, deviations=1.0, keep=1.0):
    """A wrong mean around the UR10's parameters, and its covariance: ``deviations`` of random directions."""
    rng = np.random.default_rng(seed)
    directions = np.linalg.qr(rng.normal(size=(UR10.size, UR10.size)))[0]
    factor = (SIZES * keep)[:, None] * directions * deviations
    return UR10 + (factor @ rng.normal(size=UR10.size)).reshape(UR10.shape), factor @ factor.T


def distance(parameters, mean, covariance):
    off = (parameters - mean).ravel()
    return off @ np.linalg.solve(covariance, off)


def one_link(seed):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(10, 10))
    return rng.normal(size=(1, 10)), factor @ factor.T + 0.1 * np.eye(10)


def by_cholesky_factors(mean, covariance, seed):
    """The distance that a local solver reaches from a random start: J = L Lᵀ."""
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    lower = np.tril_indices(4)
    symmetric = np.eye(16).reshape(-1, 4, 4) + np.eye(16).reshape(-1, 4, 4).swapaxes(1, 2)
    linear = np.column_stack([from_pseudo_inertia(0.5 * one) for one in symmetric])

    units = np.zeros((10, 4, 4))
    units[np.arange(10), *lower] = 1.0

    def factor(theta):
        return np.einsum("t,tij->ij", theta, units)

    def off(theta):
        return whiten @ (linear @ (factor(theta) @ factor(theta).T).ravel() - mean[0])

    def slopes(theta):
        products = units @ factor(theta).T
        return whiten @ linear @ (products + products.swapaxes(1, 2)).reshape(10, 16).T

    start = np.random.default_rng(seed).normal(size=10)
    return 2.0 * least_squares(off, start, slopes, xtol=1e-10, ftol=1e-10, max_nfev=300).cost


@pytest.mark.parametrize("seed", range(3))
def test_no_start_of_a_local_solver_gets_nearer(seed):
    mean, covariance = one_link(seed)
    assert physical_consistency(mean)[0] < 0.0
    found = nearest_consistent(mean, covariance, margin=1e-8)
    assert physical_consistency(found)[0] > 0.0
    nearest = min(by_cholesky_factors(mean, covariance, start) for start in range(4))
    assert_allclose(distance(found, mean, covariance), nearest, rtol=1e-3)
    assert distance(found, mean, covariance) < nearest * (1.0 + 1e-5)


@pytest.mark.parametrize("covariance", [np.eye(UR10.size), np.zeros((UR10.size, UR10.size))], ids=["free", "pinned"])
def test_consistent_mean_is_returned_as_it_is(covariance):
    found = nearest_consistent(UR10, covariance)
    assert_array_equal(found, UR10)
    assert not np.shares_memory(found, UR10)


def test_margin_is_kept_and_a_wider_one_costs_more():
    mean, covariance = estimate(1)
    found = [nearest_consistent(mean, covariance, margin=margin) for margin in (1e-8, 1e-4, 1e-2)]
    consistency = [physical_consistency(parameters).min() for parameters in found]
    assert 0.0 < consistency[0] < 1e-6 < 1e-5 < consistency[1] < 1e-3 < consistency[2]
    assert np.all(np.diff([distance(parameters, mean, covariance) for parameters in found]) > 0.0)


# --- what the data know --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "scale"), [("plain", 1e-6), ("stiff", 1.0), ("flat", 1e4), ("pinned", 1e-6)])
def test_scales_do_not_matter_however_far_apart_deviations_are(kind, scale):
    deviations = np.ones(UR10.size)
    deviations[:10] = {"stiff": 1e-8, "flat": 1e4}.get(kind, 1.0)
    keep = np.ones(UR10.size)
    keep[1::3] = 0.0 if kind == "pinned" else 1.0
    mean, covariance = estimate(0, deviations, keep)
    assert physical_consistency(mean).min() < 0.0
    found = nearest_consistent(mean * scale, covariance * scale**2)
    assert physical_consistency(found).min() > 0.0
    assert_allclose(found / scale, nearest_consistent(mean, covariance), rtol=1e-5, atol=1e-6 * np.abs(mean).max())
    assert_array_equal(found.ravel()[keep == 0.0], (mean * scale).ravel()[keep == 0.0])


# --- arguments -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"mean": np.ones(10)}, r"mean must have the shape \(n_links, 10\); got \(10,\)"),
        ({"mean": np.full((1, 10), np.inf)}, "mean must be finite"),
        ({"covariance": np.eye(9)}, r"covariance must have the shape .* = \(10, 10\); got \(9, 9\)"),
        ({"covariance": np.eye(10) * np.nan}, "covariance must be finite"),
        ({"covariance": -np.eye(10)}, "variances not negative"),
        ({"margin": 0.0}, "margin must be finite and above 0"),
        ({"margin": 0.2}, r"margin must be in \(0, 0\.1\]; got 0\.2"),
    ],
)
def test_invalid_arguments_raise(changed, message):
    with pytest.raises(ValueError, match=message):
        nearest_consistent(**{"mean": np.ones((1, 10)), "covariance": np.eye(10), **changed})
