"""Functions drawn from the posterior.

`FunctionSamples` can be evaluated anywhere and approximate f by random waves. `Paths` are exact, but each function is
evaluated only along a path, one row after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import index as as_index
from typing import Any

import numpy as np

from ..data.rows import of_outputs, times_weights
from ..kernels.waves import RandomFunctions, random_functions
from ..maps import Map
from ..model.mixture import unmixed
from ..model.predictor import Predictor, PredictorGroup, Projected
from ..model.roots import transposed_times
from ..utils.shapes import like_y
from .derivatives import MappedRows, chained, mapped
from .near import NearPath

# Largest numbers of floats in memory: in the derivatives of all waves, and in the paths that are followed together.
_NUMBERS_OF_WAVES, _NUMBERS_OF_PATHS = 2**22, 2**24
# A row counts as known from earlier rows if its residual variance is less than this share of k̃(x, x).
_KNOWN = 1e-13


@dataclass(frozen=True)
class Functions:
    """The posterior of a fitted model as functions of X."""

    predictor: Predictor
    feature_map: Map | None
    kernel_map: Map | None
    base: np.ndarray | None = None  # columns of X (k, o) that are added to the outputs

    @property
    def noise(self) -> np.ndarray:
        """Noise variance σ² of each output, (o,)."""
        return self.predictor.noise

    def mapped(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the kernel's inputs and the features of rows (n, D)."""
        features = np.empty((len(X), 0)) if self.feature_map is None else self.feature_map.value(X)
        return X if self.kernel_map is None else self.kernel_map.value(X), features

    def between(self, X: np.ndarray) -> np.ndarray:
        """Return covariances (n, o, o) between different outputs of a row; 0 unless outputs share weights or θ."""
        if not self.predictor.n_common:
            return np.zeros((len(X), len(self.noise), len(self.noise)))
        common = self.predictor.common(*self.mapped(X))
        return np.einsum("kni,knj->nij", common, common) * (1.0 - np.eye(len(self.noise)))

    def at_once(self, n_steps: int) -> int:
        """Number of paths to follow at once, so that memory stays small."""
        # A path of a mixture has the points of one draw.
        points = sum(len(group.points) // len(unmixed(group)) for group in self.predictor.groups)
        return max(1, _NUMBERS_OF_PATHS // (n_steps * (n_steps * len(self.predictor.groups) + points)))

    def draw(self, n: int, n_steps: int, rng: np.random.RandomState) -> Callable[[np.ndarray], np.ndarray]:
        """Draw n paths: returns a function of their current rows (n, D) that gives the next g(x) of each, (n, o)."""
        paths = Paths(self.predictor, n, n_steps, rng)

        def step(X: np.ndarray) -> np.ndarray:
            values = paths.step(*self.mapped(X))
            return values if self.base is None else values + X[:, self.base].sum(axis=1)

        return step


def common_normals(predictor: Predictor, n: int, rng: np.random.RandomState) -> np.ndarray:
    """Draw the normals (n, 1, p) of weights or θ that all outputs share; p is 0 if they share none."""
    return rng.standard_normal((n, 1, predictor.n_common))


def drawn_weights(group: PredictorGroup, n: int, common: np.ndarray, rng: np.random.RandomState) -> np.ndarray:
    """Draw the weights (n, o, m + p) of P = [V; Hᵀ] in n functions from q."""
    o, k, _ = group.root.shape
    normals, p = rng.standard_normal((n, o, k)), common.shape[2]
    if p:
        normals[:, :, k - p :] = common
    return group.mean + transposed_times(group.root, normals.transpose(1, 2, 0)).transpose(2, 0, 1)


def _with_draws(
    predictor: Predictor, n: int, rng: np.random.RandomState
) -> Iterator[tuple[PredictorGroup, list[PredictorGroup], np.ndarray]]:
    """Yield each group with its draws of kernel and noise, of which most models have one, and that of n functions."""
    draw_of = np.zeros(n, dtype=int)
    for index, group in enumerate(predictor.groups):
        draws = unmixed(group)
        # All outputs of a function come from one draw, unless they are those of different models.
        if len(draws) > 1 and (index == 0 or not predictor.n_common):
            draw_of = rng.randint(len(draws), size=n)
        yield group, draws, draw_of


# --- anywhere: random waves ------------------------------------------------------------------------------------------
# A function drawn from the prior, made of random waves, is moved to the values at the inducing points that are drawn
# from q. With P = [V; Hᵀ], weights W drawn from q and f₀ = s aᵀΦ(x), a ~ N(0, I),
#
#     g(x) = W P + f₀(x) - vᵀ L⁻¹ f₀(X_m)
#
# (Matheron's rule; Wilson et al. 2020). The mean and the part from q are exact. The variance of f between inducing
# points is approximate, and gets better with the number of waves.


class FunctionSamples(Sequence["SampledFunction"]):
    """Functions drawn from a posterior: a sequence of callables, which can be called itself to evaluate all at once.

    Rows are not validated: pass finite float64 arrays with the columns of `fit`.
    """

    def __init__(self, posterior: Functions, n: int, n_waves: int, rng: np.random.RandomState):
        predictor = posterior.predictor
        self._posterior = posterior
        common = common_normals(predictor, n, rng)
        self._groups: list[_Waves | _WavesOfDraws] = []
        for group, draws, draw_of in _with_draws(predictor, n, rng):
            if len(draws) == 1:
                self._groups.append(_Waves.drawn(group, predictor, n, n_waves, common, rng))
            else:
                self._groups.append(_WavesOfDraws.drawn(draws, predictor, draw_of, n_waves, rng))
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
        """Evaluate all functions at rows (n_rows, n_features) or at one row: (n_functions, n_rows, n_outputs)."""
        # The axis of rows is left out for one row, and that of outputs for one output.
        return self._values(X, slice(None))

    def value_and_jacobian(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values of a call and their derivatives with respect to X, of the same shape + (n_features,)."""
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
        waves = sum(own.n_waves * own.n_columns for own in self._groups)
        size = max(1, _NUMBERS_OF_WAVES // waves)
        return (rows[first : first + size] for first in range(0, len(rows), size))

    def _finished(self, rows: np.ndarray, parts: list[np.ndarray]) -> np.ndarray:
        """Join the groups' values (o, k, n) to those of all outputs (k, n, o), and add intercept and base."""
        predictor = self._posterior.predictor
        values = predictor.in_order(parts).transpose(1, 2, 0) + predictor.intercept
        return values if self._posterior.base is None else values + rows[:, self._posterior.base].sum(axis=1)

    @staticmethod
    def _shaped(X: np.ndarray, values: np.ndarray) -> np.ndarray:
        return like_y(values if X.ndim == 2 else values[:, 0])


@dataclass(frozen=True)
class SampledFunction:
    """Function number ``index`` of the functions that were drawn from a posterior."""

    of: FunctionSamples
    index: int

    def __call__(self, X: np.ndarray) -> np.ndarray:
        """Evaluate the noise-free g(x); shapes are those of ``predict`` of the compiled model."""
        return self.of._values(X, self._which)[0]

    def value_and_jacobian(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values of a call and their derivatives with respect to the columns of X."""
        values, jacobians = self.of._values_and_jacobians(X, self._which)
        return values[0], jacobians[0]

    @property
    def _which(self) -> slice:
        return slice(self.index, self.index + 1)


@dataclass(frozen=True)
class _Waves:
    """k functions of one group's outputs: weights times [V; Hᵀ; Φ]."""

    group: PredictorGroup
    waves: RandomFunctions  # Φ
    by_points: np.ndarray  # (o, k, m)
    by_features: np.ndarray  # (o, k, p)
    by_waves: np.ndarray  # (o, k, L)

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
        m, d = group.points.shape
        waves = random_functions(group.kernel, group.hyperparameters, n_waves, d, rng)
        at_points = waves.value(group.points)
        weights = drawn_weights(group, k, common, rng).transpose(1, 0, 2)
        by_waves = rng.standard_normal((len(group.signal), k, len(at_points)))
        # The diagonal of L Lᵀ - K: the noise of an exact model, whose points are the rows, else a jitter.
        L, K = group.whitening.L, group.whitening.covariance.matrix()
        added = np.maximum(np.einsum("ij,ij->i", L, L) - np.diagonal(K), 0.0)
        seen = by_waves @ at_points + np.sqrt(added) * rng.standard_normal((len(by_waves), k, m))
        scale = np.sqrt(group.signal)[:, np.newaxis, np.newaxis]
        by_points = weights[:, :, :m] - scale * (seen @ group.whitening.L_inv.T)
        by_features = weights[:, :, m:] + predictor.offset[group.outputs][:, np.newaxis]
        return cls(group, waves, by_points, by_features, scale * by_waves)

    @property
    def n_waves(self) -> int:
        """Number L of waves of all terms of the kernel."""
        return self.by_waves.shape[2]

    @property
    def n_columns(self) -> int:
        """Number d of columns of the kernel's inputs."""
        return self.group.points.shape[1]

    def values(self, inputs: np.ndarray, features: np.ndarray, which: Any) -> np.ndarray:
        """Evaluate some of the functions at rows: (o, k, n)."""
        group = self.group
        own, features = of_outputs(inputs, group.outputs), of_outputs(features, group.outputs)
        V = group.whitening.L_inv @ group.whitening.covariance.cross(group.kernel.prepare(own))
        found = self.by_points[:, which] @ V + self.by_waves[:, which] @ self.waves.value(own)
        return found + self.by_features[:, which] @ features.T

    def slopes(self, rows: MappedRows, which: Any) -> np.ndarray:
        """Differentiate some of the functions with respect to X: (o, k, n, D)."""
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


@dataclass(frozen=True)
class _WavesOfDraws:
    """k functions of one output of a mixture: each comes from one of the draws of kernel and noise."""

    draw_of: np.ndarray  # (k,): the draw of each function
    place: np.ndarray  # (k,): its place among the functions of this draw
    draws: list[_Waves]

    @classmethod
    def drawn(
        cls,
        groups: list[PredictorGroup],
        predictor: Predictor,
        draw_of: np.ndarray,
        n_waves: int,
        rng: np.random.RandomState,
    ) -> _WavesOfDraws:
        """Draw functions, given the draw of each."""
        draws, none = [], np.empty((0, 1, 0))
        for s, group in enumerate(groups):
            draws.append(_Waves.drawn(group, predictor, int(np.sum(draw_of == s)), n_waves, none, rng))
        place = np.empty(len(draw_of), dtype=int)
        for s in range(len(groups)):
            place[draw_of == s] = np.arange(np.sum(draw_of == s))
        return cls(draw_of, place, draws)

    @property
    def n_waves(self) -> int:
        """Number L of waves of a draw."""
        return self.draws[0].n_waves

    @property
    def n_columns(self) -> int:
        """Number d of columns of the kernel's inputs."""
        return self.draws[0].n_columns

    def values(self, inputs: np.ndarray, features: np.ndarray, which: slice) -> np.ndarray:
        """Evaluate some of the functions at rows: (1, k, n)."""
        return self._gathered(which, lambda waves, own: waves.values(inputs, features, own))

    def slopes(self, rows: MappedRows, which: slice) -> np.ndarray:
        """Differentiate some of the functions with respect to X: (1, k, n, D)."""
        return self._gathered(which, lambda waves, own: waves.slopes(rows, own))

    def _gathered(self, which: slice, of_draw: Callable[[_Waves, Any], np.ndarray]) -> np.ndarray:
        wanted, place, found = self.draw_of[which], self.place[which], {}
        for s in np.unique(wanted):
            found[s] = of_draw(self.draws[s], place[wanted == s])
        first = next(iter(found.values()))
        gathered = np.empty((1, len(wanted), *first.shape[2:]))
        for s, values in found.items():
            gathered[:, wanted == s] = values
        return gathered


# --- along a path: exact ---------------------------------------------------------------------------------------------
# A draw of ω = (v, w) from q sets the values at the inducing points and the weights. The residual of f is a Gaussian
# process with the covariance k_res(x, x') = s² (k̃(x, x') - v(x)ᵀv(x')). It is drawn at one row of the path after the
# other, given all earlier rows: with k_res = s² L Lᵀ along the path, f_res = s L ξ, where ξ is a standard normal per
# row and output, and L grows by a row (Rasmussen & Williams 2006, appendix A.2, on conditioned Gaussians).


class Paths:
    """n functions of ``n_steps`` steps: each step evaluates each function at one row."""

    def __init__(self, predictor: Predictor, n: int, n_steps: int, rng: np.random.RandomState):
        # Groups with a local part condition their rows themselves.
        self.predictor = replace(predictor, groups=tuple(replace(group, near=None) for group in predictor.groups))
        common = common_normals(predictor, n, rng)
        self._groups: list[_Path | _PathOfDraws | NearPath] = []
        for group, draws, draw_of in _with_draws(predictor, n, rng):
            if len(draws) == 1:
                self._groups.append(_path_of(group, n, n_steps, common, rng))
            else:
                self._groups.append(_PathOfDraws(draws, draw_of, n_steps, rng))

    def step(self, inputs: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Return the noise-free g(x) of each function at its row, (n, o), from inputs (n, d) and features (n, p)."""
        plain = replace(
            self.predictor,
            groups=tuple(
                group
                for group, own in zip(self.predictor.groups, self._groups, strict=True)
                if not isinstance(own, _PathOfDraws)
            ),
        )
        projected, parts = plain.projected(inputs, features), []
        for group, own in zip(self.predictor.groups, self._groups, strict=True):
            if isinstance(own, _PathOfDraws):
                rows = of_outputs(inputs, group.outputs), of_outputs(features, group.outputs)
                parts.append(own.step(*rows).T)
            else:
                parts.append(own.step(next(projected)).T)
        values = self.predictor.in_order(parts).T
        return values + times_weights(features, self.predictor.offset) + self.predictor.intercept


def _path_of(
    group: PredictorGroup, n: int, n_steps: int, common: np.ndarray, rng: np.random.RandomState
) -> _Path | NearPath:
    """Draw the part of n functions that belongs to one group of outputs."""
    if group.near is None:
        return _Path(group, n, n_steps, common, rng)
    weights = drawn_weights(group, n, common, rng)[:, 0]
    return NearPath(group, group.near, n_steps, weights, rng.standard_normal((n, n_steps)))


class _Path:
    """The part of n functions that belongs to one group of outputs."""

    def __init__(self, group: PredictorGroup, n: int, n_steps: int, common: np.ndarray, rng: np.random.RandomState):
        o = len(group.signal)
        self.group = group
        self._weights = drawn_weights(group, n, common, rng)
        self._innovations = rng.standard_normal((n, n_steps, o))
        self._V = np.empty((n, n_steps, len(group.points)))
        self._inputs = np.empty((n, n_steps, group.points.shape[1]))
        self._L_inv = np.zeros((n, n_steps, n_steps))
        self._t = 0

    def step(self, rows: Projected) -> np.ndarray:
        """Return f + P weights of each function at its own row, (n, o of the group)."""
        group, t = self.group, self._t
        V = rows.P[: len(group.points)].T
        values = np.einsum("noj,jn->no", self._weights, rows.P)
        before = group.kernel.paired(group.hyperparameters, self._inputs[:, :t], rows.inputs[:, np.newaxis])
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


class _PathOfDraws:
    """The part of n functions that belongs to one output of a mixture: each comes from one of the draws."""

    def __init__(self, draws: list[PredictorGroup], draw_of: np.ndarray, n_steps: int, rng: np.random.RandomState):
        none, self._parts = np.empty((0, 1, 0)), list[tuple[np.ndarray, _Path]]()
        for s, group in enumerate(draws):
            which = np.flatnonzero(draw_of == s)
            if len(which):
                self._parts.append((which, _Path(group, len(which), n_steps, none, rng)))

    def step(self, inputs: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Return f + P weights of each function at its own row, (n, 1)."""
        found = np.empty((len(inputs), 1))
        for which, path in self._parts:
            group, own = path.group, inputs[which]
            prepared, m = group.kernel.prepare(own), len(group.points)
            P = np.empty((group.mean.shape[1], len(which)))
            P[m:] = features[which].T
            V = group.whitening.solve(prepared, out=P[:m])
            found[which] = path.step(Projected(own, prepared, P, group.whitening.remaining(prepared, V)))
        return found


def _times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Multiply matrices (n, t, k) by vectors (n, k): (n, t)."""
    return np.matmul(matrices, vectors[:, :, np.newaxis])[:, :, 0]
