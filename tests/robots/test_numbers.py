import pickle
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from skevgp.datasets import load_robot
from skevgp.robots.numbers import RobotNumbers
from skevgp.robots.rigid_body import RigidBody


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "acrobot", "iiwa14", "panda", "ur5"])
def test_a_model_is_the_same_after_it_was_numbers(name):
    model = load_robot(name)
    again = RobotNumbers.of(model).model()
    assert again == model
    data, other = model.createData(), again.createData()
    q, v, a = np.random.RandomState(0).randn(3, model.nv)
    np.testing.assert_array_equal(pin.rnea(model, data, q, v, a), pin.rnea(again, other, q, v, a))
    np.testing.assert_array_equal(pin.aba(model, data, q, v, a), pin.aba(again, other, q, v, a))


def test_named_positions_are_kept():
    model = load_robot("acrobot")
    model.referenceConfigurations["home"] = np.array([0.1, 0.2])
    again = RobotNumbers.of(model).model()
    np.testing.assert_array_equal(again.referenceConfigurations["home"], [0.1, 0.2])


def test_what_is_no_such_model_is_left_alone():
    flying = pin.Model()
    flying.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "base")
    assert RobotNumbers.of(flying) is None
    assert RobotNumbers.of(pin.Model()) is None
    assert RobotNumbers.of("acrobot") is None


def test_a_rigid_body_is_the_same_after_a_pickle():
    body = RigidBody(load_robot("iiwa14"))
    again = pickle.loads(pickle.dumps(body))
    q, v, u = np.random.RandomState(0).randn(3, 5, 7)
    np.testing.assert_array_equal(again.accelerations_under(q, v, u), body.accelerations_under(q, v, u))
    assert type(body.__getstate__()["model"]) is RobotNumbers


GOOD = RobotNumbers.of(load_robot("panda"))


@pytest.mark.parametrize(
    "wrong",
    [
        {"names": GOOD.names[1:]},
        {"joints": ["JointModelFreeFlyer", *GOOD.joints[1:]]},
        {"joints": ["Model", *GOOD.joints[1:]]},
        {"parents": GOOD.parents + 1},
        {"parents": GOOD.parents - 1},
        {"axes": GOOD.axes[1:]},
        {"inertias": GOOD.inertias[1:]},
        {"n_bodies": 10**9},
        {"limits": {"armature": np.zeros(2)}},
        {"limits": {"names": np.zeros(2)}},
        {"frames": GOOD.frames[1:]},
        {"frame_numbers": GOOD.frame_numbers + 1000},
        {"frame_numbers": GOOD.frame_numbers * [1, 1, 3]},
        {"configurations": {"home": np.zeros(1)}},
    ],
    ids=str,
)
def test_numbers_that_do_not_fit_are_refused(wrong):
    with pytest.raises(ValueError, match=r"^A robot"):
        replace(GOOD, **wrong).model()
