"""Find how much later than the motion the efforts of a recording are.

Torques of a rigid body with friction are linear in its parameters. The efforts are shifted by each delay in turn, and
regressed on the torques per parameter. The delay with the smallest residuals is that of the recording. This does not
depend on the masses in the robot's model. Without a robot, the dynamics that a simpler regression lacks look like a
delay of up to 0.1 s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline

from ...robots import RigidBody
from ...robots.loading import Robot, known_robot
from ...utils.validation import as_floats
from .recording import Signals
from .signals import Break, Grid, Processing, pieces, process_piece

_LARGEST = 0.1  # s: delays that are tried
_COARSE, _FINE = 41, 21  # number of delays that are tried in all of the range, and around the best one
_CUTOFF = 5.0  # Hz, if the log is not filtered
_ROWS = 10.0  # per period of the cutoff: enough for splines between them
_MOST = 3000  # rows of a regression, evenly spread
_STICTION = 0.05  # rad/s or m/s, within which Coulomb friction changes its sign
_DEPENDENT = 1e-8  # of the largest singular value: below it, parameters have no effect of their own
_CLEAR = 10.0  # nats that a delay gains over none; below it, there is none
_LEAST_SHARE = 1e-15  # of the variance of efforts: rounding
# The delay of velocities: length of windows, s; the fewest windows; limits, in rows, and in s or rows; standard errors
# above 0 of a clear delay.
_WINDOW, _FEWEST, _LEAST_LATE, _LONGEST_LATE, _LATE_ROWS, _CLEARLY = 0.1, 20, 0.1, 0.1, 1.5, 5.0


def check_delay(delay: Any, n_joints: int) -> np.ndarray:
    """Return the delay of each joint (n_joints,), s."""
    values = as_floats(delay, "delay")
    if values.shape not in ((), (n_joints,)) or not np.isfinite(values).all():
        raise ValueError(f"delay must be a finite number, or one for each of the {n_joints} joints; got {delay!r}.")
    return np.broadcast_to(values, n_joints).copy()


def velocity_delays(time: np.ndarray, position: np.ndarray, velocity: np.ndarray, moving: list[slice]) -> np.ndarray:
    """Return the time by which velocities (n, n_joints) are later than positions, (n_joints,), s; 0 if none is clear.

    ``moving`` are runs of steps without gaps and rest. A joint whose delay is uncertain has the median of the others.
    """
    # With v(t) = q̇(t - d), the change of position in a window is ∫ v dt + d Δv to first order. So d is the slope of the
    # difference over Δv.
    n_joints, step = position.shape[1], float(np.median(np.diff(time)))
    length = max(1, round(_WINDOW / step))
    starts = np.array([start for run in moving for start in range(run.start, run.stop - length + 1)], dtype=np.intp)
    if len(starts) < _FEWEST:
        return np.zeros(n_joints)
    ends = starts + length
    total = cumulative_trapezoid(velocity, time, axis=0, initial=0.0)
    with np.errstate(all="ignore"):
        change = velocity[ends] - velocity[starts]
        missed = position[ends] - position[starts] - (total[ends] - total[starts])
        information = np.sum(change**2, axis=0)
        delays = np.sum(missed * change, axis=0) / information
        # Windows overlap, so fewer than all are independent.
        errors = np.sqrt(np.mean((missed - delays * change) ** 2, axis=0) * length / information)
    least, longest = _LEAST_LATE * step, max(_LONGEST_LATE, _LATE_ROWS * step)
    known = np.isfinite(delays) & np.isfinite(errors)
    late = known & (delays > least) & (delays < longest) & (delays > _CLEARLY * errors)
    if not late.any():
        return np.zeros(n_joints)
    uncertain = ~late & ~(known & (_CLEARLY * errors < least))
    return np.where(late, delays, np.where(uncertain, np.median(delays[late]), 0.0))


@dataclass(frozen=True)
class RecordedRobot:
    """A robot whose moving joints are those of a log."""

    body: RigidBody
    columns: list[int]  # the log's number of each joint

    @classmethod
    def of(cls, robot: Robot, names: Sequence[str], named: bool) -> RecordedRobot:
        """Lock the joints that the log lacks; joints are matched by order if the names are not `named`."""
        model = known_robot(robot)
        known = list(model.names)[1:]
        if not named or not set(names) <= set(known):
            return cls(RigidBody(model), list(range(len(names))))
        joints = [name for name in known if name in names]
        return cls(RigidBody(known_robot(model, joints=joints)), [names.index(name) for name in joints])

    def torques_per_parameter(self, signals: Signals) -> list[np.ndarray]:
        """Return the regressor (n, n_parameters) of each column of the log: of all links, and friction of the joint."""
        assert signals.velocity is not None
        assert signals.acceleration is not None
        states = signals.position, signals.velocity, signals.acceleration
        links = self.body.torque_regressor(*(state[:, self.columns] for state in states))
        of_log = links[:, np.argsort(self.columns)]
        one = np.ones(len(links))
        return [
            np.column_stack([of_log[:, joint], acceleration, velocity, np.tanh(velocity / _STICTION), one])
            for joint, (velocity, acceleration) in enumerate(
                zip(signals.velocity.T, signals.acceleration.T, strict=True)
            )
        ]


def estimate_delay(
    raw: Signals, step: float, gap: float, how: Processing, breaks: Sequence[Break], robot: RecordedRobot
) -> float | None:
    """Return the delay of the efforts of a sorted recording, one for all joints, s; None if the log does not tell.

    If velocities are late, it is the delay of the efforts behind them.
    """
    how.check_frequencies(step)
    cutoff = min(_CUTOFF, 0.2 / step) if how.cutoff is None else how.cutoff
    how = replace(how, cutoff=cutoff, dt=max(step, 1.0 / (_ROWS * cutoff)))
    if raw.velocity is not None:
        moving = [slice(rows.start, rows.stop - 1) for rows in pieces(raw.time, gap, breaks)]
        lags = velocity_delays(raw.time, raw.position, raw.velocity, moving)
        earlier = [np.interp(raw.time - lag, raw.time, q) for lag, q in zip(lags, raw.position.T, strict=True)]
        raw = replace(raw, position=np.column_stack(earlier))
    fit = _Regressions.of(raw, step, gap, how, breaks, robot)
    if fit is None:
        return None
    tried = np.linspace(-_LARGEST, _LARGEST, _COARSE)
    deviances = fit.deviances(tried)
    best = int(np.argmin(deviances))
    if max(deviances[0], deviances[-1]) - deviances[best] < _CLEAR:
        return None
    near = tried[best] + (tried[1] - tried[0]) * np.linspace(-1.0, 1.0, _FINE)
    deviances = fit.deviances(np.append(near, 0.0))
    lowest = 1 + int(np.argmin(deviances[1:-2]))  # with a neighbour on both sides
    if deviances[-1] - deviances[lowest] < _CLEAR:
        return 0.0
    if best in (0, _COARSE - 1):
        raise ValueError(
            f'delay="auto" tries delays up to {_LARGEST:g} s, and the efforts fit the robot best at {near[lowest]:.3g} '
            "s. Look at the signals, and pass the delay as a number."
        )
    before, at, after = deviances[lowest - 1 : lowest + 2]
    # The minimum of the parabola through the three.
    return float(near[lowest] + 0.5 * (near[1] - near[0]) * (before - after) / (before - 2.0 * at + after))


@dataclass(frozen=True)
class _Regressions:
    """Regressions of the efforts of all joints, for any delay."""

    times: list[np.ndarray]  # of the rows of each piece, s
    efforts: list[CubicSpline]  # of each piece
    bases: list[np.ndarray]  # (n, rank) for each joint: orthonormal, of the space of the regressor's columns
    n_independent: float  # rows that are as informative as these, which are filtered

    @classmethod
    def of(
        cls,
        raw: Signals,
        step: float,
        gap: float,
        how: Processing,
        breaks: Sequence[Break],
        robot: RecordedRobot,
    ) -> _Regressions | None:
        """Filter a recording; return None if no row is left."""
        grid, found = Grid.of(raw, step, how), []
        for rows in pieces(raw.time, gap, breaks):
            done = process_piece(raw.at(rows), grid, how)
            if done is not None:
                signals, why = done
                first, last = signals.time[[0, -1]]
                # Rows whose efforts are there for each delay, with one step to spare.
                reach = 1.1 * _LARGEST
                whole = (why == "") & (signals.time >= first + reach) & (signals.time <= last - reach)
                found.append((signals, np.flatnonzero(whole)))
        n_rows = sum(len(rows) for _, rows in found)
        if not n_rows:
            return None
        every = int(np.ceil(n_rows / _MOST))
        kept = [(signals, rows[::every]) for signals, rows in found]
        at = [signals.at(rows) for signals, rows in kept]
        regressors = [
            np.concatenate(parts) for parts in zip(*(robot.torques_per_parameter(s) for s in at), strict=True)
        ]
        assert how.dt is not None
        assert how.cutoff is not None
        return cls(
            [signals.time for signals in at],
            [CubicSpline(signals.time, signals.torque) for signals, _ in kept],
            [_basis(regressor) for regressor in regressors],
            min(n_rows, 2.0 * how.cutoff * how.dt * n_rows),
        )

    def deviances(self, delays: np.ndarray) -> np.ndarray:
        """Return the negative log likelihood of each delay, up to a constant, with the noise of each joint profiled."""
        found = []
        for delay in delays:
            efforts = np.concatenate([spline(t + delay) for spline, t in zip(self.efforts, self.times, strict=True)])
            efforts -= efforts.mean(axis=0)
            total = (efforts**2).sum(axis=0)
            explained = [((basis.T @ own) ** 2).sum() for basis, own in zip(self.bases, efforts.T, strict=True)]
            moves = total > 0.0
            share = 1.0 - np.array(explained)[moves] / total[moves]
            found.append(0.5 * self.n_independent * np.log(np.maximum(share, _LEAST_SHARE)).sum())
        return np.array(found)


def _basis(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the space of the columns."""
    sizes = np.linalg.norm(columns, axis=0)
    left, values, _ = np.linalg.svd(columns[:, sizes > 0.0] / sizes[sizes > 0.0], full_matrices=False)
    return left[:, values > _DEPENDENT * values[0]]
