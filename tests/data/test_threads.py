"""Sums in a fixed order, threads that hold few parts at a time, libraries held to one thread."""

from concurrent.futures import ThreadPoolExecutor
from threading import Event, get_ident

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from skevgp import EVGPRegressor
from skevgp.data.threads import BlockMap, side_by_side, single_threaded_libraries, thread_pool
from skevgp.solvers import LBFGS
from skevgp.utils.monitor import Monitor


@pytest.fixture
def threads():
    pool = BlockMap(2)
    yield pool
    pool.close()


def numbers_of_threads():
    return {library["user_api"]: library["num_threads"] for library in threadpool_info()}


def test_several_threads_are_others_and_results_come_in_the_parts_order(threads):
    first_is_late = Event()

    def slow_first(part):
        if part == 0:
            assert first_is_late.wait(60.0)
        elif part == 1:
            first_is_late.set()
        return part, get_ident()

    results = list(threads(slow_first, range(9)))
    assert [part for part, _ in results] == list(range(9))
    assert get_ident() not in {ident for _, ident in results}


def test_few_parts_are_under_way_at_once(threads):
    """So that the memory of what they make does not grow with their number."""
    taken = []

    def parts():
        for part in range(50):
            taken.append(part)
            yield part

    for done, _ in enumerate(threads(lambda part: part, parts()), 1):
        assert len(taken) <= done + 4


def test_error_in_a_thread_reaches_the_caller_and_ends_the_rest(threads):
    seen = []

    def fails(part):
        seen.append(part)
        if part == 3:
            raise ValueError("part 3")
        return part

    with pytest.raises(ValueError, match="part 3"):
        list(threads(fails, range(1000)))
    assert len(seen) < 20


def test_jobs_that_ctrl_c_kept_from_a_start_return_their_best():
    class Jobs(list):
        def __iter__(self):
            yield self[0]
            raise KeyboardInterrupt

    monitor = Monitor()
    assert side_by_side(lambda job: (job, monitor.stopped), Jobs("abc"), 2, monitor)[1:] == [("b", True), ("c", True)]


def test_libraries_are_limited_in_any_thread_and_set_free_afterwards():
    def limited():
        with single_threaded_libraries():
            return numbers_of_threads()

    before = numbers_of_threads()
    assert set(limited().values()) == {1}
    with ThreadPoolExecutor(1) as other:
        assert set(other.submit(limited).result().values()) == {1}
    with single_threaded_libraries(), single_threaded_libraries(), thread_pool(1) as pool:
        assert set(pool.submit(numbers_of_threads).result().values()) == {1}
    assert numbers_of_threads() == before


def test_nested_thread_limits_are_released_once():
    """Whichever came first."""
    second_is_in, first_is_out = Event(), Event()

    def second():
        with single_threaded_libraries():
            second_is_in.set()
            assert first_is_out.wait(60.0)

    def first(pool):
        with single_threaded_libraries():
            late = pool.submit(second)
            assert second_is_in.wait(60.0)
        return late

    with threadpool_limits(2), ThreadPoolExecutor(2) as pool:
        before = numbers_of_threads()
        assert set(before.values()) == {2}
        late = pool.submit(first, pool).result()
        assert numbers_of_threads()["blas"] == 1
        first_is_out.set()
        late.result()
        assert numbers_of_threads() == before


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_fits_have_same_bits_in_any_thread():
    """Wherever BLAS and OpenMP were limited before, and for any n_jobs, k-means of restarts included."""
    rng = np.random.RandomState(0)
    rows = rng.randn(12_000, 4)
    target = np.column_stack([np.sin(rows[:, 0]), rows[:, 1] * rows[:, 2]])

    def points(n_jobs):
        fitted = EVGPRegressor(
            n_inducing=20, sharing="none", solver=LBFGS(n_restarts=1), max_iter=2, n_jobs=n_jobs, random_state=0
        )
        return fitted.fit(rows, target).inducing_points_

    expected = points(1)
    np.testing.assert_array_equal(points(2), expected)
    with ThreadPoolExecutor(1) as other:
        np.testing.assert_array_equal(other.submit(points, 1).result(), expected)
