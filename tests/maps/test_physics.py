import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from skevgp.datasets import load_robot
from skevgp.maps.physics import SymbolicRigidBody
from skevgp.robots import RigidBody

ROBOTS = ["pendulum", "cartpole", "acrobot", "iiwa14", "panda", "ur5"]


def branched():
    """A tree of joints of all kinds, aligned and not, with friction, armature and gravity askew."""
    rng = np.random.RandomState(0)
    model = pin.Model()
    model.name = "branched"
    kinds = [
        pin.JointModelRX(),
        pin.JointModelRY(),
        pin.JointModelRZ(),
        pin.JointModelPX(),
        pin.JointModelPY(),
        pin.JointModelPZ(),
        pin.JointModelRevoluteUnaligned(np.array([0.6, 0.0, -0.8])),
        pin.JointModelPrismaticUnaligned(np.array([0.0, 0.6, 0.8])),
    ]
    for number, (kind, parent) in enumerate(zip(kinds, [0, 1, 2, 1, 4, 0, 6, 7], strict=True)):
        joint = model.addJoint(parent, kind, pin.SE3.Random(), f"j{number}")
        body = pin.Inertia.FromEllipsoid(0.5 + rng.rand(), *rng.uniform(0.1, 0.4, 3))
        model.appendBodyToJoint(joint, body, pin.SE3.Random())
    model.gravity.linear = np.array([1.0, -2.0, -9.0])
    model.armature, model.damping = rng.rand(8), rng.rand(8)
    return load_robot(model)


@pytest.fixture(params=[*ROBOTS, branched], ids=lambda robot: robot if isinstance(robot, str) else robot.__name__)
def model(request):
    return load_robot(request.param) if isinstance(request.param, str) else request.param()


def test_rigid_body_functions_agree_with_pinocchio(model):
    n, body, symbolic = model.nv, RigidBody(model), SymbolicRigidBody(model)
    q, v, f = (ca.MX.sym(name, n) for name in "qvf")
    function = ca.Function(
        "all",
        [q, v, f],
        [
            symbolic.forces(q, v, f),
            symbolic.forces(q, v, None),
            symbolic.gravity(q),
            symbolic.accelerations(q, v, f),
            symbolic.accelerations_under(q, v, f),
            symbolic.accelerations(q, None, f, gravity=False),
        ],
    )
    rng = np.random.RandomState(1)
    for Q, V, F in rng.randn(5, 3, 1, n):
        expected = [
            body.forces(Q, V, F),
            body.forces(Q, V, np.zeros_like(V)),
            body.gravity(Q),
            body.accelerations(Q, V, F),
            body.accelerations(Q, V, F - np.array(model.damping) * V),
            body.accelerations_by_force(Q, F),
        ]
        for found, own in zip(function(Q[0], V[0], F[0]), expected, strict=True):
            np.testing.assert_allclose(found.full().ravel(), own[0], atol=1e-10 * np.abs(own).max() + 1e-14)


def test_unknown_joint_raises():
    model = pin.Model()
    model.name = "screw"
    model.addJoint(0, pin.JointModelHX(0.1), pin.SE3.Identity(), "thread")
    with pytest.raises(ValueError, match=r"The joint 'thread' of the robot 'screw' is of the type JointModelHX"):
        SymbolicRigidBody(model)
