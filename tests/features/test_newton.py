import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from skevgp.features import InertiaForce, InertiaForceGravity, LinkGravity
from skevgp.robots import layout_of, load_robot
from skevgp.robots.systems import Link, System

MAPS = [InertiaForce, InertiaForceGravity]
COLUMNS = {
    "pendulum": ["q", "dq/dt", "u_q"],
    "cartpole": ["x", "theta", "dx/dt", "dtheta/dt", "u_x"],
    "acrobot": ["q1", "q2", "dq1/dt", "dq2/dt", "u_q2"],
}
DT, GAMMA, G1, G2 = 0.1, 0.2, 0.3, 0.4  # DT * 2, DT * 3 and DT * 4: the guesses below

# The paper's eq. inertia_prior and gravity_prior, and section III-B.
IF_MEANS = {
    "pendulum": [[1, DT, 0], [0, 1, GAMMA]],
    "cartpole": [[1, 0, DT, 0, 0], [0, 1, 0, DT, 0], [0, 0, 1, 0, GAMMA], [0, 0, 0, 1, 0]],
    "acrobot": [[1, 0, DT, 0, 0], [0, 1, 0, DT, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, GAMMA]],
}
IFG_MEANS = {
    "pendulum": [[1, DT, 0, 0], [0, 1, GAMMA, -G1]],
    "cartpole": [[1, 0, DT, 0, 0, 0], [0, 1, 0, DT, 0, 0], [0, 0, 1, 0, GAMMA, 0], [0, 0, 0, 1, 0, -G1]],
    "acrobot": [
        [1, 0, DT, 0, 0, 0, 0],
        [0, 1, 0, DT, 0, 0, 0],
        [0, 0, 1, 0, 0, -G1, -G2],
        [0, 0, 0, 1, GAMMA, 0, -G2],
    ],
}
GAIN = {"pendulum": 3.0, "cartpole": [3.0], "acrobot": [3.0, 4.0]}
# Entries that physics knows (k), names without a value (u), and leaves at zero (.).
IFG_ROLES = {
    "pendulum": ["kk..", ".kuu"],
    "cartpole": ["k.k...", ".k.k..", "..k.u.", "...k.u"],
    "acrobot": ["k.k....", ".k.k...", "..k..uu", "...ku.u"],
}


def rows(name, n_rows=5):
    return np.random.default_rng(0).normal(size=(n_rows, len(COLUMNS[name])))


def scales(roles, known, unknown, free):
    return [[{"k": known, "u": unknown, ".": free}[role] for role in row] for row in roles]


@pytest.mark.parametrize("name", COLUMNS)
def test_inertia_force_is_the_row_itself(name):
    X = rows(name)
    assert_array_equal(InertiaForce(name).fit_transform(X), X)


@pytest.mark.parametrize(
    ("name", "angles"),
    [
        ("pendulum", lambda q: q[:, [0]]),
        ("cartpole", lambda q: q[:, [1]]),
        ("acrobot", lambda q: np.column_stack([q[:, 0], q[:, 0] + q[:, 1]])),
    ],
)
def test_gravity_adds_the_sine_of_each_angle_against_the_vertical(name, angles):
    X = rows(name)
    assert_allclose(InertiaForceGravity(name).fit_transform(X), np.hstack([X, np.sin(angles(X))]), rtol=1e-15)


@pytest.mark.parametrize("name", COLUMNS)
def test_prior_mean_of_inertia_force_is_that_of_the_paper(name):
    features = InertiaForce(name, dt=DT, inverse_inertia=2.0)
    mean, _ = features.coef_prior(len(IF_MEANS[name]))
    assert_allclose(mean, IF_MEANS[name], rtol=1e-15)


@pytest.mark.parametrize("name", COLUMNS)
def test_prior_mean_with_gravity_is_that_of_the_paper(name):
    features = InertiaForceGravity(name, dt=DT, inverse_inertia=[2.0], gravity_gain=GAIN[name])
    mean, _ = features.coef_prior(len(IFG_MEANS[name]))
    assert_allclose(mean, IFG_MEANS[name], rtol=1e-15)


@pytest.mark.parametrize("name", COLUMNS)
def test_without_guesses_only_eulers_rule_is_known(name):
    mean, _ = InertiaForceGravity(name).coef_prior(len(IFG_ROLES[name]))
    euler = scales(IFG_ROLES[name], known=1.0, unknown=0.0, free=0.0)
    assert_array_equal(mean != 0, np.array(euler) != 0)
    assert set(mean[mean != 0]) == {1.0, 0.03}


@pytest.mark.parametrize("name", COLUMNS)
def test_known_unknown_and_free_entries_have_their_own_scales(name):
    features = InertiaForceGravity(name, known_scale=0.01, unknown_scale=5.0, free_scale=0.5)
    _, scale = features.coef_prior(len(IFG_ROLES[name]))
    assert_array_equal(scale, scales(IFG_ROLES[name], 0.01, 5.0, 0.5))


def test_free_scale_of_zero_pins_the_zeros():
    mean, scale = InertiaForceGravity("acrobot", free_scale=0.0, gravity_gain=1.0, inverse_inertia=1.0).coef_prior(4)
    assert_array_equal(scale == 0, mean == 0)


@pytest.mark.parametrize("outputs", [["dq2/dt", "q1"], [3, 0], ("dq2/dt", 0), np.array([3, 0])])
def test_outputs_choose_states_by_name_or_index(outputs):
    guesses = {"inverse_inertia": 2.0, "gravity_gain": 3.0}
    mean, scale = InertiaForceGravity("acrobot", outputs=outputs, **guesses).coef_prior(2)
    all_means, all_scales = InertiaForceGravity("acrobot", **guesses).coef_prior(4)
    assert_array_equal(mean, all_means[[3, 0]])
    assert_array_equal(scale, all_scales[[3, 0]])


@pytest.mark.parametrize("outputs", [["q3"], [4], [-1], [True], [0.0], [None], ["q1", 7]])
def test_outputs_that_are_no_states_list_the_states(outputs):
    with pytest.raises(ValueError, match=r"must be indices or names of the states \['q1', 'q2', 'dq1/dt', 'dq2/dt'\]"):
        InertiaForce("acrobot", outputs=outputs).coef_prior(len(outputs))


@pytest.mark.parametrize(
    ("outputs", "n_outputs", "message"),
    [
        (None, 1, r"y has 1 columns.* predicts 2 states: \['q', 'dq/dt'\].*outputs="),
        (None, 3, "y has 3 columns.* predicts 2 states"),
        (["q"], 2, r"y has 2 columns.* predicts 1 states: \['q'\]"),
    ],
)
def test_target_of_another_width_raises(outputs, n_outputs, message):
    with pytest.raises(ValueError, match=message):
        InertiaForce("pendulum", outputs=outputs).coef_prior(n_outputs)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"dt": 0.0}, r"'dt' parameter .* in the range \(0.0, inf\) or a str among {'column'}. Got 0.0"),
        ({"dt": np.nan}, "'dt' parameter .* Got nan"),
        ({"known_scale": -1.0}, "'known_scale' parameter .* Got -1.0"),
        ({"unknown_scale": np.inf}, "'unknown_scale' parameter .* Got inf"),
        ({"free_scale": -0.1}, "'free_scale' parameter .* Got -0.1"),
        ({"inverse_inertia": [1.0, 2.0]}, "inverse_inertia must be a finite number or 1 of them"),
        ({"inverse_inertia": np.nan}, "inverse_inertia must be a finite number"),
        ({"gravity_gain": [1.0, 2.0, 3.0]}, "gravity_gain must be a finite number or 2 of them"),
    ],
)
def test_invalid_parameter_raises(parameters, message):
    with pytest.raises(ValueError, match=message):
        InertiaForceGravity("acrobot", **parameters).coef_prior(4)


@pytest.mark.parametrize("parameter", ["dt", "known_scale", "unknown_scale", "free_scale"])
def test_parameter_that_is_no_number_raises(parameter):
    with pytest.raises(ValueError, match=f"'{parameter}' parameter .* Got 'much'"):
        InertiaForce("pendulum", **{parameter: "much"}).coef_prior(2)


@pytest.mark.parametrize("feature_map", MAPS)
def test_invalid_number_of_columns_raises(feature_map):
    message = rf"X has 4 columns, but {feature_map.__name__} of the robot 'pendulum' needs 3: \['q', 'dq/dt', 'u_q'\]"
    with pytest.raises(ValueError, match=message):
        feature_map("pendulum").fit(np.zeros((2, 4)))


@pytest.mark.parametrize("feature_map", MAPS)
def test_only_a_robot_gives_a_prior(feature_map):
    assert not hasattr(feature_map(), "coef_prior")
    assert hasattr(feature_map("pendulum"), "coef_prior")


def test_pandas_output_keeps_the_index_and_names_the_columns():
    frame = pd.DataFrame(rows("pendulum"), columns=["q", "dq/dt", "u_q"], index=range(10, 15))
    transformed = InertiaForceGravity("pendulum").set_output(transform="pandas").fit_transform(frame)
    assert list(transformed.columns) == ["q", "dq/dt", "u_q", "sin(q)"]
    assert list(transformed.index) == list(frame.index)
    assert_array_equal(transformed, InertiaForceGravity("pendulum").fit_transform(frame))


# --- gravity on links in 3D ---------------------------------------------------------------------------------------


def arm_rows(robot="iiwa14", n_rows=5):
    return np.random.default_rng(0).normal(size=(n_rows, layout_of(robot).n_columns))


def test_arm_gets_both_levers_of_the_links_that_gravity_turns():
    X = arm_rows()
    features = InertiaForceGravity("iiwa14").fit(X)
    levers = [f"gravity(q{link}, u_{axis})" for link in range(2, 8) for axis in "xy"]
    assert features.get_feature_names_out().tolist() == layout_of("iiwa14").column_names + levers
    assert_array_equal(features.transform(X), np.hstack([X, LinkGravity("iiwa14").fit_transform(X)[:, 2:]]))


@pytest.mark.parametrize(("roll", "n_terms"), [(np.pi / 2, 0), (1.5707, 0), (1.5, 2)])
def test_axis_that_a_file_rounds_to_the_vertical_counts_as_vertical(roll, n_terms):
    turntable = System("turntable", links=(Link("q", "revolute", (0.0, 1.0, 0.0), mass=1.0, rpy=(roll, 0.0, 0.0)),))
    assert InertiaForceGravity(turntable).fit_transform(rows("pendulum")).shape == (5, 3 + n_terms)


def test_without_gravity_nothing_is_added():
    model = load_robot("acrobot").copy()
    model.gravity.linear = np.zeros(3)
    X = rows("acrobot")
    features = InertiaForceGravity(model).fit(X)
    assert_array_equal(features.transform(X), X)
    assert_array_equal(features.coef_prior(4)[0], InertiaForce("acrobot").coef_prior(4)[0])


@pytest.mark.parametrize("fitted", [False, True])
def test_prior_of_an_arm_is_eulers_rule_and_gravity_on_the_joints_below_each_link(fitted):
    features = InertiaForceGravity("iiwa14", gravity_gain=2.0, unknown_scale=3.0, free_scale=0.5)
    if fitted:
        features.fit(arm_rows())
    mean, scale = features.coef_prior(14)
    inertia_mean, inertia_scale = InertiaForce("iiwa14", unknown_scale=3.0, free_scale=0.5).coef_prior(14)
    assert_array_equal(mean[:, :21], inertia_mean)
    assert_array_equal(scale[:, :21], inertia_scale)
    borne = np.zeros((14, 12), dtype=bool)
    for column, link in enumerate(np.repeat(range(2, 8), 2)):
        borne[7 : 7 + link, column] = True
    assert_array_equal(mean[:, 21:], np.where(borne, -0.06, 0.0))
    assert_array_equal(scale[:, 21:], np.where(borne, 3.0, 0.5))


def test_there_may_be_a_guess_per_lever():
    gain = np.arange(1.0, 13.0)
    mean, _ = InertiaForceGravity("iiwa14", gravity_gain=gain).coef_prior(14)
    assert_allclose(mean[7, 21:], -0.03 * gain)


def test_levers_can_be_asked_for_and_have_their_own_scales():
    levers = LinkGravity(axes="x", unknown_scale=5.0, free_scale=0.0)
    features = InertiaForceGravity("acrobot", gravity=levers).fit(rows("acrobot"))
    assert features.get_feature_names_out().tolist() == [*COLUMNS["acrobot"], "gravity(q1, u_x)", "gravity(q2, u_x)"]
    assert_allclose(
        features.transform(rows("acrobot"))[:, 5:], 9.81 * np.sin(np.cumsum(rows("acrobot")[:, :2], axis=1))
    )
    assert_array_equal(features.coef_prior(4)[1][:, 5:], [[0, 0], [0, 0], [5, 5], [0, 5]])
    assert levers.robot is None  # the user's own is not touched


def test_levers_of_another_robot_must_fit():
    with pytest.raises(ValueError, match="X has 21 columns, but LinkGravity of the robot 'ur5' needs 18"):
        InertiaForceGravity("iiwa14", gravity=LinkGravity("ur5")).fit(arm_rows())


@pytest.mark.parametrize("gravity", ["sine", InertiaForce("iiwa14")])
def test_gravity_that_is_not_link_gravity_raises(gravity):
    with pytest.raises(ValueError, match="'gravity' parameter .* must be an instance of .*LinkGravity' or None"):
        InertiaForceGravity("iiwa14", gravity=gravity).fit(arm_rows())
