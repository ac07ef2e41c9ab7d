"""coef_names_: what the feature map calls its features."""

import numpy as np
import pytest
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForceGravity

RNG = np.random.RandomState(0)
X = RNG.uniform(-1.0, 1.0, (30, 2))
Y = np.column_stack([X[:, 0], X.sum(axis=1)]) + 0.1 * RNG.randn(30, 2)

each_estimator = pytest.mark.parametrize(
    "estimator", [EVGPRegressor(max_iter=0, n_inducing=5), EGPRegressor(max_iter=0)], ids=["EVGP", "EGP"]
)


@each_estimator
def test_coef_names_are_feature_names(estimator):
    m = estimator.set_params(feature_map=PolynomialFeatures(1)).fit(X, Y)
    assert m.coef_names_.tolist() == ["1", "x0", "x1"]
    assert m.coef_.shape == (2, len(m.coef_names_))


@each_estimator
def test_without_features_there_are_none(estimator):
    m = estimator.set_params(feature_map=None).fit(X, Y)
    with pytest.raises(AttributeError, match="coef_names_ only after a fit with a feature_map"):
        m.coef_names_  # noqa: B018


def test_coef_names_of_robot():
    state, after = make_dynamics("pendulum", 3, 10, random_state=0, return_X_y=True)
    m = EVGPRegressor(InertiaForceGravity("pendulum"), max_iter=0, n_inducing=5).fit(state, after)
    assert m.coef_names_.tolist() == m.feature_map_.get_feature_names_out().tolist()
    assert len(set(m.coef_names_)) == m.coef_.shape[1]
