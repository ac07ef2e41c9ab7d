"""Models whose predictions are differentiated, compiled and followed."""

import numpy as np
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, Matern
from sklearn.pipeline import make_pipeline, make_union
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures, StandardScaler

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor
from skevgp.features import ParametricFeatures, Uniform
from skevgp.solvers import LBFGS

from ..theta import rows_of_three

N_OUTPUTS, D = 3, 2
QUICK = {"max_iter": 10, "solver": LBFGS(tol=1e6), "sharing": "all", "noise_cv": None, "random_state": 0}


def quick(model):
    """The same model with few iterations, and variances that are not calibrated."""
    own = {"solver__tol": 1e6, "noise_cv": None} if isinstance(model, EVGPRegressor) else {"tol": 1e6}
    return model.set_params(max_iter=10, random_state=0, **own)


def own_columns(X):
    """Of each output other columns."""
    return np.stack([X, X[:, ::-1], X * X], axis=1)


def own_features(X):
    return np.stack([X[:, :1], np.sin(X[:, :1]), X[:, 1:]], axis=1)


def shrunk(X):
    return np.exp(0.3 * X)


KERNEL = ConstantKernel(2.0) * RBF([0.9, 1.2])
MODELS = {
    "plain": EVGPRegressor(n_inducing=12),
    "a group each": EVGPRegressor(PolynomialFeatures(2), sharing=[[0, 2], [1]], n_inducing=10),
    "diagonal": EVGPRegressor(
        PolynomialFeatures(1), KERNEL, solver=LBFGS(posterior="diagonal"), sharing="kernel", n_inducing=10
    ),
    "maps": EVGPRegressor(
        make_union(PolynomialFeatures(2), StandardScaler()),
        kernel_map=make_pipeline(StandardScaler(), PolynomialFeatures(2, include_bias=False)),
        sharing="all",
        n_inducing=12,
        normalize_y=True,
    ),
    "foreign maps": EVGPRegressor(
        FunctionTransformer(np.sinh), kernel_map=FunctionTransformer(shrunk), sharing="all", n_inducing=12
    ),
    "rows per output": EVGPRegressor(
        FunctionTransformer(own_features), kernel_map=FunctionTransformer(own_columns), sharing="none", n_inducing=12
    ),
    "shared weights": EVGPRegressor(
        FunctionTransformer(own_features), coef_prior=CoefPrior(shared=True), sharing="kernel", n_inducing=12
    ),
    "not stationary": EVGPRegressor(
        kernel=RBF(1.5) * DotProduct(1.0) + Matern(1.3, nu=2.5), sharing="all", n_inducing=12
    ),
    "parameters": EVGPRegressor(ParametricFeatures(rows_of_three, {"scale": Uniform(0.5, 3.0)}), n_inducing=10),
    "exact": EGPRegressor(PolynomialFeatures(1)),
}
