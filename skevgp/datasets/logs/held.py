"""Find frames that a driver repeats while the joint moves.

All signals of a joint then stay exactly the same for several rows, and go on where they would be without the repeats.
At rest they may stay the same, too. Three signs tell motion, each of which is enough:

* The position leaps after the repeats, by far more than in the steps next to them.
* The recorded velocity changes across the repeats about as fast as before and after them.
* The recorded velocity is that before the repeats, while the position stays.

A sensor that is slower than the log repeats all frames. This is no fault: a frame is compared with the usual one.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .recording import Signals
from .signals import whole_steps

_LONGER = 6  # times as many rows as the usual frame
_MOST = 10  # steps before the repeats that give the speed
_SIDE = 3  # steps on each side with which a leap is compared
_LEAP = 3.0  # times the largest of them
_FACTOR = 2.0  # rates that differ by less are about the same
_COUNTS = 5.0  # times the resolution of a signal: smaller changes say nothing


def find_held(raw: Signals, gap: float) -> list[tuple[int, int, int]]:
    """Return the frame that is repeated, the first row after its repeats, and the joint."""
    whole = whole_steps(raw.time, gap)
    found = []
    for joint in range(raw.position.shape[1]):
        same = whole.copy()
        for name, signal in vars(raw).items():
            if name != "time" and signal is not None:
                same &= signal[1:, joint] == signal[:-1, joint]
        edges = np.r_[0, np.flatnonzero(~same) + 1, len(raw.time)]
        lasting = np.diff(edges)
        long = lasting >= _LONGER * max(1.0, float(np.median(lasting)))
        # Gaps end the rows that are compared.
        pieces = np.r_[0, np.flatnonzero(~whole) + 1, len(raw.time)]
        velocity = None if raw.velocity is None else raw.velocity[:, joint]
        found += [
            (first, after, joint)
            for first, after in zip(edges[:-1][long].tolist(), edges[1:][long].tolist(), strict=True)
            if _moves(raw.time, raw.position[:, joint], velocity, first, after, pieces)
        ]
    return found


def _moves(
    time: np.ndarray, position: np.ndarray, velocity: np.ndarray | None, first: int, after: int, pieces: np.ndarray
) -> bool:
    """Whether the joint moves while the rows from `first` to the one before `after` are the same."""
    begin, end = (
        int(pieces[np.searchsorted(pieces, first, side="right") - 1]),
        int(pieces[np.searchsorted(pieces, after)]),
    )
    before = np.abs(np.diff(position[max(first - _SIDE, begin) : first + 1])).max(initial=0.0)
    if before == 0.0:
        return False
    if after < end:
        behind = np.abs(np.diff(position[after : min(after + _SIDE + 1, end)])).max(initial=0.0)
        if abs(position[after] - position[first]) > max(_LEAP * before, _LEAP * behind, _least(position)):
            return True
    if velocity is None:
        return False

    def rate(signal: np.ndarray, start: int, stop: int) -> float:
        start, stop = max(start, begin), min(stop, end - 1)
        return float((signal[stop] - signal[start]) / (time[stop] - time[start])) if stop > start else 0.0

    rows = after - first
    if after < end and abs(velocity[after] - velocity[first]) > _least(velocity):
        around = np.array([rate(velocity, first - rows, first), rate(velocity, after, after + rows)])
        if _is_between(rate(velocity, first, after), around):
            return True
    recorded = float(velocity[first])
    is_seen = abs(recorded) * (time[after - 1] - time[first]) > _least(position)
    return is_seen and _is_between(recorded, np.array([rate(position, first - min(rows, _MOST), first)]))


def _is_between(value: float, others: np.ndarray) -> bool:
    """Whether a value has the sign of the others, and is about as large or between them."""
    others = np.sign(value) * others
    return bool(0.0 < others.min() / _FACTOR <= abs(value) <= others.max() * _FACTOR)


def _least(signal: np.ndarray) -> float:
    """Return the least change of a signal that is motion."""
    sizes = np.abs(np.diff(signal))
    return _COUNTS * float(sizes[sizes > 0.0].min(initial=np.inf))


def rows_of(found: list[tuple[int, int, int]]) -> Iterator[tuple[int, int]]:
    """Yield the frames that are repeated and the first rows after them, of all joints together."""
    last: tuple[int, int] | None = None
    for first, after, _ in sorted(found):
        if last is not None and first < last[1]:
            last = (last[0], max(last[1], after))
            continue
        if last is not None:
            yield last
        last = (first, after)
    if last is not None:
        yield last
