"""Likelihoods and bounds as functions of theta, the logarithms of a fitted kernel's free hyperparameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..utils.linalg import NotPositiveDefiniteError
from ..utils.validation import LARGEST, as_floats

# (output, numbers) -> a value, and its gradient in the logarithms of these.
OfKernel = Callable[[int, np.ndarray], tuple[float, np.ndarray]]


def value_at(
    theta: ArrayLike, eval_gradient: bool, order: np.ndarray, fitted: Sequence[np.ndarray], of_kernel: OfKernel
) -> Any:
    """The sum over outputs of what each has at its theta and, if asked for, its gradient, of the shape of theta.

    It is -inf, as in scikit-learn's GaussianProcessRegressor, for a kernel whose matrix cannot be factorised.

    Parameters
    ----------
    theta : array-like of shape (n_theta,) or, for several outputs, (o, n_theta)
    eval_gradient : bool
    order : ndarray of shape (n_theta,)
        Where in the numbers each entry of theta is: `KernelSpec.order`.
    fitted : sequence of ndarray
        Of each output the numbers (k̃'s hyperparameters, s², perhaps σ²), in the user's units: what theta does not have
        stays as it is there.
    of_kernel : callable
        In the user's units.

    Raises
    ------
    ValueError
        If theta has another shape or is out of range.
    """
    n_outputs, thetas = len(fitted), as_floats(theta, "theta")
    shape = (len(order),) if n_outputs == 1 else (n_outputs, len(order))
    if thetas.shape != shape:
        each = "" if n_outputs == 1 else " of each of the kernels"
        raise ValueError(f"theta must be of shape {shape}, as kernel_.theta{each}; got {thetas.shape}.")
    if not (np.abs(thetas) <= np.log(LARGEST)).all():
        raise ValueError(f"theta must be logarithms of numbers from {1 / LARGEST:g} to {LARGEST:g}; got {theta!r}.")
    total, gradient = 0.0, np.zeros((n_outputs, len(order)))
    for o, own in enumerate(fitted):
        numbers = own.copy()
        numbers[order] = np.exp(thetas.reshape(gradient.shape)[o])
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                value, bars = of_kernel(o, numbers)
        except NotPositiveDefiniteError:
            return (-np.inf, np.zeros(shape)) if eval_gradient else -np.inf
        total += value
        gradient[o] = bars[order]
    return (total, gradient.reshape(shape)) if eval_gradient else total
