"""The local part: what the inducing points leave out of f is conditioned on the nearest rows.

With the whitening V of the inducing points, f = s Vᵀv + s r. The residual r is a Gaussian process with the covariance
R = k̃(x, x') - v(x)ᵀv(x'). In the order of the rows, the residual of row i is conditioned on its nearest earlier rows N
(Vecchia 1988), given v and β. This is the full-scale approximation of Gyger, Furrer & Sigrist (2025). With the noise
variances s² ρ_j of rows and

    w = (R_NN + diag(ρ_N))⁻¹ R_Ni,   δ = R_ii + ρ_i - wᵀ R_Ni,

the differences r̃_i = y_i - wᵀ y_N, h̃_i = h_i - H_Nᵀ w and ṽ_i = v_i - V_N w of the rows are

    r̃_i = s ṽ_iᵀv + h̃_iᵀ β + N(0, s² δ_i),   independent given v and β.

So all else is the sparse model of `bounds` for these rows, with a noise variance of their own. Without neighbours it
is FITC (Snelson & Ghahramani 2006). If all earlier rows are neighbours, it is the exact Gaussian process.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from ..data.neighbors import NONE, NearestRows
from ..data.threads import BlockMap, single_threaded_libraries
from ..kernels.base import Covariance, SetsPullback
from .statistics import Whitening

# A set of rows with their neighbours has arrays of about this many numbers.
_NUMBERS = 2**19
# V of all rows is kept within this many numbers. It is computed again for each set of rows if there are more.
_KEPT_NUMBERS = 2**28
# Noise variances and what is left of the variance are not below this share of the variance.
LEAST = 1e-12


class Conditioned(NamedTuple):
    """Some rows of one output, conditioned on k rows each."""

    # (b, k + 1, m + p + 1): [v, h, r] of the neighbours and, last, of the row itself.
    joint: np.ndarray
    # (b, k, k): R_NN + diag(ρ_N).
    covariance: np.ndarray
    # (b, k): w.
    weights: np.ndarray
    # (b,): R_ii - wᵀ R_Ni, the variance of r without noise.
    latent: np.ndarray
    # (b, m + p + 1): [ṽ, h̃, r̃]. For a new row, r is 0, and r̃ is minus the mean wᵀ y_N.
    differences: np.ndarray
    # Maps the gradient in k̃ within the sets (b, k + 1, k + 1) to that in the log hyperparameters.
    pull_back: SetsPullback


@dataclass(frozen=True)
class KnownRows:
    """The rows of one output on which others are conditioned, at one point of the parameters."""

    kernel: Covariance
    # (n_hyper,).
    hyperparameters: np.ndarray
    whitening: Whitening
    # (n, d), and [h, r] (n, p + 1).
    inputs: np.ndarray
    linear: np.ndarray
    # (n,): ρ, the noise variance of each row in units of s².
    ratio: np.ndarray
    # Number of rows on which a row is conditioned.
    n_neighbors: int
    n_threads: int = 1

    def __len__(self) -> int:
        return len(self.inputs)

    @property
    def n_inducing(self) -> int:
        """Number of inducing points."""
        return len(self.whitening.L)

    def scaled(self, unit: float) -> KnownRows:
        """The same rows, with residuals times ``unit``."""
        return replace(self, linear=np.column_stack([self.linear[:, :-1], unit * self.linear[:, -1]]))

    def some(self, rows: np.ndarray) -> KnownRows:
        """Some of these rows, by their positions."""
        return replace(self, inputs=self.inputs[rows], linear=self.linear[rows], ratio=self.ratio[rows])

    def with_ratio(self, ratio: np.ndarray) -> KnownRows:
        """The same rows with other noise variances (n,). What is cached does not depend on them."""
        cached = {name: value for name, value in vars(self).items() if name in ("_joint", "_nearest", "_spread")}
        other = replace(self, ratio=ratio)
        vars(other).update(cached)
        return other

    def __getstate__(self) -> dict[str, object]:
        # What is cached is computed again.
        return {field.name: getattr(self, field.name) for field in fields(self)}

    # --- neighbours ---------------------------------------------------------------------------------------------------

    def coordinates(self, inputs: np.ndarray) -> np.ndarray:
        """The coordinates in which near rows are correlated. Those of the inputs if the kernel has no distance."""
        found = self.kernel.nearness(self.hyperparameters, inputs)
        return found if found.shape[1] else (inputs - self.inputs[0]) / self._spread

    @cached_property
    def _spread(self) -> np.ndarray:
        spread = self.inputs.std(axis=0)
        return np.where(spread > 0.0, spread, 1.0)

    @cached_property
    def _nearest(self) -> NearestRows:
        return NearestRows(self.coordinates(self.inputs))

    def nearest(self, inputs: np.ndarray) -> np.ndarray:
        """The positions of the nearest of these rows to others, (q, k)."""
        return self._nearest.of(self.coordinates(inputs), self.n_neighbors, self.n_threads)

    # --- V ------------------------------------------------------------------------------------------------------------

    def whitened(self, inputs: np.ndarray) -> np.ndarray:
        """V of rows, (q, m)."""
        prepared = self.kernel.prepare(inputs)
        return self.whitening.solve(prepared, out=np.empty((self.n_inducing, len(inputs)))).T

    @cached_property
    def _joint(self) -> np.ndarray | None:
        """[v, h, r] of all rows (n, m + p + 1). None if there is no memory for it."""
        if len(self) * self.n_inducing > _KEPT_NUMBERS:
            return None
        return np.ascontiguousarray(np.hstack([self.whitened(self.inputs), self.linear]))

    def joint(self, rows: np.ndarray) -> np.ndarray:
        """[v, h, r] of rows by their positions (...): (..., m + p + 1)."""
        if self._joint is not None:
            return self._joint[rows]
        distinct, places = np.unique(rows, return_inverse=True)
        V = self.whitened(self.inputs[distinct])
        return np.concatenate([V[places.reshape(rows.shape)], self.linear[rows]], axis=-1)

    # --- conditioning -------------------------------------------------------------------------------------------------

    def slices(self, n_rows: int, k: int) -> list[slice]:
        """Sets of rows that are conditioned at once."""
        size = max(_NUMBERS // ((k + 1) * (self.n_inducing + self.linear.shape[1] + 2 * (k + 1))), 1)
        return [slice(first, min(first + size, n_rows)) for first in range(0, n_rows, size)]

    def for_new(self, use: Callable[[slice, Conditioned], None], inputs: np.ndarray, P: np.ndarray) -> None:
        """Condition new rows (q, d) with [v, h] (q, m + p) on their nearest rows, and use them, some at a time."""
        neighbours = self.nearest(inputs)
        own = np.hstack([P, np.zeros((len(inputs), 1))])

        def one(rows: slice) -> None:
            use(rows, self.conditioned(neighbours[rows], inputs[rows], own[rows]))

        slices = self.slices(*neighbours.shape)
        if self.n_threads == 1 or len(slices) == 1:
            deque(map(one, slices), 0)
            return
        with single_threaded_libraries():
            threads = BlockMap(self.n_threads)
            try:
                deque(threads(one, slices), 0)
            finally:
                threads.close()

    def among_themselves(self, neighbours: np.ndarray, first: int, rows: slice) -> Conditioned:
        """Some of these rows, from ``first`` on, conditioned on neighbours (n - first, k)."""
        own = np.arange(first, len(self))[rows]
        return self.conditioned(neighbours[rows], self.inputs[own], self.joint(own))

    def conditioned(
        self, neighbours: np.ndarray, inputs: np.ndarray, own: np.ndarray, others: Others | None = None
    ) -> Conditioned:
        """Rows (b, d) with [v, h, r] (b, m + p + 1), conditioned on neighbours (b, k), and on other rows."""
        missing = neighbours == NONE
        # The last place is that of the row itself.
        positions = np.pad(np.where(missing, 0, neighbours), ((0, 0), (0, 1)))
        sets, joint, ratio = self.inputs[positions], self.joint(positions), self.ratio[positions[:, :-1]]
        if others is not None:
            sets, joint = (np.concatenate(pair, axis=1) for pair in ((others.inputs, sets), (others.joint, joint)))
            missing, ratio = (np.pad(values, ((0, 0), (others.inputs.shape[1], 0))) for values in (missing, ratio))
        sets[:, -1], joint[:, -1], k = inputs, own, ratio.shape[1]
        K, pull_back = self.kernel.within(self.hyperparameters, sets)
        V = joint[:, :, : self.n_inducing]
        R = K - V @ V.transpose(0, 2, 1)
        covariance, crossed = R[:, :k, :k], R[:, :k, k]
        if missing.any():
            # A neighbour that is not there is independent of all others.
            joint[:, :k][missing] = 0.0
            covariance *= ~missing[:, :, np.newaxis] & ~missing[:, np.newaxis]
            crossed *= ~missing
            ratio = np.where(missing, 1.0, ratio)
        variances = np.einsum("bkk->bk", K)
        # The smallest number keeps the matrix from being singular where k̃(x, x) is 0.
        noise = np.maximum(ratio, np.maximum(LEAST * variances[:, :k], np.finfo(float).tiny))
        np.einsum("bkk->bk", covariance)[...] += noise
        weights = np.linalg.solve(covariance, crossed[:, :, np.newaxis])[:, :, 0]
        latent = R[:, k, k] - np.einsum("bk,bk->b", weights, crossed)
        differences = joint[:, k] - (weights[:, np.newaxis] @ joint[:, :k])[:, 0]
        return Conditioned(
            joint=joint,
            covariance=covariance,
            weights=weights,
            latent=np.maximum(latent, LEAST * variances[:, k]),
            differences=differences,
            pull_back=pull_back,
        )

    # --- new rows together --------------------------------------------------------------------------------------------

    def covariance(self, inputs: np.ndarray) -> np.ndarray:
        """The covariance (q, q) of the errors r(x) - wᵀ y_N of new rows, in units of s², given v and β.

        It takes time and memory for all pairs of their neighbours.
        """
        neighbours, n = self.nearest(inputs), len(inputs)
        P = np.hstack([self.whitened(inputs), np.zeros((n, self.linear.shape[1] - 1))])
        weights = np.empty(neighbours.shape)

        def keep(rows: slice, found: Conditioned) -> None:
            weights[rows] = found.weights

        self.for_new(keep, inputs, P)
        distinct, places = np.unique(neighbours, return_inverse=True)
        # Each error is a row of A times r of the new rows and of their neighbours.
        columns = np.hstack([np.arange(n)[:, np.newaxis], n + places.reshape(neighbours.shape)])
        entries = np.hstack([np.ones((n, 1)), -weights])
        ends = np.arange(n + 1) * columns.shape[1]
        A = csr_matrix((entries.ravel(), columns.ravel(), ends), shape=(n, n + len(distinct))).tocsc()
        rows = np.concatenate([inputs, self.inputs[distinct]])
        noise = np.concatenate([np.zeros(n), self.ratio[distinct]])
        V, prepared = self.whitened(rows), self.kernel.prepare(rows)
        total, size = np.zeros((n, n)), max(_NUMBERS // len(rows), 1)
        for first in range(0, len(rows), size):
            some = slice(first, first + size)
            R = self.kernel.at(self.hyperparameters, rows[some]).cross(prepared) - V[some] @ V.T
            diagonal = np.arange(len(R))
            R[diagonal, first + diagonal] += noise[some]
            total += A[:, some] @ (A @ R.T).T
        return total


class Others(NamedTuple):
    """Further rows without noise on which a row is conditioned."""

    # (b, t, d), and [v, h, r] (b, t, m + p + 1).
    inputs: np.ndarray
    joint: np.ndarray
