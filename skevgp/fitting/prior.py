"""The prior of the weights β, from the arguments of the regressor and from the feature map."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import eigh
from sklearn.compose import ColumnTransformer
from sklearn.pipeline import FeatureUnion, Pipeline

from ..data.maps import transformed
from ..utils.sklearn import safe_indexing
from ..utils.state import StatefulEstimator
from ..utils.validation import as_floats, check_magnitude

# Without a prior from the map, a feature may explain this many times the target's standard deviation.
_WIDE = 10.0
# Rounding errors of correlations.
_ROUNDING = 1e-8


class CoefPrior(StatefulEstimator):
    """Prior of the weights β of the explicit features, β ~ N(mean, Σ), for ``coef_prior=`` of the regressors.

    Parameters
    ----------
    mean : array-like of shape (n_outputs, n_h), float or "auto", default="auto"
        Prior mean. ``"auto"`` asks the feature map's ``coef_prior(n_outputs)``; for a map without one, it is 0.
    scale : array-like of shape (n_outputs, n_h), float or "auto", default="auto"
        Prior standard deviation. ``"auto"`` asks the feature map; for a map without an opinion it is
        10 * std(y) / rms(h). A scale of 0 keeps a weight at its mean. `EGPRegressor` takes ``np.inf``: its estimate of
        such a weight is that of generalised least squares (Rasmussen & Williams 2006, eq. 2.42 to 2.45).
    cov : array-like of shape (n_h, n_h) or (n_outputs, n_h, n_h), default=None
        Prior covariance Σ, of all outputs or of each, instead of ``scale``. The mass and the first moment of a link,
        for example, are correlated in any honest prior.
    shared : bool or "auto", default="auto"
        Whether all outputs have the same weights, as the torques of a robot's joints have one set of inertial
        parameters. Then ``mean``, ``scale`` and ``coef_`` have no axis of outputs, all outputs are fitted together, and
        they depend on each other (``predict(X, return_cov="joint")``). ``"auto"`` asks the feature map's attribute
        ``share_coef``. Not for Adam or the diagonal posterior.

    Examples
    --------
    >>> from sklearn.preprocessing import PolynomialFeatures
    >>> from skevgp import CoefPrior, EVGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> prior = CoefPrior(mean=0.0, scale=5.0)
    >>> model = EVGPRegressor(PolynomialFeatures(1), coef_prior=prior, n_inducing=10, random_state=0).fit(X, y)
    >>> model.coef_prior_scale_
    array([5., 5.])
    """

    def __init__(
        self,
        mean: ArrayLike | Literal["auto"] = "auto",
        scale: ArrayLike | Literal["auto"] = "auto",
        cov: ArrayLike | None = None,
        shared: bool | Literal["auto"] = "auto",
    ):
        self.mean = mean
        self.scale = scale
        self.cov = cov
        self.shared = shared


def as_coef_prior(coef_prior: Any) -> CoefPrior:
    """Return the prior that ``coef_prior=`` names or is.

    Raises
    ------
    TypeError
        If it is none.
    """
    if isinstance(coef_prior, CoefPrior):
        shared = coef_prior.shared
        if not (isinstance(shared, (bool, np.bool_)) or _word(shared) == "auto"):
            raise TypeError(f'shared of CoefPrior must be True, False or "auto"; got {shared!r}.')
        return coef_prior
    if _word(coef_prior) == "auto":
        return CoefPrior()
    raise TypeError(f'coef_prior must be "auto" or a skevgp.CoefPrior(...); got {coef_prior!r}.')


class Resolved(NamedTuple):
    """Mean and standard deviations (k, p), and C (k, p, p) with Σ = C Cᵀ. k is 1 if outputs share their weights."""

    mean: np.ndarray
    scale: np.ndarray
    root: np.ndarray | None


def resolved(
    prior: CoefPrior, feature_map: Any, X: Any, wide: np.ndarray, n_outputs: int, allow_vague: bool = False
) -> Resolved:
    """The prior of the weights of a fitted feature map, checked.

    The map's method ``coef_prior(n_outputs)`` returns the mean, and the standard deviations or the covariance: (k, p,
    p), or one (p, p) for all. A union joins the priors of its parts. A part without the method, and entries of a scale
    that are NaN, get mean 0 and the scale ``wide`` (k, p). Only the first row of X is used, to find the widths of the
    parts. ``allow_vague`` allows infinite scales. Raises a ValueError if a shape does not fit, a value is not finite, a
    scale is negative, or a covariance is not positive semi-definite.
    """
    shape, shared = wide.shape, n_outputs > len(wide)
    for name in ("mean", "scale", "cov"):
        value = getattr(prior, name)
        if feature_map is None and (isinstance(value, list | tuple) or np.ndim(value) > 0):
            raise ValueError(f"{name} of CoefPrior needs a feature_map: without one there are no weights.")
    if prior.cov is not None and _word(prior.scale) != "auto":
        raise ValueError(
            f"cov and scale={prior.scale!r} of CoefPrior both say how far weights may be; give one of them."
        )
    auto_mean, auto_scale, correlation = np.zeros(shape), wide, _independent(shape)
    if feature_map is not None and "auto" in (_word(prior.mean), _word(prior.scale)):
        first = safe_indexing(X, slice(0, 1))
        auto_mean, scale, correlation = _map_prior(feature_map, first, n_outputs, shape)
        auto_scale = np.where(np.isnan(scale), auto_scale, scale)
    mean = auto_mean if _word(prior.mean) == "auto" else _as_table(prior.mean, "mean of CoefPrior", shape, shared)
    scale, scale_name = auto_scale, 'scale="auto" of CoefPrior, the feature map\'s or 10 std(y) / rms of a feature,'
    if _word(prior.scale) != "auto":
        scale_name = "scale of CoefPrior"
        scale, correlation = _as_table(prior.scale, scale_name, shape, shared), _independent(shape)
    if prior.cov is not None:
        scale, correlation = _of_covariance(prior.cov, "cov of CoefPrior", shape)
    finite = np.where(scale == np.inf, wide, scale) if allow_vague else scale
    for name, values in (("mean of CoefPrior", mean), (scale_name, finite)):
        if not np.isfinite(values).all():
            raise ValueError(f"{name} must be finite; it holds {values[~np.isfinite(values)][0]}.")
        check_magnitude(values, name)
    if (scale < 0).any():
        raise ValueError(f"scale of CoefPrior must not be negative; its smallest value is {scale.min()}.")
    if (correlation == _independent(shape)).all():
        return Resolved(mean.astype(float), scale.astype(float), None)
    eigenvalues, vectors = (np.array(each) for each in zip(*map(eigh, correlation), strict=True))
    root = vectors * np.sqrt(np.maximum(eigenvalues, 0.0))[:, np.newaxis]
    return Resolved(mean.astype(float), scale.astype(float), scale[:, :, np.newaxis] * root)


def _independent(shape: tuple[int, int]) -> np.ndarray:
    """The correlation (k, p, p) of independent weights."""
    return np.repeat(np.eye(shape[1])[np.newaxis], shape[0], axis=0)


def _of_covariance(covariance: ArrayLike, name: str, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations (k, p) and correlations (k, p, p) of a covariance, checked."""
    k, p = shape
    values = as_floats(covariance, name)
    if values.shape not in ((p, p), (k, p, p)):
        each = f", or one such for each output, {(k, p, p)}" if k > 1 else ""
        raise ValueError(
            f"{name} must be of the shape (n_features_out, n_features_out) = {(p, p)}{each}; got the shape "
            f"{values.shape}."
        )
    values = np.broadcast_to(values, (k, p, p))
    if not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite; it holds {values[~np.isfinite(values)][0]}.")
    variance = np.diagonal(values, axis1=1, axis2=2)
    if (variance < 0.0).any():
        raise ValueError(f"{name} must have no negative variance; its smallest is {variance.min()}.")
    scale = np.sqrt(variance)
    check_magnitude(scale, name)
    unit = np.where(scale > 0.0, scale, 1.0)
    correlation = values / unit[:, :, np.newaxis] / unit[:, np.newaxis]
    if np.abs(correlation - correlation.transpose(0, 2, 1)).max() > _ROUNDING:
        raise ValueError(f"{name} must be symmetric.")
    correlation = 0.5 * (correlation + correlation.transpose(0, 2, 1))
    if (correlation[scale == 0.0] != 0.0).any():
        raise ValueError(f"{name} must be positive semi-definite: a weight without variance has no covariance.")
    diagonal = np.einsum("oii->oi", correlation)
    diagonal[...] = 1.0
    if (lowest := np.linalg.eigvalsh(correlation).min()) < -_ROUNDING * p:
        raise ValueError(
            f"{name} must be positive semi-definite; the lowest eigenvalue of its correlations is {lowest:.3g}."
        )
    return scale, correlation


def _word(value: Any) -> str | None:
    return value if isinstance(value, str) else None


def _as_table(value: ArrayLike | str, name: str, shape: tuple[int, int], shared: bool) -> np.ndarray:
    array = as_floats(value, name)
    if array.shape not in ((), *_shapes(shape)):
        raise ValueError(
            f"{name} must be 'auto', a number or an array of {_shapes_text(shape, shared)}; got the shape "
            f"{array.shape}."
        )
    return np.broadcast_to(array, shape)


def _shapes(shape: tuple[int, int]) -> list[tuple[int, ...]]:
    """The shapes that are accepted for (k, p): for one output, a row alone too."""
    return [shape, shape[1:]] if shape[0] == 1 else [shape]


def _shapes_text(shape: tuple[int, int], shared: bool) -> str:
    """The same for error messages."""
    if shared:
        return f"the shape (n_features_out,) = {shape[1:]}, since the outputs share their weights"
    alone = f", or {shape[1:]} for the one output" if shape[0] == 1 else ""
    return f"the shape (n_outputs, n_features_out) = {shape}{alone}"


def wide_scale(
    feature_size: np.ndarray, target_std: np.ndarray, target_largest: np.ndarray, shared: bool = False
) -> np.ndarray:
    """10 * std(y) / rms(h), the scale of weights without prior knowledge: (o, p), or (1, p) if they are shared.

    ``feature_size`` (p,) or (o, p) is the rms of each feature. ``target_largest`` (o,) is the largest absolute value of
    each target, which is used if its standard deviation is 0. For shared weights the widest scale of all outputs
    counts.
    """
    size = np.where(target_std > 0.0, target_std, target_largest)
    size = _WIDE * np.where(size > 0.0, size, 1.0)[:, np.newaxis]
    if not shared:
        return size / np.where(feature_size > 0.0, feature_size, 1.0)
    feature_size = np.broadcast_to(feature_size, (len(size), np.shape(feature_size)[-1]))
    known = feature_size > 0.0
    wide = np.where(known, size / np.where(known, feature_size, 1.0), 0.0).max(axis=0, keepdims=True)
    return np.where(wide > 0.0, wide, size.max())


def _map_prior(
    feature_map: Any, first: Any, n_outputs: int, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean and scale (k, width) of a map's weights, and their correlation. NaN in the scale if the map has none."""
    if hasattr(feature_map, "coef_prior"):
        return _own_prior(feature_map, n_outputs, shape)
    mean, scale, correlation = np.zeros(shape), np.full(shape, np.nan), _independent(shape)
    if isinstance(feature_map, Pipeline):
        steps = [step for _, step in feature_map.steps if step not in ("passthrough", None)]
        for step in steps[:-1]:
            first = step.transform(first)
        return _map_prior(steps[-1], first, n_outputs, shape) if steps else (mean, scale, correlation)
    for part, part_first, columns, weight in _parts_of(feature_map, first):
        part_mean, part_scale, part_correlation = _map_prior(part, part_first, n_outputs, (shape[0], len(columns)))
        mean[:, columns] = part_mean / weight
        scale[:, columns] = part_scale / abs(weight)
        correlation[:, columns[:, np.newaxis], columns] = part_correlation
    return mean, scale, correlation


def says_shared(feature_map: Any) -> bool:
    """Whether a fitted feature map says that all outputs have the same weights. All parts of a union must say so."""
    if hasattr(feature_map, "share_coef"):
        return bool(feature_map.share_coef)
    if isinstance(feature_map, Pipeline):
        parts = [step for _, step in feature_map.steps if step not in ("passthrough", None)][-1:]
    elif isinstance(feature_map, FeatureUnion):
        parts = [part for _, part in feature_map.transformer_list if part != "drop"]
    elif isinstance(feature_map, ColumnTransformer):
        parts = [part for _, part, _ in feature_map.transformers_ if part != "drop"]
    else:
        return False
    return bool(parts) and all(map(says_shared, parts))


def _own_prior(feature_map: Any, n_outputs: int, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The result of a map's ``coef_prior``, checked."""
    (k, p), prior, allowed = shape, feature_map.coef_prior(n_outputs), _shapes(shape)
    called = f"coef_prior of {feature_map!r}"
    parts = [as_floats(part, f"What {called} returns") for part in prior] if isinstance(prior, (tuple, list)) else []
    shapes = [part.shape for part in parts]
    if len(shapes) != 2 or shapes[0] not in allowed or shapes[1] not in [*allowed, (p, p), (k, p, p)]:
        raise ValueError(
            f"{called} must return two arrays of {_shapes_text(shape, n_outputs > k)}, of which the second may be the "
            f"covariance, {(k, p, p) if k > 1 else (p, p)}; got {shapes or type(prior).__name__}."
        )
    mean = parts[0].reshape(shape)
    if shapes[1] not in allowed:
        scale, correlation = _of_covariance(parts[1], f"The covariance of {called}", shape)
        return mean, scale, correlation
    return mean, parts[1].reshape(shape), _independent(shape)


def _parts_of(feature_map: Any, first: Any) -> Iterator[tuple[Any, Any, np.ndarray, float]]:
    """The parts of a union: map, its input for the first row, its columns in the result, and its weight.

    Parts of weight 0 are left out: their features are 0.
    """
    if isinstance(feature_map, FeatureUnion):
        start = 0
        for name, part in feature_map.transformer_list:
            if part == "drop":
                continue
            width = np.shape(first if part == "passthrough" else transformed(part, first))[-1]
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


def coef_names(feature_map: Any, columns: np.ndarray | None, n_features: int, letter: str = "h") -> np.ndarray:
    """Names of the features of a fitted map. "h0", "h1", ... (with ``letter``) if it has none."""
    try:
        names = np.asarray([str(name) for name in feature_map.get_feature_names_out(columns)], dtype=object)
    except (AttributeError, TypeError, ValueError):
        names = np.empty(0, dtype=object)
    if len(names) == n_features:
        return names
    return np.array([f"{letter}{index}" for index in range(n_features)], dtype=object)
