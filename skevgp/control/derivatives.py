"""Rows behind both maps with their Jacobians, and the posterior of the gradient of g(x) = h(x)ᵀβ + f(x)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..data.rows import of_outputs
from ..maps import Map
from ..model.predictor import Predictor, PredictorGroup


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


def mapped(X: np.ndarray, feature_map: Map | None, kernel_map: Map | None) -> MappedRows:
    """Rows X (n, D) through the maps, of which either may be None."""
    n, columns = X.shape
    features, feature_slopes = np.empty((n, 0)), np.empty((n, 0, columns))
    if feature_map is not None:
        features, feature_slopes = feature_map.value(X), feature_map.jacobian(X)
    if kernel_map is None:
        return MappedRows(X, features, None, feature_slopes)
    return MappedRows(kernel_map.value(X), features, kernel_map.jacobian(X), feature_slopes)


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
        slopes = chained(covariance.slopes(own.prepared).transpose(1, 0, 2), by_inputs)  # (n, m, D)
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
    return np.moveaxis(predictor.in_order(parts), 0, 1)


def chained(slopes: np.ndarray, by_inputs: np.ndarray | None) -> np.ndarray:
    """From derivatives (n, k, d) in the kernel's inputs to those in X (n, k, D)."""
    return slopes if by_inputs is None else slopes @ by_inputs
