import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose

from skevgp.datasets import plant as plant_module
from skevgp.datasets import simulate
from skevgp.datasets.plant import Plant
from skevgp.robots import load_robot


def strongly_damped(damping):
    model = load_robot("acrobot")
    model.damping = np.array([damping, damping])
    return model


def with_a_massless_tip():
    model = load_robot("pendulum")
    model.addJoint(1, pinocchio.JointModelRY(), pinocchio.SE3.Identity(), "tip")
    return model


def test_mass_matrix_is_that_of_the_inverse_dynamics():
    plant, q = Plant("iiwa14"), np.linspace(-1.0, 1.0, 7)
    rows, still = np.tile(q, (7, 1)), np.zeros((7, 7))
    columns = plant.body.forces(rows, still, np.eye(7)) - plant.body.gravity(rows)
    assert_allclose(plant.mass_matrix(q), columns, rtol=0, atol=1e-12)


def test_massless_link_raises():
    with pytest.raises(ValueError, match=r"mass matrix of 'pendulum' is singular.*\['tip'\].*inertia"):
        simulate(with_a_massless_tip(), np.zeros(4), np.zeros((2, 2)))


def test_robot_without_any_mass_raises():
    model = load_robot("pendulum")
    model.inertias[1] = pinocchio.Inertia.Zero()
    with pytest.raises(ValueError, match=r"is singular.*\['q'\]"):
        simulate(model, [0.1, 0.0], np.zeros((1, 1)))


def test_implicit_method_agrees_with_the_explicit_one():
    plant, rng = Plant(strongly_damped(50.0)), np.random.default_rng(0)
    z, u = rng.uniform(-1.0, 1.0, (5, 4)), rng.standard_normal((5, 1))
    assert_allclose(plant.advance(z, u, 0.03, stiff=True), plant.advance(z, u, 0.03, stiff=False), rtol=0, atol=1e-7)


def test_motion_too_fast_for_the_step_ends_in_an_error():
    with pytest.raises(ValueError, match="integration of 'pendulum' over 0.03 s failed: it needs more than 600 steps"):
        simulate("pendulum", [3.0, 1e6], np.zeros((1, 1)))


def test_no_step_takes_for_ever(monkeypatch):
    monkeypatch.setattr(plant_module, "_MOST_ALLOWED", 700)
    with pytest.raises(ValueError, match="'pendulum' over 1e[+]308 s failed: it needs more than 700 steps"):
        simulate("pendulum", [1.0, 0.0], np.ones((1, 1)), dt=1e308)
