import numpy as np
import pandas as pd
import pinocchio
import pytest
from numpy.testing import assert_allclose

from skevgp import EVGPRegressor
from skevgp.datasets import load_robot
from skevgp.features import RigidBodyRegressor
from skevgp.robots import RigidBody
from skevgp.solvers import LBFGS

from .test_jacobians import LIFT, name_of

ROBOTS = ["pendulum", "acrobot", "iiwa14", "ur5", LIFT]


def rows_of(model, n=20, seed=0):
    return np.random.default_rng(seed).normal(size=(n, 3 * model.nv))


@pytest.mark.parametrize("robot", ROBOTS, ids=name_of)
def test_with_the_models_own_weights_torques_are_those_of_newton_and_euler_with_friction(robot):
    model = load_robot(robot)
    X = rows_of(model)
    q, v, a = np.split(X, 3, axis=1)
    body = RigidBodyRegressor(robot)
    H = body.fit_transform(X)
    mean, covariance = body.coef_prior(model.nv)
    expected = RigidBody(model).forces(q, v, a) + np.array(model.damping) * v
    assert H.shape == (20, model.nv, len(mean))
    assert_allclose(H @ mean, expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max())
    assert len(body.get_feature_names_out()) == len(mean) == len(covariance)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12 * np.abs(covariance).max()


def test_other_inertias_and_friction_are_other_weights():
    model = load_robot("ur5").copy()
    rng = np.random.default_rng(1)
    X = rows_of(model)
    q, v, a = np.split(X, 3, axis=1)
    for link in range(1, model.njoints):
        model.inertias[link] = pinocchio.Inertia.Random()
    friction = rng.uniform(0.1, 1.0, (4, model.nv))
    links = np.concatenate([link.toDynamicParameters() for link in list(model.inertias)[1:]])
    torque = RigidBody(model).forces(q, v, a)
    torque += friction[0] * v + friction[1] * np.tanh(v / 0.2) + friction[2] + friction[3] * a
    H = RigidBodyRegressor("ur5", stiction_velocity=0.2).fit_transform(X)
    assert_allclose(H @ np.concatenate([links, *friction]), torque, rtol=1e-9, atol=1e-9 * np.abs(torque).max())


@pytest.mark.parametrize("robot", ROBOTS, ids=name_of)
def test_jacobian_is_the_derivative(robot):
    X = rows_of(load_robot(robot), 5)
    body = RigidBodyRegressor(robot, stiction_velocity=0.5).fit(X)
    found, step = body.jacobian(X), 1e-5
    assert found.shape == (*body.transform(X).shape, X.shape[1])
    for column in range(X.shape[1]):
        move = np.zeros(X.shape[1])
        move[column] = step
        expected = (body.transform(X + move) - body.transform(X - move)) / (2.0 * step)
        assert_allclose(found[..., column], expected, rtol=1e-6, atol=1e-6 * np.abs(found).max())


def test_priors_covariance_is_that_of_small_errors_of_mass_centre_and_shape():
    model = load_robot("ur5")
    body = RigidBodyRegressor("ur5", mass_scale=1e-3, com_scale=1e-3, inertia_scale=0.0, friction=[])
    _, covariance = body.coef_prior(6)
    rng, link = np.random.default_rng(0), model.inertias[3]
    # The forearm reaches to the wrist.
    size = np.linalg.norm(model.jointPlacements[4].translation)
    drawn = []
    for _ in range(4000):
        mass = link.mass * (1.0 + 1e-3 * rng.standard_normal())
        lever = link.lever + 1e-3 * size * rng.standard_normal(3)
        inertia = link.inertia * mass / link.mass
        drawn.append(pinocchio.Inertia(mass, lever, inertia).toDynamicParameters())
    expected, found = np.cov(np.array(drawn).T), covariance[20:30, 20:30]
    scale = np.sqrt(np.diag(found))
    assert_allclose(np.sqrt(np.diag(expected)), scale, rtol=0.1, atol=0.02 * scale.max())
    units = np.maximum(scale, 0.02 * scale.max())
    assert_allclose(expected / np.outer(units, units), found / np.outer(units, units), atol=0.1)


def test_all_joints_share_weights_in_the_regressor():
    model = load_robot("acrobot")
    X = rows_of(model, 200)
    body = RigidBodyRegressor("acrobot", friction=["viscous"])
    mean, _ = body.coef_prior(2)
    y = body.fit_transform(X) @ mean + 0.01 * np.random.default_rng(0).normal(size=(200, 2))
    fitted = EVGPRegressor(body, n_inducing=5, max_iter=5, noise_cv=None, random_state=0, solver=LBFGS(tol=1e9)).fit(
        X, y
    )
    assert fitted.coef_.shape == (22,)
    assert np.sqrt(np.mean((fitted.predict(X) - y) ** 2)) < 0.02


def test_names_and_order_of_columns():
    names = ["q", "dq/dt", "d2q/dt2"]
    frame = pd.DataFrame([[0.1, 0.2, 0.3]], columns=names)
    assert_allclose(RigidBodyRegressor("pendulum").fit_transform(frame)[0, 0, -1], 0.3)
    with pytest.raises(ValueError, match=r"robot's order \['q', 'dq/dt', 'd2q/dt2'\]"):
        RigidBodyRegressor("pendulum").fit(frame[names[::-1]])
    with pytest.raises(ValueError, match="X has 2 columns.*needs 3"):
        RigidBodyRegressor("pendulum").fit([[0.1, 0.2]])


def test_invalid_arguments_raise():
    with pytest.raises(ValueError, match="y has 3 columns.*torques of its 1 joints"):
        RigidBodyRegressor("pendulum").coef_prior(3)
    for name in ("stiction_velocity", "mass_scale", "com_scale", "inertia_scale", "friction_scale"):
        with pytest.raises(ValueError, match=name):
            RigidBodyRegressor("pendulum", **{name: -1.0}).fit([[0.0, 0.0, 0.0]])
