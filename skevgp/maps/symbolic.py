"""Transformers in CasADi: what a fitted map makes of one symbolic row.

A map of none of the types below can say it itself, by a method ``to_casadi(x)``: x is an MX of shape (n_features, 1),
and it returns an MX of shape (n_features_out, 1), or a list of these with one per output.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import numpy as np
from sklearn import decomposition, preprocessing
from sklearn.compose import ColumnTransformer
from sklearn.pipeline import FeatureUnion, Pipeline

from ..features import AngleEncoder, InertiaForce, InertiaForceGravity, LinkGravity, NominalDynamics
from ..features.gravity import SineGravity
from ..utils.casadi import casadi
from .maps import column_indices
from .symbolic_rigid_body import SymbolicRigidBody

# Of one row: a column (width, 1), or one for each output.
Mapped = Any


def mapped(fitted_map: Any, x: Mapped, name: str) -> Mapped:
    """What a fitted map makes of a row.

    Parameters
    ----------
    fitted_map : transformer, "passthrough" or None
        The last two leave the row as it is.
    x : casadi.MX of shape (d, 1), or list of these
        The row, or one for each output.
    name : str
        The argument's name, for errors.

    Returns
    -------
    row : casadi.MX of shape (width, 1), or list of these
        A list has a row for each output.

    Raises
    ------
    TypeError
        If the map, or a part of it, has no expression in CasADi; the message names it and lists those that do.
    """
    if fitted_map is None or (isinstance(fitted_map, str) and fitted_map == "passthrough"):
        return x
    if isinstance(x, list):
        raise TypeError(f"{name}: {fitted_map!r} comes after a map that returns a row for each output. {WORKING}")
    if hasattr(fitted_map, "to_casadi"):
        return fitted_map.to_casadi(x)
    if type(fitted_map) in _CONTAINERS:
        return _CONTAINERS[type(fitted_map)](fitted_map, x, name)
    if type(fitted_map) in _EXPRESSIONS:
        return _EXPRESSIONS[type(fitted_map)](fitted_map, x)
    raise TypeError(f"{name}: {fitted_map!r} cannot be written in CasADi. {WORKING}")


# --- maps of maps ----------------------------------------------------------------------------------------------------


def _pipeline(pipeline: Pipeline, x: Any, name: str) -> Mapped:
    for _, step in pipeline.steps:
        x = mapped(step, x, name)
    return x


def _union(union: FeatureUnion, x: Any, name: str) -> Mapped:
    weights = union.transformer_weights or {}
    parts = [
        _times(mapped(part, x, name), weights.get(called, 1.0))
        for called, part in union.transformer_list
        if not _is_dropped(part)
    ]
    return _side_by_side(parts)


def _columns(transformer: ColumnTransformer, x: Any, name: str) -> Mapped:
    weights = transformer.transformer_weights or {}
    names = list(getattr(transformer, "feature_names_in_", []))
    parts = []
    for called, part, columns in transformer.transformers_:
        indices = column_indices(columns, names, transformer.n_features_in_).tolist()
        if indices and not _is_dropped(part):
            parts.append(_times(mapped(part, _taken(x, indices), name), weights.get(called, 1.0)))
    return _side_by_side(parts)


def _is_dropped(part: Any) -> bool:
    return isinstance(part, str) and part == "drop"


def _times(row: Mapped, weight: float) -> Mapped:
    if weight == 1.0:
        return row
    return [own * float(weight) for own in row] if isinstance(row, list) else row * float(weight)


def _side_by_side(parts: list[Mapped]) -> Mapped:
    """Columns of all parts; of parts with a row for each output, and others with one for all, those of each output."""
    ca = casadi()
    if not parts:
        return ca.MX(0, 1)
    sizes = [len(part) for part in parts if isinstance(part, list)]
    if not sizes:
        return ca.vertcat(*parts)
    return [ca.vertcat(*(part[o] if isinstance(part, list) else part for part in parts)) for o in range(sizes[0])]


def _taken(x: Any, indices: Any) -> Any:
    """Some of a row's columns, in this order; the row itself if they are all of it."""
    indices = np.asarray(indices).tolist()
    return x if indices == list(range(x.numel())) else x[indices]


# --- scikit-learn's --------------------------------------------------------------------------------------------------


def _scaled(x: Any, factor: np.ndarray | None, offset: np.ndarray | None = None) -> Any:
    """(x - offset) * factor, without what is None."""
    ca = casadi()
    x = x if offset is None else x - ca.DM(np.array(offset, dtype=float))
    return x if factor is None else x * ca.DM(np.array(factor, dtype=float))


def _inverse(scale: Any) -> np.ndarray | None:
    return None if scale is None else 1.0 / np.asarray(scale, dtype=float)


def _standard(scaler: Any, x: Any) -> Any:
    return _scaled(x, _inverse(scaler.scale_), scaler.mean_ if scaler.with_mean else None)


def _robust(scaler: Any, x: Any) -> Any:
    return _scaled(x, _inverse(scaler.scale_), scaler.center_)


def _min_max(scaler: Any, x: Any) -> Any:
    ca = casadi()
    x = _scaled(x, scaler.scale_) + ca.DM(np.array(scaler.min_))
    return ca.fmin(ca.fmax(x, scaler.feature_range[0]), scaler.feature_range[1]) if scaler.clip else x


def _max_abs(scaler: Any, x: Any) -> Any:
    ca = casadi()
    x = _scaled(x, _inverse(scaler.scale_))
    return ca.fmin(ca.fmax(x, -1.0), 1.0) if getattr(scaler, "clip", False) else x


def _polynomial(features: Any, x: Any) -> Any:
    """Each monomial as a product of as many factors as the degree is, some of them 1."""
    ca = casadi()
    powers = features.powers_
    one = powers.shape[1]
    factors = [np.repeat(np.arange(one), own).tolist() for own in powers]
    degree = max(map(len, factors))
    padded = np.array([own + [one] * (degree - len(own)) for own in factors], dtype=int).reshape(len(powers), degree)
    row, found = ca.vertcat(x, 1.0), ca.DM.ones(len(powers))
    for column in padded.T:
        found = found * row[column.tolist()]
    return found


def _principal(pca: Any, x: Any) -> Any:
    components = pca.components_
    if getattr(pca, "whiten", False):
        deviations = np.sqrt(pca.explained_variance_)
        components = components / np.maximum(deviations, np.finfo(float).eps)[:, np.newaxis]
    return casadi().mtimes(casadi().DM(components), _scaled(x, None, getattr(pca, "mean_", None)))


def _function(transformer: Any, x: Any) -> Any:
    """Of a FunctionTransformer that does nothing, or by a function of NumPy that CasADi has too."""
    func = transformer.func
    if func is None:
        return x
    if func in _UFUNCS and not transformer.kw_args:
        return getattr(casadi(), _UFUNCS[func])(x)
    raise TypeError(
        f"{transformer!r} cannot be written in CasADi, as functions of NumPy on their own can be "
        f"({', '.join(function.__name__ for function in _UFUNCS)}). Write a transformer with a method to_casadi(x)."
    )


_UFUNCS: dict[Any, str] = {
    np.sin: "sin",
    np.cos: "cos",
    np.tan: "tan",
    np.tanh: "tanh",
    np.exp: "exp",
    np.log: "log",
    np.log1p: "log1p",
    np.sqrt: "sqrt",
    np.abs: "fabs",
}


# --- our own ---------------------------------------------------------------------------------------------------------


def _by_steps(expression: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Of features of [q, q̇, u] what `RobotMap` makes of them where a row ends with its time step."""

    @wraps(expression)
    def found(features: Any, x: Any) -> Any:
        if not features._timed:
            return expression(features, x)
        return casadi().vertcat(x[: features._n_kept(features._layout)], x[-1] * expression(features, x[:-1]))

    return found


@_by_steps
def _as_it_is(features: Any, x: Any) -> Any:
    return x


def _angles(encoder: Any, x: Any) -> Any:
    ca = casadi()
    if not len(encoder._angles):
        return x
    turned = _taken(x, encoder._angles)
    row, n = ca.vertcat(x, ca.sin(turned), ca.cos(turned)), x.numel()
    source = encoder._source.copy()
    source[encoder._sines] = n + np.arange(len(encoder._angles))
    source[encoder._cosines] = n + len(encoder._angles) + np.arange(len(encoder._angles))
    return row[source.tolist()]


@_by_steps
def _newton_gravity(features: Any, x: Any) -> Any:
    return casadi().vertcat(x, mapped(features._gravity, x, "feature_map"))


def _sines(features: Any, x: Any) -> Any:
    ca = casadi()
    if features.robot is None:
        return ca.sin(x)
    angles = np.zeros((len(features._terms()), x.numel()))
    for own, term in zip(angles, features._terms(), strict=True):
        own[list(term.angle)] = 1.0
    if (angles.sum(axis=1) == 1.0).all():
        return ca.sin(_taken(x, angles.argmax(axis=1)))
    return ca.sin(ca.mtimes(ca.DM(angles), x))


@_by_steps
def _link_gravity(features: Any, x: Any) -> Any:
    """Gravity passed on from each link to the next, as `LinkGravity` does it."""
    if features.robot is None:
        return x
    ca, links = casadi(), features._links
    weights: list[Any] = []
    for i, parent in enumerate(links._parents):
        rotation = ca.DM(links._fixed[i, 0] + (0.0 if links._turns[i].any() else links._cosine[i, 0]))
        if links._turns[i].any():
            rotation = rotation + ca.cos(x[i]) * ca.DM(links._cosine[i, 0]) + ca.sin(x[i]) * ca.DM(links._sine[i, 0])
        before = weights[parent] if parent >= 0 else ca.DM(links._weight.reshape(1, 3))
        weights.append(ca.mtimes(before, rotation))
    return _taken(ca.horzcat(*weights).T, features._columns) * ca.DM(features._signs)


@_by_steps
def _nominal(features: Any, x: Any) -> Any:
    """As a function of scalars, inside: a tenth of the time that matrices of 6 x 6 would take."""
    if features.robot is None:
        return x
    ca, layout = casadi(), features._layout
    n, body = layout.n_joints, SymbolicRigidBody(features._body.model)
    row = ca.MX.sym("x", x.numel())
    q, v = row[:n], row[n : 2 * n]
    force = ca.MX.zeros(n, 1)
    force[list(layout.driven)] = row[2 * n :]
    terms = {
        "acceleration": lambda: body.accelerations_under(q, v, force),
        "gravity": lambda: body.gravity(q),
        "bias": lambda: body.forces(q, v, None),
        "input": lambda: body.accelerations(q, None, force, gravity=False),
    }
    found = ca.vertcat(*(terms[term]() for term in features._terms))
    return ca.Function("nominal_dynamics", [row], [found]).expand()(x)


_CONTAINERS: dict[type, Callable[[Any, Any, str], Mapped]] = {
    Pipeline: _pipeline,
    FeatureUnion: _union,
    ColumnTransformer: _columns,
}
_EXPRESSIONS: dict[type, Callable[[Any, Any], Mapped]] = {
    AngleEncoder: _angles,
    InertiaForce: _as_it_is,
    InertiaForceGravity: _newton_gravity,
    LinkGravity: _link_gravity,
    NominalDynamics: _nominal,
    SineGravity: _sines,
    preprocessing.StandardScaler: _standard,
    preprocessing.MinMaxScaler: _min_max,
    preprocessing.MaxAbsScaler: _max_abs,
    preprocessing.RobustScaler: _robust,
    preprocessing.PolynomialFeatures: _polynomial,
    preprocessing.FunctionTransformer: _function,
    decomposition.PCA: _principal,
    decomposition.TruncatedSVD: _principal,
}
# For people.
_NAMES = [kind.__name__ for kind in (*_EXPRESSIONS, *_CONTAINERS) if kind is not SineGravity]
WORKING = (
    f"These can be exported: {', '.join(_NAMES)}, and any transformer with a method to_casadi(x), from an MX of shape "
    "(n_features, 1) to one of shape (n_features_out, 1) or, of a map with a row for each output, a list of these."
)
