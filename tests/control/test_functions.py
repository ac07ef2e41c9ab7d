"""Functions drawn from the posterior have its mean and covariance: exactly along a path, else to what waves can do."""

import pickle

import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, DotProduct, Matern, RationalQuadratic
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor
from skevgp.solvers import LBFGS

from .cases import N_OUTPUTS, QUICK, D, own_features, quick
from .test_derivatives import close, differences

N, N_PATHS = 1000, 8_000


def test_functions_have_posterior_mean_and_covariance(model, data):
    X = data[2]
    values = model.sample_functions(N, n_waves=1000)(X)
    assert values.shape == (N, len(X), N_OUTPUTS)
    mean, cov = model.predict(X, return_cov=True, include_noise=False)
    std = np.sqrt(np.einsum("nno->no", cov))
    assert np.abs((values.mean(axis=0) - mean) / std).max() < 6.0 / np.sqrt(N)
    ratio = values.var(axis=0) / std**2
    assert 0.9 < np.median(ratio) < 1.1
    assert ratio.min() > 0.6
    assert ratio.max() < 1.6
    errors = (values - mean) / std
    found = np.einsum("sio,sjo->ijo", errors, errors) / N
    assert np.abs(found - cov / (std[:, np.newaxis] * std)).max() < 0.35


@pytest.mark.parametrize(
    "kernel",
    [Matern([1.0, 1.0], nu=1.5), Matern([1.0, 1.0], nu=2.5), RationalQuadratic(1.0, 1.0), RBF([1.0, 1.0])],
    ids=["matern 3/2", "matern 5/2", "rational quadratic", "rbf"],
)
def test_variance_between_points_is_right_for_rough_functions_too(kernel):
    """What inducing points leave of a fitted kernel is far out in its spectrum."""
    rng = np.random.RandomState(0)
    X = rng.uniform(-2.0, 2.0, (60, 2))
    y = np.sin(2.0 * X[:, 0]) + X[:, 1] + 0.02 * rng.randn(60)
    model = EVGPRegressor(kernel=kernel, n_inducing=15, noise_cv=None, random_state=0).fit(X, y)
    rows = rng.uniform(-2.0, 2.0, (40, 2))
    ratio = model.sample_functions(1500)(rows).var(axis=0) / model.predict(rows, True, include_noise=False)[1] ** 2
    assert 0.9 < np.median(ratio) < 1.1
    assert np.quantile(ratio, 0.05) > 0.75
    assert np.quantile(ratio, 0.95) < 1.3


def test_jacobians_agree_with_differences(model, data):
    X, functions = data[2], model.sample_functions(3, random_state=1, n_waves=100)
    values, jacobians = functions.value_and_jacobian(X)
    np.testing.assert_allclose(values, functions(X), rtol=1e-10, atol=1e-10)
    assert jacobians.shape == (3, len(X), N_OUTPUTS, D)
    for function, value, jacobian in zip(functions, values, jacobians, strict=True):
        np.testing.assert_allclose(function(X), value, rtol=1e-9, atol=1e-9)
        close(jacobian, differences(function, X), 1e-6)
        one = function.value_and_jacobian(X[2])
        np.testing.assert_allclose(one[0], value[2], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(one[1], jacobian[2], rtol=1e-9, atol=1e-9)


def test_same_seed_gives_the_same_functions_and_they_can_be_pickled(data):
    X, Y, X_new = data
    model = EVGPRegressor(n_inducing=10, **QUICK).fit(X, Y)
    one, other, third = (model.sample_functions(2, random_state=seed, n_waves=50) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one(X_new), other(X_new))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(one))[1](X_new), other[1](X_new))
    assert not np.array_equal(one(X_new), third(X_new))


# --- along a path ----------------------------------------------------------------------------------------------------

FOLLOWED = {
    "plain": EVGPRegressor(sharing="all", n_inducing=8),
    "features": EVGPRegressor(PolynomialFeatures(1), sharing=[[0, 1], [2]], n_inducing=8, normalize_y=True),
    "diagonal": EVGPRegressor(
        PolynomialFeatures(1), solver=LBFGS(posterior="diagonal"), sharing="kernel", n_inducing=8
    ),
    "shared weights": EVGPRegressor(
        FunctionTransformer(own_features), coef_prior=CoefPrior(shared=True), sharing="kernel", n_inducing=8
    ),
    "not stationary": EVGPRegressor(
        kernel=RBF(1.5) * DotProduct(1.0) + Matern(1.3, nu=0.5), sharing="none", n_inducing=8
    ),
    "exact": EGPRegressor(PolynomialFeatures(1)),
}


@pytest.fixture(scope="module", params=FOLLOWED)
def followed(request):
    rng = np.random.RandomState(0)
    X = rng.uniform(-2.0, 2.0, (60, 2))
    Y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], X[:, 0] * X[:, 1], np.cos(X.sum(axis=1))])
    return quick(FOLLOWED[request.param]).fit(X, Y + 0.1 * rng.randn(*Y.shape))


def test_along_a_given_path_they_have_the_posteriors_joint_covariance(followed):
    path = np.array([[0.0, 0.0], [0.4, -0.3], [3.0, 2.5], [0.0, 0.0], [0.4, -0.3 + 1e-9], [2.8, 2.9]])
    step = followed._posterior.functions().draw(N_PATHS, len(path), np.random.RandomState(1))
    values = np.stack([step(np.repeat(row[np.newaxis], N_PATHS, axis=0)) for row in path], axis=1)
    mean, joint = followed.predict(path, return_cov="joint", include_noise=False)
    size = np.sqrt(np.diag(joint))
    errors = (values - mean).reshape(N_PATHS, -1)
    assert np.abs(errors.mean(axis=0) / size).max() < 5.0 / np.sqrt(N_PATHS)
    covariance = errors.T @ errors / N_PATHS
    assert np.abs((covariance - joint) / np.outer(size, size)).max() < 6.0 / np.sqrt(N_PATHS)
    # A function is one: back at a row it has the value that it had.
    assert np.abs(values[:, 3] - values[:, 0]).max() < 1e-5 * size.max()
    assert np.abs(values[:, 4] - values[:, 1]).max() < 1e-2 * size.max()
