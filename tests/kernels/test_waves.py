"""Random functions, whose mean product must be the covariance."""

import numpy as np
import pytest
from sklearn.gaussian_process import kernels as sk

from skevgp.kernels import Cosine, FunctionKernel
from skevgp.kernels.parse import parse_kernel
from skevgp.kernels.waves import random_functions

KERNELS = {
    "rbf": sk.RBF([0.8, 1.7]),
    "matern 1/2": sk.Matern(1.2, nu=0.5),
    "matern 3/2": sk.Matern([1.2, 0.7], nu=1.5),
    "matern 5/2": sk.Matern(1.2, nu=2.5),
    "matern 0.8": sk.Matern(1.2, nu=0.8),
    "rational quadratic": sk.RationalQuadratic(1.1, 0.7),
    "dot product": sk.DotProduct(0.6),
    "cosine": Cosine([2.0, 3.0]),
    "sum": sk.RBF(0.8) + 0.4 * sk.DotProduct(0.5) + sk.ConstantKernel(0.3),
    "product": sk.RBF(1.4) * (Cosine(2.0) + sk.DotProduct(0.7)) * sk.ConstantKernel(0.8),
}
SIZE = 40_000
X = np.random.RandomState(0).uniform(-1.5, 1.5, (12, 2))


def drawn(kernel, n_columns=2, size=SIZE, centre=None):
    spec = parse_kernel(sk.ConstantKernel() * kernel, n_columns)
    covariance = spec.covariance if centre is None else spec.covariance.centred(centre)
    hyperparameters = spec.starts.hyperparameters.value
    return random_functions(covariance, hyperparameters, size, n_columns, np.random.RandomState(1))


# Rows are taken from a centre where this is no difference, but in a dot product.
@pytest.mark.parametrize(
    ("name", "centre"),
    [(name, np.array([3.0, -2.0])) for name in KERNELS] + [(name, None) for name in ("dot product", "sum", "product")],
)
def test_their_mean_product_is_the_covariance(name, centre):
    Phi = drawn(KERNELS[name], centre=centre).value(X)
    expected = KERNELS[name](X)
    # The deviation of a product of two functions is a few times its mean; of several factors more.
    assert np.abs(Phi.T @ Phi - expected).max() < 25.0 / np.sqrt(SIZE) * np.abs(expected).max()


@pytest.mark.parametrize(
    ("kernel", "name"),
    [(FunctionKernel(lambda X, Z: X @ Z.T), "Function"), (sk.ExpSineSquared(1.0, 9.0), "ExpSineSquared of 2 columns")],
)
def test_kernels_of_which_none_can_be_drawn_raise(kernel, name):
    with pytest.raises(ValueError, match=f"No functions can be drawn from a kernel with a {name}"):
        drawn(kernel)
    with pytest.raises(ValueError, match="No functions can be drawn"):
        drawn(sk.RBF() * kernel + sk.RBF())
