"""`fit_exact`: maximise the likelihood of the exact model, and return the result as `ExactFit`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ..data.blocks import Blocks
from ..data.rows import LocalSource, RawRows, Rows, Source
from ..model.exact import ExactModel, LikelihoodObjective
from ..model.model import SparseModel
from ..model.parameters import ParameterTable, Values, log_prior
from ..model.predictor import CoefficientPrior, Predictor
from ..model.weights import WeightLikelihood
from ..solvers import LBFGS
from ..solvers.base import Minimum, Tolerance
from ..utils.linalg import NotPositiveDefiniteError
from ..utils.monitor import Monitor
from ..utils.validation import LARGEST, as_floats
from .messages import ended_early, far_from_prior, interrupted, learned_too_little
from .problem import Problem
from .rules import Rules
from .search import FeaturesAlone, Fit, Start, drawn, search
from .start import centred_kernels, checked_variance, starting_table, with_signal_of_constants
from .units import Units, check_independent, may_hide_noise, noise_of_most_evidence

# Takes θ -> minus the log marginal likelihood, the first θ and bounds=. Returns the best θ and its value, as for GPR.
Optimizer = Callable[..., tuple[np.ndarray, float]]
# A user's kernel is checked on so many rows.
_CHECKED_ROWS = 500
# A negligible signal, as a share of one that the user fixes.
_NO_SIGNAL = 1e-12


@dataclass(frozen=True)
class ExactTask:
    """An exact model of some rows, with all that `search` needs."""

    model: ExactModel
    table: ParameterTable
    # (o,): variance of the residuals.
    scatter: np.ndarray
    rules: Rules
    max_iter: int
    tol: float
    # For restarts.
    rng: np.random.RandomState
    monitor: Monitor
    n_restarts: int = 0
    # The user's optimizer instead of L-BFGS. It works in the units of ``units``.
    optimizer: Optimizer | None = None
    units: Units | None = None

    # First values from another fit.
    warm: Values | None = None

    # Only sparse models have samples and inducing points.
    interpolates: ClassVar[bool] = True
    samples: ClassVar[tuple[int, ...]] = ()
    lengthscale_mask: ClassVar[bool] = False
    placed: ClassVar[bool] = True
    place: ClassVar[None] = None

    @property
    def mean_precision(self) -> float:
        """Mean precision of the rows, in units of 1/σ²."""
        precision = self.model.rows.precision
        return 1.0 if precision is None else float(precision.sum() / self.model.rows.total)

    @cached_property
    def alone(self) -> FeaturesAlone:
        """The likelihood of the features with as little Gaussian process as the limits allow."""
        if self.optimizer is not None or self.max_iter == 0:
            return FeaturesAlone()
        signal, hidden = self.table["signal"], may_hide_noise(self.model.prior, len(self.model.rows.inputs))
        bound, noise = self._best_with(np.where(signal.free, signal.value_limits()[:, 0], signal.start), hidden)
        most = -np.inf
        if hidden and not signal.free.all():
            # The cost of a fixed signal depends on the end of the kernel.
            most, _ = self._best_with(_NO_SIGNAL * signal.start, hidden)
        return FeaturesAlone(bound, noise, most, hidden)

    def _best_with(self, signal: np.ndarray, hidden: bool) -> tuple[float, np.ndarray]:
        """The highest likelihood for a signal (o,), and its noise (o,), searched over all decades if ``hidden``."""
        rows, values = self.model.rows, self.table.values_at_start()
        least, highest = self.table["noise"].value_limits().T
        if not hidden:
            least = highest = np.clip(np.average(rows.targets**2, axis=0, weights=rows.precision), least, highest)

        def evidence(noise: np.ndarray) -> np.ndarray:
            return self.model.log_likelihoods(values | {"signal": signal, "noise": noise})

        return noise_of_most_evidence(evidence, least, highest, self.model.prior.shared)

    def restart(self) -> Values:
        """Random first values."""
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
            ended_early("LBFGS", minimum, spent + minimum.n_iter, self.max_iter, self.tol, sparse=False),
        )

    def _minimised_by(
        self,
        optimizer: Optimizer,
        table: ParameterTable,
        loss: Callable[[np.ndarray], tuple[float, np.ndarray]],
        monitor: Monitor,
    ) -> Fit:
        """Run the user's optimizer on minus the log marginal likelihood, in logarithms of the user's units."""
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
class ExactFit:
    """The fitted exact model of all outputs."""

    units: Units
    model: ExactModel
    # The limits and the start of the parameters.
    table: ParameterTable
    # In internal units.
    fit: Fit
    # For the user.
    messages: tuple[str, ...]
    # Whether f is orthogonal to the features (see `model.bounds.Group.leaks`).
    orthogonal: bool = False

    def predictor(self) -> Predictor:
        """The predictor of all outputs, in the user's units."""
        if self.orthogonal:
            sparse, values, blocks = self._sparse_twin()
            found = sparse.at_optimum(values, sparse.statistics(values, blocks), blocks=blocks)
        else:
            found = self.model.predictor(self.fit.values)
        return self.units.predictor([found], [list(range(len(self.units.target_unit)))])

    # --- other features of the same rows (see `fitting.theta`) --------------------------------------------------------

    def moved(self, source: Source, prior: CoefficientPrior) -> ExactFit:
        """The same kernel and noise with other features, and a prior with learned scales for these."""
        units = self._with_prior(prior)
        rows = units.rows(source)
        vague = np.zeros(prior.scale.shape, dtype=bool)
        vague[:, : self.model.vague.shape[1]] = self.model.vague
        model = replace(self.model, prior=units.internal_prior(), vague=vague, rows=rows.some(np.arange(len(rows))))
        values = self.fit.values
        bound = float(model.log_likelihoods(values).sum()) + log_prior(values)
        return replace(self, units=units, model=model, fit=replace(self.fit, bound=bound))

    def weight_likelihoods(self, source: Source, prior: CoefficientPrior) -> list[WeightLikelihood]:
        """The likelihood of the weights of each output, for other features, in the user's units."""
        moved = self.moved(source, prior)
        if self.orthogonal:
            sparse, values, blocks = moved._sparse_twin()
            each = sparse.weight_likelihoods(values, sparse.statistics(values, blocks))
        else:
            each = moved.model.weight_likelihoods(moved.fit.values)
        return [own.in_units(unit) for own, unit in zip(each, self.units.target_unit, strict=True)]

    def _with_prior(self, prior: CoefficientPrior) -> Units:
        factors = self.fit.values.get("coef_factors")
        return replace(self.units, prior=prior if factors is None else prior.at({"coef_factors": 1.0 / factors}))

    def _sparse_twin(self) -> tuple[SparseModel, Values, Blocks]:
        """The sparse model whose inducing points are the rows, its values, and its rows."""
        model, o = self.model, len(self.units.target_unit)
        groups: tuple[slice, ...] = (slice(0, o),)
        kernels = model.kernels
        if kernels is not None or model.rows.features.ndim == 3:
            # Outputs with rows of their own have a set of points each.
            groups, kernels = tuple(slice(i, i + 1) for i in range(o)), kernels or (model.kernel,) * o
        sparse = SparseModel(
            model.kernel, model.prior, "full", groups, complete=True, kernels=kernels, orthogonal=self.orthogonal
        )
        points = np.array([model.rows.of(group).inputs for group in groups])
        rows = Rows(LocalSource.holding(model.rows), _as_it_is)
        values = self.fit.values | {"inducing_points": points}
        return sparse, values, sparse.blocks(rows, points.shape[1])

    @property
    def lower_bound(self) -> float:
        """Log marginal likelihood, in nats, summed over outputs."""
        return self.log_marginal_likelihood

    @property
    def prior(self) -> CoefficientPrior:
        """The prior of the weights in the user's units, with the learned scales."""
        return self.units.prior.at(self.fit.values)

    @property
    def log_marginal_likelihood(self) -> float:
        """Log marginal likelihood, in nats, summed over outputs."""
        return self.fit.bound - log_prior(self.fit.values) - self._shift

    def log_likelihood_at(self, output: int, numbers: np.ndarray) -> tuple[float, np.ndarray]:
        """Log likelihood of an output at other numbers, and its gradient in their logarithms.

        ``numbers`` (n_hyper + 2,) are the hyperparameters of k̃, s² and σ², in the user's units. So is the value, in
        nats.
        """
        own, model = slice(output, output + 1), self.model
        kernel = model.kernel if model.kernels is None else model.kernels[output]
        factors = {name: value for name, value in self.fit.values.items() if name == "coef_factors"}
        prior = model.prior.at(factors).outputs(own)
        model = ExactModel(kernel, prior, model.vague[own], model.rows.of(own))
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
    previous: ExactFit | None = None,
) -> ExactFit:
    """Maximise the log marginal likelihood of all rows of a problem, from the end of another fit if it is given."""
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
        # The user's optimizer gets the widest limits at once.
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
        None if previous is None else table.started_at(_values_in(units, previous)).values_at_start(),
    )
    best = search(task)
    values, changed = with_signal_of_constants(problem, rows, table, best.values)
    if changed:
        best = replace(best, values=values, bound=float(model.log_likelihoods(values).sum()) + log_prior(values))

    # Messages for the user.
    learned = model.prior.at(best.values)
    proper = replace(learned, reference=np.where(vague, 0.0, learned.reference))
    messages = [best.message, far_from_prior(proper, rows, problem.weight_names)]
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
    return ExactFit(units, model, table, best, (message,) if message else (), problem.orthogonal)


def _as_it_is(raw: RawRows) -> RawRows:
    return raw


def _values_in(units: Units, fitted: ExactFit) -> Values:
    """The values of a fit in other internal units."""
    ratio = (fitted.units.target_unit / units.target_unit) ** 2
    return {name: value * ratio if name in ("signal", "noise") else value for name, value in fitted.fit.values.items()}


def log_units_of_contrasts(units: Units, model: ExactModel) -> np.ndarray:
    """The difference of each output's loss (o,) of all rows between the user's and internal units."""
    # A vague weight uses up one row: the likelihood is that of n - n_vague contrasts, each with a unit.
    n_vague = model.vague.sum(axis=1)
    if model.prior.shared:
        n_vague[1:] = 0
    return (model.rows.total - n_vague) * np.log(units.target_unit)


# Maps (output, numbers) to a value, and its gradient in the logarithms of the numbers.
OfKernel = Callable[[int, np.ndarray], tuple[float, np.ndarray]]


def value_at(
    theta: ArrayLike, eval_gradient: bool, order: np.ndarray, fitted: Sequence[np.ndarray], of_kernel: OfKernel
) -> Any:
    """The sum over outputs of a function of kernels at theta and, optionally, its gradient, of the shape of theta.

    ``theta`` is (n_theta,) or, for several outputs, (o, n_theta). ``order`` (n_theta,) is the position of each entry in
    the numbers (`KernelSpec.order`). ``fitted`` has these numbers of each output (k̃'s hyperparameters, s², perhaps σ²)
    in the user's units: numbers that are not in theta stay. The value is -inf, as in scikit-learn's
    GaussianProcessRegressor, if the kernel matrix cannot be factorised. Raises a ValueError if theta has another shape
    or is out of range.
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
