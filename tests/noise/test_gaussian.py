"""Gaussian noise: its start, and what the noise of inputs leaves of it."""

import numpy as np
import pytest

from skevgp import EVGPRegressor
from skevgp.datasets import make_toy
from skevgp.noise import Gaussian
from skevgp.noise.gaussian import own_variance


def test_variance_is_where_a_fit_starts():
    X, y = make_toy(60, random_state=0, return_X_y=True)
    model = EVGPRegressor(n_inducing=10, noise=Gaussian(variance=1e3), random_state=0)
    assert model.fit(X, y).noise_variance_ < 100.0
    assert model.set_params(max_iter=0, noise_cv=None).fit(X, y).noise_variance_ == pytest.approx(1e3)


def test_own_variance_is_what_the_noise_of_inputs_leaves():
    squares, counts, variance = np.array([1.0, 2.0, 3.0]), np.array([1.0, 1.0, 2.0]), np.array([0.01, 0.02, 0.005])
    assert own_variance(squares, 0.0 * squares, counts, variance) == pytest.approx(350.0, rel=1e-3)
    assert own_variance(4.0 * variance + 0.3, np.full(3, 0.3), counts, variance) == pytest.approx(4.0, rel=1e-3)
