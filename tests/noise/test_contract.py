"""What every noise model has in common."""

import pickle

import numpy as np
import pytest
from sklearn.base import clone

from skevgp import EVGPRegressor
from skevgp.datasets import make_toy
from skevgp.noise import NOISES, as_noise
from skevgp.solvers import LBFGS

DISTANCES = np.array([0.0, 0.5, 4.0, 400.0, 1e12])


@pytest.mark.parametrize("name", NOISES)
def test_name_is_the_model_with_its_defaults(name):
    noise = as_noise(name)
    assert noise.get_params() == NOISES[name]().get_params()
    assert as_noise(clone(noise)).get_params() == noise.get_params()
    with pytest.raises(ValueError, match="variance of .* must be finite and above 0.0; got -1.0"):
        as_noise(noise.set_params(variance=-1.0))


@pytest.mark.parametrize("name", NOISES)
def test_clean_data_have_the_same_predictions_under_each(name):
    """And a file or a copy of the model has them too."""
    X, y = make_toy(random_state=0, return_X_y=True)
    options = {"n_inducing": 10, "solver": LBFGS(tol=1.0), "noise_cv": None, "random_state": 0}
    fitted, plain = (EVGPRegressor(**options, noise=one).fit(X, y) for one in (name, "gaussian"))
    found = fitted.predict(X, return_std=True)
    np.testing.assert_allclose(found, plain.predict(X, return_std=True), rtol=0.02, atol=0.02)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(fitted)).predict(X, return_std=True), found)


@pytest.mark.parametrize("name", [name for name, kind in NOISES.items() if kind.heavy_tails])
@pytest.mark.parametrize("n_outputs", [1, 3])
def test_scales_of_rows(name, n_outputs):
    """A row without an error is ordinary, and the further a row is from its prediction, the less it counts."""
    scales = NOISES[name]().row_scales(n_outputs, DISTANCES)
    for values in (scales.mean, scales.outlier, scales.log_variance):
        assert values.shape == DISTANCES.shape
        assert np.isfinite(values).all()
    assert 0.5 < scales.mean[0] < 2.0
    assert (scales.mean > 0.0).all()
    assert (np.diff(scales.mean) <= 0.0).all()
    assert ((scales.outlier >= 0.0) & (scales.outlier <= 1.0)).all()
    np.testing.assert_array_equal(scales.at(DISTANCES[::-1]).mean, scales.mean[::-1])
    # A copy holds no rows. It is as good for others.
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(scales)).at(DISTANCES).mean, scales.mean)
