"""What is told while a fit runs, and how it is told to stop."""

from __future__ import annotations

import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from math import log
from threading import Event, Lock, current_thread, main_thread
from types import FrameType
from typing import TextIO

# Called once per iteration, with its number (from 1), the loss, and the columns of y that it is of.
Report = Callable[[int, float, Sequence[int]], object]
# Seconds between two looks of a line: on a terminal, and in a log.
_LIVE, _LOG = 0.5, 10.0
# A third of the fewest iterations that tell when the others end; L-BFGS needs about as many to see that it stalls.
_FEW = 4


class Monitor:
    """The one object that a fit hands down: it shows progress, and ends the fit upon Ctrl-C or when its time is over.

    An optimiser calls `iteration` once per iteration, and does its work inside `keeping_the_best`: Ctrl-C then ends the
    work and sets `stopped`, here and in all monitors made from this one by `seen_as`, in whatever thread they are. What
    comes between and after is short: once there is something to keep, Ctrl-C waits for its end, and a second one does
    not (`monitor_of`).

    Parameters
    ----------
    report : callable, default=None
        report(iteration, loss, outputs), once per iteration.
    progress : Progress, default=None
        Told the same and more.
    max_time : float, default=None
        Seconds from now on; then it ends the fit as Ctrl-C does, but says so by `out_of_time`.
    clock : callable
        Seconds.
    """

    def __init__(
        self,
        report: Report | None = None,
        progress: Progress | None = None,
        max_time: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._report, self._progress, self.max_time, self._clock = report, progress, max_time, clock
        self._end = None if max_time is None else clock() + max_time
        # Of all parts; that of the own part is over; that of some part was.
        self._stop, self._late, self._some_late = Event(), Event(), Event()
        # Whether something may have been found, and how many `keeping_the_best` the main thread is inside of.
        self._found, self._inside = Event(), [0]
        self._n_before, self._factor, self._shift = 0, 1.0, 0.0
        self._about, self._is_last = tuple[str, ...](), True
        self._outputs: Sequence[int] = range(0)

    def seen_as(
        self,
        n_before: int = 0,
        factor: float = 1.0,
        shift: float = 0.0,
        outputs: Sequence[int] | None = None,
        about: str = "",
        is_last: bool = True,
    ) -> Monitor:
        """The same monitor for a part of the fit: after so many iterations, its loss in other units.

        Parameters
        ----------
        n_before : int, default=0
            Iterations before the part's first.
        factor, shift : float, default=1, 0
            The part's loss, times ``factor`` plus ``shift``, is the loss of the whole.
        outputs : sequence of int, default=None
            The columns of y that the part is of, if it knows better.
        about : str, default=""
            What part it is, for whoever looks on.
        is_last : bool, default=True
            Whether the whole is done when the part is.
        """
        part = copy(self)
        part._n_before += n_before
        part._shift += shift * self._factor
        part._factor *= factor
        part._outputs = self._outputs if outputs is None else outputs
        part._about += (about,) if about else ()
        part._is_last &= is_last
        return part

    def with_time(self, share: float) -> Monitor:
        """The same monitor for a part of the fit that has a share of the time that is left: only it ends with that."""
        part = copy(self)
        if self._end is not None:
            now = self._clock()
            part._end, part._late = now + share * (self._end - now), Event()
        return part

    def silent(self) -> Monitor:
        """The same monitor for a part of the fit of which nobody is told; it ends like the others."""
        part = copy(self)
        part._report = part._progress = None
        return part

    def iteration(self, number: int, loss: float, most: int | None = None, enough: float | None = None) -> None:
        """Tell of an iteration; raises KeyboardInterrupt once the fit has been told to stop.

        A StopIteration, by which callbacks of SciPy's optimisers end them, tells it to.

        Parameters
        ----------
        number : int
        loss : float
        most : int, default=None
            The most iterations.
        enough : float, default=None
            The optimiser ends before that when iterations gain less.
        """
        if self._end is not None and self._clock() >= self._end:
            self._late.set()
            self._some_late.set()
        if self.stopped:
            raise KeyboardInterrupt
        number, loss = self._n_before + number, self._factor * loss + self._shift
        if self._progress is not None:
            most = self._n_before + most if self._is_last and most is not None else None
            enough = None if enough is None else self._factor * enough
            self._progress(number, loss, self._outputs, ", ".join(self._about), most, enough)
        if self._report is not None:
            try:
                self._report(number, loss, self._outputs)
            except StopIteration:
                raise KeyboardInterrupt from None

    @property
    def stopped(self) -> bool:
        """Whether Ctrl-C has ended the fit, or the time of this part is over."""
        return self._stop.is_set() or self._late.is_set()

    @property
    def out_of_time(self) -> bool:
        """Whether some part of the fit ended because its time was over."""
        return self._some_late.is_set()

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C, or who looks on, has ended the fit."""
        return self._stop.is_set()

    @property
    def finishes(self) -> bool:
        """Whether what was found would be lost if the main thread were interrupted now."""
        return self._found.is_set() and self._inside[0] == 0

    def stop(self) -> None:
        """End all that is handed this monitor at its next iteration."""
        self._stop.set()

    @contextmanager
    def keeping_the_best(self, patient: bool = False) -> Iterator[None]:
        """What is done inside ends upon Ctrl-C, without an error: what it has found so far counts.

        Parameters
        ----------
        patient : bool, default=False
            Whether it ends at the second one only, since what is found is not at hand yet.
        """
        own = not patient and current_thread() is main_thread()
        self._inside[0] += own
        try:
            yield
        except KeyboardInterrupt:
            if not self._late.is_set():
                self.stop()
        finally:
            self._found.set()
            self._inside[0] -= own


class _Way:
    """The iterations from one start, and how long they will go on."""

    def __init__(self, about: str):
        self.about, self.number = about, 0
        self.times, self.losses = list[float](), list[float]()

    def left(self, most: int | None, enough: float | None) -> float | None:
        """In seconds; None as long as that cannot be known.

        Gains fall as they fell from one third of the iterations to the next, the last, until they are small enough.
        """
        window = (len(self.losses) - 1) // 3
        if most is None or window < _FEW:
            return None
        n_left = float(most - self.number)
        if enough:
            before = self.losses[-1 - 2 * window] - self.losses[-1 - window]
            now, least = self.losses[-1 - window] - self.losses[-1], enough * window
            if now > least and not now < before:
                return None
            windows = log(now / least) / log(before / now) - 0.5 if now > least else 0.0
            n_left = min(n_left, max(windows, 0.0) * window + _FEW)
        return n_left * (self.times[-1] - self.times[-1 - window]) / window


class Progress:
    """Print iteration, bound and time: at verbosity 1 in one live line, at each iteration from 2.

    The line also tells the part of the fit and, once it can be known, about how much time is left for it. Where outputs
    have fits of their own it is of the one that has just had an iteration. What is no terminal gets a line each ten
    seconds, and the last.

    Parameters
    ----------
    verbose : int
    stream : file, default=None
        None means the standard output.
    clock : callable
        Seconds.
    """

    def __init__(self, verbose: int, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic):
        self._verbose, self._clock = verbose, clock
        self._stream = sys.stdout if stream is None else stream
        self._is_live = verbose == 1 and self._stream is not None and self._stream.isatty()
        self._start = self._last = clock()
        self._lock, self._ways = Lock(), dict[tuple[int, ...], _Way]()
        self._text: Callable[[], str] | None = None
        self._width = 0

    def __call__(
        self, number: int, loss: float, outputs: Sequence[int], about: str, most: int | None, enough: float | None
    ) -> None:
        """Tell of an iteration; arguments as of `Monitor`."""
        with self._lock:
            now = self._clock()
            if self._verbose > 1:
                print(f"iteration {number:6d}   bound {-loss:16.3f}   {now - self._start:8.1f} s", file=self._stream)
                return
            way = self._ways.get(tuple(outputs))
            if way is None or (way.about, way.number + 1) != (about, number):
                way = self._ways[tuple(outputs)] = _Way(about)
            way.number = number
            way.times.append(now)
            way.losses.append(loss)

            def text() -> str:
                left = way.left(most, enough)
                parts = [about, f"iteration {number}", f"bound {-loss:.3f}", f"{now - self._start:.0f} s"]
                return ", ".join(filter(None, [*parts, "" if left is None else f"about {_rounded(left)} left"]))

            self._text = text
            if now - self._last >= (_LIVE if self._is_live else _LOG):
                self._last = now
                self._show()

    def close(self) -> None:
        """The fit is done: the line is the last."""
        with self._lock:
            self._show()
            if self._width > 0:
                print(file=self._stream)
            self._width = 0

    def _show(self) -> None:
        if self._text is None:
            return
        line, self._text = self._text(), None
        if self._is_live:
            # One longer than the terminal could not be written over.
            line = line[: shutil.get_terminal_size().columns - 1]
            print("\r" + line.ljust(self._width), end="", file=self._stream, flush=True)
            self._width = len(line)
        else:
            print(line, file=self._stream, flush=True)


def _rounded(seconds: float) -> str:
    return f"{float(f'{max(seconds, 1.0):.1g}'):.0f} s" if seconds < 95.0 else f"{seconds / 60.0:.0f} min"


@contextmanager
def monitor_of(verbose: int, callback: Report | None = None, max_time: float | None = None) -> Iterator[Monitor]:
    """The monitor of a fit that prints as ``verbose`` says, and calls callback(iteration, bound, outputs)."""
    progress = Progress(verbose) if verbose else None
    report = callback and (lambda number, loss, outputs: callback(number, -loss, outputs))
    monitor = Monitor(report, progress, max_time)
    try:
        with _waiting_for(monitor):
            yield monitor
    finally:
        if progress is not None:
            progress.close()


@contextmanager
def _waiting_for(monitor: Monitor) -> Iterator[None]:
    """Ctrl-C stops a monitor that finishes, and what it is handed to comes to its end."""
    # Other threads get no Ctrl-C; whoever handles it in a way of their own goes on to do so.
    if current_thread() is not main_thread() or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return

    def handle(number: int, frame: FrameType | None) -> None:
        if not monitor.finishes or monitor.interrupted:
            signal.default_int_handler(number, frame)
        monitor.stop()

    signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
