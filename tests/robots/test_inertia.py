import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from skevgp.robots import (
    body_parameters,
    inertial_parameters,
    load_robot,
    physical_consistency,
    pseudo_inertia,
    with_parameters,
)

ROBOTS = ["iiwa14", "panda", "ur10", "talos_left_arm"]


def of_points(points, masses):
    """The parameters of point masses, from first principles."""
    inertia = sum(m * (p @ p * np.eye(3) - np.outer(p, p)) for p, m in zip(points, masses, strict=True))
    return np.r_[sum(masses), masses @ points, inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]]


def body(seed, n=8):
    rng = np.random.default_rng(seed)
    return of_points(rng.normal(size=(n, 3)) + 0.5, rng.uniform(0.1, 1.0, n))


def of_moments(moments, mass=2.0, lever=(0.0, 0.0, 0.0)):
    lever = np.array(lever)
    inertia = np.diag(moments) + mass * (lever @ lever * np.eye(3) - np.outer(lever, lever))
    return np.r_[mass, mass * lever, inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]]


# --- parameters and pseudo-inertias --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ROBOTS)
def test_torques_are_linear_in_the_parameters(name):
    model = load_robot(name)
    model.armature = np.zeros(model.nv)
    rng, data = np.random.default_rng(0), model.createData()
    q, v, a = rng.uniform(-1.0, 1.0, (3, model.nv))
    regressor = pinocchio.computeJointTorqueRegressor(model, data, q, v, a)
    parameters = inertial_parameters(model)
    assert parameters.shape == (model.nv, 10)
    assert_allclose(regressor @ parameters.ravel(), pinocchio.rnea(model, data, q, v, a), rtol=1e-9, atol=1e-10)


def test_pseudo_inertia_is_the_sum_over_points_of_their_homogeneous_coordinates():
    rng = np.random.default_rng(0)
    points, masses = rng.normal(size=(6, 3)), rng.uniform(0.1, 1.0, 6)
    homogeneous = np.column_stack([points, np.ones(6)])
    assert_allclose(pseudo_inertia(of_points(points, masses)), homogeneous.T * masses @ homogeneous, rtol=1e-12)


# --- consistency ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        (of_moments([1.0, 1.0, 1.0]), 1.0),
        (of_moments([1.0, 1.0, 1.0], lever=[0.3, -0.2, 5.0]), 1.0),
        (of_moments([1.0, 1.0, 2.0]), 0.0),  # a plate
        (of_moments([1.0, 1.0, 0.0]), 0.0),  # a rod
        (of_moments([1.0, 1.0, 4.0]), -0.6),  # second moments 2, 2, -1: against the triangle inequality
        (of_moments([-1.0, -1.0, -1.0]), -1.0),
        (-of_moments([1.0, 1.0, 1.0]), -1.0),
        (np.r_[-1.0, np.zeros(3), of_moments([1.0, 1.0, 1.0])[4:]], -1.0),
        (np.r_[0.0, np.zeros(3), of_moments([1.0, 1.0, 1.0])[4:]], 0.0),
        (np.r_[0.0, 1.0, np.zeros(8)], -1.0),  # a first moment without a mass
        (np.r_[1e-300, 1e300, np.zeros(8)], -1.0),
        (np.r_[1.0, np.zeros(9)], 0.0),
        (np.zeros(10), 0.0),
    ],
)
def test_measure_of_consistency(parameters, expected):
    assert_allclose(physical_consistency(parameters), expected, atol=1e-12)


# --- mass, centre, inertia -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_body_parameters_are_pinocchios_with_their_derivatives(seed):
    parameters = body(seed)
    values, jacobian = body_parameters(parameters)
    link = pinocchio.Inertia.FromDynamicParameters(parameters)
    inertia = link.inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    assert_allclose(values, np.r_[link.mass, link.lever, inertia], rtol=1e-10, atol=1e-12)
    h = 1e-6
    differences = [
        (body_parameters(parameters + h * e)[0] - body_parameters(parameters - h * e)[0]) / (2 * h) for e in np.eye(10)
    ]
    assert_allclose(jacobian, np.transpose(differences), rtol=1e-6, atol=1e-7)


# --- models --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ROBOTS)
def test_model_gets_its_parameters_and_the_given_one_stays(name):
    model = load_robot(name)
    before, expected = model.copy(), inertial_parameters(model) * 1.3
    changed = with_parameters(model, expected, armature=0.2, damping=np.arange(model.nv), friction=0.4)
    assert model == before
    assert_allclose(inertial_parameters(changed), expected, rtol=1e-12, atol=1e-14)
    assert_array_equal(changed.armature, np.full(model.nv, 0.2))
    assert_array_equal(changed.damping, np.arange(model.nv))
    assert_array_equal(changed.friction, np.full(model.nv, 0.4))
    for index in range(1, model.njoints):
        changed.inertias[index] = model.inertias[index]
    for attribute in ("armature", "damping", "friction"):
        setattr(changed, attribute, getattr(model, attribute))
    assert changed == model


def test_inconsistent_link_raises():
    model = load_robot("ur10")
    parameters = inertial_parameters(model)
    parameters[2, 0] = -3.0
    with pytest.raises(ValueError, match=r"'elbow_joint' moves \(mass -3\).*is -1 .*Use nearest_consistent"):
        with_parameters(model, parameters)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"parameters": np.ones((5, 10))}, r"parameters must have the shape .* = \(6, 10\); got \(5, 10\)"),
        ({"parameters": np.ones(60)}, r"parameters must have the shape .*; got \(60,\)"),
        ({"parameters": np.full((6, 10), np.nan)}, "parameters must be finite"),
        ({"parameters": [["a"] * 10] * 6}, "parameters must be real numbers"),
        ({"armature": -1.0}, r"armature must be finite and not negative; got -1\.0"),
        ({"damping": np.ones(5)}, r"damping must be a number or have the shape .* = \(6,\); got \(5,\)"),
        ({"friction": np.inf}, "friction must be finite and not negative"),
    ],
)
def test_invalid_arguments_raise(arguments, message):
    model = load_robot("ur10")
    with pytest.raises(ValueError, match=message):
        with_parameters(model, **{"parameters": inertial_parameters(model), **arguments})
