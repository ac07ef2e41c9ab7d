"""What every covariance must do; a kernel gets here by registering itself."""

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad
from sklearn.gaussian_process import kernels as sk

from skevgp.kernels import FunctionKernel
from skevgp.kernels.base import exported_kernels
from skevgp.kernels.parse import parse_kernel
from skevgp.kernels.waves import random_functions

from ..oracle import central_differences, relative_error
from .cases import KERNELS, REGISTERED, ROUGH, SIMPLE, STEP_OF_ROWS, X, Z, parsed, pulled_back, random_bars, scalar

CENTRE = np.array([0.3, -0.2])
# A covariance of one column, by its distance in any direction.
OF_ONE_COLUMN = {"ExpSineSquared"}


@pytest.mark.parametrize("name", REGISTERED)
def test_hyperparameters_are_the_kernels_in_its_order(name):
    covariance, hyperparameters = parsed(REGISTERED[name])
    assert covariance.n_hyperparameters == len(hyperparameters)
    np.testing.assert_allclose(np.log(hyperparameters), REGISTERED[name].theta)


@pytest.mark.parametrize("centre", [None, CENTRE])
@pytest.mark.parametrize("name", KERNELS)
def test_values_are_those_of_the_scikit_learn_kernel(name, centre):
    kernel = KERNELS[name]
    covariance, hyperparameters = parsed(kernel, centre)
    at, prepared = covariance.at(hyperparameters, Z), covariance.prepare(X)
    close = {"rtol": 1e-12, "atol": 1e-12}
    np.testing.assert_allclose(at.matrix(), kernel(Z), **close)
    np.testing.assert_allclose(at.cross(prepared), kernel(Z, X), **close)
    np.testing.assert_allclose(np.broadcast_to(at.diagonal(prepared), 40), kernel.diag(X), **close)


@pytest.mark.parametrize("centre", [None, CENTRE])
@pytest.mark.parametrize("name", KERNELS)
def test_gradients_agree_with_finite_differences(name, centre):
    covariance, hyperparameters = parsed(KERNELS[name], centre)
    points, bars, p = Z[:4], random_bars(4, 40), len(hyperparameters)

    def value(flat):
        return scalar(covariance, np.exp(flat[:p]), flat[p:].reshape(4, 2), X, bars)

    hyper_bar, Z_bar = pulled_back(covariance, hyperparameters, points, X, bars)
    actual = np.concatenate([hyper_bar, Z_bar.ravel()])
    expected = central_differences(value, np.concatenate([np.log(hyperparameters), points.ravel()]), 1e-5)
    assert np.abs(actual - expected).max() < 1e-7 * max(np.abs(expected).max(), 1.0)


@pytest.mark.parametrize("centre", [None, CENTRE])
@pytest.mark.parametrize("name", KERNELS)
def test_covariances_within_small_sets(name, centre):
    """Their values are those of the scikit-learn kernel, and gradients agree with finite differences."""
    covariance, hyperparameters = parsed(KERNELS[name], centre)
    sets = X[:30].reshape(6, 5, 2)
    values, pull_back = covariance.within(hyperparameters, sets)
    expected = np.array([KERNELS[name](rows) for rows in sets])
    np.testing.assert_allclose(values, expected, rtol=1e-12, atol=1e-12)
    bars = np.random.RandomState(2).randn(6, 5, 5)
    bars += bars.transpose(0, 2, 1)
    differences = central_differences(
        lambda logs: np.vdot(bars, covariance.within(np.exp(logs), sets)[0]), np.log(hyperparameters), 1e-5
    )
    np.testing.assert_allclose(
        pull_back(bars), differences, rtol=1e-6, atol=1e-6 * np.abs(differences).max(initial=1.0)
    )


WITHOUT_DISTANCE = (sk.ConstantKernel, sk.DotProduct, FunctionKernel)


@pytest.mark.parametrize("name", SIMPLE)
def test_near_rows_are_correlated(name):
    """The nearest row in the coordinates of nearness has the largest correlation."""
    covariance, hyperparameters = parsed(SIMPLE[name])
    coordinates = covariance.nearness(hyperparameters, X)
    assert (coordinates.shape[1] == 0) == isinstance(SIMPLE[name], WITHOUT_DISTANCE)
    if coordinates.shape[1] == 0:
        return
    K = SIMPLE[name](X)
    distances = np.linalg.norm(coordinates[0] - coordinates[1:], axis=1)
    assert K[0, 1:][distances.argmin()] == pytest.approx(K[0, 1:].max(), rel=1e-9)


def plain(kernel, A, B, values):
    """The formulas in plain autograd.numpy; takes the hyperparameters off the front of a list."""
    if isinstance(kernel, sk.KernelOperator):
        left, right = plain(kernel.k1, A, B, values), plain(kernel.k2, A, B, values)
        return left + right if isinstance(kernel, sk.Sum) else left * right
    if isinstance(kernel, FunctionKernel):
        own = {hyperparameter.name: values.pop(0) for hyperparameter in kernel.hyperparameters}
        return kernel.function(A, B, **own)
    if isinstance(kernel, sk.ConstantKernel):
        return values.pop(0) * np.ones((len(A), len(B)))
    if isinstance(kernel, sk.DotProduct):
        return values.pop(0) ** 2 + A @ B.T
    own = values.pop(0) if isinstance(kernel, sk.RationalQuadratic | sk.ExpSineSquared) else None
    ard = getattr(kernel, "anisotropic", False)
    lengths = anp.array([values.pop(0) for _ in range(2 if ard else 1)])
    squared = anp.sum(((A[:, None, :] - B[None, :, :]) / lengths) ** 2, axis=2)
    if isinstance(kernel, sk.RationalQuadratic):
        return (1.0 + squared / (2.0 * own)) ** -own
    if isinstance(kernel, sk.ExpSineSquared):
        return anp.exp(-2.0 * (anp.sin(np.pi * anp.sqrt(squared)) / own) ** 2)
    nu = getattr(kernel, "nu", np.inf)
    if nu == np.inf:
        return anp.exp(-0.5 * squared)
    t = anp.sqrt(2.0 * nu * squared)
    return {0.5: 1.0, 1.5: 1.0 + t, 2.5: 1.0 + t + t**2 / 3.0}[nu] * anp.exp(-t)


def written_out(kernel):
    """Whether `plain` knows it."""
    if isinstance(kernel, sk.KernelOperator):
        return written_out(kernel.k1) and written_out(kernel.k2)
    known = sk.RBF | sk.Matern | sk.RationalQuadratic | sk.ExpSineSquared | sk.DotProduct | sk.ConstantKernel
    # A subclass may be another covariance.
    is_known = isinstance(kernel, FunctionKernel) or type(kernel) in known.__args__
    return is_known and getattr(kernel, "nu", 0.5) in (0.5, 1.5, 2.5, np.inf)


@pytest.mark.parametrize("name", [name for name, kernel in KERNELS.items() if written_out(kernel)])
def test_gradients_of_the_rows_agree_with_autograd(name):
    kernel = KERNELS[name]
    covariance, hyperparameters = parsed(kernel, CENTRE)
    cross_bar, p = random_bars(7, 40)[0], len(hyperparameters)

    def value(flat):
        points = flat[p:].reshape(7, 2)
        return anp.sum(cross_bar * plain(kernel, points, X, [anp.exp(flat[i]) for i in range(p)]))

    flat = np.concatenate([np.log(hyperparameters), Z.ravel()])
    hyper_bar, Z_bar = pulled_back(covariance, hyperparameters, Z, X, (cross_bar, np.zeros(40), np.zeros((7, 7))))
    assert relative_error(np.concatenate([hyper_bar, Z_bar.ravel()]), grad(value)(flat)) < 1e-9


STATIONARY = [name for name, kernel in KERNELS.items() if kernel.is_stationary()]


@pytest.mark.parametrize("name", STATIONARY)
def test_covariance_of_differences_keeps_its_digits_far_from_zero(name):
    """Shifted by 1e8, exactly: told of the centre, values and gradients are those near 0."""
    near, hyperparameters = parsed(KERNELS[name])
    shift = np.array([2.0**27, -(2.0**27)])
    far = near.centred(shift)
    points, inputs = np.round(Z * 2**20) / 2**20, np.round(X * 2**20) / 2**20
    bars, close = random_bars(7, 40), {"rtol": 1e-12, "atol": 1e-12}
    one, other = near.at(hyperparameters, points), far.at(hyperparameters, points + shift)
    np.testing.assert_allclose(other.matrix(), one.matrix(), **close)
    np.testing.assert_allclose(other.cross(far.prepare(inputs + shift)), one.cross(near.prepare(inputs)), **close)
    for actual, expected in zip(
        pulled_back(far, hyperparameters, points + shift, inputs + shift, bars),
        pulled_back(near, hyperparameters, points, inputs, bars),
        strict=True,
    ):
        np.testing.assert_allclose(actual, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", SIMPLE)
def test_coincident_points(name):
    """X_m = X with duplicates, far from the origin: k(x, x) keeps its digits and gradients stay finite."""
    inputs = 1e3 * np.vstack([X, X[:5]])
    covariance, hyperparameters = parsed(SIMPLE[name])
    at = covariance.at(hyperparameters, inputs)
    U = at.cross(covariance.prepare(inputs))
    exact = name in ROUGH or name == "matern 0.8"
    np.testing.assert_allclose(U, at.matrix(), rtol=1e-8, atol=1e-12 if exact else 1e-7)
    for gradient in pulled_back(covariance, hyperparameters, inputs, inputs, random_bars(45, 45)):
        assert np.isfinite(gradient).all()


@pytest.mark.parametrize("name", KERNELS)
def test_extreme_hyperparameters_and_distances_are_finite(name):
    """To the corners of scikit-learn's default bounds and well beyond, on inputs of any size, without warnings."""
    covariance, hyperparameters = parsed(KERNELS[name])
    rng = np.random.RandomState(0)
    for inputs_scale in (1e-12, 1.0, 1e12):
        points, inputs = inputs_scale * Z, inputs_scale * np.vstack([X[:6], Z])
        for corner in (-5.0, 5.0, -30.0, 30.0):
            for which in (np.full(len(hyperparameters), True), rng.rand(len(hyperparameters)) < 0.5):
                at_corner = np.where(which, 10.0**corner, hyperparameters)
                at, prepared = covariance.at(at_corner, points), covariance.prepare(inputs)
                assert np.isfinite(at.matrix()).all()
                assert np.isfinite(at.cross(prepared)).all()
                assert np.isfinite(at.diagonal(prepared)).all()
                for gradient in pulled_back(covariance, at_corner, points, inputs, random_bars(7, 13)):
                    assert np.isfinite(gradient).all()


# --- slopes in the rows, by which predictions are differentiated -----------------------------------------------------


def is_smooth(covariance):
    """Whether no part of a covariance has a profile that is rough."""
    parts = getattr(covariance, "parts", ())
    return all(map(is_smooth, parts)) if parts else getattr(covariance, "profile", RBF_PROFILE).smooth


RBF_PROFILE = parsed(sk.RBF())[0].profile
SMOOTH = [name for name in KERNELS if is_smooth(parsed(KERNELS[name])[0])]
NO_GRADIENT = [name for name in KERNELS if name not in SMOOTH]


def differences(function, rows):
    """Central differences of function(rows), (..., n), in each column of its rows: (..., n, d)."""
    each = []
    for column in np.eye(rows.shape[1]):
        step = STEP_OF_ROWS * column
        each.append((function(rows + step) - function(rows - step)) / (2.0 * STEP_OF_ROWS))
    return np.stack(each, axis=-1)


def close(actual, expected, share=1e-7):
    assert actual.shape == expected.shape
    assert np.abs(actual - expected).max() <= share * max(np.abs(expected).max(), 1.0)


@pytest.mark.parametrize("centre", [None, CENTRE])
@pytest.mark.parametrize("name", KERNELS)
def test_slopes_agree_with_differences_of_the_scikit_learn_kernel(name, centre):
    kernel = KERNELS[name]
    covariance, hyperparameters = parsed(kernel, centre)
    at, prepared = covariance.at(hyperparameters, Z), covariance.prepare(X)
    close(at.slopes(prepared), differences(lambda rows: kernel(Z, rows), X))
    diagonal = np.broadcast_to(at.diagonal_slopes(prepared), X.shape)
    close(diagonal, differences(kernel.diag, X))


@pytest.mark.parametrize("centre", [None, CENTRE])
@pytest.mark.parametrize("name", SMOOTH)
def test_mixed_slopes_agree_with_differences_of_slopes(name, centre):
    covariance, hyperparameters = parsed(KERNELS[name], centre)
    actual = covariance.at(hyperparameters, Z).mixed_slopes(covariance.prepare(X))
    for row, own in zip(X[:4], actual, strict=False):
        # ∂k(z, x)/∂x at x = row, as a function of z.
        expected = differences(
            lambda points, x=row: (
                covariance.at(hyperparameters, points).slopes(covariance.prepare(x[np.newaxis]))[:, 0].T
            ),
            row[np.newaxis],
        )[:, 0]
        # Of a function that is differentiable just once, differences across z = x are as good as their step.
        close(own, expected, 1e-2 if "matern 1.9" in name else 1e-4)


@pytest.mark.parametrize("name", NO_GRADIENT)
def test_functions_without_gradient_raise(name):
    covariance, hyperparameters = parsed(KERNELS[name])
    with pytest.raises(ValueError, match="has no gradient. It is as rough as"):
        covariance.at(hyperparameters, Z).mixed_slopes(covariance.prepare(X))


# --- from and to scikit-learn, in CasADi, and as random functions ----------------------------------------------------


@pytest.mark.parametrize("name", KERNELS)
def test_kernel_comes_back_from_its_covariance(name):
    kernel = sk.ConstantKernel(2.0) * KERNELS[name]
    spec = parse_kernel(kernel, 2)
    shape, signal = spec.starts.hyperparameters, spec.starts.signal
    found = spec.to_sklearn(shape.value, shape.bounds, float(signal.value[0]), signal.bounds)
    assert repr(found) == repr(kernel)
    np.testing.assert_array_equal(found.theta, kernel.theta)
    np.testing.assert_array_equal(found.bounds, kernel.bounds)


@pytest.mark.parametrize("name", REGISTERED)
def test_expression_in_casadi_is_the_covariance(name):
    covariance, hyperparameters = parsed(REGISTERED[name], CENTRE)
    casadi = pytest.importorskip("casadi")
    x = casadi.MX.sym("x", 2)
    if type(REGISTERED[name]).__name__ not in exported_kernels():
        with pytest.raises(ValueError, match=r"cannot be written in CasADi. These can be exported: "):
            covariance.expression(hyperparameters, Z, x)
        return
    function = casadi.Function("k", [x], list(covariance.expression(hyperparameters, Z, x)))
    at = covariance.at(hyperparameters, Z)
    for row in X[:5]:
        prepared = covariance.prepare(row[np.newaxis])
        cross, diagonal = (found.full().ravel() for found in function(row))
        np.testing.assert_allclose(cross, at.cross(prepared)[:, 0], rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(diagonal, np.broadcast_to(at.diagonal(prepared), 1), rtol=1e-12)


@pytest.mark.parametrize("name", REGISTERED)
def test_mean_product_of_random_functions_is_the_covariance(name):
    d, size = 1 if name in OF_ONE_COLUMN else 2, 40_000
    rows, kernel = X[:10, :d], REGISTERED[name]
    spec = parse_kernel(sk.ConstantKernel() * kernel, d)
    hyperparameters = spec.starts.hyperparameters.value
    refused = ""
    try:
        Phi = random_functions(spec.covariance, hyperparameters, size, d, np.random.RandomState(1)).value(rows)
    except ValueError as error:
        refused = str(error)
    if refused:
        # A kernel may say that its spectral density is not known, but not those of scikit-learn.
        assert "spectral density is not known" in refused
        assert not type(kernel).__module__.startswith("sklearn")
        return
    expected = kernel(rows)
    # The deviation of a product of two functions is a few times its mean.
    assert np.abs(Phi.T @ Phi - expected).max() < 25.0 / np.sqrt(size) * np.abs(expected).max()
