"""What readers return, whatever the file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
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
    torque: np.ndarray  # N m or N; A or whatever a file has, before it is multiplied by the gains

    def each(self, function: Callable[[np.ndarray], np.ndarray], time: np.ndarray | None = None) -> Signals:
        """What a function makes of each signal, at other times if there are any."""
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
    """A file's signals, their times counted from its first row."""

    signals: Signals
    joint_names: list[str]
    start: float  # the first row's time by the file's own clock, s


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors about what a file holds begin with its name."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
