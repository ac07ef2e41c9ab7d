import numpy as np
import pytest
from numpy.testing import assert_allclose

from skevgp.identification.stiction import JointNoise, MeanFriction, likeliest_noise, noise_at


def drawn(n=20_000, seed=0, noise=0.1, coulomb=2.0, velocity=0.02):
    rng = np.random.default_rng(seed)
    speed = 0.2 * rng.normal(size=n)
    true = JointNoise(noise**2, coulomb, velocity)
    return rng.normal(size=n) * np.sqrt(true.of(speed)), speed


def test_at_rest_friction_is_uniform_and_at_speed_it_is_known():
    noise = JointNoise(0.01, 3.0, 0.02)
    assert noise.of(np.array([0.0]))[0] == pytest.approx(0.01 + np.var(np.linspace(-3.0, 3.0, 100_001)), rel=1e-3)
    assert noise.of(np.array([1.0, -1.0])) == pytest.approx(0.01)


@pytest.mark.parametrize("velocity", [0.005, 0.02, 0.1])
def test_velocity_is_found_too(velocity):
    found = likeliest_noise(*drawn(velocity=velocity), coulomb=2.0, velocity=0.01, least=1e-9)
    assert found.velocity == pytest.approx(velocity, rel=0.1)
    assert found.variance == pytest.approx(0.01, rel=0.2)


@pytest.mark.parametrize("coulomb", [0.5, 2.0])
def test_noise_of_few_rows_that_move_is_larger_than_the_mean_square_of_all(coulomb):
    rng = np.random.default_rng(0)
    speed = np.where(np.arange(20_000) % 100 == 0, 1.0, 1e-3)
    true = JointNoise(1.0, coulomb, 0.01)
    quiet = np.where(speed > 0.5, 1.0, 0.1)  # at rest hardly any of it is seen
    errors = quiet * np.sqrt(true.variance) * rng.normal(size=20_000)
    found = noise_at(errors[speed > 0.5], speed[speed > 0.5], coulomb, 0.01, 1e-9)
    assert found.variance == pytest.approx(1.0, rel=0.3)
    assert noise_at(errors, speed, coulomb, 0.01, 1e-9).variance > np.mean(errors**2)


def test_slopes_of_mean_friction_are_those_of_differences():
    speed = 0.05 * np.random.default_rng(0).normal(size=(50, 2))
    friction, step = MeanFriction(np.array([2.0, -3.0]), np.array([0.5, -1.0])), 1e-5

    def torque(z):
        return friction.coulomb * np.tanh(speed / MeanFriction(friction.coulomb, z).velocity)

    for joint in range(2):
        moved = step * np.eye(2)[joint]
        expected = (torque(friction.z + moved) - torque(friction.z - moved)) / (2.0 * step)
        assert_allclose(friction.slopes(speed)[:, :, joint], expected, atol=1e-8)
