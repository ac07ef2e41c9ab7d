"""The paper's loss of mini-batches, with a hand-written gradient: what Adam minimises."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from .._linalg import cholesky_pullback
from ..optimizers.parameters import ParameterTable
from ..rows.blocks import Blocks
from .bounds import LOG_2PI
from .families import DiagonalFamily, Family, FullFamily, Group, NaturalFamily
from .model import SparseModel
from .posterior import Posterior
from .statistics import SufficientStatistics, collect, pull_back


class ElboObjective:
    """(θ, q) -> the paper's loss (its eq. elbo) of a mini-batch (its appendix C), per row, and its gradient.

    q's mean is whitened (a = s L v); its spread is as its family says. With e = r - P mean, summed row by row, and with
    the rows of a batch counted N/n times, the loss of each output is

        ½ [N log 2πσ² + (eᵀe + s² Σ(k̃ - |v|²)) / σ² + |v|² + |w + w₀|² - (m + p)] + the family's `SpreadTerms`.

    Parameters
    ----------
    model : SparseModel
    table : ParameterTable
        Of the parameters without q.
    blocks : Blocks
        All rows.
    natural_rates : (float, float), default=None
        If given, q (of the full family) moves by natural gradients of these lengths, the first and the least, and is no
        part of θ.

    Attributes
    ----------
    table : ParameterTable
        Of all that an optimiser moves.
    """

    def __init__(
        self,
        model: SparseModel,
        table: ParameterTable,
        blocks: Blocks,
        natural_rates: tuple[float, float] | None = None,
    ):
        self.model, self.blocks, self.n_rows = model, blocks, blocks.linear.n_rows
        start = table.values(table.start())
        optima, factors = [], []
        for own, outputs, (_, L, L_inv) in zip(
            model.statistics(start, blocks),
            model.groups,
            model.factors(start),
            strict=True,
        ):
            of_group = model.bound(own, outputs, start["signal"], start["noise"], L, L_inv).posteriors
            optima += of_group
            factors += [L_inv] * len(of_group)
        self.natural = None if natural_rates is None else NaturalFamily(optima, *natural_rates)
        self.family: Family
        if self.natural is not None:
            self.family = self.natural
        else:
            self.family = FullFamily(optima) if model.family == "full" else DiagonalFamily(optima, factors)
        # A step of w should move the prediction as much as a step of v does.
        reach = model.prior.scale * np.sqrt(np.diagonal(blocks.linear.HH) / self.n_rows)
        m = start["inducing_points"].shape[1]
        unit = np.hstack([np.ones((len(reach), m)), 1.0 / np.where(reach > 0.0, reach, 1.0)])
        self.table = ParameterTable([*table.parameters, *self.family.parameters(unit)])
        # What `ParameterTable.values` multiplied the coordinates by.
        self._units = {own.name: own.unit for own in self.table.parameters if own.transform == "identity"}

    def minibatch(self, batches: Iterator[Blocks]) -> Callable[..., tuple[float, np.ndarray]]:
        """X -> (loss, gradient) of the next batch, per row of the whole data."""

        def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
            return self.evaluate(x, next(batches))

        return objective

    def pace(self, share: float) -> None:
        """Told the size of Adam's next step as a share of its first, shorten the natural gradients as much."""
        if self.natural is not None:
            self.natural.pace(share)

    def evaluate(self, x: np.ndarray, rows: Blocks) -> tuple[float, np.ndarray]:
        """The loss of some rows that stand for all, per row, and its gradient (size,).

        Parameters
        ----------
        x : ndarray of shape (size,)
        rows : Blocks

        Returns
        -------
        loss : float
        gradient : ndarray of shape (size,)

        Raises
        ------
        NotPositiveDefiniteError
            If a matrix is not finite.
        """
        values, model = self.table.values(x), self.model
        o, p = model.prior.scale.shape
        gradient = {name: np.zeros_like(value) for name, value in values.items()}
        total = 0.5 * self.n_rows * float(o * LOG_2PI + np.log(values["noise"]).sum())
        # Rows that count N/n times: a noise variance of σ² n/N.
        noise = values["noise"] * (rows.linear.n_rows / self.n_rows)
        for index, (outputs, (at, L, L_inv)) in enumerate(zip(model.groups, model.factors(values), strict=True)):
            statistics = collect(rows, at, L_inv)
            own = Group(
                outputs,
                statistics.outputs(outputs),
                values["signal"][outputs],
                noise[outputs],
                model.prior.outputs(outputs),
                L,
                L_inv,
            )
            m, ratio, scale = len(L), own.signal / own.noise, own.prior.scale
            mean = self.family.mean(values, own)
            terms = self.family.terms(values, own)
            f, b = np.sqrt(own.signal) * mean[:, :m].T, (scale * mean[:, m:]).T
            fitted, VE_bar = np.zeros((m + p, o)), np.zeros((m, o))
            fitted[:m, outputs], fitted[m:, outputs] = f, b
            VE_bar[:, outputs] = -f / own.noise
            rows_bar, L_bar, squares, VE = pull_back(
                rows, at, L_inv, statistics, terms.VV, terms.VH, VE_bar, 0.5 * ratio.sum(), fitted
            )
            hyper_bar, Z_bar = at.finish_pullback(rows_bar, cholesky_pullback(L, L_inv, L_bar + terms.L))
            gradient["hyperparameters"] += hyper_bar
            gradient["inducing_points"][index] += Z_bar

            squares, VE = squares[outputs], VE[:, outputs]
            HE = own.statistics.HR - statistics.VH.T @ f - statistics.HH @ b
            shift = mean.copy()
            shift[:, m:] += own.prior.reference
            unexplained = ratio * statistics.unexplained
            data = squares / own.noise + unexplained
            total += 0.5 * float(data.sum() + np.vdot(shift, shift) - shift.size) + terms.value
            from_mean = 0.5 * np.einsum("mo,mo->o", f, VE) / own.noise
            gradient["signal"][outputs] = 0.5 * unexplained - from_mean + terms.log_signal
            gradient["noise"][outputs] = 0.5 * (self.n_rows - data) + terms.log_noise
            if "mean" in gradient:
                shift[:, :m] -= (VE * (np.sqrt(own.signal) / own.noise)).T
                shift[:, m:] -= (HE / own.noise).T * scale
                gradient["mean"][outputs], gradient["spread"][outputs] = shift, terms.spread
        for name, unit in self._units.items():
            gradient[name] *= unit
        return total / self.n_rows, self.table.flat(gradient) / self.n_rows

    def solution(self, x: np.ndarray) -> tuple[float, Posterior, list[SufficientStatistics]]:
        """The bound on all rows, the posterior and the statistics at a point.

        A q that moves by natural gradients takes a last one, of length 1, on all rows: to its optimum.
        """
        values = self.table.values(x)
        if self.natural is not None:
            self.natural.forget()
        bound = -self.evaluate(x, self.blocks)[0] * self.n_rows
        L_inv = [
            factor
            for outputs, (_, _, factor) in zip(self.model.groups, self.model.factors(values), strict=True)
            for _ in range(outputs.start, outputs.stop)
        ]
        posterior = self.model.posterior(values, self.family.means(values), self.family.roots(values, L_inv))
        return bound, posterior, self.model.statistics(values, self.blocks)
