"""skpro's adapter takes our mean and std for a predictive distribution."""

import numpy as np
import pytest

from skevgp import EGPRegressor, EVGPRegressor

pytest.importorskip("skpro")
pd = pytest.importorskip("pandas")


@pytest.mark.parametrize(
    "model", [EVGPRegressor(n_inducing=20, random_state=0), EGPRegressor()], ids=["sparse", "exact"]
)
def test_the_distribution_has_our_mean_and_std(data, model):
    from skpro.metrics import CRPS
    from skpro.regression.adapters.sklearn import SklearnProbaReg

    X, y = pd.DataFrame(data[0], columns=["a", "b"]), pd.DataFrame({"y": data[1]})
    adapted = SklearnProbaReg(model).fit(X[:200], y[:200])
    mean, std = adapted.estimator_.predict(X[200:], return_std=True)
    distribution = adapted.predict_proba(X[200:])
    np.testing.assert_allclose(distribution.mean()["y"], mean)
    np.testing.assert_allclose(np.sqrt(distribution.var()["y"]), std)
    interval = adapted.predict_interval(X[200:], coverage=0.9)
    inside = (interval.iloc[:, 0] <= y["y"][200:]) & (y["y"][200:] <= interval.iloc[:, 1])
    assert 0.8 <= inside.mean() <= 0.98
    # Of noise of 0.1 no forecast has less than 0.1 / √π.
    assert 0.05 < CRPS()(y[200:], distribution) < 0.08
