"""Rows in files and in memory: the same model, without a copy of the data."""

import tracemalloc
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pandas as pd
import pytest
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures, StandardScaler
from threadpoolctl import threadpool_info

from skevgp import EVGPRegressor
from skevgp.rows.blocks import LocalBlocks, block_rows
from skevgp.rows.source import LocalSource, Moments, moments_of_rows
from skevgp.rows.threads import BlockMap, single_threaded_libraries, thread_pool
from skevgp.solvers import LBFGS

RNG = np.random.RandomState(0)
X = RNG.uniform(-2.0, 2.0, (400, 2))
Y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], X[:, 0] * X[:, 1]]) + 0.05 * RNG.randn(400, 2)
X_NEW = RNG.uniform(-2.0, 2.0, (50, 2))

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


def model(**parameters):
    maps = {"feature_map": PolynomialFeatures(1), "kernel_map": StandardScaler()}
    return EVGPRegressor(**{"n_inducing": 12, "max_iter": 4, "random_state": 0, **maps, **parameters})


@pytest.fixture
def in_pieces(monkeypatch):
    """As if there were so many rows that nothing of them can be kept."""
    monkeypatch.setattr("skevgp.rows.mapped.MAPPED_BYTES", 0)
    monkeypatch.setattr("skevgp.rows.blocks.CACHE_BYTES", 0)
    monkeypatch.setattr("skevgp.rows.source.PASS_ROWS", 70)
    monkeypatch.setattr("skevgp.rows.blocks._MIN_BLOCK_ROWS", 30)
    monkeypatch.setattr("skevgp.rows.blocks._BLOCK_NUMBERS", 30)
    monkeypatch.setattr("skevgp.rows.blocks._WORTH_THREADS", 0)


@pytest.mark.parametrize("sharing", ["all", "none"])
@pytest.mark.parametrize("solver", ["lbfgs", "adam"])
def test_what_is_made_again_at_each_pass_gives_the_same(request, sharing, solver):
    expected = model(sharing=sharing, solver=solver).fit(X, Y)
    request.getfixturevalue("in_pieces")
    pieces = model(sharing=sharing, solver=solver).fit(X, Y)
    # Adam's first steps divide gradients by their size: those that only rounding makes differ from 0 move too.
    rtol, atol = {"lbfgs": (1e-6, 0.0), "adam": (0.0, 1e-4)}[solver]
    np.testing.assert_allclose(pieces.predict(X_NEW), expected.predict(X_NEW), rtol=rtol, atol=atol)
    assert pieces.lower_bound_ == pytest.approx(expected.lower_bound_, rel=1e-4 if atol else 1e-8)


def test_a_map_whose_width_changes_from_piece_to_piece_is_named(in_pieces, monkeypatch):
    monkeypatch.setattr("skevgp.rows.mapped.MAP_ROWS", 70)
    widening = FunctionTransformer(lambda rows: np.ones((len(rows), 1 if len(rows) == 70 else 2)))
    with pytest.raises(ValueError, match=r"same number of columns for all rows; they returned \(2, 1\) and \(2, 2\)"):
        model(feature_map=widening, kernel_map=None).fit(X, Y)


def test_pieces_in_threads_have_the_same_bits(in_pieces):
    fits = [model(n_jobs=n_jobs).fit(X, Y) for n_jobs in (1, 2, 3)]
    for other in fits[1:]:
        np.testing.assert_array_equal(other.predict(X_NEW), fits[0].predict(X_NEW))


@pytest.fixture
def little_memory(monkeypatch):
    for name in ("rows.mapped.MAPPED_BYTES", "rows.blocks.CACHE_BYTES", "rows.blocks.KEEP_BYTES"):
        monkeypatch.setattr(f"skevgp.{name}", 2**20)


@pytest.mark.slow
@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_memory_mapped_files_are_not_copied(tmp_path, dtype, little_memory):
    n, d = 500_000, 8
    rng = np.random.RandomState(0)
    np.save(tmp_path / "X.npy", rng.uniform(-2.0, 2.0, (n, d)).astype(dtype))
    np.save(tmp_path / "y.npy", np.sin(rng.randn(n)).astype(dtype))
    mapped = [np.load(tmp_path / name, mmap_mode="r") for name in ("X.npy", "y.npy")]
    tracemalloc.start()
    EVGPRegressor(n_inducing=5, max_iter=1, random_state=0).fit(*mapped)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 0.9 * mapped[0].nbytes


@pytest.mark.slow
@pytest.mark.slow
def test_memory_does_not_grow_with_the_rows(little_memory, tmp_path):
    """Beyond what may be kept, four times the rows need no more memory."""
    peaks = []
    for n in (50_000, 200_000):
        np.save(tmp_path / "X.npy", RNG.uniform(-2.0, 2.0, (n, 8)))
        np.save(tmp_path / "y.npy", RNG.randn(n))
        mapped = [np.load(tmp_path / name, mmap_mode="r") for name in ("X.npy", "y.npy")]
        tracemalloc.start()
        model(kernel_map=None, max_iter=1).fit(*mapped)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0] + 2**20


def test_memory_mapped_files_and_frames_give_the_same(tmp_path):
    expected = model().fit(X, Y).predict(X_NEW)
    np.save(tmp_path / "X.npy", X)
    np.save(tmp_path / "Y.npy", Y)
    mapped = [np.load(tmp_path / name, mmap_mode="r") for name in ("X.npy", "Y.npy")]
    np.testing.assert_array_equal(model().fit(*mapped).predict(X_NEW), expected)
    frame, new = (pd.DataFrame(rows, columns=["a", "b"]) for rows in (X, X_NEW))
    # The order of a frame in memory is another, and so is the rounding.
    np.testing.assert_allclose(model().fit(frame, Y).predict(new), expected, rtol=1e-8)


def test_single_precision_is_computed_in_double():
    X32, Y32 = X.astype(np.float32), Y.astype(np.float32)
    single, double = model().fit(X32, Y32), model().fit(X32.astype(float), Y32.astype(float))
    np.testing.assert_array_equal(single.predict(X_NEW), double.predict(X_NEW))
    assert single.predict(X_NEW.astype(np.float32)).dtype == np.float64


def test_moments_of_pieces_are_those_of_the_whole():
    values = RNG.randn(100, 3) * [1.0, 1e-3, 0.0] + [1e6, 0.0, 7.0]
    whole = Moments.of(values)
    pieces = Moments.of(values[:1]) + Moments.of(values[1:40]) + Moments.of(values[40:])
    np.testing.assert_allclose(pieces.mean, values.mean(axis=0), rtol=1e-15)
    np.testing.assert_allclose(pieces.variance, values.var(axis=0), rtol=1e-9)
    np.testing.assert_allclose(pieces.rms, np.sqrt(np.mean(values**2, axis=0)), rtol=1e-14)
    for name in ("n", "lowest", "highest"):
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name))
    assert pieces.variance[2] == 0.0
    assert pieces.mean[2] == 7.0


def test_a_source_hands_out_rows_by_index(monkeypatch):
    monkeypatch.setattr("skevgp.rows.source.PASS_ROWS", 7)
    source = LocalSource.of(X, Y, Y[:, :1])
    raw = source.take(np.array([5, 2]))
    np.testing.assert_array_equal(raw.inputs, X[[5, 2]])
    np.testing.assert_allclose(source.sum(moments_of_rows)[1].mean, Y.mean(axis=0), rtol=1e-12)


def test_an_error_in_a_thread_reaches_the_caller_and_ends_the_rest():
    seen = []

    def fails(part):
        seen.append(part)
        if part == 3:
            raise ValueError("part 3")
        return part

    threads = BlockMap(2)
    with pytest.raises(ValueError, match="part 3"):
        list(threads(fails, range(1000)))
    threads.close()
    assert len(seen) < 20


@pytest.mark.parametrize("n_inducing", [1, 10, 100, 1000])
def test_blocks_cover_all_rows_once(n_inducing):
    from skevgp.rows.blocks import Block

    n = 10_001
    blocks = LocalBlocks(lambda rows: Block(None, np.ones((rows.stop - rows.start, 1)), 0), n, n_inducing)
    sizes = [len(blocks[index].linear) for index in range(len(blocks))]
    assert sum(sizes) == n
    assert set(sizes[:-1]) == {block_rows(n_inducing)}
    assert blocks.linear.n_rows == n


def test_every_row_gets_into_mini_batches_however_many_there_are(monkeypatch):
    from skevgp.rows.internal import Rows

    monkeypatch.setattr("skevgp.rows.internal._SHUFFLED_ROWS", 40)
    n = 150
    rows = Rows(
        LocalSource.of(np.arange(n, dtype=float)[:, np.newaxis], np.empty((n, 0)), np.zeros((n, 1))), lambda r: r
    )

    class Identity:
        def prepare(self, inputs):
            return inputs

    batches = rows.batches(Identity(), 32, np.random.RandomState(0))
    seen = [next(batches).block.prepared[:, 0] for _ in range(60)]
    assert {len(batch) for batch in seen} == {32}
    assert all(len(set(batch)) == 32 for batch in seen)
    assert set(np.concatenate(seen)) == set(range(n))


def test_fits_have_the_same_bits_in_any_thread():
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


def test_libraries_are_limited_in_any_thread_and_set_free_afterwards():
    def threads():
        return {library["user_api"]: library["num_threads"] for library in threadpool_info()}

    def limited():
        with single_threaded_libraries():
            return threads()

    before = threads()
    assert set(limited().values()) == {1}
    with ThreadPoolExecutor(1) as other:
        assert set(other.submit(limited).result().values()) == {1}
    with single_threaded_libraries(), single_threaded_libraries(), thread_pool(1) as pool:
        assert set(pool.submit(threads).result().values()) == {1}
    assert threads() == before
