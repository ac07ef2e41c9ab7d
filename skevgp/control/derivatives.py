"""Mapped rows with the Jacobians of the maps, and the posterior of the gradient of g(x) = h(x)ᵀβ + f(x)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..data.rows import of_outputs
from ..maps import Map
from ..model.predictor import Predictor, PredictorGroup
from ..model.roots import times


class MappedRows(NamedTuple):
    """Rows X (n, D) after both maps, with the Jacobians of the maps."""

    inputs: np.ndarray  # of the kernel, (n, d) or (n, o, d)
    features: np.ndarray  # (n, p) or (n, o, p)
    input_slopes: np.ndarray | None  # ∂inputs/∂X, (n, d, D) or (n, o, d, D); None if the inputs are X
    feature_slopes: np.ndarray  # (n, p, D) or (n, o, p, D)

    def of(self, group: PredictorGroup) -> tuple[np.ndarray | None, np.ndarray]:
        """Return the Jacobians (n, d, D) and (n, p, D) of the rows of a group."""
        inputs, features = self.input_slopes, self.feature_slopes
        return None if inputs is None else _of_group(inputs, group), _of_group(features, group)


def _of_group(slopes: np.ndarray, group: PredictorGroup) -> np.ndarray:
    if slopes.ndim == 3:
        return slopes
    n, o, k, columns = slopes.shape
    return of_outputs(slopes.reshape(n, o, k * columns), group.outputs).reshape(n, k, columns)


def mapped(X: np.ndarray, feature_map: Map | None, kernel_map: Map | None) -> MappedRows:
    """Apply both maps to rows X (n, D); either may be None."""
    n, columns = X.shape
    features, feature_slopes = np.empty((n, 0)), np.empty((n, 0, columns))
    if feature_map is not None:
        features, feature_slopes = feature_map.value(X), feature_map.jacobian(X)
    if kernel_map is None:
        return MappedRows(X, features, None, feature_slopes)
    return MappedRows(kernel_map.value(X), features, kernel_map.jacobian(X), feature_slopes)


def gradient_covariance(predictor: Predictor, rows: MappedRows) -> np.ndarray:
    """Return Cov[∂g/∂x] of each row and output, (n, o, D, D); ValueError if the kernel has no gradient."""
    # A derivative is linear, so that the gradient of a Gaussian process is one (Rasmussen & Williams 2006, section
    # 9.4).
    parts = []
    for group, own in zip(predictor.groups, predictor.projected(rows.inputs, rows.features), strict=True):
        covariance, (by_inputs, by_features) = group.whitening.covariance, rows.of(group)
        slopes = chained(covariance.slopes(own.prepared).transpose(1, 0, 2), by_inputs)  # (n, m, D)
        P = np.concatenate([group.whitening.times_inverse(slopes), by_features], axis=1)  # (n, m + p, D)
        V = P[:, : len(group.points)]
        left = covariance.mixed_slopes(own.prepared)
        if by_inputs is not None:
            left = by_inputs.transpose(0, 2, 1) @ left @ by_inputs
        left = left - V.transpose(0, 2, 1) @ V
        # Where the inducing points explain a direction fully, only rounding is left, which may be negative.
        unknown = np.einsum("nii->ni", left) > 0.0
        left *= unknown[:, :, np.newaxis] & unknown[:, np.newaxis]
        n, size, columns = P.shape
        deviation = times(group.root, P.transpose(1, 0, 2).reshape(size, n * columns))
        deviation = deviation.reshape(*deviation.shape[:2], n, columns).transpose(0, 2, 1, 3)  # (o, n, k, D)
        signal = group.signal[:, np.newaxis, np.newaxis, np.newaxis]
        parts.append(signal * left + deviation.transpose(0, 1, 3, 2) @ deviation)
    return np.moveaxis(predictor.in_order(parts), 0, 1)


def chained(slopes: np.ndarray, by_inputs: np.ndarray | None) -> np.ndarray:
    """Turn derivatives (n, k, d) with respect to the kernel's inputs into those with respect to X (n, k, D)."""
    return slopes if by_inputs is None else slopes @ by_inputs
