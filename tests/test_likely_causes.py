"""What `InverseDynamics` says of columns in another order or in degrees, and nothing of these where all is right."""

import warnings

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning

from skevgp import InverseDynamics
from skevgp.features import NominalDynamics, RigidBodyRegressor
from skevgp.identification.likely_causes import likely_causes
from skevgp.robots import RigidBody, load_robot

from .test_inverse_dynamics import Arm, with_masses

NOISE = 0.05


def arm_of_five(robot, noise=NOISE):
    """A log of a robot whose other joints are locked: a search tries all orders of joints, 720 of six."""
    return Arm(load_robot(robot, joints=list(load_robot(robot).names)[1:6]), noise=noise, n_groups=1, dt=0.1)


def causes_of(robot, X, y, is_far=True):
    feature_map = RigidBodyRegressor(robot).fit(X)
    return likely_causes(feature_map, X, y, feature_map.coef_prior(y.shape[1]), is_far=is_far)


def columns_of(X, order):
    """Rows in whose blocks column k is that of the joint order[k]."""
    n = len(order)
    return X[:, [n * block + joint for block in range(3) for joint in order]]


def in_degrees(X, blocks, joints):
    X, n = X.copy(), X.shape[1] // 3
    X[:, [n * "qva".index(block) + joint for block in blocks for joint in joints]] *= 180.0 / np.pi
    return X


def warning_of(robot, X, y, **data):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        InverseDynamics(robot, n_inducing=0, stiction_velocity=None).fit(X, y, **data)
    assert all(one.category is ConvergenceWarning for one in caught)
    assert len(caught) <= 1
    return str(caught[0].message) if caught else ""


@pytest.mark.parametrize(("what", "masses"), [("X and y", 1.0), ("X", 0.1), ("y", 1.0)])
def test_columns_in_another_order_are_named_in_their_order(what, masses):
    arm = arm_of_five("ur5")
    order = [2, 1, 0, 4, 3]
    X = arm.X if what == "y" else columns_of(arm.X, order)
    y = arm.y if what == "X" else arm.y[:, order]
    names = list(arm.nominal.names)[1:]
    (cause,) = causes_of(with_masses(arm, masses), X, y)
    columns = [names[joint] for joint in order]
    assert cause == f"the columns of {what} seem to be in the order {columns}, and must be in the robot's: {names}"


@pytest.mark.long
@pytest.mark.parametrize("robot", ["iiwa14", "panda"])
def test_order_of_more_joints_is_searched_step_by_step(robot):
    arm = Arm(robot, noise=NOISE)
    order = np.random.default_rng(0).permutation(arm.nominal.nv)
    columns = [arm.nominal.names[1 + joint] for joint in order.tolist()]
    found = causes_of(arm.nominal, columns_of(arm.X, order), arm.y[:, order], is_far=False)
    assert any(f"columns of X and y seem to be in the order {columns}" in cause for cause in found)


@pytest.mark.parametrize(("robot", "blocks"), [("ur5", "qva"), ("kinova", "q")])  # the latter has joints without limits
def test_degrees_are_named(robot, blocks):
    arm = arm_of_five(robot)
    names = list(arm.nominal.names)[1:]
    (cause,) = causes_of(arm.nominal, in_degrees(arm.X, blocks, range(5)), arm.y)
    signals = {"qva": "positions, velocities and accelerations", "q": "positions"}[blocks]
    assert cause == f"{signals} of {names} look like degrees, and must be in radians"


@pytest.mark.parametrize("robot", ["cartpole", "ur10"])
def test_radians_do_not_look_like_degrees_where_torques_are_of_another_kind(robot):
    """Without gravity, in amperes, or with signs of their own, torques are explained best without some signals."""
    arm, rng = arm_of_five(robot, noise=0.0), np.random.default_rng(0)
    q, v, a = np.split(arm.X, 3, axis=1)
    forces = RigidBody(arm.nominal).forces
    wrong = {
        "compensated": forces(q, v, a) - forces(q, 0.0 * v, 0.0 * a),
        "currents": arm.y * rng.uniform(0.01, 0.2, arm.nominal.nv),
        "signs": arm.y * rng.choice([-1.0, 1.0], arm.nominal.nv),
    }
    causes = {name: causes_of(arm.nominal, arm.X, y) for name, y in wrong.items()}
    assert not any("degrees" in cause for several in causes.values() for cause in several)


def test_positions_beyond_their_limits_are_named_if_the_model_is_far_off():
    arm = arm_of_five("ur5")
    X = arm.X.copy()
    X[:, 0] += 9.0  # of the vertical axis: torques do not know it
    (cause,) = causes_of(arm.nominal, X, arm.y)
    assert cause.startswith("positions of 'shoulder_pan_joint' (from ")
    assert "with limits of -6.28 and 6.28 rad) are beyond the joints' limits" in cause
    assert causes_of(arm.nominal, X, arm.y, is_far=False) == []


@pytest.mark.parametrize(
    "robot", ["acrobot", *(pytest.param(robot, marks=pytest.mark.long) for robot in ("ur5", "iiwa14"))]
)
def test_right_columns_give_no_cause(robot):
    """However little torques are explained."""
    arm, rng = Arm(robot, noise=NOISE), np.random.default_rng(0)
    scale, n = arm.y.std(axis=0), arm.nominal.nv
    wrong = {
        "noise": arm.y + 2.0 * scale * rng.normal(size=arm.y.shape),
        "currents": arm.y / np.linspace(5.0, 15.0, n),
        "signs": -arm.y,
        "what no rigid body does": arm.y + scale * np.sin(7.0 * arm.X[:, :n]),
        "nothing": np.zeros_like(arm.y),
    }
    for masses in (1.0, 0.1) if n == 2 else (0.1,):
        model = with_masses(arm, masses)
        named = {name: causes_of(model, arm.X, y, is_far=False) for name, y in wrong.items()}
        assert named == {name: [] for name in wrong}


# --- data frames ---------------------------------------------------------------------------------------------------

UR5 = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
NAMES = [f"{signal}/{joint}" for signal in ("position", "velocity", "acceleration") for joint in UR5]


def test_frame_whose_names_say_that_joints_are_in_another_order_raises(frame_of):
    small, joints = Arm("acrobot", noise=NOISE, n_groups=1), ["q1", "q2"]
    names = [f"{signal}/{joint}" for signal in ("position", "velocity", "acceleration") for joint in joints]
    of_small = [frame_of(dict(zip(*each, strict=True))) for each in ((names, small.X.T), (joints, small.y.T))]
    assert warning_of("acrobot", *of_small) == ""
    arm = Arm(noise=NOISE, n_groups=1, dt=0.2)
    X, y = frame_of(dict(zip(NAMES, arm.X.T, strict=True))), frame_of(dict(zip(UR5, arm.y.T, strict=True)))
    by_name = sorted(UR5)
    other = frame_of({name: arm.X[:, NAMES.index(name)] for name in sorted(NAMES)})
    with pytest.raises(ValueError, match=r"columns of X must be in the robot's order.*of the joints \['elbow_joint'"):
        InverseDynamics("ur5").fit(other, y)
    with pytest.raises(ValueError, match=r"columns of y must be in the robot's order.*got \['elbow_joint'"):
        InverseDynamics("ur5").fit(X, frame_of({name: arm.y[:, UR5.index(name)] for name in by_name}))


def test_columns_of_each_joint_side_by_side_raise(frame_of):
    side_by_side = [f"{joint}/{signal}" for joint in UR5 for signal in ("q", "dq", "u")]
    frame = frame_of({name: np.zeros(2) for name in side_by_side})
    with pytest.raises(ValueError, match="by their names they are those of the joints"):
        RigidBodyRegressor("ur5").fit(frame)
    ordered = [f"{joint}/{signal}" for signal in ("q", "dq", "u") for joint in UR5]
    assert NominalDynamics("ur5").fit_transform(frame_of({name: np.zeros(2) for name in ordered})).shape == (2, 6)
