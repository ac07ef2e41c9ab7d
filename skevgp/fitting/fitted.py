"""The result of a fit: `FittedModel` of each independent model, and `Fitted` of all of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..data.rows import Rows, Source
from ..model.exact import exact_twin
from ..model.model import SparseModel
from ..model.parameters import ParameterTable, Values
from ..model.predictor import CoefficientPrior, Predictor
from ..model.statistics import Kernel, SufficientStatistics
from ..model.weights import WeightLikelihood
from .doubts import TURNS, RowDoubts, look_at, of_residuals
from .rules import Rules
from .units import Units


@dataclass(frozen=True)
class FittedModel:
    """A fitted sparse model of some outputs, in internal units."""

    sparse: SparseModel
    # The limits and the start of the parameters.
    table: ParameterTable
    values: Values
    # For each set of inducing points, at ``values``.
    statistics: list[SufficientStatistics]
    predictor: Predictor
    loss_curve: list[float]
    message: str
    # Whether neighbouring rows are alike.
    dependent: bool = False
    # Number of outputs that predict held-out groups no better than the features alone.
    gone: int = 0
    # Only for noise with heavy tails.
    doubts: RowDoubts | None = None
    # Only if they are more accurate than from the statistics.
    known_bound: float | None = None
    known_upper_bound: float | None = None
    # Whether the predictor is that of the exact model.
    is_exact: bool = False

    @cached_property
    def bound(self) -> float:
        """Lower bound on the log marginal likelihood of the residuals, in nats, in internal units."""
        return self.sparse.bound(self.values, self.statistics) if self.known_bound is None else self.known_bound

    @cached_property
    def upper_bound(self) -> float:
        """Upper bound on the same."""
        if self.known_upper_bound is not None:
            return self.known_upper_bound
        return self.sparse.upper_bound(self.values, self.statistics)

    def moved(self, rows: Rows, prior: CoefficientPrior) -> FittedModel:
        """The model of the same rows with other features, at the same values."""
        sparse = replace(self.sparse, prior=prior)
        blocks = sparse.blocks(rows, self.values["inducing_points"].shape[1])
        statistics = sparse.statistics(self.values, blocks)
        if self.is_exact:
            exact = exact_twin(sparse, self.table, rows)
            bound, predictor = float(exact.log_likelihoods(self.values).sum()), exact.predictor(self.values)
        else:
            bound = sparse.bound(self.values, statistics, blocks)
            predictor = sparse.at_optimum(self.values, statistics, blocks=blocks)
        upper = bound if self.is_exact else sparse.upper_bound(self.values, statistics, blocks)
        return replace(
            self,
            sparse=sparse,
            statistics=statistics,
            predictor=predictor,
            known_bound=bound,
            known_upper_bound=upper,
        )

    def weight_likelihoods(self, prior: CoefficientPrior, rows: Rows | None) -> list[WeightLikelihood]:
        """The likelihood of the weights of each output for a prior and, if ``rows`` are given, for their features."""
        sparse, statistics = replace(self.sparse, prior=prior), self.statistics
        if rows is not None:
            if self.is_exact:
                return exact_twin(sparse, self.table, rows).weight_likelihoods(self.values)
            blocks = sparse.blocks(rows, self.values["inducing_points"].shape[1])
            statistics = sparse.statistics(self.values, blocks)
        return sparse.weight_likelihoods(self.values, statistics)

    def updated(self, rows: Rows, weight: float = 1.0) -> FittedModel:
        """The model with new rows: same kernel and inducing points, q at its optimum for all rows so far.

        ``weight`` multiplies the log likelihood of the earlier rows.
        """
        if self.doubts is not None:
            return self._updated_doubting(self.doubts, rows)
        # Points that were all rows before are not all rows now.
        sparse, values = replace(self.sparse, complete=False), self.values
        if self.is_exact:
            # From here on the sparse model is used, with its lowest noise.
            lowest = np.where(self.table["noise"].free, Rules.lowest_noise, 0.0)
            values = values | {"noise": np.maximum(values["noise"], lowest)}
            whitenings = list(sparse.whitenings(values))
        else:
            whitenings = [group.whitening for group in self.predictor.groups]
        before = self.statistics
        if self.is_exact or weight < 1.0:
            # The tight charge of earlier rows with another noise or weight is not known from their sums.
            before = sparse.with_loose_charge(values, before)
        new = sparse.statistics(values, sparse.blocks(rows, values["inducing_points"].shape[1]), whitenings)
        statistics = [old.scaled(weight) + more for old, more in zip(before, new, strict=True)]
        predictor = sparse.at_optimum(values, statistics, whitenings)
        return replace(
            self,
            sparse=sparse,
            values=values,
            statistics=statistics,
            predictor=predictor,
            known_bound=None,
            known_upper_bound=None,
            is_exact=False,
        )

    def told(self) -> FittedModel:
        """The model with the noise variance of rows that are not outliers. Then no upper bound is known."""
        if self.doubts is None:
            return self
        predictor = replace(self.predictor, noise=self.values["noise"] * self.doubts.noise_factor)
        return replace(self, known_upper_bound=np.inf, predictor=predictor)

    def _updated_doubting(self, doubts: RowDoubts, rows: Rows) -> FittedModel:
        """The model with new rows, whose noise scales and q alternate. The scales of earlier rows stay.

        The first scales come from the predictions before the update.
        """
        noise, plain = self.values["noise"], replace(self, doubts=None)
        look = look_at(rows, of_residuals(self.predictor))
        predicted = look.latent + np.multiply.outer(look.variance, noise)
        doubts = replace(doubts, scales=doubts.scales.at((look.errors**2 / predicted).sum(axis=1)))
        for _ in range(TURNS):
            new = plain.updated(doubts.weigh(rows))
            before, look = doubts, look_at(rows, of_residuals(new.predictor), doubts.precision(self.sparse, noise))
            doubts = replace(doubts, scales=doubts.scales.at(look.distances(noise)))
            if not doubts.differ_from(before):
                break
        return replace(plain.updated(doubts.weigh(rows)), doubts=doubts).told()


@dataclass(frozen=True)
class Fitted:
    """The fitted models of all outputs."""

    units: Units
    # Of each model.
    outputs: list[list[int]]
    # Whether the groups of outputs were found, and not given.
    found: bool
    models: tuple[FittedModel, ...]
    # For the user.
    messages: tuple[str, ...]

    def predictor(self) -> Predictor:
        """The predictor of all outputs, in the user's units."""
        return self.units.predictor([one.predictor for one in self.models], self.outputs)

    def updated(self, source: Source, weight: float = 1.0, row_variance: np.ndarray | None = None) -> Fitted:
        """The models with new rows. ``weight`` multiplies the log likelihood of the earlier rows."""
        rows = self.units.rows(source)
        pairs = zip(self.outputs, self.models, strict=True)
        models = (one.updated(rows.outputs(own).noisier(row_variance), weight) for own, one in pairs)
        return replace(self, models=tuple(models))

    # --- other features of the same rows (see `fitting.theta`) --------------------------------------------------------

    def moved(self, source: Source, prior: CoefficientPrior) -> Fitted:
        """The models with the same kernel and noise, other features, and a prior with learned scales for these."""
        units = self._with_prior(prior)
        rows, internal = units.rows(source), units.internal_prior()
        pairs = zip(self.outputs, self.models, strict=True)
        models = (one.moved(rows.outputs(own), internal.outputs(own)) for own, one in pairs)
        return replace(self, units=units, models=tuple(models))

    def reweighted(self, prior: CoefficientPrior) -> Fitted:
        """The models with another prior of the weights that has the same offset."""
        units = self._with_prior(prior)
        internal, models = units.internal_prior(), []
        for own, one in zip(self.outputs, self.models, strict=True):
            sparse = replace(one.sparse, prior=internal.outputs(own))
            predictor = sparse.at_optimum(one.values, one.statistics)
            models.append(replace(one, sparse=sparse, predictor=predictor, known_bound=None, known_upper_bound=None))
        return replace(self, units=units, models=tuple(models))

    def weight_likelihoods(
        self, source: Source | None = None, prior: CoefficientPrior | None = None
    ) -> list[WeightLikelihood]:
        """The likelihood of the weights of each output, in the user's units.

        With a ``source``, they are those of other features, which have the prior ``prior`` with learned scales.
        """
        units = self.units if prior is None else self._with_prior(prior)
        rows, internal = None if source is None else units.rows(source), units.internal_prior()
        found: dict[int, WeightLikelihood] = {}
        for own, one in zip(self.outputs, self.models, strict=True):
            each = one.weight_likelihoods(internal.outputs(own), None if rows is None else rows.outputs(own))
            found |= {o: each[i].in_units(units.target_unit[o]) for i, o in enumerate(own)}
        return [found[o] for o in sorted(found)]

    def _with_prior(self, prior: CoefficientPrior) -> Units:
        """The units with a prior that has the learned scales."""
        factors = self._factors()
        return replace(self.units, prior=prior.at({"coef_factors": 1.0 / factors}) if factors.size else prior)

    def _factors(self) -> np.ndarray:
        factors = np.ones((len(self.units.target_unit), self.units.prior.n_groups))
        for outputs, one in zip(self.outputs, self.models, strict=True):
            factors[outputs] = one.values.get("coef_factors", 1.0)
        return factors

    @property
    def prior(self) -> CoefficientPrior:
        """The prior of the weights in the user's units, with the learned scales."""
        return self.units.prior.at({"coef_factors": self._factors()})

    @property
    def row_scales(self) -> np.ndarray | None:
        """E[τ] of each row and model, (n, n_models). None for Gaussian noise."""
        each = [one.doubts.scales.mean for one in self.models if one.doubts is not None]
        return np.column_stack(each) if each else None

    @property
    def dependent(self) -> bool:
        """Whether neighbouring rows are alike."""
        return any(one.dependent for one in self.models)

    @property
    def gone(self) -> int:
        """Number of outputs that predict held-out groups no better than the features alone."""
        return sum(one.gone for one in self.models)

    @property
    def lower_bound(self) -> float:
        """Lower bound on the log marginal likelihood, in nats, summed over outputs."""
        return sum(one.bound for one in self.models) - self._shift

    @property
    def upper_bound(self) -> float:
        """Upper bound on the log marginal likelihood, in nats, summed over outputs."""
        return sum(one.upper_bound for one in self.models) - self._shift

    @property
    def n_iter(self) -> int:
        """Number of iterations of the longest fit."""
        return max(len(one.loss_curve) for one in self.models)

    @property
    def loss_curve(self) -> np.ndarray:
        """Minus the bound per iteration, (n_iter,), summed over models. A model that has ended keeps its last value."""
        if self.n_iter == 0:
            return np.empty(0)
        # A model without free parameters has no iterations.
        curves = [one.loss_curve or [-one.bound] for one in self.models]
        return np.sum([np.pad(curve, (0, self.n_iter - len(curve)), "edge") for curve in curves], axis=0) + self._shift

    @property
    def _shift(self) -> float:
        # Difference of the loss of all rows between the user's and internal units.
        return self.models[0].statistics[0].n_rows * self.units.log_unit(slice(None))

    @property
    def n_parameters(self) -> int:
        """Number of free parameters of kernels, noise, inducing points and q."""
        total = 0
        for one in self.models:
            n_outputs, p = one.sparse.prior.scale.shape
            m, of_weights = one.values["inducing_points"].shape[1], p + p * (p + 1) // 2
            of_values = m + m * (m + 1) // 2 + m * p
            if one.sparse.family == "diagonal":
                of_values, of_weights = 2 * m, 2 * p
            total += one.table.size + n_outputs * of_values
            total += of_weights * (1 if one.sparse.prior.shared else n_outputs)
        return total

    @property
    def sharing(self) -> list[list[int]]:
        """The groups of outputs that share a kernel."""
        found = []
        for outputs, one in zip(self.outputs, self.models, strict=True):
            separate = one.values["hyperparameters"].ndim == 2
            found += [outputs[group] for group in one.sparse.groups] if separate else [outputs]
        return sorted(found)

    def limits(self, name: str, output: int) -> np.ndarray:
        """Limits (n, 2) of an output's ``hyperparameters`` or ``signal``, in the user's units."""
        one, within = next(
            (one, own.index(output)) for own, one in zip(self.outputs, self.models, strict=True) if output in own
        )
        limits = one.table[name].value_limits()
        if name == "signal":
            # Calibration may have moved it outside.
            (low, high), signal = limits[within], one.values["signal"][within]
            return np.array([[min(low, signal), max(high, signal)]]) * self.units.target_unit[output] ** 2
        if one.table[name].start.ndim == 1:
            return limits
        return limits.reshape(*one.table[name].start.shape, 2)[one.sparse.set_of(within, one.table[name])]

    def values_in(self, units: Units, rows: Rows, kernel: Kernel, model: int) -> Values:
        """The values of a model in other internal units, as far as they are useful for another fit."""
        one, own, inputs = self.models[model], self.outputs[model], rows.inputs
        values, points = one.values, one.values["inducing_points"]
        if inputs.mean.ndim == 2 and one.sparse.kernels is None:
            inputs = inputs.at(own)
        if points.shape[2] != inputs.mean.shape[-1] or (inputs.mean.ndim == 2 and len(points) != len(inputs.mean)):
            return {}
        lowest, highest = (edge.reshape(-1, 1, points.shape[2]) for edge in (inputs.lowest, inputs.highest))
        outside = (points < 2.0 * lowest - highest) | (points > 2.0 * highest - lowest)
        # For a smooth function a few points may be far outside. If most are, the rows are different ones.
        if outside.any(axis=-1).mean() > 0.5:
            return {}
        ratio = (self.units.target_unit[own] / units.target_unit[own]) ** 2
        found = {"noise": values["noise"] * ratio, "inducing_points": points}
        if self.units.prior.labels == units.prior.labels and "coef_factors" in values:
            found["coef_factors"] = values["coef_factors"]
        if one.sparse.kernel == kernel:
            found |= {"hyperparameters": values["hyperparameters"], "signal": values["signal"] * ratio}
        return found
