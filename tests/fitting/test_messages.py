import warnings

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.datasets import make_dynamics
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
def test_a_kernel_to_which_neighbours_are_strangers_is_white(length_scale, expected):
    assert white(LINE, WAVE, RBF(length_scale)) is expected
    # Other outputs may be noise.
    assert white(LINE, np.hstack([NOISE, WAVE]), RBF(length_scale)) is expected


def test_where_neighbours_are_not_alike_white_noise_is_the_answer():
    for columns in (1, 3, 20):
        rng = np.random.RandomState(0)
        inputs, targets = rng.randn(200, columns), rng.randn(200, 3)
        assert not white(inputs, targets, RBF(1e-4))


@pytest.mark.parametrize("inputs", [np.zeros((50, 2)), np.zeros((1, 2))], ids=["constant", "one row"])
def test_what_is_no_noise_is_not_white(inputs):
    assert not white(inputs, np.arange(float(len(inputs)))[:, np.newaxis], RBF(1e-4))
    assert not white(LINE, WAVE, RBF(1e-4) + ConstantKernel(1.0))
    assert not white(LINE - 5.0, WAVE, DotProduct(1e-3))


def test_repeated_rows_are_explained_by_a_kernel_of_single_points():
    """Which is right if the value at each place is drawn anew."""
    rng = np.random.RandomState(0)
    inputs, values = np.repeat(rng.rand(40, 2), 5, axis=0), np.repeat(rng.randn(40, 1), 5, axis=0)
    assert not white(inputs, values + 0.1 * rng.randn(200, 1), RBF(1e-4))


def test_what_noise_explains_is_told_where_neighbours_are_alike():
    rows = identity_rows(LINE, np.hstack([WAVE, NOISE]))
    scatter = rows.scatter()
    assert "of 1 of 2 outputs" in nothing_learned(scatter, rows)
    assert nothing_learned(0.9 * scatter, rows) == ""
    assert "n_inducing, or n_restarts of the solver" in nothing_learned(scatter, rows)
    alone = identity_rows(LINE, WAVE)
    assert "Raise n_restarts" in nothing_learned(alone.scatter(), alone, sparse=False)


def test_a_kernel_that_outputs_share_is_named():
    rows = identity_rows(LINE, np.hstack([WAVE, WAVE]))
    noise = rows.scatter() * [1.0, 0.1]
    assert 'sharing="none" gives each its own' in nothing_learned(noise, rows)
    assert "MultiOutputRegressor(EGPRegressor(...)) fits each" in nothing_learned(noise, rows, sparse=False)
    assert "share" not in nothing_learned(rows.scatter(), rows)


MODELS = {
    "exact": lambda **arguments: EGPRegressor(**arguments),
    "sparse": lambda **arguments: EVGPRegressor(inducing_init=LINE[::2], random_state=0, **arguments),
}


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_a_fit_that_ends_with_white_noise_says_so(model):
    with pytest.warns(ConvergenceWarning, match=r"neighbouring rows are (alike|strangers)"):
        model(kernel=RBF(1e-4)).fit(LINE, WAVE[:, 0])


def test_an_exact_fit_says_that_its_kernel_is_white():
    with pytest.warns(ConvergenceWarning, match="The kernel became white noise"):
        model = EGPRegressor(kernel=RBF(1e-4)).fit(LINE, WAVE[:, 0])
    between = LINE[:-1] + 0.025
    assert model.score(between, np.sin(between[:, 0])) < 0.1


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_a_model_that_is_not_fitted_says_nothing(model):
    with warnings.catch_warnings(action="error"):
        model(kernel=RBF(1e-4), max_iter=0).fit(LINE, WAVE[:, 0])


def test_who_asks_for_white_noise_is_not_told():
    with warnings.catch_warnings(action="error"):
        EGPRegressor(kernel=RBF(1e-4, "fixed")).fit(LINE, WAVE[:, 0])


@pytest.mark.long
@pytest.mark.parametrize("columns", [1, 2, 8, 20])
@pytest.mark.parametrize(
    "target",
    [lambda X: np.sin(5 * X[:, 0]), lambda X: X.sum(axis=1), lambda X: np.random.RandomState(1).randn(len(X))],
    ids=["one column", "line", "noise"],
)
def test_a_fit_that_has_learned_what_there_is_says_nothing(columns, target):
    X = np.random.RandomState(0).randn(150, columns)
    for model in (EGPRegressor(), EVGPRegressor(n_inducing=30, random_state=0), EGPRegressor(PolynomialFeatures(1))):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            model.fit(X, target(X))
        assert not [one for one in told if "neighbouring rows" in str(one.message)]


@pytest.mark.parametrize("system", ["pendulum", "cartpole", "acrobot", "iiwa14"])
def test_a_robot_is_not_white_noise(system):
    data = make_dynamics(system, n_trajectories=6, n_steps=20, random_state=0)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        EVGPRegressor(n_inducing=20, max_iter=40, random_state=0).fit(data.data, data.target)
    assert not [one for one in told if "neighbouring rows" in str(one.message)]
