import numpy as np
import pytest

from skevgp.datasets import make_toy


def test_mean_is_waves_on_a_line_of_slope_three():
    """Between the waves, and at both ends, the line is left."""
    toy = make_toy(n_samples=20_000, noise=0.0, random_state=0)
    x, waves = toy.data[:, 0], toy.target - 3.0 * toy.data[:, 0]
    assert np.interp([0.0, 3.5, 6.0], x, waves) == pytest.approx(0.0, abs=1.0)
    extrema = waves[1:-1][np.diff(np.sign(np.diff(waves))) != 0]
    np.testing.assert_allclose(extrema[np.abs(extrema) > 2.0], [-11.0, 3.2, 5.3, -5.0], atol=0.5)


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
def test_invalid_arguments_raise(arguments, error, message):
    with pytest.raises(error, match=message):
        make_toy(**arguments)
