"""sktime's reduction forecasts a series with our regressor on its last values."""

import numpy as np
import pytest

from skevgp import EVGPRegressor

pytest.importorskip("sktime")
pd = pytest.importorskip("pandas")


# Of a default of its own.
@pytest.mark.filterwarnings("ignore:The default of config ``remember_data``:FutureWarning")
@pytest.mark.parametrize("strategy", ["recursive", "direct"])
def test_a_series_is_forecast(strategy):
    from sktime.forecasting.compose import make_reduction

    series = pd.Series(np.sin(0.3 * np.arange(150.0)) + 0.02 * np.random.RandomState(0).randn(150))
    forecaster = make_reduction(EVGPRegressor(n_inducing=15, random_state=0), strategy=strategy, window_length=12)
    forecast = forecaster.fit(series[:140], fh=np.arange(1, 11)).predict()
    assert list(forecast.index) == list(range(140, 150))
    np.testing.assert_allclose(np.ravel(forecast), series[140:], atol=0.15)
