"""What L-BFGS minimises: θ -> (loss, gradient). (Adam: `elbo`.)"""

from __future__ import annotations

import numpy as np

from .._linalg import cholesky_pullback
from ..optimizers.parameters import ParameterTable
from ..rows.blocks import Blocks
from .bounds import Residuals
from .model import SparseModel
from .statistics import collect, pull_back


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
