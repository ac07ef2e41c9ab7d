"""Fits with noise in the inputs: fits, and estimates of the slopes of the function, alternate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..control.posterior import Posterior
from ..data.dataset import Dataset
from ..noise.gaussian import own_variance, relative_noise, row_weights
from ..utils.monitor import Monitor
from .fitted import Fitted

# Fits and slopes alternate until no output's σ² changes by more than this share, or so many times.
_SETTLED, _TURNS = 0.05, 5
# Relative noise variances are computed with a σ² of at least this share of the mean variance from the inputs. For a
# function without noise, σ² is almost 0, and they would be almost infinite.
_LEAST_SHARE = 1e-3
# Number of rows whose slopes are computed at once.
_ROWS_AT_ONCE = 256


def fit_to_noisy_inputs(
    fitted: Fitted,
    data: Dataset,
    posterior_of: Callable[[Fitted], Posterior],
    numbers: np.ndarray,
    covariance: np.ndarray,
    refit: Callable[[np.ndarray, Fitted], Fitted],
    monitor: Monitor,
    base: np.ndarray | None = None,
) -> Fitted:
    """Repeat a fit, which first had exact inputs, until the noise variances converge.

    ``numbers`` is X as an array, and ``covariance`` (D, D) is that of its noise. ``refit`` takes noise variances (n, o)
    of the rows in units of σ², and the fit to continue. If ``base`` is given, y was a difference to these columns of X.
    """
    before, weights = None, row_weights(data.chosen, data.source.n_rows)
    for _ in range(_TURNS):
        by_inputs, squares = look_at_slopes(posterior_of(fitted), data, numbers, covariance, base)
        outputs = zip(squares.T, by_inputs.T, strict=True)
        noise = np.array([own_variance(*of_output, *weights) for of_output in outputs])
        if before is not None and (np.abs(np.log(noise / before)) < _SETTLED).all():
            break
        before = noise
        least = _LEAST_SHARE * np.average(by_inputs, axis=0, weights=weights[0])
        fitted = refit(relative_noise(by_inputs, np.maximum(noise, least), data.chosen), fitted)
        if monitor.stopped or monitor.out_of_time:
            break
    return fitted


def look_at_slopes(
    posterior: Posterior, data: Dataset, numbers: np.ndarray, covariance: np.ndarray, base: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """∂g Σ ∂gᵀ and E(y - g)² of each row that counts and each output, both (n, o), in the order of the source."""
    fast, chosen = posterior.compile(include_noise=False), data.chosen
    positions = np.arange(len(numbers)) if chosen.positions is None else chosen.positions
    variances, squares = [], []
    for first in range(0, len(positions), _ROWS_AT_ONCE):
        indices = positions[first : first + _ROWS_AT_ONCE]
        X = np.asarray(numbers[indices], dtype=np.float64)
        # The maps are checked here, because the compiled posterior checks nothing.
        posterior.maps.rows(data.given, numbers, indices)
        slopes: Any = fast.value_and_jacobian(X)[1].reshape(len(X), -1, X.shape[1])
        if base is not None:
            # If y is a difference to columns of X, the noise of these is in y too.
            slopes[:, np.arange(len(base)), base] += 1.0
        variances.append(np.einsum("noi,ij,noj->no", slopes, covariance, slopes, optimize=True))
        mean, std = (part.reshape(len(X), -1) for part in fast.predict(X, return_std=True))
        squares.append((data.y[indices].reshape(mean.shape) - mean) ** 2 + std**2)
    return np.concatenate(variances), np.concatenate(squares)
