"""Progress of a fit, and requests to stop it."""

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
# Seconds between two lines, if a line is drawn over the last one and if lines follow each other.
_LIVE, _LOG = 0.2, 10.0


class Monitor:
    """Shows the progress of a fit, and ends the fit upon Ctrl-C or when its time is over."""

    def __init__(
        self,
        report: Report | None = None,
        progress: Progress | None = None,
        max_time: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        # An optimiser calls `iteration` once per iteration and works inside `keeping_the_best`. There, Ctrl-C ends the
        # work and sets `stopped`, for this monitor and all parts made from it, in all threads. report(iteration, loss,
        # outputs) is called once per iteration. max_time is in seconds from now; `out_of_time` is True afterwards.
        self._report, self._progress, self.max_time, self._clock = report, progress, max_time, clock
        self._end = None if max_time is None else clock() + max_time
        # All parts share the objects below, except that `with_time` gives a part its own _late.
        # Whether the fit was stopped, the time of this part is over, and that of some part is.
        self._stop, self._late, self._some_late = Event(), Event(), Event()
        # Whether there may be parameters to keep, and the depth of `keeping_the_best` in the main thread.
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
        """Return the monitor of a part of the fit, whose loss times ``factor`` plus ``shift`` is that of the whole."""
        # The part begins after n_before iterations, fits the columns ``outputs`` of y (None: those of this monitor),
        # and is called ``about`` in the progress.
        part = copy(self)
        part._n_before += n_before
        part._shift += shift * self._factor
        part._factor *= factor
        part._outputs = self._outputs if outputs is None else outputs
        part._about = ", ".join(filter(None, [self._about, about]))
        return part

    def with_time(self, share: float) -> Monitor:
        """Return the monitor of a part with a share of the remaining time; only the part ends when that is over."""
        part = copy(self)
        if self._end is not None:
            now = self._clock()
            part._end, part._late = now + share * (self._end - now), Event()
        return part

    def silent(self) -> Monitor:
        """Return the monitor of a part that is not reported, and ends with the others."""
        part = copy(self)
        part._report = part._progress = None
        return part

    def iteration(self, number: int, loss: float) -> None:
        """Report an iteration, or raise KeyboardInterrupt if the fit is to end."""
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
            except StopIteration:  # callbacks of SciPy raise it to end the fit
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
        """Whether an error in the main thread would lose the best parameters so far."""
        return self._found.is_set() and self._inside[0] == 0

    def stop(self) -> None:
        """End all parts at their next iterations."""
        self._stop.set()

    @contextmanager
    def keeping_the_best(self, patient: bool = False) -> Iterator[None]:
        """Let Ctrl-C end the work inside without an error; if patient, only a second Ctrl-C."""
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
    """Shows the part of the fit, iteration, bound and seconds so far, for a verbosity of at least 1."""

    def __init__(self, verbose: int, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic):
        # At verbosity 1, tqdm draws one live line, if it is installed and the stream (by default the standard output)
        # is a terminal or a notebook. Otherwise there is a line every ten seconds, and the last one. From verbosity 2,
        # there is a line for each iteration. If several models are fitted in parallel, a line is about the latest
        # iteration.
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
        """Record an iteration, and show it if it is time."""
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
            # On a terminal, an empty bar fills the line, and longer text is cut off.
            fills = self._stream.isatty()
            self._bar = self._tqdm(desc=text, bar_format="{desc}{bar}", file=self._stream, dynamic_ncols=fills)
        else:
            self._bar.set_description_str(text, refresh=False)
            # `refresh` would hold the lock of all bars, and Ctrl-C inside of it would leave them locked.
            if not self._bar.disable:
                self._bar.display()


def _tqdm_on(stream: TextIO | None) -> Any:
    """Return the class of tqdm's bars, or None if it is not installed or the stream cannot draw over a line."""
    try:
        auto, plain = (require(f"tqdm.{name}", "A progress bar") for name in ("auto", "asyncio"))
    except ImportError:
        return None
    # In notebooks, the automatic class is not the plain one.
    return auto.tqdm if auto.tqdm is not plain.tqdm or (stream is not None and stream.isatty()) else None


@contextmanager
def monitor_of(verbose: int, callback: Report | None = None, max_time: float | None = None) -> Iterator[Monitor]:
    """Make the monitor of a fit, with progress by ``verbose`` and calls of callback(iteration, bound, outputs)."""
    # Once there are parameters to keep, the first Ctrl-C outside of `keeping_the_best` stops the monitor without an
    # error, so that the fit is completed. A second one raises KeyboardInterrupt.
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
