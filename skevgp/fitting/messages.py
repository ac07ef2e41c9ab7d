"""Messages to the user about the end of a fit. Each function returns an empty text if there is nothing to say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from ..data.rows import RawRows, Rows
from ..model.parameters import ParameterTable, Values
from ..model.predictor import CoefficientPrior
from ..model.statistics import Kernel
from ..solvers.base import Minimum

# Nothing was learned if the noise explains more than this share.
_NOTHING_LEARNED = 0.99
# A kernel is white noise if no more than this share of so many pairs of neighbours have at least this correlation.
# (`alike_neighbours` needs more similar pairs than that.)
_PAIRS, _WHITE_SHARE, _WHITE = 200, 0.1, 0.01
# y is far from its prior mean by so many times its standard deviation, a weight by so many prior standard deviations.
_FAR, _FAR_WEIGHT = 1e4, 100.0
# The standard deviation of a sample, as a share of its range, is about this or more.
_STD_OF_RANGE = 0.15
# Largest number of names in a message.
_NAMES = 5
# Noise with outliers is tested with up to this share of outliers.
_MOST_OUTLIERS = 0.15
# Number of rows among which neighbours are found.
_NEIGHBOUR_SAMPLE = 2000

DEPENDENT_ROWS = (
    "Neighbouring rows are similar, and blocks of rows are predicted worse than single rows. std is too small for new "
    "trajectories. Pass groups to fit(X, y, groups=...) to identify the trajectory of each row. If rows are sorted but "
    "independent, shuffle them, or ignore this warning."
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
            f"{solver} stopped after {n_iter} iterations, because rounding errors hide further progress. This is usual "
            f"for data without noise. The best parameters are kept. Use a larger tol"
            f"{', fewer inducing points' if sparse else ''}, or a WhiteKernel with a lower bound on the noise."
        )
    sooner = 'a number for tol (now "auto")' if tol is None else f"a larger tol (now {tol})"
    return (
        f"The {'bound' if sparse else 'likelihood'} was still rising after max_iter={max_iter} iterations. Raise "
        f"max_iter, or stop earlier with {sooner}."
    )


def mini_batches_ended(solver: str, minimum: Minimum, fell: bool, learning_rate: float, batch_size: int) -> str:
    """Why a solver on mini-batches failed. ``fell`` says whether its bound ended below the first one."""
    if not minimum.converged:
        return (
            f"{solver} diverged after {minimum.n_iter} steps. The best parameters so far are kept. Lower learning_rate "
            f"(now {learning_rate}), or raise batch_size (now {batch_size})."
        )
    if fell:
        return (
            f"{solver} ended with a bound below the first one after {minimum.n_iter} steps. The best parameters are "
            f"kept. Raise max_iter or batch_size (now {batch_size}), or lower learning_rate (now {learning_rate})."
        )
    return ""


def interrupted(n_iter: int, max_time: float | None = None) -> str:
    """Message that Ctrl-C, or the end of ``max_time``, ended the fit."""
    how = "was interrupted" if max_time is None else f"ended at max_time={max_time:g} seconds"
    return f"The fit {how} after {n_iter} iterations. The best parameters so far are kept."


def signal_gone(gone: int, n_outputs: int) -> str:
    """Message that the Gaussian process of ``gone`` outputs does not predict held-out groups."""
    if not gone:
        return ""
    return (
        f"The Gaussian process does not improve predictions of left-out groups for {gone} of {n_outputs} outputs that "
        "are fitted together. std accounts for this. More groups, other columns (kernel_map) or "
        "other features may help."
    )


def many_outliers(share: float) -> str:
    """Message that more rows are outliers than the noise model can separate from the others."""
    if share <= _MOST_OUTLIERS:
        return ""
    return (
        f"{share:.0%} of the rows are far from the prediction. With more than {_MOST_OUTLIERS:.0%} of outliers, mean "
        "and std may be wrong. Remove wrong rows before the fit, or use other features or other columns (kernel_map)."
    )


def far_from_prior(prior: CoefficientPrior, rows: Rows, names: Sequence[str]) -> str:
    """Message that y, or a weight, is too far from its prior mean. ``names`` are those of the first weights."""
    # Residuals that are rounding errors of y are not of size one. The range shows their size even if a few rows have
    # almost all of the precision.
    y, columns = rows.residuals, rows.columns
    size = np.maximum(np.sqrt(rows.scatter() / rows.mean_precision), _STD_OF_RANGE * (y.highest - y.lowest)[columns])
    if (size < np.minimum(np.abs(y.mean[columns]), 1.0) / _FAR).any():
        return (
            f"y is more than {_FAR:g} times its scatter away from its prior mean of 0, which leaves the kernel little "
            "accuracy for the rest. Set normalize_y=True, or add an intercept to the feature_map."
        )
    # Weights with a learned scale are as far as their scale allows, and those with the scale 0 stay. The weights after
    # the named ones are those of parameters θ.
    p = len(names)
    fixed = (prior.scale > 0.0) & (True if prior.groups is None else prior.groups < 0)
    far = ((np.abs(prior.reference) > _FAR_WEIGHT) & fixed)[:, :p].any(axis=0)
    if far.any():
        far_names = [str(name) for name, is_far in zip(names, far, strict=True) if is_far]
        shown, n_more = ", ".join(far_names[:_NAMES]), len(far_names) - _NAMES
        shown += f" and {n_more} more" if n_more > 0 else ""
        return (
            f"The weights of {shown} are more than {_FAR_WEIGHT:g} prior standard deviations away from their prior "
            "mean. Check the units of X and y, or raise the scale of coef_prior for these weights."
        )
    return ""


def learned_too_little(kernel: Kernel, values: Values, table: ParameterTable, rows: Rows, sparse: bool = True) -> str:
    """Message that the noise, or a white kernel, explains what the Gaussian process could have learned."""
    message = ""
    if table["noise"].free.any():
        message = nothing_learned(values["noise"], rows, sparse)
    if not message and table["hyperparameters"].free.any():
        message = white_kernel(kernel, values["hyperparameters"], rows)
    return message


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
        cause = "They may share the kernel's shape with outputs that need another one. " + (
            'Use sharing="none" for independent kernels, or raise '
            if sparse
            else "Use MultiOutputRegressor(EGPRegressor(...)) for independent kernels, or raise "
        )
    return (
        f"The noise explains the whole residual of the features for {nothing.sum()} of {len(nothing)} outputs that are "
        "fitted together. The Gaussian process learned nothing from any start, although neighbouring rows are similar. "
        f"{cause or 'Raise '}{'n_inducing, or n_restarts of the solver' if sparse else 'n_restarts'}, start kernel or "
        "noise elsewhere, or check the scales of the kernel's columns."
    )


def white_kernel(kernel: Kernel, hyperparameters: np.ndarray, rows: Rows) -> str:
    """Message that the kernel k̃ itself became white noise, though neighbouring rows are alike."""
    if len(rows) < 2:
        return ""
    sampled, nearest = neighbours(rows, _PAIRS)
    n = len(sampled.inputs)
    K = np.abs(kernel.at(hyperparameters, np.vstack([sampled.inputs, nearest.inputs])).matrix())
    variance = np.diagonal(K)
    correlated = np.diagonal(K[:n, n:]) >= _WHITE * np.sqrt(variance[:n]) * np.sqrt(variance[n:])
    if correlated.mean() > _WHITE_SHARE or not alike_neighbours(rows).any():
        return ""
    return (
        "The kernel became white noise, although neighbouring rows are similar. Away from the training rows, "
        "predictions are those of the features and the prior mean alone. Start the length scales higher, raise their "
        "lower bounds, or raise n_restarts (of the solver, if there is one)."
    )


def alike_neighbours(rows: Rows) -> np.ndarray:
    """Whether neighbouring rows have more similar residuals than noise has, (o,). Then there is something to learn."""
    # The mean squared difference of residuals between each row and its nearest neighbour is about twice their variance
    # if they are noise (von Neumann 1941, for ordered rows). Its standard error is about 1.6 / √n of that. Less by four
    # of these is more than chance.
    if rows.inputs.constant.all() or len(rows) < 2:
        return np.zeros(len(rows.scatter()), dtype=bool)
    sampled, nearest = neighbours(rows)
    difference = np.mean((sampled.targets - nearest.targets) ** 2, axis=0)
    return difference < 2.0 * sampled.targets.var(axis=0) * (1.0 - 6.4 / np.sqrt(len(sampled.inputs)))


def neighbours(rows: Rows, size: int = _NEIGHBOUR_SAMPLE) -> tuple[RawRows, RawRows]:
    """Up to ``size`` rows of a sample, and the nearest other row of the sample to each, in standard deviations."""
    sample = rows.some(np.unique(np.linspace(0, len(rows) - 1, _NEIGHBOUR_SAMPLE).astype(int)))
    inputs = (sample.inputs - rows.inputs.mean) / rows.inputs.scale
    queried = np.unique(np.linspace(0, len(inputs) - 1, size).astype(int))
    _, pairs = cKDTree(inputs).query(inputs[queried], 2)
    sampled, nearest = (sample[positions] for positions in pairs.T)
    return sampled, nearest
