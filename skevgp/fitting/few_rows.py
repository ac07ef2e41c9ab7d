"""Kernels for few rows: a weak prior of kernel and noise, and draws from their posterior.

With few rows for each hyperparameter, many kernels explain the rows about equally well. The most likely one is too
sure: columns that fit by chance seem to matter. A prior makes functions smooth unless the rows say otherwise, and
predictions are averaged over draws from the posterior of kernel and noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..kernels.base import Covariance
from ..model.parameters import ParameterTable, Values
from ..solvers.base import Objective
from ..solvers.coordinates import Limits
from ..solvers.lbfgs import curvature_along_axes
from ..utils.linalg import NotPositiveDefiniteError

# The prior of a length scale: log(length scale / std of the column) has this mean plus ½ log d, for d columns, and this
# standard deviation. (Hvarfner, Hellsten & Nardi 2024, arXiv 2402.02229, have √2 and √3. These predicted better in
# benchmarks/few_rows.py.)
_LENGTH_MEAN, _LENGTH_STD = 2.3, 1.4
# Standard deviations of the logarithms of the signal variance, the noise variance and other hyperparameters. Their
# median is their start, except that of the noise variance, which is this share of the residuals' variance.
_SIGNAL_STD, _NOISE_STD, _OTHER_STD, _NOISE_SHARE = 4.0, 2.0, 2.0, 0.1
# A start by forward selection: each column is long, this many times the median of the prior, or short, in standard
# deviations of the column. The noise variance is this share of the residuals' variance. A column must gain so many
# nats. At most so many are tried each time, and so many chosen.
_LONG, _SHORT, _NOISE, _GAIN, _TRIED, _CHOSEN = 3.0, 1.0, 0.3, 1.0, 40, 8
# Modes are different if a coordinate differs by more than this.
_SAME = 0.2
# This share of the difference between the log evidences of two modes counts. The evidence is only known from the
# curvature along the axes.
_EVIDENCE = 0.5
# Hamiltonian Monte Carlo: draws, trajectories for each draw, trajectories before the first draw, steps of a
# trajectory, and the first length of a step in posterior standard deviations.
N_DRAWS, _PER_DRAW, _WARM_UP, _STEPS, _STEP = 16, 2, 10, 8, 0.3
# The step length is changed towards this rate of acceptance during the warm-up.
_ACCEPTED, _CHANGE = 0.8, 1.25
# Positions are multiples of this many units, and units are powers of 2: rounding errors of one trajectory, which differ
# between processors, do not reach the next one.
_GRID, _START_GRID = 2.0**-7, 2.0**-3
# Limits of units, and the number of differences of gradients that give them.
_SHORTEST, _LONGEST, _PROBES = 2.0**-6, 4.0, 8


@dataclass(frozen=True)
class HyperPrior:
    """Independent log-normal priors of kernel and noise. Their log density is multiplied by ``weight``."""

    # From 1 for very few rows to 0 for enough.
    weight: float
    # The means and standard deviations of the logarithms, in the parameters' shapes.
    means: Values
    stds: Values
    # Which hyperparameters (n_hyper,) are the length scales of the columns. None: there is not one for each column.
    columns: np.ndarray | None

    @classmethod
    def of(
        cls, table: ParameterTable, kernel: Covariance, column_std: np.ndarray, scatter: np.ndarray, weight: float
    ) -> HyperPrior:
        """The prior of the parameters of a table.

        ``column_std`` (d,) are the standard deviations of the columns. ``scatter`` (o,) is the variance of the
        residuals. It is 0 for constants, whose noise variance has its start as median.
        """
        starts = {name: table[name].start for name in ("hyperparameters", "signal", "noise")}
        medians = starts | {"noise": np.where(scatter > 0.0, _NOISE_SHARE * scatter, starts["noise"])}
        means = {name: np.log(median) for name, median in medians.items()}
        spreads = {"hyperparameters": _OTHER_STD, "signal": _SIGNAL_STD, "noise": _NOISE_STD}
        stds = {name: np.full(start.shape, spreads[name]) for name, start in starts.items()}
        # A length scale of all columns is in units of their mean standard deviation (of logarithms).
        d, of_column, is_length = len(column_std), kernel.lengthscale_mask, kernel.is_length
        lengths = _LENGTH_MEAN + 0.5 * np.log(d) + np.log(column_std)
        means["hyperparameters"][..., is_length & ~of_column] = lengths.mean()
        means["hyperparameters"][..., of_column] = np.resize(lengths, of_column.sum())
        stds["hyperparameters"][..., is_length] = _LENGTH_STD
        return cls(weight, means, stds, of_column if of_column.sum() == d else None)

    def log_density(self, values: Values) -> float:
        """The log density, times the weight and without its constant."""
        distances = [(np.log(values[name]) - mean) / self.stds[name] for name, mean in self.means.items()]
        return -0.5 * self.weight * float(sum(np.sum(distance**2) for distance in distances))


class WithPrior:
    """Minus the bound and the log prior, per row, and its gradient, as a function of the flat vector."""

    def __init__(self, objective: Objective, table: ParameterTable, prior: HyperPrior, n_rows: float):
        # The coordinates of these parameters are their logarithms. The others have no precision.
        self.objective, values = objective, table.values_at_start()
        means = {name: prior.means.get(name, np.zeros(value.shape)) for name, value in values.items()}
        precisions = {
            name: prior.weight / prior.stds[name] ** 2 if name in prior.stds else np.zeros(value.shape)
            for name, value in values.items()
        }
        self._mean, self._precision, self._n_rows = table.flat(means), table.flat(precisions), n_rows
        # The part of fixed values is constant.
        free = 0.5 * float(self._precision @ (table.start() - self._mean) ** 2)
        self._of_fixed = -prior.log_density(values) - free

    def __call__(self, flat: np.ndarray) -> tuple[float, np.ndarray]:
        loss, slopes = self.objective(flat)
        distance = flat - self._mean
        slope = self._precision * distance
        energy = 0.5 * float(distance @ slope) + self._of_fixed
        return loss + energy / self._n_rows, slopes + slope / self._n_rows


# --- a start ----------------------------------------------------------------------------------------------------------


def forward_selection(
    energy: Objective, table: ParameterTable, prior: HyperPrior, scatter: np.ndarray, seen: Callable[[float], None]
) -> Values:
    """Values in which a few columns have short length scales: one after another, the one that lowers the energy most.

    With about as many columns as rows, a gradient leads to many columns that matter a little. ``energy`` is a function
    of the flat vector of the table, and ``prior.columns`` is not None. ``seen`` is called with each energy.
    """
    assert prior.columns is not None
    values, is_free = table.values_at_start(), table["hyperparameters"].free
    place = np.flatnonzero(prior.columns & is_free)
    means = {name: np.exp(mean) for name, mean in prior.means.items()}
    hyperparameters = np.where(prior.columns, _LONG * means["hyperparameters"], values["hyperparameters"])
    short = _SHORT * means["hyperparameters"] / np.exp(_LENGTH_MEAN + 0.5 * np.log(prior.columns.sum()))
    values |= {"hyperparameters": hyperparameters, "signal": means["signal"]}
    values["noise"] = np.where(scatter > 0.0, _NOISE * scatter, values["noise"])

    def at(hyperparameters: np.ndarray) -> tuple[float, np.ndarray]:
        start = table.started_at(values | {"hyperparameters": hyperparameters}).start()
        value, slope = _at(energy, start)
        seen(value)
        # The free hyperparameters are the first coordinates.
        slopes = np.zeros(len(is_free))
        slopes[is_free] = slope[: is_free.sum()]
        return value, slopes

    best, slope = at(hyperparameters)
    chosen: list[int] = []
    while len(chosen) < min(_CHOSEN, len(place)):
        # The columns that would gain most from a little shorter length scale.
        left = [j for j in place[np.argsort(-slope[place], kind="stable")].tolist() if j not in chosen][:_TRIED]
        tried = [np.where(np.arange(len(short)) == j, short, hyperparameters) for j in left]
        found = [at(one) for one in tried]
        index = int(np.argmin([value for value, _ in found]))
        if not found[index][0] < best - _GAIN:
            break
        best, slope = found[index]
        hyperparameters = tried[index]
        chosen.append(left[index])
    return values | {"hyperparameters": hyperparameters}


# --- draws ------------------------------------------------------------------------------------------------------------


def drawn(
    energy: Objective,
    modes: Sequence[np.ndarray],
    limits: Limits,
    rng: np.random.RandomState,
    seen: Callable[[float], None],
) -> list[np.ndarray]:
    """`N_DRAWS` draws from the density exp(-energy(x)), given some of its modes (size,).

    ``energy`` returns its value and gradient. ``limits`` reflect the chains. ``seen`` is called with the energy after
    each trajectory.
    """
    # Each mode has draws by its share of the evidence, ∫ exp(-energy) ≈ exp(-energy) Π unit around it. Of modes close
    # to each other, the best counts.
    different: list[np.ndarray] = []
    for mode in sorted(modes, key=lambda mode: _at(energy, mode)[0]):
        if all(np.abs(mode - other).max(initial=0.0) > _SAME for other in different):
            different.append(mode)
    units = [_units(energy, np.round(mode / _START_GRID) * _START_GRID, rng) for mode in different]
    sizes = [np.log(unit).sum() - _at(energy, mode)[0] for mode, unit in zip(different, units, strict=True)]
    shares = np.exp(_EVIDENCE * (np.array(sizes) - max(sizes)))
    ends = np.round(N_DRAWS * np.cumsum(shares) / shares.sum()).astype(int)
    draws: list[np.ndarray] = []
    for mode, unit, n_draws in zip(different, units, np.diff(ends, prepend=0), strict=True):
        if n_draws:
            draws += _chain(energy, mode, unit, limits, n_draws, rng, seen)
    return draws


def _chain(
    energy: Objective,
    mode: np.ndarray,
    unit: np.ndarray,
    limits: Limits,
    n_draws: int,
    rng: np.random.RandomState,
    seen: Callable[[float], None],
) -> list[np.ndarray]:
    """Draws by Hamiltonian Monte Carlo (Neal 2011) from a mode, with momenta in units of the coordinates."""
    x = np.clip(_on_grid(mode, unit), *limits)
    (here, slope), step, draws = _at(energy, x), _STEP, list[np.ndarray]()
    for turn in range(_WARM_UP + _PER_DRAW * n_draws):
        momentum, uniform, length = rng.standard_normal(len(x)), rng.uniform(), rng.uniform(0.4, 1.2)
        kick = step * length * unit
        there, p, total, slope_there = x, momentum, here, slope
        for _ in range(_STEPS):
            p = p - 0.5 * kick * slope_there
            there, p = _reflected(_on_grid(there + kick * p, unit), p, limits)
            total, slope_there = _at(energy, there)
            if not np.isfinite(total):
                break
            p = p - 0.5 * kick * slope_there
        change = here - total + 0.5 * (momentum @ momentum - p @ p) if np.isfinite(total) else -np.inf
        accepted = np.exp(min(change, 0.0))
        if uniform < accepted:
            x, here, slope = there, total, slope_there
        if turn < _WARM_UP:
            step = min(step * (_CHANGE if accepted > _ACCEPTED else 1.0 / _CHANGE), _STEP)
        elif (turn - _WARM_UP) % _PER_DRAW == _PER_DRAW - 1:
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
    """The scale of each coordinate, 1 / √(∂²energy / ∂x²), as a power of 2."""
    along_axes = curvature_along_axes(lambda x: _at(energy, x)[1], x, _at(energy, x)[1], _PROBES, rng)
    curvature = np.maximum(along_axes, _LONGEST**-2)
    return np.clip(2.0 ** np.round(-0.5 * np.log2(curvature)), _SHORTEST, _LONGEST)


def _on_grid(x: np.ndarray, unit: np.ndarray) -> np.ndarray:
    return np.round(x / (_GRID * unit)) * (_GRID * unit)


def _reflected(x: np.ndarray, momentum: np.ndarray, limits: Limits) -> tuple[np.ndarray, np.ndarray]:
    """A position within the limits, and its momentum."""
    lower, upper = limits
    low, high = x < lower, x > upper
    x = np.where(low, 2.0 * lower - x, np.where(high, 2.0 * upper - x, x))
    return np.clip(x, lower, upper), np.where(low | high, -momentum, momentum)
