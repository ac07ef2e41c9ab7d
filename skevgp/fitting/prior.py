"""The prior of the weights β, from the arguments of the regressor and from the feature map."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import eigh, svd
from sklearn.compose import ColumnTransformer
from sklearn.pipeline import FeatureUnion, Pipeline

from ..maps.sklearn import parts_of_union, steps_of
from ..utils.sklearn import safe_indexing
from ..utils.state import StatefulEstimator
from ..utils.validation import as_floats, check_magnitude

# The scale of a weight without prior knowledge is so many times the largest that least squares could give. The prior
# then changes predictions by 1e-6 of their std.
_WIDE = 1e3
# With few rows for each weight, a free weight would make std far too wide. Its scale is then so many times the rms of y
# over that of the feature. Scales that are learned start there too.
_MODERATE = 10.0
# The share of a feature that the others cannot represent counts as at least the first number. Below the second, it is a
# rounding error, and the features are collinear.
_INDEPENDENT, _COLLINEAR = 1e-6, 1e-12
# Rounding errors of correlations.
_ROUNDING = 1e-8


class CoefPrior(StatefulEstimator):
    """Prior β ~ N(mean, Σ) of the weights of the explicit features.

    Pass it to a regressor as ``coef_prior``. See the user guide, :doc:`/guide/priors`.

    Parameters
    ----------
    mean : array-like of shape (n_outputs, n_h), float or "auto", default="auto"
        Prior mean. If ``"auto"``, that of the method ``coef_prior(n_outputs)`` of the feature map, or 0 if the map has
        no such method.
    scale : array-like of shape (n_outputs, n_h), float or "auto", default="auto"
        Prior standard deviation. If ``"auto"``, that of the feature map. If the map has no prior, 1000 times the
        largest weight that least squares could give, so that the prior has no effect on predictions. With fewer rows
        than ten times the features, it is 10 * rms(y) / rms(h). A scale of 0 keeps a weight at its mean. `EGPRegressor`
        also takes ``np.inf``, which gives generalised least squares.
    cov : array-like of shape (n_h, n_h) or (n_outputs, n_h, n_h), default=None
        Prior covariance Σ, of all outputs or of each, instead of ``scale``. For example, the mass and the first moment
        of a link are correlated.
    shared : bool or "auto", default="auto"
        Whether all outputs have the same weights, like the torques of a robot with one set of inertial parameters. Then
        ``mean``, ``scale`` and ``coef_`` have no axis of outputs. If ``"auto"``, the attribute ``share_coef`` of the
        feature map decides.
    groups : array-like of str of shape (n_h,) or (n_outputs, n_h), "auto" or None, default="auto"
        Labels of the weights. The fit learns a factor on the standard deviations of all weights with the same label,
        for each output. An empty label keeps the standard deviation. If ``"auto"``, the labels are those of the feature
        map, unless ``scale`` or ``cov`` are given. If None, all standard deviations stay.

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

    The torques of gravity in two joints are linear in the same two first moments, 20 and 5. Each joint has a row of
    features:

    >>> import numpy as np
    >>> from sklearn.preprocessing import FunctionTransformer
    >>> def gravity(X):
    ...     own, both = np.sin(X[:, 0]), np.sin(X[:, 0] + X[:, 1])
    ...     return np.stack([np.column_stack([own, both]), np.column_stack([0.0 * own, both])], axis=1)
    >>> X = np.random.default_rng(0).uniform(-3.0, 3.0, (100, 2))
    >>> y = gravity(X) @ [20.0, 5.0] + np.cos(2.0 * X)
    >>> prior = CoefPrior(shared=True)
    >>> model = EVGPRegressor(FunctionTransformer(gravity), coef_prior=prior, n_inducing=10, random_state=0).fit(X, y)
    >>> model.coef_.round(1)
    array([20.,  5.])
    """

    def __init__(
        self,
        mean: ArrayLike | Literal["auto"] = "auto",
        scale: ArrayLike | Literal["auto"] = "auto",
        cov: ArrayLike | None = None,
        shared: bool | Literal["auto"] = "auto",
        groups: ArrayLike | Literal["auto"] | None = "auto",
    ):
        self.mean = mean
        self.scale = scale
        self.cov = cov
        self.shared = shared
        self.groups = groups


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
    """The prior of the weights in the user's units. k is 1 if outputs share their weights, else their number."""

    # (k, p) each: mean and standard deviations.
    mean: np.ndarray
    scale: np.ndarray
    # (k, p, p): C with Σ = C Cᵀ. None: weights are independent.
    root: np.ndarray | None
    # (k, p): the label of each weight's group, whose scale is learned. Empty: the scale stays.
    groups: np.ndarray


@dataclass(frozen=True)
class InData:
    """What the data say of sizes. k is 1 if outputs share their weights, else their number."""

    # k and p.
    shape: tuple[int, int]
    # Returns the scale (k, p) of weights without prior knowledge, or its start if it is learned, from `wide_scale`.
    wide: Callable[[bool], np.ndarray]
    # (p,) or (o, p): the rms of each feature.
    size: np.ndarray
    # Maps a prior mean (k, p) to the rms (o,) of what it leaves of y.
    left_over: Callable[[np.ndarray], np.ndarray]


def resolved(
    prior: CoefPrior, feature_map: Any, X: Any, data: InData, n_outputs: int, allow_vague: bool = False
) -> Resolved:
    """The prior of the weights of a fitted feature map, checked.

    A map may have three methods, and a union joins what its parts say:

    - ``coef_prior(n_outputs)`` returns the mean, and the standard deviations or the covariance: (k, p, p), or one
      (p, p) for all. Standard deviations that are NaN come from the next method.
    - ``coef_scale(left_over, size)`` returns standard deviations (k, p) in units of the data: ``left_over`` (o,) is the
      rms of what the prior mean of all features leaves of y, and ``size`` (p,) that of each feature. Those that are
      still NaN are wide.
    - ``coef_groups(n_outputs)`` returns the labels (k, p) of groups of weights, whose scales are learned.

    A part without the first has mean 0 and wide scales. Only the first row of X is used, to find the widths of the
    parts. ``allow_vague`` allows infinite scales. Raises a ValueError if a shape does not fit, a value is not finite, a
    scale is negative, a covariance is not positive semi-definite, or weights of two groups are correlated.
    """
    shape, shared = data.shape, n_outputs > data.shape[0]
    for name in ("mean", "scale", "cov", "groups"):
        value = getattr(prior, name)
        if feature_map is None and (isinstance(value, list | tuple) or np.ndim(value) > 0):
            raise ValueError(f"{name} of CoefPrior needs a feature_map, because its features have the weights.")
    if prior.cov is not None and _word(prior.scale) != "auto":
        raise ValueError(
            f"cov and scale={prior.scale!r} of CoefPrior both set the prior covariance. Pass one of them only."
        )
    by_hand = _word(prior.scale) != "auto" or prior.cov is not None
    parts: list[_Part] = []
    if feature_map is not None and not (by_hand and _word(prior.mean) != "auto"):
        parts = list(_parts(feature_map, safe_indexing(X, slice(0, 1)), np.arange(shape[1])))
    mean, scale, correlation = np.zeros(shape), np.full(shape, np.nan), _independent(shape)
    for part in parts:
        part_shape = shape[0], len(part.columns)
        part_mean, part_scale, part_correlation = _own_prior(part.feature_map, n_outputs, part_shape)
        mean[:, part.columns] = part_mean / part.weight
        scale[:, part.columns] = part_scale / abs(part.weight)
        correlation[:, part.columns[:, np.newaxis], part.columns] = part_correlation
    if _word(prior.mean) != "auto":
        mean = _as_table(prior.mean, "mean of CoefPrior", shape, shared)
    _check_finite(mean, "mean of CoefPrior")
    scale_name, unknown = 'scale="auto" of CoefPrior, from the feature map or the data,', np.zeros(shape, dtype=bool)
    if prior.cov is not None:
        scale, correlation = _of_covariance(prior.cov, "cov of CoefPrior", shape)
    elif by_hand:
        scale_name = "scale of CoefPrior"
        scale, correlation = _as_table(prior.scale, scale_name, shape, shared), _independent(shape)
    else:
        scale = _in_units_of_data(scale, mean, parts, data)
        unknown = np.isnan(scale)
        scale = np.where(unknown, data.wide(False), scale) if unknown.any() else scale
    _check_finite(np.where(scale == np.inf, 1.0, scale) if allow_vague else scale, scale_name)
    if (scale < 0).any():
        raise ValueError(f"scale of CoefPrior must not be negative; its smallest value is {scale.min()}.")
    groups = _groups(prior, parts, n_outputs, shape, by_hand)
    groups[(scale == 0.0) | np.isinf(scale)] = ""
    if (learned := unknown & (groups != "")).any():
        scale = np.where(learned, data.wide(True), scale)
    mean, scale = mean.astype(float), scale.astype(float)
    if (correlation == _independent(shape)).all():
        return Resolved(mean, scale, None, groups)
    root = np.array([root_of_correlation(matrix, labels) for matrix, labels in zip(correlation, groups, strict=True)])
    return Resolved(mean, scale, scale[:, :, np.newaxis] * root, groups)


def _check_finite(values: np.ndarray, name: str) -> None:
    if not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite; it holds {values[~np.isfinite(values)][0]}.")
    check_magnitude(values, name)


def _in_units_of_data(scale: np.ndarray, mean: np.ndarray, parts: Sequence[_Part], data: InData) -> np.ndarray:
    """Scales (k, p) in which those that are NaN are taken from the sizes of the data, if a map knows how."""
    scale = scale.copy()
    asking = [part for part in parts if hasattr(part.feature_map, "coef_scale") and np.isnan(scale).any()]
    left_over = data.left_over(mean) if asking else np.empty(0)
    for part in asking:
        # A feature that is 0 on all rows has no size. Its weight may have any scale.
        size = data.size[..., part.columns] / abs(part.weight)
        part_scale = as_floats(
            part.feature_map.coef_scale(left_over, np.where(size > 0.0, size, 1.0)), "A scale of a map"
        )
        allowed = _shapes((len(mean), len(part.columns)))
        if part_scale.shape not in allowed:
            raise ValueError(
                f"coef_scale of {part.feature_map!r} must return standard deviations of the shape {allowed[0]}; got "
                f"{part_scale.shape}."
            )
        part_scale = part_scale.reshape(allowed[0]) / abs(part.weight)
        missing = np.isnan(scale[:, part.columns])
        scale[:, part.columns] = np.where(missing, part_scale, scale[:, part.columns])
    return scale


def _groups(
    prior: CoefPrior, parts: Sequence[_Part], n_outputs: int, shape: tuple[int, int], by_hand: bool
) -> np.ndarray:
    """The labels (k, p) of the groups of weights with learned scales. Empty: the scale stays."""
    groups = np.full(shape, "", dtype=object)
    if prior.groups is None:
        return groups
    if _word(prior.groups) != "auto":
        labels = np.asarray(prior.groups, dtype=object)
        if labels.shape not in _shapes(shape) and labels.shape != shape[1:]:
            raise ValueError(
                f"groups of CoefPrior must be 'auto', None or the labels of all weights, of the shape {shape[1:]} or "
                f"{shape}; got the shape {labels.shape}."
            )
        groups[...] = labels
        groups[np.array([[label is None for label in row] for row in groups], dtype=bool)] = ""
        if not all(isinstance(label, str) for label in groups.ravel()):
            raise ValueError(f"groups of CoefPrior must be strings or None; got {prior.groups!r}.")
        return groups
    labelled = [part for part in parts if hasattr(part.feature_map, "coef_groups")]
    for part in [] if by_hand else labelled:
        allowed = _shapes((shape[0], len(part.columns)))
        labels = np.asarray(part.feature_map.coef_groups(n_outputs), dtype=object)
        if labels.shape not in allowed:
            raise ValueError(
                f"coef_groups of {part.feature_map!r} must return labels of the shape {allowed[0]}; got {labels.shape}."
            )
        labels = labels.reshape(allowed[0])
        prefix = f"{part.name}: " if len(labelled) > 1 and part.name else ""
        groups[:, part.columns] = [[f"{prefix}{label}" if label else "" for label in row] for row in labels]
    return groups


def root_of_correlation(correlation: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """A C (p, p) with C Cᵀ = ``correlation``, in which weights of different groups have nothing in common."""
    root = np.zeros(correlation.shape)
    for group in dict.fromkeys(groups):
        members = np.flatnonzero(groups == group)
        if correlation[members][:, groups != group].any():
            raise ValueError(
                f"Weights of different groups must be independent; those of the group {group!r} are correlated with "
                "others. CoefPrior(groups=None) keeps all scales."
            )
        eigenvalues, vectors = eigh(correlation[np.ix_(members, members)])
        root[np.ix_(members, members)] = vectors * np.sqrt(np.maximum(eigenvalues, 0.0))
    return root


def _independent(shape: tuple[int, int]) -> np.ndarray:
    """The correlation (k, p, p) of independent weights."""
    return np.repeat(np.eye(shape[1])[np.newaxis], shape[0], axis=0)


def _of_covariance(covariance: ArrayLike, name: str, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations (k, p) and correlations (k, p, p) of a covariance, checked."""
    k, p = shape
    values = as_floats(covariance, name)
    if values.shape not in ((p, p), (k, p, p)):
        alternative = f", or one such for each output, {(k, p, p)}" if k > 1 else ""
        raise ValueError(
            f"{name} must be of the shape (n_features_out, n_features_out) = {(p, p)}{alternative}; got the shape "
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
    triangles: np.ndarray, n_rows: float, target_size: np.ndarray, shared: bool = False, moderate: bool = False
) -> np.ndarray:
    """The scale of weights without prior knowledge: (o, p), or (1, p) if they are shared.

    ``triangles`` (k, r, p) are R with HᵀΩH = RᵀR, one for all outputs or o, and ``n_rows`` is Σω. ``target_size`` (o,)
    is the largest absolute value of each target, or its rms for a ``moderate`` scale: for few rows, and for the start
    of scales that are learned. For shared weights the widest scale of all outputs counts.
    """
    # With |y| ≤ a on all rows, least squares gives no weight above a √(Σω (HᵀΩH)⁻¹_jj) (by Cauchy-Schwarz). That is
    # a / rms of the part of h_j that the other features cannot represent. For powers of a column far from 0, it is far
    # above a / rms(h_j).
    o, p = len(target_size), triangles.shape[-1]
    size = np.where(target_size > 0.0, target_size, 1.0)
    of_zeros = size.max() if shared else size[:, np.newaxis]
    triangles = np.broadcast_to(triangles, (o, *triangles.shape[1:]))
    alone = size[:, np.newaxis] / np.where((rms := _sizes(triangles) / np.sqrt(n_rows)) > 0.0, rms, np.inf)
    if shared:
        alone = alone.max(axis=0, keepdims=True)
    if moderate:
        return _MODERATE * np.where(alone > 0.0, alone, of_zeros)
    if shared:
        # The rows of all outputs, in units of their targets.
        triangles = np.linalg.qr((triangles / size[:, np.newaxis, np.newaxis]).reshape(-1, p)).R[np.newaxis]
        n_rows, size = n_rows * o, np.ones(1)
    largest = np.array([np.sqrt(n_rows) * unit * _dual_sizes(R) for unit, R in zip(size, triangles, strict=True)])
    largest = np.maximum(largest, alone)
    return _WIDE * np.where(largest > 0.0, largest, of_zeros)


def _sizes(triangles: np.ndarray) -> np.ndarray:
    """√ of the diagonal of RᵀR (..., p)."""
    largest = np.abs(triangles).max(axis=-2, initial=0.0)
    unit = np.where(largest > 0.0, largest, 1.0)
    sizes: np.ndarray = unit * np.sqrt(np.sum((triangles / unit[..., np.newaxis, :]) ** 2, axis=-2))
    return np.where(largest > 0.0, sizes, 0.0)


def _dual_sizes(R: np.ndarray) -> np.ndarray:
    """√ of the diagonal (p,) of (RᵀR)⁺, without digits that rounding may have changed. 0 for a column of zeros."""
    sizes = _sizes(R)
    seen = sizes > 0.0
    dual_sizes = np.zeros(len(sizes))
    if seen.any():
        _, values, vectors = svd(R[:, seen] / sizes[seen], full_matrices=False, lapack_driver="gesvd")
        kept = values > _COLLINEAR * values[0]
        by = np.maximum(values[kept], _INDEPENDENT * values[0])
        dual_sizes[seen] = np.sqrt(np.sum((vectors[kept] / by[:, np.newaxis]) ** 2, axis=0)) / sizes[seen]
    return dual_sizes


class _Part(NamedTuple):
    """A map inside pipelines and unions: its columns of h(x), and the number that they are multiplied by."""

    feature_map: Any
    columns: np.ndarray
    weight: float
    name: str


def _parts(feature_map: Any, first: Any, columns: np.ndarray, name: str = "") -> Iterator[_Part]:
    """The maps with a prior inside pipelines and unions, given the first row of their X."""
    if any(hasattr(feature_map, method) for method in ("coef_prior", "coef_scale", "coef_groups")):
        yield _Part(feature_map, columns, 1.0, name)
    elif isinstance(feature_map, Pipeline):
        steps = steps_of(feature_map)
        for step in steps[:-1]:
            first = step.transform(first)
        if steps:
            yield from _parts(steps[-1], first, columns, name)
    else:
        for part in parts_of_union(feature_map, first):
            part_name = f"{name}: {part.name}" if name else part.name
            for inner in _parts(part.transformer, part.rows, columns[part.columns], part_name):
                yield inner._replace(weight=part.weight * inner.weight)


def says_shared(feature_map: Any) -> bool:
    """Whether a fitted feature map says that all outputs have the same weights. All parts of a union must say so."""
    if hasattr(feature_map, "share_coef"):
        return bool(feature_map.share_coef)
    if isinstance(feature_map, Pipeline):
        parts = steps_of(feature_map)[-1:]
    elif isinstance(feature_map, FeatureUnion):
        parts = [part for _, part in feature_map.transformer_list if part != "drop"]
    elif isinstance(feature_map, ColumnTransformer):
        parts = [part for _, part, _ in feature_map.transformers_ if part != "drop"]
    else:
        return False
    return bool(parts) and all(map(says_shared, parts))


def _own_prior(feature_map: Any, n_outputs: int, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The result of a map's ``coef_prior``, checked."""
    if not hasattr(feature_map, "coef_prior"):
        return np.zeros(shape), np.full(shape, np.nan), _independent(shape)
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


def coef_names(feature_map: Any, columns: np.ndarray | None, n_features: int, letter: str = "h") -> np.ndarray:
    """Names of the features of a fitted map. "h0", "h1", ... (with ``letter``) if it has none."""
    try:
        names = np.asarray([str(name) for name in feature_map.get_feature_names_out(columns)], dtype=object)
    except (AttributeError, TypeError, ValueError):
        names = np.empty(0, dtype=object)
    if len(names) == n_features:
        return names
    return np.array([f"{letter}{index}" for index in range(n_features)], dtype=object)
