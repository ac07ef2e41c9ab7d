"""Feature maps with parameters θ inside pipelines and unions, and their linearisation in θ."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.compose import ColumnTransformer
from sklearn.pipeline import FeatureUnion, Pipeline

from ..data.maps import transformed
from ..features import ParametricFeatures
from ..features.theta import Prior, check_prior
from ..utils.casadi import casadi
from ..utils.frames import as_fitted
from ..utils.sklearn import safe_indexing
from .base import Map, NoExpressionError, adapts, as_map
from .sklearn import parts_of_union, steps_of

# --- the parameters of nested maps ------------------------------------------------------------------------------------


def maps_with_theta(feature_map: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The maps with parameters inside pipelines and unions, each with its name there."""
    if isinstance(feature_map, Pipeline):
        for own, step in feature_map.steps:
            yield from maps_with_theta(step, f"{name}{own}__")
    elif isinstance(feature_map, (FeatureUnion, ColumnTransformer)):
        fitted = getattr(feature_map, "transformers_", None) or getattr(feature_map, "transformer_list", [])
        for own, part, *_ in fitted:
            yield from maps_with_theta(part, f"{name}{own}__")
    elif callable(getattr(feature_map, "theta_prior", None)) and feature_map.theta_prior():
        yield name, feature_map


@dataclass(frozen=True)
class Theta:
    """The parameters of all maps inside a feature map."""

    maps: tuple[Any, ...]
    # For each parameter: the index of its map, its name there and for the user, its prior and its unit.
    owners: tuple[int, ...]
    own_names: tuple[str, ...]
    names: tuple[str, ...]
    priors: tuple[Prior, ...]
    units: tuple[str, ...]

    @classmethod
    def of(cls, feature_map: Any) -> Theta | None:
        """The parameters of a fitted map, or None if it has none."""
        found = list(maps_with_theta(feature_map)) if feature_map is not None else []
        if not found:
            return None
        owners, own_names, full, priors, units = [], [], [], [], []
        for index, (prefix, own) in enumerate(found):
            for name, prior in own.theta_prior().items():
                check_prior(prior, name)
                owners.append(index)
                own_names.append(name)
                full.append(f"{prefix}{name}")
                priors.append(prior)
                units.append(str((getattr(own, "units", None) or {}).get(name, "")))
        # Names of parts are only needed if two parameters have the same name.
        names = [own if own_names.count(own) == 1 else long for own, long in zip(own_names, full, strict=True)]
        maps = tuple(own for _, own in found)
        return cls(maps, tuple(owners), tuple(own_names), tuple(names), tuple(priors), tuple(units))

    def __len__(self) -> int:
        return len(self.names)

    def values(self, z: np.ndarray) -> np.ndarray:
        """The values (q,) at coordinates z (q,), which are standard normal a priori."""
        return np.array([prior.value(float(own)) for prior, own in zip(self.priors, z, strict=True)])

    def slopes(self, z: np.ndarray) -> np.ndarray:
        """The derivatives (q,) of the values in z."""
        return np.array([prior.slope(float(own)) for prior, own in zip(self.priors, z, strict=True)])

    def coordinates(self) -> np.ndarray:
        """The coordinates z (q,) of the present values."""
        each = zip(self.priors, self.owners, self.own_names, strict=True)
        return np.array([prior.coordinate(self.maps[owner].theta_[name]) for prior, owner, name in each])

    def set(self, z: np.ndarray) -> None:
        """Set the parameters of the maps to coordinates z (q,)."""
        values = self.values(z)
        for index, own in enumerate(self.maps):
            mine = [i for i, owner in enumerate(self.owners) if owner == index]
            own.set_theta({self.own_names[i]: float(values[i]) for i in mine})


def theta_jacobian(feature_map: Any, rows: Any, theta: Theta) -> np.ndarray:
    """∂h/∂z of each row, (n, p, q) or (n, o, p, q), for some rows of the input of a fitted map."""
    slopes = theta.slopes(theta.coordinates())
    found = _jacobian(feature_map, rows, theta)
    if found is None:
        raise AssertionError("a map without parameters")
    return found * slopes


def _jacobian(feature_map: Any, rows: Any, theta: Theta) -> np.ndarray | None:
    """∂h/∂θ of each row. None: it is 0."""
    q = len(theta)
    for index, own in enumerate(theta.maps):
        if own is feature_map:
            mine = [i for i, owner in enumerate(theta.owners) if owner == index]
            slope = np.asarray(own.theta_jacobian(np.asarray(rows, dtype=np.float64)), dtype=np.float64)
            found = np.zeros((*slope.shape[:-1], q))
            found[..., mine] = slope
            return found
    if isinstance(feature_map, Pipeline):
        jacobian: np.ndarray | None = None
        for step in steps_of(feature_map):
            # dh/dθ = ∂h/∂θ + ∂h/∂z dz/dθ, for the steps' inputs z.
            own_jacobian = _jacobian(step, rows, theta)
            if jacobian is not None:
                onward = as_map(step, example=rows).chain(np.asarray(rows, dtype=np.float64), jacobian)
                own_jacobian = onward if own_jacobian is None else onward + own_jacobian
            jacobian, rows = own_jacobian, transformed(step, rows)
        return jacobian
    parts = list(parts_of_union(feature_map, rows))
    each = [(part, _jacobian(part.transformer, part.rows, theta)) for part in parts]
    known = [jacobian for _, jacobian in each if jacobian is not None]
    if not known:
        return None
    # If some parts have a row for each output, the others are repeated for each output (see `data.maps.transformed`).
    width = np.shape(transformed(feature_map, safe_indexing(rows, slice(0, 1))))[1:]
    found = np.zeros((len(known[0]), *width, q))
    for part, jacobian in each:
        if jacobian is not None:
            wide = jacobian[:, np.newaxis] if jacobian.ndim < found.ndim else jacobian
            found[..., part.columns, :] = part.weight * wide
    return found


# --- the linearisation ------------------------------------------------------------------------------------------------


class LinearizedFeatures(TransformerMixin, BaseEstimator):
    """The features h(x; θ) of a fitted map, and after them the columns of ∂h/∂z that are not 0.

    The weights of the columns are products of β and of deviations of z, so that the model stays linear in its weights.
    """

    def __init__(self, feature_map: Any, columns: np.ndarray):
        # ``columns`` (d, 2) are the feature and the parameter of each column of ∂h/∂z.
        self.feature_map = feature_map
        self.columns = columns

    def fit(self, X: Any, y: Any = None) -> LinearizedFeatures:
        """Do nothing: the map is fitted."""
        return self

    def transform(self, X: Any) -> np.ndarray:
        """Return h(x) and the columns, (n, p + d) or (n, o, p + d)."""
        return self.join(np.asarray(transformed(self.feature_map, X), dtype=np.float64), X)

    def join(self, features: np.ndarray, X: Any) -> np.ndarray:
        """Append the columns of ∂h/∂z to features."""
        theta = Theta.of(self.feature_map)
        assert theta is not None
        jacobian = theta_jacobian(self.feature_map, X, theta)
        return np.concatenate([features, jacobian[..., self.columns[:, 0], self.columns[:, 1]]], axis=-1)

    def __sklearn_is_fitted__(self) -> bool:
        return True


@adapts(LinearizedFeatures)
class Linearized(Map):
    """The adapter of `LinearizedFeatures`."""

    def __init__(self, transformer: LinearizedFeatures, example: Any = None):
        super().__init__(transformer, example)
        self._features = as_map(transformer.feature_map, example=example)

    def value(self, X: np.ndarray) -> np.ndarray:
        features = self._features.value(X)
        return self.transformer.join(features, as_fitted(self.transformer.feature_map, X, self._package))

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        # Only the columns of ∂h/∂z need differences.
        found = self._differences(X)
        inner = self._features.jacobian(X)
        found[..., : inner.shape[-2], :] = inner
        return found

    def casadi(self, x: Any) -> Any:
        # The features of a copy whose parameters are symbols, and their derivatives in these.
        ca, feature_map = casadi(), deepcopy(self.transformer.feature_map)
        theta = Theta.of(feature_map)
        assert theta is not None
        z = theta.coordinates()
        symbols, values = ca.MX.sym("theta", len(theta)), ca.DM(theta.values(z))
        for index, own in enumerate(theta.maps):
            if not getattr(as_map(own), "symbolic_theta", False):
                raise NoExpressionError(f"The parameters of {own!r} cannot be written in CasADi.")
            names = [(i, theta.own_names[i]) for i, owner in enumerate(theta.owners) if owner == index]
            own.theta_ = {name: symbols[i] for i, name in names}
        features = as_map(feature_map).casadi(x)
        found = []
        for own in features if isinstance(features, list) else [features]:
            slopes = ca.mtimes(ca.jacobian(own, symbols), ca.diag(ca.DM(theta.slopes(z))))
            columns = [slopes[int(i), int(j)] for i, j in self.transformer.columns]
            found.append(ca.graph_substitute(ca.vertcat(own, *columns), [symbols], [values]))
        return found if isinstance(features, list) else found[0]


@adapts(ParametricFeatures)
class OfFunction(Map):
    """The adapter of `ParametricFeatures`: values without validation, and expressions of scalars."""

    by_example = False
    # Whether `casadi` takes the parameters from ``theta_`` as symbols.
    symbolic_theta = True

    @classmethod
    def of(cls, transformer: ParametricFeatures, example: Any) -> Map:
        return cls(transformer)

    def value(self, X: np.ndarray) -> np.ndarray:
        return self.transformer._values(X)

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        return self.transformer._slopes(X)

    def casadi(self, x: Any) -> Any:
        ca, theta = casadi(), self.transformer.theta_
        row, symbols = ca.SX.sym("x", x.numel()), ca.SX.sym("theta", len(theta))
        named = {name: symbols[i] for i, name in enumerate(theta)}
        try:
            found = self.transformer._expressions([row[i] for i in range(x.numel())], named)
        except Exception as error:
            raise NoExpressionError(
                f"{self.transformer!r} cannot be written in CasADi: {error} Its function must also work on an array of "
                "symbols, as arithmetic and functions like np.sin do."
            ) from error
        outputs = [ca.vertcat(*own) for own in found]
        function = ca.Function("features", [row, symbols], outputs)
        expressions = function.call([x, ca.vertcat(*theta.values())])
        return expressions if self.transformer._ndim == 3 else expressions[0]
