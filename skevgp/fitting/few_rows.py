"""Kernels for few rows: a weak prior of kernel and noise, and draws from their posterior.

With few rows for each hyperparameter, many kernels explain the rows about equally well. The most likely one is too
sure: columns that fit by chance seem to matter. A prior makes functions smooth unless the rows say otherwise, and
predictions are averaged over draws from the posterior of kernel and noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..model.parameters import ParameterTable, Values
from ..solvers.base import Objective
from ..utils.linalg import NotPositiveDefiniteError

# The prior of a length scale: log(length scale / std of the column) ~ N(√2 + ½ log d, 3) for d columns (Hvarfner,
# Hellsten & Nardi 2024, "Vanilla Bayesian Optimization Performs Great in High Dimensions", eq. 9).
_LENGTH_MEAN, _LENGTH_STD = np.sqrt(2.0), np.sqrt(3.0)
# Standard deviations of the logarithms of the signal variance, the noise variance and other hyperparameters. Their
# median is their start, except that of the noise variance, which is this share of the residuals' variance.
_SIGNAL_STD, _NOISE_STD, _OTHER_STD, _NOISE_SHARE = 2.0, 3.0, np.sqrt(3.0), 1e-2
# Hamiltonian Monte Carlo: trajectories before the first draw, draws (one per trajectory), steps of a trajectory, and
# the first length of a step in posterior standard deviations.
_WARM_UP, N_DRAWS, _STEPS, _STEP = 12, 16, 8, 0.25
# The step length is changed towards this rate of acceptance during the warm-up.
_ACCEPTED, _CHANGE = 0.8, 1.25
# Positions are multiples of this many units, and units are powers of 2: rounding errors of one trajectory, which differ
# between processors, do not reach the next one.
_GRID, _START_GRID = 2.0**-7, 2.0**-3
# Limits of units, and the step of differences of gradients, both in log parameters.
_SHORTEST, _LONGEST, _DIFFERENCE, _PROBES = 2.0**-6, 4.0, 1e-3, 8


@dataclass(frozen=True)
class HyperPrior:
    """Independent log-normal priors of kernel and noise. Their log density is multiplied by ``weight``."""

    # From 1 for very few rows to 0 for enough.
    weight: float
    # The means and standard deviations of the logarithms, in the parameters' shapes.
    means: Values
    stds: Values

    @classmethod
    def of(
        cls, table: ParameterTable, mask: np.ndarray, column_std: np.ndarray, scatter: np.ndarray, weight: float
    ) -> HyperPrior:
        """The prior of the parameters of a table.

        ``mask`` (n_hyper,) says which hyperparameters are length scales of the columns, whose standard deviations are
        ``column_std`` (d,). ``scatter`` (o,) is the variance of the residuals.
        """
        d, starts = len(column_std), {name: table[name].start for name in ("hyperparameters", "signal", "noise")}
        means = {name: np.log(start) for name, start in starts.items()}
        spreads = {"hyperparameters": _OTHER_STD, "signal": _SIGNAL_STD, "noise": _NOISE_STD}
        length = _LENGTH_MEAN + 0.5 * np.log(d) + np.log(column_std)
        if mask.sum() and mask.sum() % d == 0:
            means["hyperparameters"][..., mask] = np.resize(length, mask.sum())
        elif len(mask) == 1:
            means["hyperparameters"][...] = length.mean()
        means["noise"] = np.log(_NOISE_SHARE * scatter)
        stds = {name: np.full(start.shape, spreads[name]) for name, start in starts.items()}
        return cls(weight, means, stds)

    def __call__(self, values: Values) -> tuple[float, Values]:
        """The log density without its constant, and its gradient in the logarithms."""
        total, gradient = 0.0, {name: np.zeros(value.shape) for name, value in values.items()}
        for name, mean in self.means.items():
            distance = (np.log(values[name]) - mean) / self.stds[name]
            total -= 0.5 * self.weight * float(np.sum(distance**2))
            gradient[name] = -self.weight * distance / self.stds[name]
        return total, gradient


class WithPrior:
    """Minus the bound and the log prior, per row, and its gradient, as a function of the flat vector."""

    def __init__(self, objective: Objective, table: ParameterTable, prior: HyperPrior, n_rows: float):
        self.objective, self.table, self.prior, self.n_rows = objective, table, prior, n_rows

    def __call__(self, flat: np.ndarray) -> tuple[float, np.ndarray]:
        loss, slopes = self.objective(flat)
        value, gradient = self.prior(self.table.values(flat))
        return loss - value / self.n_rows, slopes - self.table.gradient(gradient) / self.n_rows


# --- draws ------------------------------------------------------------------------------------------------------------


def drawn(
    energy: Objective,
    mode: np.ndarray,
    limits: tuple[np.ndarray, np.ndarray],
    rng: np.random.RandomState,
    seen: Callable[[float], None],
) -> list[np.ndarray]:
    """Draws from the density exp(-energy(x)), whose mode is x (size,): a chain of Hamiltonian Monte Carlo (Neal 2011).

    ``energy`` returns its value and gradient. ``limits`` reflect the chain. ``seen`` is called with the energy after
    each trajectory.
    """
    unit = _units(energy, np.round(mode / _START_GRID) * _START_GRID, rng)
    x = _on_grid(np.clip(mode, *limits), unit)
    (here, slope), step, draws = _at(energy, x), _STEP, []
    for turn in range(_WARM_UP + N_DRAWS):
        momentum, uniform, length = rng.standard_normal(len(x)), rng.uniform(), rng.uniform(0.8, 1.2)
        there, p, total = x, momentum, np.inf
        slope_there = slope
        for _ in range(_STEPS):
            p = p - 0.5 * step * length * unit * slope_there
            there, p = _reflected(_on_grid(there + step * length * unit * p, unit), p, limits)
            total, slope_there = _at(energy, there)
            if not np.isfinite(total):
                break
            p = p - 0.5 * step * length * unit * slope_there
        change = here - total + 0.5 * (momentum @ momentum - p @ p) if np.isfinite(total) else -np.inf
        accepted = np.exp(min(change, 0.0))
        if uniform < accepted:
            x, here, slope = there, total, slope_there
        if turn < _WARM_UP:
            step *= _CHANGE if accepted > _ACCEPTED else 1.0 / _CHANGE
            step = min(step, _STEP)
        else:
            draws.append(x)
        seen(here)
    return draws


def _at(energy: Objective, x: np.ndarray) -> tuple[float, np.ndarray]:
    """Energy and gradient. Infinite where they cannot be computed."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            value, slope = energy(x)
    except NotPositiveDefiniteError:
        return np.inf, np.zeros(len(x))
    return (value, slope) if np.isfinite(value) and np.isfinite(slope).all() else (np.inf, np.zeros(len(x)))


def _units(energy: Objective, x: np.ndarray, rng: np.random.RandomState) -> np.ndarray:
    """The scale of each coordinate, 1 / √(∂²energy / ∂x²), as a power of 2 (see `solvers.lbfgs.curvature_units`)."""
    total, here = np.zeros(len(x)), _at(energy, x)[1]
    for _ in range(_PROBES):
        signs = rng.choice([-1.0, 1.0], len(x))
        total += signs * (_at(energy, x + _DIFFERENCE * signs)[1] - here) / _DIFFERENCE
    curvature = np.maximum(np.abs(total) / _PROBES, _LONGEST**-2)
    return np.clip(2.0 ** np.round(-0.5 * np.log2(curvature)), _SHORTEST, _LONGEST)


def _on_grid(x: np.ndarray, unit: np.ndarray) -> np.ndarray:
    return np.round(x / (_GRID * unit)) * (_GRID * unit)


def _reflected(
    x: np.ndarray, momentum: np.ndarray, limits: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """A position within the limits, and its momentum."""
    lower, upper = limits
    low, high = x < lower, x > upper
    x = np.where(low, 2.0 * lower - x, np.where(high, 2.0 * upper - x, x))
    return np.clip(x, lower, upper), np.where(low | high, -momentum, momentum)
