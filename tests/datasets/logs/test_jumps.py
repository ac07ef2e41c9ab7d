"""Positions that jump: wraps are unwrapped, other jumps cut the record, motion stays."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from skevgp.datasets import load_log, log_transitions

from .cases import text_of

T = np.arange(0.0, 20.0, 0.01)
Q = 2.5 * T + np.sin(1.3 * T)
DQ = 2.5 + 1.3 * np.cos(1.3 * T)
COLUMNS = {"time": 0, "position": 1, "velocity": 2, "effort": 3}


@pytest.fixture
def load(tmp_path):
    def load(q, dq=None, t=T, **arguments):
        file = tmp_path / "log.csv"
        file.write_text(text_of(np.column_stack([t, q, q if dq is None else dq, np.cos(t)])))
        ignored = {"velocity": "derive"} if dq is None else {}
        return load_log(file, **{"columns": COLUMNS, "rest_velocity": 0.0, **ignored, **arguments})

    return load


def assert_same_but_for_turns(found, expected, period):
    assert_allclose(found[:, 1:], expected[:, 1:], atol=1e-9 * period)
    turns = (found[:, 0] - expected[:, 0]) / period
    assert_allclose(turns, np.full(len(turns), np.round(turns[0])), atol=1e-9)


RANGES = [
    (1.0, -np.pi, np.pi),
    (1.0, 0.0, 2.0 * np.pi),
    (1.0, -4.0 * np.pi, 4.0 * np.pi),
    (180.0 / np.pi, -180.0, 180.0),
    (180.0 / np.pi, 0.0, 360.0),
]


@pytest.mark.parametrize(
    ("unit", "low", "high", "recorded"),
    [
        *((*one, True) for one in RANGES),
        (*RANGES[0], False),
        (*RANGES[4], False),
        *(pytest.param(*one, False, marks=pytest.mark.long) for one in RANGES[1:4]),
    ],
)
def test_wrapped_angle_gives_the_data_of_the_unwrapped_one(load, unit, low, high, recorded):
    dq = unit * DQ if recorded else None
    shown = (unit * Q - low) % (high - low) + low
    plain, log = load(unit * Q, dq), load(shown, dq)
    assert_same_but_for_turns(log.data, plain.data, high - low)
    assert log.recordings[0].wrapped == {"q1": np.count_nonzero(np.abs(np.diff(shown)) > 0.5 * (high - low))}
    assert "unwrapped: q1" in log.DESCR
    assert "unwrapped" not in plain.DESCR
    if recorded:
        found, expected = log_transitions(log), log_transitions(plain)
        assert_allclose(found.target - found.data[:, :2], expected.target - expected.data[:, :2], atol=1e-9 * unit)


def test_velocity_of_a_joint_that_mostly_rests_is_not_taken_for_differences(load):
    velocity = np.where(T > 12.0, 3.0 * np.sin(np.pi * (T - 12.0) / 8.0), 0.01 * np.cos(T))
    q = np.r_[0.0, np.cumsum(0.005 * (velocity[1:] + velocity[:-1]))]
    log = load((q + np.pi) % (2.0 * np.pi) - np.pi, velocity)
    assert log.recordings[0].wrapped["q1"] > 0


def test_jump_that_is_no_turn_cuts_the_record(load):
    log = load(np.sin(T) + 1.3 * (T > 9.995), np.cos(T))
    (cut,) = [cut for cut in log.recordings[0].cuts if cut[2] == "jump"]
    assert_allclose(cut[:2], [9.99, 10.0], atol=1e-9)
    assert len(np.unique(log.pieces)) == 2
    assert "positions jump 1 times" in log.DESCR
    transitions = log_transitions(log)
    assert len(transitions.data) == len(T) - 2
    assert np.abs(transitions.target[:, 0] - transitions.data[:, 0]).max() < 0.02


LINK = """<link name="{}"><inertial><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


@pytest.mark.parametrize(("joint", "turns"), [("continuous", True), ("revolute", False)])
def test_joint_of_a_urdf_is_unwrapped_if_it_has_no_limits(load, tmp_path, joint, turns):
    limits = '<limit lower="-3.2" upper="3.2" effort="1" velocity="9"/>'
    links = f'<joint name="q1" type="{joint}"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>{limits}</joint>'
    (tmp_path / "arm.urdf").write_text(f'<robot name="r">{LINK.format("a")}{LINK.format("b")}{links}</robot>')
    log = load((Q + np.pi) % (2.0 * np.pi) - np.pi, DQ, robot=tmp_path / "arm.urdf")
    assert (log.recordings[0].wrapped["q1"] > 0) == turns


def test_joint_with_limits_is_not_unwrapped(load):
    shown = (Q + np.pi) % (2.0 * np.pi) - np.pi
    log = load(shown, DQ, robot="cartpole", joints=["theta"])
    assert log.recordings[0].wrapped["theta"] > 0
    (recording,) = load(shown, DQ, robot="cartpole", joints=["x"]).recordings
    assert recording.wrapped == {"x": 0}
    assert "jump" in {why for *_, why in recording.cuts}


@pytest.mark.parametrize(("wrap", "error"), [("yes", ValueError), (0.0, ValueError), (None, TypeError)])
def test_invalid_wrap_raises(load, wrap, error):
    with pytest.raises(error, match="wrap must be"):
        load(Q, DQ, wrap=wrap)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.002, 0.01, 0.05]), st.sampled_from([0.01, 1.0, 57.3, 1000.0]))
def test_smooth_motion_with_noise_and_resolution_is_no_jump(seed, step, unit):
    from skevgp.datasets.logs.jumps import find_jumps

    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.6, 1.4, 1500)) * step
    waves = rng.uniform(0.05, 0.08 / step, 4)
    q = np.sum(rng.standard_normal(4) * np.sin(2 * np.pi * waves * t[:, None] + rng.uniform(0, 6, 4)) / waves, axis=1)
    q += rng.choice([0.0, 1e-4, 1e-2]) * rng.standard_normal(len(t))
    q *= rng.random() > 0.2
    resolution = rng.choice([1e-9, 1e-4, 1e-2])
    position = unit * resolution * np.round(q / resolution)[:, None]
    found = find_jumps(t, position, float(np.median(np.diff(t))), np.inf, ["auto"], ["any"])
    assert found.cuts == []
    assert found.wraps == [0]
