import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from skevgp.features import AngleEncoder
from skevgp.robots import layout_of

NAMES = {
    "pendulum": ["sin(q)", "cos(q)", "dq/dt", "u_q"],
    "cartpole": ["x", "sin(theta)", "cos(theta)", "dx/dt", "dtheta/dt", "u_x"],
    "acrobot": ["sin(q1)", "cos(q1)", "sin(q2)", "cos(q2)", "dq1/dt", "dq2/dt", "u_q2"],
}


def rows(n_columns, n_rows=5):
    return np.random.default_rng(0).uniform(-3.0, 3.0, (n_rows, n_columns))


def encoded(X, angles):
    """Column by column."""
    pieces = [np.column_stack([np.sin(x), np.cos(x)] if i in angles else [x]) for i, x in enumerate(X.T)]
    return np.hstack(pieces)


@pytest.mark.parametrize(("robot", "angles"), [("pendulum", {0}), ("cartpole", {1}), ("acrobot", {0, 1})])
def test_each_angle_gives_way_to_its_sine_and_cosine(robot, angles):
    X = rows(layout_of(robot).n_columns)
    assert_array_equal(AngleEncoder(robot).fit_transform(X), encoded(X, angles))


@pytest.mark.parametrize("robot", NAMES)
def test_columns_are_named_after_the_angles(robot):
    encoder = AngleEncoder(robot).fit(rows(layout_of(robot).n_columns))
    assert encoder.get_feature_names_out().tolist() == NAMES[robot]


@pytest.mark.parametrize(
    ("robot", "n_angles"),
    [("iiwa14", 7), ("ur5", 6), ("panda", 7), ("kinova", 6)],  # panda has two prismatic fingers
)
def test_all_revolute_positions_are_angles_also_continuous_ones(robot, n_angles):
    X = rows(layout_of(robot).n_columns)
    assert_array_equal(AngleEncoder(robot).fit_transform(X), encoded(X, set(range(n_angles))))


@pytest.mark.parametrize("angles", [["q2"], [1], np.array([1]), np.array(["q2"]), (np.int64(1),)])
def test_angles_chosen_by_index_or_name_overrule_the_robots(angles):
    assert_array_equal(AngleEncoder("acrobot", angles=angles).fit_transform(rows(5)), encoded(rows(5), {1}))


@pytest.mark.parametrize("angles", [[3, 1], [1, 3], np.array([3, 1])])
def test_without_a_robot_the_order_of_the_columns_stays_whatever_that_of_angles(angles):
    encoder = AngleEncoder(angles=angles).fit(rows(5))
    assert_array_equal(encoder.transform(rows(5)), encoded(rows(5), {1, 3}))
    assert encoder.get_feature_names_out().tolist() == ["x0", "sin(x1)", "cos(x1)", "x2", "sin(x3)", "cos(x3)", "x4"]


def test_data_frames_choose_angles_by_their_columns_and_name_the_result():
    frame = pd.DataFrame(rows(3), columns=["t", "heading", "speed"], index=range(10, 15))
    encoder = AngleEncoder(angles=["heading"]).set_output(transform="pandas").fit(frame)
    transformed = encoder.transform(frame)
    assert list(transformed.columns) == ["t", "sin(heading)", "cos(heading)", "speed"]
    assert list(transformed.index) == list(frame.index)
    assert_array_equal(transformed, encoded(frame.to_numpy(), {1}))


@pytest.mark.parametrize("angles", [["x"], [0], ["dtheta/dt"], [3], ["u_x"], [4], ["elbow"], [7], [-4], [True], [1.0]])
def test_angle_that_is_no_revolute_position_lists_those_that_are(angles):
    message = r"angles=.* must be .* of revolute joints of the robot 'cartpole': \{1: 'theta'\}"
    with pytest.raises(ValueError, match=message):
        AngleEncoder("cartpole", angles=angles).fit(rows(5))


@pytest.mark.parametrize("angles", [[5], [-1], ["x0"], [True], [0.0], [None], [0, 9], [[0, 1]], np.array([[0, 1]])])
def test_without_a_robot_an_angle_must_be_a_column(angles):
    with pytest.raises(ValueError, match=r"(?s)angles=.* must be a sequence of indices of the 5 columns of X"):
        AngleEncoder(angles=angles).fit(rows(5))


@pytest.mark.parametrize("angles", ["q1", 0])
def test_angles_must_be_a_sequence(angles):
    with pytest.raises(
        ValueError, match=f"The 'angles' parameter of AngleEncoder must be an array-like or None. Got {angles!r}"
    ):
        AngleEncoder("acrobot", angles=angles).fit(rows(5))


@pytest.mark.parametrize("angles", [[0, 0], ["q1", "q1"], ["q1", 0]])
def test_angle_named_twice_raises(angles):
    with pytest.raises(ValueError, match=r"angles=.* must not name a column twice"):
        AngleEncoder("acrobot", angles=angles).fit(rows(5))


@pytest.mark.parametrize("robot", ["acrobot", "cartpole"])
def test_inverse_gives_the_rows_back(robot):
    encoder = AngleEncoder(robot).fit(rows(5))
    assert_allclose(encoder.inverse_transform(encoder.transform(rows(5))), rows(5), rtol=1e-14, atol=1e-14)


def test_inverse_gives_angles_above_minus_pi_and_up_to_pi():
    encoder = AngleEncoder(angles=[0]).fit([[0.0, 0.0]])
    X = np.array([[4.0, 9.0], [-4.0, -9.0], [np.pi, 0.0], [-np.pi, 0.0], [0.0, 1.0]])
    expected = [[4.0 - 2 * np.pi, 9.0], [2 * np.pi - 4.0, -9.0], [np.pi, 0.0], [np.pi, 0.0], [0.0, 1.0]]
    assert_allclose(encoder.inverse_transform(encoder.transform(X)), expected, rtol=1e-14)
    assert encoder.inverse_transform([[-0.0, -1.0, 0.0]])[0, 0] == np.pi


@pytest.mark.parametrize("n_columns", [5, 8])
def test_inverse_of_another_width_raises(n_columns):
    encoder = AngleEncoder("acrobot").fit(rows(5))
    with pytest.raises(ValueError, match=rf"X has {n_columns} columns, but AngleEncoder made 7: \['sin\(q1\)'"):
        encoder.inverse_transform(rows(n_columns))


def test_pipeline_scales_what_was_encoded_and_inverts_it():
    pipeline = make_pipeline(AngleEncoder("acrobot"), StandardScaler()).fit(rows(5))
    expected = StandardScaler().fit_transform(encoded(rows(5), {0, 1}))
    assert_allclose(pipeline.transform(rows(5)), expected, rtol=1e-14)
    assert pipeline.get_feature_names_out().tolist() == NAMES["acrobot"]
    assert_allclose(pipeline.inverse_transform(expected), rows(5), rtol=1e-12, atol=1e-12)
