"""Derivatives and paths of a model with a local part (see `model.conditioning`). Neighbours are held."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..data.rows import of_outputs
from ..model.conditioning import Conditioned, KnownRows, Others
from ..model.predictor import PredictorGroup, Projected
from .derivatives import MappedRows, chained


class NearMoments(NamedTuple):
    """Mean (1, n) and variance (1, n) of the noise-free g(x) of an output without the intercept."""

    mean: np.ndarray
    variance: np.ndarray


@dataclass(frozen=True)
class NearGroup:
    """The posterior of one output, with the moments and slopes of `compiled`."""

    own: PredictorGroup
    near: KnownRows
    # (p,): added to the weights.
    offset: np.ndarray

    def moments(self, inputs: np.ndarray, features: np.ndarray, return_variance: bool) -> NearMoments:
        """Return mean and variance at mapped rows."""
        group, rows, H = self.own, of_outputs(inputs, self.own.outputs), of_outputs(features, self.own.outputs)
        mean, variance = np.empty((1, len(rows))), np.empty((1, len(rows)))

        def put(some: slice, found: Conditioned) -> None:
            P = found.differences[:, :-1]
            mean[0, some] = P @ group.mean[0] - found.differences[:, -1]
            variance[0, some] = group.signal[0] * found.latent + np.square(P @ group.root[0].T).sum(axis=1)

        self.near.for_new(put, rows, np.hstack([self.near.whitened(rows), H]))
        return NearMoments(mean + H @ self.offset, variance)

    # With C and c = R_N(x) of `model.conditioning`, w = C⁻¹ c, a the mean of (v, β) and G their covariance,
    #
    #     mean = [v; h]ᵀa + cᵀβ,    β = C⁻¹ (y_N - [V; H]_Nᵀ a),
    #     variance = s² (k(x, x) - |v|² - cᵀw) + pᵀG p,    p = [v; h] - [V; H]_N w.

    def slopes(self, found: NearMoments, rows: MappedRows) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives of mean and variance with respect to X, (1, n, D) each."""
        group, near, (by_inputs, by_features) = self.own, self.near, rows.of(self.own)
        inputs, H = of_outputs(rows.inputs, group.outputs), of_outputs(rows.features, group.outputs)
        (n, d), m, s2 = inputs.shape, near.n_inducing, float(group.signal[0])
        a, prepared = group.mean[0], group.kernel.prepare(inputs)
        of_points = group.whitening.covariance.slopes(prepared)
        dV = (group.whitening.L_inv @ of_points.reshape(m, n * d)).reshape(m, n, d)
        at_row = np.broadcast_to(group.whitening.covariance.diagonal_slopes(prepared), (n, d))
        mean, variance = np.empty((n, d)), np.empty((n, d))
        mean_by_features, variance_by_features = np.empty(H.shape), np.empty(H.shape)
        neighbours = near.nearest(inputs)

        def put(some: slice, found: Conditioned) -> None:
            k, V = neighbours.shape[1], found.joint[:, :-1, :m]
            others, P = found.joint[:, :k, :-1], found.differences[:, :-1]
            G = P @ group.root[0].T @ group.root[0]
            wanted = np.stack([found.joint[:, :k, -1] - others @ a, (others @ G[:, :, np.newaxis])[:, :, 0]], axis=2)
            beta, of_G = np.moveaxis(np.linalg.solve(found.covariance, wanted), 2, 0)
            gamma = -2.0 * (s2 * found.weights + of_G)
            own = found.joint[:, k, :m]
            by_V = a[:m] - (beta[:, np.newaxis] @ V)[:, 0]
            variance_by_V = 2.0 * (G[:, :m] - s2 * own) - (gamma[:, np.newaxis] @ V)[:, 0]
            # ∂k(x_N, x)/∂x of each row and its neighbours.
            dK = np.array(
                [
                    near.kernel.at(near.hyperparameters, near.inputs[chosen]).slopes(
                        near.kernel.prepare(row[np.newaxis])
                    )
                    for chosen, row in zip(neighbours[some], inputs[some], strict=True)
                ]
            ).reshape(len(P), k, d)
            mean[some] = np.einsum("nm,mnd->nd", by_V, dV[:, some]) + np.einsum("nk,nkd->nd", beta, dK)
            variance[some] = s2 * at_row[some] + np.einsum("nm,mnd->nd", variance_by_V, dV[:, some])
            variance[some] += np.einsum("nk,nkd->nd", gamma, dK)
            mean_by_features[some], variance_by_features[some] = a[m:] + self.offset, 2.0 * G[:, m:]

        near.for_new(put, inputs, np.hstack([near.whitened(inputs), H]))
        totals = []
        for by_row, by_feature in ((mean, mean_by_features), (variance, variance_by_features)):
            total = chained(by_row[:, np.newaxis], by_inputs)[:, 0]
            totals.append((total + np.einsum("np,npD->nD", by_feature, by_features))[np.newaxis])
        return totals[0], totals[1]


class NearPath:
    """The part of n functions that belongs to one output. A row is conditioned on its last rows of the path too.

    The rows of the path are known without noise. As many are used as neighbours.
    """

    def __init__(self, group: PredictorGroup, near: KnownRows, n_steps: int, weights: np.ndarray, normals: np.ndarray):
        # weights: draws of (v, β), (n, m + p). normals: (n, n_steps).
        n = len(weights)
        self.group, self.near, self._weights, self._normals = group, near, weights, normals
        self._inputs = np.empty((n, n_steps, near.inputs.shape[1]))
        self._joint = np.empty((n, n_steps, near.n_inducing + near.linear.shape[1]))
        self._t = 0

    def step(self, rows: Projected) -> np.ndarray:
        """Return the value of each function at its own row, (n, 1), without offset and intercept."""
        near, t, n = self.near, self._t, len(self._weights)
        own = np.hstack([rows.P.T, np.zeros((n, 1))])
        last = slice(max(t - near.n_neighbors, 0), t)
        neighbours = near.nearest(rows.inputs)
        values = np.empty(n)
        for some in near.slices(n, neighbours.shape[1] + last.stop - last.start):
            others = Others(self._inputs[some, last], self._joint[some, last])
            found = near.conditioned(neighbours[some], rows.inputs[some], own[some], others)
            P = found.differences
            values[some] = np.einsum("nj,nj->n", P[:, :-1], self._weights[some]) - P[:, -1]
            values[some] += np.sqrt(self.group.signal[0] * found.latent) * self._normals[some, t]
        own[:, -1] = values
        self._inputs[:, t], self._joint[:, t], self._t = rows.inputs, own, t + 1
        return values[:, np.newaxis]
