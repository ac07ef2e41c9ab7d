"""The prior of the weights β, from the arguments of the regressor and from the feature map."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sklearn.compose import ColumnTransformer
from sklearn.pipeline import FeatureUnion, Pipeline

from ._sklearn import safe_indexing
from ._validation import as_floats, check_magnitude

# Of a weight whose map has no opinion: the feature could explain ten times the target's standard deviation.
_WIDE = 10.0


def resolve_coef_prior(
    coef_mean: ArrayLike | str,
    coef_scale: ArrayLike | str,
    feature_map: Any,
    X: Any,
    wide: np.ndarray,
    *,
    allow_vague: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Prior mean and standard deviation of the weights.

    Parameters
    ----------
    coef_mean, coef_scale : array-like of shape (o, p), scalar or "auto"
        ``"auto"`` asks the feature map's ``coef_prior(n_outputs)``; unions concatenate those of their parts. A part
        without one, and entries of a scale that are NaN, get mean 0 and the scale ``wide``.
    feature_map : transformer or None
        Fitted.
    X : array-like of shape (n, d)
        What the map takes; only its first row is used, to learn the widths of the parts of a union.
    wide : ndarray of shape (o, p)
        `wide_scale`.
    allow_vague : bool, default=False
        Whether a scale may be infinite.

    Returns
    -------
    mean, scale : ndarray of shape (o, p)

    Raises
    ------
    ValueError
        If a shape does not fit, a value is not finite or a scale is negative.
    """
    shape = wide.shape
    auto_mean, auto_scale = np.zeros(shape), wide
    if feature_map is not None and "auto" in (_word(coef_mean), _word(coef_scale)):
        first = safe_indexing(X, slice(0, 1))
        mean, scale = _map_prior(feature_map, first, shape[0], shape[1])
        auto_mean, auto_scale = mean, np.where(np.isnan(scale), auto_scale, scale)
    mean = auto_mean if _word(coef_mean) == "auto" else _as_table(coef_mean, "coef_mean", shape)
    scale = auto_scale if _word(coef_scale) == "auto" else _as_table(coef_scale, "coef_scale", shape)
    finite = np.where(scale == np.inf, wide, scale) if allow_vague else scale
    for name, values in (("coef_mean", mean), ("coef_scale", finite)):
        if not np.isfinite(values).all():
            raise ValueError(f"{name} must be finite; it holds {values[~np.isfinite(values)][0]}.")
        check_magnitude(values, name)
    if (scale < 0).any():
        raise ValueError(f"coef_scale must not be negative; its smallest value is {scale.min()}.")
    return mean.astype(float), scale.astype(float)


def _word(value: Any) -> str | None:
    return value if isinstance(value, str) else None


def _as_table(value: ArrayLike | str, name: str, shape: tuple[int, int]) -> np.ndarray:
    array = as_floats(value, name)
    # With one output its row may stand alone.
    if array.shape not in ((), shape, (shape[1],) if shape[0] == 1 else ()):
        raise ValueError(
            f"{name} must be 'auto', a number or an array of the shape (n_outputs, n_features_out) = {shape}; got the "
            f"shape {array.shape}."
        )
    return np.broadcast_to(array, shape)


def wide_scale(feature_size: np.ndarray, target_std: np.ndarray, target_largest: np.ndarray) -> np.ndarray:
    """10 * std(y) / rms(h), the scale of weights of which nothing is known.

    Parameters
    ----------
    feature_size : ndarray of shape (p,)
        Root mean square of each feature.
    target_std, target_largest : ndarray of shape (o,)
        Standard deviation of each target, and its largest absolute value, which serves where it does not vary.

    Returns
    -------
    scale : ndarray of shape (o, p)
    """
    size = np.where(target_std > 0.0, target_std, target_largest)
    return _WIDE * np.where(size > 0.0, size, 1.0)[:, np.newaxis] / np.where(feature_size > 0.0, feature_size, 1.0)


def _map_prior(feature_map: Any, first: Any, n_outputs: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Prior (n_outputs, width) of a map's features; NaN in the scale where it has no opinion."""
    if hasattr(feature_map, "coef_prior"):
        return _own_prior(feature_map, (n_outputs, width))
    mean, scale = np.zeros((n_outputs, width)), np.full((n_outputs, width), np.nan)
    if isinstance(feature_map, Pipeline):
        steps = [step for _, step in feature_map.steps if step not in ("passthrough", None)]
        for step in steps[:-1]:
            first = step.transform(first)
        return _map_prior(steps[-1], first, n_outputs, width) if steps else (mean, scale)
    for part, part_first, columns, weight in _parts_of(feature_map, first):
        part_mean, part_scale = _map_prior(part, part_first, n_outputs, len(columns))
        mean[:, columns] = part_mean / weight
        scale[:, columns] = part_scale / abs(weight)
    return mean, scale


def _own_prior(feature_map: Any, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """What a map's ``coef_prior`` says, checked."""
    prior = feature_map.coef_prior(shape[0])
    shapes = [np.shape(part) for part in prior] if isinstance(prior, (tuple, list)) else type(prior).__name__
    if shapes != [shape, shape]:
        raise ValueError(
            f"coef_prior of {feature_map!r} must return two arrays of the shape (n_outputs, n_features_out) = {shape}; "
            f"got {shapes}."
        )
    return np.asarray(prior[0], dtype=float), np.asarray(prior[1], dtype=float)


def _parts_of(feature_map: Any, first: Any) -> Iterator[tuple[Any, Any, np.ndarray, float]]:
    """The parts of a union: map, what it sees of the first row, its columns in the result, their weight.

    Parts of weight 0 are left out: their features are 0 and say nothing of a weight.
    """
    if isinstance(feature_map, FeatureUnion):
        start = 0
        for name, part in feature_map.transformer_list:
            if part == "drop":
                continue
            width = np.shape(first if part == "passthrough" else part.transform(first))[1]
            weight = _weight(feature_map, name)
            if weight != 0.0:
                yield part, first, np.arange(start, start + width), weight
            start += width
    elif isinstance(feature_map, ColumnTransformer):
        for name, part, columns in feature_map.transformers_:
            own = np.arange(feature_map.output_indices_[name].start, feature_map.output_indices_[name].stop)
            weight = _weight(feature_map, name)
            if len(own) and weight != 0.0:
                yield part, safe_indexing(first, columns, axis=1), own, weight


def _weight(union: Any, name: str) -> float:
    weight = (union.transformer_weights or {}).get(name)
    return 1.0 if weight is None else float(weight)
