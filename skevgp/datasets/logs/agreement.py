"""Whether a recorded velocity is the derivative of the recorded position; if not, what it seems to be.

The integral of the velocity is compared with the change of position, in windows so long that the change is far above
the noise and the resolution of the position. The slope of one over the other is 1 if they agree, however noisy the
velocity is, and it has a standard error: a velocity is refused only where its slope is clearly another one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_SHORTEST, _LONGEST = 4, 0.5  # of windows: steps, and s
_FEWEST = 12  # windows in which the joint moves, or nothing is said
_NOISES = 10.0  # a window's change of position, in standard deviations of its noise
_SLOWEST = {"velocity": 0.02, "acceleration": 0.2}  # per s, or per s²: drivers round what is slower to 0
_AGREES = (2.0 / 3.0, 1.5)  # slopes that are no contradiction
_ERRORS = 6.0  # standard errors that a slope is away from 1, at least
_FITS = 0.3  # median deviation over median change: less is a cause that explains the signal
_LATE, _LATEST = 0.03, 0.5  # s: delays that matter, and those that are looked for
_CHANCE = 1.5  # three standard deviations of the share of windows, were each as likely as not
_ALIKE = 0.05  # deviations that differ by less are no reason to prefer one delay to another
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
    """Where a joint moves: the change of its position, and that of the other signal's integral."""

    first: np.ndarray  # rows
    last: np.ndarray
    change: np.ndarray  # (k,)

    def of(self, integral: np.ndarray) -> np.ndarray:
        return integral[self.last] - integral[self.first]


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
    """Refuse a recorded derivative that contradicts what it is the derivative of.

    Parameters
    ----------
    time : ndarray of shape (n,)
        Ascending, s.
    position, rate : ndarray of shape (n, n_joints)
        A continuous signal within pieces, and its recorded derivative.
    pieces : sequence of slice
        Rows between gaps.
    names : sequence of str
        Of the joints.
    slowest : float
        Slower motion counts as rest, per s.
    wrapped : ndarray of shape (n - 1, n_joints) of bool
        Steps at which the recorded position wrapped.
    what : {"velocity", "acceleration"}
        Name of ``rate``.

    Raises
    ------
    ValueError
        If it contradicts. The message names each such joint and the likely cause.
    """
    integral = np.zeros_like(rate)
    integral[1:] = np.cumsum((rate[1:] + rate[:-1]) / 2.0 * np.diff(time)[:, np.newaxis], axis=0)
    if not (np.isfinite(integral).all() and np.isfinite(np.ptp(position, axis=0)).all()):
        return  # numbers that overflow are told where they are filtered
    floor = max(2.0 * slowest if what == "velocity" else 0.0, _SLOWEST[what])
    causes, steps = {}, [_resolution(column) for column in rate.T]
    rounding = min((step for step in steps if step > 0.0), default=0.0)
    for joint, name in enumerate(names):
        # A joint so slow that the driver rounds it to 0 throughout shows what it rounds to in other joints only.
        slow = max(floor, 0.0 if steps[joint] > 0.0 else 2.0 * rounding)
        windows = _moving(time, position[:, joint], rate[:, joint], integral[:, joint], pieces, slow)
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


def _moving(
    time: np.ndarray,
    position: np.ndarray,
    rate: np.ndarray,
    integral: np.ndarray,
    pieces: Sequence[slice],
    floor: float,
) -> _Windows | None:
    """The shortest windows in which enough motion is well above the noise; None if there are none.

    In half of them or more the integral moves too, if longer ones can have that: differences of a coarse position are 0
    in most rows.
    """
    step = float(np.median(np.diff(time)))
    noise = _noise(time, position, pieces)
    length, found = _SHORTEST, None
    while True:
        ends = [_windows(time[rows], rows.start, length) for rows in pieces]
        first, last = (np.concatenate(each) for each in zip(*ends, strict=True))
        change = position[last] - position[first]
        speed = np.abs(change) / (time[last] - time[first])
        # A velocity in coarse units is 0 in slow motion.
        coarse = min(2.0 * _resolution(rate), 0.5 * np.quantile(speed, 0.9)) if len(speed) else 0.0
        moves = (np.abs(change) > _NOISES * noise) & (speed > max(floor, coarse))
        if moves.sum() >= _FEWEST:
            found = _Windows(first[moves], last[moves], change[moves])
            if np.median(np.abs(found.of(integral))) > 0.0 or not rate.any():
                return found
        length *= 2
        if length * step > _LONGEST:
            return found


def _windows(time: np.ndarray, start: int, length: int) -> tuple[np.ndarray, np.ndarray]:
    """First and last rows of windows of so many steps, and of nearly as many mean ones: stamps may come in bursts."""
    first = np.arange(0, max(0, len(time) - length), length)
    if not len(first):
        return first, first
    least = time[first] + (length - 0.5) * (time[-1] - time[0]) / (len(time) - 1)
    last = np.maximum(first + length, np.searchsorted(time, least))
    inside = last < len(time)
    return start + first[inside], start + last[inside]


def _resolution(values: np.ndarray) -> float:
    sizes = np.abs(np.diff(values))
    return float(sizes[sizes > 0.0].min()) if sizes.any() else 0.0


def _noise(time: np.ndarray, position: np.ndarray, pieces: Sequence[slice]) -> float:
    """Standard deviation, of what lines through two neighbours leave; not below that of rounding to the resolution."""
    left = []
    for rows in pieces:
        t, q = time[rows], position[rows]
        if len(t) > 2:
            part = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
            left.append((q[1:-1] - (1.0 - part) * q[:-2] - part * q[2:]) / np.sqrt(1.0 + part**2 + (1.0 - part) ** 2))
    scatter = 1.4826 * float(np.median(np.abs(np.concatenate(left)))) if left else 0.0
    return max(scatter, _resolution(position) / np.sqrt(12.0))


def _slope(change: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Of a line through 0 by least absolute deviations, with its standard error."""
    ratio, weight = other / change, np.abs(change)
    order = np.argsort(ratio)
    middle = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    slope = float(ratio[order][min(middle, len(ratio) - 1)])
    scale = 1.4826 * np.median(np.abs(other - slope * change))
    return slope, float(1.2533 * scale / np.sqrt((change**2).sum()))


def _deviation(change: np.ndarray, other: np.ndarray, slope: float = 1.0) -> float:
    """Median deviation from the line, relative to the median change."""
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
    """What a contradicting signal seems to be; None if it agrees."""
    change, other = windows.change, windows.of(integral[:, joint])
    # The median of what it deviates does not show it where the joint mostly moves one way.
    if unsigned := _unsigned(change, other):
        return unsigned
    fastest = np.abs(change / (time[windows.last] - time[windows.first])).max()
    slope, error = _slope(change, other)
    plain = _deviation(change, other)
    if _AGREES[0] <= slope <= _AGREES[1] or abs(slope - 1.0) <= _ERRORS * error:
        if plain <= 0.2:
            return None
        return _late(windows, joint, time, integral, pieces, 0.5 * plain)
    if np.ptp(rate[:, joint]) == 0.0:
        return (
            f"it is {rate[0, joint] + 0.0:g} in all rows, and the motion is as fast as {fastest:.3g}; the driver may "
            "never fill it"
        )
    if slope != 0.0 and _deviation(change, other, slope) <= _FITS:
        return _scale(slope, what)
    return (
        _other_column(windows, joint, integral, names)
        or _late(windows, joint, time, integral, pieces, _FITS)
        or f"it does not follow the motion (slope {slope:.2g} instead of 1)"
    )


def _scale(slope: float, what: str) -> str:
    for factor, words in _UNITS[what].items():
        for sign in (1.0, -1.0):
            if abs(slope / (sign * factor) - 1.0) <= _NEAR:
                opposite = " and of opposite sign" if sign < 0.0 and factor != -1.0 else ""
                return f"it is {slope:.4g} times the derivative, as if {words}{opposite}"
    motor = "; it may be that of the motor, before the gear, or in another unit" if abs(slope) > 1.0 else ""
    return f"it is {slope:.4g} times the derivative{motor or '; it may be in another unit'}"


def _other_column(windows: _Windows, joint: int, integral: np.ndarray, names: Sequence[str]) -> str | None:
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
    back = np.abs(change[change < 0.0]).sum() / np.abs(change).sum()
    if (
        not 0.1 <= back <= 0.9
        or (other * np.sign(other.sum()) < 0.0).any()
        or _deviation(np.abs(change), other) > _FITS
    ):
        return None
    return "it is a speed without sign"


def _late(
    windows: _Windows, joint: int, time: np.ndarray, integral: np.ndarray, pieces: Sequence[slice], enough: float
) -> str | None:
    """A delay with which the deviation falls below ``enough``."""
    column = integral[:, joint]
    ends = np.concatenate([np.full(rows.stop - rows.start, time[rows.stop - 1]) for rows in pieces])
    starts = np.concatenate([np.full(rows.stop - rows.start, time[rows.start]) for rows in pieces])
    step = float(np.median(np.diff(time)))
    delays = np.linspace(-_LATEST, _LATEST, 101)

    def moved(delay: float) -> tuple[np.ndarray, np.ndarray]:
        first, last = time[windows.first] + delay, time[windows.last] + delay
        inside = (first >= starts[windows.first]) & (last <= ends[windows.first])
        return inside, np.interp(last[inside], time, column) - np.interp(first[inside], time, column)

    found = []
    for delay in delays:
        inside, other = moved(delay)
        enough_windows = len(other) >= _FEWEST
        found.append(_deviation(windows.change[inside], other) if enough_windows else np.inf)
    # Periodic motion fits at whole periods, too: the shortest of the delays that fit about as well as the best.
    padded = np.pad(found, 1, constant_values=np.inf)
    lowest = (padded[1:-1] <= padded[:-2]) & (padded[1:-1] <= padded[2:]) & (padded[1:-1] <= min(found) + _ALIKE)
    best = min(np.flatnonzero(lowest).tolist(), key=lambda index: abs(delays[index]))
    delay = float(delays[best])
    if found[best] >= enough or abs(delay) < max(_LATE, 2.0 * step):
        return None
    # Of so many delays one fits by chance: it has to fit better than none in clearly more than half of the windows.
    inside, other = moved(delay)
    now = windows.of(column)[inside]
    better = np.abs(windows.change[inside] - other) < np.abs(windows.change[inside] - now)
    if better.mean() < 0.5 + _CHANCE / np.sqrt(len(better)):
        return None
    return f"it is {abs(delay):.2g} s {'late' if delay > 0.0 else 'early'}"


def _differenced(time: np.ndarray, position: np.ndarray, rate: np.ndarray, wrapped: np.ndarray) -> str | None:
    """A velocity that was computed from the wrapped angle jumps where that does."""
    steps = np.flatnonzero(wrapped)
    if not len(steps):
        return None
    fast = np.maximum(np.abs(rate[steps]), np.abs(rate[steps + 1]))
    ordinary = np.abs(np.diff(position)) / np.diff(time)
    usual = np.maximum(ordinary.max(), np.quantile(np.abs(rate), 0.5))
    if np.mean(fast > 5.0 * usual) < 0.5:
        return None
    return f"it is {fast.max():.3g} where the angle wraps, as if it were differences of the wrapped angle"
