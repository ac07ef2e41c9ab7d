"""Find velocities, accelerations and efforts that are corrupt: values that leave their neighbours and come back.

A corrupt value is far from the values before and after it, which agree with each other. Steps of a torque, friction at
a reversal and noise stay: a value must also be impossible. There are three reasons for this, each of which is enough:

* It is a velocity that the position contradicts, while the line between its neighbours agrees with the position.
* It is farther from its neighbours than all other values from each other.
* It is exactly 0, as a value that a driver does not fill, and farther from its neighbours than steps elsewhere.

An effort or an acceleration stays if the velocity leaps at the same time: it may be an impact. It also stays if
three or more last for more than one row: they are pulses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .jumps import Steps
from .recording import Signals
from .signals import Break, whole_steps

_LONGEST = {"velocity": 20, "acceleration": 3, "torque": 3}  # rows of a spike; positions show longer ones of velocities
_FARTHER = 1.5  # times the range of all other values
_LARGE = 0.25  # ... if the position contradicts a velocity: brakes shake it for one row
_FASTER = 4.0  # times the largest step elsewhere
_PULSES = 3  # spikes of an effort that last for more than one row: corrupt values are seldom next to each other
_AGREES = 0.25  # of the spike's integral: the change of position is so near to that without the spike
_USUAL = 4.0  # a spike's integral is so many times the usual deviation between velocity and position
_QUANTILE = 0.99  # of all deviations, which is the usual one


@dataclass(frozen=True)
class Corrupt:
    """Successive values of a joint that are corrupt."""

    where: Break
    signal: str
    joint: int
    worst: int  # the row that is farthest from its neighbours


def find_corrupt(raw: Signals, step: float, gap: float, breaks: Sequence[Break]) -> list[Corrupt]:
    """Find corrupt values in the pieces of a sorted recording."""
    steps, whole = np.diff(raw.time), whole_steps(raw.time, gap, breaks)
    found = []
    for joint, position in enumerate(raw.position.T):
        leaps = np.zeros(len(steps), dtype=bool)
        for signal, longest in _LONGEST.items():
            values = getattr(raw, signal)
            if values is None:
                continue
            of_joint = Steps(steps, whole, values[:, joint], step)
            spikes = _Spikes.of(raw.time, values[:, joint], of_joint, longest)
            impossible = spikes.impossible(position if signal == "velocity" else None)
            if signal == "velocity":
                leaps = of_joint.leaps()
            if signal != "velocity" and spikes.are_pulses(impossible):
                continue
            for k in impossible.tolist():
                before, after = spikes.rows[k]
                if signal == "velocity":
                    leaps[max(before, 0) : after] = False
                elif leaps[max(before - 1, 0) : after + 1].any():
                    continue
                found.append(Corrupt(Break(before, after, "corrupt"), signal, joint, spikes.worst[k]))
    return found


@dataclass(frozen=True)
class _Spikes:
    """Values of a signal that leave their neighbours and come back."""

    time: np.ndarray  # (n,)
    values: np.ndarray  # (n,)
    steps: Steps
    rows: list[tuple[int, int]]  # before and after each spike
    lines: list[np.ndarray]  # of each spike: the values of a line between its neighbours
    worst: list[int]  # the row of each spike that is farthest from the line

    def are_pulses(self, chosen: np.ndarray) -> bool:
        """Whether spikes, given by their indices, recur as pulses do."""
        return sum(after - before > 2 for before, after in (self.rows[k] for k in chosen.tolist())) >= _PULSES

    @classmethod
    def of(cls, time: np.ndarray, values: np.ndarray, steps: Steps, longest: int) -> _Spikes:
        found: list[tuple[int, int]] = []
        lines, worst = [], []
        for before, after in steps.spikes(longest):
            inside = np.arange(before + 1, after)
            ends = [row for row in (before, after) if 0 <= row < len(time)]
            if before >= 0 and after < len(time) and not steps.whole[before:after].all():
                # Next to a gap, only one neighbour is in the same piece.
                ends = [after] if not steps.whole[before] else [before]
            lines.append(np.interp(time[inside], time[ends], values[ends]))
            worst.append(int(inside[np.argmax(np.abs(values[inside] - lines[-1]))]))
            found.append((before, after))
        return cls(time, values, steps, found, lines, worst)

    @property
    def sizes(self) -> np.ndarray:
        """Return how far each spike is from its neighbours."""
        return np.array([np.abs(self._inside(at) - line).max() for at, line in zip(self.rows, self.lines, strict=True)])

    def _inside(self, rows: tuple[int, int]) -> np.ndarray:
        return self.values[rows[0] + 1 : rows[1]]

    def impossible(self, position: np.ndarray | None) -> np.ndarray:
        """Return which spikes are corrupt; `position` is the integral of the values, if there is one."""
        if not self.rows:
            return np.empty(0, dtype=np.intp)
        others = np.ones(len(self.values), dtype=bool)
        for before, after in self.rows:
            others[before + 1 : after] = False
        rest = self.values[others]
        far = self.sizes > _FARTHER * np.ptp(rest) if len(rest) else np.zeros(len(self.rows), dtype=bool)
        unfilled = self._unfilled()
        if position is None:
            return np.flatnonzero(far | unfilled)
        contradicted, confirmed = self._compared(position, others)
        empty = np.array([not self._inside(rows).any() for rows in self.rows])
        contradicted &= empty | (self.sizes > _LARGE * np.ptp(rest) if len(rest) else False)
        return np.flatnonzero(contradicted | ((far | unfilled) & ~confirmed))

    def _unfilled(self) -> np.ndarray:
        """Return which spikes are exactly 0, and farther from their neighbours than steps elsewhere."""
        none = np.array([not self._inside(rows).any() and self._has_neighbours(rows) for rows in self.rows])
        elsewhere = self.steps.whole.copy()
        for (before, after), one in zip(self.rows, none, strict=True):
            if one:
                elsewhere[before:after] = False
        speeds = np.abs(self.steps.d) / self.steps.lasting
        reached = np.array([speeds[max(before, 0) : after].max() for before, after in self.rows])
        return none & (reached > _FASTER * speeds[elsewhere].max(initial=0.0))

    def _has_neighbours(self, rows: tuple[int, int]) -> bool:
        before, after = rows
        return before >= 0 and after < len(self.values) and bool(self.steps.whole[before:after].all())

    def _compared(self, position: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which spikes the position contradicts, and which it confirms."""
        integral = np.r_[0.0, np.cumsum((self.values[1:] + self.values[:-1]) / 2.0 * np.diff(self.time))]
        contradicted, confirmed = np.zeros(len(self.rows), dtype=bool), np.zeros(len(self.rows), dtype=bool)
        usual: dict[int, float] = {}
        for k, (rows, line) in enumerate(zip(self.rows, self.lines, strict=True)):
            if not self._has_neighbours(rows):
                continue
            between = slice(rows[0], rows[1] + 1)
            time, recorded = self.time[between], self.values[between]
            mended = np.r_[recorded[0], line, recorded[-1]]
            change = position[rows[1]] - position[rows[0]]
            by_record, by_line = np.trapezoid(recorded, time), np.trapezoid(mended, time)
            length = rows[1] - rows[0]
            if length not in usual:
                usual[length] = self._deviation(position, integral, others, length)
            spike = abs(by_record - by_line)
            contradicted[k] = abs(change - by_line) <= _AGREES * spike and spike > _USUAL * usual[length]
            confirmed[k] = abs(change - by_record) < abs(change - by_line)
        return contradicted, confirmed

    def _deviation(self, position: np.ndarray, integral: np.ndarray, others: np.ndarray, length: int) -> float:
        """Return the usual deviation of the integral from the position in windows of so many steps without a spike."""
        good = np.r_[0, np.cumsum(~(others[1:] & others[:-1] & self.steps.whole))]
        fine = good[length:] == good[:-length]
        missed = np.abs((position[length:] - position[:-length]) - (integral[length:] - integral[:-length]))[fine]
        return float(np.quantile(missed, _QUANTILE)) if len(missed) else np.inf
