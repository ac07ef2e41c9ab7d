"""What all maps of robots with parameters promise, and what each parameter means."""

import pickle
import re
from dataclasses import replace

import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import clone
from sklearn.pipeline import FeatureUnion

from skevgp import EVGPRegressor
from skevgp.datasets import load_robot, make_dynamics, perturb_robot
from skevgp.features import (
    Friction,
    InertiaForce,
    InertiaForceGravity,
    LinkGravity,
    LogNormal,
    NominalDynamics,
    Normal,
    RigidBodyRegressor,
    Uniform,
)
from skevgp.fitting import theta
from skevgp.io import load, save
from skevgp.robots import RigidBody, System, layout_of
from skevgp.robots.systems import Link

TERMS = ["acceleration", "midpoint", "gravity", "bias", "input"]
UR5 = {
    "mass(forearm_link)": LogNormal(1.0, 0.2),
    "length(upper_arm_link)": LogNormal(1.0, 0.1),
    "inertia(wrist_1_joint)": LogNormal(1.0, 0.3),
}
ACROBOT = {
    **{f"{kind}({joint})": LogNormal(1.0, 0.2) for joint in ("q1", "q2") for kind in ("mass", "length", "inertia")},
    "damping(q2)": Uniform(0.0, 3.0),
}
FRICTION = {
    "stiction_velocity(q1)": LogNormal(0.5, 0.5),
    "stribeck_velocity": LogNormal(1.0, 0.5),
    "sharpness(q2)": Uniform(0.5, 2.5),
}
CASES = {
    "nominal": NominalDynamics("acrobot", terms=TERMS, parameters=ACROBOT),
    "nominal, ur5": NominalDynamics("ur5", terms=TERMS, parameters=UR5),
    "nominal, iiwa14": NominalDynamics("iiwa14", parameters={"armature(q3)": LogNormal(1.0, 0.3)}, dt="column"),
    "gravity": LinkGravity("iiwa14", parameters={"offset(q2)": Normal(0.1, 0.1), "offset(q4)": Normal(0.0, 0.1)}),
    "gravity, time step": LinkGravity("cartpole", parameters={"offset(theta)": Normal(0.1, 0.1)}, dt="column"),
    "IFG, sines": InertiaForceGravity("acrobot", parameters={f"offset(q{i})": Normal(0.0, 0.1) for i in (2, 1)}),
    "IFG, levers": InertiaForceGravity("iiwa14", parameters={"offset(q2)": Normal(0.0, 0.1)}, dt="column"),
    "friction": Friction("acrobot", parameters=FRICTION),
    "friction, time step": Friction(
        "acrobot", terms=["stribeck"], dt="column", parameters={"sharpness": LogNormal(1, 1)}
    ),
    "torques": RigidBodyRegressor("acrobot", parameters={"stiction_velocity": LogNormal(0.5, 0.5)}),
    "torques, one joint": RigidBodyRegressor(
        "ur5", friction=["offset", "coulomb"], parameters={"stiction_velocity(elbow_joint)": LogNormal(0.5, 0.5)}
    ),
}


@pytest.fixture(params=CASES)
def features(request):
    return clone(CASES[request.param])


def rows_of(features, n_rows=20, seed=0):
    layout = layout_of(features.robot)
    n_columns = 3 * layout.n_joints if isinstance(features, RigidBodyRegressor) else layout.n_columns
    X = np.random.default_rng(seed).uniform(-1.5, 1.5, (n_rows, n_columns))
    X[0] = 0.0
    if getattr(features, "dt", None) == "column":
        X = np.column_stack([X, np.linspace(0.005, 0.05, n_rows)])
    return X


def moved(features, X):
    """Fitted, at other values than the medians."""
    features.fit(X)
    priors = features.theta_prior()
    features.set_theta({name: prior.value(0.5 - 0.3 * i) for i, (name, prior) in enumerate(priors.items())})
    return features


# --- all maps ---------------------------------------------------------------------------------------------------------


def test_theta_jacobian_is_the_derivative_of_transform(features):
    X = rows_of(features)
    theta = moved(features, X).theta_
    found, step = features.theta_jacobian(X), 1e-5
    assert found.shape == (*features.transform(X).shape, len(theta))
    for number, name in enumerate(theta):
        values = []
        for sign in (1.0, -1.0):
            features.set_theta({**theta, name: theta[name] + sign * step})
            values.append(features.transform(X))
        expected = (values[0] - values[1]) / (2.0 * step)
        assert np.abs(expected).max() > 0.0
        assert_allclose(found[..., number], expected, rtol=0.0, atol=1e-8 * np.abs(values[0]).max())


def test_jacobian_is_the_derivative_of_transform(features):
    X, step = rows_of(features)[1:], 1e-6
    found = moved(features, X).jacobian(X)
    for column, shift in enumerate(step * np.eye(X.shape[1])):
        expected = (features.transform(X + shift) - features.transform(X - shift)) / (2.0 * step)
        assert_allclose(found[..., column], expected, rtol=0.0, atol=1e-6 * np.abs(found).max())


@pytest.mark.parametrize(
    ("features", "names"),
    [
        (NominalDynamics("acrobot", terms=TERMS), [*ACROBOT, "damping(q1)"]),
        (NominalDynamics("iiwa14"), ["armature(q3)", "inertia(q7)"]),
        (LinkGravity("acrobot"), ["offset(q1)", "offset(q2)"]),
        (InertiaForceGravity("cartpole"), ["offset(theta)"]),
        (Friction("acrobot"), ["stiction_velocity", "stribeck_velocity(q1)", "sharpness(q2)"]),
        (RigidBodyRegressor("acrobot"), ["stiction_velocity(q2)"]),
    ],
)
def test_fit_sets_medians(features, names):
    X = rows_of(features)
    expected = features.fit_transform(X), features.jacobian(X)
    assert features.theta_prior() == {}
    assert not hasattr(features, "theta_")
    medians = {name: getattr(features, name.partition("(")[0], float("offset" not in name)) for name in names}
    priors = {name: LogNormal(value, 0.3) if value else Normal(0.0, 0.3) for name, value in medians.items()}
    features = features.set_params(parameters=priors).fit(X)
    assert features.theta_ == medians
    assert set(features.units) == set(medians)
    assert_array_equal(features.transform(X), expected[0])
    assert_array_equal(features.jacobian(X), expected[1])
    assert not hasattr(features.set_params(parameters=None).fit(X), "theta_")


@pytest.mark.parametrize("kind", [LinkGravity, InertiaForceGravity])
def test_offset_is_added_to_the_angle_in_gravity_alone(kind):
    features = kind("acrobot", parameters={"offset(q2)": Normal(0.1, 0.1)})
    X = rows_of(features)
    found, shifted = features.fit_transform(X), X + [0.0, 0.1, 0.0, 0.0, 0.0]
    n_others = X.shape[1] if kind is InertiaForceGravity else 0
    assert_array_equal(found[:, :n_others], X[:, :n_others])
    assert_array_equal(found[:, n_others:], kind("acrobot").fit_transform(shifted)[:, n_others:])


def test_copies_keep_the_values(features, tmp_path):
    X = rows_of(features)
    expected = moved(features, X).transform(X), features.theta_jacobian(X)
    save(features, tmp_path / "map.skevgp")
    for copied in (pickle.loads(pickle.dumps(features)), load(tmp_path / "map.skevgp")):
        assert copied.theta_ == features.theta_
        assert_array_equal(copied.transform(X), expected[0])
        assert_allclose(copied.theta_jacobian(X), expected[1], rtol=1e-10)
    again = clone(features).fit(X)
    assert again.theta_ == {name: prior.value(0.0) for name, prior in features.parameters.items()}


POSITIVE = LogNormal(1.0, 1.0)
INVALID = {
    "unknown link": (
        NominalDynamics("cartpole", parameters={"mass(pole)": POSITIVE}),
        "no parameter 'mass(pole)'. The parameters that it can have are ['mass(x)', 'mass(theta)', 'length(theta)'].",
    ),
    "link that does not move": (
        NominalDynamics("ur5", parameters={"mass(base_link)": POSITIVE}),
        "no parameter 'mass(base_link)'",
    ),
    "fixed joint": (
        NominalDynamics("ur5", parameters={"mass(ee_fixed_joint)": POSITIVE}),
        "no parameter 'mass(ee_fixed_joint)'",
    ),
    "link's name for damping": (
        NominalDynamics("acrobot", parameters={"damping(link)": POSITIVE}),
        "no parameter 'damping(link)'",
    ),
    "damping of a model without damping": (
        NominalDynamics("ur5", parameters={"damping(elbow_joint)": POSITIVE}),
        "no damping above 0 for joint 'elbow_joint'. Add Friction(robot) to the features, which learns it.",
    ),
    "same joint": (
        NominalDynamics("ur5", parameters={"mass(tool0)": POSITIVE, "mass(wrist_3_joint)": POSITIVE}),
        "'mass(tool0)' and 'mass(wrist_3_joint)' are for the same joint",
    ),
    "negative mass": (
        NominalDynamics("acrobot", parameters={"mass(q1)": Normal(1.0, 0.2)}),
        "'mass(q1)' must be above 0, but its prior Normal(mean=1.0, std=0.2) also allows other values",
    ),
    "no prior": (NominalDynamics("acrobot", parameters={"mass(q1)": 1.0}), "'mass(q1)' has no prior"),
    "offset of a prismatic joint": (
        LinkGravity("cartpole", parameters={"offset(x)": Normal(0, 1)}),
        "can have are ['offset(theta)']",
    ),
    "offset of all joints": (
        InertiaForceGravity("cartpole", parameters={"offset": Normal(0, 1)}),
        "no parameter 'offset'",
    ),
    "parameters of a part": (
        InertiaForceGravity("cartpole", gravity=LinkGravity(parameters={"offset(theta)": Normal(0, 1)})),
        "must leave parameters to InertiaForceGravity",
    ),
    "term that is not there": (
        Friction("acrobot", terms=["coulomb"], parameters={"sharpness": POSITIVE}),
        "can have are ['stiction_velocity', 'stiction_velocity(q1)', 'stiction_velocity(q2)']",
    ),
    "one joint and all": (
        Friction("acrobot", parameters={"sharpness": POSITIVE, "sharpness(q1)": POSITIVE}),
        "'sharpness' and 'sharpness(q1)' are for the same joint",
    ),
    "negative sharpness": (
        Friction("acrobot", parameters={"sharpness": Uniform(-1, 1)}),
        "'sharpness' must be above 0",
    ),
    "no Coulomb friction": (
        RigidBodyRegressor("acrobot", friction=["viscous"], parameters={"stiction_velocity": POSITIVE}),
        "can have are []",
    ),
}


@pytest.mark.parametrize("case", INVALID)
def test_invalid_parameters_raise(case):
    features, message = INVALID[case]
    with pytest.raises((ValueError, TypeError), match=re.escape(message)):
        features.fit(rows_of(features))


@pytest.mark.parametrize("kind", [NominalDynamics, LinkGravity, InertiaForceGravity, Friction, RigidBodyRegressor])
def test_parameters_need_a_robot(kind):
    with pytest.raises(ValueError, match=r"parameters=\['mass\(q\)'\] of .* need a robot"):
        kind(parameters={"mass(q)": LogNormal(1.0, 0.1)}).fit(np.zeros((2, 3)))


# --- what the factors of NominalDynamics mean -------------------------------------------------------------------------


def at(theta, robot, X):
    features = NominalDynamics(robot, terms=TERMS, parameters={name: LogNormal(1.0, 1.0) for name in theta}).fit(X)
    features.set_theta(theta)
    return features


@pytest.mark.parametrize("robot", ["acrobot", "ur5"])
def test_derivatives_in_mass_and_inertia_are_those_of_pinocchios_regressor(robot):
    model, X = load_robot(robot), rows_of(NominalDynamics(robot))
    n, joint = model.nv, 2
    name = model.names[joint]
    found = at({f"mass({name})": 1.0, f"inertia({name})": 1.0}, robot, X).theta_jacobian(X)
    link = model.inertias[joint]
    turning = pinocchio.Inertia.Zero()
    turning.inertia = link.inertia
    body, layout, data = RigidBody(model), layout_of(robot), model.createData()
    for x, derivatives in zip(X, found, strict=True):
        q, v, u = x[:n], x[n : 2 * n], np.zeros(n)
        u[list(layout.driven)] = x[2 * n :]
        a = pinocchio.aba(model, data, q, v, u - model.damping * v)
        Y = body.torque_regressor(q[None], v[None], a[None])[0][:, 10 * (joint - 1) : 10 * joint]
        # dq̈/dp = -M⁻¹ Y_p
        parameters = np.column_stack([link.toDynamicParameters(), turning.toDynamicParameters()])
        expected = -np.linalg.solve(body.mass_matrix(q), Y @ parameters)
        assert_allclose(derivatives[:n], expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def arm(length=1.0, mass=1.0, armature=1.0):
    """Three joints about skew axes. The factors are for the second one."""
    place, inertia = length * np.array([0.1, 0.2, -0.3]), mass * length**2 * np.array([0.3, 0.2, 0.25])
    first = Link("a", "revolute", (0.0, 1.0, 0.0), 1.0, (0.1, 0.0, -0.5), (0.1, 0.2, 0.15), damping=0.2, armature=0.1)
    second = Link("b", "revolute", (0.6, 0.0, 0.8), 2.0 * mass, tuple(place), tuple(inertia), (0.0, 0.3, -1.0))
    third = Link("c", "prismatic", (0.0, 0.0, 1.0), 0.5, (0.0, 0.1, 0.1), xyz=(0.0, 0.5 * length, -0.7 * length))
    return System("arm", (first, replace(second, rpy=(0.1, 0.2, 0.3), armature=0.2 * armature), third))


def test_factors_are_those_of_a_robot_built_with_them():
    X = rows_of(NominalDynamics(arm()))
    found = at({"length(b)": 1.3, "mass(b)": 0.7, "armature(b)": 1.5}, arm(), X).transform(X)
    expected = NominalDynamics(arm(1.3, 0.7, 1.5), terms=TERMS).fit_transform(X)
    assert_allclose(found, expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max())


def test_factors_undo_errors_of_the_model():
    model = load_robot("acrobot").copy()
    wrong = perturb_robot(model, 0.2, random_state=0)
    for link, own in zip(wrong.inertias, model.inertias, strict=True):
        link.lever = own.lever
    theta = {}
    for joint in (1, 2):
        mass = model.inertias[joint].mass / wrong.inertias[joint].mass
        theta[f"mass({model.names[joint]})"] = mass
        inertia = np.linalg.norm(model.inertias[joint].inertia) / np.linalg.norm(wrong.inertias[joint].inertia)
        theta[f"inertia({model.names[joint]})"] = inertia / mass
    X = rows_of(NominalDynamics("acrobot"))
    expected = NominalDynamics("acrobot", terms=TERMS).fit_transform(X)
    assert_allclose(at(theta, wrong, X).transform(X), expected, rtol=1e-9, atol=1e-10 * np.abs(expected).max())


# --- fits -------------------------------------------------------------------------------------------------------------

QUICK = {"n_inducing": 10, "sharing": "all", "noise_cv": None, "random_state": 0}


@pytest.fixture
def few_starts(monkeypatch):
    """Trials of starts would take half of a small fit."""
    monkeypatch.setattr(theta, "_TRIED", 4)
    monkeypatch.setattr(theta, "_IMPROVED", 1)


def assert_found(model, expected, relative=0.1):
    for name, value in expected.items():
        assert abs(model.theta_[name] - value) < 3.0 * model.theta_std_[name], name
        assert model.theta_std_[name] < relative * abs(value), name


@pytest.mark.long
def test_fit_finds_wrong_mass_and_length():
    model = load_robot("acrobot").copy()
    first, second = model.inertias[1], model.inertias[2]
    first.mass, first.inertia = 1.2 * first.mass, 1.2 * first.inertia
    second.lever, second.inertia = 1.2 * second.lever, 1.44 * second.inertia
    data = make_dynamics(model, 8, 50, dt=0.01, noise=0.003, random_state=0)
    parameters = {"length(q2)": LogNormal(1.0, 0.3), "mass(q1)": LogNormal(1.0, 0.3)}
    nominal = NominalDynamics("acrobot", dt=0.01, parameters=parameters)
    features = FeatureUnion([("state", InertiaForce("acrobot", dt=0.01)), ("nominal", nominal)])
    fitted = EVGPRegressor(features, n_inducing=20, random_state=0).fit(data.data, data.target)
    assert_found(fitted, {"length(q2)": 1.2, "mass(q1)": 1.2})


@pytest.mark.parametrize("kind", ["sine", pytest.param("levers", marks=pytest.mark.long)])
@pytest.mark.usefixtures("few_starts")
def test_fit_finds_the_offset_of_an_encoder(kind):
    offset, dt = 0.15, 0.01
    data = make_dynamics("pendulum", 4, 25, dt=dt, noise=0.001, random_state=0)
    X, y = data.data.copy(), data.target.copy()
    X[:, 0] -= offset
    y[:, 0] -= offset
    parameters = {"offset(q)": Normal(0.0, 0.2)}
    features = InertiaForceGravity("pendulum", dt=dt, parameters=parameters)
    if kind == "levers":
        # With one lever. Two would represent any offset.
        gravity = LinkGravity("pendulum", dt=dt, axes="x", parameters=parameters)
        features = FeatureUnion([("state", InertiaForce("pendulum", dt=dt)), ("gravity", gravity)])
    model = EVGPRegressor(features, **QUICK)
    assert_found(model.fit(X, y), {"offset(q)": offset}, 0.3)


@pytest.mark.usefixtures("few_starts")
def test_fit_finds_the_numbers_of_friction():
    rng, dt = np.random.default_rng(0), 0.01
    X = rng.uniform(-1.0, 1.0, (100, 3))
    true = Friction("pendulum", stiction_velocity=0.02, stribeck_velocity=0.3, sharpness=1.5, dt=dt)
    acceleration = 4.0 * X[:, 2] - true.fit_transform(X) @ [0.5, 1.0, 2.0]
    y = np.column_stack([X[:, 0] + dt * X[:, 1], X[:, 1] + dt * acceleration + 1e-4 * rng.normal(size=100)])
    y[:, 0] += 1e-4 * rng.normal(size=100)
    parameters = {"stribeck_velocity": LogNormal(0.5, 0.5), "sharpness": Uniform(0.5, 2.5)}
    friction = Friction("pendulum", stiction_velocity=0.02, dt=dt, parameters=parameters)
    features = FeatureUnion([("state", InertiaForce("pendulum", dt=dt)), ("friction", friction)])
    model = EVGPRegressor(features, **QUICK)
    assert_found(model.fit(X, y), {"stribeck_velocity": 0.3, "sharpness": 1.5}, 0.2)


@pytest.mark.usefixtures("few_starts")
def test_fit_finds_the_stiction_velocities_of_joints():
    rng = np.random.default_rng(0)
    X = rng.normal(size=(300, 6)) * [1.0, 1.0, 0.3, 0.3, 1.0, 1.0]
    true = RigidBodyRegressor("acrobot", stiction_velocity=[0.1, 0.3])
    weights = true.coef_prior(2)[0].copy()
    weights[22:24], weights[24:26] = 0.5, 2.0  # viscous and Coulomb friction
    y = true.fit_transform(X) @ weights + 0.02 * rng.normal(size=(300, 2))
    parameters = {f"stiction_velocity(q{joint})": LogNormal(0.2, 1.0) for joint in (1, 2)}
    body = RigidBodyRegressor("acrobot", parameters=parameters)
    fitted = EVGPRegressor(body, **QUICK | {"sharing": "none"}).fit(X, y)
    assert_found(fitted, {"stiction_velocity(q1)": 0.1, "stiction_velocity(q2)": 0.3})
    assert "stiction_velocity(q1) [rad/s]" in str(fitted.summary())
