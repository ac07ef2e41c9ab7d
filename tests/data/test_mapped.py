"""Rows through the user's maps: kept or made anew, from memory or from files, without a copy of the data."""

import pickle
import tracemalloc

import numpy as np
import pytest
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures, StandardScaler

from skevgp import EVGPRegressor
from skevgp.data.maps import MappedRows, Maps

RNG = np.random.RandomState(0)
X = RNG.uniform(-2.0, 2.0, (400, 2))
Y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], X[:, 0] * X[:, 1]]) + 0.05 * RNG.randn(400, 2)
X_NEW = RNG.uniform(-2.0, 2.0, (50, 2))

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


def model(**parameters):
    maps = {"feature_map": PolynomialFeatures(1), "kernel_map": StandardScaler()}
    return EVGPRegressor(**{"n_inducing": 12, "max_iter": 3, "random_state": 0, **maps, **parameters})


class Counting(FunctionTransformer):
    """The sine of each column, which counts the rows that it is given."""

    def transform(self, X):
        self.n_rows_ = getattr(self, "n_rows_", 0) + len(X)
        return np.sin(X)


def mapped(feature_map=None, kernel_map=None, X=X, y=Y):
    return MappedRows(X, X, y, Maps(feature_map, kernel_map))


@pytest.mark.parametrize("rows", [slice(3, 7), np.array([9, 0, 9])], ids=str)
@pytest.mark.parametrize("kept", [True, False])
def test_kernel_sees_its_map_and_the_features_are_theirs(kept, rows, monkeypatch):
    if not kept:
        monkeypatch.setattr("skevgp.data.maps.MAPPED_BYTES", 0)
    scaler, trend = StandardScaler().fit(X), PolynomialFeatures(1).fit(X)
    raw = mapped(trend, scaler)(rows)
    np.testing.assert_allclose(raw.inputs, scaler.transform(X)[rows], rtol=1e-15)
    np.testing.assert_array_equal(raw.features, trend.transform(X)[rows])
    np.testing.assert_array_equal(raw.targets, Y[rows])


def test_maps_are_cached_if_memory_allows(monkeypatch):
    own = mapped(kept := Counting())
    for _ in range(3):
        own(slice(0, 400))
    assert kept.n_rows_ == 400
    # Two features of 400 rows: a byte less, and they are not kept.
    monkeypatch.setattr("skevgp.data.maps.MAPPED_BYTES", 8 * 2 * 400 - 1)
    own = mapped(again := Counting())
    for _ in range(3):
        own(slice(0, 400))
    assert again.n_rows_ == 4 * 400


def test_mapped_rows_can_be_sent_to_workers():
    own = mapped(PolynomialFeatures(1).fit(X))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(own))(slice(2, 4)).features, own(slice(2, 4)).features)


@pytest.fixture
def in_pieces(monkeypatch):
    """As if there were so many rows that nothing of them can be kept."""
    monkeypatch.setattr("skevgp.data.maps.MAPPED_BYTES", 0)
    monkeypatch.setattr("skevgp.data.blocks.CACHE_BYTES", 0)
    monkeypatch.setattr("skevgp.data.rows.PASS_ROWS", 70)
    monkeypatch.setattr("skevgp.data.blocks._MIN_BLOCK_ROWS", 30)
    monkeypatch.setattr("skevgp.data.blocks._BLOCK_NUMBERS", 30)
    monkeypatch.setattr("skevgp.data.blocks._WORTH_THREADS", 0)


@pytest.mark.parametrize("sharing", ["all", "none"])
@pytest.mark.parametrize("solver", ["lbfgs", "adam"])
def test_recomputed_maps_agree(request, sharing, solver):
    # Two outputs with own points are calibrated too.
    options = {"sharing": sharing, "solver": solver, "noise_cv": 5 if sharing == "none" else None}
    expected = model(**options).fit(X[:160], Y[:160])
    request.getfixturevalue("in_pieces")
    pieces = model(**options).fit(X[:160], Y[:160])
    # Adam's first steps divide gradients by their size: those that only rounding makes differ from 0 move too.
    rtol, atol = {"lbfgs": (1e-6, 0.0), "adam": (0.0, 1e-4)}[solver]
    np.testing.assert_allclose(pieces.predict(X_NEW), expected.predict(X_NEW), rtol=rtol, atol=atol)
    assert pieces.lower_bound_ == pytest.approx(expected.lower_bound_, rel=1e-4 if atol else 1e-8)


def test_map_whose_width_changes_from_piece_to_piece_raises(in_pieces, monkeypatch):
    monkeypatch.setattr("skevgp.data.maps.MAP_ROWS", 70)
    widening = FunctionTransformer(lambda rows: np.ones((len(rows), 1 if len(rows) == 70 else 2)))
    with pytest.raises(ValueError, match=r"same number of columns for all rows; they returned \(2, 1\) and \(2, 2\)"):
        model(feature_map=widening, kernel_map=None).fit(X, Y)


def test_pieces_in_threads_have_same_bits(in_pieces):
    fits = [model(n_jobs=n_jobs, sharing="all", max_iter=1).fit(X[:200], Y[:200]) for n_jobs in (1, 2, 3)]
    for other in fits[1:]:
        np.testing.assert_array_equal(other.predict(X_NEW), fits[0].predict(X_NEW))


@pytest.fixture
def little_memory(monkeypatch):
    for name in ("maps.MAPPED_BYTES", "blocks.CACHE_BYTES", "blocks.KEEP_BYTES"):
        monkeypatch.setattr(f"skevgp.data.{name}", 2**20)
    monkeypatch.setattr("skevgp.fitting.rules.LARGEST_SAMPLE", 2**17)


@pytest.mark.long
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


@pytest.mark.long
def test_memory_does_not_grow_with_the_rows(little_memory, tmp_path):
    """Beyond what may be kept, four times the rows need no more memory."""
    peaks = []
    for n in (100_000, 400_000):
        np.save(tmp_path / "X.npy", RNG.uniform(-2.0, 2.0, (n, 8)))
        np.save(tmp_path / "y.npy", RNG.randn(n))
        mapped = [np.load(tmp_path / name, mmap_mode="r") for name in ("X.npy", "y.npy")]
        tracemalloc.start()
        model(kernel_map=None, max_iter=1).fit(*mapped)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0] + 2**20
