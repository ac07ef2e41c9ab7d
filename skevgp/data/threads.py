"""Sums in a fixed order and jobs side by side, in threads that hold BLAS and OpenMP to one thread each."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import lru_cache
from itertools import islice
from sys import modules
from threading import Lock
from typing import Any, TypeVar

from threadpoolctl import OpenBLASController, ThreadpoolController, threadpool_limits

from ..utils.monitor import Monitor

Part = TypeVar("Part")
Total = TypeVar("Total")

_lock, _users, _limits = Lock(), 0, list[Any]()


@contextmanager
def single_threaded_libraries() -> Iterator[None]:
    """Hold BLAS and OpenMP to one thread: results then do not depend on how many there could be.

    The limit on BLAS is the process's: of several fits at once the first sets it and the last lifts it. That on OpenMP
    is each thread's own.
    """
    global _users
    with _one_thread("openmp"):
        with _lock:
            if _users == 0:
                _take_control()
                _limits.append(_one_thread("blas"))
            _users += 1
        try:
            yield
        finally:
            with _lock:
                _users -= 1
                if _users == 0:
                    _take_control()
                    _limits.pop().restore_original_limits()


def _one_thread(user_api: str) -> Any:
    """A limit on these libraries only: one of `threadpool_limits`, when lifted, also sets the others back."""
    return _controller(len(modules)).select(user_api=user_api).limit(limits=1)


@lru_cache(maxsize=1)
def _controller(n_modules: int) -> ThreadpoolController:
    """What controls the libraries that are loaded: to look for them takes milliseconds, and imports load more."""
    return ThreadpoolController()


def _take_control() -> None:
    """Let this thread limit OpenBLAS, whichever did before it.

    From threadpoolctl 3.6 on the first thread that sets a limit is the only one that can, while it lives; a fit may run
    in any thread, and the lock above keeps several from fighting.
    """
    if hasattr(OpenBLASController, "clear_controlling_thread"):
        OpenBLASController.clear_controlling_thread(force=True)


def thread_pool(n_threads: int) -> ThreadPoolExecutor:
    """Threads in which BLAS and OpenMP are held to one thread."""
    return ThreadPoolExecutor(n_threads, initializer=threadpool_limits, initargs=(1,))


def add(first: Any, second: Any) -> Any:
    """First + second; of tuples, entry by entry."""
    if isinstance(first, tuple):
        return tuple(a + b for a, b in zip(first, second, strict=True))
    return first + second


def ordered_sum(parts: Iterable[Any]) -> Any:
    """The sum of at least one part, from the first to the last."""
    iterator = iter(parts)
    total = next(iterator)
    for part in iterator:
        total = add(total, part)
    return total


class BlockMap:
    """Apply a function to parts of the data, in threads if there are several, and yield results in the parts' order.

    Few parts are under way at once, so that memory does not grow with their number, and the order of summation never
    depends on the number of threads, so neither do the bits of a sum.
    """

    def __init__(self, n_threads: int = 1):
        self._n_threads = n_threads
        self._pool = thread_pool(n_threads) if n_threads > 1 else None

    def __call__(self, function: Callable[[Part], Total], parts: Iterable[Part]) -> Iterator[Total]:
        if self._pool is None:
            yield from map(function, parts)
            return
        waiting = iter(parts)
        running: deque[Future[Total]] = deque()
        try:
            for part in islice(waiting, 2 * self._n_threads):
                running.append(self._pool.submit(function, part))
            while running:
                result = running.popleft().result()
                for part in islice(waiting, 1):
                    running.append(self._pool.submit(function, part))
                yield result
        finally:
            for future in running:
                future.cancel()

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()


def side_by_side(one: Callable[[Part], Total], jobs: Sequence[Part], n_threads: int, monitor: Monitor) -> list[Total]:
    """Each job's result; Ctrl-C stops the monitor, upon which jobs end with what they have."""
    results: list[Total] = []
    if n_threads < 2:
        for job in jobs:
            results.append(one(job))
        return results
    futures: list[Future[Total]] = []
    with thread_pool(n_threads) as pool:
        with monitor.keeping_the_best():
            for job in jobs:
                futures.append(pool.submit(one, job))
            done, _ = wait(futures, return_when=FIRST_EXCEPTION)
            if any(future.exception() for future in done):
                # The error is the result: nobody waits for the others.
                monitor.stop()
                pool.shutdown(wait=False, cancel_futures=True)
                next(future for future in futures if future in done and future.exception()).result()
        futures += [pool.submit(one, job) for job in jobs[len(futures) :]]
        return [future.result() for future in futures]
