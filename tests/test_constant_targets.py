"""Targets that do not vary, or hardly against their mean: the std keeps above the rounding of y, far away it is 1."""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.metrics import negative_log_predictive_density

RNG = np.random.default_rng(0)
X = RNG.uniform(size=(100, 2))
WAVE = np.sin(5.0 * X[:, 0]) + 0.1 * RNG.standard_normal(100)
GROUPS = np.repeat(np.arange(10), 10)
both = pytest.mark.parametrize(
    "model", [EGPRegressor(normalize_y=True), EVGPRegressor(normalize_y=True, random_state=0)]
)


@both
@pytest.mark.parametrize("constant", [0.0, 1.0, -7.0, 1e-12, 1e12, 1e20])
def test_std_of_a_constant_is_above_its_rounding_and_1_far_away(model, constant):
    y = np.full(5, constant)
    mean, std = model.fit(X[:5], y).predict(np.vstack([X[:5], [[1e9, 1e9]]]), return_std=True)
    assert_allclose(mean, constant)
    assert (std > np.spacing(abs(constant))).all()
    # 1 but for constants whose rounding is more.
    assert_allclose(std[5], max(1.0, 1e-14 * abs(constant)), rtol=0.1)
    assert std[:5].max() < max(1e-3 * std[5], 2.0 * np.spacing(abs(constant)))


@both
def test_std_is_above_the_rounding_of_y_where_y_is_tiny_against_its_mean(model):
    y = 1e6 + 1e-7 * WAVE
    mean, std = model.fit(X, y).predict(X, return_std=True)
    assert (std > np.spacing(1e6)).all()
    assert np.std(mean - y) < 1e-7


@cache
def predicted_alone(normalize_y):
    model = EVGPRegressor(normalize_y=normalize_y, n_inducing=15, sharing="all", random_state=0)
    return model.fit(X, WAVE, groups=GROUPS).predict(X, return_std=True)


@pytest.mark.parametrize("sharing", ["auto", "kernel"])
@pytest.mark.parametrize("normalize_y", [True, False])
def test_constant_output_does_not_affect_others(sharing, normalize_y):
    """Warnings are errors here; the other output is as well predicted as alone."""
    Y = np.column_stack([WAVE, np.full(100, 0.3)])
    model = EVGPRegressor(normalize_y=normalize_y, n_inducing=15, sharing=sharing, random_state=0)
    mean, std = model.fit(X, Y, groups=GROUPS).predict(X, return_std=True)
    assert (std[:, 1] > np.spacing(0.3)).all()
    assert_allclose(mean[:, 1], 0.3, atol=1e-4)
    assert negative_log_predictive_density(Y[:, 1] + 1e-15, mean[:, 1], std[:, 1]) < -5.0
    alone = predicted_alone(normalize_y)
    assert_allclose(mean[:, 0], alone[0], atol=0.1)
    assert_allclose(std[:, 0], alone[1], rtol=0.2)
