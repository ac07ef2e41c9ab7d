"""Recorded velocities that contradict positions."""

import numpy as np
import pytest

from skevgp.datasets import load_log
from skevgp.datasets.logs.agreement import check_agreement

T = np.arange(0.0, 20.0, 0.01)
Q = np.column_stack([np.sin(T) + 0.3 * np.sin(2.7 * T), np.cos(1.4 * T) - 0.2 * np.sin(3.1 * T)])
DQ = np.column_stack([np.cos(T) + 0.81 * np.cos(2.7 * T), -1.4 * np.sin(1.4 * T) - 0.62 * np.cos(3.1 * T)])
COLUMNS = {"time": 0, "position": [1, 2], "velocity": [3, 4], "effort": [5, 6]}


@pytest.fixture
def load(tmp_path):
    def load(q, dq, **arguments):
        file = tmp_path / "log.csv"
        np.savetxt(file, np.column_stack([T, q, dq, q]), delimiter=",")
        return load_log(file, columns=COLUMNS, **arguments)

    return load


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
def test_a_contradiction_names_joint_and_cause(load, dq, cause):
    with pytest.raises(ValueError, match=f"log.csv: the recorded velocity contradicts the position.*{cause}"):
        load(Q, dq)
    derived = load(Q, dq, velocity="derive")
    assert derived.recordings[0].raw.velocity is None
    assert np.abs(derived.data[:, 2:4] - load(Q, DQ).data[:, 2:4]).max() < 1e-2


@pytest.mark.parametrize("noise", [0.1, 1.0, 3.0])
def test_a_noisy_velocity_is_no_contradiction(load, noise):
    rng = np.random.default_rng(0)
    load(Q, DQ + noise * rng.standard_normal(DQ.shape))


def test_joints_that_hardly_move_are_not_judged(load):
    rng = np.random.default_rng(0)
    q = Q * [1.0, 0.0] + 1e-3 * rng.standard_normal(Q.shape)
    load(q, DQ * [1.0, 0.0])


def test_nan_velocities_are_ignored_when_derived(load):
    with pytest.raises(ValueError, match='velocity is not finite in any row.*velocity="derive"'):
        load(Q, np.nan * DQ)
    assert np.isfinite(load(Q, np.nan * DQ, velocity="derive").data).all()


def test_invalid_velocity_raises(load):
    with pytest.raises(ValueError, match='velocity must be "recorded" or "derive"; got \'none\''):
        load(Q, DQ, velocity="none")


def test_a_joint_that_creeps_may_have_a_velocity_that_is_rounded_to_0(load):
    q = np.column_stack([40.0 * np.sin(T), 10.0 + 0.3 * np.minimum(T, 5.0)])
    dq = np.round(np.column_stack([40.0 * np.cos(T), np.where(T < 5.0, 0.3, 0.0)]))
    assert load(q, dq).data.shape[1] == 6


def test_differences_of_a_coarse_encoder_agree_though_most_rows_are_0(load):
    fine = np.arange(0.0, 20.0, 0.001)
    count = 2.0 * np.pi / 2048.0
    q = np.round(np.column_stack([np.sin(0.3 * fine), np.cos(0.2 * fine)]) / count) * count
    dq = np.diff(q, axis=0, append=q[-1:]) / 0.001
    assert np.mean(dq[::10] == 0.0) > 0.5
    load(q[::10], dq[::10])
    with pytest.raises(ValueError, match="contradicts the position"):
        load(q[::10], -dq[::10])


def test_stamps_may_come_in_bursts(tmp_path):
    """Ten rows within two milliseconds, then none for 98: what a host stamps that reads a buffer."""
    stamps = np.floor(T / 0.1) * 0.1 + np.arange(len(T)) % 10 * 2e-4
    file = tmp_path / "log.csv"
    for factor in (1.0, 3.0):
        np.savetxt(file, np.column_stack([stamps, np.sin(T), factor * np.cos(T), T]), delimiter=",", fmt="%.9g")
        columns = {"time": 0, "position": 1, "velocity": 2, "effort": 3}
        if factor == 1.0:
            load_log(file, columns=columns, max_gap=0.5)
        else:
            with pytest.raises(ValueError, match="contradicts the position"):
                load_log(file, columns=columns, max_gap=0.5)


@pytest.mark.parametrize("seconds", [0.04, 0.1, 0.2, -0.1])
def test_the_delay_of_periodic_motion_is_the_shortest(load, seconds):
    q = np.column_stack([np.sin(4.0 * np.pi * T), np.cos(4.0 * np.pi * T)])
    dq = 4.0 * np.pi * np.column_stack([np.cos(4.0 * np.pi * (T - seconds)), -np.sin(4.0 * np.pi * (T - seconds))])
    with pytest.raises(ValueError, match=f"{abs(seconds):.2g} s {'late' if seconds > 0.0 else 'early'}"):
        load(q, dq)


def test_a_speed_without_sign_is_found_where_the_joint_mostly_moves_one_way(load):
    q = np.column_stack([0.8 * T + np.sin(T) + 0.5 * np.sin(2.3 * T), np.sin(T)])
    dq = np.column_stack([np.abs(0.8 + np.cos(T) + 1.15 * np.cos(2.3 * T)), np.cos(T)])
    with pytest.raises(ValueError, match="Joint 'q1': it is a speed without sign"):
        load(q, dq)


@pytest.mark.parametrize("rate", [10, 20])
@pytest.mark.parametrize("seed", range(20))
def test_noise_in_logs_of_few_rows_is_no_delay(seed, rate):
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, rng.uniform(3.0, 12.0), 1.0 / rate)
    speed, phase = rng.uniform(0.3, 4.0), rng.uniform(0.0, 6.0)
    dq = speed * np.cos(speed * t + phase) + speed * rng.standard_normal(len(t))
    check_agreement(t, np.sin(speed * t + phase)[:, None], dq[:, None], [slice(0, len(t))], ["q1"])


@pytest.mark.parametrize("counts", [2048, 3600, 4096])
@pytest.mark.parametrize("rows", [10, 20], ids=["100 Hz", "50 Hz"])
@pytest.mark.parametrize("speed", [0.1, 0.3, 1.0])
def test_differences_of_any_coarse_encoder_agree(counts, rows, speed):
    fine = np.arange(0.0, 30.0, 0.001)
    count = 2.0 * np.pi / counts
    q = np.round(np.sin(speed * fine) / count) * count
    dq = np.diff(q, prepend=q[0]) / 0.001
    some = slice(None, None, rows)
    check_agreement(
        fine[some], q[some, np.newaxis], dq[some, np.newaxis], [slice(0, len(fine) // rows)], ["q1"], slowest=0.01
    )


@pytest.mark.parametrize("frequency", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("burst", [5, 10, 20])
def test_stamps_in_bursts_are_no_delay(burst, frequency):
    phase = 2.0 * np.pi * frequency * T
    stamps = np.arange(len(T)) // burst * burst * 0.01 + np.arange(len(T)) % burst * 2e-4
    dq = 2.0 * np.pi * frequency * np.cos(phase)
    check_agreement(stamps, np.sin(phase)[:, None], dq[:, None], [slice(0, len(T))], ["q1"])


def test_a_velocity_that_is_0_below_a_threshold_agrees_where_the_joint_creeps(load):
    """Drivers have a threshold in units of the motor, so that it may be any number."""
    q = np.column_stack([40.0 * np.sin(T), 10.0 + 0.3 * T])
    dq = np.column_stack([40.0 * np.cos(T), np.full(len(T), 0.3)])
    load(q, np.where(np.abs(dq) < 0.5, 0.0, dq))


def test_an_accelerometer_that_measures_gravity_too_is_no_contradiction(tmp_path):
    file = tmp_path / "log.csv"
    np.savetxt(file, np.column_stack([T, np.sin(T), np.cos(T), 0.5 - np.sin(T), T]), delimiter=",")
    log = load_log(file, columns={"time": 0, "position": 1, "velocity": 2, "acceleration": 3, "effort": 4})
    assert np.abs(log.data[:, 2] - 0.5 + log.data[:, 0]).max() < 0.01


def test_a_noisy_velocity_of_few_rows_is_not_late(tmp_path):
    t = np.arange(0.0, 10.0, 0.1)
    q, dq = np.sin(1.3 * t) + 0.4 * np.sin(3.1 * t), 1.3 * np.cos(1.3 * t) + 1.24 * np.cos(3.1 * t)
    file, columns = tmp_path / "log.csv", {"time": 0, "position": 1, "velocity": 2, "effort": 3}
    for seed in range(30):
        noisy = dq + dq.std() * np.random.RandomState(seed).randn(len(t))
        np.savetxt(file, np.column_stack([t, q, noisy, q]), delimiter=",")
        load_log(file, columns=columns, dt=0.1, cutoff=2.0)
