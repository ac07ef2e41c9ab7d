import sys

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot
from numpy.testing import assert_allclose, assert_array_equal

from skevgp.datasets import load_log
from skevgp.plotting import SignalsDisplay

mpl.use("Agg")
NAMES = ["shoulder", "elbow"]
ROWS = ["velocity", "acceleration", "torque"]


@pytest.fixture(autouse=True)
def close_figures():
    yield
    pyplot.close("all")


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Two files, the first with a gap, rest and a short piece; noise on the velocities."""
    t = np.delete(np.arange(0.0, 12.0, 0.01), np.r_[400:450, 470:500])
    phase = np.where(t < 8.0, t, 8.0)
    rng = np.random.RandomState(0)
    velocity = np.where(t < 8.0, np.cos(phase), 0.0)[:, np.newaxis] * [1.0, 2.0] + 1e-3 * rng.randn(len(t), 2)
    position, torque = np.sin(phase)[:, np.newaxis] * [1.0, 2.0], np.sin(phase)[:, np.newaxis] * [3.0, -4.0]
    table = np.column_stack([t, position, velocity, torque])
    files = [tmp_path_factory.mktemp("logs") / name for name in ("first.csv", "second.csv")]
    for file, rows in zip(files, (table, table[-400:] + 1.0), strict=True):
        np.savetxt(file, rows, delimiter=",")
    columns = {"time": 0, "position": [1, 2], "velocity": [3, 4], "effort": [5, 6]}
    return load_log(files, columns=columns, joints=NAMES)


def lines(ax):
    return {line.get_label().partition(",")[0]: line for line in ax.lines}


def recorded(ax):
    """What is drawn of it; lines are broken by NaN."""
    points = np.column_stack(lines(ax)["recorded"].get_data())
    return points[~np.isnan(points[:, 0])].T


def spans(ax):
    """First and last second of each coloured span, and its colour."""
    return [(patch.get_x(), patch.get_x() + patch.get_width(), tuple(patch.get_facecolor())) for patch in ax.patches]


def test_there_is_a_column_for_each_joint_with_units(log):
    display = SignalsDisplay.from_log(log)
    assert display.axes_.shape == (3, 2)
    assert [ax.get_title() for ax in display.axes_[0]] == NAMES
    assert [ax.get_ylabel() for ax in display.axes_[:, 0]] == [
        "velocity\n(rad/s)",
        "acceleration\n(rad/s²)",
        "torque\n(N m)",
    ]
    assert {ax.get_xlabel() for ax in display.axes_[-1]} == {"time (s)"}
    assert display.figure_.get_suptitle() == "first.csv"


def test_lines_are_what_was_recorded_and_what_became_of_it(log):
    display = SignalsDisplay.from_log(log)
    raw, processed = log.recordings[0].raw, log.recordings[0].processed
    kept = processed.why == ""
    for row, name in enumerate(ROWS):
        for joint in range(2):
            drawn = lines(display.axes_[row, joint])
            assert set(drawn) == {"recorded", "processed"}
            time, values = drawn["processed"].get_data()
            assert_array_equal(time, processed.time)
            assert_array_equal(values[kept], processed[name][kept, joint])
            assert np.isnan(values[~kept]).all()
            if name != "acceleration":
                time, values = recorded(display.axes_[row, joint])
                assert_array_equal(time, raw.time)
                assert_array_equal(values, raw[name][:, joint])


def test_noise_does_not_set_the_scale(log):
    display = SignalsDisplay.from_log(log)
    kept = log.groups == 0
    low, high = display.axes_[1, 0].get_ylim()
    values = log.data[kept, 4]
    assert_allclose([low, high], [values.min() - np.ptp(values) / 4.0, values.max() + np.ptp(values) / 4.0])


def test_removed_rows_are_coloured_by_reason(log):
    display = SignalsDisplay.from_log(log)
    cuts = log.recordings[0].cuts
    assert {why for *_, why in cuts} == {"gap", "edge", "rest", "too short"}
    for ax in display.axes_.flat:
        drawn = spans(ax)
        assert_allclose([span[:2] for span in drawn], [cut[:2] for cut in cuts])
        colours = {why: {span[2] for span, cut in zip(drawn, cuts, strict=True) if cut[2] == why} for *_, why in cuts}
        assert all(len(found) == 1 for found in colours.values())
        assert len(set.union(*colours.values())) == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"file": 2}, "file=2 must be the index of one of 2 files"),
        ({"joints": 2}, r"joints=2 must be some of \['shoulder', 'elbow'\]"),
        ({"joints": "wrist"}, "joints='wrist' must be some of"),
        ({"joints": []}, r"joints=\[\] must be some of"),
        ({"axes": np.empty(3, dtype=object)}, r"axes must be of shape \(3, 2\), a column for each joint; got \(3,\)"),
    ],
)
def test_invalid_values_raise(log, arguments, message):
    with pytest.raises(ValueError, match=message):
        SignalsDisplay.from_log(log, **arguments)


def test_missing_matplotlib_raises(log, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match="pip install matplotlib"):
        SignalsDisplay.from_log(log)
