"""Where a fit starts: what the features alone explain, and the first value and bounds of each parameter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve
from scipy.spatial import cKDTree

from .linalg import jittered_cholesky
from .parameters import Parameter, ParameterTable, Start

# Lengthscales start at this many standard deviations of their column, times √d: rows are then neither all alike nor
# all strangers, whatever the number of columns.
_LENGTHSCALE = 0.6
_LENGTHSCALE_BOUNDS = 1e-2, 1e4

# In units of the variance that the features alone leave over. A low first noise keeps L-BFGS out of the optimum where
# the noise explains everything; Adam, whose steps do not grow with the gradient, starts nearer to the data's scatter.
FIRST_NOISE = {"lbfgs": 1e-4, "adam": 1e-2}
# Below 1e-10 of it, rounding in k(x, x) - |v|² (about 1e-16 times the condition of L, 1e6) outweighs the noise.
_NOISE_BOUNDS = 1e-10, 1e2
# Of squared target units, however little they scatter: about the rounding error of the residuals.
_LOWEST_NOISE = 1e-20
# So that the lowest noise variance in the user's units is not rounded to 0.
_SMALLEST_UNIT = 1e-140
_NEIGHBOUR_SAMPLE = 2000
_SIGNAL_BOUNDS = 1e-8, 1e8


@dataclass(frozen=True)
class Starts:
    """What the user says of the kernel and the noise.

    Attributes
    ----------
    hyperparameters : Start
        Of k̃.
    signal : Start
        s², the same for all outputs.
    noise : Start
        σ², the same for all outputs.
    """

    hyperparameters: Start
    signal: Start
    noise: Start


def features_alone(features: np.ndarray, residuals: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """The most probable w of r = H diag(scale) w + ε, w ~ N(0, I), for each output.

    The noise variance is first negligible, then what that leaves over; two steps of iterative refinement make up for
    the rounding of the normal equations.

    Parameters
    ----------
    features : ndarray of shape (n, p)
    residuals : ndarray of shape (n, o)
        y - H mean.
    scale : ndarray of shape (o, p)
        Prior standard deviations; 0 keeps a coefficient at its mean.

    Returns
    -------
    w : ndarray of shape (o, p)
    """
    w = np.zeros(scale.shape)
    HH = features.T @ features
    for o, c in enumerate(scale):
        target = residuals[:, o]
        noise = 1e-12 * np.mean(target**2)
        for _ in range(2):
            if noise == 0.0 or not c.any():
                break
            precision = c[:, np.newaxis] * HH * c
            np.einsum("ii->i", precision)[...] += noise
            root = jittered_cholesky(precision)
            for _ in range(3):
                left_over = target - features @ (c * w[o])
                w[o] += cho_solve((root, True), c * (features.T @ left_over) - noise * w[o])
            noise = np.mean((target - features @ (c * w[o])) ** 2)
    return w


def unit_of(values: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """The root mean square of each column, never below the rounding error of ``reference`` and never 0.

    Parameters
    ----------
    values, reference : ndarray of shape (n, o)

    Returns
    -------
    unit : ndarray of shape (o,)
    """
    largest = np.abs(reference).max(axis=0)
    unit = np.maximum(rms(values), 1e-14 * largest)
    return np.where(unit > 0.0, np.maximum(unit, _SMALLEST_UNIT), 1.0)


def rms(values: np.ndarray) -> np.ndarray:
    """Root mean square of each column, without overflow."""
    largest = np.abs(values).max(axis=0, initial=0.0)
    safe = np.where(largest > 0.0, largest, 1.0)
    return safe * np.sqrt(np.mean((values / safe) ** 2, axis=0))


def spread_of(inputs: np.ndarray) -> np.ndarray:
    """The standard deviation (d,) of each centred column; 1 where the column is constant."""
    spread = rms(inputs)
    return np.where(spread > _SMALLEST_UNIT, spread, 1.0)


def alike_neighbours(inputs: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Whether neighbouring rows have residuals more alike than noise has: then there is something to learn.

    The mean square difference of residuals between each row and its nearest neighbour is about twice their variance if
    they are noise (von Neumann 1941, for rows in order); less by four of its standard errors, about 1.6 / √n each, is
    more than chance.

    Parameters
    ----------
    inputs : ndarray of shape (n, d)
        The kernel's, centred.
    residuals : ndarray of shape (n, o)

    Returns
    -------
    alike : ndarray of shape (o,)
    """
    rows = np.unique(np.linspace(0, len(inputs) - 1, _NEIGHBOUR_SAMPLE).astype(int))
    if len(rows) < 2:
        return np.zeros(residuals.shape[1], dtype=bool)
    inputs, residuals = inputs[rows] / spread_of(inputs), residuals[rows]
    _, nearest = cKDTree(inputs).query(inputs, 2)
    difference = np.mean((residuals[nearest[:, 0]] - residuals[nearest[:, 1]]) ** 2, axis=0)
    return difference < 2.0 * residuals.var(axis=0) * (1.0 - 6.4 / np.sqrt(len(rows)))


def starting_table(
    inputs: np.ndarray,
    inducing_points: np.ndarray,
    target_unit: np.ndarray,
    starts: Starts,
    scatter: np.ndarray,
    first_noise: float,
    n_hyperparameters: int,
) -> ParameterTable:
    """The parameters of a sparse model: hyperparameters of k̃, s², σ² (in squared target units) and X_m.

    Parameters
    ----------
    inputs : ndarray of shape (n, d)
        The kernel's, centred.
    inducing_points : ndarray of shape (g, m, d)
        One set per group of outputs.
    target_unit : ndarray of shape (o,)
        The size of what the features alone leave over.
    starts : Starts
        What the user says of them.
    scatter : ndarray of shape (o,)
        Variance of the residuals, in squared target units: 1, but for targets far from 0.
    first_noise : float
        Where the noise variance starts, as a share of the scatter, if the user does not say.
    n_hyperparameters : int
        1 or d.

    Returns
    -------
    table : ParameterTable
        With the parameters ``hyperparameters``, ``signal``, ``noise``, ``inducing_points``.
    """
    spread, o = spread_of(inputs), np.ones(len(target_unit))
    typical = spread if n_hyperparameters > 1 else np.sqrt(np.mean(spread**2, keepdims=True))
    root_d = np.sqrt(inputs.shape[1])
    lower, upper = _LENGTHSCALE_BOUNDS
    return ParameterTable(
        [
            starts.hyperparameters.parameter(
                "hyperparameters", _LENGTHSCALE * root_d * typical, lower * typical, upper * root_d * typical, 1.0
            ),
            starts.signal.parameter("signal", o, _SIGNAL_BOUNDS[0] * o, _SIGNAL_BOUNDS[1] * o, target_unit**2),
            starts.noise.parameter(
                "noise",
                first_noise * scatter,
                np.maximum(_NOISE_BOUNDS[0] * scatter, _LOWEST_NOISE),
                _NOISE_BOUNDS[1] * o,
                target_unit**2,
            ),
            Parameter("inducing_points", inducing_points, unit=spread),
        ]
    )
