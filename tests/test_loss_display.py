"""The bound over the iterations."""

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot
from numpy.testing import assert_array_equal
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.datasets import make_toy
from skevgp.plotting import LossDisplay

mpl.use("Agg")
X, y = make_toy(60, random_state=0, return_X_y=True)


@pytest.fixture(autouse=True)
def close_figures():
    yield
    pyplot.close("all")


@pytest.fixture(scope="module")
def sparse():
    return EVGPRegressor(n_inducing=8, noise_cv=None, random_state=0).fit(X, y)


def test_line_is_minus_the_loss(sparse):
    display = LossDisplay.from_estimator(sparse, label="m", color="black")
    assert_array_equal(display.line_.get_ydata(), -sparse.loss_curve_)
    assert_array_equal(display.line_.get_xdata(), np.arange(1, sparse.n_iter_ + 1))
    assert (display.line_.get_label(), display.line_.get_color()) == ("m", "black")
    assert display.ax_.get_ylabel() == "lower bound (nats)"


def test_pipeline_shows_its_last_step(sparse):
    pipe = make_pipeline(FunctionTransformer(), clone(sparse)).fit(X, y)
    assert_array_equal(LossDisplay.from_estimator(pipe).bound, -sparse.loss_curve_)


@pytest.mark.parametrize(("n_iter", "first"), [(19, True), (40, False)])
def test_axis_leaves_out_the_beginning_of_long_fits_only(n_iter, first):
    bound = -(0.5 ** np.arange(n_iter))
    low, high = LossDisplay(bound).plot().ax_.get_ylim()
    assert (low < bound[0]) == first
    assert high > bound[-1]


def test_model_without_iterations_raises():
    with pytest.raises(ValueError, match="EVGPRegressor has no iterations to show"):
        LossDisplay.from_estimator(EVGPRegressor(n_inducing=8, max_iter=0, random_state=0).fit(X, y))
    with pytest.raises(NotFittedError):
        LossDisplay.from_estimator(EVGPRegressor())


def test_points_that_cannot_be_evaluated_are_gaps():
    def wanders(objective, theta, bounds):
        objective(theta * np.nan)
        return theta, objective(theta)[0]

    model = EGPRegressor(optimizer=wanders).fit(X, y)
    assert not np.isfinite(model.loss_curve_).all()
    for gap in (False, True):
        display = LossDisplay.from_estimator(model, gap=gap)
        display.figure_.canvas.draw()
        assert np.isfinite(display.ax_.get_ylim()).all()
