"""The iiwa14 against stored numbers of another simulator."""

from pathlib import Path

import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose

from skevgp.robots import RigidBody, load_robot


@pytest.fixture(scope="module")
def stored():
    return np.load(Path(__file__).parents[1] / "data" / "iiwa14.npz")


@pytest.fixture(scope="module")
def model():
    return load_robot("iiwa14")


def test_gravity_torques(stored, model):
    assert_allclose(RigidBody(model).gravity(stored["grav_q"]), stored["grav_tau"], rtol=0, atol=1e-10)


def test_mass_matrices_with_the_rotors_inertia(stored, model):
    data = model.createData()
    upper = np.array([np.triu(pinocchio.crba(model, data, q)) for q in stored["mass_q"]])
    assert_allclose(upper, np.triu(stored["mass_M"]), rtol=0, atol=1e-10)
    assert_allclose(model.armature, stored["reflected_inertia"], rtol=1e-12)


def test_rotations_and_origins_of_the_links(stored, model):
    data = model.createData()
    for q, rotations, origins in zip(stored["link_q"], stored["link_R"], stored["link_p"], strict=True):
        pinocchio.forwardKinematics(model, data, q)
        assert_allclose([data.oMi[link].rotation for link in range(1, 8)], rotations, rtol=0, atol=1e-10)
        assert_allclose([data.oMi[link].translation for link in range(1, 8)], origins, rtol=0, atol=1e-10)


def test_inverse_dynamics_undo_the_accelerations(stored, model):
    force = RigidBody(model).forces(stored["acc_q"], stored["acc_v"], stored["acc_qddot"])
    assert_allclose(force, stored["acc_u"], rtol=0, atol=1e-10 * np.abs(stored["acc_u"]).max())
