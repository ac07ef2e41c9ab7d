"""The record that all readers return."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Signals:
    """Signals of all joints at the same times."""

    time: np.ndarray  # (n,), s
    position: np.ndarray  # (n, n_joints), rad or m, as all that follow
    velocity: np.ndarray | None  # per s
    acceleration: np.ndarray | None  # per s²
    torque: np.ndarray  # N m or N; before multiplication by the gains, A or the unit of the file

    def each(self, function: Callable[[np.ndarray], np.ndarray], time: np.ndarray | None = None) -> Signals:
        """Apply a function to each signal but the time."""
        position, velocity, acceleration, torque = (
            None if signal is None else function(signal)
            for signal in (self.position, self.velocity, self.acceleration, self.torque)
        )
        assert position is not None
        assert torque is not None
        return Signals(self.time if time is None else time, position, velocity, acceleration, torque)

    def at(self, rows: Any) -> Signals:
        return self.each(lambda signal: signal[rows], self.time[rows])


@dataclass(frozen=True)
class Recording:
    """Signals of a file, with times since its first row. A missing value is NaN."""

    signals: Signals
    joint_names: list[str]
    start: float  # the first row's time by the file's own clock, s
    # By numbers of rows: why values are missing, and why a row is an error unless ``keep`` leaves it out.
    problems: Mapping[int, str] = field(default_factory=dict)
    refused: Mapping[int, str] = field(default_factory=dict)
    n_passed: int = 0  # messages at the beginning and end that do not name all joints
    choice: str = ""  # how to choose one of several publishers


def completed(read: Recording, rows: np.ndarray) -> tuple[Signals, np.ndarray]:
    """Drop incomplete rows at the beginning and the end of the kept rows; return the others and their numbers.

    Drivers publish before the motors answer, tables have a line of units, and the last line may be cut off. An
    incomplete row between complete ones is an error. A velocity or acceleration that a joint never has does not count
    here: `in_order` names it.
    """
    for row in rows:
        if row in read.refused:
            raise ValueError(f"row {row} {read.refused[row]}.")
    kept = read.signals.at(rows)
    fine = np.array([int(row) not in read.problems for row in rows])
    lacks: list[tuple[str, np.ndarray]] = []  # of each signal (n, n_joints)
    for name, signal in vars(kept).items():
        if signal is not None:
            lack = np.isnan(signal.reshape(len(rows), -1))
            if name in ("velocity", "acceleration") and fine.any():
                lack[fine] &= ~lack[fine].all(axis=0)
            lacks.append((name, lack))
    incomplete = np.any([lack.any(axis=1) for _, lack in lacks], axis=0)
    whole = np.flatnonzero(~incomplete)

    def told(at: int) -> str:
        """Name what a row lacks."""
        row, hint = int(rows[at]), ""
        name, lack = next((name, lack[at]) for name, lack in lacks if lack[at].any())
        if name in ("velocity", "acceleration"):
            hint = f', or pass {name}="derive" to ignore it'
        joint = "" if name == "time" else f" of joint {read.joint_names[int(np.argmax(lack))]!r}"
        why = f" ({read.problems[row]})" if row in read.problems else ""
        signal = "effort" if name == "torque" else name
        return f"row {row} lacks the {signal}{joint}{why}. Leave it out by keep{hint}."

    if not len(whole):
        raise ValueError(f"none of its {len(rows)} rows is complete: {told(0)}")
    inside = np.flatnonzero(incomplete[whole[0] : whole[-1]])
    if len(inside):
        raise ValueError(told(int(whole[0] + inside[0])))
    n_incomplete = len(rows) - int(whole[-1] - whole[0]) - 1
    if n_incomplete > len(whole):
        at = 0 if incomplete[0] else int(whole[-1]) + 1
        raise ValueError(f"{n_incomplete} of its {len(rows)} rows are incomplete: {told(at)}")
    complete = slice(whole[0], whole[-1] + 1)
    return kept.at(complete), rows[complete]


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Begin errors about a file with its name."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
