"""Regressors whose feature map has parameters, among scikit-learn's tools and ours."""

import pickle

import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import clone
from sklearn.compose import ColumnTransformer
from sklearn.model_selection import GridSearchCV
from sklearn.preprocessing import StandardScaler

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor, ResidualRegressor
from skevgp.features import Normal, ParametricFeatures
from skevgp.fitting import theta
from skevgp.io import load, save

from ..theta import FIXED, PRIORS, WAVE, data, wave

X, Y = data()
GIVEN = {"random_state": 0, "kernel": FIXED, "max_iter": 0}
OPTIONS = {"n_inducing": 12, **GIVEN}
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


@pytest.fixture(autouse=True)
def few_starts(monkeypatch):
    """Other starts than the prior median would take most of a small fit."""
    monkeypatch.setattr(theta, "_TRIED", 1)
    monkeypatch.setattr(theta, "_IMPROVED", 0)


def assert_same_model(one, other):
    assert one.theta_ == other.theta_
    assert_array_equal(one.theta_cov_, other.theta_cov_)
    for found, expected in zip(one.predict(X, return_std=True), other.predict(X, return_std=True), strict=True):
        assert_array_equal(found, expected)


@pytest.mark.parametrize(("kind", "options"), [(EVGPRegressor, OPTIONS), (EGPRegressor, GIVEN)])
def test_files_and_pickles_hold_parameters(kind, options, tmp_path):
    model = kind(WAVE, discrepancy="orthogonal", **options).fit(X, Y)
    assert_same_model(pickle.loads(pickle.dumps(model)), model)
    path, name = tmp_path / "model.skevgp", "tests.theta.wave"
    with pytest.raises(ValueError, match=rf"cannot be saved.*{name}.*trusted="):
        save(model, path)
    save(model, path, trusted=[name])
    loaded = load(path, trusted=[name])
    assert_same_model(loaded, model)
    if kind is EVGPRegressor:
        for own in (model, loaded):
            own.partial_fit(X[:5], Y[:5] + 0.1)
        assert_same_model(loaded, model)
    assert_same_model(clone(loaded).fit(X, Y), clone(model).fit(X, Y))


def test_search_over_priors_finds_the_right_one():
    model = EVGPRegressor(WAVE, **OPTIONS)
    priors = [{**PRIORS, "period": Normal(2.6, 0.1)}, PRIORS]
    search = GridSearchCV(model, {"feature_map__parameters": priors}, cv=2).fit(X, Y[:, 0])
    assert search.best_params_["feature_map__parameters"] is priors[1]
    assert search.best_estimator_.theta_["period"] == pytest.approx(1.8, abs=0.05)


def test_columns_of_frame_are_those_of_array():
    expected = EVGPRegressor(ColumnTransformer([("wave", WAVE, [0]), ("other", StandardScaler(), [1])]), **OPTIONS).fit(
        X, Y
    )
    frame = pd.DataFrame(X, columns=["t", "u"])
    model = EVGPRegressor(
        ColumnTransformer([("wave", WAVE, ["t"]), ("other", StandardScaler(), ["u"])]), **OPTIONS
    ).fit(frame, Y)
    assert model.theta_ == pytest.approx(expected.theta_, rel=1e-8)
    assert_allclose(model.predict(frame), expected.predict(X), rtol=1e-7)
    assert list(model.coef_names_) == ["wave__wave", "other__u"]
    assert_allclose(model.jacobian(frame), expected.jacobian(X), rtol=1e-6, atol=1e-8)


def test_residual_of_a_base_column_has_parameters():
    expected = EVGPRegressor(WAVE, **OPTIONS).fit(X, Y[:, 0])
    model = ResidualRegressor(EVGPRegressor(WAVE, **OPTIONS), base=[1]).fit(X, Y[:, 0] + X[:, 1])
    assert model.regressor_.theta_ == pytest.approx(expected.theta_, rel=1e-8)
    assert_allclose(model.predict(X), expected.predict(X) + X[:, 1], rtol=1e-7, atol=1e-9)


def test_summary_has_priors_posteriors_and_units():
    model = EVGPRegressor(ParametricFeatures(wave, PRIORS, units={"period": "s"}), **OPTIONS).fit(X, Y)
    frame = model.summary().to_frame().query("part == 'parameter'").set_index("name")
    assert list(frame.index) == ["period [s]", "phase"]
    assert_allclose(frame["value"], list(model.theta_.values()))
    assert_allclose(frame["std"], list(model.theta_std_.values()))
    assert ((frame["low"] < frame["value"]) & (frame["value"] < frame["high"])).all()
    # 95 % of Uniform(1, 3) and Normal(0, 0.5).
    assert_allclose(frame.loc["period [s]", ["prior_low", "prior_high"]].astype(float), [1.05, 2.95], rtol=1e-6)
    assert_allclose(frame.loc["phase", ["prior_low", "prior_high"]].astype(float), [-0.98, 0.98], atol=1e-4)
    width = frame["high"] - frame["low"]
    assert_allclose(width, 2.0 * 1.96 * frame["std"], rtol=0.02)
    assert "period [s]" in str(model.summary())
    assert "period [s]" in model.summary()._repr_html_()


def test_fixed_weights_stay():
    """A simulator with weight 1, in both discrepancies."""
    for discrepancy in ("free", "orthogonal"):
        model = EVGPRegressor(WAVE, coef_prior=CoefPrior(2.0, 0.0), discrepancy=discrepancy, **OPTIONS).fit(X, Y[:, 0])
        assert_array_equal(model.coef_, [2.0])
        assert_array_equal(model.coef_std_, [0.0])
        assert model.theta_["period"] == pytest.approx(1.8, abs=0.03)
