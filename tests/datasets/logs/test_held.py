"""Frames that a driver repeats while joints move are cut; rest and slow sensors are not."""

import numpy as np
import pytest

from skevgp.datasets import log_transitions
from skevgp.exceptions import RobotModelWarning

from .cases import PENDULUM, identified, pendulum


def held(starts, n_rows):
    table = pendulum()
    for first in starts:
        table[first + 1 : first + n_rows, 1:] = table[first, 1:]
    return table


@pytest.mark.parametrize(
    ("n_rows", "derive"),
    [
        (7, False),
        (40, False),
        (20, True),
        *(pytest.param(*one, marks=pytest.mark.long) for one in ((20, False), (40, True))),
    ],
)
def test_frames_that_are_held_are_cut(load, n_rows, derive):
    starts = np.arange(150, 1900, 233)
    with pytest.warns(RobotModelWarning, match=f"{len(starts) * (n_rows - 1)} rows repeat the frame before them"):
        log = load(held(starts, n_rows), velocity="derive" if derive else "recorded")
    cuts = [cut for cut in log.recordings[0].cuts if cut[2] == "held"]
    np.testing.assert_allclose([cut[0] for cut in cuts], 0.01 * starts, atol=1e-9)
    np.testing.assert_allclose([cut[1] for cut in cuts], 0.01 * (starts + n_rows), atol=1e-9)
    assert log.recordings[0].n_held == len(starts) * (n_rows - 1)
    assert f"{len(starts) * (n_rows - 1)} rows that repeat a frame" in log.DESCR
    assert identified(log) == pytest.approx(PENDULUM, abs=0.02)
    if not derive:
        assert len(log_transitions(log).data) == 1999 - len(starts) * n_rows


def test_frame_that_is_held_to_the_end_is_cut(load):
    with pytest.warns(RobotModelWarning, match="499 rows repeat"):
        log = load(held([1500], 500))
    assert log.time[-1] < 15.0
    assert log.recordings[0].cuts[-1] == pytest.approx((15.0, 19.99, "held"))


@pytest.mark.parametrize("times", [2, 4, 5])
def test_sensor_that_is_slower_than_the_log_is_no_fault(load, times):
    table = pendulum(0.002, 10.0)
    slow = table[::times].repeat(times, axis=0)[: len(table)]
    slow[:, 0] = table[:, 0]
    log = load(slow)
    assert log.recordings[0].n_held == 0
    assert identified(log) == pytest.approx(PENDULUM, abs=0.02)


def test_equal_frames_at_rest_are_no_fault(load):
    t = np.arange(0.0, 20.0, 0.01)
    # Moves of 2 s there and back, with rests of 2 s. All signals are exact.
    s = np.clip(t % 4.0 / 2.0, 0.0, 1.0)
    q, dq = 10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5, 15.0 * s**2 * (1.0 - s) ** 2
    back = t // 4.0 % 2.0 == 1.0
    q, dq = np.where(back, 1.0 - q, q), np.where(back, -dq, dq)
    for arguments in ({}, {"velocity": "derive"}):
        log = load(np.column_stack([t, q, dq, 5.0 * np.sin(q)]), rest_velocity=0.0, **arguments)
        assert {why for *_, why in log.recordings[0].cuts} == {"edge"}


def test_joint_that_sticks_and_slips_is_not_held(load):
    t = np.arange(0.0, 20.0, 0.01)
    pulled = 0.5 * t
    q = np.floor(pulled) + np.clip(10.0 * (pulled - np.floor(pulled)) - 9.0, 0.0, 1.0)
    for effort in (5.0 * (pulled - q), np.zeros(len(t))):
        log = load(np.column_stack([t, q, np.gradient(q, t), effort]), rest_velocity=0.0)
        assert {why for *_, why in log.recordings[0].cuts} == {"edge"}
