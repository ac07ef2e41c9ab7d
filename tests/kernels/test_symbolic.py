import numpy as np
import pytest
from sklearn.gaussian_process import kernels as sk

from skevgp.kernels import FunctionKernel

from .cases import KERNELS, X, Z, parsed

ca = pytest.importorskip("casadi")

WITHOUT = {"matern 0.3", "matern 1", "matern 0.8", "matern 1.9, ard", "matern 7.3", "matern 60"}


def has_function(kernel):
    if isinstance(kernel, sk.KernelOperator):
        return has_function(kernel.k1) or has_function(kernel.k2)
    return isinstance(kernel, FunctionKernel)


EXPORTED = {name: kernel for name, kernel in KERNELS.items() if name not in WITHOUT and not has_function(kernel)}
EXPORTED["matern 7/2"] = sk.Matern([0.8, 1.3], nu=3.5)
EXPORTED["matern 21/2"] = sk.Matern(0.8, nu=10.5)
ROUGH = sk.Matern(0.9, nu=0.5)


def symbolic(kernel, points=Z, centre=None):
    """x -> (k̃(X_m, x), k̃(x, x)), and the same in NumPy, row by row."""
    covariance, hyperparameters = parsed(kernel, centre)
    x = ca.MX.sym("x", points.shape[1])
    function = ca.Function("k", [x], list(covariance.expression(hyperparameters, points, x)))
    at = covariance.at(hyperparameters, points)

    def numeric(row):
        prepared = covariance.prepare(row.reshape(1, -1))
        return at.cross(prepared)[:, 0], np.broadcast_to(at.diagonal(prepared), 1)

    return function, numeric


@pytest.mark.parametrize("kernel", [*EXPORTED.values(), ROUGH], ids=[*EXPORTED, "rough"])
def test_derivatives_at_inducing_point(kernel):
    function, numeric = symbolic(kernel)
    x = ca.MX.sym("x", 2)
    cross, _ = function(x)
    derivatives = ca.Function("d", [x], [ca.jacobian(cross, x), ca.hessian(cross[0], x)[0]])
    first, second = (own.full() for own in derivatives(Z[0]))
    np.testing.assert_allclose(function(Z[0])[0].full().ravel(), numeric(Z[0])[0], rtol=1e-12, atol=1e-14)
    assert np.isfinite(first).all()
    assert np.isfinite(second).all()
    h = 1e-5
    sides = [[numeric(Z[0] + sign * h * unit)[0] for unit in np.eye(2)] for sign in (1.0, -1.0)]
    expected = [(up - down) / (2.0 * h) for up, down in zip(*sides, strict=True)]
    # Symmetric differences are right for a kink as well.
    np.testing.assert_allclose(first, np.transpose(expected), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kernel", [sk.RBF(1.0), sk.Matern(1.0, nu=1.5), sk.RationalQuadratic()], ids=repr)
def test_centre_far_away_costs_no_digits(kernel):
    far = np.array([1e8, -3e7])
    function, numeric = symbolic(kernel, Z + far, centre=far)
    row = X[0] + far
    np.testing.assert_allclose(function(row)[0].full().ravel(), numeric(row)[0], rtol=1e-10)


@pytest.mark.parametrize(
    "kernel", [sk.RBF(1.0) + FunctionKernel(lambda X, Z, a=1.0: a * X @ Z.T), FunctionKernel(lambda X, Z: X @ Z.T)]
)
def test_function_kernel_cannot_be_exported(kernel):
    with pytest.raises(ValueError, match=r"The kernel Function\(.*These can be exported: .*\bRBF\b"):
        symbolic(kernel)


@pytest.mark.parametrize("nu", [0.7, 30.5])
def test_matern_with_bessel_functions_cannot_be_exported(nu):
    with pytest.raises(ValueError, match=rf"Matern\(nu={nu}\) cannot be written in CasADi.*half-integer"):
        symbolic(sk.Matern(1.0, nu=nu))
