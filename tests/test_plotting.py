import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot
from matplotlib.colors import to_rgb
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.exceptions import NotFittedError
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.linear_model import LinearRegression
from sklearn.metrics import make_scorer, r2_score
from sklearn.model_selection import learning_curve
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures, StandardScaler

from skevgp import EVGPRegressor
from skevgp.datasets import make_toy
from skevgp.metrics import prediction_error
from skevgp.plotting import CoefficientDisplay, LearningCurveDisplay, PosteriorDisplay, RolloutDisplay
from skevgp.plotting._style import PALETTE

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


class Witness(RegressorMixin, BaseEstimator):
    """It writes down the numbers of its training rows, which are its input; clones write on the same list."""

    def __init__(self, seen=None):
        self.seen = seen

    def __sklearn_clone__(self):
        return self

    def fit(self, X, y):
        self.seen.append(X[:, 0].tolist())
        return self

    def predict(self, X):
        return np.zeros((len(X), 2))


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


def test_the_line_is_the_predicted_mean():
    model = fitted()
    display = PosteriorDisplay.from_estimator(model, X, label="EVGP")
    line = lines(display)["EVGP"]
    assert_array_equal(line.get_xdata(), X[:, 0])
    assert_array_equal(line.get_ydata(), model.predict(X))


@pytest.mark.parametrize(("n_std", "label"), [(2.0, "±2 std"), (0.5, "±0.5 std")])
def test_the_band_is_so_many_standard_deviations(n_std, label):
    model = fitted()
    mean, std = model.predict(X, return_std=True)
    edges, drawn = band(PosteriorDisplay.from_estimator(model, X, n_std=n_std))
    assert_allclose(edges, [mean - n_std * std, mean + n_std * std])
    assert drawn == label


def test_observations_are_drawn_only_if_given():
    model = fitted()
    assert_array_equal(lines(PosteriorDisplay.from_estimator(model, X, y))["observed"].get_ydata(), y)
    assert "observed" not in lines(PosteriorDisplay.from_estimator(model, X))


def test_mean_and_observations_have_colours_of_their_own():
    drawn = lines(PosteriorDisplay.from_estimator(fitted(), X, y))
    assert len({to_rgb(line.get_color()) for line in drawn.values()}) == 3


def test_inducing_points_are_crosses_on_the_lower_edge():
    model = fitted()
    display = PosteriorDisplay.from_estimator(model, X)
    crosses = lines(display)["inducing points"]
    assert_array_equal(crosses.get_xdata(), model.inducing_points_[:, 0])
    assert crosses.get_marker() == "x"
    display.figure_.draw_without_rendering()
    on_screen = crosses.get_transform().transform(np.column_stack(crosses.get_data()))
    assert display.ax_.transAxes.inverted().transform(on_screen)[:, 1] == pytest.approx(0.03)


@pytest.mark.parametrize("output", [0, 1])
def test_each_output_shows_its_own_inducing_points(output):
    model = EVGPRegressor(n_inducing=5, sharing="kernel", random_state=0).fit(X, Y)
    crosses = lines(PosteriorDisplay.from_estimator(model, X, output=output))["inducing points"]
    assert_array_equal(crosses.get_xdata(), model.inducing_points_[output, :, 0])
    assert (model.inducing_points_[0] != model.inducing_points_[1]).any()


def test_inducing_points_of_another_space_are_not_drawn():
    display = PosteriorDisplay.from_estimator(fitted(kernel_map=StandardScaler()), X)
    assert "inducing points" not in lines(display)


@pytest.mark.parametrize("output", [0, 1])
def test_one_of_several_outputs_is_drawn(output):
    model = fitted(Y)
    mean, std = model.predict(X, return_std=True)
    display = PosteriorDisplay.from_estimator(model, X, Y, output=output)
    assert_array_equal(lines(display)["mean"].get_ydata(), mean[:, output])
    assert_array_equal(lines(display)["observed"].get_ydata(), Y[:, output])
    assert_allclose(band(display)[0][1], mean[:, output] + 2.0 * std[:, output])


def test_rows_of_several_columns_are_numbered():
    two_columns = np.hstack([X, X**2])
    display = PosteriorDisplay.from_estimator(fitted(inputs=two_columns), two_columns)
    assert_array_equal(lines(display)["mean"].get_xdata(), np.arange(30))
    assert "inducing points" not in lines(display)


def test_the_horizontal_axis_can_be_given():
    times = np.linspace(0.0, 3.0, 30)
    assert_array_equal(lines(PosteriorDisplay.from_estimator(fitted(), X, x=times))["mean"].get_xdata(), times)


@pytest.mark.parametrize(("targets", "output"), [(y, 0), (Y, 0), (Y, 1)])
def test_training_data_are_dots_at_places_of_their_own(targets, output):
    display = PosteriorDisplay.from_estimator(fitted(targets), X[:7], output=output, x_train=X[:, 0], y_train=targets)
    dots = lines(display)["training data"]
    assert_array_equal(dots.get_xdata(), X[:, 0])
    assert_array_equal(dots.get_ydata(), Y[:, output])
    assert (dots.get_marker(), dots.get_linestyle()) == (".", "None")
    assert_array_equal(lines(display)["mean"].get_xdata(), X[:7, 0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"x_train": X[:, 0]}, "x_train and y_train go together; y_train is None"),
        ({"y_train": y}, "x_train and y_train go together; x_train is None"),
        ({"x_train": X[:4, 0], "y_train": y}, "inconsistent numbers of samples"),
    ],
)
def test_training_data_that_do_not_fit_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        PosteriorDisplay.from_estimator(fitted(), X, **arguments)


def test_any_regressor_with_a_standard_deviation_works():
    model = GaussianProcessRegressor(alpha=1.0, optimizer=None).fit(X, y)
    display = PosteriorDisplay.from_estimator(model, X)
    assert_array_equal(lines(display)["mean"].get_ydata(), model.predict(X))
    assert set(lines(display)) == {"mean"}


def test_a_display_can_be_drawn_again():
    display = PosteriorDisplay(np.arange(3.0), np.zeros(3), np.ones(3))
    first = display.plot().ax_
    second = display.plot(n_std=3.0, label="again").ax_
    assert first is not second
    assert_array_equal(band(display)[0], [[-3.0] * 3, [3.0] * 3])
    assert set(lines(display)) == {"again"}


def test_the_posterior_needs_a_fitted_regressor():
    with pytest.raises(NotFittedError):
        PosteriorDisplay.from_estimator(EVGPRegressor(), X)


@pytest.mark.parametrize("output", [0, 1])
def test_weights_of_one_output_are_shown_beside_their_prior(trend, output):
    display = CoefficientDisplay.from_estimator(trend, output=output)
    assert_array_equal(display.mean, trend.coef_[output])
    assert_array_equal(display.std, trend.coef_std_[output])
    assert_array_equal(display.prior_mean, trend.coef_prior_mean_[output])
    assert_array_equal(display.prior_std, trend.coef_prior_scale_[output])


def test_weights_of_a_single_output_are_shown():
    model = fitted(y, PolynomialFeatures(1))
    assert_array_equal(CoefficientDisplay.from_estimator(model).mean, model.coef_)


def test_bars_are_so_many_standard_deviations():
    display = CoefficientDisplay(["a", "b"], *np.array([[1.0, 2.0], [0.1, 0.2], [3.0, 4.0], [0.3, 0.4]])).plot(n_std=3)
    prior, posterior = display.ax_.containers
    assert (prior.get_label(), posterior.get_label()) == ("prior ±3 std", "posterior ±3 std")
    for container, means, stds in ((prior, [3.0, 4.0], [0.3, 0.4]), (posterior, [1.0, 2.0], [0.1, 0.2])):
        points, _, (bars,) = container
        assert_array_equal(points.get_xdata(), means)
        ends = np.array([segment[:, 0] for segment in bars.get_segments()])
        assert_allclose(ends.T, [np.subtract(means, np.multiply(3, stds)), np.add(means, np.multiply(3, stds))])


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
def test_bars_that_are_shorter_than_their_symbol_stand_in_numbers(mean, std, text):
    display = CoefficientDisplay(["a"], *np.array([[mean], [std], [0.0], [1.0]])).plot()
    assert [shown.get_text() for shown in display.ax_.texts] == [text]


def test_the_style_has_the_palette_and_all_examples_have_the_style():
    with pyplot.style.context("skevgp.plotting.page"):
        assert tuple(pyplot.rcParams["axes.prop_cycle"].by_key()["color"]) == PALETTE
    for script in (Path(__file__).parents[1] / "examples").glob("plot_*.py"):
        assert 'style.use("skevgp.plotting.page")' in script.read_text(), script


def test_weights_are_listed_from_the_top(trend):
    display = CoefficientDisplay.from_estimator(trend)
    ticks = {label.get_text(): label.get_position()[1] for label in display.ax_.get_yticklabels()}
    assert ticks == {"1": 1, "x0": 0}
    points = display.ax_.containers[1][0]
    assert_allclose(points.get_ydata(), [1.0, 0.0], rtol=0, atol=0.2)
    assert_array_equal(points.get_xdata(), trend.coef_[0])


def test_weights_of_a_map_without_names_are_numbered():
    model = fitted(y, FunctionTransformer(lambda X: np.hstack([X, X**2])))
    assert CoefficientDisplay.from_estimator(model).names == ["h0", "h1"]


def test_without_features_there_are_no_weights_to_show():
    with pytest.raises(ValueError, match="no weights to show: it was fitted with feature_map=None"):
        CoefficientDisplay.from_estimator(fitted())


def test_weights_need_a_fitted_regressor():
    with pytest.raises(NotFittedError):
        CoefficientDisplay.from_estimator(EVGPRegressor())


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
    "draw",
    [
        lambda model: PosteriorDisplay.from_estimator(model, X),
        lambda model: CoefficientDisplay.from_estimator(model),
        lambda model: learning_curve_of(n_runs=1),
    ],
)
def test_without_axes_there_is_a_new_figure(trend, draw):
    display = draw(trend)
    assert display.figure_ is display.ax_.figure
    assert pyplot.get_fignums() == [display.figure_.number]


@pytest.mark.parametrize(
    "display",
    [
        PosteriorDisplay(np.arange(3.0), np.zeros(3), np.ones(3)),
        CoefficientDisplay(["a"], *np.ones((4, 1))),
        LearningCurveDisplay(np.arange(3.0), np.ones((3, 2))),
        RolloutDisplay(np.arange(3.0), np.zeros((3, 2)), np.ones((3, 2))),
    ],
    ids=lambda display: type(display).__name__,
)
def test_without_matplotlib_the_pip_command_is_given(monkeypatch, display):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match=r"Plotting needs the optional package 'matplotlib'.*pip install matplotlib"):
        display.plot()


@pytest.mark.parametrize("arguments", [{"y": np.zeros(3)}, {"x": np.zeros(3)}])
def test_another_number_of_observations_or_places_is_an_error(trend, arguments):
    with pytest.raises(ValueError, match="inconsistent numbers of samples"):
        PosteriorDisplay.from_estimator(trend, X[:5], **arguments)


@pytest.mark.parametrize("output", [2, -3])
def test_an_output_that_is_not_there_is_named(trend, output):
    with pytest.raises(ValueError, match=f"output={output} must be the index of one of"):
        PosteriorDisplay.from_estimator(trend, X[:5], output=output)
    with pytest.raises(ValueError, match=f"output={output} must be the index of one of"):
        CoefficientDisplay.from_estimator(trend, output=output)


def test_places_are_drawn_in_order():
    display = PosteriorDisplay(np.array([2.0, 0.0, 1.0]), np.array([20.0, 0.0, 10.0]), np.ones(3)).plot()
    np.testing.assert_array_equal(display.ax_.lines[0].get_xydata(), [[0, 0], [1, 10], [2, 20]])


def test_a_pipeline_of_maps_without_names_is_numbered():
    features = make_pipeline(FunctionTransformer())
    model = EVGPRegressor(features, n_inducing=3, max_iter=0).fit(np.arange(10.0)[:, np.newaxis], np.arange(10.0))
    assert CoefficientDisplay.from_estimator(model).names == ["h0"]


def test_the_curve_is_the_mean_of_runs_and_the_band_their_range():
    scores = np.array([[4.0, 8.0, 6.0], [1.0, np.nan, 3.0]])
    display = LearningCurveDisplay(np.array([10, 40]), scores).plot(label="EVGP", color="#D55E00")
    line = lines(display)["EVGP"]
    assert_array_equal(line.get_xydata(), [[10, 6], [40, 2]])
    assert to_rgb(line.get_color()) == to_rgb("#D55E00")
    (area,) = display.ax_.collections
    assert {tuple(corner) for corner in area.get_paths()[0].vertices} == {(10, 4), (10, 8), (40, 1), (40, 3)}
    assert_allclose(area.get_facecolor()[0, :3], to_rgb("#D55E00"))


def test_curves_on_the_same_axes_have_colours_of_their_own():
    display = LearningCurveDisplay(np.array([10, 40]), np.ones((2, 1)), "NLPD").plot(label="0")
    for number in range(1, 6):
        display.plot(display.ax_, label=str(number))
    assert len({to_rgb(line.get_color()) for line in lines(display).values()}) == 6
    assert (display.ax_.get_xlabel(), display.ax_.get_ylabel()) == ("training rows", "NLPD")


@pytest.mark.parametrize(
    ("lowest", "log_scale", "scale"),
    [(1.0, None, "log"), (1.0, False, "linear"), (1.0, True, "log"), (0.0, None, "linear"), (-1.0, False, "linear")],
)
def test_axes_are_logarithmic_where_scores_are_positive_or_as_told(lowest, log_scale, scale):
    axes = LearningCurveDisplay(np.array([10, 40]), np.array([[2.0], [lowest]])).plot(log_scale=log_scale).ax_
    assert (axes.get_xscale(), axes.get_yscale()) == (scale, scale)
    if scale == "log":
        assert [label.get_text() for label in axes.get_xticklabels()] == ["10", "40"]


def test_curves_on_the_same_axes_have_a_tick_for_every_number_of_rows():
    axes = LearningCurveDisplay(np.array([10, 40]), np.ones((2, 1))).plot().ax_
    LearningCurveDisplay(np.array([20, 40]), np.ones((2, 1))).plot(axes)
    assert [label.get_text() for label in axes.get_xticklabels()] == ["10", "20", "40"]


def test_scores_that_have_no_logarithm_are_named():
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


def test_whole_groups_are_added_in_an_order_of_each_run():
    seen = []
    numbers, groups = np.arange(30.0)[:, np.newaxis], np.repeat(["c", "a", "b", "d"], [3, 7, 15, 5])
    display = learning_curve_of(Witness(seen), numbers, sizes=[1, 2, 4], groups=groups, n_runs=3, random_state=0)
    seen = np.reshape(np.array(seen, dtype=object), (3, 3))
    for run in seen:
        found = [groups[np.array(rows, dtype=int)] for rows in run]
        assert [len(set(own)) for own in found] == [1, 2, 4]
        assert all(len(own) == np.isin(groups, own).sum() for own in found)
        assert set(run[0]) < set(run[1]) < set(run[2])
    assert len({tuple(run[0]) for run in seen}) > 1
    assert_array_equal(display.n_rows, [np.mean([len(rows) for rows in sizes]) for sizes in seen.T])


def test_the_same_random_state_gives_the_same_curve():
    first, second, third = (learning_curve_of(n_runs=2, random_state=state).scores for state in (0, 0, 1))
    assert_array_equal(first, second)
    assert (first[0] != third[0]).any()


def test_another_score_can_be_drawn():
    display = learning_curve_of(score=r2_score, sizes=[30], n_runs=1)
    assert display.scores == pytest.approx(np.array([[r2_score(Y[:9], LinearRegression().fit(X, Y).predict(X[:9]))]]))
    assert display.ax_.get_ylabel() == "r2 score"


def test_data_frames_stay_data_frames():
    frame = pd.DataFrame({"place": X[:, 0]})
    curve = LearningCurveDisplay.from_estimator(LinearRegression(), frame, Y, frame, Y, sizes=[30], n_runs=1)
    assert curve.scores == pytest.approx(np.array([[prediction_error(Y, LinearRegression().fit(X, Y).predict(X))]]))


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
def test_sizes_that_are_not_numbers_of_groups_are_named(sizes, problem, message):
    with pytest.raises(problem, match=message):
        learning_curve_of(sizes=sizes)


def test_a_curve_needs_a_run_and_rows_of_one_length():
    with pytest.raises(ValueError, match="n_runs must be at least 1; got 0"):
        learning_curve_of(n_runs=0)
    with pytest.raises(ValueError, match="inconsistent numbers of samples"):
        learning_curve_of(targets=Y[:5])
    with pytest.raises(ValueError, match="inconsistent numbers of samples"):
        learning_curve_of(groups=np.zeros(5))


def test_without_matplotlib_nothing_is_fitted(monkeypatch):
    witness = Witness([])
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match="Plotting needs the optional package 'matplotlib'"):
        learning_curve_of(witness)
    assert not witness.seen
