"""The pendulum with the paper's data sizes, and the tools of scikit-learn around it."""

import numpy as np
import pytest

from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForceGravity
from skevgp.metrics import containing_ratios, prediction_error


@pytest.fixture(scope="module", params=[0, 3])
def data(request):
    seed = request.param
    return make_dynamics("pendulum", random_state=seed), make_dynamics("pendulum", random_state=1000 + seed)


def error(model, data):
    train, test = data
    return prediction_error(test.target, model.fit(train.data, train.target).predict(test.data))


def explained_by_the_gp(model):
    """The noise is far below what the features alone leave over: the GP has not collapsed."""
    return (model.noise_variance_ < 0.1 * model._fitted.units.target_unit**2).all()


@pytest.mark.long
def test_inertia_force_gravity(data):
    model = EVGPRegressor(InertiaForceGravity("pendulum"), n_inducing=10, random_state=0)
    assert error(model, data) <= 0.002
    assert explained_by_the_gp(model)


@pytest.mark.long
def test_uncertainty_is_honest_with_noise():
    train = make_dynamics("pendulum", noise=0.01, random_state=0)
    test = make_dynamics("pendulum", random_state=1000)
    noise = 0.01 * train.target.std(axis=0)
    observed = test.target + noise * np.random.RandomState(0).randn(*test.target.shape)
    model = EVGPRegressor(InertiaForceGravity("pendulum"), n_inducing=10, random_state=0).fit(train.data, train.target)
    mean, std = model.predict(test.data, return_std=True)
    np.testing.assert_allclose(containing_ratios(observed, mean, std), [0.683, 0.954, 0.997], atol=0.03)
    np.testing.assert_allclose(np.sqrt(model.noise_variance_), noise, rtol=0.1)


@pytest.mark.long
def test_weights_are_physics():
    train = make_dynamics("pendulum", random_state=0)
    model = EVGPRegressor(InertiaForceGravity("pendulum"), n_inducing=10, random_state=0).fit(train.data, train.target)
    # q' = q + dt dq; dq' = dq + dt/J u - dt g/l sin q, to first order, minus what the GP takes over.
    np.testing.assert_allclose(model.coef_[0], [1.0, 0.03, 0.0, 0.0], atol=0.03)
    np.testing.assert_allclose(model.coef_[1, [1, 2]], [1.0, 0.12], atol=0.03)
    assert -0.7 < model.coef_[1, 3] < -0.3
