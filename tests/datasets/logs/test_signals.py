"""What is done to signals, seen from outside: motions that are known exactly go in and come out."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from skevgp.datasets import load_log

from .cases import BY_NUMBER, irregular_times, motion, table_of, write_table


@pytest.fixture
def load(tmp_path):
    """Load a table, whole and never at rest unless it is said otherwise."""

    def load(table, **arguments):
        file = write_table(tmp_path / "log.csv", table)
        return load_log(file, **{"columns": BY_NUMBER, "rest_velocity": 0.0, **arguments})

    return load


def errors(log, t0):
    """Of positions, velocities, accelerations and currents, in units of their largest values."""
    found = [*np.hsplit(log.data, 3), log.target]
    expected = motion(log.time + t0)
    return [np.abs(f - e).max() / np.abs(e).max() for f, e in zip(found, expected, strict=True)]


@pytest.mark.parametrize("repeated", [False, True], ids=["once", "repeated rows"])
def test_motion_written_down_irregularly_is_recovered(load, repeated):
    t = irregular_times()
    table = table_of(np.sort(np.r_[t, t[::7]]) if repeated else t)
    log = load(table)
    assert log.recordings[0].n_repeated == (len(t[::7]) if repeated else 0)
    assert_allclose(np.diff(log.time), 0.01, rtol=1e-9)
    assert_array_equal(np.less(errors(log, t[0]), [2e-4, 2e-4, 2e-3, 2e-3]), True)


@pytest.mark.parametrize("dt", [0.004, 0.01, 0.03, 0.1])
def test_grid_has_the_step_that_is_asked_for(load, dt):
    t = irregular_times()
    log = load(table_of(t), dt=dt, cutoff=4.5)
    assert_allclose(np.diff(log.time), dt, rtol=1e-9)
    assert_array_equal(np.less(errors(log, t[0]), [2e-4, 2e-4, 3e-3, 3e-3]), True)


def waves(t, frequency):
    """A current of one joint, its other signals smooth."""
    table = table_of(t)
    table[:, 6] = np.sin(2.0 * np.pi * frequency * t)
    return table


@pytest.mark.parametrize(
    "frequency", [1.0, 5.0, 12.0, *(pytest.param(other, marks=pytest.mark.long) for other in (3.0, 8.0))]
)
def test_filter_delays_nothing_and_is_butterworths_squared(load, frequency):
    t = np.arange(0.0, 10.0, 0.002)
    log = load(waves(t, frequency), dt=0.01, cutoff=5.0)
    phase = 2.0 * np.pi * frequency * log.time[:, np.newaxis]
    weights = np.linalg.lstsq(np.hstack([np.sin(phase), np.cos(phase)]), log.target[:, 0], rcond=None)[0]
    # The bilinear transform, with which the digital filter is made, bends frequencies: on a grid of 2 ms by little.
    assert_allclose(weights, [1.0 / (1.0 + (frequency / 5.0) ** 8), 0.0], atol=0.005)


def test_regular_times_may_stay_and_be_filtered(load):
    t = np.arange(0.0, 20.0, 0.008)
    log = load(table_of(t), dt=None)
    assert_allclose(np.diff(log.time), 0.008, rtol=1e-6)
    assert_array_equal(np.less(errors(log, 0.0), [2e-4, 2e-4, 3e-3, 3e-3]), True)


def test_two_periods_of_the_cutoff_are_cut_at_each_end(load):
    t = np.arange(0.0, 10.0, 0.01)
    log = load(table_of(t), cutoff=2.5)
    assert_allclose(log.time[[0, -1]], [0.8, t[-1] - 0.8], atol=1e-9)
    assert_allclose(log.recordings[0].cuts[0][:2], (0.0, 0.795), atol=1e-9)
    assert [why for *_, why in log.recordings[0].cuts] == ["edge", "edge"]


def test_nothing_leaks_across_a_gap(load):
    t = irregular_times()
    first, second = table_of(t[:1000]), table_of(t[1100:])
    log = load(np.vstack([first, second]))
    other = second.copy()
    other[:, 1:] += 100.0
    other[:, 4:6] = second[:, 4:6] + 20.0
    other[:, 1:3] += 20.0 * second[:, :1]
    assert_array_equal(np.unique(log.pieces), [0, 1])
    assert not log.groups.any()
    (gap,) = [cut for cut in log.recordings[0].cuts if cut[2] == "gap"]
    assert_allclose(gap[:2], [t[999] - t[0], t[1100] - t[0]], atol=1e-9)
    changed = load(np.vstack([first, other]))
    assert_array_equal(changed.data[log.pieces == 0], log.data[log.pieces == 0])
    assert np.abs(changed.target[log.pieces == 1] - log.target[log.pieces == 1] - 100.0).max() < 1e-9
    assert_array_equal(load(first).data, log.data[log.pieces == 0])
    assert ((log.time < gap[0]) == (log.pieces == 0)).all()
    assert (log.time[log.pieces == 1] > gap[1]).all()


@pytest.mark.parametrize(("missing", "n_gaps"), [(3, 0), (6, 1)])
def test_gap_is_longer_than_five_steps(load, missing, n_gaps):
    t = np.arange(0.0, 10.0, 0.01)
    log = load(table_of(np.r_[t[:500], t[500 + missing :]]))
    assert len(np.unique(log.pieces)) == 1 + n_gaps


@pytest.mark.parametrize("n_rows", [1, 2, 20])
def test_pieces_too_short_for_the_filter_are_left_out(load, n_rows):
    t = irregular_times()
    t = t[np.r_[0:1000, 1100 : 1100 + n_rows, 1300 : len(t)]]
    log = load(table_of(t))
    assert [why for *_, why in log.recordings[0].cuts if why != "edge"] == ["gap", "too short", "gap"]
    assert len(np.unique(log.pieces)) == 2


def resting(t, *phases):
    """The motion as a clock goes that stands still in these phases: positions stay, velocities are 0."""
    stands = np.any([(first <= t) & (t < last) for first, last in phases], axis=0)
    own = np.cumsum(np.where(stands, 0.0, np.diff(t, append=t[-1])))
    table = table_of(own)
    table[stands, 4:6] = 0.0
    table[:, 0] = t
    return table


def test_rest_is_cut_at_the_ends_and_between(load):
    phases = [(0.0, 2.0), (8.0, 10.0), (14.0, 14.3), (18.0, 20.0)]
    log = load(resting(np.arange(0.0, 20.0, 0.01), *phases), rest_velocity=0.02)
    rests = [cut[:2] for cut in log.recordings[0].cuts if cut[2] == "rest"]
    assert_allclose(rests, [phases[0], phases[1], phases[3]], atol=0.35)  # the filter rings a little
    assert_array_equal(np.unique(log.pieces), [0, 1])
    assert not log.groups.any()
    slow = (np.abs(log.data[:, 2:4]) < 0.02).all(axis=1)
    for first, last in rests:
        assert not ((log.time > first) & (log.time < last)).any()
    assert 0 < slow.sum() < 50  # the rest of 0.3 s


def spoilt(row, column, value):
    table = table_of(irregular_times())
    table[row, column] = value
    return table


@pytest.mark.parametrize(
    ("table", "arguments", "message"),
    [
        (spoilt(30, 2, np.nan), {}, "row 30 lacks the position of joint 'q2'. Leave it out by keep"),
        (spoilt(40, 6, np.inf), {}, "the torque is not finite in row 40 of the rows kept"),
        (spoilt(7, 0, np.nan), {}, "row 7 lacks the time. Leave it out by keep"),
        (table_of(irregular_times()), {"dt": None}, r"not regular: steps differ .* median of 0.008\d* s by .* Pass dt"),
        (table_of(np.arange(0.0, 0.5, 0.01)), {}, "too short: no piece .* longer than the 0.8 s cut at its ends"),
        (table_of([0.0, 0.01]), {"cutoff": None}, "too short: .* longer than the 0.02 s cut at its ends"),
        (table_of(np.zeros(9)), {}, "its 9 rows do not have two different times"),
        (table_of(irregular_times()), {"rest_velocity": 99.0}, "all rows are at rest: .* than rest_velocity=99"),
        (table_of(np.r_[irregular_times(), irregular_times()]), {}, r"its clock goes back by 13.9\d* s at 0 s"),
        (table_of(np.arange(0.0, 9.0, 0.01)), {"cutoff": 50.0}, r"cutoff=50 Hz must be below 50 Hz.*row every 0.01 s"),
        (table_of(np.arange(0.0, 9.0, 0.01)), {"cutoff": 5.0, "dt": 0.1}, "cutoff=5 Hz must be below 5 Hz"),
        (table_of(np.arange(0.0, 9.0, 0.2)), {"dt": 0.05}, r"must be below 2.5 Hz.*a row every 0.2 s"),
        (table_of(np.arange(0.0, 9.0, 0.01)), {"dt": 1e-5}, r"dt=1e-05 s is far below the recording's step of 0.01 s"),
    ],
)
def test_unprocessable_log_raises(load, table, arguments, message):
    with pytest.raises(ValueError, match=f"log.csv: .*{message}"):
        load(table, **arguments)
