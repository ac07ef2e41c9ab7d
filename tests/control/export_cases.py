"""Fitted models to be exported, and what predictions say of them."""

import casadi as ca
import numpy as np
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.gaussian_process import kernels as sk
from sklearn.pipeline import make_pipeline, make_union
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor
from skevgp.features import AngleEncoder, InertiaForceGravity, NominalDynamics, ParametricFeatures, Uniform
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS

from ..theta import DECAY, WAVE, rows_of_three


class Rows(TransformerMixin, BaseEstimator):
    """A row of two columns for each of three outputs."""

    def fit(self, X, y=None):
        return self

    def transform(self, X):
        return np.stack([X[:, :2] * (o + 1.0) + X[:, 1:3] ** 2 for o in range(3)], axis=1)

    def to_casadi(self, x):
        return [x[:2] * (o + 1.0) + x[1:3] ** 2 for o in range(3)]


def data(n_rows=40, n_columns=5, n_outputs=3, seed=0):
    """Waves of several frequencies, each output with noise of its own size."""
    rng = np.random.RandomState(seed)
    X = rng.uniform(-2.0, 2.0, (n_rows, n_columns))
    waves = np.sin(X[:, :3] @ rng.randn(3, n_outputs)) + 0.5 * X[:, 1:2]
    return X, waves + np.linspace(0.05, 0.5, n_outputs) * rng.randn(n_rows, n_outputs)


def fitted(model, **arguments):
    """Fitted to `data`."""
    return model.fit(*data(**arguments))


def sparse(*arguments, **others):
    given = {"n_inducing": 10, "max_iter": 0, "noise_cv": None, "random_state": 0, "noise": Gaussian(variance=0.05)}
    return EVGPRegressor(*arguments, **{**given, **others})


def exact(*arguments, **others):
    return EGPRegressor(*arguments, **{"max_iter": 0, "random_state": 0, "noise": Gaussian(variance=0.05), **others})


POLYNOMIAL = make_union(PolynomialFeatures(1), StandardScaler())
CARTPOLE = make_union(InertiaForceGravity("cartpole"), NominalDynamics("cartpole"))
ENCODER = make_pipeline(AngleEncoder("cartpole"), StandardScaler())
CORRELATED = np.array([[1.0, 0.5], [0.5, 2.0]])
MODELS = {
    "no maps": sparse(),
    "features": sparse(POLYNOMIAL),
    "cartpole": sparse(CARTPOLE, kernel_map=ENCODER, coef_prior=CoefPrior(mean=0.1, scale=1.0), normalize_y=True),
    "all": sparse(POLYNOMIAL, sharing="all"),
    "kernel": sparse(POLYNOMIAL, sharing="kernel"),
    "none": sparse(POLYNOMIAL, sharing="none"),
    "groups": sparse(POLYNOMIAL, sharing=[[2, 0], [1]], normalize_y=True),
    "rows of features": sparse(Rows(), sharing="kernel"),
    "rows of inputs": sparse(kernel_map=Rows(), sharing="none"),
    "rows of both": sparse(Rows(), kernel_map=Rows(), coef_prior=CoefPrior(cov=CORRELATED)),
    "shared weights": sparse(Rows(), coef_prior=CoefPrior(shared=True), sharing="none"),
    "shared weights, all": sparse(POLYNOMIAL, coef_prior=CoefPrior(shared=True), sharing="all", normalize_y=True),
    "correlated weights": sparse(PolynomialFeatures(1), coef_prior=CoefPrior(cov=np.eye(6) + 0.3)),
    "pinned weights": sparse(PolynomialFeatures(1), coef_prior=CoefPrior(scale=0.0, mean=0.5)),
    "diagonal": sparse(POLYNOMIAL, solver=LBFGS(posterior="diagonal")),
    "student-t": sparse(POLYNOMIAL, noise="student-t"),
    "all rows": sparse(n_inducing=40, kernel=sk.RBF(0.5)),
    "sums": sparse(kernel=2.0 * sk.Matern(1.0, nu=1.5) + sk.DotProduct(0.5) + sk.WhiteKernel(0.1), noise="gaussian"),
    "parameters": sparse(make_union(WAVE, StandardScaler())),
    "parameters, rows": sparse(ParametricFeatures(rows_of_three, {"scale": Uniform(0.5, 3.0)})),
    "parameters, orthogonal f": exact(DECAY, discrepancy="orthogonal"),
    "exact": exact(),
    "exact, features": exact(POLYNOMIAL, normalize_y=True),
    "exact, shared weights": exact(Rows(), coef_prior=CoefPrior(shared=True)),
    "exact, rows": exact(Rows(), kernel_map=Rows()),
}


def evaluated(function, X, *others):
    """A function's mean and variance at rows, each (n, o)."""
    found = [function(row, *others) for row in X]
    return tuple(np.array([output.full().ravel() for output in outputs]) for outputs in zip(*found, strict=True))


def predicted(model, X, include_noise=True):
    """`predict` with an axis of outputs, the standard deviation squared."""
    mean, std = model.predict(X, return_std=True, include_noise=include_noise)
    return mean.reshape(len(X), -1), std.reshape(len(X), -1) ** 2


def jacobians(function, x_of, *others):
    """Of mean and variance, at a row."""
    x = ca.MX.sym("x", len(x_of))
    outputs = function(x, *others)
    found = ca.Function("j", [x], [ca.jacobian(output, x) for output in outputs])(x_of)
    return [own.full() for own in found]
