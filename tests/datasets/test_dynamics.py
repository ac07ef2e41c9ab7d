import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.utils import check_random_state

from skevgp.datasets import load_robot, make_dynamics, quintic_reference


def states(dynamics):
    return dynamics.data[:, : dynamics.target.shape[1]]


def test_same_random_state_gives_same_bits():
    first, second = (make_dynamics("acrobot", 2, 3, noise=0.1, input_noise=0.1, random_state=7) for _ in range(2))
    assert_array_equal(first.data, second.data)
    assert_array_equal(first.target, second.target)


def test_noise_is_a_fraction_of_each_targets_scatter():
    clean, noisy = (make_dynamics("cartpole", 10, 40, noise=noise, random_state=0) for noise in (0.0, 0.1))
    fraction = (noisy.target - clean.target).std(axis=0) / clean.target.std(axis=0)
    assert fraction == pytest.approx(0.1, rel=0.15)
    assert_array_equal(noisy.data, clean.data)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"system": "robot"}, r"Unknown robot 'robot'.*'acrobot', 'cartpole', 'cartpole_damped', 'iiwa14', 'pendulum'"),
        ({"system": "acrobat"}, "Did you mean 'acrobot'"),
        (
            {"duration": 1.0},
            "duration is the time of a controlled move, but 'pendulum' is driven by random inputs; got 1.0",
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
def test_invalid_values_raise(arguments, message):
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
def test_invalid_types_raise(arguments, message):
    with pytest.raises(TypeError, match=message):
        make_dynamics(**{"system": "pendulum"} | arguments)


def test_iiwa14_has_the_size_of_the_paper():
    assert make_dynamics("iiwa14", n_steps=1, duration=1.5).trajectories.shape == (465, 2, 14)
    assert make_dynamics("iiwa14", n_trajectories=1).data.shape == (50, 21)


@pytest.mark.parametrize("robot", ["iiwa14", load_robot("iiwa14")], ids=["name", "model"])
def test_iiwa14_starts_at_rest_and_tracks_its_target(robot):
    dynamics = make_dynamics(robot, 5, random_state=3)
    rng = check_random_state(3)
    q0 = 1.5 * rng.uniform(-1.0, 1.0, (5, 7))
    q1 = q0 + 0.8 * rng.uniform(-1.0, 1.0, (5, 7))
    first = dynamics.trajectories[:, 0]
    assert_array_equal(first, np.hstack([q0, np.zeros((5, 7))]))
    desired = quintic_reference(q0, q1, 1.5, 0.03 * np.arange(51))[0]
    assert np.abs(dynamics.trajectories[..., :7] - desired).max() < 0.15
    assert np.abs(dynamics.trajectories[:, -1, :7] - q1).max() < 0.05


def test_joint_without_motor_is_swung_at_random():
    model = load_robot("acrobot")
    model.name = "mine"
    model.lowerPositionLimit, model.upperPositionLimit = np.array([2.0, -9.0]), np.array([2.5, 1.0])
    dynamics = make_dynamics(model, 200, 1, random_state=0)
    first = dynamics.trajectories[:, 0]
    assert_allclose(first.min(axis=0), [2.0, -5.5, -0.5, -0.5], atol=0.05)
    assert_allclose(first.max(axis=0), [2.5, -2.5, 0.5, 0.5], atol=0.05)
    assert 0.1 < dynamics.data[:, -1].std() < 1.0
    assert "random inputs from random states" in dynamics.DESCR


@pytest.mark.parametrize(
    ("name", "arguments", "joint"),
    [
        pytest.param("panda", {"dt": 0.1}, "finger", marks=pytest.mark.long),
        ("so100", {"dt": 0.1}, "gripper"),
        ("panda", {"duration": 0.2}, "finger"),
    ],
)
def test_moves_that_run_away_raise(name, arguments, joint):
    with pytest.raises(ValueError, match=rf"unstable in step \d+, at .*{joint}.*Lower dt"):
        make_dynamics(name, 10, 50, random_state=0, **arguments)


@pytest.mark.long
def test_number_of_jobs_does_not_change_a_bit():
    one, two = (make_dynamics("iiwa14", 65, 2, random_state=0, n_jobs=jobs) for jobs in (1, 2))
    assert_array_equal(one.data, two.data)
    assert_array_equal(one.target, two.target)
