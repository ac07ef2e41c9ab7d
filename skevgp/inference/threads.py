"""Threads: blocks (or outputs) run side by side, BLAS and OpenMP inside them do not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from typing import Any

from threadpoolctl import threadpool_limits

_lock, _users, _limits = Lock(), 0, None


@contextmanager
def single_threaded_libraries() -> Iterator[None]:
    """Hold BLAS and OpenMP to one thread: results then do not depend on how many there could be.

    The limit is the process's. Of several fits at once the first sets it and the last lifts it.
    """
    global _users, _limits
    with _lock:
        if _users == 0:
            _limits = threadpool_limits(1)
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if _users == 0 and _limits is not None:
                _limits.restore_original_limits()
                _limits = None


class BlockMap:
    """Apply a function to blocks, in threads if there are several, and yield the results in the blocks' order.

    The order of summation never depends on the number of threads, so neither do the bits of a sum.
    """

    def __init__(self, n_threads: int = 1):
        self._pool = ThreadPoolExecutor(n_threads) if n_threads > 1 else None

    def __call__(self, function: Callable[..., Any], *sequences: Sequence[Any]) -> Iterator[Any]:
        if self._pool is None or len(sequences[0]) < 2:
            return map(function, *sequences)
        return self._pool.map(function, *sequences)

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
