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
# The groups of weights for velocities: known (k), input (i), gravity (g), coupling (c) and other (.).
GROUPS = {
    "pendulum": [".kig"],
    "cartpole": ["..k.ic", "...kcg"],
    "acrobot": ["..k.cgg", "...kicg"],
}
NAMES = {"k": "known", "i": "input", "g": "gravity", "c": "coupling", ".": "other"}
PRIOR = {"known_rate": 0.7, "unknown_ratio": 5.0, "coupling_ratio": 0.5, "other_ratio": 0.02}
LENGTH = {"inverse_length": 4.0}


def rows(name, n_rows=5):
    return np.random.default_rng(0).normal(size=(n_rows, len(COLUMNS[name])))


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
    n = layout_of(name).n_joints
    mean, _ = InertiaForceGravity(name).coef_prior(2 * n)
    assert_array_equal(mean[:, : 2 * n], np.eye(2 * n) + 0.03 * np.eye(2 * n, k=n))
    assert_array_equal(mean[:, 2 * n :], 0.0)


@pytest.mark.parametrize("left", [1e-3, 1e3])
@pytest.mark.parametrize("name", COLUMNS)
def test_standard_deviations_are_those_of_their_groups(name, left):
    """Rates of weights that Newton's law gives, and of gravity at most; all others are in units of the data."""
    n, of_velocities = layout_of(name).n_joints, np.array([list(row) for row in GROUPS[name]])
    features = InertiaForceGravity(name, dt=DT, **LENGTH, **PRIOR)
    # Newton's law gives the 1 of a position for itself, too. Its group is that of the known ones.
    of_positions = np.where(np.eye(*of_velocities.shape), "k", of_velocities)
    groups = np.vectorize(NAMES.get)(np.vstack([of_positions, of_velocities]))
    assert_array_equal(features.coef_groups(2 * n), groups)
    n_inertia = 2 * n + layout_of(name).n_inputs
    # A sine decelerates by g / l, and moves other joints by a share of that.
    rate = np.vectorize({"k": 0.7, "g": 9.81 * 4.0, "c": 0.5 * 9.81 * 4.0}.get)(of_velocities, np.nan)
    rate[:, 2 * n : n_inertia] = np.nan
    ratio = np.vectorize({"i": 5.0, "g": 5.0, "c": 0.5 * 5.0, ".": 0.02}.get)(of_velocities, np.nan)
    _, own = features.coef_prior(2 * n)
    assert_allclose(own[n:], DT * np.where(np.isnan(ratio), rate, np.nan))
    rng = np.random.default_rng(0)
    left_over, size = left * rng.uniform(1.0, 2.0, 2 * n), rng.uniform(1.0, 2.0, rate.shape[1])
    in_units = features.coef_scale(left_over, size)
    expected = ratio * left_over[n:, np.newaxis] / size
    expected[:, n_inertia:] = np.minimum(expected, DT * rate)[:, n_inertia:]
    assert_allclose(in_units[n:], expected)
    # A position changes by Δt times its velocity.
    assert_allclose(own[:n], DT * own[n:])
    assert_allclose(in_units[:n], DT * in_units[n:])
    # Without gravity they are the same.
    inertia = InertiaForce(name, dt=DT, **PRIOR)
    assert_array_equal(inertia.coef_groups(2 * n), groups[:, :n_inertia])
    assert_array_equal(inertia.coef_prior(2 * n)[1], own[:, :n_inertia])
    assert_array_equal(inertia.coef_scale(left_over, size[:n_inertia]), in_units[:, :n_inertia])


def test_ratios_of_zero_pin_the_zeros():
    """For positions, h(x) may then change by what changes their velocities."""
    guesses = {"gravity_gain": 1.0, "inverse_inertia": 1.0}
    features = InertiaForceGravity("acrobot", coupling_ratio=0.0, other_ratio=0.0, **guesses)
    mean, own = features.coef_prior(4)
    scale = np.where(np.isnan(own), features.coef_scale(np.ones(4), np.ones(7)), own)
    assert_array_equal(scale[2:] == 0.0, mean[2:] == 0.0)
    assert_array_equal(scale[:2] == 0.0, mean[2:] == 0.0)


@pytest.mark.parametrize("outputs", [["dq2/dt", "q1"], [3, 0], ("dq2/dt", 0), np.array([3, 0])])
def test_outputs_choose_states_by_name_or_index(outputs):
    guesses = {"inverse_inertia": 2.0, "gravity_gain": 3.0}
    some, every = InertiaForceGravity("acrobot", outputs=outputs, **guesses), InertiaForceGravity("acrobot", **guesses)
    for of_some, of_all in zip(some.coef_prior(2), every.coef_prior(4), strict=True):
        assert_array_equal(of_some, of_all[[3, 0]])
    assert_array_equal(some.coef_groups(2), every.coef_groups(4)[[3, 0]])
    # The velocity of q1 is not predicted. Then its own residuals count, in place of Δt times those of the velocity.
    left_over, size = np.array([0.03 * 4.0, 2.0, 4.0, 5.0]), np.arange(1.0, 8.0)
    assert_allclose(some.coef_scale(left_over[[3, 0]], size), every.coef_scale(left_over, size)[[3, 0]])


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
        ({"known_rate": -1.0}, "'known_rate' parameter .* Got -1.0"),
        ({"unknown_ratio": np.inf}, "'unknown_ratio' parameter .* Got inf"),
        ({"inverse_length": -1.0}, "'inverse_length' parameter .* Got -1.0"),
        ({"coupling_ratio": np.nan}, "'coupling_ratio' parameter .* Got nan"),
        ({"other_ratio": -0.1}, "'other_ratio' parameter .* Got -0.1"),
        ({"inverse_inertia": [1.0, 2.0]}, "inverse_inertia must be a finite number or 1 of them"),
        ({"inverse_inertia": np.nan}, "inverse_inertia must be a finite number"),
        ({"gravity_gain": [1.0, 2.0, 3.0]}, "gravity_gain must be a finite number or 2 of them"),
    ],
)
def test_invalid_parameter_raises(parameters, message):
    with pytest.raises(ValueError, match=message):
        InertiaForceGravity("acrobot", **parameters).coef_prior(4)


@pytest.mark.parametrize("parameter", ["dt", *PRIOR])
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
    for method in ("coef_prior", "coef_scale", "coef_groups"):
        assert not hasattr(feature_map(), method)
        assert hasattr(feature_map("pendulum"), method)


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
    inertia = InertiaForce("iiwa14", dt=DT, **PRIOR)
    features = InertiaForceGravity("iiwa14", dt=DT, gravity_gain=2.0, **LENGTH, **PRIOR)
    if fitted:
        features.fit(arm_rows())
    mean, own = features.coef_prior(14)
    groups, in_units = features.coef_groups(14), features.coef_scale(np.ones(14), np.ones(33))
    for of_all, of_inertia in zip((mean, own), inertia.coef_prior(14), strict=True):
        assert_array_equal(of_all[:, :21], of_inertia)
    assert_array_equal(groups[:, :21], inertia.coef_groups(14))
    assert_array_equal(in_units[:, :21], inertia.coef_scale(np.ones(14), np.ones(21)))
    borne = np.zeros((7, 12), dtype=bool)
    for column, link in enumerate(np.repeat(range(2, 8), 2)):
        borne[:link, column] = True
    assert_array_equal(mean[:, 21:], np.vstack([np.zeros((7, 12)), np.where(borne, -DT * 2.0, 0.0)]))
    assert_array_equal(groups[:, 21:], np.tile(np.where(borne, "gravity", "coupling"), (2, 1)))
    # The levers are in m/s²: their weights are Δt / l, which is less than the data leave.
    assert_allclose(in_units[7:, 21:], DT * np.where(borne, 4.0, 0.5 * 4.0))
    assert_allclose(in_units[:7], DT * in_units[7:])
    assert np.isnan(own[:, 21:]).all()


def test_there_may_be_a_guess_per_lever():
    gain = np.arange(1.0, 13.0)
    mean, _ = InertiaForceGravity("iiwa14", gravity_gain=gain).coef_prior(14)
    assert_allclose(mean[7, 21:], -0.03 * gain)


def test_levers_can_be_asked_for_and_have_their_own_prior():
    levers = LinkGravity(axes="x", inverse_length=5.0, unknown_ratio=2.0, coupling_ratio=0.0)
    features = InertiaForceGravity("acrobot", dt=DT, gravity=levers, **LENGTH, **PRIOR).fit(rows("acrobot"))
    assert features.get_feature_names_out().tolist() == [*COLUMNS["acrobot"], "gravity(q1, u_x)", "gravity(q2, u_x)"]
    assert_allclose(
        features.transform(rows("acrobot"))[:, 5:], 9.81 * np.sin(np.cumsum(rows("acrobot")[:, :2], axis=1))
    )
    assert_allclose(features.coef_scale(np.full(4, 1e3), np.ones(7))[2:, 5:], DT * np.array([[5, 5], [0, 5]]))
    assert_allclose(features.coef_scale(np.full(4, 1e-3), np.ones(7))[2:, 5:], 1e-3 * np.array([[2, 2], [0, 2]]))
    assert levers.robot is None  # the user's own is not touched


@pytest.mark.parametrize("left", [1e-3, 1e3])
def test_sines_and_levers_have_the_same_prior(left):
    """A lever is g times the sine, and its weight 1 / g times that of the sine."""
    X, gravity = rows("acrobot"), {"inverse_length": 4.0, "unknown_ratio": 5.0, "coupling_ratio": 0.5}
    contributions = []
    for given in (None, LinkGravity(axes="x", **gravity)):
        features = InertiaForceGravity("acrobot", gravity=given, **gravity)
        H = features.fit_transform(X)
        scale = features.coef_scale(np.full(4, left), np.sqrt(np.mean(H**2, axis=0)))
        contributions.append(H[:, 5:] * scale[:, np.newaxis, 5:])
    sines, levers = contributions
    assert_allclose(levers, sines)
    assert (sines != 0.0).all()


def test_levers_of_another_robot_must_fit():
    with pytest.raises(ValueError, match="X has 21 columns, but LinkGravity of the robot 'ur5' needs 18"):
        InertiaForceGravity("iiwa14", gravity=LinkGravity("ur5")).fit(arm_rows())


@pytest.mark.parametrize("gravity", ["sine", InertiaForce("iiwa14")])
def test_gravity_that_is_not_link_gravity_raises(gravity):
    with pytest.raises(ValueError, match="'gravity' parameter .* must be an instance of .*LinkGravity' or None"):
        InertiaForceGravity("iiwa14", gravity=gravity).fit(arm_rows())


@pytest.mark.parametrize("name", ["known_rate", "unknown_ratio", "coupling_ratio", "other_ratio", "inverse_length"])
def test_scales_may_be_integers(name):
    whole, real = (InertiaForceGravity("acrobot", **{name: kind(0)}) for kind in (int, float))
    left_over, size = np.arange(1.0, 5.0), np.arange(1.0, 8.0)
    assert_array_equal(whole.coef_prior(4)[1], real.coef_prior(4)[1])
    assert_array_equal(whole.coef_scale(left_over, size), real.coef_scale(left_over, size))
