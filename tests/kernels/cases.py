"""Kernels to be tested: one or two of each entry of the registry, others by hand; and what tests ask of them."""

import autograd.numpy as anp
import numpy as np
from sklearn.gaussian_process import kernels as sk

from skevgp.kernels import FunctionKernel
from skevgp.kernels.base import READERS
from skevgp.kernels.parse import parse_kernel

_rng = np.random.RandomState(0)
X, Z = _rng.randn(40, 2), _rng.randn(7, 2)
# Of central differences in rows.
STEP_OF_ROWS = 1e-6


def smooth(X, Z, lengthscale=1.0, weight=0.5):
    squared = anp.sum((X[:, None, :] - Z[None, :, :]) ** 2, axis=2)
    return anp.exp(-0.5 * squared / lengthscale**2) * (1.0 + weight * anp.dot(X, Z.T))


def polynomial(X, Z, bias=0.7):
    return (anp.dot(X, Z.T) + bias) ** 2


def polynomial_diagonal(X, bias=0.7):
    return (anp.sum(X**2, axis=1) + bias) ** 2


# Where the constructor's defaults do not do. (With a short period it is a covariance of one column only.)
_ARGUMENTS = {FunctionKernel: {"function": smooth}, sk.ExpSineSquared: {"periodicity": 9.0}}


def _registered():
    """Each kernel of the registry, with one lengthscale and, if it can have them, one per column; no value is 1."""
    for kind in READERS:
        kernel = kind(**_ARGUMENTS.get(kind, {}))
        found = {kind.__name__: kernel}
        if hasattr(kernel, "anisotropic"):
            found[f"{kind.__name__}, ard"] = kind(length_scale=[1.0, 1.0])
        for name, kernel in found.items():
            yield name, kernel.clone_with_theta(kernel.theta + np.linspace(-0.3, 0.4, len(kernel.theta) + 1)[1:])


REGISTERED = dict(_registered())
ROUGH = {"matern 0.3": sk.Matern(1.0, nu=0.3), "matern 1/2": sk.Matern(0.9, nu=0.5), "matern 1": sk.Matern(1.1, nu=1.0)}
SIMPLE = {
    **REGISTERED,
    **ROUGH,
    "matern 0.8": sk.Matern(1.1, nu=0.8),
    "matern 3/2, ard": sk.Matern([0.9, 1.5], nu=1.5),
    "matern 1.9, ard": sk.Matern([1.1, 0.6], nu=1.9),
    "matern 5/2": sk.Matern(0.9, nu=2.5),
    "matern 7.3": sk.Matern(1.1, nu=7.3),
    "matern 60": sk.Matern(1.1, nu=60.0),
    "matern inf": sk.Matern([0.7, 1.1], nu=np.inf),
    "function with diagonal": FunctionKernel(polynomial, diagonal=polynomial_diagonal),
}
COMPOSITE = {
    "sum": sk.RBF([0.8, 1.4]) + sk.Matern(0.9, nu=2.5) + 0.3,
    "product": sk.Matern(1.9, nu=1.5) * sk.DotProduct(0.7) * sk.DotProduct(0.4) * sk.DotProduct(1.1),
    "nested": (sk.RBF([1.0, 2.0]) + 0.5 * sk.DotProduct()) * (sk.RationalQuadratic(0.9, 0.6) + sk.ConstantKernel(0.2)),
    "other order": sk.DotProduct(0.7) * sk.RBF(0.8) + sk.RBF(1.4) * (sk.DotProduct(0.6) + sk.ConstantKernel(0.4)),
    "periodic": sk.RBF(3.0) * sk.ExpSineSquared(1.2, 9.0) + 0.1 * sk.Matern(0.5, nu=0.5) + FunctionKernel(polynomial),
    **{f"with {name}": sk.RBF(2.0) * kernel + sk.DotProduct() * kernel for name, kernel in REGISTERED.items()},
}
KERNELS = {**SIMPLE, **COMPOSITE}


def parsed(kernel, centre=None):
    """k̃ of a kernel that shall not lose its outermost constant, and its hyperparameters."""
    spec = parse_kernel(sk.ConstantKernel() * kernel, 2)
    covariance = spec.covariance if centre is None else spec.covariance.centred(np.asarray(centre, dtype=float))
    return covariance, spec.starts.hyperparameters.value


def scalar(covariance, hyperparameters, points, inputs, bars):
    """Σ bars * (k(X_m, X), k(x, x), k(X_m, X_m))."""
    at, prepared = covariance.at(hyperparameters, points), covariance.prepare(inputs)
    diagonal = np.broadcast_to(at.diagonal(prepared), len(inputs))
    return np.vdot(bars[0], at.cross(prepared)) + bars[1] @ diagonal + np.vdot(bars[2], at.matrix())


def pulled_back(covariance, hyperparameters, points, inputs, bars, n_blocks=2):
    """Gradients of `scalar` in log hyperparameters and points."""
    at = covariance.at(hyperparameters, points)
    total = at.start_pullback()
    for rows in np.array_split(np.arange(len(inputs)), n_blocks):
        prepared = covariance.prepare(inputs[rows])
        total += at.cross_pullback(prepared, at.cross(prepared), bars[0][:, rows].copy(), bars[1][rows])
    return at.finish_pullback(total, bars[2])


def random_bars(m, n, seed=1):
    state = np.random.RandomState(seed)
    symmetric = state.randn(m, m)
    return state.randn(m, n), state.randn(n), symmetric + symmetric.T
