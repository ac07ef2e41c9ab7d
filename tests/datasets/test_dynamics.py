from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from sklearn.utils import check_random_state

from skevgp.datasets import make_dynamics, simulate
from skevgp.robots import get_system

KEYS = {"data", "target", "groups", "trajectories", "feature_names", "target_names", "robot", "dt", "DESCR"}
ALPHA = {"pendulum": [np.pi, 0.5], "cartpole": [1.0, np.pi, 0.5, 0.5], "acrobot": [np.pi, 1.0, 0.5, 0.5]}
ETA = {"pendulum": 1.0, "cartpole": 100.0, "acrobot": 0.5}
NAMES = {
    "pendulum": ["q", "dq/dt", "u_q"],
    "cartpole": ["x", "theta", "dx/dt", "dtheta/dt", "u_x"],
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
        ({"system": "robot"}, r"Unknown robot 'robot'.*'acrobot', 'cartpole', 'iiwa14', 'pendulum'"),
        ({"system": "acrobat"}, "Did you mean 'acrobot'"),
        ({"system": replace(get_system("pendulum"), name="mine")}, "No sampling scales are known for 'mine'.*pendulum"),
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
