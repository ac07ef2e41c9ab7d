"""Functions drawn from the posterior, to be evaluated anywhere.

A function of the prior, made of random waves, is moved to what a draw of q says at the inducing points: with
P = [V; Hᵀ], weights W drawn from q and f₀ = s aᵀΦ(x), a ~ N(0, I),

    g(x) = W P + f₀(x) - vᵀ L⁻¹ f₀(X_m)

(Matheron's rule; Wilson et al. 2020). Its mean and what comes from q are exact; how f varies between inducing points is
as good as the waves are many. `paths` is exact, but only along paths.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import index as as_index
from typing import Any

import numpy as np

from ..data.rows import of_outputs
from ..kernels.waves import RandomFunctions, random_functions
from ..maps.derivatives import MappedRows, chained, mapped
from ..model.predictor import Predictor, PredictorGroup
from ..utils.shapes import like_y
from .paths import Functions, common_normals, drawn_weights

# Of the derivatives of all waves at once.
_NUMBERS = 2**22


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
        self._groups = [_Group.drawn(group, predictor, n, n_waves, common, rng) for group in predictor.groups]
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
        size = max(1, _NUMBERS // waves)
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
class _Group:
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
    ) -> _Group:
        """Draw k functions."""
        hyperparameters, (m, d) = np.log(group.hyperparameters), group.points.shape
        waves = random_functions(group.kernel, hyperparameters, n_waves, d, rng)  # type: ignore[arg-type]
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
