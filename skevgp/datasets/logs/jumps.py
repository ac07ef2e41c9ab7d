"""Find jumps of positions: an angle that wraps is unwrapped, any other jump cuts the record.

A jump is a step between two rows that differs from the steps before and after it. Three questions decide about it. None
uses the recorded velocity, which a driver may have computed from the same wrapped angles:

* Does the step equal a whole number of periods (2π or 360) plus the step that its neighbours predict?
* Is it far beyond the fastest step elsewhere, or do all positions lie within one period, as those of an encoder do that
  starts again?
* Does it stand alone? Motion that the rows resolve has at least one more step in the same direction next to it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np

from ...robots import layout_of, load_robot
from ...robots.loading import named_system
from ...utils.validation import check_real
from .signals import Break, merged, whole_steps

RADIANS, DEGREES = 2.0 * np.pi, 360.0
_SIDE = 3  # neighbours on each side of a step that predict it
_FEWEST = 3  # neighbours that a step needs; with fewer it is no jump
# A wrap's step, without its periods, may differ from the prediction by this part of a period, plus twice the largest
# deviation of a neighbour from the prediction.
_LOOSE, _TIGHT = 0.02, 0.002
_FASTER = 4.0  # a jump is so many times the fastest step elsewhere
_LONELY = 8.0  # ... and so many times what its neighbours deviate in its direction
_COUNTS = 50.0  # ... and so many times the resolution of the positions
_FEW_COUNTS = 10.0  # ... or of velocities and efforts
_SMOOTH = 0.125  # of a period: 95 % of steps are predicted better than that where an angle is sampled well
_STRONGEST = 1e3  # rad/s²: a step that a motor could make between two rows is no jump
_RANGE = 0.9  # share of positions that gives their range; above a turn, units may be degrees or mm, with larger steps
_SPIKE = 3  # rows that are away and come back, at most
_MOST = 0.02  # above this share of lone steps, the joint really moves in steps
_BINS = 16  # of the positions' range; an angle that turned several times, there and back, was in most of them
_UNLIMITED = 1e10  # limits beyond it are none

Kind = str  # "any", "turns" (revolute without limits) or "bounded" (prismatic, or with limits)
Wish = bool | float | str  # True, False, "auto" or a period


@dataclass(frozen=True)
class Jumps:
    """Unwrapped positions of a recording, and where they jump."""

    position: np.ndarray  # (n, n_joints), unwrapped
    wraps: list[int]  # per joint: how many jumps were unwrapped
    periods: list[float | None]  # of each joint; None if it was not unwrapped
    cuts: list[Break]  # at jumps of another size
    wrapped: np.ndarray  # (n - 1, n_joints) of bool: the steps that were unwrapped


def check_wrap(wrap: Any) -> None:
    """Check the argument `wrap` before the joints are known."""
    if isinstance(wrap, Mapping):
        for key, one in wrap.items():
            if not isinstance(key, str):
                raise TypeError(f"wrap must have names of joints as keys; got {key!r}.")
            _check_wish(one, f"wrap[{key!r}]")
    elif isinstance(wrap, (list, tuple, np.ndarray)):
        for index, one in enumerate(wrap):
            _check_wish(one, f"wrap[{index}]")
    else:
        _check_wish(wrap, "wrap")


def wishes(wrap: Any, names: Sequence[str]) -> list[Wish]:
    """Return True, False, "auto" or a period for each joint."""
    if isinstance(wrap, Mapping):
        unknown = sorted(set(wrap) - set(names))
        if unknown:
            raise ValueError(f"wrap names {unknown}, which are not among the joints {list(names)}.")
        return [_plain(wrap.get(name, "auto")) for name in names]
    if isinstance(wrap, (list, tuple, np.ndarray)):
        if len(wrap) != len(names):
            raise ValueError(f"wrap must have one value for each of the {len(names)} joints; got {wrap!r}.")
        return [_plain(one) for one in wrap]
    return [_plain(wrap)] * len(names)


def _check_wish(one: Any, name: str) -> None:
    if isinstance(one, (bool, np.bool_)) or (isinstance(one, str) and one == "auto"):
        return
    if not isinstance(one, Real):
        kind = ValueError if isinstance(one, str) else TypeError
        raise kind(f'{name} must be "auto", True, False or a period above 0; got {one!r}.')
    check_real(one, name, minimum=0.0, strict=True)


def _plain(one: Any) -> Wish:
    return one if isinstance(one, str) else bool(one) if isinstance(one, (bool, np.bool_)) else float(one)


def kinds_of(robot: Any, names: Sequence[str], named: bool) -> list[Kind]:
    """Find which joints of a log can turn without end; joints are matched by order if the names are not `named`."""
    if robot is None:
        return ["any"] * len(names)
    if named_system(robot) is not None:
        layout = layout_of(robot)
        known = dict(zip(layout.position_names, layout.revolute, strict=True))
    else:
        model = load_robot(robot)
        layout = layout_of(model)
        free = (np.asarray(model.lowerPositionLimit) < -_UNLIMITED) & (model.upperPositionLimit > _UNLIMITED)
        turning = [bool(turns and one) for turns, one in zip(layout.revolute, free, strict=True)]
        known = dict(zip(layout.position_names, turning, strict=True))
    if named and set(names) <= set(known):
        return ["turns" if known[name] else "bounded" for name in names]
    if len(names) != len(known):
        raise ValueError(
            f"The joints of robot are {list(known)}, but those of the log are {list(names)}. Name the joints of the "
            "log by joints=[...]. If only some joints were recorded, pass robot=load_robot(robot, joints=[...]), "
            "which locks the others."
        )
    return ["turns" if turns else "bounded" for turns in known.values()]


def find_jumps(
    time: np.ndarray,
    position: np.ndarray,
    step: float,
    gap: float,
    asked: Sequence[Wish],
    kinds: Sequence[Kind],
    known: Sequence[Break] = (),
) -> Jumps:
    """Unwrap angles, and find the jumps that are no wraps; `known` are breaks that were found before.

    Across a gap, or a jump that is no wrap, the turn of an unwrapped angle is unknown: the next piece begins at the
    turn that is nearest to the end of the last one.
    """
    steps = np.diff(time)
    whole = whole_steps(time, gap, known)
    columns = [Steps(steps, whole, column, step) for column in position.T]
    resolutions = [column.resolution for column in columns]
    periods = _periods(columns, asked, kinds)
    done, wraps, broken = np.array(position, dtype=np.float64), [], []
    wrapped = np.zeros((len(steps), len(columns)), dtype=bool)
    for joint, column in enumerate(columns):
        period = periods[joint]
        turns = (
            np.zeros(len(steps))
            if period is None
            else column.turns(period, _how(asked[joint], kinds[joint], column, period))
        )
        wrapped[:, joint] = turns != 0.0
        wraps.append(int(wrapped[:, joint].sum()))
        if wraps[-1]:
            assert period is not None
            column = column.unwrapped(turns * period)
        # A joint that never moves has no resolution of its own.
        found = [] if asked[joint] is False else column.lone(resolutions[joint] or max(resolutions))
        broken.extend(found)
        if wraps[-1]:
            assert period is not None
            free = ~whole
            for before, after in found:
                free[before:after] = True
            across = np.round(column.d / period)
            turns = turns + np.where(free, across, 0.0)
            done[1:, joint] -= period * np.cumsum(turns)
    return Jumps(
        done,
        wraps,
        [period if count else None for period, count in zip(periods, wraps, strict=True)],
        merged([Break(*rows, "jump") for rows in broken], _SPIKE - 2),
        wrapped,
    )


def _how(asked: Wish, kind: Kind, column: Steps, period: float) -> str:
    """Return how much evidence of a wrap is needed: little if the user gives a period, or asks to unwrap.

    Positions that exceed one period may be in another unit. Then each of their steps looks like several periods.
    """
    if asked is True:
        return "forced" if np.ptp(column.position) <= (1.0 + _LOOSE) * period else "turns"
    return "forced" if isinstance(asked, float) else "turns" if kind == "turns" else "any"


def _periods(columns: Sequence[Steps], asked: Sequence[Wish], kinds: Sequence[Kind]) -> list[float | None]:
    """Return the period of each joint that may be unwrapped; all joints of a log have the same unit."""
    wanted = [one is True or (one == "auto" and kind != "bounded") for one, kind in zip(asked, kinds, strict=True)]
    degrees = any(
        wish and column.turns(DEGREES, _how(one, kind, column, DEGREES)).any()
        for wish, column, one, kind in zip(wanted, columns, asked, kinds, strict=True)
    )
    common = DEGREES if degrees else RADIANS
    return [
        one if isinstance(one, float) else common if wish else None for one, wish in zip(asked, wanted, strict=True)
    ]


class Steps:
    """The steps of one joint."""

    def __init__(self, steps: np.ndarray, whole: np.ndarray, position: np.ndarray, step: float):
        self.steps = steps  # (n - 1,), of time, s
        self.whole = whole  # (n - 1,) of bool: no gap
        self.position = position  # (n,)
        self.step = step  # the median step of time, s
        self.d = np.diff(position)
        # Stamps that come in bursts make steps of time short, so that joints seem fast.
        self.lasting = np.maximum(steps, step)

    @property
    def resolution(self) -> float:
        sizes = np.abs(self.d[self.whole])
        return float(sizes[sizes > 0.0].min(initial=np.inf)) if (sizes > 0.0).any() else 0.0

    def unwrapped(self, jumps: np.ndarray) -> Steps:
        """Subtract these jumps from the steps."""
        position = self.position - np.r_[0.0, np.cumsum(jumps)]
        return Steps(self.steps, self.whole, position, self.step)

    def turns(self, period: float, how: str) -> np.ndarray:
        """Count the periods in each step; 0 for motion.

        `how` is the evidence that a wrap needs: the most for "any" joint, less for one that "turns" without end, and
        little if it is "forced".
        """
        none = np.zeros(len(self.d))
        whole = self.whole
        if not (np.abs(self.d[whole]) > 0.5 * period).any():
            return none
        rest = self.d - period * np.round(self.d / period)
        middle, deviation = self._neighbours(rest)
        expected = middle * self.steps
        turns = np.where(whole, np.round((self.d - np.nan_to_num(expected)) / period), 0.0)
        rest = self.d - period * turns
        error = np.abs(rest - expected)
        jumps = whole & (turns != 0.0)
        if how == "forced":
            return np.where(jumps & ((error <= 0.25 * period) | np.isnan(error)), turns, 0.0)
        known = whole & np.isfinite(error)
        jumps &= known
        spread = 2.0 * deviation * self.lasting
        if not jumps.any():
            return none
        loose = jumps & (error <= np.minimum(_LOOSE * period + spread, _SMOOTH * period))
        if self._goes_to_and_fro(turns[loose]):
            loose &= np.abs(turns) == 1.0
        if self._starts_again(period, turns, loose) and np.quantile(error[known], 0.95) <= _SMOOTH * period:
            return np.where(loose, turns, 0.0)
        # A turn that was lost may be anywhere. It counts only among slow steps.
        alone = self._share(turns == 0.0) >= 0.5
        others = whole & ~(loose & alone)
        for before, after in self.lone(self.resolution):
            others[before:after] = False
        fastest = (np.abs(self.d) / self.lasting)[others].max(initial=0.0)
        fast = np.abs(self.d) > _FASTER * fastest * self.lasting
        tight = loose & (error <= (_LOOSE if how == "turns" else _TIGHT) * period + spread)
        return np.where(tight & alone & fast, turns, 0.0)

    def _goes_to_and_fro(self, turns: np.ndarray) -> bool:
        """Whether jumps of several turns lead there and back with few positions between, as between two states."""
        several = turns[np.abs(turns) > 1.0]
        if not ((several > 0.0).any() and (several < 0.0).any()):
            return False
        visited = np.histogram(self.position, _BINS)[0] > 0
        return bool(visited.mean() <= 0.5)

    def _starts_again(self, period: float, turns: np.ndarray, jumps: np.ndarray) -> bool:
        """Whether all jumps have one size, and all positions lie within it."""
        sizes = np.unique(np.abs(turns[jumps]))
        if len(sizes) != 1:
            return False
        reach = np.ptp(self.position)
        return bool(reach <= (1.0 + _LOOSE) * sizes[0] * period)

    def lone(self, resolution: float) -> list[tuple[int, int]]:
        """Return the last row before each jump and the first row after it."""
        lone, error = self._lonely(_COUNTS * resolution)
        size = np.abs(error)
        if lone.any():
            low, high = np.quantile(self.position, [0.5 - _RANGE / 2.0, 0.5 + _RANGE / 2.0])
            lone &= 4.0 * size > _STRONGEST * max(1.0, (high - low) / RADIANS) * self.lasting**2
        speed = np.abs(self.d) / self.lasting
        while lone.any():
            rest = speed[self.whole & ~lone].max(initial=0.0)
            slower = lone & (size <= _FASTER * rest * self.lasting)
            if not slower.any():
                break
            lone &= ~slower
        # No jump is returned if the joint moves only in such steps.
        groups = self._grouped(np.flatnonzero(lone), _SPIKE)
        away = sum(not _returns(error[group]) for group in groups)
        if away > max(4, _MOST * np.count_nonzero(self.d)):
            return []
        return [(group[0], group[-1] + 1) for group in groups]

    def spikes(self, longest: int) -> list[tuple[int, int]]:
        """Return the last row before and the first row after values that leave their neighbours and come back.

        They last at most `longest` rows. At the ends of a piece of the record, where values only leave or only come
        back, they last at most as many rows as a jump away and back. The rows are then -1 or n, or those next to a gap.
        """
        lone, error = self._lonely(_FEW_COUNTS * self.resolution)
        found = []
        for group in self._grouped(np.flatnonzero(lone), longest):
            first, last = group[0], group[-1]
            if _returns(error[group]):
                found.append((first, last + 1))
            elif not self.whole[max(first - _SPIKE, 0) : first].all() or first < _SPIKE:
                broken = np.flatnonzero(~self.whole[:first])
                found.append((int(broken[-1]) if len(broken) else -1, last + 1))
            elif not self.whole[last + 1 : last + 1 + _SPIKE].all() or last >= len(self.d) - _SPIKE:
                broken = np.flatnonzero(~self.whole[last + 1 :])
                found.append((first, last + 2 + int(broken[0]) if len(broken) else len(self.d) + 1))
        return found

    def leaps(self) -> np.ndarray:
        """Return which steps (n - 1,) are far larger than those next to them."""
        return self._lonely(_FEW_COUNTS * self.resolution)[0]

    def _lonely(self, least: float) -> tuple[np.ndarray, np.ndarray]:
        """Return which steps are far larger than those next to them, and at least so large, and by how much."""
        middle, deviation = self._neighbours(self.d, same_direction=True)
        error = self.d - middle * self.steps
        size = np.abs(error)
        limit = np.maximum(_LONELY * deviation * self.lasting, least)
        return self.whole & np.isfinite(size) & (size > limit), error

    def _grouped(self, lone: np.ndarray, longest: int) -> list[list[int]]:
        """Join steps away and back."""
        groups: list[list[int]] = []
        for index in lone.tolist():
            if groups and index - groups[-1][-1] <= longest and self.whole[groups[-1][-1] : index].all():
                groups[-1].append(index)
            else:
                groups.append([index])
        return groups

    def _around(self, values: np.ndarray) -> np.ndarray:
        """Return the neighbours of each step, (2 * _SIDE, n - 1); NaN beyond a gap."""
        n = len(values)
        runs = np.r_[0, np.cumsum(~self.whole[1:] | ~self.whole[:-1])] if n else np.empty(0)
        found = np.full((2 * _SIDE, n), np.nan)
        for row, shift in enumerate([*range(-_SIDE, 0), *range(1, _SIDE + 1)]):
            here = slice(max(0, -shift), max(0, n - max(0, shift)))
            there = slice(max(0, shift), max(0, n + min(0, shift)))
            near = runs[here] == runs[there]
            found[row, here] = np.where(near, values[there], np.nan)
        return found

    def _neighbours(self, d: np.ndarray, same_direction: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return the median rate of each step's neighbours and their largest deviation from it; NaN if they are few.

        With ``same_direction`` a deviation counts only if it has the direction of that of the step.
        """
        rates = d / self.lasting
        around = self._around(rates)
        enough = np.isfinite(around).sum(axis=0) >= _FEWEST
        middle, deviation = np.full(len(d), np.nan), np.full(len(d), np.nan)
        middle[enough] = np.nanmedian(around[:, enough], axis=0)
        away = around - middle
        if same_direction:
            away = np.maximum(away * np.sign(d - middle * self.steps), 0.0)
        deviation[enough] = np.nanmax(np.abs(away[:, enough]), axis=0)
        return middle, deviation

    def _share(self, flags: np.ndarray) -> np.ndarray:
        """Return the share of each step's neighbours that have the flag."""
        around = self._around(flags.astype(np.float64))
        there = np.isfinite(around)
        return np.where(there, around, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)


def _returns(steps: np.ndarray) -> bool:
    """Whether steps lead back to where they began."""
    return bool(abs(steps.sum()) <= 0.5 * np.abs(steps).max())
