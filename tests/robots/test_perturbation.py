import numpy as np
import pytest
from numpy.testing import assert_allclose

from skevgp.robots import load_robot, perturb_robot

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


def test_inertia_stays_one_that_a_body_can_have():
    for link in list(perturb_robot("iiwa14", 0.9, random_state=0).inertias)[1:]:
        moments = np.linalg.eigvalsh(link.inertia)
        assert 0.0 < moments[0] <= moments[1] <= moments[2] <= moments[0] + moments[1]


@pytest.mark.parametrize("scale", [-0.1, 1.0, 2.0, np.nan, np.inf])
def test_scale_out_of_range_raises(scale):
    with pytest.raises(ValueError, match="scale must be .*; got"):
        perturb_robot("acrobot", scale)


@pytest.mark.parametrize("scale", ["much", None, True, [0.1]])
def test_scale_that_is_no_number_raises(scale):
    with pytest.raises(TypeError, match="scale must be a number; got"):
        perturb_robot("acrobot", scale)


def test_unknown_robot_gets_close_matches():
    with pytest.raises(ValueError, match="Unknown robot 'acrobat'.*Did you mean 'acrobot'"):
        perturb_robot("acrobat")
