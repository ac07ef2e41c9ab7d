"""A user's own function: as a kernel of scikit-learn, and in a fit."""

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from skevgp import EVGPRegressor
from skevgp.kernels import FunctionKernel
from skevgp.kernels.parse import parse_kernel
from skevgp.solvers import LBFGS

from .cases import smooth

rng = np.random.RandomState(0)
X, X_NEW = rng.randn(20, 2), rng.randn(15, 2)
Y = np.sin(2 * X[:, 0]) + X[:, 1] + 0.1 * rng.randn(20)


def fitted(kernel, **arguments):
    return EVGPRegressor(kernel=kernel, n_inducing=8, random_state=0, **arguments).fit(X, Y)


def test_function_of_the_users_for_the_diagonal_is_used():
    def diagonal(X, lengthscale=1.0, weight=0.5):
        return 1.0 + weight * anp.sum(X**2, axis=1)

    rough = {"solver": LBFGS(tol=1.0), "noise_cv": None}
    with_it = fitted(FunctionKernel(smooth, diagonal=diagonal), **rough)
    without = fitted(FunctionKernel(smooth), **rough)
    assert with_it.lower_bound_ == pytest.approx(without.lower_bound_, rel=1e-6)

    def wrong(X, **_):
        return 1.0

    with pytest.raises(ValueError, match="wrong must return an array of shape"):
        fitted(FunctionKernel(smooth, diagonal=wrong))


def test_function_without_hyperparameters():
    model = fitted(lambda X, Z: anp.exp(-anp.sum((X[:, None] - Z[None]) ** 2, axis=2)), solver=LBFGS(tol=1.0))
    assert repr(model.kernel_.k2) == "FunctionKernel(<lambda>)"
    assert model.n_parameters_ == 2 + 8 * 2 + 8 + 8 * 9 // 2


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
        (FunctionKernel(smooth, values_bounds=(1.0, 2.0, 3.0)), "values_bounds must be two numbers, the lower first"),
        (
            FunctionKernel(smooth, values_bounds={"lengthscale": (1, 2, 3)}),
            "values_bounds of 'lengthscale' must be two",
        ),
        (FunctionKernel(smooth, {"weight": 0.0}), "must be positive"),
        (FunctionKernel(lambda X, Z: np.exp(-cdist(X, Z))), "<lambda> cannot be traced by autograd. Write it with"),
        (FunctionKernel(lambda X, Z: X @ Z.T * np.nan), r"kernel: k\(X, X\) is not finite"),
        (FunctionKernel(lambda X, Z: X), "must return an array of shape"),
    ],
)
def test_functions_that_do_not_work_say_why(kernel, message):
    with pytest.raises(ValueError, match=message):
        fitted(kernel)


def test_exact_gp_is_told_of_numbers_that_are_not_finite():
    with pytest.raises(ValueError, match="returned numbers that are not finite"):
        FunctionKernel(lambda X, Z: X @ Z.T * np.nan)(X)


def kinked(X, Z, scale=1.0):
    return anp.exp(-anp.sqrt(anp.sum((X[:, None, :] - Z[None, :, :]) ** 2, axis=2)) / scale)


def test_function_without_a_gradient_at_distance_zero_raises():
    with pytest.raises(ValueError, match=r"gradient is not finite where x = x'"):
        EVGPRegressor(kernel=kinked, n_inducing=5, random_state=0).fit(X, Y)


def test_function_that_autograd_knows_no_forward_derivative_of_raises():
    def traced_backwards_only(X, Z):
        import autograd.numpy as anp
        from autograd.extend import defvjp, primitive

        square = primitive(lambda x: x**2)
        defvjp(square, lambda value, x: lambda bar: 2.0 * x * bar)
        return anp.exp(-0.5 * anp.sum(square(X[:, None] - Z[None]), axis=2))

    covariance = parse_kernel(traced_backwards_only, 2).covariance
    at = covariance.at(np.empty(0), X_NEW)
    with pytest.raises(ValueError, match="cannot be traced by autograd"):
        at.slopes(covariance.prepare(X))
