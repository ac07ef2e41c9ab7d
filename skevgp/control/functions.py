"""Functions drawn from the posterior.

`FunctionSamples` can be evaluated anywhere, by random waves. `Paths` are exact, but each function is evaluated only
along a path that it makes itself, one row after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from operator import index as as_index
from typing import Any

import numpy as np

from ..data.rows import of_outputs, times_weights
from ..kernels.waves import RandomFunctions, random_functions
from ..maps import Map
from ..model.predictor import Predictor, PredictorGroup, Projected
from ..utils.shapes import like_y
from .derivatives import MappedRows, chained, mapped

# Numbers at once in the derivatives of all waves, and in what all paths keep that are followed together.
_NUMBERS_OF_WAVES, _NUMBERS_OF_PATHS = 2**22, 2**24
# In units of k̃(x, x): a row of which less is left is known from those before.
_KNOWN = 1e-13


@dataclass(frozen=True)
class Functions:
    """The posterior of a fitted model as functions of X, to be drawn and followed.

    Attributes
    ----------
    predictor : Predictor
    feature_map, kernel_map : Map or None
    base : ndarray of shape (k, o), optional
        The columns of X that are added to the outputs.
    """

    predictor: Predictor
    feature_map: Map | None
    kernel_map: Map | None
    base: np.ndarray | None = None

    @property
    def noise(self) -> np.ndarray:
        """σ² of each output, (o,)."""
        return self.predictor.noise

    def mapped(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The kernel's inputs and the features of rows (n, D)."""
        features = np.empty((len(X), 0)) if self.feature_map is None else self.feature_map.value(X)
        return X if self.kernel_map is None else self.kernel_map.value(X), features

    def between(self, X: np.ndarray) -> np.ndarray:
        """Covariances (n, o, o) of different outputs of a row, which are 0 but where outputs share their weights."""
        if not self.predictor.shared:
            return np.zeros((len(X), len(self.noise), len(self.noise)))
        common = self.predictor.common(*self.mapped(X))
        return np.einsum("kni,knj->nij", common, common) * (1.0 - np.eye(len(self.noise)))

    def at_once(self, n_steps: int) -> int:
        """How many paths of so many steps to follow at once, so that memory stays small."""
        points = sum(len(group.points) for group in self.predictor.groups)
        return max(1, _NUMBERS_OF_PATHS // (n_steps * (n_steps * len(self.predictor.groups) + points)))

    def draw(self, n: int, n_steps: int, rng: np.random.RandomState) -> Callable[[np.ndarray], np.ndarray]:
        """A function of rows (n, D), one for each path, that returns the next g(x) of each, (n, o)."""
        paths = Paths(self.predictor, n, n_steps, rng)

        def step(X: np.ndarray) -> np.ndarray:
            values = paths.step(*self.mapped(X))
            return values if self.base is None else values + X[:, self.base].sum(axis=1)

        return step


def common_normals(predictor: Predictor, n: int, rng: np.random.RandomState) -> np.ndarray:
    """The normals (n, 1, p) of weights that all outputs share; p is 0 if they share none."""
    return rng.standard_normal((n, 1, predictor.offset.shape[1] if predictor.shared else 0))


def drawn_weights(group: PredictorGroup, n: int, common: np.ndarray, rng: np.random.RandomState) -> np.ndarray:
    """What P = [V; Hᵀ] is multiplied by in n functions drawn from q, (n, o, m + p)."""
    o, k, _ = group.root.shape
    normals, p = rng.standard_normal((n, o, k)), common.shape[2]
    if p:
        normals[:, :, k - p :] = common
    return group.mean + np.einsum("nok,okj->noj", normals, group.root, optimize=True)


# --- anywhere: random waves ------------------------------------------------------------------------------------------
# A function of the prior, made of random waves, is moved to what a draw of q says at the inducing points: with
# P = [V; Hᵀ], weights W drawn from q and f₀ = s aᵀΦ(x), a ~ N(0, I),
#
#     g(x) = W P + f₀(x) - vᵀ L⁻¹ f₀(X_m)
#
# (Matheron's rule; Wilson et al. 2020). Its mean and what comes from q are exact; how f varies between inducing points
# is as good as the waves are many.


class FunctionSamples(Sequence["SampledFunction"]):
    """Functions drawn from a posterior: a sequence of callables that can be called itself, for all of them at once.

    What it is called with is not validated: rows are float64 arrays with the columns of `fit`, finite and not empty.

    Parameters
    ----------
    posterior : Functions
    n : int
        How many functions.
    n_waves : int
        Random waves of each term of a kernel.
    rng : RandomState
    """

    def __init__(self, posterior: Functions, n: int, n_waves: int, rng: np.random.RandomState):
        predictor = posterior.predictor
        self._posterior = posterior
        common = common_normals(predictor, n, rng)
        self._groups = [_Waves.drawn(group, predictor, n, n_waves, common, rng) for group in predictor.groups]
        self._n = n

    def __len__(self) -> int:
        return self._n

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        position = as_index(index)
        if not -len(self) <= position < len(self):
            raise IndexError(f"There are {len(self)} functions; got the index {index}.")
        return SampledFunction(self, position % len(self))

    def __call__(self, X: np.ndarray) -> np.ndarray:
        """All functions at rows.

        Parameters
        ----------
        X : ndarray of shape (n_features,) or (n_rows, n_features)
            One row or several.

        Returns
        -------
        values : ndarray of shape (n_functions, n_rows, n_outputs)
            Without the axis of rows if X is one row, and without that of outputs if there is one.
        """
        return self._values(X, slice(None))

    def value_and_jacobian(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """All functions at rows, and how they change with the columns of X.

        Parameters
        ----------
        X : ndarray of shape (n_features,) or (n_rows, n_features)
            One row or several.

        Returns
        -------
        values : ndarray of shape (n_functions, n_rows, n_outputs)
            As of a call.
        jacobians : ndarray of shape (n_functions, n_rows, n_outputs, n_features)
            Likewise.
        """
        return self._values_and_jacobians(X, slice(None))

    def _values(self, X: np.ndarray, which: slice) -> np.ndarray:
        rows = X if X.ndim == 2 else X[np.newaxis]
        parts = []
        for piece in self._pieces(rows):
            inputs, features = self._posterior.mapped(piece)
            parts.append(self._finished(piece, [own.values(inputs, features, which) for own in self._groups]))
        return self._shaped(X, np.concatenate(parts, axis=1))

    def _values_and_jacobians(self, X: np.ndarray, which: slice) -> tuple[np.ndarray, np.ndarray]:
        rows, maps = X if X.ndim == 2 else X[np.newaxis], (self._posterior.feature_map, self._posterior.kernel_map)
        values, jacobians = [], []
        for piece in self._pieces(rows):
            behind = mapped(piece, *maps)
            values.append(
                self._finished(piece, [own.values(behind.inputs, behind.features, which) for own in self._groups])
            )
            found = self._posterior.predictor.in_order([own.slopes(behind, which) for own in self._groups])
            if self._posterior.base is not None:
                for columns in self._posterior.base:
                    found[np.arange(len(found)), :, :, columns] += 1.0
            jacobians.append(found.transpose(1, 2, 0, 3))
        found = np.concatenate(jacobians, axis=1)
        found = found[:, :, 0] if found.shape[2] == 1 else found
        return self._shaped(X, np.concatenate(values, axis=1)), found if X.ndim == 2 else found[:, 0]

    def _pieces(self, rows: np.ndarray) -> Iterator[np.ndarray]:
        waves = sum(own.n_waves * own.group.points.shape[1] for own in self._groups)
        size = max(1, _NUMBERS_OF_WAVES // waves)
        return (rows[first : first + size] for first in range(0, len(rows), size))

    def _finished(self, rows: np.ndarray, parts: list[np.ndarray]) -> np.ndarray:
        """Of the groups' values (o, k, n) those of all outputs, (k, n, o), with what is added."""
        predictor = self._posterior.predictor
        values = predictor.in_order(parts).transpose(1, 2, 0) + predictor.intercept
        return values if self._posterior.base is None else values + rows[:, self._posterior.base].sum(axis=1)

    @staticmethod
    def _shaped(X: np.ndarray, values: np.ndarray) -> np.ndarray:
        return like_y(values if X.ndim == 2 else values[:, 0])


@dataclass(frozen=True)
class SampledFunction:
    """One function drawn from a posterior.

    Attributes
    ----------
    of : FunctionSamples
        All that were drawn.
    index : int
        Which of them it is.
    """

    of: FunctionSamples
    index: int

    def __call__(self, X: np.ndarray) -> np.ndarray:
        """The noise-free g(x), of the shape that ``predict`` of the compiled model returns."""
        return self.of._values(X, self._which)[0]

    def value_and_jacobian(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same, and its derivatives in the columns of X."""
        values, jacobians = self.of._values_and_jacobians(X, self._which)
        return values[0], jacobians[0]

    @property
    def _which(self) -> slice:
        return slice(self.index, self.index + 1)


@dataclass(frozen=True)
class _Waves:
    """What the functions are of one group's outputs: weights times [V; Hᵀ; Φ].

    Attributes
    ----------
    group : PredictorGroup
    waves : RandomFunctions
        Φ.
    by_points : ndarray of shape (o, k, m)
        Of k functions.
    by_features : ndarray of shape (o, k, p)
    by_waves : ndarray of shape (o, k, L)
    """

    group: PredictorGroup
    waves: RandomFunctions
    by_points: np.ndarray
    by_features: np.ndarray
    by_waves: np.ndarray

    @classmethod
    def drawn(
        cls,
        group: PredictorGroup,
        predictor: Predictor,
        k: int,
        n_waves: int,
        common: np.ndarray,
        rng: np.random.RandomState,
    ) -> _Waves:
        """Draw k functions."""
        hyperparameters, (m, d) = np.log(group.hyperparameters), group.points.shape
        waves = random_functions(group.kernel, hyperparameters, n_waves, d, rng)
        at_points = waves.value(group.points)
        weights = drawn_weights(group, k, common, rng).transpose(1, 0, 2)
        by_waves = rng.standard_normal((len(group.signal), k, len(at_points)))
        # What is added to K's diagonal: the noise of the exact model, whose points are the rows; else a jitter.
        L, K = group.whitening.L, group.whitening.covariance.matrix()
        added = np.maximum(np.einsum("ij,ij->i", L, L) - np.diagonal(K), 0.0)
        seen = by_waves @ at_points + np.sqrt(added) * rng.standard_normal((len(by_waves), k, m))
        scale = np.sqrt(group.signal)[:, np.newaxis, np.newaxis]
        by_points = weights[:, :, :m] - scale * (seen @ group.whitening.L_inv.T)
        by_features = weights[:, :, m:] + predictor.offset[group.outputs][:, np.newaxis]
        return cls(group, waves, by_points, by_features, scale * by_waves)

    @property
    def n_waves(self) -> int:
        """L of all terms."""
        return self.by_waves.shape[2]

    def values(self, inputs: np.ndarray, features: np.ndarray, which: slice) -> np.ndarray:
        """Of some of the functions, at rows: (o, k, n)."""
        group = self.group
        own, features = of_outputs(inputs, group.outputs), of_outputs(features, group.outputs)
        V = group.whitening.L_inv @ group.whitening.covariance.cross(group.kernel.prepare(own))
        found = self.by_points[:, which] @ V + self.by_waves[:, which] @ self.waves.value(own)
        return found + self.by_features[:, which] @ features.T

    def slopes(self, rows: MappedRows, which: slice) -> np.ndarray:
        """∂/∂X, (o, k, n, D)."""
        group, (by_inputs, by_features) = self.group, rows.of(self.group)
        own = of_outputs(rows.inputs, group.outputs)
        (o, _, m), (n, d) = self.by_points.shape, own.shape
        from_cross, from_waves = self.by_points[:, which] @ group.whitening.L_inv, self.by_waves[:, which]
        k = from_cross.shape[1]
        slopes = group.whitening.covariance.slopes(group.kernel.prepare(own)).reshape(m, n * d)
        found = from_cross.reshape(o * k, m) @ slopes
        found += from_waves.reshape(o * k, -1) @ self.waves.slopes(own).reshape(-1, n * d)
        found = chained(found.reshape(o * k, n, d).transpose(1, 0, 2), by_inputs)  # (n, o k, D)
        found = found + self.by_features[:, which].reshape(o * k, -1) @ by_features
        return found.transpose(1, 0, 2).reshape(o, k, n, -1)


# --- along a path: exact ---------------------------------------------------------------------------------------------
# A draw of ω = (v, w) from q is what a function has of the inducing points and the weights. What these leave of f, a
# Gaussian process with the covariance k_res(x, x') = s² (k̃(x, x') - v(x)ᵀv(x')), is drawn at one row of the path after
# the other, given all rows before: with k_res = s² L Lᵀ along the path, f_res = s L ξ, where ξ is a standard normal per
# row and output, and L grows by a row. (Rasmussen & Williams 2006, appendix A.2: a Gaussian conditioned on part of it.)


class Paths:
    """n functions, evaluated at a row each, step by step.

    Parameters
    ----------
    predictor : Predictor
    n : int
        How many functions.
    n_steps : int
        How many rows each path will have.
    rng : RandomState
    """

    def __init__(self, predictor: Predictor, n: int, n_steps: int, rng: np.random.RandomState):
        self.predictor = predictor
        common = common_normals(predictor, n, rng)
        self._groups = [_Path(group, n, n_steps, common, rng) for group in predictor.groups]

    def step(self, inputs: np.ndarray, features: np.ndarray) -> np.ndarray:
        """The noise-free g(x) of each function at its row, (n, o).

        Parameters
        ----------
        inputs : ndarray of shape (n, d) or (n, o, d)
            The kernel's; row i is function i's.
        features : ndarray of shape (n, p) or (n, o, p)
        """
        projected = self.predictor.projected(inputs, features)
        parts = [own.step(rows).T for own, rows in zip(self._groups, projected, strict=True)]
        values = self.predictor.in_order(parts).T
        return values + times_weights(features, self.predictor.offset) + self.predictor.intercept


class _Path:
    """What the functions are of one group's outputs.

    Parameters
    ----------
    group : PredictorGroup
    n, n_steps : int
    common : ndarray of shape (n, 1, p)
        `common_normals`.
    rng : RandomState
    """

    def __init__(self, group: PredictorGroup, n: int, n_steps: int, common: np.ndarray, rng: np.random.RandomState):
        o = len(group.signal)
        self.group, self._hyperparameters = group, np.log(group.hyperparameters)
        self._weights = drawn_weights(group, n, common, rng)
        self._innovations = rng.standard_normal((n, n_steps, o))
        self._V = np.empty((n, n_steps, len(group.points)))
        self._inputs = np.empty((n, n_steps, group.points.shape[1]))
        self._L_inv = np.zeros((n, n_steps, n_steps))
        self._t = 0

    def step(self, rows: Projected) -> np.ndarray:
        """What f and the weights give, of each function at its row, (n, o of the group)."""
        group, t = self.group, self._t
        V = rows.P[: len(group.points)].T
        values = np.einsum("noj,jn->no", self._weights, rows.P)
        before = group.kernel.paired(self._hyperparameters, self._inputs[:, :t], rows.inputs[:, np.newaxis])
        before -= _times(self._V[:, :t], V)
        own = _times(self._L_inv[:, :t, :t], before)  # the row of L
        left = rows.unexplained - np.einsum("nt,nt->n", own, own)
        size = group.whitening.covariance.diagonal(rows.prepared)
        left = np.where(left > _KNOWN * size, left, 0.0)
        deviation = np.sqrt(left)
        residual = np.einsum("nt,nto->no", own, self._innovations[:, :t])
        residual += deviation[:, np.newaxis] * self._innovations[:, t]
        inverse = np.where(left > 0.0, 1.0, 0.0) / np.where(left > 0.0, deviation, 1.0)
        self._L_inv[:, t, :t] = -inverse[:, np.newaxis] * np.matmul(own[:, np.newaxis], self._L_inv[:, :t, :t])[:, 0]
        self._L_inv[:, t, t] = inverse
        self._V[:, t], self._inputs[:, t] = V, rows.inputs
        self._t = t + 1
        return values + np.sqrt(group.signal) * residual


def _times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Matrices (n, t, k) times vectors (n, k): (n, t)."""
    return np.matmul(matrices, vectors[:, :, np.newaxis])[:, :, 0]
