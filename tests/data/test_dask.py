"""Dask arrays in, the same estimator out."""

import os
import pickle
import signal

import dask
import dask.array as da
import distributed
import numpy as np
import pytest
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures, StandardScaler

from skevgp import EVGPRegressor
from skevgp.solvers import LBFGS, Adam

pytestmark = [
    pytest.mark.filterwarnings("ignore::UserWarning:distributed"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    # A few iterations are enough to compare.
    pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning"),
]

N = 600
RNG = np.random.RandomState(0)
# In the order in which a fit to arrays puts so few rows: chunks stay where they are.
X = np.sort(RNG.uniform(-2.0, 2.0, (N, 2)).view("f8,f8"), axis=0).view(float)
Y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], X[:, 0] * X[:, 1]]) + 0.05 * RNG.randn(N, 2)
X_NEW = RNG.uniform(-2.0, 2.0, (50, 2))


def model(**parameters):
    return EVGPRegressor(
        **{"n_inducing": 12, "max_iter": 25, "solver": LBFGS(tol=1e9), "random_state": 0, **parameters}
    )


def chunked(*arrays, rows=(150, 250, 200)):
    return tuple(da.from_array(array, chunks=(rows, *array.shape[1:])) for array in arrays)


def assert_same_model(actual, expected, rtol=1e-6):
    for part, whole in zip(
        actual.predict(X_NEW, return_std=True), expected.predict(X_NEW, return_std=True), strict=True
    ):
        np.testing.assert_allclose(part, whole, rtol=rtol, atol=1e-8)
    np.testing.assert_allclose(actual.lower_bound_, expected.lower_bound_, rtol=rtol)
    np.testing.assert_allclose(actual.upper_bound_, expected.upper_bound_, rtol=rtol)


@pytest.fixture(scope="module")
def cluster():
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster,
        distributed.Client(cluster),
    ):
        yield cluster


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::skevgp.exceptions.DependentRowsWarning")
@pytest.mark.parametrize("sharing", ["all", "kernel", "none", [[1], [0]], "auto"], ids=str)
@pytest.mark.parametrize("feature_map", [None, PolynomialFeatures(1)])
def test_fit_to_chunks_is_fit_to_arrays(sharing, feature_map):
    parameters = {"sharing": sharing, "feature_map": feature_map, "max_iter": 5}
    assert_same_model(model(**parameters).fit(*chunked(X, Y)), model(**parameters).fit(X, Y))


def test_chunks_may_be_of_one_row_or_none():
    rows = (1, 299, 0, 1, 299)
    parameters = {"max_iter": 1, "noise_cv": 5, "sharing": "all"}
    assert_same_model(model(**parameters).fit(*chunked(X, Y, rows=rows)), model(**parameters).fit(X, Y))


@pytest.mark.long
def test_fit_to_chunks_on_two_workers_is_fit_to_arrays(cluster):
    assert_same_model(model(max_iter=5).fit(*chunked(X, Y)), model(max_iter=5).fit(X, Y))


@pytest.mark.long
@pytest.mark.parametrize("chunks", [None, 250])
def test_folds_may_be_groups(chunks):
    groups = np.repeat(np.arange(20), 30)
    given = groups if chunks is None else da.from_array(groups, chunks=chunks)
    weights = np.where(np.arange(600) % 5 == 0, 0.0, 1.0)
    parameters = {"noise_cv": 20, "max_iter": 1, "feature_map": PolynomialFeatures(1)}
    expected = model(**parameters).fit(X, Y, weights, groups=groups)
    actual = model(**parameters).fit(*chunked(X, Y), weights, groups=given)
    np.testing.assert_allclose(actual.noise_variance_, expected.noise_variance_, rtol=1e-6)


@pytest.mark.long
def test_adam_takes_its_batches_from_the_chunks():
    parameters = {"solver": Adam(batch_size=100), "max_iter": 5}
    assert_same_model(model(**parameters).fit(*chunked(X, Y)), model(**parameters).fit(X, Y))


@pytest.mark.parametrize("include_noise", [True, False])
def test_prediction_is_lazy_and_chunk_by_chunk(include_noise):
    fitted = model(max_iter=0).fit(X, Y)
    (rows,) = chunked(X_NEW, rows=(20, 0, 30))
    mean, std = fitted.predict(rows, return_std=True, include_noise=include_noise)
    assert mean.chunks == std.chunks == ((20, 0, 30), (2,))
    expected = fitted.predict(X_NEW, return_std=True, include_noise=include_noise)
    np.testing.assert_allclose(mean, expected[0], rtol=1e-12)
    np.testing.assert_allclose(std, expected[1], rtol=1e-12)
    np.testing.assert_allclose(fitted.predict(rows), expected[0], rtol=1e-12)


def test_partial_fit_takes_chunks():
    both = model(max_iter=0).fit(X, Y).partial_fit(X[:100] + 0.01, Y[:100])
    lazy = model(max_iter=0).fit(*chunked(X, Y)).partial_fit(*chunked(X[:100] + 0.01, Y[:100], rows=(60, 40)))
    assert_same_model(lazy, both, rtol=1e-8)


@pytest.mark.long
def test_maps_are_fitted_without_bringing_the_rows_here():
    """Chunk by chunk where a map can; else to a sample, which here is all rows."""
    parameters = {"kernel_map": StandardScaler(), "feature_map": FunctionTransformer(np.sin), "max_iter": 5}
    lazy = model(**parameters).fit(*chunked(X, Y))
    np.testing.assert_allclose(lazy.kernel_map_.mean_, X.mean(axis=0), rtol=1e-12)
    assert_same_model(lazy, model(**parameters).fit(X, Y))


@pytest.mark.long
def test_nothing_of_the_size_of_the_data_reaches_the_client(monkeypatch):
    sizes = []

    def counting(*args, **kwargs):
        found = compute(*args, **kwargs)
        sizes.append(len(pickle.dumps(found)))
        return found

    compute = dask.base.compute
    monkeypatch.setattr("dask.base.compute", counting)
    monkeypatch.setattr("dask.compute", counting)
    big = da.random.default_rng(0).normal(size=(200_000, 2), chunks=(50_000, 2))
    fitted = model(max_iter=1).fit(big, da.sin(big[:, 0]))
    # The largest is the sample that the fit begins with: 64,000 rows of inputs and target.
    assert 8 * 3 * 64_000 < max(sizes) < 1.1 * 8 * 3 * 64_000
    assert len(sizes) > 10
    assert fitted.predict(big).npartitions == 4


@pytest.mark.long
def test_worker_that_dies_does_not_change_the_result(cluster):
    """Its partitions are made again on the other; sums keep their order, so even the bits are the same."""
    expected = model(max_iter=40).fit(*chunked(X, Y))
    pids, seen = list(distributed.default_client().run(os.getpid).values()), []

    def killing(iteration, bound, outputs):
        seen.append(iteration)
        if len(seen) == 3:
            os.kill(pids[0], signal.SIGKILL)

    survived = model(max_iter=40, solver=LBFGS(tol=1e9, callback=killing)).fit(*chunked(X, Y))
    assert len(seen) > 4
    np.testing.assert_array_equal(survived.predict(X_NEW), expected.predict(X_NEW))
    assert survived.lower_bound_ == expected.lower_bound_


@pytest.mark.long
def test_forgetting_score_and_warm_start(cluster):
    lazy = model().fit(*chunked(X, Y)).partial_fit(*chunked(X, Y), forgetting_factor=0.5)
    local = model().fit(X, Y).partial_fit(X, Y, forgetting_factor=0.5)
    assert_same_model(lazy, local, rtol=1e-4)
    assert lazy.score(*chunked(X, Y)) == pytest.approx(local.score(X, Y), rel=1e-6)
    bound = local.set_params(warm_start=True, max_iter=0).fit(*chunked(X, Y)).lower_bound_
    assert bound == pytest.approx(model().fit(X, Y).lower_bound_, rel=1e-6)


@pytest.mark.parametrize(
    ("bad_X", "bad_y", "message"),
    [
        (lambda: chunked(X)[0], lambda: Y[:10], "600 rows, but y has 10"),
        (lambda: chunked(X)[0], lambda: None, "requires y|y must"),
        (lambda: chunked(np.where(X > 1.9, np.nan, X))[0], lambda: Y, "X contains NaN"),
        (lambda: chunked(X)[0], lambda: np.where(Y > 1.0, np.inf, Y), "y contains infinity"),
        (lambda: da.from_array(X[:, 0], chunks=100), lambda: Y, "2 dimensions"),
        (lambda: da.empty((0, 2)), lambda: Y, "empty"),
    ],
)
def test_invalid_chunks_raise(bad_X, bad_y, message):
    with pytest.raises(ValueError, match=message):
        model().fit(bad_X(), bad_y())


def test_options_without_dask_raise():
    fitted = model(max_iter=0).fit(X, Y)
    (rows,) = chunked(X_NEW, rows=(20, 30))
    with pytest.raises(ValueError, match="return_cov.*Dask"):
        fitted.predict(rows, return_cov=True)
    with pytest.raises(ValueError, match="^sample_y needs rows in memory. Pass"):
        fitted.sample_y(rows)
    with pytest.raises(ValueError, match="2 features"):
        fitted.predict(da.zeros((5, 3)))
    with pytest.raises(TypeError, match="to_dask_array"):
        model().fit(rows.to_delayed().ravel()[0], Y)
    with pytest.raises(TypeError, match="to_dask_array"):
        fitted.predict(rows.to_delayed().ravel()[0])
    with pytest.raises(ValueError, match="X must have 2 dimensions"):
        fitted.predict(rows[:, 0])
