"""Refuse a log with the messages of two nodes: positions leap back and forth between two levels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .jumps import DEGREES, RADIANS, Wish
from .recording import Signals

_ROWS = 6  # of a window
_APART = 4.0  # the two levels of a window are so many times apart than what lies within one of them
_COUNTS = 10.0  # ... and so many times the resolution of the positions
_SHARE, _FEWEST = 0.1, 5  # of windows, and number of windows
_STRONGEST = 1e3  # rad/s²: what a motor could do is motion
_NEAR = 0.02  # of a period: levels that are so near to a whole number of periods are one angle


def check_publishers(rows: Signals, numbers: np.ndarray, names: Sequence[str], wrap: Sequence[Wish], hint: str) -> None:
    """Raise if positions leap back and forth; rows are in order, with all rows of one time, and have these numbers.

    `hint` says how to choose one publisher.
    """
    n_windows = len(rows.time) // _ROWS
    if n_windows < _FEWEST:
        return
    step = float(np.median(np.diff(rows.time)))
    for joint, name in enumerate(names):
        if wrap[joint] is False:
            continue
        position = rows.position[:, joint]
        windows = position[: n_windows * _ROWS].reshape(n_windows, _ROWS)
        sizes = np.abs(np.diff(position))
        least = max(
            _COUNTS * float(sizes[sizes > 0.0].min(initial=np.inf)),
            0.25 * _STRONGEST * max(1.0, float(np.ptp(np.quantile(position, [0.05, 0.95]))) / RADIANS) * step**2,
        )
        ordered = np.sort(windows, axis=1)
        each, split = np.arange(n_windows), np.argmax(np.diff(ordered, axis=1), axis=1)
        low, high = ordered[each, split], ordered[each, split + 1]
        within = np.maximum(low - ordered[:, 0], ordered[:, -1] - high)
        is_high = windows > ((low + high) / 2.0)[:, np.newaxis]
        switches = np.count_nonzero(np.diff(is_high, axis=1), axis=1)
        leaps = (high - low > np.maximum(_APART * within, least)) & (switches > 1)
        for period in {RADIANS, DEGREES, float(wrap[joint])} if isinstance(wrap[joint], float) else {RADIANS, DEGREES}:
            turns = (high - low) / period
            leaps &= (np.round(turns) == 0.0) | (np.abs(turns - np.round(turns)) > _NEAR)
        if leaps.sum() < max(_FEWEST, _SHARE * n_windows):
            continue
        window = int(np.argmax(leaps))
        at = window * _ROWS + int(np.argmax(np.diff(is_high[window])))
        one, other = (f"{position[row]:.4g} in row {numbers[row]}" for row in (at, at + 1))
        same = rows.time[at] == rows.time[at + 1]
        raise ValueError(
            f"positions of joint {name!r} leap back and forth between two levels in {leaps.mean():.0%} of the record, "
            f"first from {one} to {other}{', of the same time' if same else ''}. Several nodes may publish on one "
            f"topic. {hint} Positions that really move like this are taken as they are with wrap=False."
        )
