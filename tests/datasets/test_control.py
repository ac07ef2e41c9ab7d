from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from skevgp.datasets import ComputedTorqueController, quintic_reference, simulate
from skevgp.robots import load_robot


@pytest.fixture(scope="module")
def stored():
    return np.load(Path(__file__).parents[1] / "data" / "iiwa14_computed_torque.npz")


def test_reference_starts_and_ends_at_rest():
    q, v, a = quintic_reference([0.2, -1.0], [1.0, 2.0], 1.5, [-1.0, 0.0, 1.5, 2.0])
    assert_allclose(q, [[0.2, -1.0], [0.2, -1.0], [1.0, 2.0], [1.0, 2.0]], rtol=1e-15)
    assert_array_equal(v, np.zeros((4, 2)))
    assert_array_equal(a, np.zeros((4, 2)))


def test_reference_equals_the_stored_one(stored):
    q, v, a = quintic_reference(stored["q0"], stored["q1"], 1.0, 0.03 * np.arange(50))
    assert_allclose(np.concatenate([q, v], axis=-1), stored["smooth_Zd"], rtol=0, atol=1e-12)
    assert_allclose(a, stored["smooth_Ad"], rtol=0, atol=1e-11)


def test_commands_equal_the_stored_ones_step_by_step(stored):
    controller = ComputedTorqueController("iiwa14", stored["q0"], stored["q1"], duration=1.0)
    for step in range(50):
        commands = controller(step, stored["smooth_Z"][:, step]) + stored["noise"][:, step]
        assert_allclose(commands, stored["smooth_U"][:, step], rtol=0, atol=1e-8)
        assert_allclose(controller.integral, stored["smooth_I"][:, step], rtol=0, atol=1e-9)


def test_clamped_commands_equal_the_stored_ones(stored):
    effort, Z = stored["effort_limit"], stored["step_Z"]
    before, after = Z[:, :-1].reshape(-1, 14), Z[:, 1:].reshape(-1, 14)
    U = stored["step_U"].reshape(-1, 1, 7)
    assert (np.abs(U) > effort).any()
    ends, acted = simulate("iiwa14", before, U, return_inputs=True)
    assert_array_equal(acted[:, 0], stored["step_U_acted"].reshape(-1, 7))
    assert_allclose(ends[:, 1], after, rtol=0, atol=1e-8)


OTHERS = ["iiwa14", "panda", "kinova", "talos_left_arm"]


@pytest.mark.parametrize(
    "robot", ["ur5", "double_pendulum", *(pytest.param(name, marks=pytest.mark.long) for name in OTHERS)]
)
def test_robot_arrives_at_its_target(robot):
    n = load_robot(robot).nv
    q0, q1 = np.zeros((2, n)), np.array([[0.02], [-0.02]]) * np.ones(n)
    controller = ComputedTorqueController(robot, q0, q1, duration=0.3)
    Z = simulate(robot, np.zeros((2, 2 * n)), controller, n_steps=30)
    assert_allclose(Z[:, -1, :n], q1, rtol=0, atol=0.002)


ZERO, ONE = np.zeros(7), np.ones(7)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"robot": "acrobot"}, r"All joints must be driven; those of 'acrobot' without a motor are \['q1'\]"),
        ({"robot": "robot"}, "Unknown robot 'robot'"),
        ({"q0": np.zeros(6), "q1": np.ones(6)}, "q0 and q1 must have 7 columns for 'iiwa14'; got 6"),
        ({"q1": np.ones((2, 7))}, r"same shape.*got \(7,\) and \(2, 7\)"),
        ({"q0": np.full(7, np.nan)}, "q0 must be finite"),
        ({"duration": 0.0}, "duration must be finite and above 0.0; got 0.0"),
        ({"dt": -0.03}, "dt must be finite and above 0.0; got -0.03"),
        ({"kp": -1.0}, "kp must be a number or 7 numbers, not negative; got -1.0"),
        ({"ki": np.ones(6)}, "ki must be a number or 7 numbers"),
        ({"kd": 67.0}, r"kd must be below 2 / dt = 66.6667.*got 67.0"),
        ({"kd": 64.0, "dt": 0.03125}, r"kd must be below 2 / dt = 64,.*got 64.0"),
    ],
)
def test_invalid_arguments_of_a_controller_raise(arguments, message):
    with pytest.raises(ValueError, match=message):
        ComputedTorqueController(**{"robot": "iiwa14", "q0": ZERO, "q1": ONE, "duration": 1.0} | arguments)


@pytest.fixture
def ur5():
    return ComputedTorqueController("ur5", np.zeros(6), np.ones(6), duration=1.0)


@pytest.mark.parametrize(("steps", "next_step"), [([3], 0), ([0, 2], 1), ([0, 1, 1], 2)])
def test_steps_that_do_not_follow_one_another_raise(ur5, steps, next_step):
    *before, last = steps
    for step in before:
        ur5(step, np.zeros((1, 12)))
    with pytest.raises(ValueError, match=f"follow one another from 0; got {last}, expected 0 or {next_step}"):
        ur5(last, np.zeros((1, 12)))


@pytest.mark.parametrize(("step", "error"), [(-1, ValueError), (0.0, TypeError), ("0", TypeError)])
def test_invalid_step_raises(ur5, step, error):
    with pytest.raises(error, match="step must be"):
        ur5(step, np.zeros((1, 12)))


def test_number_of_trajectories_stays(ur5):
    ur5(0, np.zeros((2, 12)))
    with pytest.raises(ValueError, match="There were 2 trajectories in step 0; got 3"):
        ur5(1, np.zeros((3, 12)))


def test_refused_call_changes_nothing(ur5):
    Z = np.random.default_rng(0).uniform(-0.1, 0.1, (2, 1, 12))
    ur5(0, Z[0])
    with pytest.raises(ValueError, match="must fit q0"):
        ur5(1, np.zeros((1, 10)))
    torque = ur5(1, Z[1])
    ur5(0, Z[0])
    assert_array_equal(ur5(1, Z[1]), torque)


@pytest.mark.parametrize(("Z", "message"), [([[np.nan] * 12], "Z must be finite"), ([["a"] * 12], "Z must be real")])
def test_states_that_are_no_numbers_raise(ur5, Z, message):
    with pytest.raises(ValueError, match=message):
        ur5(0, Z)


@pytest.mark.parametrize("shape", [(14,), (3, 14), (2, 12)])
def test_states_of_another_shape_raise(shape):
    controller = ComputedTorqueController("iiwa14", np.zeros((2, 7)), np.ones((2, 7)), duration=1.0)
    with pytest.raises(ValueError, match=r"must fit q0, of shape \(2, 7\)"):
        controller(0, np.zeros(shape))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 1.0, 1.0, 0.0), "q0 and q1 must have the same shape"),
        (([0.0], [1.0], 0.0, 0.0), "duration must be finite and above 0.0"),
        (([0.0], [1.0], 1.0, [[0.0]]), "times must be a number or one-dimensional"),
        (([0.0], [1.0], 1.0, np.inf), "times must be finite"),
    ],
)
def test_invalid_arguments_of_a_reference_raise(arguments, message):
    with pytest.raises(ValueError, match=message):
        quintic_reference(*arguments)
