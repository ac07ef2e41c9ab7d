"""Progress of a fit, and how a fit is told to stop."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from threading import Event, Lock, current_thread, main_thread
from types import FrameType
from typing import Any, TextIO

from .optional import require

# Called once per iteration, with its number (from 1), the loss, and the columns of y that are fitted.
Report = Callable[[int, float, Sequence[int]], object]
# Seconds between two lines: where a line is drawn over the one before, and where lines follow each other.
_LIVE, _LOG = 0.2, 10.0


class Monitor:
    """The object that a fit hands down. It shows progress, and ends the fit upon Ctrl-C or when its time is over.

    An optimiser calls `iteration` once per iteration and works inside `keeping_the_best`. There, Ctrl-C ends the work
    and sets `stopped`, for this monitor and for all parts made from it, in all threads. `monitor_of` says what Ctrl-C
    does elsewhere.

    Parameters
    ----------
    report : callable, default=None
        report(iteration, loss, outputs), called once per iteration.
    progress : Progress, default=None
        Shows iterations to the user.
    max_time : float, default=None
        Number of seconds from now on after which the fit ends. `out_of_time` then is True.
    clock : callable
        Returns seconds.
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
        # All parts share the objects below, except that `with_time` gives a part its own _late.
        # Whether the fit was stopped, the time of this part is over, and that of some part is.
        self._stop, self._late, self._some_late = Event(), Event(), Event()
        # Whether there may be something to keep, and how many `keeping_the_best` the main thread is inside of.
        self._found, self._inside = Event(), [0]
        self._n_before, self._factor, self._shift, self._about = 0, 1.0, 0.0, ""
        self._outputs: Sequence[int] = range(0)

    def seen_as(
        self,
        n_before: int = 0,
        factor: float = 1.0,
        shift: float = 0.0,
        outputs: Sequence[int] | None = None,
        about: str = "",
    ) -> Monitor:
        """The monitor of a part of the fit.

        Parameters
        ----------
        n_before : int, default=0
            Number of iterations before the first of the part.
        factor, shift : float, default=1, 0
            The loss of the whole is ``factor`` times the loss of the part, plus ``shift``.
        outputs : sequence of int, default=None
            Columns of y that the part fits. If None, those of this monitor.
        about : str, default=""
            Name of the part, for the user.
        """
        part = copy(self)
        part._n_before += n_before
        part._shift += shift * self._factor
        part._factor *= factor
        part._outputs = self._outputs if outputs is None else outputs
        part._about = ", ".join(filter(None, [self._about, about]))
        return part

    def with_time(self, share: float) -> Monitor:
        """The monitor of a part that has a share of the time that is left. Only the part ends when that is over."""
        part = copy(self)
        if self._end is not None:
            now = self._clock()
            part._end, part._late = now + share * (self._end - now), Event()
        return part

    def silent(self) -> Monitor:
        """The monitor of a part that is not reported. It ends as the others do."""
        part = copy(self)
        part._report = part._progress = None
        return part

    def iteration(self, number: int, loss: float) -> None:
        """Report an iteration, or raise KeyboardInterrupt if the fit is to end.

        A report may end the fit by KeyboardInterrupt, or by StopIteration as callbacks of SciPy do.
        """
        if self._end is not None and self._clock() >= self._end:
            self._late.set()
            self._some_late.set()
        if self.stopped:
            raise KeyboardInterrupt
        number, loss = self._n_before + number, self._factor * loss + self._shift
        if self._progress is not None:
            self._progress(number, loss, self._about)
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
        """Whether the time of some part of the fit was over."""
        return self._some_late.is_set()

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C or a report has ended the fit."""
        return self._stop.is_set()

    @property
    def finishes(self) -> bool:
        """Whether an error in the main thread would now lose what was found."""
        return self._found.is_set() and self._inside[0] == 0

    def stop(self) -> None:
        """End all parts at their next iterations."""
        self._stop.set()

    @contextmanager
    def keeping_the_best(self, patient: bool = False) -> Iterator[None]:
        """Ctrl-C ends the work inside without an error: the best found so far counts.

        Parameters
        ----------
        patient : bool, default=False
            Whether only a second Ctrl-C ends the work, because its result is not at hand yet.
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


class Progress:
    """Show the part of the fit, iteration, bound and seconds so far.

    At verbosity 1, tqdm draws one live line, if it is installed and the stream is a terminal or a notebook. Otherwise
    there is a line every ten seconds, and the last one. From verbosity 2, there is a line for each iteration. Where
    several models are fitted side by side, a line is about the model that has just had an iteration.

    Parameters
    ----------
    verbose : int
        Verbosity, at least 1.
    stream : file, default=None
        If None, the standard output.
    clock : callable
        Returns seconds.
    """

    def __init__(self, verbose: int, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic):
        self._verbose, self._clock = verbose, clock
        self._stream = sys.stdout if stream is None else stream
        self._tqdm = _tqdm_on(self._stream) if verbose == 1 else None
        self._bar: Any = None
        self._seconds = 0.0 if verbose > 1 else _LOG if self._tqdm is None else _LIVE
        self._start = self._last = clock()
        self._lock = Lock()
        # The last iteration, if it is not shown yet: number, loss, part of the fit, seconds.
        self._told: tuple[int, float, str, float] | None = None

    def __call__(self, number: int, loss: float, about: str) -> None:
        """Tell of an iteration."""
        with self._lock:
            now = self._clock()
            self._told = number, loss, about, now - self._start
            if now - self._last >= self._seconds:
                self._last = now
                self._show()

    def close(self) -> None:
        """Show the last iteration, and end the line."""
        with self._lock:
            self._show()
            if self._bar is not None:
                self._bar.close()

    def _show(self) -> None:
        if self._told is None:
            return
        (number, loss, about, seconds), self._told = self._told, None
        text = f"iteration {number:6d}   bound {-loss:16.3f}   {seconds:8.1f} s"
        if self._verbose == 1:
            text = ", ".join(filter(None, [about, f"iteration {number}", f"bound {-loss:.3f}", f"{seconds:.0f} s"]))
        if self._tqdm is None:
            print(text, file=self._stream, flush=True)
        elif self._bar is None:
            # On a terminal, an empty bar fills the line and cuts off what is longer.
            fills = self._stream.isatty()
            self._bar = self._tqdm(desc=text, bar_format="{desc}{bar}", file=self._stream, dynamic_ncols=fills)
        else:
            self._bar.set_description_str(text, refresh=False)
            # Not `refresh`: Ctrl-C inside of it would leave the lock that all bars share locked.
            if not self._bar.disable:
                self._bar.display()


def _tqdm_on(stream: TextIO | None) -> Any:
    """The class of tqdm's bars, or None if it is not installed or cannot draw over a line of the stream."""
    try:
        auto, plain = (require(f"tqdm.{name}", "A progress bar") for name in ("auto", "asyncio"))
    except ImportError:
        return None
    # In notebooks, the automatic class is not the plain one.
    return auto.tqdm if auto.tqdm is not plain.tqdm or (stream is not None and stream.isatty()) else None


@contextmanager
def monitor_of(verbose: int, callback: Report | None = None, max_time: float | None = None) -> Iterator[Monitor]:
    """The monitor of a fit, which shows progress as ``verbose`` says and calls callback(iteration, bound, outputs).

    Once there is something to keep, the first Ctrl-C outside of `Monitor.keeping_the_best` stops the monitor without an
    error, so that the fit is put together. A second one raises KeyboardInterrupt.
    """
    progress = Progress(verbose) if verbose else None
    report = callback and (lambda number, loss, outputs: callback(number, -loss, outputs))
    monitor = Monitor(report, progress, max_time)

    def handle(number: int, frame: FrameType | None) -> None:
        if not monitor.finishes or monitor.interrupted:
            signal.default_int_handler(number, frame)
        monitor.stop()

    # Other threads get no Ctrl-C, and a user's own handler stays.
    waits = current_thread() is main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if waits:
        signal.signal(signal.SIGINT, handle)
    try:
        yield monitor
    finally:
        if waits:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        if progress is not None:
            progress.close()
