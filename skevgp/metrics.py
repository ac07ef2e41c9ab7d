"""The paper's metrics of a probabilistic prediction (its section IV-B), and a proper score."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils import check_array, check_consistent_length

__all__ = ["containing_ratios", "negative_log_predictive_density", "prediction_error", "std_norm"]


def _matrix(values: ArrayLike, name: str) -> np.ndarray:
    """(n_samples,) or (n_samples, n_outputs) -> (n_samples, n_outputs)."""
    matrix = check_array(values, ensure_2d=False, dtype=np.float64, input_name=name)
    if matrix.ndim == 1:
        matrix = matrix[:, np.newaxis]
    return matrix


def _matrices(**named: ArrayLike) -> list[np.ndarray]:
    matrices = {name: _matrix(values, name) for name, values in named.items()}
    check_consistent_length(*matrices.values())
    widths = {name: matrix.shape[1] for name, matrix in matrices.items()}
    if len(set(widths.values())) > 1:
        raise ValueError(f"All arguments must have the same number of outputs; got {widths}.")
    return list(matrices.values())


def _positive(std: np.ndarray, name: str) -> np.ndarray:
    if (std < 0).any():
        raise ValueError(f"{name} must not be negative; its smallest value is {std.min()}.")
    return std


def prediction_error(y_true: ArrayLike, y_pred: ArrayLike) -> float:
    """Mean over rows of the Euclidean norm of the error ("Error" in the paper).

    Parameters
    ----------
    y_true, y_pred : array-like of shape (n_samples,) or (n_samples, n_outputs)
        What was observed and what was predicted.

    Returns
    -------
    error : float
        In the units of y.

    Raises
    ------
    ValueError
        If shapes differ or a value is not finite.

    Examples
    --------
    >>> from skevgp.metrics import prediction_error
    >>> prediction_error([[0.0, 0.0], [1.0, 1.0]], [[3.0, 4.0], [1.0, 1.0]])
    2.5
    """
    y_true, y_pred = _matrices(y_true=y_true, y_pred=y_pred)
    return float(np.linalg.norm(y_true - y_pred, axis=1).mean())


def std_norm(std: ArrayLike) -> float:
    """Mean over rows of the Euclidean norm of the predicted standard deviation (‖STD‖ in the paper).

    Parameters
    ----------
    std : array-like of shape (n_samples,) or (n_samples, n_outputs)
        Predicted standard deviations, with noise.

    Returns
    -------
    norm : float
        In the units of y.

    Raises
    ------
    ValueError
        If a value is negative or not finite.

    Examples
    --------
    >>> from skevgp.metrics import std_norm
    >>> std_norm([[3.0, 4.0], [0.0, 1.0]])
    3.0
    """
    return float(np.linalg.norm(_positive(_matrix(std, "std"), "std"), axis=1).mean())


def containing_ratios(
    y_true: ArrayLike, y_pred: ArrayLike, std: ArrayLike, k: Sequence[float] | float = (1, 2, 3)
) -> np.ndarray:
    """Share of the values within k predicted standard deviations (CR-k in the paper).

    For Gaussian errors with the right standard deviation it tends to 0.683, 0.954 and 0.997 at k = 1, 2, 3.

    Parameters
    ----------
    y_true, y_pred, std : array-like of shape (n_samples,) or (n_samples, n_outputs)
        Observations, predicted means and predicted standard deviations (with noise).
    k : float or sequence of float, default=(1, 2, 3)
        Half widths of the interval, in standard deviations, not negative.

    Returns
    -------
    ratios : ndarray of shape (len(k),)
        Shares of all (row, output) pairs with ``|y_true - y_pred| <= k * std``.

    Raises
    ------
    ValueError
        If shapes differ, a value is not finite or a standard deviation is negative.

    Examples
    --------
    >>> from skevgp.metrics import containing_ratios
    >>> containing_ratios([0.5, 1.5, 2.5, 3.5], [0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0])
    array([0.25, 0.5 , 0.75])
    """
    y_true, y_pred, std = _matrices(y_true=y_true, y_pred=y_pred, std=std)
    error, std = np.abs(y_true - y_pred), _positive(std, "std")
    widths = np.atleast_1d(np.asarray(k, dtype=float))
    if not (widths >= 0).all():
        raise ValueError(f"k must be numbers that are not negative; got {k!r}.")
    return np.array([np.mean(error <= width * std) for width in widths])


def negative_log_predictive_density(y_true: ArrayLike, y_pred: ArrayLike, std: ArrayLike) -> float:
    """Mean over rows of -log N(y | mean, std²), summed over outputs: a proper score, lower is better.

    Parameters
    ----------
    y_true, y_pred, std : array-like of shape (n_samples,) or (n_samples, n_outputs)
        Observations, predicted means and predicted standard deviations (with noise, above 0).

    Returns
    -------
    nlpd : float
        In nats per row.

    Raises
    ------
    ValueError
        If shapes differ, a value is not finite or a standard deviation is not above 0.

    Examples
    --------
    >>> from skevgp.metrics import negative_log_predictive_density
    >>> round(negative_log_predictive_density([0.0, 0.0], [0.0, 0.0], [1.0, 1.0]), 4)
    0.9189
    """
    y_true, y_pred, std = _matrices(y_true=y_true, y_pred=y_pred, std=std)
    if (std <= 0).any():
        raise ValueError(f"std must be above 0; its smallest value is {std.min()}.")
    density = 0.5 * np.log(2.0 * np.pi) + np.log(std) + 0.5 * ((y_true - y_pred) / std) ** 2
    return float(density.sum(axis=1).mean())
