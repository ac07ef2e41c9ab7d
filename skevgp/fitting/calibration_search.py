"""Where an output's signal and noise variance predict rows that were left out best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student_t

from ..model.parameters import ParameterTable, Values
from .left_out import LeftOut, Weights

# In place of squares that vanish.
_LOWEST = 1e-20
# Ratios s²/σ² that are tried are powers of 2: these many doublings away first, then in steps of so many, and no further
# than so many from where the bound is highest.
_LOOK, _STEPS, _FARTHEST = (-6, 0, 6), (3.0, 1.0, 0.25), 36
# What the logarithm of the root mean square error counts beside a log density: to this the mean of rows that are
# uncertain anyway hardly matters.
_SQUARES = 0.5
# Where groups are few, as many errors of a new one as should lie within 2 standard deviations; with no fewer degrees of
# freedom than this.
_INSIDE, _FEWEST_DEGREES = 0.97725, 3.0
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

    def with_signal_above(self, least: np.ndarray) -> Limits:
        """The same with a signal (o,) that does not fall below."""
        low, high = self.signal.T
        return replace(self, signal=np.column_stack([np.clip(least, low, high), high]))

    def with_signal_below(self, most: np.ndarray) -> Limits:
        """The same with a signal (o,) that does not rise above."""
        low, high = self.signal.T
        return replace(self, signal=np.column_stack([low, np.clip(most, low, high)]))


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

    def loss(self, signal: float, noise: float) -> float:
        """Minus the mean log density of what was left out, but for a constant."""
        density, _ = self._means(signal / noise, np.array([noise]))
        return float(density[0])

    def without_signal(self) -> float:
        """The same of the features alone, with a noise as large as what they leave over."""
        _, squares = self._means(0.0, self._at_bound("noise") * np.ones(1))
        return self.loss(0.0, max(float(squares[0]), _LOWEST))

    def in_doubt(self, signal: float, noise: float, groups: Sequence[np.ndarray]) -> float:
        """By what variances should be larger since they are known from so many groups only, (n,) of each fold.

        A group's root mean square of errors over std is one observation of the scale of std; of the mean of them, ν =
        1 / (2 variance) degrees of freedom are left. Errors of a new group are then distributed as Student's t.
        """
        means: list[np.ndarray] = []
        for fold, known, own in zip(self.folds, self.known, groups, strict=True):
            error, variance = fold.predicted(self.index, signal / noise, np.array([noise]), known)
            counts = np.bincount(own, fold.rows.counts)
            sums = np.bincount(own, fold.rows.counts * (error**2 / variance)[:, 0])
            means.append(sums[counts > 0.0] / counts[counts > 0.0])
        scale = np.sqrt(np.concatenate(means))
        spread = float(np.var(scale, ddof=1)) / max(float(np.mean(scale)) ** 2, _LOWEST)
        degrees = max(len(scale) / max(2.0 * spread, 1e-6), _FEWEST_DEGREES)
        return float((student_t.ppf(_INSIDE, degrees) / norm.ppf(_INSIDE)) ** 2)

    def times(self, factor: float, signal: float, noise: float) -> tuple[float, float]:
        """Variances times a factor, within their limits."""
        signal, noise = (
            float(np.clip(value * factor, *self._range(name))) for name, value in (("signal", signal), ("noise", noise))
        )
        return signal, noise

    def _along_ratios(self) -> tuple[float, float]:
        s2, noise = (self._at_bound(name) for name in ("signal", "noise"))
        if not self.limits.free_signal and not self.limits.free_noise:
            return s2, noise
        (s_low, s_high), (low, high) = self._range("signal"), self._range("noise")
        # Where the bound was highest may be far from what is allowed here.
        begin = float(np.clip(np.round(np.log2(s2 / noise)), np.log2(s_low / high), np.log2(s_high / low)))
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
            noise = self._at_bound("noise")
        ratio = 2.0 ** (k + _STEPS[-1] * shift)
        signal = ratio * noise
        if not self.limits.free_signal:
            signal = self._at_bound("signal")
            noise = signal / ratio
        return (
            float(np.clip(signal, *self._range("signal"))),
            float(np.clip(noise, *self._range("noise"))),
        )

    def _range(self, name: str) -> tuple[float, float]:
        """From where to where it may move."""
        if not getattr(self.limits, f"free_{name}"):
            return (self._at_bound(name),) * 2
        low, high = getattr(self.limits, name)[self.output]
        if name == "noise":
            low = max(low, min(self.lowest, high))
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
        noise = np.clip(self._at_bound("noise"), low, high)
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
        density, squares = self._means(ratio, noise)
        log_prior = np.log(ratio * noise / self._at_bound("signal")) ** 2 + np.log(noise / self._at_bound("noise")) ** 2
        n = sum(fold.rows.counts.sum() for fold in self.folds)
        return density + 0.5 * (log_prior / n + _SQUARES * np.log(np.maximum(squares, _LOWEST)))

    def _means(self, ratio: float, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Minus the mean log density but for a constant (g,), and the mean square error, of what was left out."""
        density, squares, n = np.zeros(len(noise)), np.zeros(1), 0.0
        for fold, known in zip(self.folds, self.known, strict=True):
            error, variance = fold.predicted(self.index, ratio, noise, known)
            counts, error = fold.rows.counts, error**2
            density += 0.5 * (counts @ (np.log(variance) + error / variance))
            squares = squares + counts @ error
            n += counts.sum()
        return density / n, squares / n

    def _at_bound(self, name: str) -> float:
        return float(self.values[name][self.output])


def _vertex(before: float, here: float, after: float) -> float:
    """Where a parabola through three points, one step apart, is lowest: in steps from the middle one, the lowest."""
    curvature = before - 2.0 * here + after
    return 0.0 if curvature <= 0.0 else float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))
