"""Scorers that see the predicted standard deviation, in scikit-learn's own hands."""

from functools import partial

import numpy as np
import pytest
import sklearn
from scipy.stats import norm
from sklearn.base import BaseEstimator, clone
from sklearn.compose import TransformedTargetRegressor
from sklearn.decomposition import PCA
from sklearn.ensemble import BaggingRegressor
from sklearn.experimental import enable_halving_search_cv  # noqa: F401
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, WhiteKernel
from sklearn.linear_model import BayesianRidge, LinearRegression
from sklearn.model_selection import (
    GridSearchCV,
    GroupKFold,
    HalvingGridSearchCV,
    cross_val_score,
    cross_validate,
)
from sklearn.multioutput import MultiOutputRegressor, RegressorChain
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MinMaxScaler, PolynomialFeatures, StandardScaler

from skevgp import EGPRegressor, EVGPRegressor, ResidualRegressor, metrics
from skevgp.datasets import make_toy
from skevgp.metrics import (
    crps,
    make_std_scorer,
    neg_crps,
    neg_nlpd,
    negative_log_predictive_density,
)
from skevgp.utils.scorers import StdScorer

X, y = (part[np.random.RandomState(0).permutation(60)] for part in make_toy(60, random_state=0, return_X_y=True))
Y = np.column_stack([y, 3.0 - 2.0 * X[:, 0]])
GROUPS = np.repeat(np.arange(12), 5)
SPARSE = EVGPRegressor(n_inducing=5, max_iter=0, random_state=0)
SCORERS = [one for one in vars(metrics).values() if isinstance(one, StdScorer)]


def nlpd_of(model, inputs=X, targets=y):
    return -negative_log_predictive_density(targets, *model.predict(inputs, return_std=True))


@pytest.mark.parametrize(
    "model",
    [
        SPARSE,
        EGPRegressor(max_iter=0),
        ResidualRegressor(SPARSE),
        GaussianProcessRegressor(RBF() + WhiteKernel(), optimizer=None),
        BayesianRidge(),
        make_pipeline(StandardScaler(), SPARSE),
    ],
    ids=str,
)
def test_score_is_minus_the_metric_of_mean_and_std(model):
    fitted = clone(model).fit(X, y)
    assert neg_nlpd(fitted, X, y) == pytest.approx(nlpd_of(fitted))
    assert neg_crps(fitted, X, y) == pytest.approx(-crps(y, *fitted.predict(X, return_std=True)))


@pytest.mark.parametrize("search", [GridSearchCV, partial(HalvingGridSearchCV, random_state=1)], ids=["all", "halving"])
def test_searches_choose_the_noise_that_is_there(search):
    """Of fixed ones; a score of means alone could not tell the largest from the true one."""
    kernels = [RBF(2.0) + WhiteKernel(noise, "fixed") for noise in (1e-4, 3.0, 3000.0)]
    grid = search(EGPRegressor(max_iter=0), {"kernel": kernels}, scoring=neg_nlpd, cv=3, error_score="raise")
    found = grid.fit(X, y)
    assert found.best_params_["kernel"] == kernels[1]
    assert neg_nlpd(found, X, y) == neg_nlpd(found.best_estimator_, X, y)


@pytest.mark.parametrize("scorer", SCORERS, ids=repr)
def test_higher_scores_are_of_better_predictions(scorer):
    """Of the true mean and standard deviation, against predictions that are ten standard deviations off."""

    class Known(BaseEstimator):
        def __init__(self, error):
            self.error = error

        def predict(self, X, return_std=False):
            return X[:, 0] + self.error, np.full(len(X), 1.0)

    inputs = np.random.RandomState(0).randn(500, 2)
    targets = inputs.sum(axis=1)
    assert scorer(Known(0.0), inputs, targets) > scorer(Known(10.0), inputs, targets)


def test_scorer_says_how_it_was_made():
    assert repr(neg_crps) == "make_std_scorer(crps, greater_is_better=False)"
    scorer = make_std_scorer(norm.logpdf, where=1)
    assert repr(scorer) == "make_std_scorer(logpdf, where=1)"
    with pytest.raises(TypeError, match="score_func must be callable; got 'crps'"):
        make_std_scorer("crps")


# --- what scikit-learn puts around a regressor -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("transformer", "targets"), [(StandardScaler(), y), (MinMaxScaler((-1.0, 3.0)), Y), (None, Y[:, :1])]
)
def test_scaled_target_scales_std(transformer, targets):
    model = TransformedTargetRegressor(SPARSE, transformer=transformer).fit(X, targets)
    inner = model.transformer_.transform(targets.reshape(60, -1)).reshape(targets.shape)
    step = np.diff(targets.reshape(60, -1)[:2], axis=0) / np.diff(inner.reshape(60, -1)[:2], axis=0)
    inside = neg_nlpd(model.regressor_, X, inner)
    assert neg_nlpd(model, X, targets) == pytest.approx(inside - np.log(np.abs(step)).sum())


@pytest.mark.parametrize(
    "options",
    [
        {"func": np.arcsinh, "inverse_func": np.sinh},
        {"transformer": PCA()},
        {"transformer": MinMaxScaler(clip=True)},
    ],
    ids=str,
)
def test_nonlinear_target_transformer_raises(options):
    model = TransformedTargetRegressor(SPARSE, **options).fit(X, Y)
    with pytest.raises(TypeError, match=r"(?s)A TransformedTargetRegressor with .* has no standard deviation of y"):
        neg_nlpd(model, X, Y)


def test_independent_models_of_outputs_are_put_side_by_side():
    model = MultiOutputRegressor(SPARSE).fit(X, Y)
    expected = sum(nlpd_of(own, X, column) for own, column in zip(model.estimators_, Y.T, strict=True))
    assert neg_nlpd(model, X, Y) == pytest.approx(expected)
    nested = make_pipeline(PolynomialFeatures(2), TransformedTargetRegressor(model, transformer=StandardScaler()))
    assert np.isfinite(cross_val_score(nested, X, Y, scoring=neg_crps, cv=2, error_score="raise")).all()


class Deaf(BayesianRidge):
    """Takes any argument, and does nothing with it."""

    def predict(self, X, **_):
        return super().predict(X)


def test_predict_without_std_raises():
    with pytest.raises(TypeError, match="returns no pair of mean and std"):
        neg_crps(Deaf().fit(X, y), X[:2], y[:2])


def test_regressor_without_return_std_raises():
    model = BaggingRegressor(BayesianRidge(), n_estimators=2).fit(X, y)
    with pytest.raises(TypeError, match="BaggingRegressor.predict takes no return_std"):
        neg_crps(model, X, y)


@pytest.mark.parametrize("model", [LinearRegression(), RegressorChain(SPARSE)], ids=str)
def test_scorer_without_std_raises(model):
    with pytest.raises(TypeError, match=rf"{type(model).__name__}.predict takes no return_std"):
        neg_nlpd(model.fit(X, Y), X, Y)


# --- groups ------------------------------------------------------------------------------------------------------


@pytest.fixture
def routing():
    with sklearn.config_context(enable_metadata_routing=True):
        yield


class Witness(EVGPRegressor):
    """Writes down the groups that its fits were told of."""

    def fit(self, X, y, sample_weight=None, *, groups=None, relative_variance=None):
        self.told_ = groups
        return super().fit(X, y, sample_weight, groups=groups, relative_variance=relative_variance)


WITNESS = Witness(n_inducing=5, max_iter=0, random_state=0)


@pytest.mark.usefixtures("routing")
@pytest.mark.parametrize(
    ("wrapped", "inner"),
    [
        (lambda own: own, lambda model: model),
        (lambda own: make_pipeline(StandardScaler(), own), lambda model: model[-1]),
        (
            lambda own: TransformedTargetRegressor(own, transformer=StandardScaler()),
            lambda model: model.regressor_,
        ),
        (MultiOutputRegressor, lambda model: model.estimators_[0]),
        (ResidualRegressor, lambda model: model.regressor_),
    ],
    ids=["itself", "pipeline", "scaled y", "outputs apart", "residual"],
)
def test_groups_are_routed_to_the_fit_and_to_the_split(wrapped, inner):
    own = clone(WITNESS).set_fit_request(groups=True)
    model = wrapped(own)
    targets = Y if isinstance(model, MultiOutputRegressor) else y
    found = cross_validate(
        model,
        *(X, targets),
        params={"groups": GROUPS},
        cv=GroupKFold(3),
        scoring={"nlpd": make_std_scorer(negative_log_predictive_density)}
        if wrapped is not ResidualRegressor
        else None,
        return_estimator=True,
        error_score="raise",
    )
    for (train, _), fitted in zip(GroupKFold(3).split(X, y, GROUPS), found["estimator"], strict=True):
        np.testing.assert_array_equal(inner(fitted).told_, GROUPS[train])
