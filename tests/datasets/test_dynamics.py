import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.utils import check_random_state

from skevgp.datasets import load_robot, make_dynamics, quintic_reference, simulate
from skevgp.robots import get_system, layout_of

KEYS = {"data", "target", "groups", "trajectories", "feature_names", "target_names", "robot", "dt", "DESCR"}
ALPHA = {
    "pendulum": [np.pi, 0.5],
    "cartpole": [1.0, np.pi, 0.5, 0.5],
    "cartpole_damped": [1.0, np.pi, 0.5, 0.5],
    "acrobot": [np.pi, 1.0, 0.5, 0.5],
}
ETA = {"pendulum": 1.0, "cartpole": 100.0, "cartpole_damped": 100.0, "acrobot": 0.5}
NAMES = {
    "pendulum": ["q", "dq/dt", "u_q"],
    "cartpole": ["x", "theta", "dx/dt", "dtheta/dt", "u_x"],
    "cartpole_damped": ["x", "theta", "dx/dt", "dtheta/dt", "u_x"],
    "acrobot": ["q1", "q2", "dq1/dt", "dq2/dt", "u_q2"],
}
SYSTEMS = sorted(NAMES)


@pytest.fixture(scope="module")
def paper_pendulum():
    return make_dynamics("pendulum", random_state=0)


def states(dynamics):
    return dynamics.data[:, : dynamics.target.shape[1]]


def test_the_pendulum_has_the_size_of_the_paper(paper_pendulum):
    assert paper_pendulum.data.shape == (4800, 3)
    assert paper_pendulum.target.shape == (4800, 2)
    assert paper_pendulum.trajectories.shape == (48, 101, 2)


@pytest.mark.parametrize(("name", "n_trajectories"), [("cartpole", 48), ("acrobot", 93)])
def test_the_number_of_trajectories_is_that_of_the_paper(name, n_trajectories):
    assert make_dynamics(name, n_steps=1).trajectories.shape == (n_trajectories, 2, 4)


@pytest.mark.parametrize("name", ["cartpole", "acrobot"])
def test_the_number_of_steps_is_that_of_the_paper(name):
    assert make_dynamics(name, n_trajectories=1).data.shape == (100, 5)


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_bunch_names_its_columns(name):
    dynamics = make_dynamics(name, 2, 3, random_state=0)
    assert set(dynamics) == KEYS
    assert dynamics.feature_names == NAMES[name]
    assert dynamics.target_names == NAMES[name][:-1]
    assert dynamics.data.shape == (6, len(NAMES[name]))
    assert dynamics.robot == name
    assert name in dynamics.DESCR


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_target_is_the_next_row_of_its_trajectory(name):
    dynamics = make_dynamics(name, 3, 4, random_state=0)
    same_trajectory = dynamics.groups[1:] == dynamics.groups[:-1]
    assert_array_equal(states(dynamics)[1:][same_trajectory], dynamics.target[:-1][same_trajectory])
    assert (states(dynamics)[1:][~same_trajectory] != dynamics.target[:-1][~same_trajectory]).all()


def test_rows_are_the_trajectories_one_after_the_other():
    dynamics = make_dynamics("cartpole", 2, 3, random_state=0)
    assert_array_equal(states(dynamics), dynamics.trajectories[:, :-1].reshape(6, 4))
    assert_array_equal(dynamics.target, dynamics.trajectories[:, 1:].reshape(6, 4))
    assert_array_equal(dynamics.groups, [0, 0, 0, 1, 1, 1])


def test_the_data_are_a_simulation_under_their_own_inputs():
    dynamics = make_dynamics("acrobot", 2, 3, dt=0.05, random_state=0)
    Z = simulate("acrobot", dynamics.trajectories[:, 0], dynamics.data[:, 4:].reshape(2, 3, 1), dt=0.05)
    assert_array_equal(dynamics.trajectories, Z)


@pytest.mark.parametrize("name", SYSTEMS)
def test_initial_states_fill_the_range_of_the_paper(name):
    first = make_dynamics(name, 200, 1, random_state=0).trajectories[:, 0]
    extent = np.abs(first).max(axis=0) / ALPHA[name]
    assert (extent <= 1.0).all()
    assert (extent > 0.95).all()
    assert (first.min(axis=0) < 0).all()


@pytest.mark.parametrize("name", SYSTEMS)
def test_inputs_have_the_scale_of_the_paper(name):
    inputs = make_dynamics(name, 20, 50, random_state=0).data[:, -1]
    assert np.std(inputs) == pytest.approx(ETA[name], rel=0.1)
    assert np.mean(inputs) == pytest.approx(0.0, abs=0.15 * ETA[name])


def test_angles_are_not_wrapped():
    theta = make_dynamics("cartpole", 20, 50, random_state=0).trajectories[:, :, 1]
    assert np.abs(theta).max() > np.pi
    assert np.abs(np.diff(theta, axis=1)).max() < 1.0


def test_the_same_random_state_gives_the_same_bits():
    first, second = (make_dynamics("acrobot", 2, 3, noise=0.1, input_noise=0.1, random_state=7) for _ in range(2))
    assert_array_equal(first.data, second.data)
    assert_array_equal(first.target, second.target)


def test_another_random_state_gives_other_data():
    first, second = (make_dynamics("pendulum", 2, 3, random_state=seed) for seed in (0, 1))
    assert (first.data != second.data).all()


def test_a_random_state_instance_goes_on():
    rng = check_random_state(0)
    first, second = (make_dynamics("pendulum", 2, 3, random_state=rng) for _ in range(2))
    assert_array_equal(first.data, make_dynamics("pendulum", 2, 3, random_state=0).data)
    assert (first.data != second.data).all()


def test_noise_is_a_fraction_of_each_targets_scatter():
    clean, noisy = (make_dynamics("cartpole", 20, 50, noise=noise, random_state=0) for noise in (0.0, 0.1))
    fraction = (noisy.target - clean.target).std(axis=0) / clean.target.std(axis=0)
    assert fraction == pytest.approx(0.1, rel=0.15)
    assert_array_equal(noisy.data, clean.data)


def test_input_noise_is_a_fraction_of_each_states_scatter():
    clean, noisy = (make_dynamics("cartpole", 20, 50, input_noise=noise, random_state=0) for noise in (0.0, 0.1))
    fraction = (states(noisy) - states(clean)).std(axis=0) / states(clean).std(axis=0)
    assert fraction == pytest.approx(0.1, rel=0.15)
    assert_array_equal(noisy.target, clean.target)
    assert_array_equal(noisy.data[:, 4:], clean.data[:, 4:])


def test_noise_leaves_the_true_trajectories():
    clean = make_dynamics("pendulum", 2, 3, random_state=0)
    noisy = make_dynamics("pendulum", 2, 3, noise=0.5, input_noise=0.5, random_state=0)
    assert_array_equal(noisy.trajectories, clean.trajectories)


def test_the_description_tells_the_noise():
    assert "noise 0.25 on the targets" in make_dynamics("pendulum", 1, 2, noise=0.25).DESCR


def test_return_x_y_gives_the_two_arrays():
    X, y = make_dynamics("pendulum", 2, 3, noise=0.1, random_state=0, return_X_y=True)
    dynamics = make_dynamics("pendulum", 2, 3, noise=0.1, random_state=0)
    assert_array_equal(X, dynamics.data)
    assert_array_equal(y, dynamics.target)


def test_a_system_works_in_place_of_its_name():
    pendulum = get_system("pendulum")
    dynamics = make_dynamics(pendulum, 2, 3, random_state=0)
    assert dynamics.robot is pendulum
    assert_array_equal(dynamics.data, make_dynamics("pendulum", 2, 3, random_state=0).data)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"system": "robot"}, r"Unknown robot 'robot'.*'acrobot', 'cartpole', 'cartpole_damped', 'iiwa14', 'pendulum'"),
        ({"system": "acrobat"}, "Did you mean 'acrobot'"),
        (
            {"duration": 1.0},
            "duration is the time of a controlled move; 'pendulum' is driven by random inputs. Got 1.0",
        ),
        ({"system": "iiwa14", "duration": 0.0}, "duration must be finite and above 0.0; got 0.0"),
        ({"n_trajectories": 0}, "n_trajectories must be at least 1; got 0"),
        ({"n_steps": -1}, "n_steps must be at least 1; got -1"),
        ({"dt": 0.0}, "dt must be finite and above 0.0; got 0.0"),
        ({"dt": np.inf}, "dt must be finite and above 0.0; got inf"),
        ({"noise": -0.1}, "noise must be finite and at least 0.0; got -0.1"),
        ({"input_noise": np.nan}, "input_noise must be finite and at least 0.0; got nan"),
    ],
)
def test_bad_values_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_dynamics(**{"system": "pendulum"} | arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"system": 3}, "must be a name .*; got 3"),
        ({"n_trajectories": 2.0}, "n_trajectories must be an integer; got 2.0"),
        ({"n_steps": True}, "n_steps must be an integer; got True"),
        ({"dt": "0.03"}, "dt must be a number; got '0.03'"),
        ({"noise": [0.1]}, r"noise must be a number; got \[0.1\]"),
    ],
)
def test_bad_types_are_named(arguments, message):
    with pytest.raises(TypeError, match=message):
        make_dynamics(**{"system": "pendulum"} | arguments)


def as_drawn_before_there_was_control(name, n_trajectories, n_steps):
    rng = check_random_state(5)
    z0 = np.array(ALPHA[name]) * rng.uniform(-1.0, 1.0, (n_trajectories, len(ALPHA[name])))
    return z0, ETA[name] * rng.standard_normal((n_trajectories, n_steps, 1))


@pytest.mark.parametrize("robot", [str, get_system, load_robot], ids=["name", "System", "model"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_states_and_inputs_of_the_planar_systems_are_the_papers(name, robot):
    z0, U = as_drawn_before_there_was_control(name, 3, 4)
    dynamics = make_dynamics(robot(name), 3, 4, random_state=5)
    assert_array_equal(dynamics.trajectories[:, 0], z0)
    assert_array_equal(dynamics.data[:, -1:], U.reshape(-1, 1))


NOISE = 0.1 * np.array([3.0, 15.0, 3.0, 2.0, 2.0, 2.0, 0.05])


def test_iiwa14_has_the_size_of_the_paper():
    assert make_dynamics("iiwa14", n_steps=1, duration=1.5).trajectories.shape == (465, 2, 14)
    assert make_dynamics("iiwa14", n_trajectories=1).data.shape == (50, 21)


@pytest.mark.parametrize("robot", ["iiwa14", load_robot("iiwa14")], ids=["name", "model"])
def test_iiwa14_starts_at_rest_and_tracks_its_target(robot):
    dynamics = make_dynamics(robot, 20, random_state=3)
    rng = check_random_state(3)
    q0 = 1.5 * rng.uniform(-1.0, 1.0, (20, 7))
    q1 = q0 + 0.8 * rng.uniform(-1.0, 1.0, (20, 7))
    first = dynamics.trajectories[:, 0]
    assert_array_equal(first, np.hstack([q0, np.zeros((20, 7))]))
    desired = quintic_reference(q0, q1, 1.5, 0.03 * np.arange(51))[0]
    assert np.abs(dynamics.trajectories[..., :7] - desired).max() < 0.15
    assert np.abs(dynamics.trajectories[:, -1, :7] - q1).max() < 0.05


def test_iiwa14s_torques_scatter_around_computed_torque():
    dynamics = make_dynamics("iiwa14", 400, 1, duration=1.5, random_state=0)
    model = load_robot("iiwa14")
    data = model.createData()
    held = [pinocchio.computeGeneralizedGravity(model, data, row[:7]) for row in dynamics.data]
    assert_allclose((dynamics.data[:, 14:] - held).std(axis=0), NOISE, rtol=0.1)


def test_a_shorter_move_rests_at_its_target():
    rest = make_dynamics("iiwa14", 5, 50, duration=0.6, random_state=0).trajectories[:, 30:, :7]
    assert np.ptp(rest, axis=1).max() < 0.1


def test_inputs_are_those_that_acted():
    dynamics = make_dynamics("iiwa14", 5, 4, duration=0.1, random_state=0)
    effort = load_robot("iiwa14").upperEffortLimit
    U = dynamics.data[:, 14:]
    assert (np.abs(U) <= effort).all()
    assert (np.abs(U) == effort).any()
    assert_array_equal(dynamics.trajectories, simulate("iiwa14", dynamics.trajectories[:, 0], U.reshape(5, 4, 7)))


@pytest.mark.parametrize("name", ["panda", "ur5", "kinova", "double_pendulum"])
def test_any_robot_moves_within_its_limits(name):
    dynamics = make_dynamics(name, 10, 10, duration=1.0, random_state=0)
    model, layout = load_robot(name), layout_of(name)
    assert dynamics.data.shape == (100, layout.n_columns)
    assert dynamics.feature_names == layout.column_names
    assert np.isfinite(dynamics.target).all()
    first = dynamics.trajectories[:, 0, : model.nv]
    known = model.lowerPositionLimit < model.upperPositionLimit
    assert (first >= np.where(known, model.lowerPositionLimit, -1.5)).all()
    assert (first <= np.where(known, model.upperPositionLimit, 1.5)).all()
    assert (np.ptp(first, axis=0) <= 3.0).all()
    assert (first.std(axis=0) > 0.005).all()
    assert not dynamics.trajectories[:, 0, model.nv :].any()


def test_a_joint_without_motor_is_swung_at_random():
    model = load_robot("acrobot")
    model.name = "mine"
    model.lowerPositionLimit, model.upperPositionLimit = np.array([2.0, -9.0]), np.array([2.5, 1.0])
    dynamics = make_dynamics(model, 200, 1, random_state=0)
    first = dynamics.trajectories[:, 0]
    assert_allclose(first.min(axis=0), [2.0, -5.5, -0.5, -0.5], atol=0.05)
    assert_allclose(first.max(axis=0), [2.5, -2.5, 0.5, 0.5], atol=0.05)
    assert 0.1 < dynamics.data[:, -1].std() < 1.0
    assert "random inputs from random states" in dynamics.DESCR


def test_a_long_step_does_not_shake_the_arm():
    moves = make_dynamics("ur5", 3, 20, dt=0.1, random_state=0).trajectories
    assert np.abs(moves[..., 6:]).max() < 5.0


@pytest.mark.parametrize(
    ("name", "arguments", "joint"),
    [("panda", {"dt": 0.1}, "finger"), ("so100", {"dt": 0.1}, "gripper"), ("panda", {"duration": 0.2}, "finger")],
)
def test_moves_that_run_away_are_an_error(name, arguments, joint):
    with pytest.raises(ValueError, match=rf"run away in step \d+, at .*{joint}.*unstable at this dt of .*Lower dt"):
        make_dynamics(name, 10, 50, random_state=0, **arguments)


@pytest.mark.parametrize("name", ["panda", "so100"])
def test_moves_at_the_default_step_stay_near_their_targets(name):
    moves = make_dynamics(name, 10, 50, random_state=0).trajectories
    half = moves.shape[2] // 2
    assert np.abs(moves[..., half:]).max() < 3.0
    assert np.abs(moves[..., :half] - moves[:, :1, :half]).max() < 1.2


def test_a_motor_too_weak_to_hold_its_joint_is_no_unstable_controller():
    model = load_robot("pendulum")
    model.name = "weak"
    model.upperEffortLimit, model.lowerEffortLimit = np.array([0.5]), np.array([-0.5])
    dynamics = make_dynamics(model, 10, 50, random_state=0)
    assert np.abs(dynamics.trajectories[..., 0] - dynamics.trajectories[:, :1, 0]).max() > 1.0


@pytest.mark.long
def test_the_number_of_jobs_does_not_change_a_bit():
    one, two = (make_dynamics("iiwa14", 65, 2, random_state=0, n_jobs=jobs) for jobs in (1, 2))
    assert_array_equal(one.data, two.data)
    assert_array_equal(one.target, two.target)


def test_wrapped_angles_keep_what_changed():
    turning = {"system": "cartpole", "n_trajectories": 20, "n_steps": 50}
    free, wrapped = (make_dynamics(**turning, wrap_angles=wrap, random_state=0) for wrap in (False, True))
    assert (np.abs(free.data[:, 1]) > np.pi).any()
    assert (wrapped.data[:, 1] >= -np.pi).all()
    assert (wrapped.data[:, 1] < np.pi).all()
    assert_allclose(wrapped.target - states(wrapped), free.target - states(free), rtol=0, atol=1e-13)
    assert_array_equal(np.delete(wrapped.data, 1, axis=1), np.delete(free.data, 1, axis=1))
    assert_array_equal(wrapped.trajectories, free.trajectories)
    assert "angles wrapped" in wrapped.DESCR


def test_the_description_tells_the_controller():
    assert "computed-torque control" in make_dynamics("iiwa14", 1, 1).DESCR
