"""Kernels at work: in the bounds, and in a fit from scikit-learn's tree back to it."""

import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import (
    RBF,
    ConstantKernel,
    DotProduct,
    ExpSineSquared,
    Matern,
    RationalQuadratic,
    WhiteKernel,
)

from skevgp import EVGPRegressor
from skevgp.fitting.start import checked_variance
from skevgp.kernels import FunctionKernel
from skevgp.kernels.parse import Start, Starts, parse_kernel
from skevgp.model.model import SparseModel
from skevgp.model.objectives import BoundObjective
from skevgp.noise import Gaussian

from ..oracle import problem, table_of
from .cases import KERNELS, REGISTERED, Z, parsed, polynomial, smooth


def model_with(kernel, shared=True, **sizes):
    """The small problem of the oracle with another kernel."""
    model, rows, table = problem("full", shared, **sizes)
    spec = parse_kernel(ConstantKernel() * kernel, 2)
    # As an estimator hands it over.
    covariance = spec.covariance.centred(rows.inputs.mean(axis=0))
    points = table["inducing_points"].start
    starts = Starts(spec.starts.hyperparameters, Start(np.array([0.7])), Start(np.array([0.2])))
    variance = checked_variance(covariance, spec.starts.hyperparameters.value, points[0])
    table = table_of(rows.inputs, points, starts, np.ones(2), covariance, mean_variance=variance)
    return SparseModel(covariance, model.prior, model.groups), rows, table


def test_value_of_a_bound_that_depends_on_the_diagonal():
    """Titsias 2009, eq. 9, written down from matrices, for a covariance that is not stationary."""
    kernel = KERNELS["nested"]
    model, rows, table = model_with(kernel)
    values = table.values(table.start())
    inputs, points = rows.inputs, values["inducing_points"][0]
    K = kernel(points) + 1e-12 * np.diag(kernel.diag(points))
    V = np.linalg.solve(np.linalg.cholesky(K), kernel(points, inputs))
    expected = 0.0
    for o in range(2):
        prior, noise, signal = model.prior, values["noise"][o], values["signal"][o]
        H = rows.features * prior.scale[o]
        r = rows.residuals[:, o] + H @ prior.reference[o]
        covariance = signal * V.T @ V + H @ H.T + noise * np.eye(60)
        quadratic = r @ np.linalg.solve(covariance, r)
        expected -= 0.5 * (60 * np.log(2 * np.pi) + np.linalg.slogdet(covariance)[1] + quadratic)
        expected -= 0.5 * signal * (kernel.diag(inputs).sum() - (V**2).sum()) / noise
    found, _ = BoundObjective(model, table, rows.blocks(model.kernel, 17))(table.start())
    assert found == pytest.approx(-expected / 60, rel=1e-8)


@pytest.mark.parametrize(
    ("kernel", "message"),
    [
        (FunctionKernel(lambda X, Z: X @ Z.T - 10.0), "positive semi-definite"),
        (FunctionKernel(lambda X, Z: 0.0 * X @ Z.T), "positive semi-definite and not 0"),
        (FunctionKernel(lambda X, Z: X @ Z.T + X[:, :1]), "must be symmetric"),
        (FunctionKernel(lambda X, Z: X @ Z.T / 0.0), "not finite"),
        (FunctionKernel(lambda X, Z: np.exp(X @ Z.T)[:-1]), r"<lambda> must return an array of shape \(7, 7\); it has"),
        (FunctionKernel(polynomial, diagonal=lambda X, bias: X[:, 0] ** 2), "must return the diagonal of k"),
        (FunctionKernel(lambda X, Z: 1.0), r"must return an array of shape \(7, 7\); it has \(\)"),
        (FunctionKernel(lambda X, Z: np.array([[float(x @ z) for z in Z] for x in X])), "cannot be traced by autograd"),
    ],
)
def test_kernels_that_do_not_work_on_the_points_say_why(kernel, message):
    covariance, hyperparameters = parsed(kernel)
    with pytest.raises(ValueError, match=message):
        checked_variance(covariance, hyperparameters, Z)


# --- in an estimator ---------------------------------------------------------------------------------------------

X, X_NEW = np.random.RandomState(0).randn(20, 2), np.random.RandomState(2).randn(15, 2)
NOISE = 0.1 * np.random.RandomState(1).randn(20, 2)
Y = np.column_stack([np.sin(2 * X[:, 0]) + X[:, 1], 5.0 * np.cos(X[:, 1])]) + NOISE
TREES = {
    "matern 1/2": Matern(0.8, nu=0.5),
    "matern 3/2": 2.0 * Matern([0.8, 1.5], nu=1.5),
    "matern 5/2": Matern(0.8, nu=2.5) * 3.0,
    "matern 0.8": Matern(0.8, nu=0.8),
    "matern 3.1": Matern([0.8, 1.1], nu=3.1),
    "matern inf": Matern(0.8, nu=np.inf),
    "rational quadratic": 2.0 * RationalQuadratic(0.8, 0.7),
    "exp sine squared": ExpSineSquared(1.5, 12.0),
    "dot product": DotProduct(0.5),
    "constant": ConstantKernel(2.0),
    "sum with a bias": 2.0 * RBF([0.7, 0.9]) + 0.1,
    "nested": ConstantKernel(4) * (RBF([1, 2]) + 0.5 * DotProduct()) + WhiteKernel(0.02),
    "product": RBF(2.0) * ExpSineSquared(1.0, 10.0) + RationalQuadratic() * DotProduct() + WhiteKernel(0.02),
    "function": ConstantKernel(2.0) * FunctionKernel(smooth) + WhiteKernel(0.02),
    "function and others": FunctionKernel(smooth, {"weight": 0.1}) * Matern() + 0.3,
    **REGISTERED,
}


@pytest.mark.parametrize(("name", "sharing"), [(name, "all" if name in REGISTERED else "none") for name in TREES])
def test_inducing_points_at_all_rows_give_the_exact_gp(name, sharing):
    kernel = TREES[name]
    noise = None if "WhiteKernel" in str(kernel) else 0.02
    offset = np.array([2.0, -1.0])
    model = EVGPRegressor(kernel=kernel, noise=Gaussian(variance=noise), n_inducing=20, max_iter=0, sharing=sharing)
    model.fit(X + offset, Y)
    mean, std = model.predict(X_NEW + offset, return_std=True, include_noise=False)
    _, cov = model.predict(X_NEW + offset, return_cov=True, include_noise=False)
    bound = 0.0
    for o in range(2):
        gpr = GaussianProcessRegressor(model.kernel_[o], alpha=model.noise_variance_[o], optimizer=None)
        gpr.fit(X + offset, Y[:, o])
        exact_mean, exact_cov = gpr.predict(X_NEW + offset, return_cov=True)
        np.testing.assert_allclose(mean[:, o], exact_mean, atol=1e-6)
        np.testing.assert_allclose(std[:, o], np.sqrt(np.diag(exact_cov)), atol=1e-6)
        np.testing.assert_allclose(cov[:, :, o], exact_cov, atol=1e-6)
        bound += gpr.log_marginal_likelihood_value_
    assert model.lower_bound_ == pytest.approx(bound, abs=1e-4)
