"""The result of a fit: `FittedModel` of each independent model, and `Fitted` of all of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..data.rows import Rows, Source
from ..model.mixture import MixturePosterior
from ..model.model import SparseModel
from ..model.parameters import ParameterTable, Values
from ..model.posterior import FittedPosterior, LocalPosterior, SparsePosterior
from ..model.predictor import CoefficientPrior, Predictor
from ..model.statistics import Kernel
from ..model.weights import WeightLikelihood
from .doubts import TURNS, RowDoubts, look_at, of_residuals
from .rules import Rules
from .units import Units


@dataclass(frozen=True)
class FittedModel:
    """A fitted model of some outputs, in internal units."""

    # Columns of y.
    outputs: list[int]
    posterior: FittedPosterior
    # The limits and the start of the parameters.
    table: ParameterTable
    loss_curve: list[float]
    message: str
    # Whether neighbouring rows are alike.
    dependent: bool = False
    # Number of outputs that predict held-out groups no better than the features alone.
    gone: int = 0
    # Only for noise with heavy tails.
    doubts: RowDoubts | None = None
    # The numbers of rows and of learned numbers of kernel and noise, if the rows are few for these.
    few: tuple[int, int] | None = None

    @property
    def sparse(self) -> SparseModel:
        """The sparse model. For an exact one, all rows are its inducing points."""
        return self.posterior.sparse

    @property
    def values(self) -> Values:
        """The parameters at the end of the fit."""
        return self.posterior.values

    @property
    def bound(self) -> float:
        """Lower bound on the log marginal likelihood of the residuals, in nats."""
        return self.posterior.bound

    @property
    def upper_bound(self) -> float:
        """Upper bound on the same. None is known for noise with heavy tails."""
        return self.posterior.upper_bound if self.doubts is None else np.inf

    @property
    def predictor(self) -> Predictor:
        """The predictor of residuals."""
        return self.posterior.predictor

    def updated(self, rows: Rows, weight: float = 1.0) -> FittedModel:
        """The model with new rows: same kernel and inducing points, q at its optimum for all rows so far.

        ``weight`` multiplies the log likelihood of the earlier rows. It must be 1 for noise with heavy tails.
        """
        if self.doubts is not None:
            assert weight == 1.0
            return self._updated_doubting(self.doubts, rows)
        lowest = np.where(self.table["noise"].free, Rules.lowest_noise, 0.0)
        return replace(self, posterior=self.posterior.updated(rows, weight, lowest))

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
        return replace(plain.updated(doubts.weigh(rows)), doubts=doubts)


@dataclass(frozen=True)
class Fitted:
    """The fitted models of all outputs."""

    units: Units
    # Whether the groups of outputs were found, and not given.
    sharing_found: bool
    models: tuple[FittedModel, ...]
    # For the user.
    messages: tuple[str, ...]

    def predictor(self) -> Predictor:
        """The predictor of all outputs, in the user's units."""
        return self.units.predictor([model.predictor for model in self.models], self.outputs)

    @property
    def at_mode(self) -> Fitted:
        """The models with their most likely kernel and noise only, if predictions are averaged over draws of them."""
        models = (
            replace(model, posterior=model.posterior.mode) if isinstance(model.posterior, MixturePosterior) else model
            for model in self.models
        )
        return replace(self, models=tuple(models))

    @property
    def few(self) -> tuple[int, int] | None:
        """The numbers of rows and of learned numbers of kernel and noise of a model, if the rows are few for these."""
        return next((model.few for model in self.models if model.few is not None), None)

    @property
    def n_draws(self) -> int:
        """Number of draws of kernel and noise over which predictions are averaged. 0 if there is only one kernel."""
        mixtures = (model.posterior for model in self.models if isinstance(model.posterior, MixturePosterior))
        return max((len(mixture.draws) for mixture in mixtures), default=0)

    @property
    def outputs(self) -> list[list[int]]:
        """The columns of y of each model."""
        return [model.outputs for model in self.models]

    def updated(self, source: Source, weight: float = 1.0, row_variance: np.ndarray | None = None) -> Fitted:
        """The models with new rows. ``weight`` multiplies the log likelihood of the earlier rows."""
        rows = self.units.rows(source)
        models = (model.updated(rows.outputs(model.outputs).noisier(row_variance), weight) for model in self.models)
        return replace(self, models=tuple(models))

    # --- other features of the same rows (see `fitting.theta`) --------------------------------------------------------

    def moved(self, source: Source, prior: CoefficientPrior) -> Fitted:
        """The models with the same kernel and noise, other features, and a prior with learned scales for these."""
        units = self._with_prior(prior)
        rows, internal, models = units.rows(source), units.internal_prior(), []
        for model in self.models:
            posterior = model.posterior.moved(internal.outputs(model.outputs), rows.outputs(model.outputs))
            models.append(replace(model, posterior=posterior))
        return replace(self, units=units, models=tuple(models))

    def reweighted(self, prior: CoefficientPrior) -> Fitted:
        """The models, after new rows, with another prior of the weights that has the same offset."""
        units = self._with_prior(prior)
        internal, models = units.internal_prior(), []
        for model in self.models:
            assert isinstance(model.posterior, SparsePosterior | LocalPosterior)
            models.append(replace(model, posterior=model.posterior.reweighted(internal.outputs(model.outputs))))
        return replace(self, units=units, models=tuple(models))

    def weight_likelihoods(
        self, source: Source | None = None, prior: CoefficientPrior | None = None
    ) -> list[WeightLikelihood]:
        """The likelihood of the weights of each output, in the user's units.

        With a ``source``, they are those of other features, which have the prior ``prior`` with learned scales.
        """
        units = self.units if prior is None else self._with_prior(prior)
        rows, internal = None if source is None else units.rows(source), units.internal_prior()
        likelihoods: dict[int, WeightLikelihood] = {}
        for model in self.models:
            rows_of_model = None if rows is None else rows.outputs(model.outputs)
            of_model = model.posterior.weight_likelihoods(internal.outputs(model.outputs), rows_of_model)
            likelihoods |= dict(zip(model.outputs, of_model, strict=True))
        return [likelihoods[o].in_units(unit) for o, unit in enumerate(units.target_unit)]

    def _with_prior(self, prior: CoefficientPrior) -> Units:
        """The units with a prior that has the learned scales."""
        factors = self._factors()
        return replace(self.units, prior=prior.at({"coef_factors": 1.0 / factors}) if factors.size else prior)

    def _factors(self) -> np.ndarray:
        factors = np.ones((len(self.units.target_unit), self.units.prior.n_groups))
        for model in self.models:
            factors[model.outputs] = model.values.get("coef_factors", 1.0)
        return factors

    @property
    def prior(self) -> CoefficientPrior:
        """The prior of the weights in the user's units, with the learned scales."""
        return self.units.prior.at({"coef_factors": self._factors()})

    @property
    def row_scales(self) -> np.ndarray | None:
        """E[τ] of each row and model, (n, n_models). None for Gaussian noise."""
        scales = [model.doubts.scales.mean for model in self.models if model.doubts is not None]
        return np.column_stack(scales) if scales else None

    @property
    def dependent(self) -> bool:
        """Whether neighbouring rows are alike."""
        return any(model.dependent for model in self.models)

    @property
    def gone(self) -> int:
        """Number of outputs that predict held-out groups no better than the features alone."""
        return sum(model.gone for model in self.models)

    @property
    def lower_bound(self) -> float:
        """Lower bound on the log marginal likelihood, in nats, summed over outputs."""
        return sum(model.bound for model in self.models) - self._shift

    @property
    def upper_bound(self) -> float:
        """Upper bound on the log marginal likelihood, in nats, summed over outputs."""
        return sum(model.upper_bound for model in self.models) - self._shift

    @property
    def n_iter(self) -> int:
        """Number of iterations of the longest fit."""
        return max(len(model.loss_curve) for model in self.models)

    @property
    def loss_curve(self) -> np.ndarray:
        """Minus the bound per iteration, (n_iter,), summed over models. A model that has ended keeps its last value."""
        if self.n_iter == 0:
            return np.empty(0)
        # A model without free parameters has no iterations.
        curves = [model.loss_curve or [-model.bound] for model in self.models]
        return np.sum([np.pad(curve, (0, self.n_iter - len(curve)), "edge") for curve in curves], axis=0) + self._shift

    @property
    def _shift(self) -> float:
        # The loss of all rows in the user's units less that in internal ones.
        return sum(self.units.shift(model.posterior.n_contrasts, model.outputs) for model in self.models)

    @property
    def n_parameters(self) -> int:
        """Number of free parameters of kernels, noise, inducing points and q."""
        total = 0
        for model in self.models:
            n_outputs, p = model.sparse.prior.scale.shape
            m, of_weights = model.values["inducing_points"].shape[1], p + p * (p + 1) // 2
            of_values = m + m * (m + 1) // 2 + m * p
            if model.sparse.variant.family == "diagonal":
                of_values, of_weights = 2 * m, 2 * p
            total += model.table.size + n_outputs * of_values
            total += of_weights * (1 if model.sparse.prior.shared else n_outputs)
        return total

    @property
    def sharing(self) -> list[list[int]]:
        """The groups of outputs that share a kernel."""
        partition = []
        for model in self.models:
            separate = model.values["hyperparameters"].ndim == 2
            partition += [model.outputs[group] for group in model.sparse.groups] if separate else [model.outputs]
        return sorted(partition)

    def limits(self, name: str, output: int) -> np.ndarray:
        """Limits (n, 2) of an output's ``hyperparameters`` or ``signal``, in the user's units."""
        model = next(model for model in self.models if output in model.outputs)
        within = model.outputs.index(output)
        limits = model.table[name].value_limits()
        if name == "signal":
            # Calibration may have moved it outside.
            (low, high), signal = limits[within], model.values["signal"][within]
            return np.array([[min(low, signal), max(high, signal)]]) * self.units.target_unit[output] ** 2
        if model.table[name].start.ndim == 1:
            return limits
        return limits.reshape(*model.table[name].start.shape, 2)[model.sparse.set_of(within, model.table[name])]

    def values_in(self, units: Units, rows: Rows, kernel: Kernel, number: int) -> Values:
        """The values of a model in other internal units, as far as they are useful for another fit."""
        model, inputs = self.models[number], rows.inputs
        outputs, values, points = model.outputs, model.values, model.values["inducing_points"]
        if inputs.mean.ndim == 2 and model.sparse.kernels is None:
            inputs = inputs.at(outputs)
        if points.shape[2] != inputs.mean.shape[-1] or (inputs.mean.ndim == 2 and len(points) != len(inputs.mean)):
            return {}
        lowest, highest = (edge.reshape(-1, 1, points.shape[2]) for edge in (inputs.lowest, inputs.highest))
        outside = (points < 2.0 * lowest - highest) | (points > 2.0 * highest - lowest)
        # For a smooth function a few points may be far outside. If most are, the rows are different ones.
        if outside.any(axis=-1).mean() > 0.5:
            return {}
        ratio = (self.units.target_unit[outputs] / units.target_unit[outputs]) ** 2
        useful = {"noise": values["noise"] * ratio, "inducing_points": points}
        if self.units.prior.labels == units.prior.labels and "coef_factors" in values:
            useful["coef_factors"] = values["coef_factors"]
        if model.sparse.kernel == kernel:
            useful |= {"hyperparameters": values["hyperparameters"], "signal": values["signal"] * ratio}
        return useful
