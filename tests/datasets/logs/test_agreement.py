"""Recorded velocities that contradict positions."""

import numpy as np
import pytest

from skevgp.datasets import load_log

from .cases import text_of

T = np.arange(0.0, 20.0, 0.02)
Q = np.column_stack([np.sin(T) + 0.3 * np.sin(2.7 * T), np.cos(1.4 * T) - 0.2 * np.sin(3.1 * T)])
DQ = np.column_stack([np.cos(T) + 0.81 * np.cos(2.7 * T), -1.4 * np.sin(1.4 * T) - 0.62 * np.cos(3.1 * T)])
COLUMNS = {"time": 0, "position": [1, 2], "velocity": [3, 4], "effort": [5, 6]}


@pytest.fixture
def load(tmp_path):
    def load(q, dq, **arguments):
        file = tmp_path / "log.csv"
        file.write_text(text_of(np.column_stack([T, q, dq, q])))
        return load_log(file, columns=COLUMNS, **arguments)

    return load


@pytest.fixture(scope="module")
def agreeing(tmp_path_factory):
    """The log of velocities that agree with positions."""
    file = tmp_path_factory.mktemp("agreeing") / "log.csv"
    file.write_text(text_of(np.column_stack([T, Q, DQ, Q])))
    return load_log(file, columns=COLUMNS)


def late(seconds):
    return np.column_stack([np.interp(T - seconds, T, column) for column in DQ.T])


@pytest.mark.parametrize(
    ("dq", "cause"),
    [
        (0.0 * DQ, "joint 'q2': it is 0 in all rows.*never fill"),
        (DQ * [1.0, 0.0], "Joint 'q2': it is 0 in all rows"),
        (np.degrees(DQ), "57.*degrees per second"),
        (DQ * 30.0 / np.pi, "revolutions per minute"),
        (DQ * [1.0, -101.0], "Joint 'q2': it is -101 times.*motor"),
        (-DQ, "opposite sign"),
        (DQ[:, ::-1], "Joint 'q1': the column of 'q2' fits it"),
        (np.abs(DQ), "speed without sign"),
        (late(0.2), "0.2 s late"),
        (DQ + [0.5, 0.0], "Joint 'q1': it is 0.5 too high in all rows"),
        (np.where(T[:, np.newaxis] < 9.0, 0.0, DQ), "does not follow the motion in the first half .slope 0 instead"),
        (np.where(DQ < 0.0, 0.0, DQ), "does not follow the motion where the position falls"),
    ],
)
def test_contradicting_velocity_raises(load, agreeing, dq, cause):
    with pytest.raises(ValueError, match=f"log.csv: the recorded velocity contradicts the position.*{cause}"):
        load(Q, dq)
    derived = load(Q, dq, velocity="derive")
    assert derived.recordings[0].raw.velocity is None
    assert np.abs(derived.data[:, 2:4] - agreeing.data[:, 2:4]).max() < 1e-2


def test_joints_that_hardly_move_are_not_judged(load):
    rng = np.random.default_rng(0)
    q = Q * [1.0, 0.0] + 1e-3 * rng.standard_normal(Q.shape)
    load(q, DQ * [1.0, 0.0])


def test_invalid_velocity_raises(load):
    with pytest.raises(ValueError, match='velocity must be "recorded" or "derive"; got \'none\''):
        load(Q, DQ, velocity="none")


def test_differences_of_a_coarse_encoder_agree_though_most_rows_are_0(load):
    fine = np.arange(0.0, 20.0, 0.001)
    count = 2.0 * np.pi / 2048.0
    q = np.round(np.column_stack([np.sin(0.3 * fine), np.cos(0.2 * fine)]) / count) * count
    dq = np.diff(q, axis=0, append=q[-1:]) / 0.001
    assert np.mean(dq[::20] == 0.0) > 0.5
    load(q[::20], dq[::20])
    with pytest.raises(ValueError, match="contradicts the position"):
        load(q[::20], -dq[::20])


def test_stamps_may_come_in_bursts(tmp_path):
    """Ten rows within two milliseconds, then none for 98: what a host stamps that reads a buffer."""
    t = np.arange(0.0, 20.0, 0.01)
    stamps = np.floor(t / 0.1) * 0.1 + np.arange(len(t)) % 10 * 2e-4
    file = tmp_path / "log.csv"
    for factor in (1.0, 3.0):
        file.write_text(text_of(np.column_stack([stamps, np.sin(t), factor * np.cos(t), t]), "%.9g"))
        columns = {"time": 0, "position": 1, "velocity": 2, "effort": 3}
        if factor == 1.0:
            load_log(file, columns=columns, max_gap=0.5)
        else:
            with pytest.raises(ValueError, match="contradicts the position"):
                load_log(file, columns=columns, max_gap=0.5)


@pytest.mark.parametrize("seconds", [0.04, 0.1, 0.2, -0.1])
def test_delay_of_periodic_motion_is_the_shortest(load, seconds):
    q = np.column_stack([np.sin(4.0 * np.pi * T), np.cos(4.0 * np.pi * T)])
    dq = 4.0 * np.pi * np.column_stack([np.cos(4.0 * np.pi * (T - seconds)), -np.sin(4.0 * np.pi * (T - seconds))])
    with pytest.raises(ValueError, match=f"{abs(seconds):.2g} s {'late' if seconds > 0.0 else 'early'}"):
        load(q, dq)


def test_accelerometer_that_measures_gravity_too_is_no_contradiction(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text(text_of(np.column_stack([T, np.sin(T), np.cos(T), 0.5 - np.sin(T), T])))
    log = load_log(file, columns={"time": 0, "position": 1, "velocity": 2, "acceleration": 3, "effort": 4})
    assert np.abs(log.data[:, 2] - 0.5 + log.data[:, 0]).max() < 0.01
