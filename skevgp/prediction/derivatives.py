"""Derivatives of predictions, and the posterior of the gradient of g(x) = h(x)ᵀβ + f(x).

With P = [V; Hᵀ] a prediction has the mean W P and the variance s² (k̃(x, x) - |v|²) + |R P|² (`inference.posterior`).
Their derivatives in the kernel's inputs and in the features are pulled back through the maps' own Jacobians to the
columns of X. (With inputs of d columns, all of it is of the size of V times d.)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..inference.posterior import Predictor, PredictorGroup
from ..rows.source import of_outputs
from .maps import direct, map_jacobian


class MappedRows(NamedTuple):
    """Rows X (n, D) behind both maps, with the maps' Jacobians.

    Attributes
    ----------
    inputs : ndarray of shape (n, d) or (n, o, d)
        The kernel's.
    features : ndarray of shape (n, p) or (n, o, p)
    input_slopes : ndarray of shape (n, d, D) or (n, o, d, D), or None
        ∂inputs/∂X; None if the inputs are X.
    feature_slopes : ndarray of shape (n, p, D) or (n, o, p, D)
    """

    inputs: np.ndarray
    features: np.ndarray
    input_slopes: np.ndarray | None
    feature_slopes: np.ndarray

    def of(self, group: PredictorGroup) -> tuple[np.ndarray | None, np.ndarray]:
        """The Jacobians (n, d, D) and (n, p, D) of the rows that a group sees."""
        inputs, features = self.input_slopes, self.feature_slopes
        return None if inputs is None else _of_group(inputs, group), _of_group(features, group)


def _of_group(slopes: np.ndarray, group: PredictorGroup) -> np.ndarray:
    if slopes.ndim == 3:
        return slopes
    n, o, k, columns = slopes.shape
    return of_outputs(slopes.reshape(n, o, k * columns), group.outputs).reshape(n, k, columns)


def mapped(X: np.ndarray, feature_map: Any, kernel_map: Any) -> MappedRows:
    """Rows X (n, D) through fitted maps, of which either may be None."""
    n, columns = X.shape
    features, feature_slopes = np.empty((n, 0)), np.empty((n, 0, columns))
    if feature_map is not None:
        features, feature_slopes = direct(feature_map)(X), map_jacobian(feature_map, X)
    if kernel_map is None:
        return MappedRows(X, features, None, feature_slopes)
    return MappedRows(direct(kernel_map)(X), features, map_jacobian(kernel_map, X), feature_slopes)


class Moments(NamedTuple):
    """Mean and variance (n, o) of the noise-free g(x), and their derivatives in X (n, o, D); None if not asked for."""

    mean: np.ndarray
    mean_slopes: np.ndarray
    variance: Any
    variance_slopes: Any


def moments_with_slopes(predictor: Predictor, rows: MappedRows, return_variance: bool = False) -> Moments:
    """What `Predictor.predict` returns, and its derivatives in X."""
    projected = list(predictor.projected(rows.inputs, rows.features))
    mean, variance = predictor.moments(projected, rows.features, return_variance)
    of_mean, of_variance = [], []
    for group, own in zip(predictor.groups, projected, strict=True):
        m, covariance, (by_inputs, by_features) = len(group.points), group.whitening.covariance, rows.of(group)
        slopes = covariance.slopes(own.prepared).transpose(1, 0, 2)  # (n, m, d)
        weights = group.mean[:, m:] + predictor.offset[group.outputs]
        found = (group.mean[:, :m] @ group.whitening.L_inv) @ slopes  # (n, o, d)
        of_mean.append(_outputs_first(_chained(found, by_inputs) + weights @ by_features))
        if return_variance:
            P_bar = 2.0 * (group.root.transpose(0, 2, 1) @ (group.root @ own.P))  # (o, m + p, n)
            P_bar[:, :m] -= 2.0 * group.signal[:, np.newaxis, np.newaxis] * own.P[:m]
            found = (group.whitening.L_inv.T @ P_bar[:, :m]).transpose(2, 0, 1) @ slopes
            at_row = np.broadcast_to(covariance.diagonal_slopes(own.prepared), own.inputs.shape)
            found += group.signal[:, np.newaxis] * at_row[:, np.newaxis]
            of_variance.append(
                _outputs_first(_chained(found, by_inputs) + P_bar[:, m:].transpose(2, 0, 1) @ by_features)
            )
    mean_slopes = _rows_first(predictor.in_order(of_mean))
    return Moments(mean, mean_slopes, variance, _rows_first(predictor.in_order(of_variance)) if of_variance else None)


def gradient_covariance(predictor: Predictor, rows: MappedRows) -> np.ndarray:
    """Cov[∂g/∂x] of each output and row, (n, o, D, D): a derivative is linear (Rasmussen & Williams 2006, section 9.4).

    Raises
    ------
    ValueError
        If functions of the kernel have no gradient.
    """
    parts = []
    for group, own in zip(predictor.groups, predictor.projected(rows.inputs, rows.features), strict=True):
        covariance, (by_inputs, by_features) = group.whitening.covariance, rows.of(group)
        slopes = _chained(covariance.slopes(own.prepared).transpose(1, 0, 2), by_inputs)  # (n, m, D)
        P = np.concatenate([group.whitening.L_inv @ slopes, by_features], axis=1)  # (n, m + p, D)
        V = P[:, : len(group.points)]
        left = covariance.mixed_slopes(own.prepared)
        if by_inputs is not None:
            left = by_inputs.transpose(0, 2, 1) @ left @ by_inputs
        left = left - V.transpose(0, 2, 1) @ V
        # What the points leave of a direction that they know is rounding, perhaps below 0.
        unknown = np.einsum("nii->ni", left) > 0.0
        left *= unknown[:, :, np.newaxis] & unknown[:, np.newaxis]
        deviation = group.root[:, np.newaxis] @ P  # (o, n, k, D)
        signal = group.signal[:, np.newaxis, np.newaxis, np.newaxis]
        parts.append(signal * left + deviation.transpose(0, 1, 3, 2) @ deviation)
    return _rows_first(predictor.in_order(parts))


def _chained(slopes: np.ndarray, by_inputs: np.ndarray | None) -> np.ndarray:
    """From derivatives (n, k, d) in the kernel's inputs to those in X (n, k, D)."""
    return slopes if by_inputs is None else slopes @ by_inputs


def _outputs_first(values: np.ndarray) -> np.ndarray:
    return np.moveaxis(values, 1, 0)


def _rows_first(values: np.ndarray) -> np.ndarray:
    return np.moveaxis(values, 0, 1)
