"""State transitions of logs, for forward dynamics."""

from __future__ import annotations

from typing import Literal, overload

import numpy as np
from scipy.integrate import cumulative_trapezoid
from sklearn.utils import Bunch

from ...utils.validation import check_integer
from .delay import velocity_delays
from .signals import runs

# From this stride on, velocities are averaged.
_AVERAGED = 4


@overload
def log_transitions(log: Bunch, *, stride: int = ..., align: bool = ..., return_X_y: Literal[False] = ...) -> Bunch: ...
@overload
def log_transitions(
    log: Bunch, *, stride: int = ..., align: bool = ..., return_X_y: Literal[True]
) -> tuple[np.ndarray, np.ndarray]: ...
def log_transitions(
    log: Bunch, *, stride: int = 1, align: bool = True, return_X_y: bool = False
) -> Bunch | tuple[np.ndarray, np.ndarray]:
    """Turn logs into state transitions, each with its time step, as data for forward dynamics.

    A row of ``data`` has the recorded state and the torque that acted until the next row. The state of the next row is
    the target. Signals are neither resampled nor filtered. Angles are unwrapped as by `load_log`. Transitions across a
    gap, a jump of a position, a corrupt value, a repeated frame or rest are left out, and so are rows with the time of
    another row.

    Velocities of many drives are differences of positions, and so they are late by half a row or more. The delay of
    each joint is found from positions and velocities, and positions are taken earlier by it (``align``). If `load_log`
    had a ``delay``, the torque of a transition is the mean of the efforts that were recorded later by this delay. With
    ``delay="auto"`` and the robot, it is the torque that acted, whether the drive records the torque to come or the
    last one. That matters if rows are far apart.
    :doc:`Learn the next state from your own logs </howto/next_state>` has an example, and one without velocities.

    Parameters
    ----------
    log : Bunch
        Logs, as returned by `load_log`.
    stride : int, default=1
        Number of recorded rows from a state to the next, at least 1. Transitions do not overlap. The torque is the mean
        of the rows between, weighted by their durations. From 4 rows on, the velocity of a state is its mean over half
        of this number of rows around the state, because a velocity of a single row is noisy. The torque is then
        averaged in the same way, so that it belongs to the change of these velocities.
    align : bool, default=True
        Whether to take positions at the time of the velocities, and to average velocities. If False, states are those
        of the recording.
    return_X_y : bool, default=False
        Whether to return ``(data, target)`` instead of a Bunch.

    Returns
    -------
    transitions : :class:`~sklearn.utils.Bunch`
        Dictionary-like object with

        - ``data`` : ndarray of shape (n_rows, 3 * n_joints + 1), with positions, velocities, torques and, in the last
          column, the time to the target ``"dt"``, in SI units;
        - ``target`` : ndarray of shape (n_rows, 2 * n_joints), with positions and velocities after ``dt``;
        - ``groups`` : ndarray of shape (n_rows,), with the file of each row;
        - ``time`` : ndarray of shape (n_rows,), in s since the first row of the file;
        - ``velocity_delay`` : ndarray of shape (n_files, n_joints), time by which velocities are late, s. States are
          earlier than ``time`` by the largest one of their file;
        - ``joint_names``, ``feature_names``, ``target_names``, ``DESCR``.
    (data, target) : tuple of ndarray
        Returned only if ``return_X_y`` is True.

    Raises
    ------
    ValueError
        If ``stride`` is below 1, the log has no recorded velocities, or no transition remains.
    TypeError
        If ``log`` is not a result of `load_log`, ``stride`` is not an integer, or ``align`` is not a boolean.

    See Also
    --------
    load_log : Read the files.

    Notes
    -----
    Without ``delay="auto"``, the torque of a row is held until the next row. With fewer than 4 rows, or without
    ``align``, torques of later rows are not used, because a controller computes them from the noisy target. From 4 rows
    on, torques of up to a quarter of the stride after the target count.

    Examples
    --------
    A mass of 2 kg that a force pushes back and forth, recorded at irregular times:

    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from skevgp.datasets import load_log, log_transitions
    >>> t = np.arange(0.0, 6.0, 0.008) + np.random.RandomState(0).uniform(0.0, 0.004, 750)
    >>> table = np.column_stack([t, np.sin(t), np.cos(t), -2.0 * np.sin(t)])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "mass.csv"
    ...     np.savetxt(file, table, delimiter=",")
    ...     log = load_log(file, columns={"time": 0, "position": 1, "velocity": 2, "effort": 3})
    >>> transitions = log_transitions(log)
    >>> transitions.feature_names
    ['q1', 'dq1/dt', 'u_q1', 'dt']
    >>> q, dq, u, dt = transitions.data.T
    >>> bool(np.abs(transitions.target[:, 1] - (dq + u / 2.0 * dt)).max() < 1e-4)
    True
    """
    check_integer(stride, "stride", minimum=1)
    if not isinstance(align, (bool, np.bool_)):
        raise TypeError(f"align must be True or False; got {align!r}.")
    if not isinstance(log, Bunch) or "recordings" not in log:
        raise TypeError(f"log must be a result of load_log; got {type(log).__name__}.")
    delays = [_velocity_delays(recording, align) for recording in log.recordings]
    parts = [
        _transitions(recording, stride, delay, align) for recording, delay in zip(log.recordings, delays, strict=True)
    ]
    lengths = [len(part) for part in parts]
    if not any(lengths):
        raise ValueError(f"No {stride + 1} rows follow each other without a gap, jump or rest. Lower stride={stride}.")
    rows, n = np.vstack(parts), len(log.joint_names)
    latest = max(abs(recording.start) + float(recording.raw.time[-1]) for recording in log.recordings)
    rows[:, 3 * n] = _rounded(rows[:, 3 * n], latest)
    data, target, time = rows[:, : 3 * n + 1], rows[:, 3 * n + 1 : -1], rows[:, -1]
    if return_X_y:
        return data, target
    states = [*log.joint_names, *(f"d{name}/dt" for name in log.joint_names)]
    return Bunch(
        data=data,
        target=target,
        groups=np.repeat(np.arange(len(parts)), lengths),
        time=time,
        velocity_delay=np.array(delays),
        joint_names=log.joint_names,
        feature_names=[*states, *log.target_names, "dt"],
        target_names=states,
        DESCR=(
            f"{len(data)} transitions, each over {stride} time step{'s' if stride > 1 else ''} of the recording "
            f"({_span(data[:, -1])} s), not filtered, without gaps, jumps and rest, of the files "
            f"{', '.join(log.filenames)}."
        ),
    )


def _span(dt: np.ndarray) -> str:
    """Return the shortest and the longest time step in s, or one number if they are about the same."""
    shortest, longest = f"{dt.min():.4g}", f"{dt.max():.4g}"
    return shortest if shortest == longest else f"{shortest} to {longest}"


def _rounded(steps: np.ndarray, latest: float) -> np.ndarray:
    """Return time steps without the rounding errors of the times, which are at most the latest."""
    # Steps of a regular clock would differ by rounding errors, and a kernel may learn a length scale of their size.
    return np.round(steps, max(0, int(-np.log10(2.0 * np.spacing(max(latest, 1.0))))))


def _velocities(recording: Bunch) -> np.ndarray:
    if recording.raw.velocity is None:
        raise ValueError(
            f"{recording.filename}: there are no recorded velocities, which the states need. If the file has some, "
            'pass their columns, without velocity="derive". Otherwise make rows from the filtered log.data, as in the '
            'how-to "Learn the next state from your own logs". Differences of unfiltered positions are too noisy.'
        )
    return np.asarray(recording.raw.velocity)


def _velocity_delays(recording: Bunch, align: bool) -> np.ndarray:
    """Return the time by which the velocity of each joint is later than its position, s."""
    velocity = _velocities(recording)
    if not align:
        return np.zeros(velocity.shape[1])
    return velocity_delays(recording.raw.time, recording.raw.position, velocity, list(runs(_whole(recording))))


def _whole(recording: Bunch) -> np.ndarray:
    """Return whether there is motion without a fault from a row to the next, (n - 1,)."""
    time = recording.raw.time
    whole = np.ones(len(time) - 1, dtype=bool)
    for first, last, why in recording.cuts:
        if why in ("gap", "rest", "jump", "corrupt", "held"):
            whole &= (time[1:] <= first) | (time[:-1] >= last)
    return whole


def _at(times: np.ndarray, time: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """Return signals (n, k) at other times, by linear interpolation."""
    return np.column_stack([np.interp(times, time, column) for column in signal.T])


def _averaged(time: np.ndarray, signal: np.ndarray, at: np.ndarray, half: float) -> np.ndarray:
    """Return means of a signal (n,) over times around others, up to this half width within the signal."""
    width = np.minimum(half, np.minimum(at - time[0], time[-1] - at))
    found = np.interp(at, time, signal)
    inside = width > 0.0
    if inside.any():
        total = cumulative_trapezoid(signal, time, initial=0.0)
        change = np.interp(at + width, time, total) - np.interp(at - width, time, total)
        found[inside] = change[inside] / (2.0 * width[inside])
    return found


def _transitions(recording: Bunch, stride: int, lags: np.ndarray, align: bool) -> np.ndarray:
    """Return rows of state, torque, dt, next state and time."""
    raw, velocity, whole = recording.raw, _velocities(recording), _whole(recording)
    beginnings = np.array([motion.start for motion in runs(whole)])
    time, steps = raw.time, np.diff(raw.time)
    step, lag = float(np.median(steps)), float(lags.max())
    # Efforts that act in a step were recorded later by their delay, and they are held until the next row. An estimated
    # delay is that of the efforts in the middle of the time for which they are held, behind velocities. Any other delay
    # is that of their beginning, behind positions.
    is_estimated = recording.get("delay_is_estimated", False)
    late = np.append(recording.delay + 0.5 * step if is_estimated else recording.delay - lag, 0.0)
    for first, last, why in recording.cuts:
        if why == "gap":
            whole &= (time[1:] + late.max() <= first) | (time[:-1] + late.min() >= last)
    whole &= (time[:-1] + late.min() >= time[0]) & (time[1:] + late.max() <= time[-1])
    impulse = np.vstack([np.zeros_like(raw.torque[:1]), np.cumsum(raw.torque[:-1] * steps[:, np.newaxis], axis=0)])
    found = []
    for run in runs(whole):
        # Earlier rows of the same motion have the positions before the first state.
        begin = int(beginnings[np.searchsorted(beginnings, run.start, side="right") - 1])
        first = max(run.start, int(np.searchsorted(time, time[begin] + lag)))
        starts = np.arange(first, run.stop - stride + 1, stride)
        if not len(starts):
            continue
        rows = np.append(starts, starts[-1] + stride)
        own = slice(begin, run.stop + 1)
        # All states are of the time of the latest velocity.
        positions = _at(time[rows] - lag, time[own], raw.position[own]) if lag else raw.position[rows]
        half = 0.25 * stride * step if align and stride >= _AVERAGED else 0.0
        speeds = np.column_stack(
            [
                _averaged(time[own], velocity[own, joint], time[rows] - (lag - delay), half)
                for joint, delay in enumerate(lags)
            ]
        )
        states = np.hstack([positions, speeds])
        dt = np.diff(time[rows])[:, np.newaxis]
        if stride == 1 and not late[:-1].any():
            torque = raw.torque[starts]
        else:
            # A change of averaged velocities is by the torque with the same average.
            where = slice(None) if late[:-1].any() else own
            impulses = [
                _averaged(time[where], column[where], time[rows] + delay, half)
                for delay, column in zip(late[:-1], impulse.T, strict=True)
            ]
            torque = np.diff(np.column_stack(impulses), axis=0) / dt
        found.append(np.hstack([states[:-1], torque, dt, states[1:], time[starts, np.newaxis]]))
    width = 5 * raw.position.shape[1] + 2
    return np.vstack(found) if found else np.empty((0, width))
