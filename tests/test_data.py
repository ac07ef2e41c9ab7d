"""Rows in files and in memory: the same model, without a copy of the data."""

import tracemalloc

import numpy as np
import pandas as pd
import pytest
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

from skevgp import EVGPRegressor
from skevgp.inference.blocks import LocalBlocks, block_rows
from skevgp.inference.source import LocalSource, Moments, moments_of_rows
from skevgp.inference.threads import BlockMap

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
    monkeypatch.setattr("skevgp._data.MAPPED_BYTES", 0)
    monkeypatch.setattr("skevgp.inference.blocks.CACHE_BYTES", 0)
    monkeypatch.setattr("skevgp.inference.source.PASS_ROWS", 70)
    monkeypatch.setattr("skevgp.inference.blocks._MIN_BLOCK_ROWS", 30)
    monkeypatch.setattr("skevgp.inference.blocks._BLOCK_NUMBERS", 30)
    monkeypatch.setattr("skevgp.inference.blocks._WORTH_THREADS", 0)


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


def test_pieces_in_threads_have_the_same_bits(in_pieces):
    fits = [model(n_jobs=n_jobs).fit(X, Y) for n_jobs in (1, 2, 3)]
    for other in fits[1:]:
        np.testing.assert_array_equal(other.predict(X_NEW), fits[0].predict(X_NEW))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_memory_mapped_files_are_not_copied(tmp_path, dtype):
    n = 200_000
    rng = np.random.RandomState(0)
    np.save(tmp_path / "X.npy", rng.uniform(-2.0, 2.0, (n, 8)).astype(dtype))
    np.save(tmp_path / "y.npy", np.sin(rng.randn(n)).astype(dtype))
    mapped = [np.load(tmp_path / name, mmap_mode="r") for name in ("X.npy", "y.npy")]
    fitted = EVGPRegressor(n_inducing=5, max_iter=1, random_state=0)
    tracemalloc.start()
    fitted.fit(*mapped)
    fitted.predict(mapped[0], return_std=True)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # The blocks that are kept, k(X_m, X) and V, 10,000 rows for the inducing points: not the 8 columns of float64.
    copies = 8 * 8 * n
    assert peak < 48 * 2**20 + 16 * 2**20
    assert peak < 5 * copies


def test_memory_does_not_grow_with_the_rows(monkeypatch, tmp_path):
    """Beyond what may be kept, four times the rows need no more memory."""
    for name in ("_data.MAPPED_BYTES", "inference.blocks.CACHE_BYTES", "inference.blocks.KEEP_BYTES"):
        monkeypatch.setattr(f"skevgp.{name}", 2**20)
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
    monkeypatch.setattr("skevgp.inference.source.PASS_ROWS", 7)
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
    from skevgp.inference.blocks import Block

    n = 10_001
    blocks = LocalBlocks(lambda rows: Block(None, np.ones((rows.stop - rows.start, 1)), 0), n, n_inducing)
    sizes = [len(blocks[index].linear) for index in range(len(blocks))]
    assert sum(sizes) == n
    assert set(sizes[:-1]) == {block_rows(n_inducing)}
    assert blocks.linear.n_rows == n
