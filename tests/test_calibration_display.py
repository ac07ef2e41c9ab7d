"""The reliability curve of intervals."""

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import norm

from skevgp.metrics import calibration_error, containing_ratios
from skevgp.plotting import CalibrationDisplay

mpl.use("Agg")
RNG = np.random.default_rng(0)
Y, MEAN = RNG.normal(size=(2, 60, 2))
STD = RNG.uniform(0.5, 2.0, size=(60, 2))


@pytest.fixture(autouse=True)
def close_figures():
    yield
    pyplot.close("all")


def shares(display, y=Y, mean=MEAN, std=STD):
    """What the curve should be but where it begins and ends."""
    return containing_ratios(y, mean, std, k=norm.ppf(0.5 + display.nominal[1:-1] / 2))


def test_curve_is_the_share_of_values_inside():
    display = CalibrationDisplay.from_predictions(Y, MEAN, STD)
    assert display.observed.shape == (1, 101)
    assert_allclose(display.observed[0, 1:-1], shares(display), rtol=1e-12)
    assert_array_equal(display.observed[0, [0, -1]], [0.0, 1.0])
    (line,) = display.lines_
    assert_array_equal(line.get_xydata(), np.column_stack([np.linspace(0.0, 1.0, 101), display.observed[0]]))
    assert line.get_label() == f"error {calibration_error(Y, MEAN, STD):.3f}"


def test_curves_share_axes_with_one_diagonal():
    first = CalibrationDisplay.from_predictions(Y, MEAN, STD, label="right")
    second = CalibrationDisplay.from_predictions(Y, MEAN, 0.3 * STD, label="narrow", ax=first.ax_)
    assert second.ax_ is first.ax_
    labels = [line.get_label() for line in first.ax_.lines]
    assert [label.split(" (")[0] for label in labels] == ["as promised", "right", "narrow"]
    assert len(first.ax_.collections) == 1
    assert first.lines_[0].get_color() != second.lines_[0].get_color()
    assert (second.observed <= first.observed).all()


@pytest.mark.parametrize("first", [50, 400])
def test_on_shared_axes_the_band_is_of_the_fewest_values(first):
    ax = None
    for n in (first, 100, 200):
        ax = CalibrationDisplay.from_predictions(np.zeros(n), np.linspace(-1.0, 1.0, n), np.ones(n), ax=ax).ax_
    (band,), fewest = ax.collections, min(first, 100)
    corners = band.get_paths()[0].vertices
    half = np.abs(corners[corners[:, 0] == 0.5, 1] - 0.5)
    np.testing.assert_allclose(half.max(), 1.96 * 0.5 / np.sqrt(fewest))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"per_output": True, "output_names": ["a"]}, ValueError, r"output_names must name the 2 outputs; got \['a'\]"),
        ({"n_levels": 1}, ValueError, "n_levels must be at least 2"),
        ({"n_levels": 2.5}, TypeError, "n_levels"),
    ],
)
def test_invalid_options_raise(options, error, message):
    with pytest.raises(error, match=message):
        CalibrationDisplay.from_predictions(Y, MEAN, STD, **options)
