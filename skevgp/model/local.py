"""The likelihood of a model with a local part (see `conditioning`), and its gradient."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.sparse import csr_matrix

from ..data.neighbors import NONE, nearest_earlier
from ..data.rows import RawRows
from ..data.threads import BlockMap, ordered_sum
from .bounds import bounds_at_optimum, optimal_posteriors
from .conditioning import KnownRows
from .model import SparseModel
from .parameters import Values
from .statistics import SufficientStatistics, Whitening


@dataclass(frozen=True)
class LocalModel:
    """A sparse model with one set of inducing points for each output, and rows that are conditioned on others."""

    # Its groups are the outputs.
    sparse: SparseModel
    # In internal units, in the order in which they are conditioned.
    rows: RawRows
    n_neighbors: int
    # (n,): the positions of these rows in the user's order.
    order: np.ndarray
    # Only during a fit.
    threads: BlockMap | None = None
    n_threads: int = 1

    @classmethod
    def of(
        cls, model: SparseModel, rows: RawRows, n_neighbors: int, order: np.ndarray, threads: BlockMap | None = None
    ) -> LocalModel:
        """The local model of a sparse one, for rows in the user's order. They are conditioned in another ``order``."""
        variant = replace(model.variant, tight=False)
        o = rows.targets.shape[1]
        kernels = None
        if model.kernels is not None:
            kernels = tuple(model.kernels[model.group_of(output)] for output in range(o))
        outputs = tuple(slice(output, output + 1) for output in range(o))
        sparse_model = replace(model, groups=outputs, kernels=kernels, variant=variant, complete=True)
        return cls(sparse_model, rows[order], n_neighbors, order, threads)

    def changed(self, model: SparseModel, rows: RawRows) -> LocalModel:
        """The local model of the same rows with other features. ``rows`` are in the user's order."""
        return replace(LocalModel.of(model, rows, self.n_neighbors, self.order), n_threads=self.n_threads)

    def with_more(self, rows: RawRows) -> LocalModel:
        """The local model with further rows after its own."""
        order = np.concatenate([self.order, len(self.order) + np.arange(len(rows.inputs))])
        return replace(self, rows=self.rows.followed_by(rows), order=order)

    def known(self, values: Values, whitenings: Sequence[Whitening] | None = None) -> list[KnownRows]:
        """The rows of each output, for values with one set of inducing points for each output."""
        whitenings = list(self.sparse.whitenings(values)) if whitenings is None else whitenings
        outputs = []
        for output, whitening in enumerate(whitenings):
            raw = self.rows.of([output])
            kernel, hyperparameters = self.sparse.kernel_of(values, output)
            precision = np.ones(len(raw.inputs)) if raw.precision is None else raw.precision
            ratio = values["noise"][output] / values["signal"][output]
            outputs.append(
                KnownRows(
                    kernel=kernel,
                    hyperparameters=hyperparameters,
                    whitening=whitening,
                    inputs=raw.inputs,
                    linear=np.hstack([raw.features, raw.targets]),
                    ratio=ratio / precision,
                    n_neighbors=self.n_neighbors,
                    n_threads=self.n_threads,
                )
            )
        return outputs

    def neighbours(self, known: list[KnownRows], first: int = 0) -> list[np.ndarray]:
        """The nearest earlier rows of each row from ``first`` on, for each output."""
        found: list[np.ndarray] = []
        for index, rows in enumerate(known):
            before = known[index - 1]
            if index and np.array_equal(rows.hyperparameters, before.hyperparameters) and rows.inputs is before.inputs:
                found.append(found[-1])
            else:
                found.append(nearest_earlier(rows.coordinates(rows.inputs), self.n_neighbors, first, self.n_threads))
        return found

    @property
    def _threads(self) -> BlockMap:
        return BlockMap() if self.threads is None else self.threads

    # --- sums over the rows -------------------------------------------------------------------------------------------

    def statistics(
        self, values: Values, known: list[KnownRows], neighbours: list[np.ndarray], first: int = 0
    ) -> list[SufficientStatistics]:
        """The sufficient statistics of each output, of the rows from ``first`` on."""
        return [
            self.statistics_of(output, float(values["noise"][output] / values["signal"][output]), rows, near, first)
            for output, (rows, near) in enumerate(zip(known, neighbours, strict=True))
        ]

    def statistics_of(
        self, output: int, ratio: float, known: KnownRows, neighbours: np.ndarray, first: int = 0
    ) -> SufficientStatistics:
        """The sufficient statistics of one output, for the ratio σ²/s²."""
        sums, log_variance = ordered_sum(
            self._threads(partial(_sums, known, neighbours, first, ratio), known.slices(*neighbours.shape))
        )
        m, p = known.n_inducing, known.linear.shape[1] - 1
        counts, precision = (None if part is None else part[first:] for part in (self.rows.counts, self.rows.precision))
        n_rows = float(len(neighbours))
        if counts is not None and precision is not None:
            # w equal rows are one row with a noise variance of σ² v / w, and a constant.
            n_rows = float(counts.sum())
            log_variance += float((counts - 1.0) @ np.log(counts / precision) + np.log(counts).sum())
        return SufficientStatistics(
            n_rows=n_rows,
            VV=sums[:m, :m],
            VH=sums[:m, m : m + p],
            VR=sums[:m, m + p :],
            HH=sums[m : m + p, m : m + p],
            HR=sums[m : m + p, m + p :],
            RR=sums[m + p, m + p :],
            unexplained=0.0,
            log_variance=log_variance,
            surplus=0.0,
        )

    # --- the likelihood and its gradient ------------------------------------------------------------------------------

    def log_likelihoods(self, values: Values, neighbours: list[np.ndarray]) -> np.ndarray:
        """The log likelihood of the residuals of each output, (o,)."""
        known = self.known(values)
        statistics = self.statistics(values, known, neighbours)
        groups = self.sparse.groups_of(values, statistics, [rows.whitening for rows in known])
        return np.array([bound.value(bound.residuals()) for bound in bounds_at_optimum(groups)])

    def log_likelihood(
        self, values: Values, neighbours: list[np.ndarray], left_out: np.ndarray | None = None
    ) -> tuple[float, Values]:
        """The log likelihood of the residuals, and its gradient in the logarithms of kernel, signal and noise.

        The inducing points stay, and so do the neighbours. Outputs that are ``left_out`` (o,) do not count, unless
        outputs share their weights.
        """
        # The gradient is that of the mean over q of log p(r̃, v, w'), where q is held at the posterior of v and w'.
        known = self.known(values)
        statistics = self.statistics(values, known, neighbours)
        groups = list(enumerate(self.sparse.groups_of(values, statistics, [rows.whitening for rows in known])))
        if left_out is not None and not self.sparse.prior.shared:
            groups = [(output, group) for output, group in groups if not left_out[output]]
        counted = [group for _, group in groups]
        value = float(sum(bound.value(bound.residuals()) for bound in bounds_at_optimum(counted))) if counted else 0.0
        gradient = {name: np.zeros(entry.shape) for name, entry in values.items()}
        for (output, group), (q,) in zip(groups, optimal_posteriors(counted) if counted else (), strict=True):
            parts = _Gradient(
                known=known[output],
                neighbours=neighbours[output],
                signal=float(values["signal"][output]),
                mean=group.times_T(0, q.mean),
                root=group.times_T(0, q.root_inv.T).T,
            )
            hyper_bar, of_signal, of_noise = parts.total(self._threads)
            gradient["hyperparameters"][output if values["hyperparameters"].ndim == 2 else slice(None)] += hyper_bar
            gradient["signal"][output] += of_signal - of_noise
            gradient["noise"][output] += of_noise
        return value, gradient


def values_by_output(model: SparseModel, values: Values) -> Values:
    """The values of a sparse model, with a set of inducing points for each output."""
    groups = [model.group_of(output) for output in range(len(values["noise"]))]
    by_output = values | {"inducing_points": values["inducing_points"][groups]}
    if values["hyperparameters"].ndim == 2:
        by_output["hyperparameters"] = values["hyperparameters"][groups]
    return by_output


def _sums(known: KnownRows, neighbours: np.ndarray, first: int, ratio: float, rows: slice) -> tuple[np.ndarray, float]:
    """[ṽ, h̃, r̃]ᵀ [ṽ, h̃, r̃] with a weight of σ² / (s² δ) for each row, and Σ log(s² δ / σ²)."""
    found = known.among_themselves(neighbours, first, rows)
    relative = (found.latent + known.ratio[first:][rows]) / ratio
    scaled = found.differences / np.sqrt(relative)[:, np.newaxis]
    return scaled.T @ scaled, float(np.log(relative).sum())


class _Gradient:
    """The gradient of one output's log likelihood, for q of v and the weights with ``mean`` and rootᵀ root."""

    def __init__(self, known: KnownRows, neighbours: np.ndarray, signal: float, mean: np.ndarray, root: np.ndarray):
        self.known, self.neighbours, self.signal = known, neighbours, signal
        self.mean, self.covariance = mean, root.T @ root
        # The gradient in V of each row: its own part, and coefficients (n, k) times rows (n, m) for its neighbours.
        n, k = neighbours.shape
        self._V_bar = np.empty((n, known.n_inducing))
        self._by_neighbour = np.empty((3, n, k))
        self._of_row = np.empty((3, n, known.n_inducing))

    def total(self, threads: BlockMap) -> tuple[np.ndarray, float, float]:
        """The gradient in the log hyperparameters, and those in log s² for a given ρ, and in log ρ."""
        known, n = self.known, len(self.neighbours)
        hyper_bar, of_signal, of_ratio = ordered_sum(threads(self._rows, known.slices(*self.neighbours.shape)))
        V_bar = self._V_bar
        places = np.where(self.neighbours == NONE, 0, self.neighbours).ravel()
        ends = np.arange(n + 1) * self.neighbours.shape[1]
        for coefficients, rows in zip(self._by_neighbour, self._of_row, strict=True):
            V_bar -= csr_matrix((coefficients.ravel(), places, ends), shape=(n, n)).T @ rows
        # V = L⁻¹ U: Ū = L⁻ᵀ V̄, and Lᵀ L̄ = -V̄ Vᵀ in the lower triangle.
        whitening = known.whitening
        prepared = known.kernel.prepare(known.inputs)
        U, V = whitening.project(prepared)
        rows_bar = whitening.covariance.start_pullback()
        rows_bar = rows_bar + whitening.covariance.cross_pullback(prepared, U, whitening.L_inv.T @ V_bar.T, 0.0)
        from_points, _ = whitening.pull_back(rows_bar, -(V_bar.T @ V.T))
        return hyper_bar + from_points, of_signal, of_ratio

    def _rows(self, rows: slice) -> tuple[np.ndarray, float, float]:
        """The same of some rows, without the part of V."""
        known, m = self.known, self.known.n_inducing
        found = known.among_themselves(self.neighbours, 0, rows)
        w, k = found.weights, found.weights.shape[1]
        delta = found.latent + known.ratio[rows]
        variance = self.signal * delta
        P, r = found.differences[:, :-1], found.differences[:, -1]
        error = r - P @ self.mean
        PS = P @ self.covariance
        squares = error**2 + np.einsum("bj,bj->b", PS, P)
        # Gradients in r̃, [ṽ, h̃] and δ.
        r_bar = -error / variance
        P_bar = (error[:, np.newaxis] * self.mean - PS) / variance[:, np.newaxis]
        delta_bar = 0.5 * (squares / variance - 1.0) / delta
        # w = C⁻¹ c and δ = R_ii + ρ - cᵀ C⁻¹ c, so that with q = C⁻¹ w̄: c̄ = q - 2 δ̄ w, and C̄ = a wᵀ + w aᵀ.
        bars = np.column_stack([P_bar, r_bar])
        w_bar = -(found.joint[:, :k] @ bars[:, :, np.newaxis])
        q = np.linalg.solve(found.covariance, w_bar)[:, :, 0]
        c_bar = q - 2.0 * delta_bar[:, np.newaxis] * w
        a = 0.5 * (delta_bar[:, np.newaxis] * w - q)
        R_bar = np.empty((len(w), k + 1, k + 1))
        np.multiply(a[:, :, np.newaxis], w[:, np.newaxis], out=R_bar[:, :k, :k])
        R_bar[:, :k, :k] += R_bar[:, :k, :k].transpose(0, 2, 1).copy()
        R_bar[:, :k, k] = R_bar[:, k, :k] = 0.5 * c_bar
        R_bar[:, k, k] = delta_bar
        # ρ of the neighbours and of the row.
        positions = np.maximum(self.neighbours[rows], 0)
        of_ratio = 2.0 * float(np.vdot(a * w, known.ratio[positions])) + float(delta_bar @ known.ratio[rows])
        of_signal = 0.5 * float((squares / variance - 1.0).sum() + np.vdot(P_bar[:, :m], P[:, :m]))
        # R = K - V Vᵀ, and ṽ = v - V_N w.
        V, v_bar = found.joint[:, :, :m], P_bar[:, :m]
        cV, wV, aV = ((each[:, np.newaxis] @ V[:, :k])[:, 0] for each in (c_bar, w, a))
        self._V_bar[rows] = v_bar - cV - 2.0 * delta_bar[:, np.newaxis] * V[:, k]
        self._by_neighbour[:, rows] = w, a, c_bar
        self._of_row[:, rows] = v_bar + 2.0 * aV, 2.0 * wV, V[:, k]
        return found.pull_back(R_bar), of_signal, of_ratio
