"""Fit the exact model: where it starts, from where else it is tried, what the user should know."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ..model.exact import ExactModel, LikelihoodObjective
from ..model.parameters import ParameterTable, Values
from ..model.predictor import Predictor
from ..solvers import LBFGS
from ..solvers.base import Minimum
from ..solvers.lbfgs import Tolerance
from ..utils.linalg import NotPositiveDefiniteError
from ..utils.monitor import Monitor
from ..utils.validation import LARGEST, as_floats
from .messages import far_from_prior, interrupted, lbfgs_ended, learned_too_little
from .problem import Problem
from .search import FeaturesAlone, Fit, Rules, Start, drawn, search
from .start import centred_kernels, checked_variance, starting_table, with_signal_of_constants
from .units import Units, check_independent, may_hide_noise, noise_of_most_evidence

if TYPE_CHECKING:
    from .model import Model

# (θ -> minus the log marginal likelihood, first θ, bounds=) -> the best θ and its value, as scikit-learn's GPR asks.
Optimizer = Callable[..., tuple[np.ndarray, float]]
# On so many rows it is seen whether a user's kernel works.
_CHECKED_ROWS = 500
# Of a second opinion on the kernel of a sparse model.
_SAMPLE = 1000
# A signal that is as good as none, as a share of one that the user fixes.
_NO_SIGNAL = 1e-12


@dataclass(frozen=True)
class ExactTask:
    """An exact model of some rows, as a search needs it.

    ``scatter`` is the variance (o,) of what the features leave over. ``rng`` draws the restarts. With ``optimizer``,
    the user's takes the place of L-BFGS, and is asked in the units of ``units``.
    """

    model: ExactModel
    table: ParameterTable
    scatter: np.ndarray
    rules: Rules
    max_iter: int
    tol: float
    rng: np.random.RandomState
    monitor: Monitor
    n_restarts: int = 0
    optimizer: Optimizer | None = None
    units: Units | None = None

    # Of sparse models only: samples of the rows, inducing points, and the fit before.
    interpolates: ClassVar[bool] = True
    samples: ClassVar[tuple[int, ...]] = ()
    warm: ClassVar[None] = None
    placed: ClassVar[bool] = False
    place: ClassVar[None] = None

    @property
    def mean_precision(self) -> float:
        """Of the rows, where a row with the noise variance itself has 1."""
        precision = self.model.rows.precision
        return 1.0 if precision is None else float(precision.sum() / self.model.rows.total)

    @cached_property
    def alone(self) -> FeaturesAlone:
        """The likelihood of the features with as little Gaussian process as the parameters allow."""
        if self.optimizer is not None or self.max_iter == 0:
            return FeaturesAlone()
        signal, hidden = self.table["signal"], may_hide_noise(self.model.prior, len(self.model.rows.inputs))
        bound, noise = self._best_with(np.where(signal.free, signal.value_limits()[:, 0], signal.start), hidden)
        most = -np.inf
        if hidden and not signal.free.all():
            # What a signal that stays costs depends on where the kernel ends.
            most, _ = self._best_with(_NO_SIGNAL * signal.start, hidden)
        return FeaturesAlone(bound, noise, most, hidden)

    def _best_with(self, signal: np.ndarray, hidden: bool) -> tuple[float, np.ndarray]:
        """The likelihood with such a signal (o,), and the noise variances (o,), perhaps hidden, with the highest."""
        rows, values = self.model.rows, self.table.values_at_start()
        least, highest = self.table["noise"].value_limits().T
        if not hidden:
            least = highest = np.clip(np.average(rows.targets**2, axis=0, weights=rows.precision), least, highest)

        def evidence(noise: np.ndarray) -> np.ndarray:
            return self.model.log_likelihoods(values | {"signal": signal, "noise": noise})

        return noise_of_most_evidence(evidence, least, highest, self.model.prior.shared)

    def restart(self) -> Values:
        """First values drawn at random."""
        return drawn(self.table, self.rules, self.rng)

    def minimise(self, start: Start) -> Fit:
        """Run L-BFGS, or the user's optimizer, on minus the log marginal likelihood per row."""
        table = self.table.started_at(start.values)
        n, spent = self.model.rows.total, len(start.loss_curve)
        loss, monitor = LikelihoodObjective(self.model, table), self.monitor.seen_as(spent, n)
        if self.optimizer is not None and table.size > 0:
            return self._minimised_by(self.optimizer, table, loss, monitor)
        most, tolerance = start.until - spent, Tolerance(self.tol / n)
        minimum = LBFGS().minimise(loss, table.start(), table.limits(), most, tolerance, monitor)
        return Fit(
            table.values(minimum.x),
            -n * minimum.loss,
            start.loss_curve + [n * value for value in minimum.loss_curve],
            minimum.converged,
            lbfgs_ended(minimum, spent + minimum.n_iter, self.max_iter, self.tol, sparse=False),
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
    """What a kernel would be without inducing points: the exact model of some rows, fitted."""

    model: ExactModel
    fit: Fit
    n_parameters: int

    def missed_by(self, values: Values) -> float:
        """How much less likely the rows are under other values, in nats per row and output.

        Less half a nat for each parameter: that much a fit gains by chance.
        """
        likelihood = float(self.model.log_likelihoods(values).sum())
        nats = self.model.rows.total * self.model.rows.targets.shape[1]
        return (self.fit.bound - 0.5 * self.n_parameters - likelihood) / nats


def exact_model_of_sample(model: Model, max_iter: int, tol: float) -> Unhindered | None:
    """Fit the exact model of a sample of a model's rows, ``tol`` in nats per row and output.

    None if the kernel is fixed, or groups have kernels of their own.
    """
    if model.max_iter == 0 or not model.table["hyperparameters"].free.any() or model.sparse.kernels is not None:
        return None
    sample, prior = model.rows.sample(_SAMPLE, model.rng), model.sparse.prior
    exact = ExactModel(model.sparse.kernel, prior, np.zeros(prior.scale.shape, dtype=bool), sample)
    table, tol = model.table.without("inducing_points"), tol * sample.total * sample.targets.shape[1]
    tol = max(model.tol or 0.0, tol)
    task = ExactTask(exact, table, model.scatter, model.rules, max_iter, tol, model.rng, model.monitor.silent())
    return Unhindered(exact, search(task), table.size)


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
    problem: Problem,
    rng: np.random.RandomState,
    monitor: Monitor,
    n_restarts: int,
    tol: float,
    optimizer: Optimizer | None = None,
) -> ExactFit:
    """Maximise the log marginal likelihood of all rows."""
    units, rows, vague = problem.units, problem.units.rows(problem.source), problem.vague
    n, first, variance = len(rows), problem.spec.starts.hyperparameters.value, 1.0
    everything = rows.some(np.arange(n))
    check_independent(everything.features, vague, units.prior.shared)
    kernel, *others = kernels = centred_kernels(problem.spec.covariance, rows.inputs)
    if first is not None:
        some = np.unique(np.linspace(0, n - 1, _CHECKED_ROWS).astype(int))
        variance = checked_variance(kernel, first, everything.of(slice(0, 1)).inputs[some])
    table = starting_table(problem, rows, np.empty((1, 0, everything.inputs.shape[-1])), variance, exact=True)
    if optimizer is not None:
        # It is the user's when to go where.
        table = table.widened(("signal", "noise"))
    model = ExactModel(kernel, units.internal_prior(), vague, everything, kernels if others else None)
    task = ExactTask(
        model.with_fewer_features(),
        table,
        rows.scatter(),
        problem.rules,
        problem.max_iter,
        tol,
        rng,
        monitor.seen_as(shift=float(log_units_of_contrasts(units, model).sum())),
        n_restarts,
        optimizer,
        units,
    )
    best = search(task)
    values, changed = with_signal_of_constants(problem, rows, table, best.values)
    if changed:
        best = replace(best, values=values, bound=float(model.log_likelihoods(values).sum()))

    # What the user should know of it.
    proper = replace(model.prior, reference=np.where(vague, 0.0, model.prior.reference))
    messages = [best.message, far_from_prior(proper, rows)]
    if problem.max_iter > 0:
        each = [(rows, best.values["noise"])]
        if others:
            each = [(rows.outputs(slice(o, o + 1)), best.values["noise"][[o]]) for o in range(len(kernels))]
        told = [
            learned_too_little(own, best.values | {"noise": noise}, table, own_rows, sparse=False)
            for own, (own_rows, noise) in zip(kernels, each, strict=True)
        ]
        messages.append(max(told))
    message = " ".join(part for part in messages if part)
    if monitor.stopped:
        message = interrupted(best.n_iter, monitor.max_time if monitor.out_of_time else None)
    return ExactFit(units, model, table, best, (message,) if message else ())


def log_units_of_contrasts(units: Units, model: ExactModel) -> np.ndarray:
    """From internal units to the user's, for each output's loss (o,) of all rows: each contrast has a unit."""
    n_vague = model.vague.sum(axis=1)
    if model.prior.shared:
        n_vague[1:] = 0
    return (model.rows.total - n_vague) * np.log(units.target_unit)


# (output, numbers) -> a value, and its gradient in the logarithms of these.
OfKernel = Callable[[int, np.ndarray], tuple[float, np.ndarray]]


def value_at(
    theta: ArrayLike, eval_gradient: bool, order: np.ndarray, fitted: Sequence[np.ndarray], of_kernel: OfKernel
) -> Any:
    """The sum over outputs of what each has at its theta and, if asked for, its gradient, of the shape of theta.

    It is -inf, as in scikit-learn's GaussianProcessRegressor, for a kernel whose matrix cannot be factorised.

    Parameters
    ----------
    theta : array-like of shape (n_theta,) or, for several outputs, (o, n_theta)
    eval_gradient : bool
    order : ndarray of shape (n_theta,)
        Where in the numbers each entry of theta is: `KernelSpec.order`.
    fitted : sequence of ndarray
        Of each output the numbers (k̃'s hyperparameters, s², perhaps σ²), in the user's units: what theta does not have
        stays as it is there.
    of_kernel : callable
        In the user's units.

    Raises
    ------
    ValueError
        If theta has another shape or is out of range.
    """
    n_outputs, thetas = len(fitted), as_floats(theta, "theta")
    shape = (len(order),) if n_outputs == 1 else (n_outputs, len(order))
    if thetas.shape != shape:
        each = "" if n_outputs == 1 else " of each of the kernels"
        raise ValueError(f"theta must be of shape {shape}, as kernel_.theta{each}; got {thetas.shape}.")
    if not (np.abs(thetas) <= np.log(LARGEST)).all():
        raise ValueError(f"theta must be logarithms of numbers from {1 / LARGEST:g} to {LARGEST:g}; got {theta!r}.")
    total, gradient = 0.0, np.zeros((n_outputs, len(order)))
    for o, own in enumerate(fitted):
        numbers = own.copy()
        numbers[order] = np.exp(thetas.reshape(gradient.shape)[o])
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                value, bars = of_kernel(o, numbers)
        except NotPositiveDefiniteError:
            return (-np.inf, np.zeros(shape)) if eval_gradient else -np.inf
        total += value
        gradient[o] = bars[order]
    return (total, gradient.reshape(shape)) if eval_gradient else total
