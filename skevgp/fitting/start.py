"""Starts: first values and limits of the parameters, checks of the rows before a fit, and predictions without a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..data.rows import Moments, Rows
from ..kernels.base import Covariance
from ..kernels.parse import KernelSpec, Start
from ..model.parameters import Parameter, ParameterTable, Values
from ..model.predictor import CoefficientPrior, Predictor, PredictorGroup
from ..model.statistics import Kernel, Whitening
from ..utils.linalg import NotPositiveDefiniteError, jittered_cholesky
from .problem import Problem
from .rules import LOWEST_NOISE

# Limits of the factors of the standard deviations of groups of weights.
_FACTOR_LIMITS = 1e-4, 1e4


def centred_kernels(covariance: Covariance, inputs: Moments) -> tuple[Covariance, ...]:
    """The kernel with the centre of its inputs. One for each output that has its own inputs."""
    return tuple(covariance.centred(centre) for centre in np.atleast_2d(inputs.centre))


def checked_variance(kernel: Kernel, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> float:
    """The mean of k̃(x, x) over the first inducing points (m, d), at the user's hyperparameters (n_hyper,).

    Raises a ValueError if k̃(X_m, X_m) is not finite, not symmetric, 0 or not positive semi-definite, if its diagonal
    is not k̃(x, x), or if it has no gradient where x = x'.
    """
    at = kernel.at(hyperparameters, inducing_points)
    K = at.matrix()
    if not np.isfinite(K).all():
        raise ValueError("kernel: k(X, X) is not finite at the start of its hyperparameters.")
    variance = float(np.mean(np.diagonal(K)))
    if np.abs(K - K.T).max() > 1e-8 * np.abs(K).max():
        raise ValueError("kernel: k(X, X) must be symmetric.")
    try:
        if not np.diagonal(K).min() >= 0.0 < variance:
            raise NotPositiveDefiniteError
        jittered_cholesky(K)
    except NotPositiveDefiniteError:
        raise ValueError(
            "kernel: k(X, X) must be positive semi-definite and not 0 at the start of its hyperparameters. "
            "ExpSineSquared is positive semi-definite for a single column only."
        ) from None
    difference = np.abs(at.diagonal(kernel.prepare(inducing_points)) - np.diagonal(K)).max()
    if not difference <= 1e-6 * np.diagonal(K).max():
        raise ValueError("kernel: its function for the diagonal must return the diagonal of k(X, X).")
    if not all(np.isfinite(gradient).all() for gradient in at.finish_pullback(at.start_pullback(), np.eye(len(K)))):
        raise ValueError(
            "kernel: its gradient is not finite where x = x'. If it depends on a distance, add a small number to the "
            "squared distance: anp.sqrt(squares + 1e-12)."
        )
    return variance


def starting_table(
    problem: Problem,
    rows: Rows,
    inducing_points: np.ndarray,
    mean_variance: np.ndarray | float = 1.0,
    n_kernels: int | None = None,
    exact: bool = False,
) -> ParameterTable:
    """The parameters of a model of some outputs: hyperparameters of k̃, s², σ² (in squared target units) and X_m.

    ``rows`` are those of the outputs. Inducing points are (g, m, d). ``mean_variance`` is the mean of k̃(x, x) at the
    start, (o,) or of all. ``n_kernels`` is the number of kernels if groups of outputs have one each. ``exact`` allows
    the lower noise of the exact model.
    """
    units, starts, rules = problem.units, problem.spec.starts, problem.rules
    if exact and rules.lowest_noise_exact is not None:
        rules = replace(rules, lowest_noise=rules.lowest_noise_exact)
    inputs, columns = rows.inputs, rows.columns
    precision, scatter = rows.mean_precision, rows.scatter()
    target_unit, constant, rounding = units.target_unit[columns], units.constant[columns], units.rounding[columns]
    # Scatter is in units of σ². Limits in units of the variance of y are multiplied by the mean precision of the rows.
    o, scale = np.ones(len(target_unit)), inputs.scale
    # Outputs may have their own columns, and groups of outputs their own kernels.
    typical = np.sqrt(np.mean(scale**2, axis=0)) if scale.ndim == 2 and n_kernels is None else scale
    if problem.spec.covariance.n_hyperparameters <= 1:
        typical = np.sqrt(np.mean(typical**2, axis=-1, keepdims=True))
    root_d = np.sqrt(scale.shape[-1])
    lower, upper = rules.lengthscale_limits
    default = rules.lengthscale * root_d * typical
    if starts.hyperparameters.value is not None:
        default = starts.hyperparameters.value
    if n_kernels is not None:
        default = np.broadcast_to(default, (n_kernels, default.shape[-1]))
    signal, highest, centre = o / mean_variance, rules.highest_noise * precision * o, inputs.centre
    lowest_noise = np.maximum(rules.lowest_noise * scatter, np.maximum(LOWEST_NOISE, rounding) * precision)
    still = bool(np.all(constant))
    shape = (1 if units.prior.shared else len(o)), units.prior.n_groups
    factors = [Parameter("coef_factors", np.ones(shape), "log", *_FACTOR_LIMITS)] if units.prior.labels else []
    return ParameterTable(
        [
            parameter_of(
                starts.hyperparameters, "hyperparameters", default, lower * typical, upper * root_d * typical, 1.0
            ),
            parameter_of(
                starts.signal,
                "signal",
                # A constant must not dominate the kernel that it shares with other outputs.
                np.where(np.logical_and(constant, not still), rules.signal_limits[0], 1.0) * signal,
                rules.signal_limits[0] * signal,
                rules.signal_limits[1] * signal,
                target_unit**2,
                None if rules.widest_signal is None else rules.widest_signal * signal,
                still,
            ),
            parameter_of(
                starts.noise,
                "noise",
                np.where(constant, lowest_noise, rules.first_noise * scatter),
                lowest_noise,
                highest,
                target_unit**2,
                np.maximum(highest, units.target_scatter[columns] * precision),
                still and starts.noise.value is None,
            ),
            *factors,
            Parameter(
                "inducing_points",
                inducing_points,
                unit=scale if scale.ndim == 1 else scale[:, np.newaxis],
                origin=centre if centre.ndim == 1 else centre[:, np.newaxis],
            ),
        ]
    )


def with_signal_of_constants(
    problem: Problem, rows: Rows, table: ParameterTable, values: Values
) -> tuple[Values, bool]:
    """Values in which constants among other outputs have the signal that they would have alone, and whether any has.

    During the fit they have almost no signal, so that they do not dominate the kernel that they share.
    """
    still, start = rows.is_constant(), table["signal"].start
    if problem.spec.starts.signal.value is not None or not still.any() or still.all():
        return values, False
    alone = start / problem.rules.signal_limits[0]
    return values | {"signal": np.where(still, alone, values["signal"])}, True


def parameter_of(
    start: Start,
    name: str,
    default: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    unit: np.ndarray | float,
    widest: np.ndarray | None = None,
    stays: bool = False,
) -> Parameter:
    """A row of the table, in internal units.

    ``start`` holds the user's value and bounds, in units of ``unit``. Without them, ``default`` is the start, and
    ``lower`` and ``upper`` are the limits. ``widest`` is the upper limit of a fit that continues another one from
    ``upper``. ``stays`` fixes the parameter.
    """
    first = default if start.value is None else np.broadcast_to(start.value / unit, default.shape)
    if start.bounds is not None:
        lower, upper, widest = start.bounds[:, 0] / unit, start.bounds[:, 1] / unit, None
    return Parameter(name, first, "log", lower, upper, fixed=True if stays else start.fixed, widest=widest)


def prior_predictor(rows: Rows, spec: KernelSpec, prior: CoefficientPrior) -> Predictor:
    """The prior of y as a predictor without inducing points.

    ``spec`` must have all of its starts (`KernelSpec.as_given`). If it has no noise, there is none. ``prior`` is in the
    user's units.
    """
    o, p = prior.scale.shape
    starts, kernels = spec.starts, centred_kernels(spec.covariance, rows.inputs)
    assert starts.hyperparameters.value is not None
    assert starts.signal.value is not None
    hyperparameters, signal = starts.hyperparameters.value, np.repeat(starts.signal.value, o)
    noise = np.zeros(o) if starts.noise.value is None else np.repeat(starts.noise.value, o)
    nowhere, groups = np.empty((0, rows.inputs.mean.shape[-1])), []
    for index in range(o):
        outputs, kernel = slice(index, index + 1), kernels[index % len(kernels)]
        checked_variance(kernel, hyperparameters, rows.some(np.zeros(1, dtype=int)).of(outputs).inputs)
        groups.append(
            PredictorGroup.of(
                outputs=outputs,
                kernel=kernel,
                hyperparameters=hyperparameters,
                points=nowhere,
                whitening=Whitening.of(kernel, hyperparameters, nowhere),
                signal=signal[outputs],
                prior=prior.outputs(outputs),
                mean=[np.zeros(p)],
                root=[np.eye(p) if p else np.zeros((1, 0))],
            )
        )
    return Predictor(tuple(groups), noise, prior.mean, np.zeros(o), prior.shared)
