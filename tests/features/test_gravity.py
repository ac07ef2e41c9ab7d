import pickle
import sys

import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.pipeline import FeatureUnion

from skevgp import EVGPRegressor
from skevgp.features import InertiaForce, InertiaForceGravity, LinkGravity
from skevgp.robots import SYSTEMS, layout_of, load_robot
from skevgp.robots.systems import Link, System

G = 9.81
LIFT = System(
    "lift",
    links=(
        Link("z", "prismatic", (0.0, 0.0, 1.0), mass=2.0),
        Link("q", "revolute", (0.6, 0.0, 0.8), mass=1.0, com=(0.1, 0.2, 0.3), xyz=(1.0, 0.0, 0.0), rpy=(0.3, 0.2, 0.1)),
        Link("s", "prismatic", (0.48, -0.6, 0.64), mass=1.0, rpy=(0.3, -0.2, 0.1)),
    ),
)
# Turning about z, y, -y, x and a skew axis; sliding; with joints without limits; with two fingers on one hand.
ROBOTS = [*sorted(SYSTEMS), "ur5", "panda", "kinova", "double_pendulum", "double_pendulum_continuous", LIFT]


def rows(robot, n_rows=7, seed=0):
    return np.random.default_rng(seed).uniform(-3.0, 3.0, (n_rows, layout_of(robot).n_columns))


def by_forward_kinematics(robot, q):
    """The definition, link by link: (lever × Rᵀg)·u_z of both levers, or u_z·Rᵀg."""
    model = load_robot(robot)
    data, features = model.createData(), []
    pinocchio.forwardKinematics(model, data, q)
    for joint in range(1, model.njoints):
        weight = data.oMi[joint].rotation.T @ model.gravity.linear
        motion = pinocchio.computeJointJacobian(model, model.createData(), q, joint).reshape(6, -1)[:, joint - 1]
        if np.any(motion[:3]):
            features.append(motion[:3] @ weight)
            continue
        u_z = motion[3:]
        follower = {0: 1, 1: 2, 2: 0}[int(np.argmax(np.abs(u_z)))]
        u_x = np.eye(3)[follower] - u_z[follower] * u_z
        u_x /= np.sqrt(u_x @ u_x)
        u_y = np.cross(u_z, u_x)
        features += [np.cross(u_x, weight) @ u_z, np.cross(u_y, weight) @ u_z]
    return np.array(features)


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: getattr(robot, "name", robot))
def test_features_follow_from_forward_kinematics(robot):
    X, n = rows(robot), layout_of(robot).n_joints
    expected = [by_forward_kinematics(robot, x[:n]) for x in X]
    assert_allclose(LinkGravity(robot).fit_transform(X), expected, rtol=1e-12, atol=1e-13 * G)


def test_closed_form_of_the_acrobot():
    X = rows("acrobot")
    first, second = X[:, 0], X[:, 0] + X[:, 1]
    expected = G * np.column_stack([np.sin(first), np.cos(first), np.sin(second), np.cos(second)])
    assert_allclose(LinkGravity("acrobot").fit_transform(X), expected, rtol=1e-12)


def test_gravity_is_that_of_the_model():
    model = load_robot("pendulum").copy()
    model.gravity.linear = np.array([0.0, 0.0, -1.62])
    X = rows("pendulum")
    assert_allclose(LinkGravity(model).fit_transform(X) * G, LinkGravity("pendulum").fit_transform(X) * 1.62)


def residual_of_gravity(robot, joint):
    """Share of a joint's gravity torque that the features of it and of the links after it leave over."""
    model, X = load_robot(robot), rows(robot, 100)
    data = model.createData()
    torque = [pinocchio.computeGeneralizedGravity(model, data, x[: model.nv])[joint] for x in X]
    H = LinkGravity(robot, links=range(joint, model.nv)).fit_transform(X)
    weights = np.linalg.lstsq(H, np.array(torque), rcond=None)[0]
    return np.linalg.norm(torque - H @ weights) / np.linalg.norm(torque)


@pytest.mark.parametrize(
    ("robot", "joint"),
    [
        ("pendulum", 0),
        ("acrobot", 0),
        ("acrobot", 1),
        ("double_pendulum", 0),
        ("double_pendulum", 1),
        ("ur5", 1),
        ("ur5", 2),
        ("ur5", 3),
        ("iiwa14", 5),
        ("kinova", 5),
        ("xarm7", 6),
    ],
)
def test_gravity_is_linear_in_the_features_where_the_later_joints_are_parallel(robot, joint):
    assert residual_of_gravity(robot, joint) < 1e-10


@pytest.mark.parametrize(("axes", "kept"), [("xy", [2, 3, 12, 13]), ("x", [2, 12])])
@pytest.mark.parametrize("links", [["q2", "q7"], [1, 6], ("q2", 6), np.array([1, 6])])
def test_links_are_chosen_by_name_or_index(axes, kept, links):
    X = rows("iiwa14")
    chosen = LinkGravity("iiwa14", axes=axes, links=links).fit_transform(X)
    assert_array_equal(chosen, LinkGravity("iiwa14").fit_transform(X)[:, kept])


def test_links_come_in_the_order_asked_for():
    features = LinkGravity("iiwa14", axes="x", links=["q5", "q3"]).fit(rows("iiwa14"))
    assert features.get_feature_names_out().tolist() == ["gravity(q5, u_x)", "gravity(q3, u_x)"]


@pytest.mark.parametrize("links", [["q8"], [7], [-1], [True], [1.0], [None]])
def test_links_that_are_none_list_the_links(links):
    message = r"links=\[.*\] must be indices or names of the links \['q1', 'q2', .*, 'q7'\]"
    with pytest.raises(ValueError, match=message):
        LinkGravity("iiwa14", links=links).fit(rows("iiwa14"))


@pytest.mark.parametrize("links", [["q2", 1], np.array([1, 1])])
def test_link_named_twice_raises(links):
    with pytest.raises(ValueError, match=r"links=\[.*1.*\] must not name a link twice"):
        LinkGravity("iiwa14", links=links).fit(rows("iiwa14"))


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"axes": "xz"}, r"'axes' parameter .* among {('xy', 'x'|'x', 'xy')}. Got 'xz'"),
        ({"axes": ["x"]}, "'axes' parameter"),
        ({"links": "q2"}, "'links' parameter .* Got 'q2'"),
        ({"links": 2}, "'links' parameter .* Got 2"),
        ({"inverse_length": -1.0}, "'inverse_length' parameter .* Got -1.0"),
        ({"inverse_length": np.inf}, "'inverse_length' parameter .* Got inf"),
        ({"unknown_ratio": -1.0}, "'unknown_ratio' parameter .* Got -1.0"),
        ({"coupling_ratio": np.nan}, "'coupling_ratio' parameter .* Got nan"),
    ],
)
@pytest.mark.parametrize("robot", ["iiwa14", None])
def test_invalid_parameter_raises(parameters, message, robot):
    with pytest.raises(ValueError, match=message):
        LinkGravity(robot, **parameters).fit(rows("iiwa14"))


def test_without_pinocchio_the_message_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    with pytest.raises(ImportError, match="pip install pin"):
        LinkGravity("pendulum").fit(rows("pendulum"))


def test_fitted_map_needs_no_pinocchio(monkeypatch):
    X = rows("ur5")
    features = LinkGravity("ur5").fit(X)
    expected, stored = features.transform(X), pickle.dumps(features)
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    loaded = pickle.loads(stored)
    assert_array_equal(loaded.transform(X), expected)
    assert loaded.coef_prior(12)[0].shape == (12, 12)


def test_names_say_link_and_lever():
    names = LinkGravity(LIFT).fit(rows(LIFT)).get_feature_names_out()
    assert names.tolist() == ["gravity(z)", "gravity(q, u_x)", "gravity(q, u_y)", "gravity(s)"]


@pytest.mark.parametrize("fitted", [False, True])
def test_prior_knows_which_joints_bear_a_link(fitted):
    """A weight for a velocity is Δt / l, with Δt = 0.03 s if it is not known, or less if the data leave less."""
    prior = {"inverse_length": 2.0, "unknown_ratio": 5.0, "coupling_ratio": 0.5}
    features = LinkGravity("iiwa14", axes="x", links=["q1", "q3", "q7"], **prior)
    if fitted:
        features.fit(rows("iiwa14"))
    mean, own = features.coef_prior(14)
    assert_array_equal(mean, np.zeros((14, 3)))
    assert np.isnan(own).all()
    borne = np.arange(7)[:, np.newaxis] < [1, 3, 7]
    assert_array_equal(features.coef_groups(14), np.tile(np.where(borne, "gravity", "coupling"), (2, 1)))
    share, size = np.where(borne, 1.0, 0.5), np.array([1.0, 2.0, 4.0])
    largest = np.vstack([0.03**2 * 2.0 * share, 0.03 * 2.0 * share])
    assert_allclose(features.coef_scale(np.full(14, 1e3), size), largest, rtol=1e-14)
    left_over = 1e-5 * np.arange(1.0, 15.0)
    in_units = np.tile(5.0 * share, (2, 1)) * left_over[:, np.newaxis] / size
    assert_allclose(features.coef_scale(left_over, size), in_units, rtol=1e-14)


@pytest.mark.parametrize("length", [0.1, 2.0])
def test_weight_of_a_point_mass_is_one_over_its_length(length):
    """Then a standard deviation of 1 / l is one of 100 % of the deceleration."""
    link = Link("q", "revolute", (0.0, 1.0, 0.0), mass=3.0, com=(0.0, 0.0, -length))
    system, X = System("simple", links=(link,)), rows("pendulum")
    model, still = load_robot(system), np.zeros(1)
    acceleration = [pinocchio.aba(model, model.createData(), x[:1], still, still)[0] for x in X]
    features = LinkGravity(system, axes="x", inverse_length=1.0 / length)
    scale = features.coef_scale(np.full(2, 1e3), np.ones(1))
    assert_allclose(-features.fit_transform(X)[:, 0] * scale[1] / 0.03, acceleration)


def test_outputs_choose_states():
    features = LinkGravity("acrobot", outputs=["dq1/dt", "q2"], inverse_length=2.0, coupling_ratio=0.0)
    mean, _ = features.coef_prior(2)
    assert_array_equal(mean, np.zeros((2, 4)))
    scale = features.coef_scale(np.full(2, 1e3), np.ones(4))
    assert_allclose(scale, [[0.06, 0.06, 0.06, 0.06], [0.0, 0.0, 0.0018, 0.0018]], rtol=1e-14)


def test_union_is_inertia_force_gravity_in_two_parts():
    X = rows("iiwa14", 60)
    inertia, levers = InertiaForce("iiwa14", other_ratio=1.0), LinkGravity("iiwa14", links=range(1, 7))
    union, whole = FeatureUnion([("if", inertia), ("g", levers)]), InertiaForceGravity("iiwa14", other_ratio=1.0)
    H = whole.fit_transform(X)
    assert_array_equal(union.fit_transform(X), H)
    y = np.random.default_rng(1).normal(size=(60, 14))
    of_union, of_whole = (EVGPRegressor(features, n_inducing=5, max_iter=0).fit(X, y) for features in (union, whole))
    assert_array_equal(of_union.coef_prior_mean_, of_whole.coef_prior_mean_)
    assert_allclose(of_union.coef_prior_scale_, of_whole.coef_prior_scale_, rtol=1e-12)


def test_gravity_inside_ifg_leaves_the_outputs_to_it():
    with pytest.raises(ValueError, match=r"must leave outputs to InertiaForceGravity"):
        InertiaForceGravity("acrobot", gravity=LinkGravity(outputs=["q1"])).coef_prior(4)
