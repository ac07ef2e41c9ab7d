"""The two functions that are minimised: minus the bound at the optimum of q, and the paper's loss of mini-batches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Protocol

import numpy as np

from ..data.blocks import Blocks
from .bounds import LOG_2PI, BoundAtOptimum, Group, bounds_at_optimum
from .families import DiagonalFamily, Family, FullFamily, NaturalFamily
from .model import SparseModel
from .parameters import ParameterTable, Values
from .predictor import Predictor
from .statistics import Residuals, StatisticsGradient, pull_back


class Terms(Protocol):
    """A scalar of a group of outputs, as far as the statistics of the rows decide it."""

    @property
    def weights(self) -> np.ndarray:
        """(m + p, o): the mean of q leaves e = r - [V; Hᵀ]ᵀ weights of each row."""

    @property
    def gradient(self) -> StatisticsGradient:
        """Of the scalar."""

    def finish(self, residuals: Residuals) -> tuple[float, Values]:
        """The scalar, and its gradients in what belongs to the group's outputs: (o, ...) each, by parameter."""


def evaluate(
    model: SparseModel,
    values: Values,
    blocks: Blocks,
    terms_of: Callable[[Sequence[Group]], Sequence[Terms]],
) -> tuple[float, Values]:
    """A scalar of the model and some rows, summed over outputs, and its gradient: two passes for each set of points.

    Parameters
    ----------
    model : SparseModel
    values : dict
    blocks : Blocks
    terms_of : callable
        What the scalar is, given groups with their statistics: one after the other or, if outputs share their weights,
        all at once.

    Returns
    -------
    total : float
    gradient : dict
        In the values; in the logarithms of hyperparameters, signal and noise.

    Raises
    ------
    NotPositiveDefiniteError
        If a matrix is not finite.
    """
    total, gradient = 0.0, {name: np.zeros(value.shape) for name, value in values.items()}
    groups = model.groups_on(values, blocks)
    jointly: Iterable[Sequence[Group]] = [list(groups)] if model.prior.shared else ([group] for group in groups)
    index = 0
    for together in jointly:
        for group, terms in zip(together, terms_of(together), strict=True):
            (hyper_bar, Z_bar), residuals = pull_back(
                blocks, group.whitening, group.outputs, group.statistics, terms.gradient, terms.weights
            )
            value, own = terms.finish(residuals)
            total += value
            separate = gradient["hyperparameters"].ndim == 2
            gradient["hyperparameters"][index if separate else slice(None)] += hyper_bar
            gradient["inducing_points"][index] += Z_bar
            for name, bar in own.items():
                gradient[name][group.outputs] = bar
            index += 1
    return total, gradient


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
        self._terms_of = partial(bounds_at_optimum, family=model.family)

    def __call__(self, flat: np.ndarray) -> tuple[float, np.ndarray]:
        bound, gradient = evaluate(self.model, self.table.values(flat), self.blocks, self._terms_of)
        n_rows = self.blocks.linear.n_rows
        return -bound / n_rows, -self.table.gradient(gradient) / n_rows


class ElboObjective:
    """(θ, q) -> the paper's loss (its eq. elbo) of a mini-batch (its appendix C), per row, and its gradient.

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
        start = table.values_at_start()
        optima, factors = [], []
        for group in model.groups_on(start, blocks):
            of_group = BoundAtOptimum(group, model.family).posteriors
            optima += of_group
            factors += [group.whitening.L_inv] * len(of_group)
        self.natural = None if natural_rates is None else NaturalFamily(optima, *natural_rates)
        self.family: Family
        if self.natural is not None:
            self.family = self.natural
        else:
            self.family = FullFamily(optima) if model.family == "full" else DiagonalFamily(optima, factors)
        # A step of w should move the prediction as much as a step of v does.
        reach = model.prior.scale * np.sqrt(np.diagonal(blocks.linear.HH[0]) / self.n_rows)
        m = start["inducing_points"].shape[1]
        unit = np.hstack([np.ones((len(reach), m)), 1.0 / np.where(reach > 0.0, reach, 1.0)])
        self.table = ParameterTable([*table.parameters, *self.family.parameters(unit)])

    def minibatch(self, batches: Iterator[Blocks]) -> Callable[[np.ndarray], tuple[float, np.ndarray]]:
        """X -> (loss, gradient) of the next batch, per row of the whole data."""
        return lambda x: self.evaluate(x, next(batches))

    def pace(self, share: float) -> None:
        """Told the size of Adam's next step as a share of its first, shorten the natural gradients as much."""
        if self.natural is not None:
            self.natural.pace(share)

    def evaluate(self, x: np.ndarray, blocks: Blocks) -> tuple[float, np.ndarray]:
        """The loss of some rows that stand for all, per row, and its gradient (size,); x is of the same size."""
        values = self.table.values(x)
        # Rows that count N/n times (whatever their weights: all are drawn alike): a noise variance of σ² n/N.
        counted = values | {"noise": values["noise"] * (blocks.linear.length / self.blocks.linear.length)}
        loss, gradient = evaluate(
            self.model, counted, blocks, lambda groups: [_ElboTerms(self, values, group) for group in groups]
        )
        loss += 0.5 * self.n_rows * float(len(values["noise"]) * LOG_2PI + np.log(values["noise"]).sum())
        loss += 0.5 * len(values["noise"]) * self.blocks.linear.log_variance
        return loss / self.n_rows, self.table.gradient(gradient) / self.n_rows

    def solution(self, x: np.ndarray) -> tuple[float, Predictor]:
        """The bound on all rows and the predictor at a point.

        A q that moves by natural gradients takes a last one, of length 1, on all rows: to its optimum.
        """
        values = self.table.values(x)
        if self.natural is not None:
            self.natural.forget()
        bound = -self.evaluate(x, self.blocks)[0] * self.n_rows
        whitenings = list(self.model.whitenings(values))
        L_inv = [
            whitening.L_inv
            for outputs, whitening in zip(self.model.groups, whitenings, strict=True)
            for _ in range(outputs.start, outputs.stop)
        ]
        roots = self.family.roots(values, L_inv)
        return bound, self.model.predictor(values, whitenings, self.family.means(values), roots)


class _ElboTerms:
    """The paper's loss of a group of outputs.

    q's mean is whitened (a = s L v); its spread is as its family says. With e = r - P mean, summed row by row, and with
    the rows of a batch counted N/n times (in the group's noise), the loss of each output is

        ½ [N log 2πσ² + (eᵀe + s² Σ(k̃ - |v|²)) / σ² + |v|² + |w + w₀|² - (m + p)] + the family's `SpreadTerms`;

    the first term, with the noise as it is, is added for all outputs at once.
    """

    def __init__(self, elbo: ElboObjective, values: Values, group: Group):
        self._group, self._n_rows, m = group, elbo.n_rows, len(group.whitening.L)
        self._mean = elbo.family.mean(values, group)
        self._spread = elbo.family.terms(values, group)
        self._has_parameters = "mean" in values
        f, b = np.sqrt(group.signal) * self._mean[:, :m].T, (group.prior.scale * self._mean[:, m:]).T
        self.weights = np.vstack([f, b])
        self._ratio = group.signal / group.noise
        self.gradient = StatisticsGradient(
            self._spread.VV,
            self._spread.VH,
            -f / group.noise,
            0.0 if group.complete else 0.5 * self._ratio.sum(),
            self._spread.factor,
        )

    def finish(self, residuals: Residuals) -> tuple[float, Values]:
        """The loss, and its gradients (o, ...) in log s², log σ² and the parameters of q."""
        group, statistics, spread, m = self._group, self._group.statistics, self._spread, len(self._group.whitening.L)
        f, b = self.weights[:m], self.weights[m:]
        shift = self._mean.copy()
        shift[:, m:] += group.prior.reference
        unexplained = self._ratio * statistics.unexplained
        data = residuals.squares / group.noise + unexplained
        loss = 0.5 * float(data.sum() + np.vdot(shift, shift) - shift.size) + spread.value
        from_mean = 0.5 * np.einsum("mo,mo->o", f, residuals.VE) / group.noise
        gradient = {
            "signal": 0.5 * unexplained - from_mean + spread.log_signal,
            "noise": 0.5 * (self._n_rows - data) + spread.log_noise,
        }
        if self._has_parameters:
            HE = statistics.HR - statistics.VH.T @ f - statistics.HH @ b
            shift[:, :m] -= (residuals.VE * (np.sqrt(group.signal) / group.noise)).T
            shift[:, m:] -= (HE / group.noise).T * group.prior.scale
            gradient |= {"mean": shift, "spread": spread.spread}
        return loss, gradient
