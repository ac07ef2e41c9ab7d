"""What scikit-learn does with a regressor: frames as output, words in columns, wrapped targets, inspection."""

import numpy as np
import pandas as pd
import polars as pl
import pytest
from matplotlib import pyplot
from sklearn.base import BaseEstimator, TransformerMixin, clone
from sklearn.compose import make_column_transformer
from sklearn.inspection import PartialDependenceDisplay
from sklearn.preprocessing import OneHotEncoder, PolynomialFeatures, StandardScaler

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.solvers import LBFGS

pyplot.switch_backend("Agg")
RNG = np.random.RandomState(0)
N = 90
KINDS = np.array(["oak", "pine", "yew"])
NUMBERS = RNG.uniform(-2.0, 2.0, (N, 2))
KIND = KINDS[RNG.randint(3, size=N)]
JUMP = {"oak": 0.0, "pine": 2.0, "yew": -1.0}
Y = np.sin(2.0 * NUMBERS[:, 0]) + NUMBERS[:, 1] + np.vectorize(JUMP.get)(KIND) + 0.05 * RNG.randn(N)
FRAMES = {"pandas": pd.DataFrame, "polars": pl.DataFrame}
FIXED = EVGPRegressor(n_inducing=20, max_iter=0, random_state=0)
# One weight for each kind, and a kernel that sees the numbers and the kind.
WORDS = make_column_transformer((OneHotEncoder(), ["kind"]), (PolynomialFeatures(1), ["height"]))
SEEN = make_column_transformer((StandardScaler(), ["age", "height"]), (OneHotEncoder(), ["kind"]))
each_frame = pytest.mark.parametrize("package", FRAMES)


def frame(package, rows=slice(None)):
    return FRAMES[package]({"age": NUMBERS[rows, 0], "kind": KIND[rows], "height": NUMBERS[rows, 1]})


@pytest.fixture(autouse=True)
def close_figures():
    yield
    pyplot.close("all")


class Witness(TransformerMixin, BaseEstimator):
    """Remembers what it was given."""

    seen = ()

    def fit(self, X, y=None):
        Witness.seen += (type(X),)
        return self

    def transform(self, X):
        Witness.seen += (type(X),)
        return np.asarray(X["age"], dtype=float).reshape(-1, 1)


@each_frame
@pytest.mark.parametrize("model", [FIXED, EGPRegressor(max_iter=0)], ids=lambda model: type(model).__name__)
def test_frames_stay_frames_for_the_maps(package, model, monkeypatch):
    monkeypatch.setattr(Witness, "seen", ())
    m = clone(model).set_params(feature_map=Witness(), kernel_map=Witness()).fit(frame(package), Y)
    m.predict(frame(package), return_std=True)
    assert set(Witness.seen) == {FRAMES[package]}


# --- frames as output ---------------------------------------------------------------------------------------------


@each_frame
@pytest.mark.parametrize("sparse", [False, True])
def test_maps_that_return_frames(package, sparse):
    """Their output may not be sparse, which frames are not."""
    encoder = OneHotEncoder(sparse_output=sparse)
    maps = [
        make_column_transformer((encoder, ["kind"]), (StandardScaler(), ["age"])),
        make_column_transformer((StandardScaler(), ["age", "height"])),
    ]
    plain = clone(FIXED).set_params(feature_map=maps[0], kernel_map=maps[1]).fit(frame(package), Y)
    if not sparse:
        framed = [clone(own).set_output(transform=package) for own in maps]
        model = clone(FIXED).set_params(feature_map=framed[0], kernel_map=framed[1]).fit(frame(package), Y)
        assert isinstance(model.kernel_map_.transform(frame(package)), FRAMES[package])
        for one, other in zip(model.predict(frame(package), True), plain.predict(frame(package), True), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9)
    assert plain.coef_.shape == (4,)


# --- inspection ---------------------------------------------------------------------------------------------------


def test_partial_dependence_display_of_numbers_and_words():
    rows = frame("pandas")
    model = EVGPRegressor(WORDS, kernel_map=SEEN, n_inducing=20, solver=LBFGS(tol=0.1), random_state=0).fit(rows, Y)
    display = PartialDependenceDisplay.from_estimator(
        model,
        rows,
        ["age", "kind", ("age", "height")],
        categorical_features=["kind"],
        grid_resolution=6,
    )
    assert display.axes_.size == 3
    bars = [patch.get_height() for patch in display.axes_[0, 1].patches]
    np.testing.assert_allclose(np.subtract(bars[1:], bars[0]), [2.0, -1.0], atol=0.3)
