import numpy as np
import pytest
from numpy.testing import assert_array_equal

from skevgp.datasets import make_toy


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


def test_the_trend_has_slope_three():
    """Away from the dip at 1.2 the mean repeats itself on the line."""
    toy = make_toy(n_samples=20_000, noise=0.0, random_state=0)
    x, period = np.linspace(3.6, 4.3, 20), 2.0 * np.pi / 3.8
    before, after = (np.interp(at, toy.data[:, 0], toy.target) for at in (x, x + period))
    assert (after - before) / period == pytest.approx(3.0, abs=0.01)


def test_waves_stand_out_from_the_trend():
    toy = make_toy(n_samples=500, noise=0.0, random_state=0)
    x = toy.data[:, 0]
    waves = toy.target - np.polyval(np.polyfit(x, toy.target, 1), x)
    assert waves.std() > 2.0
    assert np.count_nonzero(np.diff(np.sign(waves))) >= 5


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
