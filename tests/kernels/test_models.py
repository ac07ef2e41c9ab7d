"""Kernels at work: in the bounds, and in a fit from scikit-learn's tree back to it."""

import pickle
import warnings

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning
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
from skevgp.data.blocks import Batch
from skevgp.fitting.start import checked_variance
from skevgp.kernels import FunctionKernel
from skevgp.kernels.parse import Start, Starts, parse_kernel
from skevgp.model.model import SparseModel
from skevgp.model.objectives import BoundObjective, ElboObjective
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS

from ..oracle import central_differences, problem, relative_error, table_of
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
    size = covariance.n_hyperparameters
    table = table_of(rows.inputs, points, starts, np.ones(2), size, mean_variance=variance)
    return SparseModel(covariance, model.prior, "full", model.groups), rows, table


@pytest.mark.parametrize(
    ("name", "shared"),
    # The gradient of a constant alone is nothing but that of the jitter.
    [*((name, True) for name in KERNELS if name != "ConstantKernel"), ("matern 5/2", False), ("nested", False)],
)
def test_gradient_of_the_bound_agrees_with_finite_differences(name, shared):
    """Σ k(x, x) enters the bound too."""
    model, rows, table = model_with(KERNELS[name], shared=shared)
    objective = BoundObjective(model, table, rows.blocks(model.kernel, 17))
    _, gradient = objective(table.start())
    assert relative_error(gradient, central_differences(lambda x: objective(x)[0], table.start(), 1e-5)) < 1e-5


@pytest.mark.parametrize("name", ["matern 5/2", "nested", "FunctionKernel"])
def test_gradient_of_the_papers_loss_agrees_with_finite_differences(name):
    model, rows, table = model_with(KERNELS[name], n=30, m=4, p=2)
    elbo = ElboObjective(model, table, rows.blocks(model.kernel, 30))
    block = rows.blocks(model.kernel, 30)[0]
    objective = elbo.minibatch(iter([Batch(block)] * 1000))
    x = elbo.table.start() + 0.1 * np.random.RandomState(1).randn(elbo.table.size)
    _, gradient = objective(x)
    assert relative_error(gradient, central_differences(lambda x: objective(x)[0], x, 1e-5)) < 1e-5


def test_the_value_of_a_bound_that_depends_on_the_diagonal():
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
        (FunctionKernel(polynomial, diagonal=lambda X, bias: X[:, 0] ** 2), "does not return the k"),
        (FunctionKernel(lambda X, Z: 1.0), r"must return an array of shape \(7, 7\); it has \(\)"),
        (FunctionKernel(lambda X, Z: np.array([[float(x @ z) for z in Z] for x in X])), "cannot be traced by autograd"),
    ],
)
def test_kernels_that_do_not_work_on_the_points_say_why(kernel, message):
    covariance, hyperparameters = parsed(kernel)
    with pytest.raises(ValueError, match=message):
        checked_variance(covariance, np.exp(hyperparameters), Z)


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


def fitted(kernel, **arguments):
    y = np.sin(2 * X[:, 0]) + NOISE[:, 0]
    return EVGPRegressor(kernel=kernel, n_inducing=8, random_state=0, **arguments).fit(X, y)


@pytest.mark.parametrize("sharing", ["all", "none"])
@pytest.mark.parametrize("name", TREES)
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


@pytest.mark.long
# Some hyperparameters may end at their limit, and the user is told.
@pytest.mark.filterwarnings("ignore:The optimal value found")
@pytest.mark.parametrize("name", TREES)
def test_a_fit_gains_and_comes_back_as_the_same_tree(name):
    kernel = TREES[name]
    start, end = (fitted(kernel, max_iter=n, solver=LBFGS(tol=1.0)) for n in (0, None))
    assert end.lower_bound_ > start.lower_bound_
    assert np.isfinite(end.predict(X_NEW, return_std=True)).all()
    tree = parse_kernel(kernel, 2).tree
    assert [(h.name, h.n_elements) for h in end.kernel_.hyperparameters] == [
        (h.name, h.n_elements) for h in tree.hyperparameters
    ]
    spec = parse_kernel(kernel, 2)
    if spec.starts.signal.value is not None:
        np.testing.assert_array_equal(end.kernel_.bounds, tree.bounds)
        np.testing.assert_allclose(start.kernel_.theta, tree.theta)
    again = fitted(end.kernel_ + WhiteKernel(end.noise_variance_, "fixed"), max_iter=0)
    np.testing.assert_allclose(again.kernel_.theta, end.kernel_.theta, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["matern 5/2", "nested", "function"])
def test_adam_serves_other_kernels(name):
    start, end = (fitted(TREES[name], solver="adam", max_iter=n) for n in (0, 60))
    assert end.lower_bound_ > start.lower_bound_


@pytest.mark.parametrize("name", ["matern 1/2", "nested", "function"])
def test_samples_follow_the_covariance(name):
    model = fitted(TREES[name], max_iter=0)
    mean, cov = model.predict(X_NEW, return_cov=True)
    samples = model.sample_y(X_NEW, 4000)
    np.testing.assert_allclose(samples.mean(axis=1), mean, atol=0.1 * np.sqrt(cov.max()))
    np.testing.assert_allclose(np.cov(samples), cov, atol=0.15 * cov.max())


@pytest.mark.parametrize("name", ["matern 5/2", "nested", "function"])
def test_partial_fit_and_pickles_keep_other_kernels(name):
    kernel, y = TREES[name], Y[:, 0]
    noise = None if "WhiteKernel" in str(kernel) else 0.02
    arguments = {"kernel": kernel, "noise": Gaussian(variance=noise), "n_inducing": 12, "max_iter": 0}
    # Distinct rows, no more than inducing points: those are the points; the units of y are those of the first rows.
    model = EVGPRegressor(**arguments).fit(X[:12] + 1.0, y[:12])
    model.partial_fit(X[12:] + 1.0, y[12:])
    model = pickle.loads(pickle.dumps(model))
    Z, k = X[:12] + 1.0, model.kernel_
    V = np.linalg.solve(np.linalg.cholesky(k(Z) + 1e-12 * np.diag(k.diag(Z))), k(Z, np.vstack([X, X_NEW]) + 1.0))
    B = np.eye(12) + V[:, :20] @ V[:, :20].T / model.noise_variance_
    expected = V[:, 20:].T @ np.linalg.solve(B, V[:, :20] @ y) / model.noise_variance_
    np.testing.assert_allclose(model.predict(X_NEW + 1.0), expected, atol=1e-6)


def test_a_signal_variance_that_is_not_given_matches_the_scatter():
    """s² Σ k̃(x, x) / n is the mean square of y, however large k̃ is."""
    y = 100.0 * Y[:, 0]
    for kernel in (RBF(), DotProduct(30.0), RBF() + 0.001 * DotProduct(), FunctionKernel(smooth)):
        model = EVGPRegressor(kernel=kernel, n_inducing=20, max_iter=0).fit(X, y)
        assert np.mean(model.kernel_.diag(X)) == pytest.approx(np.mean(y**2), rel=1e-6)
        low, high = np.exp(model.kernel_.bounds[0])
        assert low == pytest.approx(1e-8 * model.kernel_.k1.constant_value)
        assert high == pytest.approx(1e4 * model.kernel_.k1.constant_value)


# One of them ends at its limit, and the user is told.
@pytest.mark.filterwarnings("ignore:The optimal value found")
def test_single_hyperparameters_can_be_fixed():
    kernel = 2.0 * (
        RBF([0.5, 1.0], "fixed") + ConstantKernel(0.5) * RationalQuadratic(1.5, 0.7, "fixed", (0.1, 5.0))
    ) + WhiteKernel(0.1)
    model = fitted(kernel, solver=LBFGS(tol=1.0))
    rbf, scaled = model.kernel_.k2.k1, model.kernel_.k2.k2
    assert rbf == RBF([0.5, 1.0], "fixed")
    assert scaled.k2.length_scale == 1.5
    assert scaled.k2.length_scale_bounds == "fixed"
    assert scaled.k2.alpha != 0.7
    assert scaled.k2.alpha_bounds == (0.1, 5.0)
    assert scaled.k1.constant_value != 0.5
    # The constant of the sum, alpha, signal variance and noise; then inducing points and q.
    assert model.n_parameters_ == 2 + 2 + 8 * 2 + 8 + 8 * 9 // 2
    assert fitted(kernel, solver="adam", max_iter=3).kernel_.k2.k1 == rbf


def test_a_warm_start_takes_over_hyperparameters_of_the_same_kernel_only():
    y = Y[:, 0]
    model = EVGPRegressor(
        kernel=RBF([1.0, 1.0]), n_inducing=8, random_state=0, solver=LBFGS(tol=1.0), warm_start=True
    ).fit(X, y)
    learned = model.kernel_.k2.length_scale
    model.set_params(max_iter=0).fit(X, y)
    np.testing.assert_allclose(model.kernel_.k2.length_scale, learned)
    model.set_params(kernel=RationalQuadratic(0.9, 0.7)).fit(X, y)
    assert model.kernel_.k2 == RationalQuadratic(0.9, 0.7)
    model.set_params(kernel=FunctionKernel(smooth)).fit(X, y)
    assert model.kernel_.k2.get_params()["lengthscale"] == pytest.approx(1.0)


@pytest.mark.long
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("name", TREES)
def test_nasty_data_are_fitted(name, scale):
    """Duplicates, a constant column, targets without noise and of any size: no error, no NaN."""
    inputs = np.column_stack([np.repeat(X[:10, 0], 3), np.full(30, 0.3)])
    y = scale * np.round(np.sin(3 * inputs[:, 0]), 2)
    kernel = TREES[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = EVGPRegressor(kernel=kernel, n_inducing=15, max_iter=30, random_state=0).fit(inputs, y)
    mean, std = model.predict(inputs, return_std=True)
    assert np.isfinite(mean).all()
    assert (std > 0.0).all()
