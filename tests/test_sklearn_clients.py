"""What scikit-learn does with a regressor: frames as output, words in columns, wrapped targets, inspection."""

import numpy as np
import pandas as pd
import polars as pl
import pytest
import sklearn
from matplotlib import pyplot
from sklearn.base import BaseEstimator, TransformerMixin, clone
from sklearn.compose import TransformedTargetRegressor, make_column_transformer
from sklearn.inspection import PartialDependenceDisplay, partial_dependence, permutation_importance
from sklearn.model_selection import cross_val_score
from sklearn.multioutput import MultiOutputRegressor
from sklearn.pipeline import make_pipeline, make_union
from sklearn.preprocessing import FunctionTransformer, OneHotEncoder, PolynomialFeatures, StandardScaler

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
Y2 = np.column_stack([Y, NUMBERS[:, 0] * NUMBERS[:, 1]])
FRAMES = {"pandas": pd.DataFrame, "polars": pl.DataFrame}
MODEL = EVGPRegressor(n_inducing=20, solver=LBFGS(tol=0.1), random_state=0)
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


# --- words, in frames ---------------------------------------------------------------------------------------------


@each_frame
def test_words_are_encoded_by_both_maps(package):
    train, test = slice(0, 70), slice(70, N)
    model = EVGPRegressor(WORDS, kernel_map=SEEN, n_inducing=20, solver=LBFGS(tol=0.1), random_state=0)
    model.fit(frame(package, train), Y[train])
    mean, std = model.predict(frame(package, test), return_std=True)
    assert np.abs(mean - Y[test]).mean() < 0.2
    assert (np.abs(mean - Y[test]) < 4 * std).mean() > 0.9
    assert model.coef_names_.tolist()[:3] == [f"onehotencoder__kind_{kind}" for kind in KINDS]
    jumps = model.coef_[1:3] - model.coef_[0]
    np.testing.assert_allclose(jumps, [2.0, -1.0], atol=0.3)
    said = str(model.summary())
    assert "standardscaler__age" in said
    assert "onehotencoder__kind_yew" in said


def test_packages_of_frames_do_not_matter():
    means = [EVGPRegressor(WORDS, kernel_map=SEEN, n_inducing=20, max_iter=0, random_state=0) for _ in FRAMES]
    found = [model.fit(frame(p), Y).predict(frame(p)) for model, p in zip(means, FRAMES, strict=True)]
    np.testing.assert_array_equal(*found)


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


@each_frame
def test_new_words_are_an_error_of_the_encoder_or_nothing(package):
    rows = frame(package, slice(0, 5))
    new = FRAMES[package]({"age": NUMBERS[:5, 0], "kind": ["elm"] * 5, "height": NUMBERS[:5, 1]})
    strict = EVGPRegressor(WORDS, kernel_map=SEEN, n_inducing=5, max_iter=0).fit(frame(package), Y)
    assert np.isfinite(strict.predict(rows)).all()
    with pytest.raises(ValueError, match="unknown categories"):
        strict.predict(new)
    kind = OneHotEncoder(handle_unknown="ignore")
    lenient = make_column_transformer((StandardScaler(), ["age", "height"]), (kind, ["kind"]))
    model = EVGPRegressor(kernel_map=lenient, n_inducing=5, max_iter=0).fit(frame(package), Y)
    # No kind is as far from all of them as they are from each other, or farther.
    assert (model.predict(new, True)[1] > 0.0).all()


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


@each_frame
def test_the_global_option_for_frames(package):
    maps = {
        "feature_map": make_union(PolynomialFeatures(2), FunctionTransformer(np.sin, feature_names_out="one-to-one")),
        "kernel_map": StandardScaler(),
    }
    expected = clone(FIXED).set_params(**maps).fit(NUMBERS, Y).predict(NUMBERS, return_std=True)
    with sklearn.config_context(transform_output=package):
        for rows in (NUMBERS, FRAMES[package]({"a": NUMBERS[:, 0], "b": NUMBERS[:, 1]})):
            model = make_pipeline(clone(FIXED).set_params(**maps)).fit(rows, Y)
            for one, other in zip(model.predict(rows, return_std=True), expected, strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-9)


@each_frame
def test_what_a_step_before_returns_has_names(package):
    model = make_pipeline(StandardScaler().set_output(transform=package), FIXED)
    model.fit(FRAMES[package]({"a": NUMBERS[:, 0], "b": NUMBERS[:, 1]}), Y)
    assert model[-1].feature_names_in_.tolist() == ["a", "b"]
    assert "length_scale  a " in str(model[-1].summary())


# --- targets ------------------------------------------------------------------------------------------------------


@each_frame
def test_a_transformed_target(package):
    model = TransformedTargetRegressor(
        clone(FIXED).set_params(feature_map=WORDS, kernel_map=SEEN), func=np.sinh, inverse_func=np.arcsinh
    )
    found = model.fit(frame(package), Y).predict(frame(package))
    expected = clone(model.regressor).fit(frame(package), np.sinh(Y)).predict(frame(package))
    np.testing.assert_allclose(found, np.arcsinh(expected), rtol=1e-9)


@each_frame
def test_outputs_apart(package):
    model = MultiOutputRegressor(clone(FIXED).set_params(feature_map=WORDS, kernel_map=SEEN))
    found = model.fit(frame(package), Y2).predict(frame(package))
    for output, own in enumerate(model.estimators_):
        expected = clone(model.estimator).fit(frame(package), Y2[:, output])
        np.testing.assert_array_equal(own.predict(frame(package), True), expected.predict(frame(package), True))
        np.testing.assert_array_equal(found[:, output], own.predict(frame(package)))


@each_frame
def test_cross_validation_of_frames(package):
    model = clone(MODEL).set_params(feature_map=WORDS, kernel_map=SEEN)
    assert (cross_val_score(model, frame(package), Y, cv=3, error_score="raise") > 0.9).all()


# --- inspection ---------------------------------------------------------------------------------------------------


def test_importance_of_columns_with_words():
    """Of pandas: scikit-learn makes an array of other frames, without names, before it shuffles."""
    rows = frame("pandas")
    model = EVGPRegressor(WORDS, kernel_map=SEEN, n_inducing=20, solver=LBFGS(tol=0.1), random_state=0).fit(rows, Y)
    found = permutation_importance(model, rows, Y, n_repeats=3, random_state=0)
    assert (found.importances_mean > 0.1).all()
    assert found.importances_mean.shape == (3,)


@pytest.mark.parametrize("targets", [Y, Y2], ids=["one output", "two outputs"])
def test_partial_dependence_of_numbers(targets):
    model = clone(MODEL).fit(NUMBERS, targets)
    found = partial_dependence(model, NUMBERS, [1], kind="both", grid_resolution=7)
    grid = found["grid_values"][0]
    rows = np.repeat(NUMBERS[np.newaxis], 7, axis=0)
    rows[:, :, 1] = grid[:, np.newaxis]
    expected = model.predict(rows.reshape(-1, 2)).reshape(7, N, -1)
    np.testing.assert_allclose(found["individual"], np.moveaxis(expected, (2, 1, 0), (0, 1, 2)), rtol=1e-6, atol=1e-9)


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


def test_partial_dependence_display_of_outputs():
    model = clone(MODEL).fit(NUMBERS, Y2)
    displays = [
        PartialDependenceDisplay.from_estimator(model, NUMBERS, [0, 1], target=target, kind="both", grid_resolution=5)
        for target in (0, 1)
    ]
    first, second = (display.pd_results[0]["average"] for display in displays)
    assert first.shape == second.shape == (2, 5)
