"""Efforts that are recorded later or earlier than the motion."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from skevgp.datasets import load_log, load_robot
from skevgp.exceptions import RobotModelWarning
from skevgp.robots import RigidBody

from .cases import BY_NUMBER, irregular_times, motion, table_of, text_of, write_table

T = irregular_times()
ARM = [f"panda_joint{number}" for number in range(1, 8)]


def late_table(t, delay):
    """Efforts that were recorded later by so much, s; perhaps by joints."""
    table = table_of(t)
    for joint, one in enumerate(np.broadcast_to(delay, 2)):
        table[:, 6 + joint] = motion(t - one)[3][:, joint]
    return table


@pytest.mark.parametrize(
    ("delay", "irregular"),
    [
        (0.02, True),
        (-0.013, True),
        ([0.03, -0.02], True),
        ([0.03, -0.02], False),
        pytest.param(0.02, False, marks=pytest.mark.long),
        pytest.param(-0.013, False, marks=pytest.mark.long),
    ],
    ids=str,
)
def test_efforts_are_moved_to_the_motion_that_they_belong_to(tmp_path, delay, irregular):
    t = T if irregular else np.arange(0.0, 14.0, 0.008)
    file = write_table(tmp_path / "log.csv", late_table(t, delay))
    log = load_log(file, columns=BY_NUMBER, delay=delay, dt=0.01 if irregular else None)
    assert_allclose(log.target, motion(log.time + t[0])[3], atol=5e-3)
    assert_array_equal(log.recordings[0].delay, np.broadcast_to(delay, 2))
    assert_allclose(log.recordings[0].raw.torque, late_table(t, delay)[:, 6:8], rtol=1e-9)
    # Rows without efforts are cut with those of the filter.
    early, late = max(-np.min(delay), 0.0), max(np.max(delay), 0.0)
    (begin, first, _), (last, end, _) = log.recordings[0].cuts
    assert_allclose([begin, end], [0.0, t[-1] - t[0]], atol=0.01)
    assert_allclose([first, end - last], [0.4 + early, 0.4 + late], atol=0.015)


def test_no_effort_comes_from_across_a_gap(tmp_path):
    t = np.delete(T, slice(1000, 1100))
    table = late_table(t, 0.05)
    other = table.copy()
    other[1000:, 6:8] += 100.0
    plain, changed = (
        load_log(write_table(tmp_path / "log.csv", one), columns=BY_NUMBER, delay=0.05) for one in (table, other)
    )
    assert_array_equal(changed.target[plain.pieces == 0], plain.target[plain.pieces == 0])
    with pytest.raises(ValueError, match="too short: no piece without gaps is longer than the 12.8 s cut at its ends"):
        load_log(tmp_path / "log.csv", columns=BY_NUMBER, delay=12.0)


def simulated(path, robot, joints, delay, seed=0):
    """Sums of sines, torques with friction and 2 % of noise, recorded for 30 s at 125 Hz; columns as in load_log."""
    model, rng = load_robot(robot, joints=joints), np.random.default_rng(seed)
    t = np.arange(0.0, 30.0, 0.008)
    frequency = 2.0 * np.pi * np.array([0.08, 0.17, 0.29, 0.41])
    phase = rng.uniform(0.0, 2.0 * np.pi, (model.nv, 4))

    def states(t):
        angle = t[:, np.newaxis, np.newaxis] * frequency + phase
        each = np.sin(angle), frequency * np.cos(angle), -(frequency**2) * np.sin(angle)
        return [0.2 * one.sum(axis=2) for one in each]

    q, v, a = states(t - delay)
    torque = RigidBody(model).forces(q, v, a)
    scale = torque.std(axis=0)
    torque += scale * (0.1 * np.tanh(v / 0.02) + 0.1 * v + 0.02 * rng.standard_normal(torque.shape))
    q, v, _ = states(t)
    v += 1e-3 * rng.standard_normal(v.shape)
    path.write_text(text_of(np.column_stack([t, q[:, ::-1], v[:, ::-1], torque[:, ::-1]])))  # last joint first
    signals = ("position", "velocity", "effort")
    return {"time": 0, **{name: range(1 + i * model.nv, 1 + (i + 1) * model.nv) for i, name in enumerate(signals)}}


@pytest.mark.parametrize(
    ("robot", "joints"), [pytest.param("panda", ARM, marks=pytest.mark.long), ("acrobot", ["q1", "q2"])]
)
def test_delay_is_estimated_for_each_file(tmp_path, robot, joints):
    """Also if only some joints of the robot were recorded, in another order, with wrong masses."""
    delays, files = [0.0, 0.008, 0.023, -0.012], [tmp_path / f"{number}.csv" for number in range(4)]
    for seed, (file, delay) in enumerate(zip(files, delays, strict=True)):
        columns = simulated(file, robot, joints, delay, seed)
    with pytest.warns(RobotModelWarning, match=r"by [78]\.\d ms in .*1.csv, 2[23]\.\d ms in .*2.csv, -1[12]") as warned:
        log = load_log(files, columns=columns, joints=joints[::-1], robot=robot, delay="auto", cutoff=None)
    assert "0.csv" not in str(warned[0].message)
    found = np.array([recording.delay for recording in log.recordings])
    assert_allclose(found, np.tile(np.array(delays)[:, np.newaxis], len(joints)), atol=1e-3)
    assert not found[0].any()
    told = log.DESCR.split("; ")
    assert sum("efforts moved earlier by" in one for one in told) == 3


def test_delay_beyond_those_tried_raises(tmp_path):
    columns = simulated(tmp_path / "log.csv", "pendulum", None, 0.15)
    with pytest.raises(ValueError, match=r'log.csv: delay="auto" tries delays up to 0.1 s, and .* best at 0.1'):
        load_log(tmp_path / "log.csv", columns=columns, robot="pendulum", delay="auto")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"delay": "auto"}, 'delay="auto" needs robot='),
        ({"delay": "some"}, "delay must be \"auto\", a number, or one for each joint, s; got 'some'"),
        ({"delay": np.nan}, "log.csv: delay must be a finite number, or one for each of the 2 joints; got nan"),
        ({"delay": [0.1]}, r"log.csv: delay must be a finite number, or one for each of the 2 joints; got \[0.1\]"),
        ({"delay": "auto", "robot": "acrobot", "rest_velocity": 99.0}, "log.csv: all rows are at rest"),
    ],
)
def test_invalid_delay_raises(tmp_path, arguments, message):
    file = write_table(tmp_path / "log.csv", table_of(T))
    with pytest.raises(ValueError, match=message):
        load_log(file, columns=BY_NUMBER, **arguments)
