"""Functions that particles follow have the posterior's joint distribution along their path."""

import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, DotProduct, Matern
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor
from skevgp.solvers import LBFGS

N = 20_000


def own_features(X):
    return np.stack([X[:, :1], np.sin(X[:, :1]), X[:, 1:]], axis=1)


MODELS = {
    "plain": EVGPRegressor(n_inducing=8),
    "features": EVGPRegressor(PolynomialFeatures(1), sharing=[[0, 1], [2]], n_inducing=8, normalize_y=True),
    "diagonal": EVGPRegressor(
        PolynomialFeatures(1), solver=LBFGS(posterior="diagonal"), sharing="kernel", n_inducing=8
    ),
    "shared weights": EVGPRegressor(FunctionTransformer(own_features), coef_prior=CoefPrior(shared=True), n_inducing=8),
    "not stationary": EVGPRegressor(kernel=RBF(1.5) * DotProduct(1.0) + Matern(1.3, nu=0.5), n_inducing=8),
    "exact": EGPRegressor(PolynomialFeatures(1)),
}


@pytest.fixture(scope="module", params=MODELS)
def model(request):
    rng = np.random.RandomState(0)
    X = rng.uniform(-2.0, 2.0, (60, 2))
    Y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], X[:, 0] * X[:, 1], np.cos(X.sum(axis=1))])
    model = MODELS[request.param].set_params(max_iter=10, solver=LBFGS(tol=1e6), random_state=0)
    return model.fit(X, Y + 0.1 * rng.randn(*Y.shape))


def test_along_a_given_path_they_have_the_posteriors_joint_covariance(model):
    path = np.array([[0.0, 0.0], [0.4, -0.3], [3.0, 2.5], [0.0, 0.0], [0.4, -0.3 + 1e-9], [2.8, 2.9]])
    step = model._posterior.functions().draw(N, len(path), np.random.RandomState(1))
    values = np.stack([step(np.repeat(row[np.newaxis], N, axis=0)) for row in path], axis=1)
    mean, joint = model.predict(path, return_cov="joint", include_noise=False)
    size = np.sqrt(np.diag(joint))
    errors = (values - mean).reshape(N, -1)
    assert np.abs(errors.mean(axis=0) / size).max() < 5.0 / np.sqrt(N)
    covariance = errors.T @ errors / N
    assert np.abs((covariance - joint) / np.outer(size, size)).max() < 6.0 / np.sqrt(N)
    # A function is one: back at a row it has the value that it had.
    assert np.abs(values[:, 3] - values[:, 0]).max() < 1e-5 * size.max()
    assert np.abs(values[:, 4] - values[:, 1]).max() < 1e-2 * size.max()


def test_rows_that_the_points_know_leave_nothing_to_draw():
    rng = np.random.RandomState(0)
    X = rng.uniform(-2.0, 2.0, (30, 1))
    model = EVGPRegressor(inducing_init=X, max_iter=0).fit(X, np.sin(X[:, 0]))
    step = model._posterior.functions().draw(50, 30, rng)
    for row in X:
        values = step(np.repeat(row[np.newaxis], 50, axis=0))
        assert np.isfinite(values).all()
        mean, std = model.predict(row[np.newaxis], return_std=True, include_noise=False)
        assert (np.abs(values - mean) < 6.0 * std + 1e-6).all()
