"""What is told while a fit runs, and how it is told to stop."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from threading import Event

# Called once per iteration, with its number (from 1), the loss, and the columns of y that it is of.
Report = Callable[[int, float, Sequence[int]], object]


class Monitor:
    """The one object that a fit hands down: it shows progress, and ends the fit upon Ctrl-C.

    An optimiser calls `iteration` once per iteration, and does its work inside `keeping_the_best`: Ctrl-C then ends the
    work and sets `stopped`, here and in all monitors made from this one by `seen_as`, in whatever thread they are.

    Parameters
    ----------
    report : callable, default=None
        report(iteration, loss, outputs), once per iteration.
    """

    def __init__(self, report: Report | None = None):
        self._report = report
        self._stop = Event()
        self._n_before, self._factor, self._shift = 0, 1.0, 0.0
        self._outputs: Sequence[int] = range(0)

    def seen_as(
        self, n_before: int = 0, factor: float = 1.0, shift: float = 0.0, outputs: Sequence[int] | None = None
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
        """
        part = copy(self)
        part._n_before += n_before
        part._shift += shift * self._factor
        part._factor *= factor
        part._outputs = self._outputs if outputs is None else outputs
        return part

    def silent(self) -> Monitor:
        """The same monitor for a part of the fit of which nobody is told; it ends like the others."""
        part = copy(self)
        part._report = None
        return part

    def iteration(self, number: int, loss: float) -> None:
        """Tell of an iteration; raises KeyboardInterrupt once the fit has been told to stop.

        A StopIteration, by which callbacks of SciPy's optimisers end them, tells it to.
        """
        if self.stopped:
            raise KeyboardInterrupt
        if self._report is not None:
            try:
                self._report(self._n_before + number, self._factor * loss + self._shift, self._outputs)
            except StopIteration:
                raise KeyboardInterrupt from None

    @property
    def stopped(self) -> bool:
        """Whether Ctrl-C has ended the fit."""
        return self._stop.is_set()

    def stop(self) -> None:
        """End all that is handed this monitor at its next iteration."""
        self._stop.set()

    @contextmanager
    def keeping_the_best(self) -> Iterator[None]:
        """What is done inside ends upon Ctrl-C, without an error: what it has found so far counts."""
        try:
            yield
        except KeyboardInterrupt:
            self.stop()


class Progress:
    """Print iteration, bound and time: about once a second at verbosity 1, at each iteration from 2.

    Parameters
    ----------
    verbose : int
    """

    def __init__(self, verbose: int):
        self._verbose = verbose
        self._start = self._last = time.monotonic()

    def __call__(self, iteration: int, loss: float, outputs: Sequence[int]) -> None:
        now = time.monotonic()
        if iteration > 1 and self._verbose < 2 and now - self._last < 1.0:
            return
        self._last = now
        print(f"iteration {iteration:6d}   bound {-loss:16.3f}   {now - self._start:8.1f} s")


def monitor_of(verbose: int, callback: Report | None = None) -> Monitor:
    """The monitor of a fit that prints as ``verbose`` says, and calls callback(iteration, bound, outputs)."""
    progress = Progress(verbose) if verbose else None
    if callback is None:
        return Monitor(progress)

    def report(iteration: int, loss: float, outputs: Sequence[int]) -> None:
        if progress is not None:
            progress(iteration, loss, outputs)
        callback(iteration, -loss, outputs)

    return Monitor(report)
