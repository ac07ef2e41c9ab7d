"""Sums in a fixed order, and threads in which BLAS and OpenMP use one thread each."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import lru_cache, reduce
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
    """Limit BLAS and OpenMP to one thread, so that results do not depend on the number of cores."""
    # The limit on BLAS holds for the process: the first of several fits sets it, and the last one removes it. The limit
    # on OpenMP holds for this thread.
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
    """Limit the libraries of one API."""
    # `threadpool_limits` would also reset the others when the limit is removed.
    return _controller(len(modules)).select(user_api=user_api).limit(limits=1)


@lru_cache(maxsize=1)
def _controller(n_modules: int) -> ThreadpoolController:
    """The controller of the loaded libraries. A search takes milliseconds, and is repeated after further imports."""
    return ThreadpoolController()


def _take_control() -> None:
    """Let this thread limit OpenBLAS."""
    # From threadpoolctl 3.6 on, only the first thread that sets a limit can change it, as long as that thread lives. A
    # fit may run in any thread, and the lock above orders several fits.
    if hasattr(OpenBLASController, "clear_controlling_thread"):
        OpenBLASController.clear_controlling_thread(force=True)


def thread_pool(n_threads: int) -> ThreadPoolExecutor:
    """Threads in which BLAS and OpenMP use one thread."""
    return ThreadPoolExecutor(n_threads, initializer=threadpool_limits, initargs=(1,))


def add(first: Any, second: Any) -> Any:
    """Return first + second. Tuples are added entry by entry."""
    if isinstance(first, tuple):
        return tuple(a + b for a, b in zip(first, second, strict=True))
    return first + second


def ordered_sum(parts: Iterable[Any]) -> Any:
    """The sum of at least one part, from the first to the last."""
    return reduce(add, parts)


class BlockMap:
    """Apply a function to parts of the data, in threads if there are several, and yield results in order.

    The bits of a sum over parts do not depend on the number of threads, because its order does not.
    """

    def __init__(self, n_threads: int = 1):
        self._n_threads = n_threads
        self._pool = thread_pool(n_threads) if n_threads > 1 else None

    def __call__(self, function: Callable[[Part], Total], parts: Iterable[Part]) -> Iterator[Total]:
        if self._pool is None:
            yield from map(function, parts)
            return
        # Only a few parts are submitted at once. Memory then does not grow with their number.
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
    """Run jobs in threads, and return their results in order. Ctrl-C stops the monitor, and jobs return their best."""
    if n_threads < 2:
        return [one(job) for job in jobs]
    futures: list[Future[Total]] = []
    with thread_pool(n_threads) as pool:
        with monitor.keeping_the_best():
            for job in jobs:
                futures.append(pool.submit(one, job))
            done, _ = wait(futures, return_when=FIRST_EXCEPTION)
            if any(future.exception() for future in done):
                # The error is raised without waiting for the other jobs.
                monitor.stop()
                pool.shutdown(wait=False, cancel_futures=True)
                next(future for future in futures if future in done and future.exception()).result()
        futures += [pool.submit(one, job) for job in jobs[len(futures) :]]
        return [future.result() for future in futures]
