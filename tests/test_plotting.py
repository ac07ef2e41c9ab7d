import sys

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.colors import to_rgb
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.exceptions import NotFittedError
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures, StandardScaler

from skevgp import EVGPRegressor
from skevgp.datasets import make_toy
from skevgp.plotting import CoefficientDisplay, PosteriorDisplay

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
