import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from skevgp import datasets
from skevgp.robots import get_system, load_robot, perturb_robot

# romeo has massless links, icub inertias that no body can have
ROBOTS = ["pendulum", "acrobot", "iiwa14", "panda", "romeo", "icub"]


def factors(seed, n_joints, scale):
    """As documented: link by link mass, centre of mass, inertia, armature."""
    rng = np.random.RandomState(seed)
    return np.array([[1.0 + scale * rng.uniform(-1.0, 1.0) for _ in range(6)] for _ in range(n_joints)])


@pytest.mark.parametrize("name", ROBOTS)
def test_each_quantity_is_multiplied_by_its_own_factor(name):
    right, wrong = load_robot(name), perturb_robot(name, 0.3, random_state=5)
    for index, factor in enumerate(factors(5, right.nv, 0.3)):
        before, after = right.inertias[index + 1], wrong.inertias[index + 1]
        assert_allclose(after.mass, before.mass * factor[0], rtol=1e-14)
        assert_allclose(after.lever, before.lever * factor[1:4], rtol=1e-14)
        assert_allclose(after.inertia, before.inertia * factor[4], rtol=1e-13)
        assert_allclose(wrong.armature[index], right.armature[index] * factor[5], rtol=1e-14)


@pytest.mark.parametrize("name", ROBOTS)
def test_all_else_stays(name):
    right, wrong = load_robot(name), perturb_robot(name, 0.3, random_state=0)
    for index, link in enumerate(right.inertias):
        wrong.inertias[index] = link
    wrong.armature = right.armature
    assert wrong == right
    assert wrong.name == right.name


def test_an_inertia_stays_one_that_a_body_can_have():
    for link in list(perturb_robot("iiwa14", 0.9, random_state=0).inertias)[1:]:
        moments = np.linalg.eigvalsh(link.inertia)
        assert 0.0 < moments[0] <= moments[1] <= moments[2] <= moments[0] + moments[1]


def test_a_model_is_not_changed():
    model = load_robot("iiwa14")
    wrong = perturb_robot(model, random_state=0)
    assert model == load_robot("iiwa14")
    assert wrong != model


@pytest.mark.parametrize("name", ROBOTS)
def test_without_an_error_the_model_is_the_same(name):
    assert perturb_robot(name, 0.0, random_state=0) == load_robot(name)


@pytest.mark.parametrize("robot", ["acrobot", get_system("acrobot"), load_robot("acrobot")])
def test_a_name_a_system_and_a_model_are_perturbed_alike(robot):
    assert perturb_robot(robot, random_state=3) == perturb_robot("acrobot", 0.2, random_state=3)


def test_the_seed_decides():
    seeded = perturb_robot("iiwa14", random_state=1)
    assert seeded == perturb_robot("iiwa14", random_state=1)
    assert seeded == perturb_robot("iiwa14", random_state=np.random.RandomState(1))
    assert seeded != perturb_robot("iiwa14", random_state=2)


def test_a_perturbed_model_moves_otherwise():
    q = np.full(7, 0.5)
    right, wrong = (
        pinocchio.computeGeneralizedGravity(model, model.createData(), q)
        for model in (load_robot("iiwa14"), perturb_robot("iiwa14", 0.2, random_state=0))
    )
    relative = np.linalg.norm(wrong - right) / np.linalg.norm(right)
    assert 0.01 < relative < 0.5


@pytest.mark.parametrize("scale", [-0.1, 1.0, 2.0, np.nan, np.inf])
def test_a_scale_out_of_range_is_named(scale):
    with pytest.raises(ValueError, match="scale must be .*; got"):
        perturb_robot("acrobot", scale)


@pytest.mark.parametrize("scale", ["much", None, True, [0.1]])
def test_a_scale_that_is_no_number_is_named(scale):
    with pytest.raises(TypeError, match="scale must be a number; got"):
        perturb_robot("acrobot", scale)


def test_an_unknown_robot_gets_close_matches():
    with pytest.raises(ValueError, match="Unknown robot 'acrobat'.*Did you mean 'acrobot'"):
        perturb_robot("acrobat")


def test_it_is_found_beside_the_data_sets():
    assert datasets.perturb_robot is perturb_robot
    assert_array_equal(datasets.perturb_robot("acrobot", 0.0).damping, [0.1, 0.1])
