"""The functions that are minimised: minus the bound with q at its optimum, and the paper's loss of mini-batches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from ..data.blocks import Blocks
from .bounds import LOG_2PI, BoundAtOptimum, Group, bounds_at_optimum, optimal_posteriors
from .families import DiagonalFamily, Family, FullFamily, NaturalFamily
from .model import SparseModel
from .parameters import ParameterTable, Values, log_prior
from .predictor import Predictor
from .statistics import Residuals, StatisticsGradient, pull_back


def evaluate(
    model: SparseModel,
    values: Values,
    blocks: Blocks,
    terms_of: Callable[[Sequence[Group]], Sequence[BoundAtOptimum | ElboTerms]],
    share: float = 1.0,
) -> tuple[float, Values]:
    """A scalar summed over outputs, and its gradient in the values, or the logarithms of all but inducing points.

    It takes two passes over the rows for each set of inducing points. ``terms_of`` returns the term of each group. If
    outputs share their weights it gets all groups at once, else one at a time. The noise variance in ``values`` is σ²
    times ``share``. Raises `NotPositiveDefiniteError` if a matrix is not finite.
    """
    total, gradient = 0.0, {name: np.zeros(value.shape) for name, value in values.items()}
    separate = values["hyperparameters"].ndim == 2
    groups = model.groups_on(values, blocks, share)
    together: Iterable[Sequence[Group]] = [list(groups)] if model.prior.shared else ([group] for group in groups)
    index = 0
    for some in together:
        for group, terms in zip(some, terms_of(some), strict=True):
            (hyper_bar, Z_bar), residuals = pull_back(
                blocks, group.whitening, group.outputs, group.statistics, terms.gradient, terms.weights
            )
            value, own = terms.finish(residuals)
            total += value
            gradient["hyperparameters"][index if separate else slice(None)] += hyper_bar
            gradient["inducing_points"][index] += Z_bar
            for name, bar in own.items():
                # Shared weights have one row of factors.
                shared = name == "coef_factors" and model.prior.shared
                gradient[name][slice(None) if shared else group.outputs] += bar
            index += 1
    return total, gradient


class BoundObjective:
    """Minus the bound with q at its optimum, per row, and its gradient, as a function of the flat vector."""

    def __init__(self, model: SparseModel, table: ParameterTable, blocks: Blocks):
        self.model, self.table, self.blocks = model, table, blocks

    def __call__(self, flat: np.ndarray) -> tuple[float, np.ndarray]:
        values = self.table.values(flat)
        bound, gradient = evaluate(self.model, values, self.blocks, bounds_at_optimum)
        bound += log_prior(values, gradient)
        n_rows = self.blocks.linear.n_rows
        return -bound / n_rows, -self.table.gradient(gradient) / n_rows


class ElboObjective:
    """The paper's loss (eq. elbo) of mini-batches (its appendix C), per row, as a function of all parameters and q.

    ``table`` is given without the parameters of q, and ``blocks`` are all rows. If ``natural_rates`` are given, q is of
    the full family and moves by natural gradients, of these first and least lengths.
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
            (posteriors,) = optimal_posteriors([group])
            optima += posteriors
            factors += [group.whitening.L_inv] * len(posteriors)
        self.natural = None if natural_rates is None else NaturalFamily(optima, *natural_rates)
        self.family: Family
        if self.natural is not None:
            self.family = self.natural
        else:
            self.family = FullFamily(optima) if model.variant.family == "full" else DiagonalFamily(optima, factors)
        # A step of w should change predictions as much as a step of v.
        reach = model.prior.scale * np.sqrt(np.diagonal(blocks.linear.HH[0]) / self.n_rows)
        m = start["inducing_points"].shape[1]
        unit = np.hstack([np.ones((len(reach), m)), 1.0 / np.where(reach > 0.0, reach, 1.0)])
        # The parameters of the model and of q.
        self.table = ParameterTable([*table.parameters, *self.family.parameters(unit)])

    def minibatch(self, batches: Iterator[Blocks]) -> Callable[[np.ndarray], tuple[float, np.ndarray]]:
        """The function x -> (loss, gradient) of the next batch."""
        return lambda x: self.evaluate(x, next(batches))

    def pace(self, share: float) -> None:
        """Scale the natural gradient step by ``share``, as Adam's steps."""
        if self.natural is not None:
            self.natural.pace(share)

    def evaluate(self, x: np.ndarray, blocks: Blocks) -> tuple[float, np.ndarray]:
        """The loss per row and its gradient (size,) at x (size,), from rows that represent all."""
        values = self.table.values(x)
        # Each row counts N/n times, as with a noise variance of σ² n/N. N and n ignore weights: rows are drawn equally.
        share = blocks.linear.length / self.blocks.linear.length
        counted = values | {"noise": values["noise"] * share}
        loss, gradient = evaluate(
            self.model,
            counted,
            blocks,
            lambda groups: [ElboTerms(self, values, group, share) for group in groups],
            share,
        )
        loss += 0.5 * self.n_rows * float(len(values["noise"]) * LOG_2PI + np.log(values["noise"]).sum())
        loss += 0.5 * len(values["noise"]) * self.blocks.linear.log_variance
        loss += log_prior(values, gradient, sign=-1.0)
        return loss / self.n_rows, self.table.gradient(gradient) / self.n_rows

    def solution(self, x: np.ndarray) -> tuple[float, Predictor]:
        """The bound on all rows and the predictor at x.

        If q moves by natural gradients, it first takes a step of length 1 on all rows, to its optimum.
        """
        values = self.table.values(x)
        if self.natural is not None:
            self.natural.forget()
        bound = -self.evaluate(x, self.blocks)[0] * self.n_rows
        whitenings, L_inv = list(self.model.whitenings(values)), []
        for outputs, whitening in zip(self.model.groups, whitenings, strict=True):
            L_inv += [whitening.L_inv] * (outputs.stop - outputs.start)
        roots = self.family.roots(values, L_inv)
        return bound, self.model.predictor(values, whitenings, self.family.means(values), roots)


class ElboTerms:
    """The paper's loss of a group of outputs, without ½ N log 2πσ², and its gradient.

    ``group`` has the noise variance σ² n/N, because each row of a batch counts N/n times. ``share`` is n/N. The loss is
    complete once the residuals e are known from the second pass over the rows.
    """

    # q has a whitened mean (a = s L v) and a covariance of its family. With e = r - P mean (n,), summed row by row, the
    # loss of each output is
    #
    #     ½ [N log 2πσ² + (eᵀe + s² Σ (k̃ - |v(x)|²)) / σ² + |v|² + |w + w₀|² - (m + p)] + the family's `SpreadTerms`.
    #
    # The first term, with σ² itself, is added in `ElboObjective.evaluate`. In the tight bound (see `BoundAtOptimum`),
    # N/n Σ ŵ log(1 + x) takes the place of s² Σ (k̃ - |v(x)|²) / σ². Its x has σ² itself.

    def __init__(self, elbo: ElboObjective, values: Values, group: Group, share: float = 1.0):
        self._share = share
        self._group, self._n_rows, m = group, elbo.n_rows, len(group.whitening.L)
        self._mean = elbo.family.mean(values, group)
        self._spread = elbo.family.terms(values, group)
        self._has_parameters = "mean" in values
        # (m + p, o): e = r - [V; Hᵀ]ᵀ weights.
        f, b = np.sqrt(group.signal) * self._mean[:, :m].T, (group.prior.scale * self._mean[:, m:]).T
        self.weights = np.vstack([f, b])
        self._ratio = group.signal / group.noise
        self.gradient = StatisticsGradient(
            self._spread.VV,
            self._spread.VH,
            -f / group.noise,
            0.0 if group.complete else 0.5 * self._ratio.sum(),
            self._spread.factor,
            share * self._ratio if group.variant.tight else None,
        )

    def finish(self, residuals: Residuals) -> tuple[float, Values]:
        """The loss, and its gradients (o, ...) in log s², log σ², log factors and the parameters of q."""
        group, statistics, spread, m = self._group, self._group.statistics, self._spread, len(self._group.whitening.L)
        f, b = self.weights[:m], self.weights[m:]
        shift = self._mean.copy()
        shift[:, m:] += group.prior.reference
        # Rows count N/n times. The bound of Titsias (2009) has that factor in the noise already.
        unexplained, slope = group.charges() / (self._share if group.variant.tight else 1.0)
        data = residuals.squares / group.noise
        loss = 0.5 * float((data + unexplained).sum() + np.vdot(shift, shift) - shift.size) + spread.value
        from_mean = 0.5 * np.einsum("mo,mo->o", f, residuals.VE) / group.noise
        gradient = {
            "signal": 0.5 * slope - from_mean + spread.log_signal,
            "noise": 0.5 * (self._n_rows - data - slope) + spread.log_noise,
        }
        if not (self._has_parameters or group.prior.n_groups):
            return loss, gradient
        HE = statistics.HR - statistics.VH.T @ f - statistics.HH @ b
        from_weights = (HE / group.noise).T * group.prior.scale
        if group.prior.n_groups:
            # With q(w) as it is, the weights and their spread grow with the scales, and w₀ falls.
            own = spread.log_scale - from_weights * self._mean[:, m:] - shift[:, m:] * group.prior.reference
            gradient["coef_factors"] = group.prior.of_groups(own)
        if self._has_parameters:
            shift[:, :m] -= (residuals.VE * (np.sqrt(group.signal) / group.noise)).T
            shift[:, m:] -= from_weights
            gradient |= {"mean": shift, "spread": spread.spread}
        return loss, gradient
