import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.exceptions import NotFittedError

from skevgp.features import AngleEncoder, InertiaForce, InertiaForceGravity, LinkGravity, NominalDynamics
from skevgp.robots import layout_of, load_robot
from skevgp.robots.systems import Link, System

TERMS = ("acceleration", "midpoint", "gravity", "bias", "input")
PLANAR = ["pendulum", "cartpole", "acrobot"]
# Turning about skew axes, sliding, and damped.
LIFT = System(
    "lift",
    links=(
        Link("z", "prismatic", (0.0, 0.0, 1.0), mass=2.0, damping=0.3, rpy=(0.5, 0.2, 0.0)),
        Link("q", "revolute", (0.6, 0.0, 0.8), mass=1.0, com=(0.1, 0.2, 0.3), xyz=(1.0, 0.0, 0.0), rpy=(0.3, 0.2, 0.1)),
        Link("s", "prismatic", (0.48, -0.6, 0.64), mass=1.0, rpy=(0.3, -0.2, 0.1), effort=0.0),
    ),
)
ROBOTS_3D = ["iiwa14", "ur5", "panda", "double_pendulum_continuous", LIFT]
MAPS = {
    "inertia": InertiaForce,
    "inertia and gravity": InertiaForceGravity,
    "angles": AngleEncoder,
    "gravity": LinkGravity,
    "dynamics": lambda robot: NominalDynamics(robot, terms=TERMS),
}


def name_of(robot):
    return getattr(robot, "name", str(robot))


def rows(robot, n_rows=20, seed=0):
    n_columns = 4 if robot is None else layout_of(robot).n_columns
    return np.random.default_rng(seed).uniform(-3.0, 3.0, (n_rows, n_columns))


def by_differences(features, X, step=1e-5):
    columns = []
    for shift in step * np.eye(X.shape[1]):
        columns.append((features.transform(X + shift) - features.transform(X - shift)) / (2.0 * step))
    return np.stack(columns, axis=2)


def check(features, X):
    features.fit(X)
    jacobian, expected = features.jacobian(X), by_differences(features, X)
    assert jacobian.shape == (len(X), features.transform(X[:1]).shape[1], X.shape[1])
    assert_allclose(jacobian, expected, rtol=0.0, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("kind", MAPS)
@pytest.mark.parametrize("robot", [*PLANAR, None])
def test_on_a_thousand_states_central_differences_agree(robot, kind):
    check(MAPS[kind](robot), rows(robot, 1000))


@pytest.mark.parametrize("term", TERMS)
@pytest.mark.parametrize("robot", ["acrobot", "ur5", LIFT], ids=name_of)
def test_each_term_by_itself(robot, term):
    check(NominalDynamics(robot, terms=[term]), rows(robot))


@pytest.mark.parametrize(
    "features",
    [
        LinkGravity("iiwa14", axes="x", links=["q6", "q2"]),
        InertiaForceGravity("acrobot", gravity=LinkGravity(links=[1])),
        AngleEncoder(angles=[2, 0]),
        AngleEncoder("iiwa14", angles=["q3"]),
    ],
    ids=str,
)
def test_jacobian_of_chosen_features(features):
    check(features, rows(features.robot))


# --- oracles -----------------------------------------------------------------------------------------------------


def model_of_a_unit_mass(robot, joint, lever):
    """The robot without any mass but 1 kg on a link, at the end of a lever."""
    model = load_robot(robot).copy()
    for link in range(1, model.njoints):
        here = lever if link == joint else np.zeros(3)
        model.inertias[link] = pinocchio.Inertia(float(link == joint), here, np.zeros((3, 3)))
    return model


def levers(robot, joint):
    """u_x and u_y of a joint that turns, by the documented rule; of one that slides any lever."""
    model = load_robot(robot)
    at_zero = pinocchio.computeJointJacobian(model, model.createData(), np.zeros(model.nv), joint)
    motion = at_zero.reshape(6, -1)[:, joint - 1]
    if np.any(motion[:3]):
        return [np.zeros(3)]
    u_z = motion[3:]
    u_x = np.eye(3)[(np.argmax(np.abs(u_z)) + 1) % 3]
    u_x = u_x - (u_x @ u_z) * u_z
    u_x /= np.linalg.norm(u_x)
    return [u_x, np.cross(u_z, u_x)]


@pytest.mark.parametrize("robot", [*PLANAR, *ROBOTS_3D], ids=name_of)
def test_gravity_is_pinocchios_derivative_of_the_torque_of_a_unit_mass(robot):
    n, X = layout_of(robot).n_joints, rows(robot, 5)
    jacobian, feature = LinkGravity(robot).fit(X).jacobian(X), 0
    for joint in range(1, n + 1):
        for lever in levers(robot, joint):
            model = model_of_a_unit_mass(robot, joint, lever)
            data = model.createData()
            for x, found in zip(X, jacobian[:, feature], strict=True):
                held = pinocchio.computeGeneralizedGravityDerivatives(model, data, x[:n])[joint - 1]
                assert_allclose(found[:n], -held, rtol=1e-10, atol=1e-11)
            feature += 1
    assert feature == jacobian.shape[1]
    assert_array_equal(jacobian[:, :, n:], 0.0)


# --- the method --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", MAPS)
def test_jacobian_validates_input(kind):
    X = rows("cartpole")
    with pytest.raises(NotFittedError):
        MAPS[kind]("cartpole").jacobian(X)
    features = MAPS[kind]("cartpole").fit(X)
    with pytest.raises(ValueError, match="X has 4 features, but .* is expecting 5 features"):
        features.jacobian(X[:, :4])
    with pytest.raises(ValueError, match="contains NaN"):
        features.jacobian(np.where(X[0, 0] == X, np.nan, X))
    assert_array_equal(features.jacobian(X.tolist()), features.jacobian(X))


def test_dynamics_that_overflow_raise():
    features = NominalDynamics("acrobot").fit(rows("acrobot"))
    x = np.array([[0.1, 0.2, 1e90, 1e90, 1e99]]) * 1e99 ** np.array([0, 0, 1, 1, 1])
    with pytest.raises(ValueError, match="The dynamics of the robot 'acrobot' are not finite"):
        features.jacobian(x)
