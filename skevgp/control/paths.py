"""Functions drawn from the posterior, each followed along a path that it makes itself, exactly.

A draw of ω = (v, w) from q is what a function has of the inducing points and the weights. What these leave of f, a
Gaussian process with the covariance k_res(x, x') = s² (k̃(x, x') - v(x)ᵀv(x')), is drawn at one row of the path after
the other, given all rows before: with k_res = s² L Lᵀ along the path, f_res = s L ξ, where ξ is a standard normal per
row and output, and L grows by a row. (Rasmussen & Williams 2006, appendix A.2: a Gaussian conditioned on part of it.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..data.rows import times_weights
from ..maps.elementary import DirectMap
from ..model.predictor import Predictor, PredictorGroup, Projected

# In units of k̃(x, x): a row of which less is left is known from those before.
_KNOWN = 1e-13
# That all paths followed at once may keep.
_NUMBERS = 2**24


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
        self._groups = [_GroupPaths(group, n, n_steps, common, rng) for group in predictor.groups]

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


class _GroupPaths:
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


def _times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Matrices (n, t, k) times vectors (n, k): (n, t)."""
    return np.matmul(matrices, vectors[:, :, np.newaxis])[:, :, 0]


@dataclass(frozen=True)
class Functions:
    """The posterior of a fitted model as functions of X, to be drawn and followed.

    Attributes
    ----------
    predictor : Predictor
    feature_map, kernel_map : DirectMap or None
    base : ndarray of shape (k, o), optional
        The columns of X that are added to the outputs.
    """

    predictor: Predictor
    feature_map: DirectMap | None
    kernel_map: DirectMap | None
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
        return max(1, _NUMBERS // (n_steps * (n_steps * len(self.predictor.groups) + points)))

    def draw(self, n: int, n_steps: int, rng: np.random.RandomState) -> Callable[[np.ndarray], np.ndarray]:
        """A function of rows (n, D), one for each path, that returns the next g(x) of each, (n, o)."""
        paths = Paths(self.predictor, n, n_steps, rng)

        def step(X: np.ndarray) -> np.ndarray:
            values = paths.step(*self.mapped(X))
            return values if self.base is None else values + X[:, self.base].sum(axis=1)

        return step
