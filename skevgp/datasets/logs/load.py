"""The logs of a robot, as data for inverse dynamics."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Integral
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack, overload

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils import Bunch

from ...exceptions import RobotModelWarning, warn_user
from ...robots.loading import Robot, read_once
from ...utils.validation import as_floats, check_real
from .agreement import check_agreement
from .bags import SUFFIXES as BAGS
from .bags import read_bag
from .corrupt import Corrupt, find_corrupt
from .delay import RecordedRobot, check_delay, estimate_delay
from .held import find_held, rows_of
from .jumps import Wish, check_wrap, find_jumps, kinds_of, wishes
from .publishers import check_publishers
from .recording import Recording, Signals, completed, naming
from .signals import Break, Processing, in_order, merged, pieces, process, runs
from .tables import SECONDS, check_columns, read_table
from .tables import SUFFIXES as TABLES

PathLike = str | os.PathLike[str]
Columns = Mapping[str, int | str | Sequence[int | str]]
_SINGULAR = 1e10  # condition number of a coupling, above which torques would be rounding
_LATE = 0.002  # s: delays that are told
_MOST_TOLD = 3  # corrupt values that a warning names
_CHOICE = "Record one of them, or remove the rows of the others."

Keep = slice | tuple[float | None, float | None]
# True, False, "auto" or a period: for all joints, for each one, or by their names.
Wrap = bool | float | str | Sequence[bool | float | str] | Mapping[str, bool | float | str]


class _Options(TypedDict, total=False):
    """Arguments of load_log, for its overloads."""

    columns: Columns | None
    time_unit: Literal["s", "ms", "us", "ns"]
    decimal: Literal[".", ","]
    topic: str | None
    frame_id: str | None
    joints: Sequence[str] | None
    gains: ArrayLike
    coupling: ArrayLike | None
    delay: float | ArrayLike | Literal["auto"]
    velocity: Literal["recorded", "derive"]
    acceleration: Literal["recorded", "derive"]
    wrap: Wrap
    robot: Robot
    keep: Keep | Sequence[Keep | None] | None
    dt: float | None
    cutoff: float | None
    max_gap: float | None
    rest_velocity: float
    rest_time: float


@overload
def load_log(
    path: PathLike | Sequence[PathLike], *, return_X_y: Literal[False] = ..., **options: Unpack[_Options]
) -> Bunch: ...
@overload
def load_log(
    path: PathLike | Sequence[PathLike], *, return_X_y: Literal[True], **options: Unpack[_Options]
) -> tuple[np.ndarray, np.ndarray]: ...
def load_log(
    path: PathLike | Sequence[PathLike],
    *,
    columns: Columns | None = None,
    time_unit: Literal["s", "ms", "us", "ns"] = "s",
    decimal: Literal[".", ","] = ".",
    topic: str | None = None,
    frame_id: str | None = None,
    joints: Sequence[str] | None = None,
    gains: ArrayLike = 1.0,
    coupling: ArrayLike | None = None,
    delay: float | ArrayLike | Literal["auto"] = 0.0,
    velocity: Literal["recorded", "derive"] = "recorded",
    acceleration: Literal["recorded", "derive"] = "recorded",
    wrap: Wrap = "auto",
    robot: Robot = None,
    keep: Keep | Sequence[Keep | None] | None = None,
    dt: float | None = 0.01,
    cutoff: float | None = 5.0,
    max_gap: float | None = None,
    rest_velocity: float = 0.01,
    rest_time: float = 0.5,
    return_X_y: bool = False,
) -> Bunch | tuple[np.ndarray, np.ndarray]:
    """Load the logs of a robot as data for inverse dynamics: [q, q̇, q̈] and the torques.

    The function reads tables and rosbag2 recordings, resamples and filters the signals, computes missing derivatives,
    and cuts gaps and rest. :doc:`How a log is processed </howto/logs_reference>` describes each step.

    Parameters
    ----------
    path : str, path-like or sequence of them
        One file or several. Each file is a group. All files have the same joints.
    columns : dict, default=None
        Columns of ``"time"``, ``"position"``, ``"effort"`` or ``"current"``, and optionally ``"velocity"`` and
        ``"acceleration"``, in a table. Each is a number from 0, a name, a pattern such as ``"actual_q_*"``, or a
        sequence of these.
    time_unit : {"s", "ms", "us", "ns"}, default="s"
        Unit of the times in a table.
    decimal : {".", ","}, default="."
        Decimal sign of a table.
    topic : str, default=None
        Topic of a rosbag2 recording with joint states or joint trajectories. If None, the only such topic.
    frame_id : str, default=None
        ``frame_id`` in the headers of the messages to read from a rosbag2 recording, if several nodes publish on the
        topic. If None, all messages.
    joints : sequence of str, default=None
        Joints to read from a rosbag2 recording, or names for the joints of a table. If None, all joints.
    gains : float or array-like of shape (n_joints,), default=1.0
        Torque per unit of effort: 1 if efforts are in N m, and gains in N m/A if they are currents.
    coupling : array-like of shape (n_joints, n_joints), default=None
        Matrix A with q_joint = A q_motor, if the file has the signals of motors. If None, the file has the signals of
        joints.
    delay : float, array-like of shape (n_joints,) or "auto", default=0.0
        Time by which efforts lag behind positions in the recording, s. If ``"auto"``, one delay is estimated for each
        file, which needs ``robot``.
    velocity : {"recorded", "derive"}, default="recorded"
        Whether to use recorded velocities, if there are any, or differences of the positions.
    acceleration : {"recorded", "derive"}, default="recorded"
        Whether to use recorded accelerations, if there are any, or differences of the velocities.
    wrap : {"auto", True, False}, float, sequence or dict of them, default="auto"
        Whether to unwrap angles that start again after a turn. A number is the period. If ``"auto"``, only clear turns
        are unwrapped.
    robot : str, path-like, System or pinocchio.Model, default=None
        Robot, as in `load_robot`. ``wrap="auto"`` then uses the limits of its joints.
    keep : slice, tuple or sequence of them, default=None
        Rows to read: ``slice(first, stop)`` counts rows from 0, and ``(first, last)`` are seconds since the first row.
        For several files, pass a list. If None, all rows are read.
    dt : float, default=0.01
        Step of the grid, s. If None, the recorded times are kept. Their steps must differ by less than 5 %.
    cutoff : float, default=5.0
        Cutoff frequency of the filter, Hz. If None, signals are filtered only against aliasing.
    max_gap : float, default=None
        Longest time step that does not count as a gap, s. If None, 5 times the median step.
    rest_velocity : float, default=0.01
        Velocity in rad/s or m/s below which a joint is at rest. If 0, no rest is cut.
    rest_time : float, default=0.5
        Shortest rest of all joints that is cut, s.
    return_X_y : bool, default=False
        Whether to return ``(data, target)`` instead of a Bunch.

    Returns
    -------
    log : :class:`~sklearn.utils.Bunch`
        Dictionary-like object with

        - ``data`` : ndarray of shape (n_rows, 3 * n_joints), with positions (rad or m), velocities and accelerations;
        - ``target`` : ndarray of shape (n_rows, n_joints), with torques (N m) or forces (N);
        - ``groups`` : ndarray of shape (n_rows,), with the file of each row;
        - ``pieces`` : ndarray of shape (n_rows,), with the piece of each row. Any cut begins a new piece;
        - ``time`` : ndarray of shape (n_rows,), in s since the first row of the file;
        - ``recordings`` : list of Bunch, one for each file, with

          - ``raw`` and ``processed``: Bunch of ``time``, ``position``, ``velocity``, ``acceleration`` and ``torque``.
            ``processed`` also has ``why``, which is ``"edge"`` or ``"rest"`` for rows that were cut;
          - ``cuts``: list of (first second, last second, reason);
          - ``corrupt``: list of Bunch with the ``row``, ``joint``, ``signal`` and ``value`` of each corrupt velocity,
            acceleration or effort. They are cut;
          - ``n_held``: number of rows that repeat the frame before them while joints move. They are cut;
          - ``wrapped`` and ``periods``: dict of the number of unwrapped jumps, and of their periods, for each joint;
          - ``delay`` and ``delay_is_estimated``: ndarray of shape (n_joints,), with the delays of the efforts in s, and
            whether they were estimated;
          - ``start``: time of the first row by the clock of the file, s;
          - ``n_repeated`` and ``n_incomplete``: number of rows with the time of another row, and of incomplete rows at
            both ends;
          - ``filename``;

        - ``joint_names``, ``feature_names``, ``target_names``, ``filenames``, ``DESCR``.
    (data, target) : tuple of ndarray
        Returned only if ``return_X_y`` is True.

    Raises
    ------
    ValueError
        If a file cannot be read, or lacks columns, a topic or joints. If its signals contradict each other, are too
        short for the filter, or are all at rest. If positions leap back and forth, as those of two publishers do. If
        files differ in their joints, or an argument does not fit them. An error about a file begins with its name.
    TypeError
        If an argument is of the wrong type.
    OSError
        If a file is missing, or its permissions do not allow reading.
    ImportError
        If rosbags or Pinocchio is needed and not installed. The message gives the pip command.

    Warns
    -----
    RobotModelWarning
        If ``delay="auto"`` finds a delay above 0.002 s. The delay is corrected. If velocities, accelerations or efforts
        are corrupt, or frames are repeated while joints move. These rows are cut.

    See Also
    --------
    log_transitions : Data for forward dynamics.
    skevgp.plotting.SignalsDisplay : Plot of recorded and processed signals.

    Notes
    -----
    Neighbouring rows of filtered signals are nearly the same. Cross-validate by ``groups``, never by rows.

    Examples
    --------
    A joint that swings, recorded at 125 Hz with a few milliseconds of jitter:

    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from skevgp.datasets import load_log
    >>> t = np.arange(0.0, 6.0, 0.008) + np.random.RandomState(0).uniform(0.0, 0.004, 750)
    >>> table = np.column_stack([t, np.sin(2.0 * t), 2.0 * np.cos(2.0 * t), 0.5 - 0.3 * np.sin(2.0 * t)])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "swing.csv"
    ...     np.savetxt(file, table, delimiter=",", header="time,q,dq,current", comments="")
    ...     columns = {"time": "time", "position": "q", "velocity": "dq", "current": "current"}
    ...     log = load_log(file, columns=columns, gains=10.0)
    >>> log.feature_names, log.target_names
    (['q1', 'dq1/dt', 'd2q1/dt2'], ['u_q1'])
    >>> bool(np.abs(log.data[:, 2] + 4.0 * log.data[:, 0]).max() < 0.02)  # q̈ = -4 q
    True
    """
    how = Processing(dt, cutoff, max_gap, rest_velocity, rest_time)
    if not isinstance(time_unit, str) or time_unit not in SECONDS:
        raise ValueError(f"time_unit must be one of {list(SECONDS)}; got {time_unit!r}.")
    sources = {"velocity": velocity, "acceleration": acceleration}
    for name, source in sources.items():
        if not isinstance(source, str) or source not in ("recorded", "derive"):
            raise ValueError(f'{name} must be "recorded" or "derive"; got {source!r}.')
    ignored = [name for name, source in sources.items() if source == "derive"]
    check_wrap(wrap)
    if isinstance(delay, str):
        if delay != "auto":
            raise ValueError(f'delay must be "auto", a number, or one for each joint, s; got {delay!r}.')
        if robot is None:
            raise ValueError('delay="auto" needs robot=..., whose dynamics determine the delay.')
    if not isinstance(decimal, str) or decimal not in (".", ","):
        raise ValueError(f"decimal must be '.' or ','; got {decimal!r}.")
    if joints is not None and (
        not isinstance(joints, (list, tuple, np.ndarray))
        or not all(isinstance(name, str) for name in joints)
        or len(set(joints)) != len(joints)
    ):
        raise ValueError(f"joints must be a list of different names; got {joints!r}.")
    asked = None
    if columns is not None:
        asked = {name: places for name, places in check_columns(columns).items() if name not in ignored}
    files, limits = _files(path, keep)
    recordings, names = [], None if joints is None else list(joints)
    given = None if robot is None else read_once(robot)
    for file, limit in zip(files, limits, strict=True):
        with naming(file):
            if file.is_dir() or file.suffix.lower() in BAGS:
                if asked is not None:
                    raise ValueError("columns is for tables. For a rosbag2 recording, choose topic and joints.")
                read = read_bag(file, topic, names, ignored, frame_id)
            else:
                if frame_id is not None:
                    raise ValueError(f"frame_id={frame_id!r} is for rosbag2 recordings, but the file is a table.")
                read = _table(file, asked, time_unit, topic, names, decimal)
            names = read.joint_names
            wanted = wishes(wrap, names)
            named = joints is not None or asked is None
            kinds = kinds_of(given, names, named)
            if coupling is not None:
                kinds = kinds_of(None, names, named)  # motors have no limits
            motors = _Motors.of(gains, coupling, len(names))
            late = RecordedRobot.of(given, names, named) if isinstance(delay, str) else check_delay(delay, len(names))
            recordings.append(_recording(read, file, limit, motors, how, wanted, kinds, late))
    assert names is not None
    if isinstance(delay, str):
        _warn_of_delays(recordings)
    _warn_of_faults(recordings)
    log = _log(recordings, names, how)
    return (log.data, log.target) if return_X_y else log


def _files(path: Any, keep: Any) -> tuple[list[Path], list[Any]]:
    """Return the files, and which rows are kept of each."""
    if isinstance(path, (str, os.PathLike)):
        return [Path(path)], [_check_keep(keep)]
    if not isinstance(path, (list, tuple)) or not all(isinstance(one, (str, os.PathLike)) for one in path):
        raise TypeError(f"path must be a path or a list of paths; got {path!r}.")
    files = [Path(one) for one in path]
    if not files:
        raise ValueError("path must be one file or several; got an empty list.")
    if keep is not None and (not isinstance(keep, list) or len(keep) != len(files)):
        raise ValueError(f"keep must be a list with one value for each of the {len(files)} files; got {keep!r}.")
    return files, [None] * len(files) if keep is None else [_check_keep(one) for one in keep]


def _check_keep(keep: Any) -> Keep | None:
    if keep is None:
        return keep
    if isinstance(keep, slice):
        if not all(part is None or isinstance(part, Integral) for part in (keep.start, keep.stop, keep.step)):
            raise ValueError(f"keep must be slice(first row, stop row) of whole numbers; got {keep!r}.")
        return keep
    if not isinstance(keep, tuple) or len(keep) != 2:
        raise ValueError(f"keep must be slice(first row, stop row) or (first second, last second); got {keep!r}.")
    first, last = (None if one is None else check_real(one, "keep", minimum=0.0) for one in keep)
    if first is not None and last is not None and first >= last:
        raise ValueError(f"keep={keep!r}: the first second must be below the last.")
    return first, last


def _kept(time: np.ndarray, keep: Keep | None) -> np.ndarray:
    """Return the numbers of the rows that are kept; a row without a time stays if its neighbours do."""
    rows = np.arange(len(time))
    if isinstance(keep, tuple):
        first, last = (-np.inf if keep[0] is None else keep[0]), (np.inf if keep[1] is None else keep[1])
        inside = np.flatnonzero((time >= first) & (time <= last))
        between = slice(inside[0], inside[-1] + 1) if len(inside) else slice(0)
        kept = rows[between][~((time[between] < first) | (time[between] > last))]
    else:
        kept = rows[keep or slice(None)]
    if not len(kept):
        raise ValueError(f"keep={keep!r} selects none of the {len(time)} rows, which last {np.nanmax(time):g} s.")
    return kept


def _place(one: Corrupt, names: list[str], numbers: np.ndarray, signals: Signals, gains: np.ndarray) -> Bunch:
    """Say where a corrupt value is in the file, and its value there."""
    value, signal = float(getattr(signals, one.signal)[one.worst, one.joint]), one.signal
    if signal == "torque":
        value, signal = value / float(np.broadcast_to(gains, len(names))[one.joint]), "effort"
    return Bunch(row=int(numbers[one.worst]), joint=names[one.joint], signal=signal, value=value)


def _table(
    file: Path,
    columns: dict[str, list[int | str]] | None,
    time_unit: str,
    topic: str | None,
    names: list[str] | None,
    decimal: Literal[".", ","],
) -> Recording:
    """Read a table whose joints have these names."""
    ending = "".join(file.suffixes[-2:]).lower()
    if not ending.endswith(TABLES):
        hint = " Convert it with: rosbags-convert --src in.bag --dst out" if ending == ".bag" else ""
        raise ValueError(f"its name must end in one of {', '.join([*TABLES, *BAGS])}.{hint}")
    if columns is None:
        raise ValueError("pass columns=..., which says by numbers from 0 or by names where a table has its signals.")
    if topic is not None:
        raise ValueError(f"topic={topic!r} is for rosbag2 recordings, but the file is a table.")
    read = read_table(file, columns, time_unit, decimal)
    if names is not None and len(names) != len(read.joint_names):
        raise ValueError(f"it has {len(read.joint_names)} joints; expected {len(names)}: {names}.")
    return read if names is None else replace(read, joint_names=names)


def _recording(
    read: Recording,
    file: Path,
    keep: Keep | None,
    motors: _Motors,
    how: Processing,
    wrap: Sequence[Wish],
    kinds: Sequence[str],
    delay: np.ndarray | RecordedRobot,
) -> Bunch:
    """Check and process the signals of a file; the delay is estimated if it is a robot."""
    names, asked = read.joint_names, _kept(read.signals.time, keep)
    kept, numbers = completed(read, asked)
    raw = replace(kept, torque=kept.torque * motors.gains)
    order, step, gap = in_order(raw, how.max_gap, names)
    raw, numbers = raw.at(order), numbers[order]
    with np.errstate(all="ignore"):
        check_publishers(raw, numbers, names, wrap, read.choice or _CHOICE)
        first_of_time = np.r_[True, np.diff(raw.time) > 0.0]
        raw, numbers = raw.at(first_of_time), numbers[first_of_time]
        held = find_held(raw, gap)
        breaks = merged([Break(first, after, "held") for first, after in rows_of(held)], -1)
        found = find_jumps(raw.time, raw.position, step, gap, wrap, kinds, breaks)
        breaks = merged([*breaks, *found.cuts])
        raw = replace(raw, position=found.position)
        corrupt = find_corrupt(raw, step, gap, breaks)
        breaks = merged([*breaks, *(one.where for one in corrupt)])
        of_file, raw = raw, motors.joints(raw)
        parts, wrapped = list(pieces(raw.time, gap, breaks)), motors.steps_of_joints(found.wrapped)
        _check_derivatives(raw, parts, names, wrapped, how)
        is_estimated = False
        if isinstance(delay, RecordedRobot):
            found_delay = estimate_delay(raw, step, gap, how, breaks, delay)
            is_estimated, delay = found_delay is not None, np.full(len(names), found_delay or 0.0)
        done = process(raw, step, gap, how, breaks, delay if delay.any() else None)
    for name, signal in vars(done.signals).items():
        if not np.isfinite(signal).all():
            raise ValueError(f"its {name} overflows when it is filtered and differentiated.")
    return Bunch(
        filename=str(file),
        start=read.start,
        n_repeated=len(kept.time) - len(raw.time),
        n_incomplete=len(asked) - len(kept.time) + read.n_passed,
        n_held=sum(after - first - 1 for first, after in rows_of(held)),
        corrupt=[_place(one, names, numbers, of_file, motors.gains) for one in corrupt],
        raw=Bunch(**vars(raw)),
        processed=Bunch(**vars(done.signals), why=done.why),
        cuts=done.cuts,
        wrapped=dict(zip(read.joint_names, found.wraps, strict=True)),
        periods={n: period for n, period in zip(read.joint_names, found.periods, strict=True) if period is not None},
        delay=delay,
        delay_is_estimated=is_estimated,
    )


@dataclass(frozen=True)
class _Motors:
    """How signals of motors become those of joints."""

    gains: np.ndarray  # () or (n_joints,), torque per effort
    coupling: np.ndarray | None  # (n_joints, n_joints), position of each joint per position of each motor

    @classmethod
    def of(cls, gains: ArrayLike, coupling: ArrayLike | None, n_joints: int) -> _Motors:
        """Check the arguments of `load_log`."""
        factor = as_floats(gains, "gains")
        if factor.shape not in ((), (n_joints,)) or not np.isfinite(factor).all():
            raise ValueError(f"gains must be a finite number, or one for each of the {n_joints} joints; got {gains!r}.")
        if coupling is None:
            return cls(factor, None)
        matrix = as_floats(coupling, "coupling")
        if matrix.shape != (n_joints, n_joints) or not np.isfinite(matrix).all():
            raise ValueError(
                f"coupling must be a finite matrix of shape ({n_joints}, {n_joints}), with a row for each joint and a "
                f"column for each motor; got {coupling!r}."
            )
        condition = float(np.linalg.cond(matrix))
        if not condition < _SINGULAR:
            raise ValueError(
                f"coupling must be invertible, so that motors determine joints and torques; its condition number is "
                f"{condition:.3g}."
            )
        return cls(factor, matrix)

    def joints(self, signals: Signals) -> Signals:
        """Return the signals of the joints."""
        if self.coupling is None:
            return signals
        matrix = self.coupling
        moved = signals.each(lambda signal: signal @ matrix.T)
        # The power of all joints is that of all motors: τ_joint = A⁻ᵀ τ_motor.
        return replace(moved, torque=np.linalg.solve(matrix.T, signals.torque.T).T)

    def steps_of_joints(self, wrapped: np.ndarray) -> np.ndarray:
        """Return the steps (n, n_joints) of joints at which an angle of a motor that moves them wrapped."""
        if self.coupling is None:
            return wrapped
        return (wrapped.astype(float) @ (self.coupling.T != 0.0)) > 0.0


def _warn_of_delays(recordings: list[Bunch]) -> None:
    """Warn if efforts were moved."""
    late = {one.filename: one.delay[0] for one in recordings if abs(one.delay[0]) > _LATE}
    if late:
        told = ", ".join(f"{1e3 * delay:.1f} ms in {filename}" for filename, delay in late.items())
        warn_user(
            f"Efforts lag behind positions by {told}. A negative lag means that they are ahead. The lag was corrected. "
            "Pass delay=0.0 to keep the recorded times.",
            RobotModelWarning,
        )


def _warn_of_faults(recordings: list[Bunch]) -> None:
    """Warn of rows that were cut because a driver recorded wrong values."""
    told = []
    for one in recordings:
        if one.corrupt:
            places = [
                f"the {its.signal} of joint {its.joint!r} in row {its.row} ({its.value:.5g})" for its in one.corrupt
            ]
            more = f" and {len(places) - _MOST_TOLD} more" if len(places) > _MOST_TOLD else ""
            told.append(f"{one.filename}: corrupt values were cut: {', '.join(places[:_MOST_TOLD])}{more}.")
        held = [cut for cut in one.cuts if cut[2] == "held"]
        if held:
            told.append(
                f"{one.filename}: {one.n_held} rows repeat the frame before them while joints move, first at "
                f"{held[0][0]:.4g} s. They were cut."
            )
    if told:
        warn_user(" ".join(told), RobotModelWarning)


def _check_derivatives(
    raw: Signals, parts: list[slice], names: list[str], wrapped: np.ndarray, how: Processing
) -> None:
    """Raise if recorded velocities contradict positions, or accelerations contradict velocities."""
    if raw.velocity is not None:
        check_agreement(raw.time, raw.position, raw.velocity, parts, names, slowest=how.rest_velocity, wrapped=wrapped)
    if raw.acceleration is not None:
        velocity = raw.velocity
        if velocity is None:
            velocity = np.zeros_like(raw.position)
            for rows in parts:
                if rows.stop - rows.start > 1:
                    velocity[rows] = np.gradient(raw.position[rows], raw.time[rows], axis=0)
        check_agreement(raw.time, velocity, raw.acceleration, parts, names, what="acceleration")


def _log(recordings: list[Bunch], names: list[str], how: Processing) -> Bunch:
    """Join the rows of all files that were not cut."""
    kept = [recording.processed.why == "" for recording in recordings]

    def rows(name: str) -> np.ndarray:
        return np.concatenate([one.processed[name][left] for one, left in zip(recordings, kept, strict=True)])

    lengths = [int(left.sum()) for left in kept]
    runs_of_all = [run.stop - run.start for left in kept for run in runs(left)]
    return Bunch(
        data=np.hstack([rows("position"), rows("velocity"), rows("acceleration")]),
        target=rows("torque"),
        groups=np.repeat(np.arange(len(recordings)), lengths),
        # Ends of pieces are cut, so that no two of them touch.
        pieces=np.repeat(np.arange(len(runs_of_all)), runs_of_all),
        time=rows("time"),
        recordings=recordings,
        joint_names=names,
        feature_names=[*names, *(f"d{name}/dt" for name in names), *(f"d2{name}/dt2" for name in names)],
        target_names=[f"u_{name}" for name in names],
        filenames=[recording.filename for recording in recordings],
        DESCR=_description(recordings, lengths, names, how),
    )


def _description(recordings: list[Bunch], lengths: list[int], names: list[str], how: Processing) -> str:
    """Describe what was done to the signals."""
    files = "; ".join(_story(recording, length) for recording, length in zip(recordings, lengths, strict=True))
    grid = "the recorded times" if how.dt is None else f"a grid of {how.dt:g} s"
    filtered = (
        "not filtered, but against aliasing where the grid is coarser than the recording"
        if how.cutoff is None
        else f"filtered forth and back by a Butterworth filter of fourth order at {how.cutoff:g} Hz"
    )
    derived = [n for n in ("velocity", "acceleration") if any(one.raw[n] is None for one in recordings)]
    differences = f" Central differences: {' and '.join(derived)}." if derived else ""
    return (
        f"Logs of the joints {', '.join(names)}: positions, velocities and accelerations, and the torques, on {grid}, "
        f"{filtered}, within pieces without gaps, whose ends are cut.{differences} Rest (all joints below "
        f"{how.rest_velocity:g} rad/s or m/s for {how.rest_time:g} s) is cut. {files}."
    )


def _story(recording: Bunch, length: int) -> str:
    """Describe what became of a file."""
    raw, cuts = recording.raw, recording.cuts
    lost = [
        f"{sum(last - first for first, last, why in cuts if why == kind):.3g} s of {kind}"
        for kind in sorted({why for _, _, why in cuts})
    ]
    turns = [
        f"{name} {recording.wrapped[name]} times by {'2π' if period == 2.0 * np.pi else f'{period:g}'}"
        for name, period in recording.periods.items()
    ]
    unwrapped = f"; unwrapped: {', '.join(turns)}" if turns else ""
    incomplete = f"{recording.n_incomplete} incomplete at the ends; " if recording.n_incomplete else ""
    jumps = sum(why == "jump" for *_, why in cuts)
    cut_at = f"; positions jump {jumps} times" if jumps else ""
    cut_at += f"; {len(recording.corrupt)} corrupt values" if recording.corrupt else ""
    cut_at += f"; {recording.n_held} rows that repeat a frame" if recording.n_held else ""
    low, high = 1e3 * recording.delay.min(), 1e3 * recording.delay.max()
    moved = "" if low == high == 0.0 else f"; efforts moved earlier by {low:.3g} ms"
    moved += f" to {high:.3g} ms" if low != high else ""
    return (
        f"{recording.filename}: {length} rows of {len(raw.time)} recorded in {raw.time[-1] - raw.time[0]:.4g} s "
        f"({recording.n_repeated} more repeated a time; {incomplete}cut: {', '.join(lost) or 'nothing'}{cut_at}"
        f"{unwrapped}{moved})"
    )
