"""Corrupt velocities and efforts are cut and named; noise, steps and impacts stay."""

import warnings

import numpy as np
import pytest

from skevgp.datasets import log_transitions
from skevgp.exceptions import RobotModelWarning

from .cases import PENDULUM, identified, pendulum

VELOCITY, EFFORT = 2, 3


def spoilt(rows, column, value):
    table = pendulum()
    table[rows, column] = value
    return table


@pytest.mark.parametrize(
    ("rows", "column", "value", "named"),
    [
        (700, VELOCITY, 10.0, r"the velocity of joint 'q1' in row 700 \(10\)"),
        (700, VELOCITY, 1000.0, r"the velocity of joint 'q1' in row 700 \(1000\)"),
        ([700, 701], VELOCITY, 0.0, r"the velocity of joint 'q1' in row 700 \(0\)"),
        (slice(700, 715), VELOCITY, 0.0, r"the velocity of joint 'q1' in row 7\d\d \(0\)"),
        (700, EFFORT, 100.0, r"the effort of joint 'q1' in row 700 \(100\)"),
        ([700, 1200, 1201], EFFORT, 65535.0, r"in row 700 \(65535\), the effort of joint 'q1' in row 120\d \(65535\)"),
        (700, EFFORT, 0.0, r"the effort of joint 'q1' in row 700 \(0\)"),
        (0, EFFORT, 65535.0, r"in row 0 \(65535\)"),
        (1999, EFFORT, -32768.0, r"in row 1999 \(-32768\)"),
    ],
)
def test_corrupt_value_is_cut(load, rows, column, value, named):
    with pytest.warns(RobotModelWarning, match=f"log.csv: corrupt values were cut: .*{named}"):
        log = load(spoilt(rows, column, value))
    assert identified(log) == pytest.approx(PENDULUM, abs=0.02)
    corrupt = np.zeros(2000, dtype=bool)
    corrupt[rows] = True
    starts = np.flatnonzero(corrupt & ~np.r_[False, corrupt[:-1]])
    cuts = [cut for cut in log.recordings[0].cuts if cut[2] == "corrupt"]
    assert len(cuts) == len(log.recordings[0].corrupt) == len(starts)
    for (first, last, _), start in zip(cuts, starts, strict=True):
        assert first <= max(0.01 * start - 0.01, 0.0) + 1e-9
        assert last >= min(0.01 * start + 0.01, 19.99) - 1e-9
        assert not ((log.time > first) & (log.time < last)).any()
    assert f"{len(starts)} corrupt values" in log.DESCR


def test_corrupt_row_is_counted_in_the_file(load):
    table = spoilt(700, EFFORT, 65535.0)
    with pytest.warns(RobotModelWarning, match="in row 700"):
        log = load(table, keep=slice(300, None), gains=2.0)
    (corrupt,) = log.recordings[0].corrupt
    assert corrupt == {"row": 700, "joint": "q1", "signal": "effort", "value": 65535.0}


def test_no_transition_has_a_corrupt_value(load):
    with pytest.warns(RobotModelWarning, match="corrupt"):
        log = load(spoilt(700, EFFORT, 65535.0))
    found = log_transitions(log)
    assert len(found.data) == 1999 - 2
    assert np.abs(found.data[:, 2]).max() < 10.0


def test_record_full_of_corrupt_values_is_an_error(load):
    with pytest.raises(ValueError, match="too short.*efforts are corrupt 40 times, first at 0.2[45] s"):
        load(spoilt(slice(25, None, 50), EFFORT, 65535.0))


def genuine(name):
    """Logs that look corrupt, and are not."""
    table, rng = pendulum(), np.random.default_rng(1)
    t = table[:, 0]
    if name == "one step of the effort":
        table[:, EFFORT] = np.where(t < 7.0, 0.0, 50.0)
    elif name == "effort of two levels":
        table[:, EFFORT] = 5.0 * (-1.0) ** np.arange(len(t))
    elif name == "one pulse of the effort":
        table[:, EFFORT] = np.where((t > 7.0) & (t < 7.1), 50.0, table[:, EFFORT])
    elif name == "short pulses of the effort":
        table[:, EFFORT] += np.where(np.arange(len(t)) % 97 < 2, 50.0, 0.0)
    elif name == "noise with outliers":
        table[:, EFFORT] += rng.standard_t(4, len(t))
        table[:, VELOCITY] += 0.2 * rng.standard_t(4, len(t))
    elif name == "differences of coarse positions":
        table = pendulum(0.002, 10.0)
        table[:, 1] = np.round(table[:, 1], 3)
        table[1:, VELOCITY] = np.diff(table[:, 1]) / 0.002
    elif name == "impacts":
        table = pendulum(0.002, 10.0)
        t = table[:, 0]
        table[:, 1], table[:, VELOCITY] = np.abs(np.sin(t)), np.cos(t) * np.sign(np.sin(t))
        table[:, EFFORT] = np.sin(t) + 3.0 * (np.abs(np.sin(t)) < 0.001)
    return table


@pytest.mark.parametrize(
    "name",
    [
        "one step of the effort",
        "effort of two levels",
        "one pulse of the effort",
        "short pulses of the effort",
        "noise with outliers",
        "differences of coarse positions",
        "impacts",
    ],
)
def test_steps_noise_and_impacts_are_not_corrupt(load, name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        log = load(genuine(name))
    assert log.recordings[0].corrupt == []
    assert {why for *_, why in log.recordings[0].cuts} <= {"edge", "rest"}
