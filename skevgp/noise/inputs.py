"""Rows whose X is noisy too: to first order, what that adds to the noise of y (McHutchon & Rasmussen 2011, eq. 8).

Where x is measured as x + η, η ~ N(0, Σ), y = g(x) + ε is about g(x + η) - ∂g η + ε: as a row at x + η its noise
variance is σ² + ∂g Σ ∂gᵀ. It depends on the slopes of what is learned, so fits and slopes take turns.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar

from ..fitting.fitted import FittedOutputs
from ..model.predictor import Predictor
from ..utils.monitor import Monitor
from ..utils.validation import LARGEST, as_floats, check_magnitude, is_frame

# Fits and slopes take turns until no output's σ² moves by more than this share, or so often.
_SETTLED, _TURNS = 0.05, 5
# Of an output's mean squared error, what at least is its own.
_LEAST = 1e-4
# Variances below are rounded to 0 somewhere.
_SMALLEST = 1e-290
# Rows whose slopes are found at once.
_ROWS_AT_ONCE = 256


class Model(Protocol):
    """A fitted estimator with explicit features."""

    _predictor: Predictor

    def compile(self, include_noise: bool) -> Any: ...

    def _numbers(self, X: Any, *y: Any, reset: bool) -> tuple[np.ndarray, np.ndarray]: ...

    def _inputs_and_features(self, given: Any, X: Any, rows: slice | np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...


def input_covariance(input_noise: ArrayLike, n_features: int) -> np.ndarray:
    """The covariance (D, D) of X's noise, from standard deviations or as it is.

    Raises
    ------
    ValueError
        If it is of another shape, not finite, negative, or no covariance.
    """
    values = as_floats(input_noise, "input_noise")
    d = n_features
    if values.shape not in ((), (d,), (d, d)):
        raise ValueError(
            f"input_noise must be a standard deviation, one for each of the n_features={d} columns of X, or a "
            f"covariance of the shape {(d, d)}; got the shape {values.shape}."
        )
    if not np.isfinite(values).all():
        raise ValueError(f"input_noise must be finite; it holds {values[~np.isfinite(values)][0]}.")
    check_magnitude(values, "input_noise")
    if values.ndim < 2:
        if (values < 0.0).any():
            raise ValueError(f"input_noise must not be negative; its smallest standard deviation is {values.min()}.")
        return np.diag(np.broadcast_to(values, d) ** 2)
    size = np.abs(values).max()
    if np.abs(values - values.T).max() > 1e-8 * size or np.linalg.eigvalsh(values).min() < -1e-8 * size:
        raise ValueError("input_noise must be symmetric and positive semi-definite, if it is a covariance.")
    return values


def variance_by_inputs(model: Model, given: Any, X: Any, chosen: Any, covariance: np.ndarray) -> np.ndarray:
    """∂g Σ ∂gᵀ of each row that counts and each output, (n, o), in the order of the source."""
    return _looked_at(model, given, X, None, chosen, covariance)[0]


def _looked_at(
    model: Model, given: Any, X: Any, y: np.ndarray | None, chosen: Any, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The same, and E(y - g)² (n, o)."""
    fast = model.compile(include_noise=False)
    try:
        rows = model._numbers(given, reset=False)[0] if is_frame(given) else X
    except ValueError as error:
        raise ValueError("input_noise needs an X of numbers, none of them missing: others have no slopes.") from error
    # Where y is what was added to columns of X, their noise is in y too.
    base = getattr(model, "_columns_changed", None)
    positions = np.arange(len(rows)) if chosen.positions is None else chosen.positions
    variances, squares = [], []
    for first in range(0, len(positions), _ROWS_AT_ONCE):
        own = positions[first : first + _ROWS_AT_ONCE]
        some = np.asarray(rows[own], dtype=np.float64)
        # A map that goes wrong only now is named; what is compiled checks nothing.
        model._inputs_and_features(given, rows, own)
        slopes = fast.value_and_jacobian(some)[1].reshape(len(some), -1, some.shape[1])
        if base is not None:
            slopes[:, np.arange(len(base)), base] += 1.0
        variances.append(np.einsum("noi,ij,noj->no", slopes, covariance, slopes, optimize=True))
        if y is not None:
            mean, std = (part.reshape(len(some), -1) for part in fast.predict(some, return_std=True))
            squares.append((y[own].reshape(mean.shape) - mean) ** 2 + std**2)
    return np.concatenate(variances), np.concatenate(squares) if squares else np.empty((0, 0))


def relative_noise(by_inputs: np.ndarray, own: np.ndarray, chosen: Any) -> np.ndarray:
    """(v σ² + ∂g Σ ∂gᵀ) / v σ² of rows and outputs, (n, o): what multiplies the noise that rows have anyway."""
    _, variance = _weights(chosen, len(by_inputs))
    return np.minimum(1.0 + by_inputs / (own * variance[:, np.newaxis]), LARGEST)


def _weights(chosen: Any, n: int) -> tuple[np.ndarray, np.ndarray]:
    """How often rows count, and their noise variances v in units of σ², (n,) each."""
    if chosen.counts is None:
        return np.ones(n), np.ones(n)
    return chosen.counts, chosen.counts / chosen.precision


def _own_variance(squares: np.ndarray, by_inputs: np.ndarray, counts: np.ndarray, variance: np.ndarray) -> float:
    """The σ² under which squared errors (n,) of variance v σ² + ∂g Σ ∂gᵀ are most likely."""
    whole = float(counts @ (squares / variance) / counts.sum())

    def loss(log_variance: float) -> float:
        each = np.exp(log_variance) * variance + by_inputs
        return float(counts @ (np.log(each) + squares / each) / counts.sum())

    if whole <= _SMALLEST:
        return _SMALLEST
    limits = np.log(max(whole * _LEAST, _SMALLEST)), np.log(whole)
    return float(np.exp(minimize_scalar(loss, bounds=limits, method="bounded").x))


def fit_to_noisy_inputs(
    model: Model,
    fitted: FittedOutputs,
    data: tuple[Any, Any, np.ndarray, Any],
    covariance: np.ndarray,
    refit: Callable[[np.ndarray, FittedOutputs], FittedOutputs],
    monitor: Monitor,
) -> FittedOutputs:
    """Fits whose rows are as noisy as their inputs make them.

    Parameters
    ----------
    model : estimator
        With its maps; its predictor is set on the way.
    fitted : FittedOutputs
        As if inputs were exact.
    data : tuple
        Of the fit: what the maps see, X, y, and the rows that count.
    covariance : ndarray of shape (D, D)
        `input_covariance`.
    refit : callable
        (noise variances (n, o) of rows in units of σ², the fit to go on from) -> a fit.
    monitor : Monitor
    """
    given, X, y, chosen = data
    before = None
    for _ in range(_TURNS):
        model._predictor = fitted.predictor()
        by_inputs, squares = _looked_at(model, given, X, y, chosen, covariance)
        weights = _weights(chosen, len(by_inputs))
        each = zip(squares.T, by_inputs.T, strict=True)
        own = np.array([_own_variance(*of_output, *weights) for of_output in each])
        if before is not None and (np.abs(np.log(own / before)) < _SETTLED).all():
            break
        before = own
        fitted = refit(relative_noise(by_inputs, own, chosen), fitted)
        if monitor.stopped or monitor.out_of_time:
            break
    return fitted
