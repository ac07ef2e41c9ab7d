"""Gaussian noise of y and, to first order, of X (McHutchon & Rasmussen 2011, eq. 8)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar

from ..utils.validation import LARGEST, as_floats, check_magnitude
from .base import Noise

# If x is measured as x + η, η ~ N(0, Σ), then y = g(x) + ε is about g(x + η) - ∂g η + ε. As a row at x + η its noise
# variance is σ² + ∂g Σ ∂gᵀ. It depends on the slopes of the learned function, so that fits and slopes alternate.

# Least share of σ² in the mean squared error of an output.
_LEAST = 1e-4
# Smaller variances would be rounded to 0.
_SMALLEST = 1e-290


class Gaussian(Noise):
    """Gaussian noise, for the argument ``noise`` of a regressor.

    Parameters
    ----------
    variance : float, default=None
        Noise variance at the start of a fit, in squared units of y. If None, it is estimated from the data.
    inputs : float or array-like of shape (n_features,) or (n_features, n_features), default=None
        Standard deviations, or the covariance Σ, of noise in X. The noise variance of a row is then σ² + ∂g Σ ∂gᵀ
        (McHutchon & Rasmussen 2011). σ² and ``std`` are those of rows without noise in X. Dask arrays and Adam do not
        support it. See the user guide, :doc:`/guide/noise`.

    Notes
    -----
    With ``inputs``, the variance of a row is averaged over outputs that are fitted together. Fits are repeated until σ²
    changes by less than 5 %, at most five times.

    Examples
    --------
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> from skevgp.noise import Gaussian
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> model = EVGPRegressor(n_inducing=10, noise=Gaussian(inputs=0.05), random_state=0).fit(X, y)
    """

    def __init__(self, variance: float | None = None, inputs: ArrayLike | None = None):
        self.variance = variance
        self.inputs = inputs


def input_covariance(inputs: ArrayLike, n_features: int) -> np.ndarray:
    """Return the covariance (D, D) of the noise of X from ``inputs``; ValueError if that is not valid."""
    values = as_floats(inputs, "inputs of Gaussian")
    d = n_features
    if values.shape not in ((), (d,), (d, d)):
        raise ValueError(
            f"inputs of Gaussian must be a standard deviation, one for each of the n_features={d} columns of X, or a "
            f"covariance of the shape {(d, d)}; got the shape {values.shape}."
        )
    if not np.isfinite(values).all():
        raise ValueError(f"inputs of Gaussian must be finite; it holds {values[~np.isfinite(values)][0]}.")
    check_magnitude(values, "inputs of Gaussian")
    if values.ndim < 2:
        if (values < 0.0).any():
            raise ValueError(
                f"inputs of Gaussian must not be negative; its smallest standard deviation is {values.min()}."
            )
        return np.diag(np.broadcast_to(values, d) ** 2)
    size = np.abs(values).max()
    if np.abs(values - values.T).max() > 1e-8 * size or np.linalg.eigvalsh(values).min() < -1e-8 * size:
        raise ValueError("inputs of Gaussian must be symmetric and positive semi-definite, if it is a covariance.")
    return values


def relative_noise(by_inputs: np.ndarray, own: np.ndarray, chosen: Any) -> np.ndarray:
    """Return (v σ² + ∂g Σ ∂gᵀ) / v σ² of rows and outputs, (n, o): the factor on the noise of the rows."""
    _, variance = row_weights(chosen, len(by_inputs))
    return np.minimum(1.0 + by_inputs / (own * variance[:, np.newaxis]), LARGEST)


def row_weights(chosen: Any, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return how often rows count, and their noise variances v in units of σ², (n,) each."""
    if chosen.counts is None:
        return np.ones(n), np.ones(n)
    return chosen.counts, chosen.counts / chosen.precision


def own_variance(squares: np.ndarray, by_inputs: np.ndarray, counts: np.ndarray, variance: np.ndarray) -> float:
    """Return the most likely σ² of squared errors (n,) with variance v σ² + ∂g Σ ∂gᵀ."""
    whole = float(counts @ (squares / variance) / counts.sum())

    def loss(log_variance: float) -> float:
        each = np.exp(log_variance) * variance + by_inputs
        return float(counts @ (np.log(each) + squares / each) / counts.sum())

    if whole <= _SMALLEST:
        return _SMALLEST
    limits = np.log(max(whole * _LEAST, _SMALLEST)), np.log(whole)
    return float(np.exp(minimize_scalar(loss, bounds=limits, method="bounded").x))
