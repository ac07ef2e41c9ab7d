"""Where an output's signal and noise variance predict rows that were left out best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..optimizers.parameters import ParameterTable, Values
from .left_out import LeftOut, Weights

# The noise is never this low.
_LOWEST = 1e-20
# Ratios s²/σ² that are tried are powers of 2: these many doublings away first, then in steps of so many, and no further
# than so many from where the bound is highest.
_LOOK, _STEPS, _FARTHEST = (-6, 0, 6), (3.0, 1.0, 0.25), 36
# What the logarithm of the root mean square error counts beside a log density: to this the mean of rows that are
# uncertain anyway hardly matters.
_SQUARES = 0.5
# Noise variances that are tried for a ratio, as factors.
_NOISES = 2.0 ** np.arange(-3.0, 3.25, 0.5)


@dataclass(frozen=True)
class Limits:
    """Limits of signal and noise, each (o, 2), and which of the two are free."""

    signal: np.ndarray
    noise: np.ndarray
    free_signal: bool
    free_noise: bool

    @classmethod
    def of(cls, table: ParameterTable, wider: float) -> Limits:
        signal, noise = table["signal"], table["noise"]
        return cls(
            signal.value_limits() * [1.0 / wider, wider],
            noise.value_limits(),
            bool(signal.free.any()),
            bool(noise.free.any()),
        )


@dataclass(frozen=True)
class Search:
    """Where an output's log predictive density of rows left out is highest.

    Attributes
    ----------
    output, index : int
        Of the model's outputs, and of its group's.
    folds : list of LeftOut
        Of its group.
    known : list of Weights or None
        What is known of the weights beside the output's own rows, without each fold.
    values : dict
        Where the bound is highest.
    limits : Limits
    lowest : float
        The noise is not lower.
    """

    output: int
    index: int
    folds: list[LeftOut]
    known: list[Weights | None]
    values: Values
    limits: Limits
    lowest: float

    def with_limits(self, limits: Limits, lowest: float) -> Search:
        """The same search for less."""
        return replace(self, limits=limits, lowest=float(lowest))

    def best(self) -> tuple[float, float]:
        """Signal and noise variance."""
        signal, noise = self._along_ratios()
        if not self.limits.free_signal or not np.isclose(signal, self._range("signal")).any():
            return signal, noise
        # Along a limit of the signal the noise alone is searched.
        values = self.values | {"signal": np.full(len(self.values["signal"]), signal)}
        return replace(self, values=values, limits=replace(self.limits, free_signal=False))._along_ratios()

    def squares(self, signal: float, noise: float) -> float:
        """Mean square error of what was left out; without a signal that of the features alone."""
        total, n = 0.0, 0.0
        for fold, known in zip(self.folds, self.known, strict=True):
            error, _ = fold.predicted(self.index, signal / noise, np.array([noise]), known)
            total += float((fold.rows.counts @ error**2)[0])
            n += fold.rows.counts.sum()
        return total / n

    def _along_ratios(self) -> tuple[float, float]:
        s2, noise = (float(self.values[name][self.output]) for name in ("signal", "noise"))
        if not self.limits.free_signal and not self.limits.free_noise:
            return s2, noise
        begin = float(np.round(np.log2(s2 / noise)))
        tried: dict[float, tuple[float, float]] = {}

        def loss(k: float) -> float:
            if abs(k - begin) > _FARTHEST:
                return np.inf
            if k not in tried:
                tried[k] = self._at_ratio(2.0**k)
            return tried[k][0]

        best = min((begin + step for step in _LOOK), key=loss)
        for step in _STEPS:
            while (k := min((best, best - step, best + step), key=loss)) != best:
                best = k
        if not np.isfinite(loss(best)):
            return s2, noise
        return self._between(best, [tried.get(best + side * step, (np.inf, np.nan)) for side in (-1, 0, 1)])

    def _between(self, k: float, near: Sequence[tuple[float, float]]) -> tuple[float, float]:
        """Where a parabola through the losses at three powers, the last step apart around k, is lowest."""
        (before, noise_before), (here, noise), (after, noise_after) = near
        shift = 0.0
        if np.isfinite(before + after):
            shift = _vertex(before, here, after)
            noise *= (noise_after / noise if shift > 0.0 else noise / noise_before) ** shift
        if not self.limits.free_noise:
            noise = float(self.values["noise"][self.output])
        ratio = 2.0 ** (k + _STEPS[-1] * shift)
        signal = ratio * noise
        if not self.limits.free_signal:
            signal = float(self.values["signal"][self.output])
            noise = signal / ratio
        return (
            float(np.clip(signal, *self._range("signal"))),
            float(np.clip(noise, *self._range("noise"))),
        )

    def _range(self, name: str) -> tuple[float, float]:
        """From where to where it may move."""
        if not getattr(self.limits, f"free_{name}"):
            return (float(self.values[name][self.output]),) * 2
        low, high = getattr(self.limits, name)[self.output]
        if name == "noise":
            low = max(low, min(self.lowest, high), _LOWEST)
        return float(low), float(high)

    def _at_ratio(self, ratio: float) -> tuple[float, float]:
        """The lowest loss at a ratio s²/σ², and the noise variance there."""
        (s_low, s_high), (low, high) = self._range("signal"), self._range("noise")
        # A signal or a noise that is fixed is met to rounding.
        low, high = max(low, s_low / ratio * (1.0 - 1e-9)), min(high, s_high / ratio * (1.0 + 1e-9))
        if low > high:
            return np.inf, np.nan
        if high < low * 1.01:
            noise = np.array([np.sqrt(low * high)])
            return float(self._losses(ratio, noise)[0]), float(noise[0])
        noise = np.clip(self.values["noise"][self.output], low, high)
        # What makes squared errors as large as variances, were these in proportion to the noise.
        for _ in range(2):
            noise = np.clip(noise * self._excess(ratio, noise), low, high)
        grid = np.clip(noise * _NOISES, low, high)
        losses = self._losses(ratio, grid)
        best = int(np.argmin(losses))
        if not 0 < best < len(grid) - 1 or not grid[best - 1] < grid[best] < grid[best + 1]:
            return float(losses[best]), float(grid[best])
        shift = _vertex(*losses[best - 1 : best + 2])
        noise = grid[best] * (_NOISES[1] / _NOISES[0]) ** shift
        return float(losses[best] + 0.25 * shift * (losses[best + 1] - losses[best - 1])), float(noise)

    def _excess(self, ratio: float, noise: float) -> float:
        """Mean square of errors in units of their std."""
        total, n = 0.0, 0.0
        for fold, known in zip(self.folds, self.known, strict=True):
            error, variance = fold.predicted(self.index, ratio, np.array([noise]), known)
            total += float((fold.rows.counts @ (error**2 / variance))[0])
            n += fold.rows.counts.sum()
        return max(total / n, 1e-12)

    def _losses(self, ratio: float, noise: np.ndarray) -> np.ndarray:
        """What is to be low (g,), in nats per row, at noise variances (g,)."""
        density, squares, n = np.zeros(len(noise)), np.zeros(1), 0.0
        for fold, known in zip(self.folds, self.known, strict=True):
            error, variance = fold.predicted(self.index, ratio, noise, known)
            counts, error = fold.rows.counts, error**2
            density += 0.5 * (counts @ (np.log(variance) + error / variance))
            squares = squares + counts @ error
            n += counts.sum()
        s2, at_bound = (self.values[name][self.output] for name in ("signal", "noise"))
        density += 0.5 * (np.log(ratio * noise / s2) ** 2 + np.log(noise / at_bound) ** 2)
        return density / n + 0.5 * _SQUARES * np.log(np.maximum(squares / n, _LOWEST))


def _vertex(before: float, here: float, after: float) -> float:
    """Where a parabola through three points, one step apart, is lowest: in steps from the middle one, the lowest."""
    curvature = before - 2.0 * here + after
    return 0.0 if curvature <= 0.0 else float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))
