from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from skevgp.datasets import load_robot
from skevgp.robots.numbers import RobotNumbers


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "acrobot", "iiwa14", "panda", "ur5"])
def test_model_is_the_same_after_it_was_numbers(name):
    model = load_robot(name)
    again = RobotNumbers.of(model).model()
    assert again == model
    data, other = model.createData(), again.createData()
    q, v, a = np.random.RandomState(0).randn(3, model.nv)
    np.testing.assert_array_equal(pin.rnea(model, data, q, v, a), pin.rnea(again, other, q, v, a))
    np.testing.assert_array_equal(pin.aba(model, data, q, v, a), pin.aba(again, other, q, v, a))


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
def test_numbers_that_do_not_fit_raise(wrong):
    with pytest.raises(ValueError, match=r"^A robot"):
        replace(GOOD, **wrong).model()
