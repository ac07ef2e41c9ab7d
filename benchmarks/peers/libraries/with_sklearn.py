"""scikit-learn's regressors as peers."""

from __future__ import annotations

from typing import Any

import numpy as np

from peers.jobs import Fitted, Fixed, Job, Said, Scaled, Watch

GPR_MODULES = ("sklearn.gaussian_process", "scipy")
JITTER = "none (alpha=0)"
_FOLDS = 5


def at_fixed(fixed: Fixed) -> Said:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

    shape = RBF(fixed.lengthscales) if fixed.kernel == "rbf" else Matern(fixed.lengthscales, nu=2.5)
    kernel = ConstantKernel(fixed.signal) * shape + WhiteKernel(fixed.noise)
    model = GaussianProcessRegressor(kernel, alpha=0.0, optimizer=None).fit(fixed.X, fixed.y)
    mean, std = model.predict(fixed.X_test, return_std=True)
    return Said(model.log_marginal_likelihood_value_, mean, std**2)


def fit_gpr(job: Job, watch: Watch) -> Fitted:
    """The exact GP; the job brings as many rows as it can take."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    scaled = Scaled(job)
    # The default floor of the noise, 1e-5, is above the noise of dynamics.
    kernel = ConstantKernel() * RBF(scaled.lengthscales) + WhiteKernel(job.noise, (1e-10, 10.0))
    models = []
    for columns in scaled.models:
        gp = GaussianProcessRegressor(kernel, random_state=job.seed).fit(scaled.X, scaled.Y[:, columns])
        models.append(lambda X, gp=gp: gp.predict(X, return_std=True))
    return Fitted(scaled.predictor(models), [], "converged")


def fit_linear(job: Job, watch: Watch) -> Fitted:
    """What a straight line can do."""
    from sklearn.linear_model import BayesianRidge

    scaled = Scaled(job)
    models = []
    for columns in scaled.models:
        line = BayesianRidge().fit(scaled.X, scaled.Y[:, columns[0]])
        models.append(lambda X, line=line: line.predict(X, return_std=True))
    return Fitted(scaled.predictor(models), [], "converged")


def fit_trees(job: Job, watch: Watch) -> Fitted:
    """Gradient boosting with its defaults.

    It has no variance: it gets a constant one, the mean square error of cross-validation by 5 folds of the training
    rows, which is found when the clock has been read.
    """
    from sklearn.ensemble import HistGradientBoostingRegressor
    from sklearn.model_selection import KFold, cross_val_predict

    scaled = Scaled(job)
    models = []
    for columns in scaled.models:
        y = scaled.Y[:, columns[0]]
        trees = HistGradientBoostingRegressor(random_state=job.seed).fit(scaled.X, y)

        def predict(X: np.ndarray, trees: Any = trees, y: np.ndarray = y) -> tuple[np.ndarray, np.ndarray]:
            folds = KFold(_FOLDS, shuffle=True, random_state=job.seed)
            error = y - cross_val_predict(trees, scaled.X, y, cv=folds)
            return trees.predict(X), np.full(len(X), np.sqrt(np.mean(error**2)))

        models.append(predict)
    return Fitted(scaled.predictor(models), [], "converged")
