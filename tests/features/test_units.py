"""The prior of inertia and force knows no unit of length, angle or force, and that of a rate no time step."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForce, InertiaForceGravity, NominalDynamics

DEGREE, MILLI = 180.0 / np.pi, 1e3


@pytest.mark.filterwarnings("ignore:The bound was still rising")
@pytest.mark.parametrize(
    ("system", "units", "sharing"),
    [
        # Degrees, and N mm.
        ("pendulum", [DEGREE, DEGREE, MILLI], "none"),
        # The cart in mm and mm/s.
        ("cartpole", [MILLI, 1.0, MILLI, 1.0, 1.0], "kernel"),
    ],
)
def test_fit_does_not_depend_on_units(system, units, sharing):
    X, y = make_dynamics(system, 4, 15, noise=0.01, random_state=0, return_X_y=True)
    X_new, _ = make_dynamics(system, 3, 5, random_state=1, return_X_y=True)
    of_columns, of_targets = np.array(units), np.array(units[: y.shape[1]])
    model = EVGPRegressor(InertiaForce(system), n_inducing=8, sharing=sharing, max_iter=10, random_state=0)
    mean, std = model.fit(X, y).predict(X_new, return_std=True)
    scale = model.coef_prior_scale_
    model.fit(X * of_columns, y * of_targets)
    # The scales of groups are learned, too. Rounding errors grow with the iterations.
    by = of_targets[:, np.newaxis] / of_columns
    assert_allclose(model.coef_prior_scale_, scale * by, rtol=1e-8)
    found, found_std = model.predict(X_new * of_columns, return_std=True)
    assert_allclose(found / of_targets, mean, rtol=1e-8, atol=1e-8 * np.abs(mean).max())
    assert_allclose(found_std / of_targets, std, rtol=1e-7)


@pytest.mark.parametrize(
    "features",
    [
        InertiaForce("acrobot"),
        InertiaForceGravity("acrobot"),
        NominalDynamics("acrobot", terms=["acceleration", "gravity", "input"]),
    ],
)
@pytest.mark.parametrize("dt", [0.001, 0.2])
def test_prior_of_a_second_does_not_depend_on_the_step(features, dt):
    """A velocity changes by Δt times an acceleration, and a position by Δt times that."""
    X = np.random.default_rng(0).normal(size=(20, 5))
    size = np.sqrt(np.mean(features.fit_transform(X) ** 2, axis=0))
    acceleration = np.array([2.0, 5.0])

    def scales(step):
        features.set_params(dt=step).fit(X)
        left_over = np.hstack([step**2 * acceleration, step * acceleration])
        return features.coef_prior(4)[1], features.coef_scale(left_over, size)

    by = np.array([(dt / 0.03) ** 2] * 2 + [dt / 0.03] * 2)[:, np.newaxis]
    for found, usual in zip(scales(dt), scales(0.03), strict=True):
        assert_allclose(found, by * usual, rtol=1e-12)
        assert not np.isnan(found).all()
