import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from skevgp.datasets import load_log

from .cases import BY_NUMBER, irregular_times, table_of, write_table

T = irregular_times(6.0)


@pytest.fixture
def files(tmp_path):
    """Two, the second one of 3 s."""
    names = ("first.csv", "second.csv")
    return [write_table(tmp_path / name, table_of(t)) for name, t in zip(names, (T, T[:375] + 100.0), strict=True)]


@pytest.mark.parametrize("gains", [3.0, [3.0, -2.0]], ids=str)
def test_torques_are_gains_times_currents(files, gains):
    plain, log = (load_log(files[0], columns=BY_NUMBER, gains=given) for given in (1.0, gains))
    assert_allclose(log.target, plain.target * gains, rtol=1e-12)
    assert_allclose(log.recordings[0].raw.torque, plain.recordings[0].raw.torque * gains, rtol=1e-12)
    assert_array_equal(log.data, plain.data)


@pytest.mark.parametrize(
    ("keep", "rows"),
    [
        (slice(100, 500), slice(100, 500)),
        (slice(None, -200), slice(None, -200)),
        ((1.0, None), T - T[0] >= 1.0),
        ((1.0, 4.5), (T - T[0] >= 1.0) & (T - T[0] <= 4.5)),
        ((None, 4.5), T - T[0] <= 4.5),
    ],
)
def test_only_what_is_kept_is_read(tmp_path, files, keep, rows):
    table = table_of(T)
    inside = np.zeros(len(T), dtype=bool)
    inside[rows] = True
    table[~inside, 1:] = np.nan
    log = load_log(write_table(tmp_path / "spoilt.csv", table), columns=BY_NUMBER, keep=keep)
    alone = load_log(write_table(tmp_path / "alone.csv", table[inside]), columns=BY_NUMBER)
    assert_allclose(log.data, alone.data, atol=1e-9)
    assert_allclose(log.time, alone.time + T[inside][0] - T[0], atol=1e-9)


def test_description_tells_what_was_done(files):
    table = table_of(np.delete(np.sort(np.r_[T, T[::50]]), slice(300, 320)))
    write_table(files[0], table)
    told = load_log(files[0], columns=BY_NUMBER, cutoff=4.0, dt=0.02).DESCR
    for part in (
        "joints q1, q2",
        "on a grid of 0.02 s",
        "Butterworth filter of fourth order at 4 Hz",
        "Central differences: acceleration.",
        "below 0.01 rad/s",
        f"of {len(np.unique(table[:, 0]))} recorded in",
        f"({len(table) - len(np.unique(table[:, 0]))} more repeated a time",
        "cut: 1.97 s of edge",
        "s of gap",
    ):
        assert part in told
    regular = write_table(files[0], table_of(np.arange(0.0, 6.0, 0.01)))
    told = load_log(regular, columns=BY_NUMBER, cutoff=None, dt=None).DESCR
    assert "on the recorded times, not filtered" in told


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"dt": 0.0}, "dt must be finite and above 0.0; got 0.0"),
        ({"cutoff": -1.0}, "cutoff must be finite and above 0.0; got -1.0"),
        ({"max_gap": np.inf}, "max_gap must be finite and above 0.0; got inf"),
        ({"rest_velocity": -0.1}, "rest_velocity must be finite and at least 0.0; got -0.1"),
        ({"rest_time": np.nan}, "rest_time must be finite and at least 0.0; got nan"),
        ({"time_unit": "min"}, r"time_unit must be one of \['s', 'ms', 'us', 'ns'\]; got 'min'"),
        ({"gains": [1.0, 2.0, 3.0]}, "first.csv: gains must be a finite number, or one for each of the 2 joints"),
        ({"gains": np.nan}, "first.csv: gains must be a finite number"),
        ({"gains": ["a", "b"]}, "first.csv: gains must be real numbers"),
        ({"joints": ["a"]}, r"first.csv: it has 2 joints; expected 1: \['a'\]"),
        ({"joints": ["a", "a"]}, r"joints must be a list of different names; got \['a', 'a'\]"),
        ({"joints": "ab"}, "joints must be a list of different names; got 'ab'"),
        ({"topic": "/a"}, "first.csv: topic='/a' is for rosbag2 recordings"),
        ({"frame_id": "a"}, "first.csv: frame_id='a' is for rosbag2 recordings"),
        ({"columns": None}, "first.csv: pass columns=.*where a table has its signals"),
        ({"keep": (3.0, 2.0)}, r"keep=\(3.0, 2.0\): the first second must be below the last"),
        ({"keep": (1.0,)}, r"keep must be slice\(first row, stop row\) or \(first second, last second\); got \(1.0,\)"),
        ({"keep": [1.0, 2.0]}, r"keep must be slice.* got \[1.0, 2.0\]"),
        ({"keep": (99.0, None)}, r"first.csv: keep=\(99.0, None\) selects none of the 750 rows, which last 5.99\d* s"),
        ({"keep": slice(9000, None)}, "first.csv: keep=slice.* selects none of the 750 rows"),
    ],
)
def test_invalid_values_raise(files, arguments, message):
    with pytest.raises(ValueError, match=message):
        load_log(files[0], **{"columns": BY_NUMBER, **arguments})


@pytest.mark.parametrize("keep", [(1.0, 2.0), [None], slice(0, 9)], ids=str)
def test_keep_of_wrong_length_raises(files, keep):
    with pytest.raises(ValueError, match="keep must be a list with one value for each of the 2 files; got"):
        load_log(files, columns=BY_NUMBER, keep=keep)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"dt": "fast"}, "dt must be a number; got 'fast'"), ({"keep": ("1", 2.0)}, "keep must be a number; got '1'")],
)
def test_invalid_types_raise(files, arguments, message):
    with pytest.raises(TypeError, match=message):
        load_log(files[0], columns=BY_NUMBER, **arguments)


def test_files_must_have_the_same_joints(files):
    write_table(files[1], table_of(T)[:, [0, 1, 4, 6]], ["t", "q_1", "dq_1", "i_1"])
    columns = {"time": "t", "position": "q_*", "velocity": "dq_*", "current": "i_*"}
    with pytest.raises(ValueError, match=r"second.csv: it has 1 joints; expected 2: \['q1', 'q2'\]"):
        load_log(files, columns=columns)


def test_no_file_raises():
    with pytest.raises(ValueError, match="path must be one file or several; got an empty"):
        load_log([])


def test_missing_file_raises(tmp_path):
    for name in ("no.csv", "no.csv.gz"):
        with pytest.raises(FileNotFoundError, match=name):
            load_log(tmp_path / name, columns=BY_NUMBER)


@pytest.mark.parametrize(
    ("name", "message"),
    [("log.pkl", r"its name must end in one of .csv, .*, .mcap\."), ("log.bag", "Convert it with: rosbags-convert")],
)
def test_other_kinds_of_files_raise(tmp_path, name, message):
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(ValueError, match=f"{name}: .*{message}"):
        load_log(tmp_path / name)


def test_signals_that_overflow_raise(tmp_path):
    table = table_of(irregular_times(3.0))
    table[100:110, 6] = 1e308  # shorter, it would be cut as corrupt
    path = write_table(tmp_path / "log.csv", table)
    with pytest.raises(ValueError, match=r"log\.csv: its \w+ overflows when it is filtered and differentiated"):
        load_log(path, columns=BY_NUMBER)
