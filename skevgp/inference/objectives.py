"""What the optimisers minimise: θ -> (loss, gradient)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import autograd.numpy as anp
import numpy as np
from autograd import value_and_grad

from .blocks import Batch, Blocks
from .bounds import Residuals, negative_elbo
from .linalg import cholesky, cholesky_pullback, inverse_factor, lower_triangular
from .model import JITTER, SparseModel, log_variances
from .parameters import Parameter, ParameterTable
from .posterior import Posterior
from .statistics import SufficientStatistics, collect, pull_back, traceable_statistics


class BoundObjective:
    """θ -> minus the bound at the optimum of q, per row, and its gradient: what L-BFGS minimises.

    Parameters
    ----------
    model : SparseModel
    table : ParameterTable
    blocks : Blocks
    """

    def __init__(self, model: SparseModel, table: ParameterTable, blocks: Blocks):
        self.model, self.table, self.blocks = model, table, blocks

    def __call__(self, flat: np.ndarray) -> tuple[float, np.ndarray]:
        values, model = self.table.values(flat), self.model
        units = self.table["inducing_points"].unit
        total, n_rows = 0.0, self.blocks.linear.n_rows
        gradient = {name: np.zeros_like(value) for name, value in values.items()}
        for index, (outputs, (at, L, L_inv)) in enumerate(zip(model.groups, model.factors(values), strict=True)):
            statistics = collect(self.blocks, at, L_inv)
            bound = model.bound(statistics, outputs, values["signal"], values["noise"], L, L_inv)
            bar = bound.gradient
            rows_bar, L_bar, squares, VE = pull_back(
                self.blocks,
                at,
                L_inv,
                statistics,
                bar.VV,
                bar.VH,
                self._all_outputs(bar.VE, outputs),
                bar.unexplained,
                self._all_outputs(bound.fitted, outputs),
            )
            residuals = Residuals(squares[outputs], VE[:, outputs])
            hyper_bar, Z_bar = at.finish_pullback(rows_bar, cholesky_pullback(L, L_inv, L_bar + bar.L))
            total += bound.value(residuals)
            gradient["hyperparameters"] += hyper_bar
            gradient["inducing_points"][index] += Z_bar * units
            gradient["signal"][outputs], gradient["noise"][outputs] = bound.log_gradients(residuals)
        return -total / n_rows, -self.table.flat(gradient) / n_rows

    def _all_outputs(self, part: np.ndarray, outputs: slice) -> np.ndarray:
        """Columns of some outputs (., o_group) -> of all (., o), with zeros for the others."""
        whole = np.zeros((len(part), len(self.model.prior.mean)))
        whole[:, outputs] = part
        return whole


class ElboObjective:
    """(θ, q) -> the paper's loss of a mini-batch, per row, and its gradient by autograd: what Adam minimises.

    q's mean is whitened (a = s L v); its spread is diagonal in (f_m, β), or for the full family a lower triangular
    matrix T (with the log of its diagonal) in R = R₀ T, where R₀ R₀ᵀ is the optimal covariance at the start.

    Parameters
    ----------
    model : SparseModel
    table : ParameterTable
        Of the parameters without q.
    blocks : Blocks
        All rows.
    """

    def __init__(self, model: SparseModel, table: ParameterTable, blocks: Blocks):
        self.model, self.blocks, self.n_rows = model, blocks, blocks.linear.n_rows
        start = table.values(table.start())
        self.m, (o, self.p) = start["inducing_points"].shape[1], model.prior.scale.shape
        mean, spread, self.root_start = [], [], []
        for own, outputs, (_, L, L_inv) in zip(
            model.statistics(start, blocks), model.groups, model.factors(start), strict=True
        ):
            for q in model.bound(own, outputs, start["signal"], start["noise"], L, L_inv).posteriors:
                mean.append(q.mean)
                self.root_start.append(q.root_inv.T)
                spread.append(np.concatenate(log_variances(q.B, L_inv)))
        size = self.m + self.p
        if model.family == "full":
            spread = [np.zeros(size * (size + 1) // 2)] * o
        # A step of w should move the prediction as much as a step of v does.
        reach = model.prior.scale * np.sqrt(np.diagonal(blocks.linear.HH) / self.n_rows)
        unit = np.hstack([np.ones((o, self.m)), 1.0 / np.where(reach > 0.0, reach, 1.0)])
        self.table = ParameterTable(
            [
                *table.parameters,
                Parameter("mean", np.array(mean), unit=unit),
                Parameter("spread", np.array(spread)),
            ]
        )

    def minibatch(self, batches: Iterator[Batch]) -> Callable[..., tuple[float, np.ndarray]]:
        """X -> (loss, gradient) of the next batch, per row of the whole data."""
        gradient = value_and_grad(self._loss)

        def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
            loss, bar = gradient(x, next(batches))
            return loss / self.n_rows, bar / self.n_rows

        return objective

    def solution(self, x: np.ndarray) -> tuple[float, Posterior, list[SufficientStatistics]]:
        """The bound on all rows, the posterior and the statistics at a point."""
        values = self.table.values(x)
        bound = -float(self._loss(x, self.blocks))
        L_inv = np.array([factor for _, _, factor in self.model.factors(values)])
        root, _ = self._spread(values["spread"], L_inv)
        posterior = self.model.posterior(values, list(values["mean"]), [matrix.T for matrix in root])
        return bound, posterior, self.model.statistics(values, self.blocks)

    def _loss(self, x: Any, rows: Blocks) -> Any:
        coordinates, model = self.table.coordinates(x), self.model
        points = coordinates["inducing_points"] * self.table["inducing_points"].unit
        L = cholesky(model.kernel.traceable_matrices(coordinates["hyperparameters"], points), JITTER)
        statistics = traceable_statistics(coordinates["hyperparameters"], points, L, model.kernel, rows)
        root, log_det = self._spread(coordinates["spread"], inverse_factor(L))
        return negative_elbo(
            statistics.scaled(self.n_rows / rows.linear.n_rows),
            anp.exp(coordinates["signal"]),
            anp.exp(coordinates["noise"]),
            model.prior,
            coordinates["mean"] * self.table["mean"].unit,
            root,
            log_det,
        )

    def _spread(self, spread: Any, L_inv: Any) -> tuple[Any, Any]:
        """R (o, m + p, m + p) with Cov[ω] = R Rᵀ, and log |R Rᵀ| (o,)."""
        m, size, o = self.m, self.m + self.p, len(self.root_start)
        if self.model.family == "diagonal":
            half = anp.exp(0.5 * spread)
            f = L_inv * half[:, None, :m]
            w = half[:, m:, None] * np.eye(self.p)
            root = anp.concatenate(
                [
                    anp.concatenate([f, np.zeros((o, m, self.p))], axis=2),
                    anp.concatenate([np.zeros((o, self.p, m)), w], axis=2),
                ],
                axis=1,
            )
            log_det_K_inv = 2.0 * anp.sum(anp.log(anp.diagonal(L_inv, axis1=-1, axis2=-2)), axis=1)
            return root, anp.sum(spread, axis=1) + log_det_K_inv
        T = lower_triangular(anp.concatenate([anp.exp(spread[:, :size]), spread[:, size:]], axis=1), size)
        start = np.array(self.root_start)
        log_det = 2.0 * np.log(np.abs(np.diagonal(start, axis1=1, axis2=2))).sum(axis=1)
        return anp.matmul(start, T), 2.0 * anp.sum(spread[:, :size], axis=1) + log_det
