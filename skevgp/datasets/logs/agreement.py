"""Check that a recorded velocity is the derivative of the recorded position; if it is not, find the likely cause.

The integral of the velocity is compared with the change of position. Windows are so long that this change is far above
the noise and the resolution of the position. The slope of the integral over the change is 1 if they agree, also for a
noisy velocity. A velocity is refused only if its slope differs from 1 by many standard errors: in all windows, in those
of one direction, or in those of half of the record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_SHORTEST, _LONGEST = 4, 0.5  # of windows: steps, and s
_MOST = 5000  # windows that are compared; of more windows, a random sample
_FEWEST = 12  # windows in which the joint moves; with fewer, nothing is checked
_NOISES = 10.0  # a window's change of position, in standard deviations of its noise
_SLOWEST = {"velocity": 0.02, "acceleration": 0.2}  # per s, or per s²: drivers round what is slower to 0
_SLOW = 0.02  # ... and what is slower than this part of what joints reach
_AGREES = 1.5  # slopes up to that, and down to its inverse, are no contradiction
_AGREES_IN_PART = 2.0  # ... in one direction, or in half of the record
_ERRORS = 6.0  # standard errors that a slope is away from 1, at least
_FITS = 0.3  # median deviation over median change: less is a cause that explains the signal
_PART = 0.25  # of all motion, in one direction or half of the record: less says nothing
_LATE, _LATEST = 0.03, 0.5  # s: delays that matter, and those that are looked for
_BETTER = 4.0  # a delay counts if it improves more than half of the windows by this many standard errors
_ALIAS = 0.1  # delays whose deviations differ by less than this are equally good
_UNITS = {
    "velocity": {
        -1.0: "of opposite sign",
        np.degrees(1.0): "in degrees per second while the position is in radians",
        np.radians(1.0): "in radians per second while the position is in degrees",
        30.0 / np.pi: "in revolutions per minute",
        0.5 / np.pi: "in revolutions per second",
        1000.0: "in thousandths of the position's unit per second",
        0.001: "in thousands of the position's unit per second",
    },
    "acceleration": {-1.0: "of opposite sign", np.degrees(1.0): "in degrees", np.radians(1.0): "in radians"},
}
_NEAR = 0.03  # of a unit's factor


@dataclass(frozen=True)
class _Windows:
    """Windows in which a joint moves, and the change of its position in each."""

    first: np.ndarray  # rows
    last: np.ndarray
    change: np.ndarray  # (k,)

    def of(self, integral: np.ndarray) -> np.ndarray:
        """Return the change of an integral in each window."""
        return integral[self.last] - integral[self.first]

    def at(self, some: np.ndarray) -> _Windows:
        return _Windows(self.first[some], self.last[some], self.change[some])


def check_agreement(
    time: np.ndarray,
    position: np.ndarray,
    rate: np.ndarray,
    pieces: Sequence[slice],
    names: Sequence[str],
    *,
    slowest: float = 0.0,
    wrapped: np.ndarray | None = None,
    what: str = "velocity",
) -> None:
    """Raise if the rate is not the derivative of the position; the error names each joint and the likely cause.

    The position is continuous within pieces. Motion below `slowest` (per s) counts as rest. `wrapped`, of shape
    (n - 1, n_joints), marks the steps at which the recorded position wrapped. `what` names the rate. Accelerations are
    checked against velocities in the same way.
    """
    integral = np.zeros_like(rate)
    integral[1:] = np.cumsum((rate[1:] + rate[:-1]) / 2.0 * np.diff(time)[:, np.newaxis], axis=0)
    if not (np.isfinite(integral).all() and np.isfinite(np.ptp(position, axis=0)).all()):
        return  # numbers that overflow are told where they are filtered
    floor = max(2.0 * slowest if what == "velocity" else 0.0, _SLOWEST[what], _SLOW * _usual(time, position, pieces))
    resolutions = [_resolution(column) for column in rate.T]
    finest = min([one for one in resolutions if one > 0.0], default=0.0)
    causes = {}
    for joint, name in enumerate(names):
        # Drivers round velocities. A column of zeros is rounded as the others are.
        slow = max(floor, 2.0 * (resolutions[joint] or finest))
        windows = _moving(time, position[:, joint], pieces, slow)
        cause = None if windows is None else _cause(windows, joint, time, rate, integral, pieces, names, what)
        if cause is None and wrapped is not None:
            cause = _differenced(time, position[:, joint], rate[:, joint], wrapped[:, joint])
        if cause is not None:
            causes[name] = cause
    if causes:
        told = "; ".join(f"joint {name!r}: {cause}" for name, cause in causes.items())
        of = "position" if what == "velocity" else "velocity"
        raise ValueError(
            f"the recorded {what} contradicts the {of}. {told[0].upper()}{told[1:]}. Correct the {what} in the file, "
            f'or pass {what}="derive" to take it from the {of}.'
        )


def _windows(
    time: np.ndarray, position: np.ndarray, pieces: Sequence[slice], length: int
) -> tuple[_Windows, np.ndarray, float]:
    """Return all windows of so many steps, the speed in each, and their mean duration.

    Stamps that come in bursts make windows short, so the speed is the change over at least the mean duration.
    """
    first = np.concatenate([np.arange(rows.start, rows.stop - length, length) for rows in pieces])
    last = first + length
    lasting = time[last] - time[first]
    usual = float(np.mean(lasting)) if len(first) else 0.0
    change = position[last] - position[first]
    return _Windows(first, last, change), np.abs(change) / np.maximum(lasting, usual), usual


def _usual(time: np.ndarray, position: np.ndarray, pieces: Sequence[slice]) -> float:
    """Return the median, over the joints that move, of the speed that each reaches."""
    reached = []
    for column in position.T:
        _, speed, _ = _windows(time, column, pieces, _SHORTEST)
        if speed.any():
            reached.append(np.quantile(_some(speed), 0.95))
    return float(np.median(reached)) if reached else 0.0


def _some(values: np.ndarray) -> np.ndarray:
    """Draw a random sample in order; every k-th window could follow a pattern of the stamps."""
    if len(values) <= _MOST:
        return values
    return values[np.sort(np.random.default_rng(0).choice(len(values), _MOST, replace=False))]


def _moving(time: np.ndarray, position: np.ndarray, pieces: Sequence[slice], slow: float) -> _Windows | None:
    """Return the shortest windows of which enough have motion well above the noise, or None."""
    noise = _noise(time, position, pieces)
    length = _SHORTEST
    while True:
        windows, speed, usual = _windows(time, position, pieces, length)
        moves = (np.abs(windows.change) > _NOISES * noise) & (speed > slow)
        if moves.sum() >= _FEWEST:
            return windows.at(_some(np.flatnonzero(moves)))
        length *= 2
        if 2.0 * usual > _LONGEST or not len(speed):
            return None


def _resolution(values: np.ndarray) -> float:
    """Return the smallest step that is not 0."""
    sizes = np.abs(np.diff(values))
    return float(sizes[sizes > 0.0].min()) if sizes.any() else 0.0


def _noise(time: np.ndarray, position: np.ndarray, pieces: Sequence[slice]) -> float:
    """Return the noise's standard deviation, from residuals of lines through neighbours; at least that of rounding."""
    left = []
    for rows in pieces:
        t, q = time[rows], position[rows]
        if len(t) > 2:
            part = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
            left.append((q[1:-1] - (1.0 - part) * q[:-2] - part * q[2:]) / np.sqrt(1.0 + part**2 + (1.0 - part) ** 2))
    scatter = 1.4826 * float(np.median(np.abs(np.concatenate(left)))) if left else 0.0
    return max(scatter, _resolution(position) / np.sqrt(12.0))


def _slope(change: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Fit a line through 0 by least absolute deviations; return its slope and standard error."""
    ratio, weight = other / change, np.abs(change)
    order = np.argsort(ratio)
    middle = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    slope = float(ratio[order][min(middle, len(ratio) - 1)])
    # Of the mean deviation, not the median one: most windows of a velocity in spikes hold none.
    scale = 1.2533 * np.mean(np.abs(other - slope * change))
    return slope, float(1.2533 * scale / np.sqrt((change**2).sum()))


def _mean_slope(change: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Fit a line through 0 by least squares; return its slope and standard error.

    Least squares see the mean where a few rows hold all of a velocity: it was differenced at a higher rate, or stamps
    come in bursts.
    """
    slope = float(change @ other / (change @ change))
    return slope, float(np.sqrt(np.mean((other - slope * change) ** 2) / (change @ change)))


def _agrees(change: np.ndarray, other: np.ndarray, factor: float) -> bool:
    """Whether one of the two slopes is near 1, or both are uncertain."""
    slopes = [_slope(change, other), _mean_slope(change, other)]
    return any(1.0 / factor <= slope <= factor for slope, _ in slopes) or all(
        abs(slope - 1.0) <= _ERRORS * error for slope, error in slopes
    )


def _contradicting(change: np.ndarray, other: np.ndarray, what: str) -> tuple[str, np.ndarray] | None:
    """Return where the slope is not 1, in words and as windows; None if it is 1 everywhere."""
    everything, rises = np.arange(len(change)), change > 0.0
    if not _agrees(change, other, _AGREES):
        return "", everything
    parts = {
        " in the first half": everything[: len(change) // 2],
        " in the second half": everything[len(change) // 2 :],
    }
    if what == "velocity":  # accelerometers measure gravity, too
        parts |= {" where the position rises": everything[rises], " where the position falls": everything[~rises]}
    least = _PART * np.abs(change).sum()
    for where, some in parts.items():
        if (
            len(some) >= _FEWEST
            and np.abs(change[some]).sum() >= least
            and not _agrees(change[some], other[some], _AGREES_IN_PART)
        ):
            return where, some
    return None


def _deviation(change: np.ndarray, other: np.ndarray, slope: float = 1.0) -> float:
    """Return the median deviation from the line, relative to the median change."""
    return float(np.median(np.abs(other - slope * change)) / np.median(np.abs(slope * change)))


def _cause(
    windows: _Windows,
    joint: int,
    time: np.ndarray,
    rate: np.ndarray,
    integral: np.ndarray,
    pieces: Sequence[slice],
    names: Sequence[str],
    what: str,
) -> str | None:
    """Return the likely cause of a contradiction; None if the signals agree."""
    change, other = windows.change, windows.of(integral[:, joint])
    if cause := _unsigned(change, other):
        return cause
    plain, found = _deviation(change, other), _contradicting(change, other, what)
    lasting = time[windows.last] - time[windows.first]
    if found is None:
        if plain <= 0.2:
            return None
        offset = _offset(change, other, lasting, 0.5 * plain) if what == "velocity" else None
        return offset or _late(windows, joint, time, integral, pieces, 0.5 * plain)
    if np.ptp(rate[:, joint]) == 0.0:
        return (
            f"it is {rate[0, joint] + 0.0:g} in all rows, and the motion is as fast as "
            f"{np.abs(change / lasting).max():.3g}; the driver may never fill it"
        )
    where, some = found
    slope, _ = _slope(change[some], other[some])
    if not where and slope != 0.0 and _deviation(change, other, slope) <= _FITS:
        return _scale(slope, what)
    return (
        _other_column(windows, joint, integral, names)
        or _offset(change, other, lasting, 0.5 * plain)
        or _late(windows, joint, time, integral, pieces, _FITS)
        or f"it does not follow the motion{where} (slope {slope + 0.0:.2g} instead of 1)"
    )


def _scale(slope: float, what: str) -> str:
    """Name the unit that explains the slope."""
    for factor, words in _UNITS[what].items():
        for sign in (1.0, -1.0):
            if abs(slope / (sign * factor) - 1.0) <= _NEAR:
                opposite = " and of opposite sign" if sign < 0.0 and factor != -1.0 else ""
                return f"it is {slope:.4g} times the derivative, as if {words}{opposite}"
    motor = "; it may be that of the motor, before the gear, or in another unit" if abs(slope) > 1.0 else ""
    return f"it is {slope:.4g} times the derivative{motor or '; it may be in another unit'}"


def _other_column(windows: _Windows, joint: int, integral: np.ndarray, names: Sequence[str]) -> str | None:
    """Name another joint whose column fits."""
    fits = {
        other: _deviation(windows.change, windows.of(integral[:, other]))
        for other in range(len(names))
        if other != joint
    }
    best = min(fits, key=lambda other: fits[other], default=None)
    if best is None or fits[best] > _FITS:
        return None
    return f"the column of {names[best]!r} fits it, so the columns may be in another order"


def _unsigned(change: np.ndarray, other: np.ndarray) -> str | None:
    """Detect a speed without sign."""
    falls, other = change < 0.0, other if other.sum() >= 0.0 else -other
    back = np.abs(change[falls]).sum() / np.abs(change).sum()
    if not 0.1 <= back <= 0.9 or (other < 0.0).any():
        return None
    # The median of all does not show how it deviates where the joint mostly moves one way.
    if any(_deviation(np.abs(change[some]), other[some]) > _FITS for some in (falls, ~falls)):
        return None
    return "it is a speed without sign"


def _offset(change: np.ndarray, other: np.ndarray, lasting: np.ndarray, enough: float) -> str | None:
    """Find a constant offset without which the deviation is below ``enough``."""
    apart = (other - change) / lasting
    offset = float(np.median(apart))
    error = 1.2533**2 * np.mean(np.abs(apart - offset)) / np.sqrt(len(apart))
    if abs(offset) <= _ERRORS * error or _deviation(change, other - offset * lasting) >= enough:
        return None
    return f"it is {abs(offset):.2g} too {'high' if offset > 0.0 else 'low'} in all rows"


def _late(
    windows: _Windows, joint: int, time: np.ndarray, integral: np.ndarray, pieces: Sequence[slice], enough: float
) -> str | None:
    """Find a delay with which the deviation is below ``enough``, and lower in most windows."""
    column = integral[:, joint]
    ends = np.concatenate([np.full(rows.stop - rows.start, time[rows.stop - 1]) for rows in pieces])
    starts = np.concatenate([np.full(rows.stop - rows.start, time[rows.start]) for rows in pieces])
    # The same windows for all delays.
    windows = windows.at(
        (time[windows.first] - _LATEST >= starts[windows.first]) & (time[windows.last] + _LATEST <= ends[windows.first])
    )
    if len(windows.change) < _FEWEST:
        return None
    step = float(np.median(np.diff(time)))
    delays = np.linspace(-_LATEST, _LATEST, 101)
    missed = np.abs(
        [
            np.interp(time[windows.last] + delay, time, column)
            - np.interp(time[windows.first] + delay, time, column)
            - windows.change
            for delay in delays
        ]
    )  # (n_delays, n_windows)
    found = np.median(missed, axis=1) / np.median(np.abs(windows.change))
    # Several delays fit a periodic motion equally well. The shortest is chosen.
    lowest = (found <= np.r_[np.inf, found[:-1]]) & (found <= np.r_[found[1:], np.inf])
    lowest &= found <= found.min() + _ALIAS
    best = min(np.flatnonzero(lowest).tolist(), key=lambda one: abs(delays[one]))
    delay = float(delays[best])
    better = np.mean(missed[best] < missed[len(delays) // 2])
    if (
        found[best] >= enough
        or abs(delay) < max(_LATE, 2.0 * step)
        or better <= 0.5 + 0.5 * _BETTER / np.sqrt(len(windows.change))
    ):
        return None
    return f"it is {abs(delay):.2g} s {'late' if delay > 0.0 else 'early'}"


def _differenced(time: np.ndarray, position: np.ndarray, rate: np.ndarray, wrapped: np.ndarray) -> str | None:
    """Detect a velocity that was computed from the wrapped angle: it jumps where the angle does."""
    steps = np.flatnonzero(wrapped)
    if not len(steps):
        return None
    fast = np.maximum(np.abs(rate[steps]), np.abs(rate[steps + 1]))
    ordinary = np.abs(np.diff(position)) / np.diff(time)
    usual = np.maximum(ordinary.max(), np.quantile(np.abs(rate), 0.5))
    if np.mean(fast > 5.0 * usual) < 0.5:
        return None
    return f"it is {fast.max():.3g} where the angle wraps, as if it were differences of the wrapped angle"
