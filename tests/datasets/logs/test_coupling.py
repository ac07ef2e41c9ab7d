"""Signals of motors that become those of joints."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from skevgp.datasets import load_log

from .cases import BY_NUMBER, irregular_times, table_of, write_table

T = irregular_times()
# A differential: the first motor moves both joints.
COUPLING = np.array([[1.0 / 50.0, 0.0], [1.0 / 100.0, -1.0 / 80.0]])


def of_motors(table, coupling=COUPLING):
    """The table with positions, velocities and efforts of the motors."""
    table, inverse = table.copy(), np.linalg.inv(coupling)
    for columns in (slice(1, 3), slice(4, 6)):
        table[:, columns] = table[:, columns] @ inverse.T
    table[:, 6:8] = table[:, 6:8] @ coupling
    return table


@pytest.fixture
def file(tmp_path):
    return write_table(tmp_path / "log.csv", of_motors(table_of(T)))


def test_coupling_gives_the_signals_of_joints_and_keeps_the_power(tmp_path, file):
    joints = load_log(write_table(tmp_path / "joints.csv", table_of(T)), columns=BY_NUMBER)
    motors, log = (load_log(file, columns=BY_NUMBER, gains=2.0, coupling=one) for one in (None, COUPLING))
    assert_allclose(log.recordings[0].raw.position, joints.recordings[0].raw.position, atol=1e-9)
    assert_allclose(log.data, joints.data, atol=1e-8)
    assert_allclose(log.target, 2.0 * joints.target, rtol=1e-8)
    power = [np.sum(one.velocity * one.torque, axis=1) for one in (log.recordings[0].raw, motors.recordings[0].raw)]
    assert_allclose(power[0], power[1], rtol=1e-10, atol=1e-10)


def test_angles_of_motors_are_unwrapped_before(file):
    table = of_motors(table_of(T))
    whole = load_log(file, columns=BY_NUMBER, coupling=COUPLING)
    table[:, 1:3] = (table[:, 1:3] + np.pi) % (2.0 * np.pi) - np.pi
    # Joints of this robot have limits, and motors have none.
    log = load_log(write_table(file, table), columns=BY_NUMBER, coupling=COUPLING, robot="double_pendulum")
    assert min(log.recordings[0].wrapped.values()) > 10
    offset = log.data[0, :2] - whole.data[0, :2]
    assert_allclose(log.data[:, :2], whole.data[:, :2] + offset, atol=1e-8)
    assert_allclose(log.data[:, 2:], whole.data[:, 2:], atol=1e-8)


def test_velocity_of_a_wrapped_angle_is_named_for_each_joint_that_the_motor_moves(file):
    coupling = np.array([[0.2, 0.0], [0.1, -0.5]])
    table = of_motors(table_of(T), coupling)
    table[:, 1] = table[:, 1] % (2.0 * np.pi) - np.pi
    table[:, 4] = np.gradient(table[:, 1], T)
    with pytest.raises(ValueError, match=r"Joint 'q1': .*angle wraps.*; joint 'q2': .*angle wraps"):
        load_log(write_table(file, table), columns=BY_NUMBER, coupling=coupling)


@pytest.mark.parametrize(
    ("coupling", "message"),
    [
        ([[1.0, 2.0], [2.0, 4.0]], r"coupling must be invertible, .* its condition number is \d"),
        (np.zeros((2, 2)), "coupling must be invertible, .* its condition number is inf"),
        ([1.0, 2.0], r"coupling must be a finite matrix of shape \(2, 2\), with a row for each joint"),
        ([[1.0, np.nan], [0.0, 1.0]], "coupling must be a finite matrix"),
        ([["a", "b"], ["c", "d"]], "coupling must be real numbers"),
    ],
)
def test_invalid_coupling_raises(file, coupling, message):
    with pytest.raises(ValueError, match=f"log.csv: {message}"):
        load_log(file, columns=BY_NUMBER, coupling=coupling)


def test_identity_changes_nothing(file):
    plain, log = (load_log(file, columns=BY_NUMBER, coupling=one) for one in (None, np.eye(2)))
    assert_array_equal(log.data, plain.data)
    assert_array_equal(log.target, plain.target)
