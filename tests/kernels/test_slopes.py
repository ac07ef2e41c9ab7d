"""Derivatives of covariances in the rows, by which predictions are differentiated."""

import numpy as np
import pytest

from skevgp.kernels.parse import parse_kernel

from .cases import KERNELS, ROUGH, STEP_OF_ROWS, X, Z, parsed

CENTRE = np.array([0.3, -0.2])
# Nowhere differentiable, or with parts that are not.
NO_GRADIENT = [name for name in KERNELS if name in {*ROUGH, "matern 0.8", "periodic"}]
SMOOTH = [name for name in KERNELS if name not in NO_GRADIENT]


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
    for row, own in zip(X[:10], actual, strict=False):
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
def test_functions_that_have_no_gradient_are_named(name):
    covariance, hyperparameters = parsed(KERNELS[name])
    with pytest.raises(ValueError, match="Matern kernel with nu up to 1 has no gradient"):
        covariance.at(hyperparameters, Z).mixed_slopes(covariance.prepare(X))


@pytest.mark.parametrize("name", KERNELS)
def test_slopes_at_the_points_themselves_are_finite(name):
    covariance, hyperparameters = parsed(KERNELS[name])
    slopes = covariance.at(hyperparameters, X).slopes(covariance.prepare(np.vstack([X, 1e3 * X])))
    assert np.isfinite(slopes).all()


def test_a_function_that_autograd_knows_no_forward_derivative_of_is_named():
    def traced_backwards_only(X, Z):
        import autograd.numpy as anp
        from autograd.extend import defvjp, primitive

        square = primitive(lambda x: x**2)
        defvjp(square, lambda value, x: lambda bar: 2.0 * x * bar)
        return anp.exp(-0.5 * anp.sum(square(X[:, None] - Z[None]), axis=2))

    covariance = parse_kernel(traced_backwards_only, 2).covariance
    at = covariance.at(np.empty(0), Z)
    with pytest.raises(ValueError, match="cannot be traced by autograd"):
        at.slopes(covariance.prepare(X))
