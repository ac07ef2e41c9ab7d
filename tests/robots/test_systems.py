from dataclasses import FrozenInstanceError

import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose

from skevgp.robots import SYSTEMS, get_system, layout_of, load_robot

NAMES = sorted(SYSTEMS)


def mass_matrix(name, q):
    model = load_robot(name)
    return pinocchio.crba(model, model.createData(), np.array(q))


def gravity(name, q):
    model = load_robot(name)
    return pinocchio.computeGeneralizedGravity(model, model.createData(), np.array(q))


@pytest.mark.parametrize(("name", "close"), [("pendelum", "pendulum"), ("cart_pole", "cartpole")])
def test_unknown_name_gets_the_nearest_one(name, close):
    with pytest.raises(ValueError, match=rf"Unknown system '{name}'.* Did you mean '{close}'\?"):
        get_system(name)


@pytest.mark.parametrize("name", [None, 3, ["pendulum"]])
def test_invalid_name_type_raises(name):
    with pytest.raises(TypeError, match=r"must be a name .*'pendulum'.* or a System; got"):
        get_system(name)


def test_table_cannot_be_changed():
    with pytest.raises(TypeError):
        SYSTEMS["mine"] = SYSTEMS["pendulum"]
    with pytest.raises(FrozenInstanceError):
        SYSTEMS["pendulum"].name = "mine"


@pytest.mark.parametrize("name", NAMES)
def test_names_cover_states_and_inputs(name):
    system = layout_of(name)
    assert len(system.position_names) == system.n_joints
    assert len(set(system.state_names)) == 2 * system.n_joints
    assert len(system.input_names) == system.n_inputs


@pytest.mark.parametrize("name", NAMES)
def test_driven_joints_and_gravity_name_joints_of_the_system(name):
    layout = layout_of(name)
    joints = set(range(layout.n_joints))
    assert set(layout.driven) <= joints
    assert all(set(term.angle) | set(term.acts_on) <= joints for term in get_system(name).gravity)


@pytest.mark.parametrize("q", [0.0, 1.0, 3.0])
def test_mass_and_gravity_of_the_pendulum(q):
    assert_allclose(mass_matrix("pendulum", [q]), [[0.25]], rtol=1e-14)
    assert_allclose(gravity("pendulum", [q]), [9.81 * 0.5 * np.sin(q)], rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("theta", [0.0, 1.0, -2.5])
def test_mass_and_gravity_of_the_cartpole(theta):
    coupling = 0.5 * np.cos(theta)
    assert_allclose(mass_matrix("cartpole", [0.7, theta]), [[11.0, coupling], [coupling, 0.25]], rtol=1e-13)
    assert_allclose(gravity("cartpole", [0.7, theta]), [0.0, 9.81 * 0.5 * np.sin(theta)], rtol=1e-12, atol=1e-14)


def test_one_of_two_cartpoles_is_damped():
    free, damped = load_robot("cartpole"), load_robot("cartpole_damped")
    assert (list(free.damping), list(damped.damping)) == ([0.0, 0.0], [0.1, 0.1])
    assert_allclose(mass_matrix("cartpole_damped", [0.7, 1.0]), mass_matrix("cartpole", [0.7, 1.0]), rtol=1e-15)
