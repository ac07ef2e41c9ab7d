from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.utils import Bunch

from skevgp.datasets import load_log, log_transitions, simulate
from skevgp.exceptions import RobotModelWarning, ignored

from .cases import BY_NUMBER, irregular_times, motion, table_of, write_table

T = irregular_times(8.0)
GAIN = 3.0


@pytest.fixture
def load(tmp_path):
    def load(*tables, **arguments):
        files = [write_table(tmp_path / f"{number}.csv", table) for number, table in enumerate(tables)]
        return load_log(files, **{"columns": BY_NUMBER, "gains": GAIN, "rest_velocity": 0.0, **arguments})

    return load


def parts(transitions, n=2):
    """States, torques, steps and next states."""
    data = transitions.data
    return data[:, : 2 * n], data[:, 2 * n : 3 * n], data[:, -1], transitions.target


def test_row_is_a_recorded_state_with_its_torque_and_the_time_to_the_next(load):
    found = log_transitions(load(table_of(T)))
    states, torques, dt, then = parts(found)
    q, dq, _, current = motion(T)
    assert len(found.data) == len(T) - 1
    assert_allclose(states, np.hstack([q, dq])[:-1], atol=1e-10)
    assert_allclose(then, np.hstack([q, dq])[1:], atol=1e-10)
    assert_allclose(torques, GAIN * current[:-1], atol=1e-9)
    assert_allclose(dt, np.diff(T), atol=1e-10)
    assert_allclose(found.time, T[:-1] - T[0], atol=1e-10)


@pytest.mark.parametrize(("start", "n_rows"), [(0.0, 2000), (1e5, 400), (1.7e9, 400)])
def test_steps_of_a_regular_clock_are_equal(load, start, n_rows):
    table = table_of(0.01 * np.arange(n_rows))
    table[:, 0] += start
    assert_array_equal(np.unique(log_transitions(load(table)).data[:, -1]), [0.01])


@pytest.mark.parametrize("stride", [2, 5])
def test_with_a_stride_states_follow_each_other_and_torques_are_means(load, stride):
    states, torques, dt, then = parts(log_transitions(load(table_of(T)), stride=stride, align=False))
    q, dq, _, current = motion(T)
    starts = np.arange(0, len(T) - stride, stride)
    assert_allclose(states, np.hstack([q, dq])[starts], atol=1e-10)
    assert_array_equal(states[1:], then[:-1])
    assert_allclose(dt, T[starts + stride] - T[starts], atol=1e-10)
    for row, start in enumerate(starts):
        way = slice(start, start + stride)
        mean = np.average(GAIN * current[way], axis=0, weights=np.diff(T)[way])
        assert_allclose(torques[row], mean, atol=1e-8)


def test_velocities_of_long_strides_are_means_around_the_state(load):
    t = 0.01 * np.arange(800)
    table, rng = table_of(t), np.random.default_rng(0)
    table[:, 4:6] += 0.2 * rng.normal(size=(len(t), 2))
    log = load(table, rest_velocity=0.0)
    noisy, found = (parts(log_transitions(log, stride=12, align=align))[0] for align in (False, True))
    truth = motion(t)[1][: 12 * len(found) : 12]
    errors = [np.sqrt(np.mean((states[2:-2, 2:] - truth[2:-2]) ** 2)) for states in (noisy, found)]
    assert_allclose(errors[0], 0.2, rtol=0.2)
    assert errors[1] < 0.6 * errors[0]  # half of 12 rows: 1 / sqrt(6), and the curvature of the motion
    assert_array_equal(found[:, :2], noisy[:, :2])
    assert_array_equal(found[0], noisy[0])  # there are no rows before the first


def test_a_change_of_averaged_velocities_is_by_torques_with_the_same_average(load):
    """Masses of 2 and 5 kg under torques that change in each row, as those of a feedback on noisy velocities do."""
    t, masses = 0.002 * np.arange(600), np.array([2.0, 5.0])
    torque = np.random.RandomState(0).uniform(-1.0, 1.0, (len(t), 2))
    v = 0.002 * np.vstack([np.zeros(2), np.cumsum(torque[:-1], axis=0)]) / masses
    q = 0.002 * np.vstack([np.zeros(2), np.cumsum(0.5 * (v[:-1] + v[1:]), axis=0)])
    table = table_of(t)
    table[:, [BY_NUMBER["position"], BY_NUMBER["velocity"]]] = np.stack([q, v], axis=1)
    table[:, BY_NUMBER["current"]] = torque / GAIN
    for stride in (5, 12):
        states, torques, dt, then = parts(log_transitions(load(table, max_gap=0.1), stride=stride))
        assert_allclose(then[:, 2:] - states[:, 2:], torques * dt[:, np.newaxis] / masses, atol=1e-9)
        assert torques.std(axis=0).min() > 0.05


@pytest.mark.parametrize("rows_late", [0.0, 0.5, 0.8])
def test_positions_are_taken_at_the_time_of_late_velocities(load, rows_late):
    t, late = 0.03 * np.arange(400), 0.03 * rows_late
    table = table_of(t)
    table[:, 4:6] = motion(t - late)[1]
    found = log_transitions(load(table, rest_velocity=0.0))
    assert_allclose(found.velocity_delay, late, atol=5e-4)
    states, _, _, then = parts(found)
    q, dq, _, _ = motion(found.time + t[0] - late)
    assert_allclose(states, np.hstack([q, dq]), atol=4e-3)  # by linear interpolation
    assert_array_equal(states[1:], then[:-1])
    assert_array_equal(log_transitions(load(table, rest_velocity=0.0), align=False).velocity_delay, 0.0)


@cache
def pushed(n_held, h):
    """A pendulum with torques that are held for some rows of h seconds: torques, angles and velocities."""
    held = np.repeat(np.random.default_rng(0).uniform(-3.0, 3.0, 240 // n_held), n_held)
    inputs = np.repeat(held, 10)[np.newaxis, :, np.newaxis]
    return held, *simulate("pendulum", np.array([[0.3, 0.0]]), inputs, h / 10.0)[0, :-1:10].T


@pytest.mark.parametrize("n_held", [1, 2, 4])
@pytest.mark.parametrize("are_late", [False, True])
@pytest.mark.parametrize("recorded", ["next", "last"])
def test_with_an_estimated_delay_the_torque_is_that_of_the_transition(tmp_path, recorded, are_late, n_held):
    """A pendulum with held torques. Late velocities are differences of positions, as those of many drives."""
    h = 0.03
    held, q, velocity = pushed(n_held, h)
    if are_late:
        velocity = np.diff(q, prepend=q[0]) / h
    effort = held if recorded == "next" else np.append(0.0, held[:-1])
    table = np.column_stack([h * np.arange(len(q)), q, velocity, effort])[1:]
    columns = {"time": 0, "position": 1, "velocity": 2, "effort": 3}
    with ignored(category=RobotModelWarning):
        log = load_log(
            write_table(tmp_path / "log.csv", table), columns=columns, robot="pendulum", delay="auto", wrap=False
        )
    found = log_transitions(log)
    assert_allclose(found.velocity_delay, h / 2.0 if are_late else 0.0, rtol=0.05)
    row = np.searchsorted(table[:, 0], found.time + table[0, 0] - 1e-6) + 1
    # Late states are those at half of a row before. So each transition has half of two torques.
    truth = 0.5 * (held[row - 1] + held[row]) if are_late else held[row]
    assert np.sqrt(np.mean((found.data[:, 2] - truth) ** 2)) < 0.15 * truth.std()


@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_velocities_of_each_joint_have_their_own_delay(load, unit):
    t, late = 0.03 * np.arange(400), np.array([0.015, 0.0])
    table = table_of(t)
    table[:, 4] = motion(t - 0.015)[1][:, 0]
    table[:, [2, 5]] *= unit
    found = log_transitions(load(table, rest_velocity=0.0, wrap=False))
    assert_allclose(found.velocity_delay, [late], atol=5e-4)
    states, _, _, _ = parts(found)
    q, dq, _, _ = motion(found.time + t[0] - 0.015)
    states[:, [1, 3]] /= unit
    assert_allclose(states, np.hstack([q, dq]), atol=1e-2)  # by linear interpolation


def test_late_velocities_cost_one_row_of_each_motion(load):
    t = 0.03 * np.arange(400)
    table = table_of(t)
    table[:, 4:6] = motion(t - 0.015)[1]
    log = load(np.delete(table, [200], axis=0), rest_velocity=0.0, max_gap=0.04)
    assert len(log_transitions(log, align=False).data) == 397
    assert len(log_transitions(log).data) == 395


@pytest.mark.parametrize("stride", [1, 3])
def test_there_is_no_transition_across_a_gap(load, stride):
    t = np.delete(T, slice(400, 450))
    found = log_transitions(load(table_of(t)), stride=stride)
    assert found.data[:, -1].max() < stride * 0.0121
    assert len(found.data) == (399 // stride) + (len(t) - 401) // stride


@pytest.mark.parametrize("stride", [1, 3])
def test_torques_are_the_efforts_recorded_later_by_the_delay(load, stride):
    t = np.delete(np.arange(0.0, 8.0, 0.01), slice(400, 450))
    table, late = table_of(t), np.array([3, -2])
    log = load(table, delay=0.01 * late)
    found = log_transitions(log, stride=stride)
    assert len(found.data) in range(len(t) // stride - 16, len(t) // stride)
    for row, start in zip(found.data, np.searchsorted(t, found.time - 1e-6), strict=True):
        way = start + np.arange(stride)
        for joint, rows in enumerate(late):
            assert_allclose(row[4 + joint], GAIN * table[way + rows, 6 + joint].mean(), rtol=1e-8)


def test_velocities_must_be_recorded(load):
    log = load(table_of(T), columns={"time": 0, "position": [1, 2], "effort": [6, 7]})
    with pytest.raises(ValueError, match="0.csv: there are no recorded velocities.* make rows from the filtered"):
        log_transitions(log)


def test_description_tells_the_number_of_rows_and_the_time_steps(load):
    regular = load(table_of(np.arange(0.0, 8.0, 0.01)))
    assert (
        "transitions, each over 1 time step of the recording (0.01 s), not filtered" in log_transitions(regular).DESCR
    )
    found = log_transitions(load(table_of(T)), stride=2)
    dt = found.data[:, -1]
    assert (
        f"{len(dt)} transitions, each over 2 time steps of the recording ({dt.min():.4g} to {dt.max():.4g} s)"
        in found.DESCR
    )


def test_some_transition_must_remain(load):
    with pytest.raises(
        ValueError, match="No 1001 rows follow each other without a gap, jump or rest. Lower stride=1000"
    ):
        log_transitions(load(table_of(T)), stride=1000)


def test_invalid_arguments_raise(load):
    log = load(table_of(T))
    with pytest.raises(ValueError, match="stride must be at least 1; got 0"):
        log_transitions(log, stride=0)
    with pytest.raises(TypeError, match="stride must be an integer; got 1.5"):
        log_transitions(log, stride=1.5)
    with pytest.raises(TypeError, match="align must be True or False; got 'no'"):
        log_transitions(log, align="no")
    for wrong in ("log.csv", Bunch(data=log.data)):
        with pytest.raises(TypeError, match="log must be a result of load_log; got"):
            log_transitions(wrong)
