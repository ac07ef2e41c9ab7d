import numpy as np
import pytest
from numpy.testing import assert_array_equal

from skevgp.datasets import make_toy

# What the 8 to 22 of Snelson's 200 points in each half unit of x average to, on the paper's trend.
SNELSONS_MEANS = [-1.1, -4.2, -6.1, -4.7, 5.2, 10.8, 10.0, 11.2, 17.4, 15.2, 11.1, 14.8]


def test_the_default_is_as_large_as_snelsons_data():
    toy = make_toy(random_state=0)
    assert set(toy) == {"data", "target", "mean", "feature_names", "target_names", "DESCR"}
    assert toy.data.shape == (200, 1)
    assert toy.target.shape == toy.mean.shape == (200,)
    assert (toy.feature_names, toy.target_names) == (["x"], ["y"])
    assert "200 points" in toy.DESCR


def test_inputs_are_sorted_and_fill_the_interval():
    x = make_toy(random_state=0).data[:, 0]
    assert (np.diff(x) >= 0).all()
    assert 0.0 < x[0] < 0.2
    assert 5.8 < x[-1] < 6.0


def test_without_noise_the_target_is_the_mean():
    toy = make_toy(noise=0.0, random_state=0)
    assert_array_equal(toy.target, toy.mean)


def test_the_noise_has_the_standard_deviation_asked_for():
    toy = make_toy(n_samples=5000, noise=0.3, random_state=0)
    residual = toy.target - toy.mean
    assert residual.std() == pytest.approx(0.3, rel=0.05)
    assert residual.mean() == pytest.approx(0.0, abs=0.02)


def test_the_mean_is_waves_on_a_line_of_slope_three():
    """Between the waves, and at both ends, the line is left."""
    toy = make_toy(n_samples=20_000, noise=0.0, random_state=0)
    x, waves = toy.data[:, 0], toy.target - 3.0 * toy.data[:, 0]
    assert np.interp([0.0, 3.5, 6.0], x, waves) == pytest.approx(0.0, abs=1.0)
    extrema = waves[1:-1][np.diff(np.sign(np.diff(waves))) != 0]
    np.testing.assert_allclose(extrema[np.abs(extrema) > 2.0], [-11.0, 3.2, 5.3, -5.0], atol=0.5)


def test_it_looks_like_snelsons_data():
    """Each average of so few points is off by up to 0.6 in standard deviation, since the noise is 1.7."""
    toy = make_toy(n_samples=20_000, noise=0.0, random_state=0)
    halves = np.floor(2.0 * toy.data[:, 0])
    means = [toy.mean[halves == half].mean() for half in range(12)]
    np.testing.assert_allclose(means, SNELSONS_MEANS, rtol=0, atol=1.0)


def test_the_same_random_state_gives_the_same_bits():
    first, second = (make_toy(random_state=3) for _ in range(2))
    assert_array_equal(first.data, second.data)
    assert_array_equal(first.target, second.target)


def test_another_random_state_gives_other_data():
    assert (make_toy(random_state=0).data != make_toy(random_state=1).data).all()


def test_return_x_y_gives_the_two_arrays():
    X, y = make_toy(n_samples=4, random_state=0, return_X_y=True)
    toy = make_toy(n_samples=4, random_state=0)
    assert_array_equal(X, toy.data)
    assert_array_equal(y, toy.target)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"n_samples": 0}, ValueError, "n_samples must be at least 1; got 0"),
        ({"n_samples": 2.5}, TypeError, "n_samples must be an integer; got 2.5"),
        ({"noise": -1.0}, ValueError, "noise must be finite and at least 0.0; got -1.0"),
        ({"noise": np.nan}, ValueError, "noise must be finite and at least 0.0; got nan"),
        ({"noise": "loud"}, TypeError, "noise must be a number; got 'loud'"),
    ],
)
def test_bad_arguments_are_named(arguments, error, message):
    with pytest.raises(error, match=message):
        make_toy(**arguments)
