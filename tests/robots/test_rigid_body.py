import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose

from skevgp.robots import RigidBody, load_robot

ROBOTS = ["acrobot", "iiwa14", "kinova", "panda"]


def model_and_configurations(name, n=4):
    model = load_robot(name)
    return model, np.random.default_rng(0).uniform(-1.5, 1.5, (n, model.nv))


@pytest.mark.parametrize("name", ROBOTS)
def test_mass_matrix_is_that_of_the_composite_rigid_body_algorithm(name):
    model, configurations = model_and_configurations(name)
    for q in configurations:
        expected = pinocchio.crba(model, model.createData(), q)
        assert_allclose(RigidBody(model).mass_matrix(q), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
def test_accelerations_by_force_are_the_inverse_mass_matrix_times_the_force(name):
    model, q = model_and_configurations(name)
    force = np.random.default_rng(1).normal(size=q.shape)
    expected = [
        np.linalg.solve(pinocchio.crba(model, model.createData(), row), f) for row, f in zip(q, force, strict=True)
    ]
    assert_allclose(RigidBody(model).accelerations_by_force(q, force), expected, rtol=1e-8, atol=1e-10)
