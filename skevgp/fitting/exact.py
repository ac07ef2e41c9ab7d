"""Fit the exact model: where it starts, from where else it is tried, what the user should know."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..data.internal import Rows
from ..data.source import RawRows
from ..kernels.parse import KernelSpec
from ..model.exact import ExactModel, LikelihoodObjective
from ..model.parameters import ParameterTable, Values
from ..model.predictor import CoefficientPrior, Predictor
from ..model.statistics import Kernel
from ..solvers.lbfgs import lbfgs
from ..solvers.minimum import Minimum
from ..utils.linalg import NotPositiveDefiniteError
from ..utils.monitor import Monitor
from .advice import far_from_prior, how_it_ended, interrupted, learned_too_little
from .rules import Rules
from .start import centred_kernels, checked_variance, starting_table
from .strategy import Attempt, Fit, Strategy, drawn, search
from .units import Units, check_independent, may_hide_noise, noise_of_most_evidence

# (θ -> minus the log marginal likelihood, first θ, bounds=) -> the best θ and its value, as scikit-learn's GPR asks.
Optimizer = Callable[..., tuple[np.ndarray, float]]
# On so many rows it is seen whether a user's kernel works.
_CHECKED_ROWS = 500
# A signal that is as good as none, as a share of one that the user fixes.
_NO_SIGNAL = 1e-12


@dataclass(frozen=True)
class ExactOptions:
    """How to optimise.

    Attributes
    ----------
    rules : Rules
    max_iter : int
    tol : float
        In nats.
    n_restarts : int
    optimizer : callable, optional
        The user's, in place of L-BFGS.
    """

    rules: Rules
    max_iter: int
    tol: float
    n_restarts: int
    optimizer: Optimizer | None = None


@dataclass(frozen=True)
class ExactTask:
    """An exact model to be fitted: what all attempts have in common.

    Attributes
    ----------
    model : ExactModel
    table : ParameterTable
    scatter : ndarray of shape (o,)
        Variance of what the features leave over.
    options : ExactOptions
    rng : RandomState
        Draws the restarts.
    monitor : Monitor
    units : Units, optional
        Those in which a user's optimizer is asked.
    """

    model: ExactModel
    table: ParameterTable
    scatter: np.ndarray
    options: ExactOptions
    rng: np.random.RandomState
    monitor: Monitor
    units: Units | None = None

    @property
    def strategy(self) -> Strategy:
        """From where the model is fitted."""
        precision, signal = self.model.rows.precision, self.table["signal"]
        alone, noise_alone, most_alone, hidden = -np.inf, None, -np.inf, False
        if self.options.optimizer is None and self.options.max_iter > 0:
            hidden = may_hide_noise(self.model.prior, len(self.model.rows.inputs))
            little = np.where(signal.free, signal.value_limits()[:, 0], signal.start)
            alone, noise_alone = self._best_with(little, hidden)
            if hidden and not signal.free.all():
                # What a signal that stays costs depends on where the kernel ends.
                most_alone, _ = self._best_with(_NO_SIGNAL * signal.start, hidden)
        return Strategy(
            self.options.rules,
            self.table,
            self.options.max_iter,
            self.options.n_restarts,
            self.scatter,
            alone=alone,
            noise_alone=noise_alone,
            most_alone=most_alone,
            noise_hidden=hidden,
            mean_precision=1.0 if precision is None else float(precision.sum() / self.model.rows.total),
            interpolates=True,
            restart=lambda: drawn(self.table, self.options.rules, self.rng),
        )

    def _best_with(self, signal: np.ndarray, hidden: bool) -> tuple[float, np.ndarray]:
        """The likelihood with such a signal (o,), and the noise variances (o,), perhaps hidden, with the highest."""
        rows, values = self.model.rows, self.table.values_at_start()
        least, highest = self.table["noise"].value_limits().T
        if not hidden:
            least = highest = np.clip(np.average(rows.targets**2, axis=0, weights=rows.precision), least, highest)

        def evidence(noise: np.ndarray) -> np.ndarray:
            return self.model.log_likelihoods(values | {"signal": signal, "noise": noise})

        return noise_of_most_evidence(evidence, least, highest, self.model.prior.shared)

    def minimise(self, attempt: Attempt) -> Fit:
        """L-BFGS on the log marginal likelihood per row."""
        table = self.table.started_at(attempt.values)
        n, spent = self.model.rows.total, len(attempt.loss_curve)
        loss = LikelihoodObjective(self.model, table)
        monitor = self.monitor.seen_as(spent, n)
        if self.options.optimizer is not None and table.size > 0:
            return self._minimised_by(self.options.optimizer, table, loss, monitor)
        minimum = lbfgs(loss, table.start(), table.limits(), attempt.until - spent, self.options.tol / n, monitor)
        return Fit(
            table.values(minimum.x),
            -n * minimum.loss,
            attempt.loss_curve + [n * value for value in minimum.loss_curve],
            minimum.converged,
            how_it_ended(minimum, spent + minimum.n_iter, self.options.max_iter, self.options.tol, sparse=False),
        )

    def _minimised_by(
        self,
        optimizer: Optimizer,
        table: ParameterTable,
        loss: Callable[[np.ndarray], tuple[float, np.ndarray]],
        monitor: Monitor,
    ) -> Fit:
        """The user's optimizer on minus the log marginal likelihood, in logarithms of the user's units."""
        n, (lower, upper) = self.model.rows.total, table.limits()
        assert self.units is not None
        log_variance, shift = 2.0 * np.log(self.units.target_unit), log_units_of_contrasts(self.units, self.model).sum()
        in_users_units = table.flat(
            {
                own.name: log_variance if own.name in ("signal", "noise") else np.zeros(own.start.shape)
                for own in table.parameters
            }
        )
        best, curve = Minimum(table.start(), np.inf), list[float]()

        def objective(theta: np.ndarray, eval_gradient: bool = True) -> Any:
            theta = np.atleast_1d(np.asarray(theta, dtype=float))
            if theta.shape != in_users_units.shape:
                raise ValueError(f"theta must be {len(in_users_units)} numbers; got an array of shape {theta.shape}.")
            flat = theta - in_users_units
            try:
                value, gradient = loss(flat)
            except NotPositiveDefiniteError:
                value, gradient = np.inf, np.zeros(len(flat))
            if value <= best.loss:
                best.x, best.loss = flat, value
            curve.append(n * value)
            monitor.iteration(len(curve), value)
            value = n * value + float(shift)
            return (value, n * gradient) if eval_gradient else value

        with monitor.keeping_the_best():
            bounds = np.column_stack([lower, upper]) + in_users_units[:, np.newaxis]
            found = optimizer(objective, table.start() + in_users_units, bounds=bounds)
            try:
                theta, _ = found
                theta = np.asarray(theta, dtype=float)
            except (TypeError, ValueError):
                theta = np.empty(0)
            if theta.shape != lower.shape or not np.isfinite(theta).all():
                raise ValueError(f"optimizer must return {len(lower)} finite numbers and their value; got {found!r}.")
            best.x = np.clip(theta - in_users_units, lower, upper)
            best.loss = loss(best.x)[0]
        return Fit(table.values(best.x), -n * best.loss, curve)


@dataclass(frozen=True)
class Unhindered:
    """What a kernel would be without inducing points: the exact model of some rows, fitted.

    Attributes
    ----------
    model : ExactModel
    fit : Fit
    n_parameters : int
        That were fitted.
    """

    model: ExactModel
    fit: Fit
    n_parameters: int

    @classmethod
    def of(
        cls,
        kernel: Kernel,
        prior: CoefficientPrior,
        rows: RawRows,
        table: ParameterTable,
        scatter: np.ndarray,
        options: ExactOptions,
        rng: np.random.RandomState,
        monitor: Monitor,
    ) -> Unhindered:
        """Fit it; arguments as of `ExactModel` and `ExactTask`."""
        model = ExactModel(kernel, prior, np.zeros(prior.scale.shape, dtype=bool), rows)
        return cls(model, search(ExactTask(model, table, scatter, options, rng, monitor)), table.size)

    def missed_by(self, values: Values) -> float:
        """How much less likely the rows are under other values, in nats per row and output.

        Less what the fit has gained by chance, on average half a nat for each parameter (Wilks 1938).
        """
        likelihood = float(self.model.log_likelihoods(values).sum())
        nats = self.model.rows.total * self.model.rows.targets.shape[1]
        return (self.fit.bound - 0.5 * self.n_parameters - likelihood) / nats


@dataclass(frozen=True)
class ExactFit:
    """The exact model of some outputs, fitted.

    Attributes
    ----------
    units : Units
    model : ExactModel
    table : ParameterTable
        Where it started, and its limits.
    fit : Fit
        In internal units.
    messages : tuple of str
        What the user should know of how it ended.
    """

    units: Units
    model: ExactModel
    table: ParameterTable
    fit: Fit
    messages: tuple[str, ...]

    def predictor(self) -> Predictor:
        """Of all outputs, in the user's units."""
        return self.units.predictor([self.model.predictor(self.fit.values)], [list(range(len(self.units.target_unit)))])

    @property
    def log_marginal_likelihood(self) -> float:
        """In nats, summed over outputs."""
        return self.fit.bound - self._shift

    def log_likelihood_at(self, output: int, numbers: np.ndarray) -> tuple[float, np.ndarray]:
        """Of an output under another kernel and noise, and its gradient in the logarithms of these.

        Parameters
        ----------
        output : int
        numbers : ndarray of shape (n_hyper + 2,)
            Hyperparameters of k̃, s² and σ², in the user's units.

        Returns
        -------
        value : float
            In nats, in the user's units.
        gradient : ndarray of shape (n_hyper + 2,)
        """
        own, model = slice(output, output + 1), self.model
        kernel = model.kernel if model.kernels is None else model.kernels[output]
        model = ExactModel(kernel, model.prior.outputs(own), model.vague[own], model.rows.of(own))
        *hyperparameters, signal, noise = numbers
        variance = self.units.target_unit[own] ** 2
        values = {
            "hyperparameters": np.array(hyperparameters),
            "signal": signal / variance,
            "noise": noise / variance,
        }
        value, gradient = model.log_likelihood(values)
        shift = log_units_of_contrasts(self.units, self.model)[output]
        return value - float(shift), np.concatenate([gradient[name] for name in values])

    @property
    def loss_curve(self) -> np.ndarray:
        """Minus the log marginal likelihood per iteration."""
        return np.array(self.fit.loss_curve) + self._shift

    def limits(self, name: str, output: int) -> np.ndarray:
        """Limits (n, 2) of an output's ``hyperparameters`` or ``signal``, in the user's units."""
        limits = self.table[name].value_limits()
        return limits[[output]] * self.units.target_unit[output] ** 2 if name == "signal" else limits

    @property
    def _shift(self) -> float:
        return float(log_units_of_contrasts(self.units, self.model).sum())


def fit_exact(
    units: Units,
    rows: Rows,
    spec: KernelSpec,
    vague: np.ndarray,
    options: ExactOptions,
    rng: np.random.RandomState,
    monitor: Monitor,
) -> ExactFit:
    """Maximise the log marginal likelihood.

    Parameters
    ----------
    units : Units
    rows : Rows
        In internal units.
    spec : KernelSpec
        What the user says of kernel and noise.
    vague : ndarray of shape (o, p)
        Weights with an infinite prior scale.
    options : ExactOptions
    rng : RandomState
        Draws the restarts.
    monitor : Monitor
        Told of each iteration's loss, in the user's units.

    Returns
    -------
    fitted : ExactFit

    Raises
    ------
    ValueError
        If features with vague weights depend on each other, or the kernel does not work.
    """
    n, starts = len(rows), spec.starts
    everything = rows.some(np.arange(n))
    check_independent(everything.features, vague, units.prior.shared)
    kernel, *others = kernels = centred_kernels(spec.covariance, rows.inputs)
    first, variance = starts.hyperparameters.value, 1.0
    if first is not None:
        some = np.unique(np.linspace(0, n - 1, _CHECKED_ROWS).astype(int))
        variance = checked_variance(kernel, first, everything.of(slice(0, 1)).inputs[some])
    table = starting_table(
        rows.inputs,
        np.empty((1, 0, everything.inputs.shape[-1])),
        units.target_unit,
        starts,
        rows.scatter(),
        options.rules,
        kernel.n_hyperparameters,
        variance,
        rows.mean_precision,
        target_scatter=units.target_scatter,
        rounding=0.0 if units.rounding is None else units.rounding,
        constant=False if units.constant is None else units.constant,
    )
    if options.optimizer is not None:
        # It is the user's when to go where.
        table = table.widened(("signal", "noise"))
    model = ExactModel(kernel, units.internal_prior(), vague, everything, kernels if others else None)
    monitor = monitor.seen_as(shift=float(log_units_of_contrasts(units, model).sum()))
    best = search(ExactTask(model.with_fewer_features(), table, rows.scatter(), options, rng, monitor, units))
    proper = replace(model.prior, reference=np.where(vague, 0.0, model.prior.reference))
    advice = [best.message, far_from_prior(proper, rows)]
    if options.max_iter > 0:
        each = [(rows, best.values["noise"])]
        if others:
            each = [(rows.within(slice(o, o + 1)), best.values["noise"][[o]]) for o in range(len(kernels))]
        told = [
            learned_too_little(own, best.values | {"noise": noise}, table, own_rows, sparse=False)
            for own, (own_rows, noise) in zip(kernels, each, strict=True)
        ]
        advice.append(max(told))
    message = " ".join(part for part in advice if part)
    if monitor.stopped:
        message = interrupted(best.n_iter, monitor.max_time if monitor.out_of_time else None)
    return ExactFit(units, model, table, best, (message,) if message else ())


def log_units_of_contrasts(units: Units, model: ExactModel) -> np.ndarray:
    """From internal units to the user's, for each output's loss (o,) of all rows: each contrast has a unit."""
    n_vague = model.vague.sum(axis=1)
    if model.prior.shared:
        n_vague[1:] = 0
    return (model.rows.total - n_vague) * np.log(units.target_unit)
