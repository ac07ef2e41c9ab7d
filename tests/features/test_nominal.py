import pickle

import numpy as np
import pandas as pd
import pinocchio
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.pipeline import FeatureUnion

from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics, perturb_robot, simulate
from skevgp.features import AngleEncoder, InertiaForce, InertiaForceGravity, LinkGravity, NominalDynamics
from skevgp.fitting.prior import CoefPrior, InData, resolved
from skevgp.metrics import prediction_error
from skevgp.robots import System, layout_of, load_robot
from skevgp.robots.systems import Link

ROBOTS = ["pendulum", "cartpole", "acrobot", "iiwa14", "ur5", "panda", "kinova"]
TERMS = ("acceleration", "gravity", "bias", "input")
DT = 0.03


def rows(robot, n_rows=6, seed=0):
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (n_rows, layout_of(robot).n_columns))


def parts(robot, X):
    """Positions, velocities and the joint forces B u."""
    layout = layout_of(robot)
    n = layout.n_joints
    force = np.zeros((len(X), n))
    for column, joint in enumerate(layout.driven):
        force[:, joint] = X[:, 2 * n + column]
    return X[:, :n], X[:, n : 2 * n], force


def by_pinocchio(robot, term, X):
    model = load_robot(robot)
    data = model.createData()
    values = []
    for q, v, f in zip(*parts(robot, X), strict=True):
        if term == "acceleration":
            values.append(pinocchio.aba(model, data, q, v, f - model.damping * v).copy())
        elif term == "gravity":
            values.append(pinocchio.computeGeneralizedGravity(model, data, q).copy())
        elif term == "bias":
            values.append(pinocchio.rnea(model, data, q, v, np.zeros_like(v)).copy())
        else:
            values.append(np.linalg.solve(pinocchio.crba(model, data, q), f))
    return np.array(values)


def union(robot, nominal):
    return FeatureUnion([("if", InertiaForce(robot)), ("nominal", nominal)])


def mean_of(features, X, n_outputs):
    """The prior mean of the weights. It does not depend on the data."""
    width = features.transform(X).shape[1]
    data = InData(
        (n_outputs, width), lambda learned: np.ones((n_outputs, width)), np.ones(width), lambda mean: np.ones(n_outputs)
    )
    return resolved(CoefPrior(), features, X, data, n_outputs).mean


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("term", TERMS)
def test_term_is_what_pinocchio_says_row_by_row(robot, term):
    X = rows(robot)
    expected = by_pinocchio(robot, term, X)
    features = NominalDynamics(robot, terms=[term]).fit_transform(X)
    assert_allclose(features, expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max())


def test_only_the_elbow_of_the_acrobot_is_driven():
    still = np.array([[0.0, 0.0, 0.0, 0.0, 1.0]])
    mass = pinocchio.crba(load_robot("acrobot"), load_robot("acrobot").createData(), np.zeros(2))
    features = NominalDynamics("acrobot", terms=["input"]).fit_transform(still)
    assert_allclose(features, [np.linalg.inv(mass)[:, 1]], rtol=1e-12)


def test_damping_of_the_model_is_subtracted():
    damped, free = load_robot("iiwa14"), load_robot("iiwa14")
    damped.damping = np.linspace(0.1, 0.7, 7)
    X = rows("iiwa14")
    _, v, _ = parts("iiwa14", X)
    difference = NominalDynamics(damped).fit_transform(X) - NominalDynamics(free).fit_transform(X)
    model, expected = load_robot("iiwa14"), []
    for x, velocity in zip(X, v, strict=True):
        mass = pinocchio.crba(model, model.createData(), x[:7])
        expected.append(-np.linalg.solve(mass, damped.damping * velocity))
    assert_allclose(difference, expected, rtol=1e-9, atol=1e-11)


def test_reflected_inertia_of_the_model_counts():
    light = load_robot("iiwa14")
    light.armature = np.zeros(7)
    X = rows("iiwa14")
    assert (
        np.abs(NominalDynamics(light).fit_transform(X)).max()
        > 10 * np.abs(NominalDynamics("iiwa14").fit_transform(X)).max()
    )


def test_terms_come_in_the_order_given():
    X = rows("acrobot")
    both = NominalDynamics("acrobot", terms=["bias", "acceleration"]).fit(X)
    each = [NominalDynamics("acrobot", terms=[term]).fit_transform(X) for term in ("bias", "acceleration")]
    assert_array_equal(both.transform(X), np.hstack(each))
    assert both.get_feature_names_out().tolist() == ["bias torque(q1)", "bias torque(q2)", "acc(q1)", "acc(q2)"]
    alone = [NominalDynamics("acrobot", terms=[term]) for term in ("bias", "acceleration")]
    assert_array_equal(both.coef_prior(4)[1], np.hstack([each.coef_prior(4)[1] for each in alone]))
    assert_array_equal(both.coef_groups(4), np.hstack([each.coef_groups(4) for each in alone]))


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("terms", [TERMS, ["acceleration"]])
def test_prior_mean_beside_inertia_force_is_eulers_step_of_the_model(robot, terms):
    X, n = rows(robot), layout_of(robot).n_joints
    features = union(robot, NominalDynamics(robot, terms=terms))
    H = features.fit_transform(X)
    mean = mean_of(features, X, 2 * n)
    _, v, _ = parts(robot, X)
    step = np.hstack([v, by_pinocchio(robot, "acceleration", X)])
    assert_allclose(H @ mean.T, X[:, : 2 * n] + DT * step, rtol=1e-9, atol=1e-10 * np.abs(step).max())


def test_prior_mean_is_what_a_short_step_does():
    dt, X = 1e-4, rows("acrobot")
    features = FeatureUnion([("if", InertiaForce("acrobot", dt=dt)), ("nominal", NominalDynamics("acrobot", dt=dt))])
    H = features.fit_transform(X)
    mean = mean_of(features, X, 4)
    after = simulate("acrobot", X[:, :4], X[:, np.newaxis, 4:], dt)[:, 1]
    assert_allclose(H @ mean.T, after, rtol=0, atol=2e-6)
    assert np.abs(X[:, :4] - after).max() > 1e-4


def test_midpoint_predicts_velocities_to_second_order():
    """Errors are of third order in the time step. Those of Euler's rule are of second order."""
    X, errors = rows("acrobot"), {}
    for term in ("acceleration", "midpoint"):
        for dt in (0.004, 0.002):
            a = NominalDynamics("acrobot", terms=[term], dt=dt).fit_transform(X)
            after = simulate("acrobot", X[:, :4], X[:, np.newaxis, 4:], dt)[:, 1]
            errors[term, dt] = np.abs(X[:, 2:4] + dt * a - after[:, 2:]).max()
    assert errors["acceleration", 0.004] / errors["acceleration", 0.002] == pytest.approx(4.0, rel=0.1)
    assert errors["midpoint", 0.004] / errors["midpoint", 0.002] == pytest.approx(8.0, rel=0.1)


# For the velocity of each joint: the model's acceleration (m), torques of gravity (g) and bias (b), and others (.).
@pytest.mark.parametrize(
    ("terms", "groups"),
    [
        (["acceleration"], ["m.", ".m"]),
        (["gravity"], ["gg", "gg"]),
        (["bias"], ["bb", "bb"]),
        (["input"], ["m.", ".m"]),
        (["acceleration", "input"], ["m...", ".m.."]),
        (["acceleration", "midpoint"], ["..m.", "...m"]),
        (["input", "acceleration"], ["..m.", "...m"]),
        (["input", "gravity", "bias"], ["m.ggbb", ".mggbb"]),
    ],
)
def test_prior_knows_which_acceleration_moves_which_velocity(terms, groups):
    features = NominalDynamics("acrobot", terms=terms, dt=0.1, model_error=0.5, unknown_ratio=7.0, other_ratio=0.2)
    groups = np.array([list(row) for row in groups])
    names = {"m": "model", "g": "gravity torques", "b": "bias torques", ".": "other accelerations"}
    assert_array_equal(features.coef_groups(4), np.tile(np.vectorize(names.get)(groups), (2, 1)))
    mean, own = features.coef_prior(4)
    assert_allclose(mean, np.vstack([np.zeros(groups.shape), np.where(groups == "m", 0.1, 0.0)]))
    assert_allclose(own[2:], np.where(groups == "m", 0.1 * 0.5, np.nan))
    rng = np.random.default_rng(0)
    left_over, size = rng.uniform(1.0, 2.0, 4), rng.uniform(1.0, 2.0, groups.shape[1])
    in_units = features.coef_scale(left_over, size)
    ratio = np.vectorize({"m": np.nan, "g": 7.0, "b": 7.0, ".": 0.2}.get)(groups)
    assert_allclose(in_units[2:], ratio * left_over[2:, np.newaxis] / size)
    # A velocity that changes moves its position by Δt times as much.
    assert_allclose(own[:2], 0.1 * own[2:])
    assert_allclose(in_units[:2], 0.1 * in_units[2:])


def test_only_a_robot_gives_a_prior():
    assert not hasattr(NominalDynamics(), "coef_prior")
    assert hasattr(NominalDynamics("ur5"), "coef_prior")


def test_features_are_named_after_term_and_joint():
    names = NominalDynamics("cartpole", terms=TERMS).fit(rows("cartpole")).get_feature_names_out()
    assert names.tolist() == [
        "acc(x)",
        "acc(theta)",
        "gravity torque(x)",
        "gravity torque(theta)",
        "bias torque(x)",
        "bias torque(theta)",
        "acc by u(x)",
        "acc by u(theta)",
    ]


@pytest.mark.parametrize(
    "terms",
    [["speed"], ["acceleration", "friction"], [], ["gravity", "gravity"], [3], [["bias"]], np.array(["mass"])],
)
def test_unknown_terms_list_the_known_ones(terms):
    message = r"terms=.* must be one or more of \['acceleration', 'midpoint', 'gravity', 'bias', 'input'\], each once"
    with pytest.raises(ValueError, match=message):
        NominalDynamics("acrobot", terms=terms).fit(rows("acrobot"))
    with pytest.raises(ValueError, match=message):
        NominalDynamics("acrobot", terms=terms).coef_prior(4)


def test_midpoint_needs_one_time_step():
    with pytest.raises(ValueError, match="\"midpoint\" needs a number as dt; got dt='column'"):
        NominalDynamics("acrobot", terms=["midpoint"], dt="column").fit(np.full((2, 6), 0.1))


def test_term_alone_is_no_sequence():
    with pytest.raises(
        ValueError, match="The 'terms' parameter of NominalDynamics must be an array-like. Got 'gravity'"
    ):
        NominalDynamics("acrobot", terms="gravity").fit(rows("acrobot"))


def test_model_of_another_size_raises():
    with pytest.raises(ValueError, match=r"X has 5 columns, but NominalDynamics of the robot 'iiwa14' needs 21: \['"):
        NominalDynamics(load_robot("iiwa14")).fit(rows("acrobot"))


@pytest.mark.parametrize("parameter", ["dt", "model_error", "unknown_ratio", "other_ratio"])
@pytest.mark.parametrize("value", [-1.0, np.inf, np.nan, "much"])
def test_invalid_parameter_raises(parameter, value):
    with pytest.raises(ValueError, match=f"The '{parameter}' parameter of NominalDynamics must be"):
        NominalDynamics("acrobot", **{parameter: value}).coef_prior(4)


def planar_arm(*masses):
    """Point masses at the ends of links of 1 m, on joints about y."""
    return System(
        "arm",
        tuple(
            Link(f"q{i}", "revolute", (0.0, 1.0, 0.0), mass, com=(0.0, 0.0, -1.0), xyz=(0.0, 0.0, -1.0 * (i > 0)))
            for i, mass in enumerate(masses)
        ),
    )


def test_link_without_mass_at_the_tip_is_an_error_that_names_its_joint():
    with pytest.raises(ValueError, match=r"of the robot 'arm' are not finite: its joints \['q1', 'q2'\] move no mass"):
        NominalDynamics(planar_arm(1.0, 0.0, 0.0)).fit(np.zeros((2, 9)))


def test_link_without_mass_in_the_middle_matters_in_singular_positions_only():
    features = NominalDynamics(planar_arm(0.0, 1.0)).fit(np.zeros((2, 6)))
    assert np.isfinite(features.transform([[0.0, 1.0, 0.0, 0.0, 1.0, 1.0]])).all()
    with pytest.raises(ValueError, match=r"not finite: its mass matrix is singular at q = \[0\.5, 0\.0\]"):
        features.transform([[0.0, 1.0, 0.0, 0.0, 1.0, 1.0], [0.5, 0.0, 0.0, 0.0, 1.0, 1.0]])


def test_velocities_whose_squares_overflow_raise():
    features = NominalDynamics("acrobot").fit(rows("acrobot"))
    with pytest.raises(ValueError, match="is singular at .* or q̇ or u is too large there"):
        features.transform([[0.1, 0.2, 1e200, 1e200, 0.0]])


def error(model, data):
    train, test = data
    return prediction_error(test.target, model.fit(train.data, train.target).predict(test.data))


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:The bound was still rising")
@pytest.mark.filterwarnings("ignore::skevgp.exceptions.DependentRowsWarning")
def test_invalid_model_and_encoded_angles_help_the_regressor():
    errors = []
    for seed in (0, 200):
        data = [make_dynamics("acrobot", n_trajectories=n, n_steps=40, random_state=seed + n) for n in (16, 20)]
        nominal = union("acrobot", NominalDynamics(perturb_robot("acrobot", 0.2, random_state=seed)))
        settings = {"n_inducing": 20, "max_iter": 60, "random_state": 0}
        models = (
            EVGPRegressor(InertiaForceGravity("acrobot"), **settings),
            EVGPRegressor(nominal, **settings),
            EVGPRegressor(nominal, kernel_map=AngleEncoder("acrobot"), **settings),
        )
        errors.append([error(model, data) for model in models])
    plain, with_model, with_both = np.mean(errors, axis=0)
    assert with_model < 0.7 * plain
    assert with_both < with_model


# --- what a fitted map knows of the robot --------------------------------------------------------------------------


def test_fitted_map_does_not_follow_the_users_model():
    model = load_robot("acrobot")
    X = np.random.default_rng(0).normal(size=(3, 5))
    fitted = NominalDynamics(model, terms=["acceleration", "gravity", "input"]).fit(X)
    before = fitted.transform(X)
    model.inertias[1].mass = 9.0
    model.damping = np.full(2, 5.0)
    assert_array_equal(fitted.transform(X), before)
    assert_array_equal(pickle.loads(pickle.dumps(fitted)).transform(X), before)


@pytest.mark.parametrize("feature_map", [InertiaForce, InertiaForceGravity, LinkGravity, NominalDynamics, AngleEncoder])
def test_columns_with_the_robots_names_must_be_in_its_order(feature_map):
    names = layout_of("acrobot").column_names
    rows = np.random.default_rng(0).normal(size=(3, 5))
    with pytest.raises(ValueError, match=r"robot's order \['q1', 'q2', 'dq1/dt'.*got \['u_q2'"):
        feature_map("acrobot").fit(pd.DataFrame(rows, columns=names[::-1]))
    for columns in (names, list("abcde")):
        assert len(feature_map("acrobot").fit_transform(pd.DataFrame(rows, columns=columns))) == 3
