"""Cut recorded signals at gaps, interpolate them to a grid, filter and differentiate them, and cut rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.signal import butter, sosfiltfilt

from ...utils.validation import check_real
from .recording import Signals

_ORDER = 4  # of the filter, which passes twice
_GAP = 5.0  # median steps
_JITTER = 0.05  # of the median step: times that differ by less are regular
_EDGE = 2.0  # periods of the cutoff frequency that are cut at each end of a filtered piece
_BAND = 0.8  # of the grid's Nyquist frequency is left where no cutoff is asked for and the grid is coarser
_FINEST = 0.1  # of the median step: a finer grid has nothing to show

Cut = tuple[float, float, str]


class Break(NamedTuple):
    """Where rows are cut out of a record. It may have no row, as a jump between two rows."""

    before: int  # last row before it, -1 if there is none
    after: int  # first row after it, n if there is none
    why: str  # "jump", "corrupt" or "held"


@dataclass(frozen=True)
class Processing:
    """Arguments of `load_log` about the processing."""

    dt: float | None
    cutoff: float | None
    max_gap: float | None
    rest_velocity: float
    rest_time: float

    def __post_init__(self) -> None:
        for name in ("dt", "cutoff", "max_gap"):
            if getattr(self, name) is not None:
                check_real(getattr(self, name), name, minimum=0.0, strict=True)
        check_real(self.rest_velocity, "rest_velocity", minimum=0.0)
        check_real(self.rest_time, "rest_time", minimum=0.0)

    def check_frequencies(self, step: float) -> None:
        """Raise if the grid or the filter does not fit a recording with this median step."""
        if self.dt is not None and self.dt < _FINEST * step:
            raise ValueError(f"dt={self.dt:g} s is far below the recording's step of {step:g} s. Pass a larger dt.")
        nyquist = 0.5 / max(step, self.dt or 0.0)
        if self.cutoff is not None and self.cutoff >= nyquist:
            raise ValueError(
                f"cutoff={self.cutoff:g} Hz must be below {nyquist:g} Hz, half the rate of the recording (a row every "
                f"{step:g} s) and of the grid."
            )


@dataclass(frozen=True)
class Processed:
    """Signals on all rows of the grid, and why some of them are cut."""

    signals: Signals
    why: np.ndarray  # (n,) of str: why a row is left out, "" where it is not
    cuts: list[Cut]  # first and last second, and why


def in_order(raw: Signals, max_gap: float | None, names: Sequence[str]) -> tuple[np.ndarray, float, float]:
    """Sort rows by time; return their order, the median step and the longest step that is no gap.

    Messages overtake each other, so rows that are late by less than a gap are sorted. A clock that goes back by more is
    that of a second recording, which sorting would mix with the first.
    """
    for name, signal in vars(raw).items():
        if signal is not None and not np.isfinite(signal).all():
            spoilt = ~np.isfinite(signal.reshape(len(signal), -1))
            hint = f' Pass {name}="derive" to ignore it.' if name in ("velocity", "acceleration") else ""
            never = spoilt.all(axis=0)
            if never.any():
                joint = "" if never.all() else f" of joint {names[int(np.argmax(never))]!r}"
                why = "the driver may never fill it"
                raise ValueError(f"the {name}{joint} is not finite in any row kept: {why}.{hint}")
            row = np.flatnonzero(spoilt.any(axis=1))[0]
            raise ValueError(f"the {name} is not finite in row {row} of the rows kept.{hint}")
    order = np.argsort(raw.time, kind="stable")
    steps = np.diff(raw.time[order])
    if not (steps > 0.0).any():
        raise ValueError(f"its {len(order)} rows do not have two different times.")
    step = float(np.median(steps[steps > 0.0]))
    gap = _GAP * step if max_gap is None else max_gap
    late = np.maximum.accumulate(raw.time) - raw.time
    if late.max() > gap:
        raise ValueError(
            f"its clock goes back by {late.max():g} s at {raw.time[late.argmax()]:g} s: this is more than one "
            "recording. Choose one with keep, or split the file."
        )
    return order, step, gap


def pieces(time: np.ndarray, gap: float, breaks: Sequence[Break] = ()) -> Iterator[slice]:
    """Yield the pieces of rows without a gap or a break. Rows of a break are in no piece."""
    gaps = np.flatnonzero(np.diff(time) > gap * (1.0 + 1e-9))
    start = 0
    for before, after, _ in sorted([*breaks, *(Break(row, row + 1, "gap") for row in gaps.tolist())]):
        if before >= start:
            yield slice(start, before + 1)
        start = max(start, after)
    if start < len(time):
        yield slice(start, len(time))


def whole_steps(time: np.ndarray, gap: float, breaks: Sequence[Break] = ()) -> np.ndarray:
    """Return which of the steps (n - 1,) are in a piece."""
    whole = np.diff(time) <= gap * (1.0 + 1e-9)
    for before, after, _ in breaks:
        whole[max(before, 0) : after] = False
    return whole


def merged(breaks: Sequence[Break], apart: int = 0) -> list[Break]:
    """Sort breaks, and join those that touch or have at most so many more rows between them."""
    found: list[Break] = []
    for one in sorted(breaks):
        if found and one.before <= found[-1].after + apart:
            found[-1] = found[-1]._replace(after=max(found[-1].after, one.after))
        else:
            found.append(one)
    return found


def runs(flags: np.ndarray) -> Iterator[slice]:
    """Yield the runs of consecutive True."""
    for start, stop in np.flatnonzero(np.diff(np.r_[False, flags, False])).reshape(-1, 2):
        yield slice(start, stop)


def process(
    raw: Signals,
    step: float,
    gap: float,
    how: Processing,
    breaks: Sequence[Break] = (),
    delay: np.ndarray | None = None,
) -> Processed:
    """Filter and differentiate each piece of a sorted recording; raise if no row remains.

    `delay` (n_joints,) is how much later than the motion the efforts are, s. None stands for 0.
    """
    how.check_frequencies(step)
    parts, reasons = [], []
    cuts: list[Cut] = []
    grid = Grid.of(raw, step, how)
    dt = grid.h * grid.inside
    late, early = (0.0, 0.0) if delay is None else (max(delay.max(), 0.0), max(-delay.min(), 0.0))
    last = -1
    into, out_of = {one.before: one.why for one in breaks}, {one.after: one.why for one in breaks}
    for rows in pieces(raw.time, gap, breaks):
        piece = raw.at(rows)
        if rows.start > 0:
            why_not = out_of.get(rows.start, into.get(last, "gap"))
            cuts.append((float(raw.time[max(last, 0)]), float(piece.time[0]), why_not))
        last = rows.stop - 1
        done = process_piece(piece, grid, how, delay)
        if done is None:
            cuts.append((float(piece.time[0]), float(piece.time[-1]), "too short"))
            continue
        signals, why = done
        parts.append(signals)
        reasons.append(why)
        cuts.extend(
            (
                max(float(signals.time[run][0]) - dt / 2.0 - early * (run.start == 0), float(piece.time[0])),
                min(float(signals.time[run][-1]) + dt / 2.0 + late * (run.stop == len(why)), float(piece.time[-1])),
                reason,
            )
            for reason in ("edge", "rest")
            for run in runs(why == reason)
        )
    if last < len(raw.time) - 1:
        cuts.append((float(raw.time[max(last, 0)]), float(raw.time[-1]), into[last]))
    if not parts:
        lost = 2.0 * grid.edge * dt + late + early
        told = f"it is too short: no piece without gaps is longer than the {lost:g} s cut at its ends."
        raise ValueError(told + "".join(_told(why, breaks, raw.time) for why in _TOLD))
    if not any((why == "").any() for why in reasons):
        raise ValueError(f"all rows are at rest: no joint is faster than rest_velocity={how.rest_velocity:g}.")
    return Processed(_joined(parts), np.concatenate(reasons), sorted(cuts))


_TOLD = {
    "jump": "Positions jump {times}, first at {first:g} s, and each jump cuts it. Positions that move in steps are "
    "taken as they are with wrap=False.",
    "corrupt": "Velocities, accelerations or efforts are corrupt {times}, first at {first:g} s, and each time cuts it.",
    "held": "Frames are repeated while the joints move {times}, first at {first:g} s, and each time cuts it.",
}


def _told(why: str, breaks: Sequence[Break], time: np.ndarray) -> str:
    """Say how often a reason cuts the record."""
    found = [one for one in breaks if one.why == why]
    if not found:
        return ""
    times = f"{len(found)} time{'s' if len(found) > 1 else ''}"
    return " " + _TOLD[why].format(times=times, first=time[max(found[0].before, 0)])


@dataclass(frozen=True)
class Grid:
    """The grid on which signals are filtered and differentiated."""

    h: float  # its step, s
    inside: int  # steps in one of the rows that are returned
    cutoff: float | None  # of the filter, Hz
    edge: int  # rows that are cut at each end of a piece

    @classmethod
    def of(cls, raw: Signals, step: float, how: Processing) -> Grid:
        """Choose a grid that is no coarser than the recording: it is thinned out after the filter, against aliasing."""
        dt = step if how.dt is None else how.dt
        inside = max(1, int(np.ceil(dt / step - 1e-6)))
        cutoff = _BAND * 0.5 / dt if how.cutoff is None and inside > 1 else how.cutoff
        # Without a filter: as many rows as differences are one-sided.
        one_sided = 1 + (raw.velocity is None)
        edge = one_sided if cutoff is None else int(np.ceil(_EDGE / (cutoff * dt) - 1e-9))
        return cls(dt / inside, inside, cutoff, edge)


def process_piece(
    piece: Signals, grid: Grid, how: Processing, delay: np.ndarray | None = None
) -> tuple[Signals, np.ndarray] | None:
    """Return the signals on the grid, and why rows are cut; None if the piece is too short."""
    fine = _regular(piece, grid.h) if how.dt is None else _on_grid(piece, grid.h)
    if delay is not None and len(piece.time) > 1:
        fine = _with_efforts_earlier(fine, piece, delay)
    n_rows = (len(fine.time) - 1) // grid.inside + 1
    if n_rows <= 2 * grid.edge:
        return None
    if grid.cutoff is not None:
        fine = _filtered(fine, grid.cutoff, grid.h)
    velocity = np.gradient(fine.position, grid.h, axis=0) if fine.velocity is None else fine.velocity
    acceleration = np.gradient(velocity, grid.h, axis=0) if fine.acceleration is None else fine.acceleration
    signals = replace(fine, velocity=velocity, acceleration=acceleration).at(slice(None, None, grid.inside))
    why = np.full(n_rows, "", dtype="<U4")
    why[: grid.edge] = why[n_rows - grid.edge :] = "edge"
    slow = (np.abs(velocity[:: grid.inside]) < how.rest_velocity).all(axis=1)
    for run in runs(slow):
        if signals.time[run][-1] - signals.time[run][0] >= how.rest_time:
            why[run] = "rest"
    return signals, why


def _regular(piece: Signals, step: float) -> Signals:
    """Return the piece unchanged if its steps are regular, else raise."""
    irregular = np.abs(np.diff(piece.time) - step).max(initial=0.0)
    if irregular > _JITTER * step:
        raise ValueError(
            f"dt=None keeps the recorded times, but they are not regular: steps differ from their median of "
            f"{step:g} s by up to {irregular:g} s. Pass dt."
        )
    return piece


def _on_grid(piece: Signals, h: float) -> Signals:
    """Interpolate by cubic polynomials that never exceed the recorded values."""
    if len(piece.time) < 2:
        return piece
    first, last = piece.time[[0, -1]]
    time = first + h * np.arange(int((last - first) / h + 1e-6) + 1)
    inside = np.minimum(time, last)
    return piece.each(lambda signal: PchipInterpolator(piece.time, signal, axis=0)(inside), time)


def _with_efforts_earlier(fine: Signals, piece: Signals, delay: np.ndarray) -> Signals:
    """Interpolate the efforts at the delayed times of the rows, and drop the rows for which there are none."""
    delayed = fine.time[:, np.newaxis] + delay
    there = ((delayed >= piece.time[0]) & (delayed <= piece.time[-1])).all(axis=1)
    torques = [
        PchipInterpolator(piece.time, recorded)(times)
        for recorded, times in zip(piece.torque.T, delayed[there].T, strict=True)
    ]
    return replace(fine.at(there), torque=np.column_stack(torques))


def _filtered(signals: Signals, cutoff: float, h: float) -> Signals:
    """Filter all signals forth and back, so that no signal leads another."""
    sos = butter(_ORDER, cutoff, fs=1.0 / h, output="sos")
    padding = min(len(signals.time) - 1, int(np.ceil(2.0 / (cutoff * h))))
    return signals.each(lambda signal: sosfiltfilt(sos, signal, axis=0, padlen=padding))


def _joined(parts: list[Signals]) -> Signals:
    def stacked(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in parts])

    return Signals(*map(stacked, ("time", "position", "velocity", "acceleration", "torque")))
