"""State transitions of logs, for forward dynamics."""

from __future__ import annotations

from typing import Literal, overload

import numpy as np
from sklearn.utils import Bunch

from ...utils.validation import check_integer
from .signals import runs


@overload
def log_transitions(log: Bunch, *, stride: int = ..., return_X_y: Literal[False] = ...) -> Bunch: ...
@overload
def log_transitions(log: Bunch, *, stride: int = ..., return_X_y: Literal[True]) -> tuple[np.ndarray, np.ndarray]: ...
def log_transitions(log: Bunch, *, stride: int = 1, return_X_y: bool = False) -> Bunch | tuple[np.ndarray, np.ndarray]:
    """Turn logs into state transitions with their own time steps, as data for forward dynamics.

    A row of ``data`` has the recorded state and the torque that acted until the next row. The state of the next row is
    the target. Signals are neither resampled nor filtered. Angles are unwrapped as by `load_log`. Transitions across a
    gap, a jump of a position, a corrupt value, a repeated frame or rest are left out, and so are rows with the time of
    another row. If `load_log` had a ``delay``, the torque of a transition is the mean of the efforts that were recorded
    later by this delay.
    :doc:`Learn the next state from your own logs </howto/next_state>` has an example, and one without velocities.

    Parameters
    ----------
    log : Bunch
        Logs, as returned by `load_log`.
    stride : int, default=1
        Number of recorded rows from a state to the next, at least 1. Transitions do not overlap. The torque is the mean
        of the rows between, weighted by their durations.
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
        - ``joint_names``, ``feature_names``, ``target_names``, ``DESCR``.
    (data, target) : tuple of ndarray
        Returned only if ``return_X_y`` is True.

    Raises
    ------
    ValueError
        If ``stride`` is below 1, the log has no recorded velocities, or no transition remains.
    TypeError
        If ``log`` is not a result of `load_log`, or ``stride`` is not an integer.

    See Also
    --------
    load_log : Read the files.

    Notes
    -----
    The torque of a row is held until the next row. The torque of the next row is not used, because a controller
    computes it from the noisy target.

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
    if not isinstance(log, Bunch) or "recordings" not in log:
        raise TypeError(f"log must be a result of load_log; got {type(log).__name__}.")
    parts = [_transitions(recording, stride) for recording in log.recordings]
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


def _transitions(recording: Bunch, stride: int) -> np.ndarray:
    """Return rows of state, torque, dt, next state and time."""
    raw = recording.raw
    if raw.velocity is None:
        raise ValueError(
            f"{recording.filename}: there are no recorded velocities, which the states need. If the file has some, "
            'pass their columns, without velocity="derive". Otherwise make rows from the filtered log.data, as in the '
            'how-to "Learn the next state from your own logs". Differences of unfiltered positions are too noisy.'
        )
    steps = np.diff(raw.time)
    whole = np.ones(len(steps), dtype=bool)
    # Efforts that act in a step were recorded later by their delay.
    late = np.append(recording.delay, 0.0)
    for first, last, why in recording.cuts:
        if why in ("gap", "rest", "jump", "corrupt", "held"):
            whole &= (raw.time[1:] <= first) | (raw.time[:-1] >= last)
        if why == "gap":
            whole &= (raw.time[1:] + late.max() <= first) | (raw.time[:-1] + late.min() >= last)
    whole &= (raw.time[:-1] + late.min() >= raw.time[0]) & (raw.time[1:] + late.max() <= raw.time[-1])
    starts = np.concatenate(
        [np.arange(run.start, run.stop - stride + 1, stride) for run in runs(whole)] or [np.empty(0, dtype=np.intp)]
    )
    ends = starts + stride
    states = np.hstack([raw.position, raw.velocity])
    dt = (raw.time[ends] - raw.time[starts])[:, np.newaxis]
    impulse = np.vstack([np.zeros_like(raw.torque[:1]), np.cumsum(raw.torque[:-1] * steps[:, np.newaxis], axis=0)])
    if recording.delay.any():
        impulse = np.column_stack(
            [np.interp(raw.time + delay, raw.time, own) for delay, own in zip(recording.delay, impulse.T, strict=True)]
        )
        torque = (impulse[ends] - impulse[starts]) / dt
    else:
        torque = raw.torque[starts] if stride == 1 else (impulse[ends] - impulse[starts]) / dt
    return np.hstack([states[starts], torque, dt, states[ends], raw.time[starts, np.newaxis]])
