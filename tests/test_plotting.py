import sys

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.colors import to_rgb
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.linear_model import LinearRegression
from sklearn.metrics import make_scorer
from sklearn.model_selection import learning_curve
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EVGPRegressor
from skevgp.datasets import make_toy
from skevgp.metrics import prediction_error
from skevgp.plotting import (
    CoefficientDisplay,
    FeatureReportDisplay,
    LearningCurveDisplay,
    PosteriorDisplay,
    RolloutDisplay,
)

mpl.use("Agg")
X, y = make_toy(30, random_state=0, return_X_y=True)
Y = np.column_stack([y, 2.0 - y])


def fitted(targets=y, feature_map=None, inputs=X, **parameters):
    return EVGPRegressor(feature_map, n_inducing=5, max_iter=0, random_state=0, **parameters).fit(inputs, targets)


@pytest.fixture(autouse=True)
def close_figures():
    yield
    pyplot.close("all")


@pytest.fixture
def trend():
    return fitted(Y, PolynomialFeatures(1))


def learning_curve_of(estimator=None, inputs=X, targets=Y, sizes=(10, 20, 30), **options):
    """Tested on the first rows."""
    return LearningCurveDisplay.from_estimator(
        LinearRegression() if estimator is None else estimator, inputs, targets, X[:9], Y[:9], sizes=sizes, **options
    )


def lines(display):
    return {line.get_label(): line for line in display.ax_.lines}


def band(display):
    """Lower and upper edge of the filled area at each x, and its label."""
    (area,) = display.ax_.collections
    corners = area.get_paths()[0].vertices
    edges = [(corners[corners[:, 0] == x, 1].min(), corners[corners[:, 0] == x, 1].max()) for x in display.x]
    return np.array(edges).T, area.get_label()


def test_inducing_points_are_crosses_on_the_lower_edge():
    model = fitted()
    display = PosteriorDisplay.from_estimator(model, X)
    crosses = lines(display)["inducing points"]
    assert_array_equal(crosses.get_xdata(), model.inducing_points_[:, 0])
    assert crosses.get_marker() == "x"
    display.figure_.draw_without_rendering()
    on_screen = crosses.get_transform().transform(np.column_stack(crosses.get_data()))
    assert display.ax_.transAxes.inverted().transform(on_screen)[:, 1] == pytest.approx(0.03)


def test_bars_are_so_many_standard_deviations():
    display = CoefficientDisplay(["a", "b"], *np.array([[1.0, 2.0], [0.1, 0.2], [3.0, 4.0], [0.3, 0.4]])).plot(n_std=3)
    assert display.ax_.get_xlabel() == "weight"
    prior, posterior = display.ax_.containers
    assert (prior.get_label(), posterior.get_label()) == ("prior ±3 std", "posterior ±3 std")
    for container, means, stds in ((prior, [3.0, 4.0], [0.3, 0.4]), (posterior, [1.0, 2.0], [0.1, 0.2])):
        points, _, (bars,) = container
        assert_array_equal(points.get_xdata(), means)
        ends = np.array([segment[:, 0] for segment in bars.get_segments()])
        assert_allclose(ends.T, [np.subtract(means, np.multiply(3, stds)), np.add(means, np.multiply(3, stds))])


def test_line_is_the_predicted_mean():
    model = fitted()
    display = PosteriorDisplay.from_estimator(model, X, label="EVGP")
    line = lines(display)["EVGP"]
    assert_array_equal(line.get_xdata(), X[:, 0])
    assert_array_equal(line.get_ydata(), model.predict(X))


@pytest.mark.parametrize(("n_std", "label"), [(2.0, "±2 std"), (0.5, "±0.5 std")])
def test_band_is_so_many_standard_deviations(n_std, label):
    model = fitted()
    mean, std = model.predict(X, return_std=True)
    edges, drawn = band(PosteriorDisplay.from_estimator(model, X, n_std=n_std))
    assert_allclose(edges, [mean - n_std * std, mean + n_std * std])
    assert drawn == label


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"x_train": X[:, 0]}, "x_train and y_train go together; y_train is None"),
        ({"y_train": y}, "x_train and y_train go together; x_train is None"),
        ({"x_train": X[:4, 0], "y_train": y}, "inconsistent numbers of samples"),
    ],
)
def test_training_data_that_do_not_fit_raise(arguments, message):
    with pytest.raises(ValueError, match=message):
        PosteriorDisplay.from_estimator(fitted(), X, **arguments)


@pytest.mark.parametrize(
    ("mean", "std", "text"),
    [
        (1.0004, 0.0002, "1.0004 ± 0.0004"),
        (-0.4316, 0.0011, "-0.432 ± 0.002"),
        (-1e-5, 0.005, "0.00 ± 0.01"),
        (12.34, 2.0, "12 ± 4"),
        (0.5, 1e-9, "0.500000 ± 2e-09"),
        (2.0, 0.0, "2.000 ± 0"),
    ],
)
def test_short_bars_are_annotated(mean, std, text):
    display = CoefficientDisplay(["a"], *np.array([[mean], [std], [0.0], [1.0]])).plot()
    assert [shown.get_text() for shown in display.ax_.texts] == [text]


def test_without_features_there_are_no_weights_to_show():
    with pytest.raises(ValueError, match="no weights to show: it was fitted with feature_map=None"):
        CoefficientDisplay.from_estimator(fitted())


@pytest.mark.parametrize(
    "draw",
    [
        lambda model, **where: PosteriorDisplay.from_estimator(model, X, **where),
        lambda model, **where: CoefficientDisplay.from_estimator(model, **where),
        lambda model, **where: learning_curve_of(n_runs=1, **where),
    ],
)
def test_given_axes_are_used(trend, draw):
    figure, (_, right) = pyplot.subplots(ncols=2)
    display = draw(trend, ax=right)
    assert display.ax_ is right
    assert display.figure_ is figure
    assert pyplot.get_fignums() == [figure.number]


@pytest.mark.parametrize(
    "display",
    [
        PosteriorDisplay(np.arange(3.0), np.zeros(3), np.ones(3)),
        CoefficientDisplay(["a"], *np.ones((4, 1))),
        LearningCurveDisplay(np.arange(3.0), np.ones((3, 2))),
        RolloutDisplay(np.arange(3.0), np.zeros((3, 2)), np.ones((3, 2))),
        FeatureReportDisplay(["a"], np.zeros(1), np.ones(1), ["unclear"]),
    ],
    ids=lambda display: type(display).__name__,
)
def test_without_matplotlib_the_pip_command_is_given(monkeypatch, display):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match=r"Plotting needs the optional package 'matplotlib'.*pip install matplotlib"):
        display.plot()


@pytest.mark.parametrize("output", [2, -3])
def test_missing_output_raises(trend, output):
    with pytest.raises(ValueError, match=f"output={output} must be the index of one of"):
        PosteriorDisplay.from_estimator(trend, X[:5], output=output)
    with pytest.raises(ValueError, match=f"output={output} must be the index of one of"):
        CoefficientDisplay.from_estimator(trend, output=output)


def test_the_curve_is_the_mean_of_runs_and_the_band_their_range():
    scores = np.array([[4.0, 8.0, 6.0], [1.0, np.nan, 3.0]])
    display = LearningCurveDisplay(np.array([10, 40]), scores).plot(label="EVGP", color="#D55E00")
    line = lines(display)["EVGP"]
    assert_array_equal(line.get_xydata(), [[10, 6], [40, 2]])
    assert to_rgb(line.get_color()) == to_rgb("#D55E00")
    (area,) = display.ax_.collections
    assert {tuple(corner) for corner in area.get_paths()[0].vertices} == {(10, 4), (10, 8), (40, 1), (40, 3)}
    assert_allclose(area.get_facecolor()[0, :3], to_rgb("#D55E00"))


def test_curve_is_the_mean_of_runs_and_the_band_their_range():
    scores = np.array([[4.0, 8.0, 6.0], [1.0, np.nan, 3.0]])
    display = LearningCurveDisplay(np.array([10, 40]), scores).plot(label="EVGP", color="#D55E00")
    line = lines(display)["EVGP"]
    assert_array_equal(line.get_xydata(), [[10, 6], [40, 2]])
    assert to_rgb(line.get_color()) == to_rgb("#D55E00")
    (area,) = display.ax_.collections
    assert {tuple(corner) for corner in area.get_paths()[0].vertices} == {(10, 4), (10, 8), (40, 1), (40, 3)}
    assert_allclose(area.get_facecolor()[0, :3], to_rgb("#D55E00"))


@pytest.mark.parametrize(
    ("lowest", "log_scale", "scale"),
    [(1.0, None, "log"), (1.0, False, "linear"), (1.0, True, "log"), (0.0, None, "linear"), (-1.0, False, "linear")],
)
def test_axes_are_logarithmic_where_scores_are_positive_or_as_told(lowest, log_scale, scale):
    axes = LearningCurveDisplay(np.array([10, 40]), np.array([[2.0], [lowest]])).plot(log_scale=log_scale).ax_
    assert (axes.get_xscale(), axes.get_yscale()) == (scale, scale)
    if scale == "log":
        assert [label.get_text() for label in axes.get_xticklabels()] == ["10", "40"]


def test_scores_that_have_no_logarithm_raise():
    with pytest.raises(ValueError, match=r"log_scale=True needs positive scores; the smallest is -1\.0"):
        LearningCurveDisplay(np.array([10, 40]), np.array([[2.0], [-1.0]])).plot(log_scale=True)


def test_scores_are_those_of_scikit_learn_on_the_same_rows():
    orders = [np.argsort(rng.permutation(30)) for rng in [np.random.RandomState(3)] for _ in range(2)]
    sizes, _, expected = learning_curve(
        LinearRegression(),
        *(np.vstack(both) for both in ((X, X[:9]), (Y, Y[:9]))),
        train_sizes=[5, 20, 30],
        cv=[(order, np.arange(30, 39)) for order in orders],
        scoring=make_scorer(prediction_error),
    )
    display = learning_curve_of(sizes=[5, 20, 30], n_runs=2, random_state=3)
    assert_array_equal(display.n_rows, sizes)
    assert_allclose(display.scores, expected)
    assert_allclose(display.ax_.lines[0].get_ydata(), expected.mean(axis=1))
    assert display.ax_.get_ylabel() == "prediction error"


@pytest.mark.parametrize(
    ("sizes", "problem", "message"),
    [
        ([], ValueError, r"sizes=\[\] must ascend"),
        ([5, 5], ValueError, r"sizes=\[5, 5\] must ascend"),
        ([5, 31], ValueError, r"sizes=\[5, 31\] must ascend, from at least 1 to at most the 30 groups"),
        ([0, 5], ValueError, r"sizes\[0\] must be at least 1; got 0"),
        ([5, 0.5], TypeError, r"sizes\[0\] must be an integer; got 5\.0"),
    ],
)
def test_sizes_that_are_not_numbers_of_groups_raise(sizes, problem, message):
    with pytest.raises(problem, match=message):
        learning_curve_of(sizes=sizes)


def test_curve_needs_a_run_and_rows_of_one_length():
    with pytest.raises(ValueError, match="n_runs must be at least 1; got 0"):
        learning_curve_of(n_runs=0)
    with pytest.raises(ValueError, match="inconsistent numbers of samples"):
        learning_curve_of(targets=Y[:5])
    with pytest.raises(ValueError, match="inconsistent numbers of samples"):
        learning_curve_of(groups=np.zeros(5))
