"""L-BFGS over kernel and noise from several starts: one alone may end where the noise explains everything."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..optimizers.lbfgs import Minimum, Objective, Report, lbfgs
from ..optimizers.parameters import ParameterTable

# An output counts as not learned when this share of what the features alone leave over ends as noise.
_COLLAPSED = 0.9
# Where a collapsed fit starts again: factors on the first lengthscales and the first noise variance.
_OTHER_STARTS = ((0.5, 1.0), (2.0, 100.0), (1.0, 1e3))
# With about as many inducing points as rows, a low first noise may lead to a plateau on which the kernel explains every
# row by itself: such fits, which cost little, start from a noise so many times higher too.
_INTERPOLATES, _MUCH_NOISE = 1.5, 1e3
# A restart multiplies the first values by a number between 1 / factor and the factor, drawn log-uniformly.
_RESTART_FACTORS = {"hyperparameters": 3.0, "noise": 30.0}


def interpolates(n_inducing: int, n_rows: int) -> bool:
    """Whether there are about as many inducing points as rows."""
    return _INTERPOLATES * n_inducing >= n_rows


def moved_start(table: ParameterTable, rng: np.random.RandomState) -> dict[str, np.ndarray]:
    """The table's first values with kernel and noise elsewhere, within their bounds."""
    coordinates = table.coordinates(table.start())
    for name, factor in _RESTART_FACTORS.items():
        spread = np.log(factor)
        coordinates[name] = coordinates[name] + rng.uniform(-spread, spread, coordinates[name].shape)
    return table.values(np.clip(table.flat(coordinates), *table.bounds()))


def lbfgs_unless_stuck(
    objective: Objective,
    table: ParameterTable,
    scatter: np.ndarray,
    max_iter: int,
    tol: float,
    *,
    alone: float = -np.inf,
    one_start: bool = False,
    may_interpolate: bool = False,
    report: Report | None = None,
) -> Minimum:
    """L-BFGS from the table's start; from other starts too where that may have ended in a bad optimum.

    Parameters
    ----------
    objective : callable
        Minus a bound per row, and its gradient.
    table : ParameterTable
    scatter : ndarray of shape (o,)
        Variance of the residuals.
    max_iter : int
        Of each start.
    tol : float
        Per row.
    alone : float, default=-inf
        The bound per row of the features alone.
    one_start : bool, default=False
        Whether to leave out the others: the start is where another fit ended.
    may_interpolate : bool, default=False
        Whether the kernel could explain every row by itself.
    report : callable, default=None

    Returns
    -------
    minimum : Minimum
        The best.
    """
    best: Minimum | None = None

    def descend(length_factor: float, noise_factor: float) -> Minimum:
        start = table.coordinates(table.start())
        start["hyperparameters"] = start["hyperparameters"] + np.log(length_factor)
        start["noise"] = start["noise"] + np.log(noise_factor)
        first = np.clip(table.flat(start), *table.bounds())
        minimum = lbfgs(objective, first, table.bounds(), max_iter, tol, report)
        return minimum if best is None or minimum.loss < best.loss else replace(best, interrupted=minimum.interrupted)

    best = descend(1.0, 1.0)
    if max_iter == 0 or one_start or not table["noise"].free.any():
        return best
    if may_interpolate and not best.interrupted:
        best = descend(1.0, _MUCH_NOISE)
    for factors in _OTHER_STARTS:
        # A fit that has not ended yet may still be below.
        bound = -best.loss if best.converged else np.inf
        if best.interrupted or not stuck(table.values(best.x)["noise"], bound, scatter, alone):
            break
        best = descend(*factors)
    return best


def stuck(noise: np.ndarray, bound: float, scatter: np.ndarray, alone: float) -> bool:
    """Whether noise came to explain everything, or the kernel explains less than nothing would."""
    return bool((noise > _COLLAPSED * scatter).any()) or bound < alone
