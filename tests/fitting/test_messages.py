import warnings

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import RBF
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.fitting.messages import nothing_learned, white_kernel
from skevgp.kernels.parse import parse_kernel

from ..oracle import identity_rows

LINE = np.linspace(0, 10, 200)[:, np.newaxis]
WAVE = np.sin(LINE)
NOISE = np.random.RandomState(0).randn(200, 1)


def white(inputs, targets, kernel, *hyperparameters):
    spec = parse_kernel(kernel, inputs.shape[1])
    values = np.array(hyperparameters) if hyperparameters else spec.starts.hyperparameters.value
    return bool(white_kernel(spec.covariance, values, identity_rows(inputs, targets)))


@pytest.mark.parametrize(("length_scale", "expected"), [(1e-4, True), (1e-2, True), (0.05, False), (1.0, False)])
def test_short_length_scale_is_white(length_scale, expected):
    assert white(LINE, WAVE, RBF(length_scale)) is expected
    # Other outputs may be noise.
    assert white(LINE, np.hstack([NOISE, WAVE]), RBF(length_scale)) is expected


def test_dissimilar_neighbours_are_white_noise():
    for columns in (1, 3, 20):
        rng = np.random.RandomState(0)
        inputs, targets = rng.randn(200, columns), rng.randn(200, 3)
        assert not white(inputs, targets, RBF(1e-4))


def test_noise_warning_for_similar_neighbours():
    rows = identity_rows(LINE, np.hstack([WAVE, NOISE]))
    scatter = rows.scatter()
    assert "for 1 of 2 outputs" in nothing_learned(scatter, rows)
    assert nothing_learned(0.9 * scatter, rows) == ""
    assert "n_inducing, or n_restarts of the solver" in nothing_learned(scatter, rows)
    alone = identity_rows(LINE, WAVE)
    assert "Raise n_restarts" in nothing_learned(alone.scatter(), alone, sparse=False)


MODELS = {
    "exact": lambda **arguments: EGPRegressor(**arguments),
    "sparse": lambda **arguments: EVGPRegressor(inducing_init=LINE[::2], random_state=0, **arguments),
}


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_fit_that_ends_with_white_noise_says_so(model):
    with pytest.warns(ConvergenceWarning, match="neighbouring rows are similar"):
        model(kernel=RBF(1e-4)).fit(LINE, WAVE[:, 0])


@pytest.mark.long
@pytest.mark.parametrize("columns", [1, 2, 8, 20])
@pytest.mark.parametrize(
    "target",
    [lambda X: np.sin(5 * X[:, 0]), lambda X: X.sum(axis=1), lambda X: np.random.RandomState(1).randn(len(X))],
    ids=["one column", "line", "noise"],
)
def test_fit_that_has_learned_what_there_is_says_nothing(columns, target):
    X = np.random.RandomState(0).randn(150, columns)
    for model in (EGPRegressor(), EVGPRegressor(n_inducing=30, random_state=0), EGPRegressor(PolynomialFeatures(1))):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            model.fit(X, target(X))
        assert not [one for one in told if "neighbouring rows" in str(one.message)]
