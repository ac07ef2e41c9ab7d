"""Metrics of probabilistic predictions (section IV-B of the paper), proper scores, calibration and scorers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr
from sklearn.utils import check_array, check_consistent_length

from .utils.scorers import make_std_scorer
from .utils.validation import as_floats

__all__ = [
    "calibration_error",
    "containing_ratios",
    "crps",
    "interval_levels",
    "make_std_scorer",
    "neg_calibration_error",
    "neg_crps",
    "neg_nlpd",
    "negative_log_predictive_density",
    "prediction_error",
    "std_norm",
]


def _matrix(values: ArrayLike, name: str) -> np.ndarray:
    """Return values as an array (n_samples, n_outputs)."""
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
    """Return the mean over rows of the Euclidean norm of the error ("Error" in the paper).

    Parameters
    ----------
    y_true, y_pred : array-like of shape (n_samples,) or (n_samples, n_outputs)
        Observations and predicted means.

    Returns
    -------
    error : float
        Error in units of y.

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
    """Return the mean over rows of the Euclidean norm of the predicted std (‖STD‖ in the paper).

    Parameters
    ----------
    std : array-like of shape (n_samples,) or (n_samples, n_outputs)
        Predicted standard deviations, with noise.

    Returns
    -------
    norm : float
        Norm in units of y.

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
    """Return the share of the values within k predicted standard deviations (CR-k in the paper).

    For Gaussian errors with a correct standard deviation, the share tends to 0.683, 0.954 and 0.997 at k = 1, 2, 3.

    Parameters
    ----------
    y_true, y_pred, std : array-like of shape (n_samples,) or (n_samples, n_outputs)
        Observations, predicted means and predicted standard deviations (with noise).
    k : float or sequence of float, default=(1, 2, 3)
        Half width of the interval in standard deviations, at least 0.

    Returns
    -------
    ratios : ndarray of shape (len(k),)
        Share of all (row, output) pairs with ``|y_true - y_pred| <= k * std``.

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
    widths = np.atleast_1d(as_floats(k, "k"))
    if not (widths >= 0).all():
        raise ValueError(f"k must be numbers that are not negative; got {k!r}.")
    return np.array([np.mean(error <= width * std) for width in widths])


def negative_log_predictive_density(y_true: ArrayLike, y_pred: ArrayLike, std: ArrayLike) -> float:
    """Return the mean over rows of -log N(y | mean, std²), summed over outputs.

    It is a proper score, and lower is better.

    Parameters
    ----------
    y_true, y_pred, std : array-like of shape (n_samples,) or (n_samples, n_outputs)
        Observations, predicted means and predicted standard deviations (with noise, above 0).

    Returns
    -------
    nlpd : float
        Score in nats per row.

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


def crps(y_true: ArrayLike, y_pred: ArrayLike, std: ArrayLike) -> float:
    r"""Return the continuous ranked probability score of N(mean, std²): mean over rows, summed over outputs.

    It is a proper score, and lower is better. Compared with `negative_log_predictive_density`, it is in units of y and
    less sensitive to outliers. With z = (y - mean) / std, the score is (Gneiting & Raftery 2007, section 4.2)

    .. math:: \int (F(x) - 1_{x \geq y})^2 dx = \sigma \, [z (2 \Phi(z) - 1) + 2 \varphi(z) - 1 / \sqrt{\pi}].

    It is the absolute error if the standard deviation is 0.

    Parameters
    ----------
    y_true, y_pred, std : array-like of shape (n_samples,) or (n_samples, n_outputs)
        Observations, predicted means and predicted standard deviations (with noise).

    Returns
    -------
    score : float
        Score in units of y, at least 0.

    Raises
    ------
    ValueError
        If shapes differ, a value is not finite or a standard deviation is negative.

    References
    ----------
    - T. Gneiting, A. E. Raftery (2007): Strictly Proper Scoring Rules, Prediction, and Estimation.

    Examples
    --------
    >>> from skevgp.metrics import crps
    >>> round(crps([0.0, 1.0], [0.0, 0.0], [1.0, 0.0]), 4)
    0.6168
    """
    y_true, y_pred, std = _matrices(y_true=y_true, y_pred=y_pred, std=std)
    error, std = np.abs(y_true - y_pred), _positive(std, "std")
    with np.errstate(over="ignore"):
        z = np.divide(error, std, out=np.full_like(error, np.inf), where=std > 0)
        density = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    score = error * (2.0 * ndtr(z) - 1.0) + std * (2.0 * density - 1.0 / np.sqrt(np.pi))
    return float(score.sum(axis=1).mean())


def calibration_error(y_true: ArrayLike, y_pred: ArrayLike, std: ArrayLike) -> float:
    r"""Return the mean absolute difference between the coverage of central intervals and their probability.

    Let :math:`\hat c(p)` be the share of values inside the central interval of probability p of N(mean, std²). The
    error is the area between this reliability curve and the diagonal,

    .. math:: \int_0^1 |\hat c(p) - p| \, dp.

    The integral is exact, without bins. Tran et al. (2020) call it the mean absolute calibration error. The best value
    is 0, and the worst is 0.5. For n independent calibrated values it is about 0.3 / sqrt(n). Wide intervals without
    information can be calibrated too, so use it together with a proper score such as `crps`.

    Parameters
    ----------
    y_true, y_pred, std : array-like of shape (n_samples,) or (n_samples, n_outputs)
        Observations, predicted means and predicted standard deviations (with noise).

    Returns
    -------
    error : float
        Calibration error, from 0 to 0.5.

    Raises
    ------
    ValueError
        If shapes differ, a value is not finite or a standard deviation is negative.

    See Also
    --------
    skevgp.plotting.CalibrationDisplay : Plot of the reliability curve.

    References
    ----------
    - V. Kuleshov, N. Fenner, S. Ermon (2018): Accurate Uncertainties for Deep Learning Using Calibrated Regression.
    - K. Tran et al. (2020): Methods for comparing uncertainty quantifications for material property predictions.

    Examples
    --------
    All of four values are inside the 60 % interval, and none is inside the 50 % interval:

    >>> from skevgp.metrics import calibration_error
    >>> round(calibration_error([0.7, -0.7, 0.8, -0.8], [0.0] * 4, [1.0] * 4), 2)
    0.23
    """
    levels = np.sort(interval_levels(y_true, y_pred, std).ravel())
    # Between the i-th and the next level the share is i / n. Each piece is an integral of |share - p|.
    share = np.arange(len(levels) + 1) / len(levels)
    ends = np.concatenate([[0.0], levels, [1.0]])
    area = [0.5 * (end - share) * np.abs(end - share) for end in (ends[1:], ends[:-1])]
    return float(np.sum(area[0] - area[1]))


def interval_levels(y_true: ArrayLike, y_pred: ArrayLike, std: ArrayLike) -> np.ndarray:
    """Return the probability of the smallest central interval of N(mean, std²) that contains y, for each value.

    Parameters
    ----------
    y_true, y_pred, std : array-like of shape (n_samples,) or (n_samples, n_outputs)
        Observations, predicted means and predicted standard deviations (with noise).

    Returns
    -------
    levels : ndarray of shape (n_samples, n_outputs)
        Probabilities from 0 to 1. They are uniform if predictions are calibrated.

    Raises
    ------
    ValueError
        If shapes differ, a value is not finite or a standard deviation is negative.

    Examples
    --------
    >>> from skevgp.metrics import interval_levels
    >>> interval_levels([0.0, 1.0, -2.0], [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]).round(3).ravel()
    array([0.   , 0.683, 0.954])
    """
    y_true, y_pred, std = _matrices(y_true=y_true, y_pred=y_pred, std=std)
    error, std = np.abs(y_true - y_pred), _positive(std, "std")
    unreached = np.where(error > 0, np.inf, 0.0)
    with np.errstate(over="ignore"):
        return 2.0 * ndtr(np.divide(error, std, out=unreached, where=std > 0)) - 1.0


# Scorers for ``scoring=``. Higher is better.
neg_nlpd = make_std_scorer(negative_log_predictive_density, greater_is_better=False)
neg_crps = make_std_scorer(crps, greater_is_better=False)
neg_calibration_error = make_std_scorer(calibration_error, greater_is_better=False)
