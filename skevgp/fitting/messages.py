"""Messages to the user about the end of a fit. Each function returns an empty text if there is nothing to say."""

from __future__ import annotations

import numpy as np

from ..data.rows import Rows
from ..model.parameters import ParameterTable, Values
from ..model.predictor import CoefficientPrior
from ..model.statistics import Kernel
from ..solvers.base import Minimum
from .start import alike_neighbours, neighbours

# Nothing was learned if the noise explains more than this share.
_NOTHING_LEARNED = 0.99
# A kernel is white noise if no more than this share of so many pairs of neighbours have at least this correlation.
# (`alike_neighbours` needs more similar pairs than that.)
_PAIRS, _WHITE_SHARE, _WHITE = 200, 0.1, 0.01
# y is far from its prior mean by so many times its standard deviation, a weight by so many prior standard deviations.
_FAR, _FAR_WEIGHT = 1e4, 100.0

DEPENDENT_ROWS = (
    "Rows near each other are alike: left out in blocks, they are predicted worse than at random, and std is too "
    "small for new trajectories. Say in fit(X, y, groups=...) which rows belong together, such as the number of each "
    "row's trajectory. (Where rows are sorted but independent, shuffle them, or ignore this warning.)"
)


def ended_early(
    solver: str, minimum: Minimum, n_iter: int, max_iter: int, tol: float | None, sparse: bool = True
) -> str:
    """Why a solver ended before it converged, after ``n_iter`` iterations in all.

    ``tol`` is None if the solver chose it. ``sparse`` says whether there are inducing points.
    """
    if minimum.converged:
        return ""
    if n_iter < max_iter:
        return (
            f"{solver} stopped after {n_iter} iterations: rounding errors keep hiding the way up, as in data without "
            f"noise. The best parameters are kept; a larger tol{', fewer inducing points' if sparse else ''} or a "
            "WhiteKernel with a lower bound on the noise end sooner."
        )
    sooner = 'a number for tol (now "auto")' if tol is None else f"a larger tol (now {tol})"
    return (
        f"The {'bound' if sparse else 'likelihood'} was still rising after max_iter={max_iter} iterations. Raise "
        f"max_iter, or stop earlier on purpose with {sooner}."
    )


def mini_batches_ended(solver: str, minimum: Minimum, fell: bool, learning_rate: float, batch_size: int) -> str:
    """Why a solver on mini-batches failed. ``fell`` says whether its bound ended below the first one."""
    if not minimum.converged:
        return (
            f"{solver} diverged after {minimum.n_iter} steps; the best parameters so far are kept. Lower learning_rate "
            f"(now {learning_rate}), or raise batch_size (now {batch_size})."
        )
    if fell:
        return (
            f"{solver} ended with a bound below the first after all its {minimum.n_iter} steps; the best parameters "
            "are kept. Raise max_iter (steps become small only towards the end) or batch_size, or lower "
            f"learning_rate (now {learning_rate})."
        )
    return ""


def interrupted(n_iter: int, max_time: float | None = None) -> str:
    """Message that Ctrl-C, or the end of ``max_time``, ended the fit."""
    how = "was interrupted" if max_time is None else f"ended since max_time={max_time:g} seconds were over,"
    return f"The fit {how} after {n_iter} iterations; the best parameters so far are kept."


def signal_gone(gone: int, n_outputs: int) -> str:
    """Message that the Gaussian process of ``gone`` outputs does not predict held-out groups."""
    if not gone:
        return ""
    return (
        f"What the Gaussian process learned of {gone} of {n_outputs} outputs fitted together does not hold for groups "
        "that were left out: these are predicted no better than without it, and std says so. More groups, other "
        "columns (kernel_map) or features may tell what groups have in common."
    )


def far_from_prior(prior: CoefficientPrior, rows: Rows) -> str:
    """Message that y, or a weight, is too far from its prior mean."""
    # Residuals that are rounding errors of y are not of size one.
    far = rows.residuals.mean[rows.columns] ** 2
    if (rows.scatter() / rows.mean_precision < _FAR**-2 * np.minimum(far, 1.0)).any():
        return (
            f"y is more than {_FAR:g} times its scatter away from its prior mean of 0: explaining that leaves the "
            "kernel little accuracy for the rest. Set normalize_y=True, or give the feature_map an intercept."
        )
    # Weights with a learned scale are as far as their scale allows.
    fixed = True if prior.groups is None else prior.groups < 0
    if ((np.abs(prior.reference) > _FAR_WEIGHT) & fixed).any():
        return (
            f"Weights of features are more than {_FAR_WEIGHT:g} prior standard deviations away from their prior mean: "
            "raise the scale of coef_prior or, if it is an intercept's, set normalize_y=True."
        )
    return ""


def learned_too_little(kernel: Kernel, values: Values, table: ParameterTable, rows: Rows, sparse: bool = True) -> str:
    """Message that the noise, or a white kernel, explains what the Gaussian process could have learned."""
    told = ""
    if table["noise"].free.any():
        told = nothing_learned(values["noise"], rows, sparse)
    if not told and table["hyperparameters"].free.any():
        told = white_kernel(kernel, values["hyperparameters"], rows)
    return told


def nothing_learned(noise: np.ndarray, rows: Rows, sparse: bool = True) -> str:
    """Message that noise variances (o,) explain all of targets whose neighbouring rows are alike."""
    nothing = noise > _NOTHING_LEARNED * rows.scatter()
    if nothing.any():
        # If residuals look like noise, noise is the right answer.
        nothing &= alike_neighbours(rows)
    if not nothing.any():
        return ""
    cause = ""
    if len(noise) > nothing.sum():
        cause = "If they share its kernel's shape with outputs of which it learned, that may be why: " + (
            'sharing="none" gives each its own. Or raise '
            if sparse
            else "MultiOutputRegressor(EGPRegressor(...)) fits each by itself. Or raise "
        )
    return (
        f"The noise explains everything that the features leave over of {nothing.sum()} of {len(nothing)} outputs "
        "fitted together, though neighbouring rows are alike: from no start did the Gaussian process learn any of it. "
        f"{cause or 'Raise '}{'n_inducing, or n_restarts of the solver' if sparse else 'n_restarts'}, let kernel or "
        "noise start elsewhere, or look at the scales of the kernel's columns."
    )


def white_kernel(kernel: Kernel, hyperparameters: np.ndarray, rows: Rows) -> str:
    """Message that the kernel k̃ itself became white noise, though neighbouring rows are alike."""
    if len(rows) < 2:
        return ""
    each, other = neighbours(rows, _PAIRS)
    n = len(each.inputs)
    K = np.abs(kernel.at(np.log(hyperparameters), np.vstack([each.inputs, other.inputs])).matrix())
    variance = np.diagonal(K)
    correlated = np.diagonal(K[:n, n:]) >= _WHITE * np.sqrt(variance[:n]) * np.sqrt(variance[n:])
    if correlated.mean() > _WHITE_SHARE or not alike_neighbours(rows).any():
        return ""
    return (
        "The kernel became white noise: to it neighbouring rows are strangers, though they are alike, and elsewhere it "
        "predicts nothing beyond the features and the prior mean. Let its length scales start higher, raise their "
        "lower bounds, or raise n_restarts (of the solver, if there is one)."
    )
