"""A line of progress now and then."""

from __future__ import annotations

import time


class Progress:
    """Print iteration, bound and time: about once a second at verbosity 1, at each iteration from 2.

    Parameters
    ----------
    verbose : int
    shift : float
        Subtracted from the loss: from internal units to the user's.
    """

    def __init__(self, verbose: int, shift: float):
        self._verbose, self._shift = verbose, shift
        self._start = self._last = time.monotonic()

    def __call__(self, iteration: int, loss: float) -> None:
        now = time.monotonic()
        if iteration > 1 and self._verbose < 2 and now - self._last < 1.0:
            return
        self._last = now
        print(f"iteration {iteration:6d}   bound {-loss - self._shift:16.3f}   {now - self._start:8.1f} s")
