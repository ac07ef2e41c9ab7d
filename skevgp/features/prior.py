"""The prior of the weights β, from the arguments of the regressor and from the feature map."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sklearn.pipeline import FeatureUnion, Pipeline
from sklearn.utils import _safe_indexing

# Standard deviation of a weight whose map has no opinion: the feature could explain ten times the target's scatter.
_WIDE = 10.0


def resolve_coef_prior(
    coef_mean: ArrayLike | str,
    coef_scale: ArrayLike | str,
    feature_map: Any,
    X: Any,
    features: np.ndarray,
    targets: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Prior mean and standard deviation of the weights.

    Parameters
    ----------
    coef_mean, coef_scale : array-like of shape (o, p), scalar or "auto"
        ``"auto"`` asks the feature map's ``coef_prior(n_outputs)``; unions concatenate those of their parts, and a part
        without one gets mean 0 and scale 10 * std(y) / rms(h).
    feature_map : transformer or None
        Fitted.
    X : array-like of shape (n, d)
        What the map takes; only its first row is used, to learn the widths of the parts of a union.
    features : ndarray of shape (n, p)
        h(x).
    targets : ndarray of shape (n, o)

    Returns
    -------
    mean, scale : ndarray of shape (o, p)

    Raises
    ------
    ValueError
        If a shape does not fit, a value is not finite or a scale is negative.
    """
    shape = targets.shape[1], features.shape[1]
    auto_mean, auto_scale = np.zeros(shape), _wide_scale(features, targets)
    if feature_map is not None and "auto" in (_word(coef_mean), _word(coef_scale)):
        first = _safe_indexing(X, slice(0, 1))
        mean, scale = _map_prior(feature_map, first, shape[0], shape[1])
        if mean.shape != shape or scale.shape != shape:
            raise ValueError(
                f"coef_prior of {feature_map!r} must return two arrays of the shape (n_outputs, n_features_out) = "
                f"{shape}; got {mean.shape} and {scale.shape}."
            )
        auto_mean, auto_scale = mean, np.where(np.isnan(scale), auto_scale, scale)
    mean = auto_mean if _word(coef_mean) == "auto" else _as_table(coef_mean, "coef_mean", shape)
    scale = auto_scale if _word(coef_scale) == "auto" else _as_table(coef_scale, "coef_scale", shape)
    if not (np.isfinite(mean).all() and np.isfinite(scale).all()):
        raise ValueError("coef_mean and coef_scale must be finite.")
    if (scale < 0).any():
        raise ValueError(f"coef_scale must not be negative; its smallest value is {scale.min()}.")
    return mean.astype(float), scale.astype(float)


def _word(value: Any) -> str | None:
    return value if isinstance(value, str) else None


def _as_table(value: ArrayLike | str, name: str, shape: tuple[int, int]) -> np.ndarray:
    array = np.asarray(value, dtype=float)
    # With one output its row may stand alone.
    if array.shape not in ((), shape, (shape[1],) if shape[0] == 1 else ()):
        raise ValueError(
            f"{name} must be 'auto', a number or an array of the shape (n_outputs, n_features_out) = {shape}; got the "
            f"shape {array.shape}."
        )
    return np.broadcast_to(array, shape)


def _wide_scale(features: np.ndarray, targets: np.ndarray) -> np.ndarray:
    scatter = targets.std(axis=0)
    scatter = np.where(scatter > 0.0, scatter, np.abs(targets).max(axis=0))
    size = np.sqrt(np.mean(features**2, axis=0))
    return _WIDE * np.where(scatter > 0.0, scatter, 1.0)[:, np.newaxis] / np.where(size > 0.0, size, 1.0)


def _map_prior(feature_map: Any, first: Any, n_outputs: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Prior of a map's features; NaN in the scale where it has no opinion."""
    if hasattr(feature_map, "coef_prior"):
        mean, scale = feature_map.coef_prior(n_outputs)
        return np.asarray(mean, dtype=float), np.asarray(scale, dtype=float)
    if isinstance(feature_map, Pipeline):
        last = feature_map.steps[-1][1]
        return _map_prior(last, feature_map[:-1].transform(first) if len(feature_map) > 1 else first, n_outputs, width)
    if isinstance(feature_map, FeatureUnion):
        parts = []
        for name, part in feature_map.transformer_list:
            if part == "drop":
                continue
            own_width = np.shape(first if part == "passthrough" else part.transform(first))[1]
            mean, scale = _map_prior(part, first, n_outputs, own_width)
            weight = (feature_map.transformer_weights or {}).get(name, 1.0)
            parts.append((mean / weight, scale / weight))
        return np.hstack([mean for mean, _ in parts]), np.hstack([scale for _, scale in parts])
    return np.zeros((n_outputs, width)), np.full((n_outputs, width), np.nan)
