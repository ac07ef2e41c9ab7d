import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import least_squares

from skevgp.robots import (
    from_pseudo_inertia,
    inertial_parameters,
    load_robot,
    nearest_consistent,
    physical_consistency,
    pseudo_inertia,
    with_parameters,
)

UR10 = inertial_parameters(load_robot("ur10"))
SIZES = 0.5 * (np.abs(UR10).ravel() + 0.02)


def estimate(seed, deviations=1.0, keep=1.0):
    """A wrong mean around the UR10's parameters, and its covariance: ``deviations`` of random directions."""
    rng = np.random.default_rng(seed)
    directions = np.linalg.qr(rng.normal(size=(60, 60)))[0]
    factor = (SIZES * keep)[:, None] * directions * deviations
    return UR10 + (factor @ rng.normal(size=60)).reshape(UR10.shape), factor @ factor.T


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

    def off(theta):
        factor = np.zeros((4, 4))
        factor[lower] = theta
        return whiten @ (from_pseudo_inertia(factor @ factor.T) - mean[0])

    return (
        2.0 * least_squares(off, np.random.default_rng(seed).normal(size=10), xtol=1e-10, ftol=1e-10, max_nfev=300).cost
    )


@pytest.mark.parametrize("seed", range(6))
def test_no_start_of_a_local_solver_gets_nearer(seed):
    mean, covariance = one_link(seed)
    assert physical_consistency(mean)[0] < 0.0
    found = nearest_consistent(mean, covariance, margin=1e-8)
    assert physical_consistency(found)[0] > 0.0
    nearest = min(by_cholesky_factors(mean, covariance, start) for start in range(4))
    assert_allclose(distance(found, mean, covariance), nearest, rtol=1e-3)
    assert distance(found, mean, covariance) < nearest * (1.0 + 1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_no_way_to_another_robot_that_can_be_gets_nearer(seed):
    """The problem is convex: what is nearest has no direction down towards any other admissible point."""
    mean, covariance = estimate(seed)
    found = nearest_consistent(mean, covariance, margin=1e-8)
    gradient = np.linalg.solve(covariance, (found - mean).ravel())
    factors = np.random.default_rng(seed).normal(size=(2000, 6, 4, 4)) * 10.0 ** np.random.default_rng(1).uniform(
        -3.0, 1.0, (2000, 6, 1, 1)
    )
    others = np.concatenate([[UR10], from_pseudo_inertia(factors @ factors.swapaxes(-2, -1))])
    slopes = (others - found).reshape(len(others), -1) @ gradient
    assert slopes.min() > -1e-5 * np.abs(slopes).max()
    assert distance(found, mean, covariance) > 1.0


def test_it_is_nearer_than_a_repair_link_by_link():
    mean, covariance = estimate(0)
    values, vectors = np.linalg.eigh(pseudo_inertia(mean))
    clipped = from_pseudo_inertia((vectors * np.maximum(values, 1e-6)[:, None]) @ vectors.swapaxes(-2, -1))
    found = nearest_consistent(mean, covariance)
    assert distance(found, mean, covariance) < 0.5 * distance(clipped, mean, covariance)


@pytest.mark.parametrize("covariance", [np.eye(60), np.zeros((60, 60))], ids=["free", "pinned"])
def test_a_consistent_mean_is_returned_as_it_is(covariance):
    found = nearest_consistent(UR10, covariance)
    assert_array_equal(found, UR10)
    assert not np.shares_memory(found, UR10)


def test_the_margin_is_kept_and_a_wider_one_costs_more():
    mean, covariance = estimate(1)
    found = [nearest_consistent(mean, covariance, margin=margin) for margin in (1e-8, 1e-4, 1e-2)]
    consistency = [physical_consistency(parameters).min() for parameters in found]
    assert 0.0 < consistency[0] < 1e-6 < 1e-5 < consistency[1] < 1e-3 < consistency[2]
    assert np.all(np.diff([distance(parameters, mean, covariance) for parameters in found]) > 0.0)


def test_a_consistent_link_that_nothing_ties_to_others_stays():
    mean, covariance = UR10.copy(), np.diag(SIZES**2)
    mean[3, 4] = 5.0
    found = nearest_consistent(mean, covariance)
    others = [0, 1, 2, 4, 5]
    assert_allclose(found[others], mean[others], rtol=1e-6, atol=1e-9)
    assert abs(found[3, 4] - 5.0) > 0.1


# --- what the data know --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("known", [1e-4, 1e-6, 1e-8])
def test_torques_that_are_well_known_stay(known):
    """Directions that trajectories show have a small variance, those that they do not show the prior's."""
    model, rng = load_robot("ur10"), np.random.default_rng(0)
    data = model.createData()
    rows = [pinocchio.computeJointTorqueRegressor(model, data, *rng.uniform(-2.0, 2.0, (3, 6))) for _ in range(100)]
    regressor = np.concatenate(rows)
    values, vectors = np.linalg.eigh(regressor.T @ regressor / len(rows) * np.outer(SIZES, SIZES))
    seen = values > 1e-8 * values[-1]
    assert 30 <= seen.sum() <= 45
    deviations = np.where(seen, known, 1.0)
    factor = SIZES[:, None] * vectors * deviations
    mean = UR10 + (factor @ rng.normal(size=60)).reshape(UR10.shape)
    assert physical_consistency(mean).min() < -0.1
    found = nearest_consistent(mean, factor @ factor.T)
    assert physical_consistency(found).min() > 0.0
    torque = regressor @ mean.ravel()
    moved = regressor @ (found - mean).ravel()
    assert np.sqrt(np.mean(moved**2)) < 10.0 * known * np.sqrt(np.mean(torque**2)) + 1e-12
    assert np.abs(found - mean).max() > 0.01


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e4])
@pytest.mark.parametrize("kind", ["plain", "stiff", "flat", "pinned"])
def test_scales_do_not_matter_however_far_apart_deviations_are(kind, scale):
    deviations = np.ones(60)
    deviations[:20] = {"stiff": 1e-8, "flat": 1e4}.get(kind, 1.0)
    keep = np.ones(60)
    keep[1::3] = 0.0 if kind == "pinned" else 1.0
    mean, covariance = estimate(0, deviations, keep)
    assert physical_consistency(mean).min() < 0.0
    found = nearest_consistent(mean * scale, covariance * scale**2)
    assert physical_consistency(found).min() > 0.0
    assert_allclose(found / scale, nearest_consistent(mean, covariance), rtol=1e-5, atol=1e-6 * np.abs(mean).max())
    assert_array_equal(found.ravel()[keep == 0.0], (mean * scale).ravel()[keep == 0.0])


@pytest.mark.parametrize("pinned", [slice(0, 60), slice(20, 30), slice(20, 21)], ids=["all", "link", "mass"])
def test_what_is_pinned_where_nothing_can_be_moves_all_the_same(pinned):
    mean, keep = UR10.copy(), np.ones(60)
    mean[2, 0], keep[pinned] = -1.0, 0.0
    covariance = np.diag(SIZES**2 * keep)
    found = nearest_consistent(mean, covariance)
    assert physical_consistency(found).min() > 0.0
    assert found[2, 0] < UR10[2, 0]


def test_links_that_are_no_bodies_stay_none():
    mean, covariance = estimate(0)
    mean[4], keep = 0.0, np.ones(60)
    keep[40:50] = 0.0
    found = nearest_consistent(mean, covariance * np.outer(keep, keep))
    assert_array_equal(found[4], 0.0)
    assert physical_consistency(np.delete(found, 4, axis=0)).min() > 0.0
    with_parameters(load_robot("ur10"), found)


@pytest.mark.parametrize(
    "mean", [np.zeros((2, 10)), -np.ones((2, 10)), np.full((2, 10), 1e-30)], ids=["0", "-", "tiny"]
)
def test_a_mean_that_says_nothing_has_an_answer(mean):
    assert physical_consistency(nearest_consistent(mean, np.eye(20))).min() > 0.0


@pytest.mark.filterwarnings("ignore::skevgp.exceptions.RobotModelWarning")
@pytest.mark.parametrize("name", ["icub", "romeo_small"])
def test_robots_whose_files_no_body_can_have(name):
    mean = inertial_parameters(load_robot(name))
    assert physical_consistency(mean).min() < 0.0
    found = nearest_consistent(mean, np.diag((0.1 * np.abs(mean).ravel() + 1e-3) ** 2))
    assert physical_consistency(found).min() > 0.0


@pytest.mark.parametrize("seed", range(12))
def test_covariances_of_all_kinds_have_an_answer(seed):
    """Singular ones too, whose deviations differ by up to 1e8 beside pinned parameters."""
    rng = np.random.default_rng(seed)
    n = 10 * rng.integers(1, 5)
    factor = 10.0 ** rng.uniform(-3, 1, (n, 1)) * rng.normal(size=(n, n)) * 10.0 ** -rng.uniform(0, 8, n)
    factor[rng.random(n) < [0.0, 0.1, 0.5, 0.9][seed % 4]] = 0.0
    scale = 10.0 ** rng.uniform(-6, 4)
    found = nearest_consistent(rng.normal(size=(n // 10, 10)) * scale, factor @ factor.T * scale**2)
    assert physical_consistency(found).min() > 0.0


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
def test_wrong_arguments_are_named(changed, message):
    with pytest.raises(ValueError, match=message):
        nearest_consistent(**{"mean": np.ones((1, 10)), "covariance": np.eye(10), **changed})
