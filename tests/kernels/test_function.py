"""A user's own function: as a kernel of scikit-learn, and in a fit."""

import pickle

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.spatial.distance import cdist
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import WhiteKernel

from skevgp import EVGPRegressor
from skevgp.kernels import FunctionKernel
from skevgp.solvers import LBFGS

from .cases import smooth

rng = np.random.RandomState(0)
X, X_NEW = rng.randn(20, 2), rng.randn(15, 2)
Y = np.sin(2 * X[:, 0]) + X[:, 1] + 0.1 * rng.randn(20)


def fitted(kernel, **arguments):
    return EVGPRegressor(kernel=kernel, n_inducing=8, random_state=0, **arguments).fit(X, Y)


def test_a_function_is_a_kernel():
    model, same = fitted(smooth, solver=LBFGS(tol=1.0)), fitted(FunctionKernel(smooth), solver=LBFGS(tol=1.0))
    assert model.kernel_ == same.kernel_
    assert isinstance(model.kernel_.k2, FunctionKernel)
    np.testing.assert_array_equal(model.predict(X_NEW), same.predict(X_NEW))


def test_a_function_kernel_is_a_scikit_learn_kernel():
    kernel = FunctionKernel(smooth, {"weight": 0.2}, {"weight": "fixed"})
    assert repr(kernel) == "FunctionKernel(smooth, lengthscale=1, weight=0.2)"
    assert [(h.name, h.fixed) for h in kernel.hyperparameters] == [("lengthscale", False), ("weight", True)]
    np.testing.assert_allclose(kernel.theta, [0.0])
    np.testing.assert_allclose(np.exp(kernel.bounds), [[1e-5, 1e5]])
    other = clone(kernel).set_params(lengthscale=2.0)
    assert (kernel.get_params()["lengthscale"], other.get_params()["lengthscale"]) == (1.0, 2.0)
    assert other != kernel
    assert clone(other) == other == pickle.loads(pickle.dumps(other))
    assert other.clone_with_theta(kernel.theta) == clone(kernel).set_params(lengthscale=1.0)
    composite = 2.0 * kernel + WhiteKernel()
    assert composite.set_params(k1__k2__lengthscale=3.0).k1.k2.values["lengthscale"] == 3.0
    assert not kernel.is_stationary()
    assert kernel(X, X_NEW).shape == (20, 15)
    np.testing.assert_allclose(kernel.diag(X), np.diag(kernel(X)))


def test_function_kernels_work_in_the_exact_gp():
    kernel = FunctionKernel(smooth, values_bounds={"weight": (0.01, 10.0)})
    _, gradient = kernel(X, eval_gradient=True)
    for index, step in enumerate(1e-6 * np.eye(2)):
        up, down = kernel.clone_with_theta(kernel.theta + step), kernel.clone_with_theta(kernel.theta - step)
        np.testing.assert_allclose(gradient[:, :, index], (up(X) - down(X)) / 2e-6, atol=1e-7)
    kernel = 2.0 * FunctionKernel(smooth, values_bounds={"weight": "fixed"}) + WhiteKernel(0.1)
    gpr = GaussianProcessRegressor(kernel).fit(X, Y)
    start = GaussianProcessRegressor(kernel, optimizer=None).fit(X, Y)
    assert gpr.log_marginal_likelihood_value_ > start.log_marginal_likelihood_value_ + 0.1
    assert FunctionKernel(smooth, values_bounds="fixed")(X, eval_gradient=True)[1].shape == (20, 20, 0)
    with pytest.raises(ValueError, match="only be evaluated when Y is None"):
        FunctionKernel(smooth)(X, X, eval_gradient=True)


def test_a_function_of_the_users_for_the_diagonal_is_used():
    def diagonal(X, lengthscale=1.0, weight=0.5):
        return 1.0 + weight * anp.sum(X**2, axis=1)

    with_it, without = fitted(FunctionKernel(smooth, diagonal=diagonal)), fitted(FunctionKernel(smooth))
    assert with_it.lower_bound_ == pytest.approx(without.lower_bound_, rel=1e-6)

    def wrong(X, **_):
        return 1.0

    with pytest.raises(ValueError, match="wrong must return an array of shape"):
        fitted(FunctionKernel(smooth, diagonal=wrong))


def test_other_defaults_than_floats_are_no_hyperparameters():
    def power(X, Z, degree=2, bias=1.0, name=None):
        return (anp.dot(X, Z.T) + bias) ** degree

    kernel = FunctionKernel(power)
    assert [h.name for h in kernel.hyperparameters] == ["bias"]
    assert fitted(kernel, solver=LBFGS(tol=1.0)).kernel_.k2.function is power


def test_a_function_without_hyperparameters():
    model = fitted(lambda X, Z: anp.exp(-anp.sum((X[:, None] - Z[None]) ** 2, axis=2)), solver=LBFGS(tol=1.0))
    assert repr(model.kernel_.k2) == "FunctionKernel(<lambda>)"
    assert model.n_parameters_ == 2 + 8 * 2 + 8 + 8 * 9 // 2


def test_a_function_that_changes_its_arguments_leaves_the_data_alone():
    def rude(X, Z, lengthscale=1.0):
        X /= 2.0
        Z /= 2.0
        return smooth(X, Z, lengthscale)

    inputs = X.copy()
    model = EVGPRegressor(kernel=rude, n_inducing=8, max_iter=2, random_state=0)
    with pytest.warns(ConvergenceWarning):
        model.fit(inputs, Y).predict(inputs, return_std=True)
    np.testing.assert_array_equal(inputs, X)
    np.testing.assert_array_equal(model.kernel_(inputs), model.kernel_(X.copy()))
    np.testing.assert_array_equal(inputs, X)


def test_a_function_that_is_0_at_a_row():
    inputs = np.arange(10.0).reshape(-1, 1)
    model = EVGPRegressor(kernel=lambda X, Z: X @ Z.T, n_inducing=10, random_state=0).fit(inputs, 3.0 * inputs[:, 0])
    mean, std = model.predict(inputs, return_std=True)
    np.testing.assert_allclose(mean, 3.0 * inputs[:, 0], atol=1e-3)
    assert (std > 0.0).all()


def negative(X, Z, shift=-1.0):
    return X @ Z.T


def taken(X, Z, values=1.0):
    return X @ Z.T


@pytest.mark.parametrize(
    ("kernel", "message"),
    [
        (FunctionKernel(negative), r"Hyperparameters of negative must be positive; got \{'shift': -1.0\}"),
        (FunctionKernel(taken), r"taken needs other names for its hyperparameters \['values'\]"),
        (FunctionKernel(smooth, {"length": 1.0}), r"values names \['length'\]; the hyperparameters of smooth"),
        (FunctionKernel(smooth, values_bounds={"length": (1, 2)}), r"values_bounds names \['length'\]"),
        (FunctionKernel(smooth, {"weight": 0.0}), "must be positive"),
        (FunctionKernel(lambda X, Z: np.exp(-cdist(X, Z))), "<lambda> cannot be traced by autograd: write it with"),
        (FunctionKernel(lambda X, Z: X @ Z.T * np.nan), r"kernel: k\(X, X\) is not finite"),
        (FunctionKernel(lambda X, Z: X), "must return an array of shape"),
    ],
)
def test_functions_that_do_not_work_say_why(kernel, message):
    with pytest.raises(ValueError, match=message):
        fitted(kernel)


def test_the_exact_gp_is_told_of_numbers_that_are_not_finite():
    with pytest.raises(ValueError, match="returned numbers that are not finite"):
        FunctionKernel(lambda X, Z: X @ Z.T * np.nan)(X)


def kinked(X, Z, scale=1.0):
    return anp.exp(-anp.sqrt(anp.sum((X[:, None, :] - Z[None, :, :]) ** 2, axis=2)) / scale)


def test_a_function_without_a_gradient_at_distance_zero_is_named():
    with pytest.raises(ValueError, match=r"gradient is not finite where x = x'"):
        EVGPRegressor(kernel=kinked, n_inducing=5, random_state=0).fit(X, Y)


class Callable:
    def __call__(self, X, Z, scale=1.0):
        return smooth(X, Z, scale)


def test_warm_starts_know_callable_objects_again():
    m = EVGPRegressor(kernel=Callable(), n_inducing=8, warm_start=True, random_state=0).fit(X, Y)
    expected = m.kernel_.theta
    np.testing.assert_allclose(m.set_params(max_iter=0).fit(X, Y).kernel_.theta, expected, rtol=1e-9)


@pytest.mark.parametrize("bounds", [3.0, {"scale": 3.0}, (1.0, 2.0, 3.0)])
def test_bounds_of_a_function_are_pairs(bounds):
    with pytest.raises(ValueError, match="values_bounds"):
        EVGPRegressor(kernel=FunctionKernel(Callable().__call__, values_bounds=bounds)).fit(X, Y)
