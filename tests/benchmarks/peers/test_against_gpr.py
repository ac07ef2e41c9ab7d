"""The comparison with scikit-learn's GPR on a few rows."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF

from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.metrics import negative_log_predictive_density, prediction_error

from ..conftest import read


@pytest.fixture
def run(run_script, tmp_path):
    def run(*arguments):
        options = ("--systems", "smooth", "--jobs", 2, "--output", tmp_path / "gpr.csv")
        return run_script("peers/against_gpr.py", *options, *arguments)

    return run


@pytest.mark.long
def test_it_runs_and_resumes_and_leaves_out_what_would_take_too_long(run, tmp_path):
    output = tmp_path / "gpr.csv"
    said = run("--sizes", 30, "--models", "GPR", "EVGP")
    assert "[2/2] smooth" in said
    before = output.read_text()
    assert {row["model"] for row in read(output)} == {"GPR", "EVGP"}
    assert all(float(row["fit_seconds"]) > 0.0 <= float(row["memory_mb"]) for row in read(output))
    # With no time, what is there stays and nothing larger is tried.
    said = run("--sizes", 30, 60, "--models", "GPR", "EVGP", "--time-limit", 0)
    assert "[1/" not in said
    assert output.read_text() == before
    assert output.with_suffix(".png").stat().st_size > 10_000
    assert "At 30 rows, the most that GPR was fitted to" in output.with_suffix(".md").read_text()


@pytest.mark.long
def test_a_row_tells_of_the_change_of_state():
    from peers import against_gpr

    row = against_gpr.run(against_gpr.Cell("pendulum", "EVGP", 40, 0))
    rows = np.random.RandomState(0).permutation(4800)[:40]
    (X, y), (X_test, y_test) = (make_dynamics("pendulum", random_state=seed, return_X_y=True) for seed in (0, 1000))
    X, y, y_test = X[rows], y[rows] - X[rows, :2], y_test - X_test[:, :2]
    model = EVGPRegressor(random_state=0).fit(X, y)
    mean, std = model.predict(X_test, return_std=True)
    assert row["m"] == model.inducing_points_.shape[-2] == 40
    assert row["error"] == pytest.approx(prediction_error(y_test, mean), rel=1e-6)
    assert row["nlpd"] == pytest.approx(negative_log_predictive_density(y_test, mean, std), rel=1e-6)
    assert row["log_likelihood"] == pytest.approx(model.lower_bound_, rel=1e-6)


def test_the_counterpart_of_an_evgp_is_the_exact_gp():
    from peers import against_gpr

    rng = np.random.RandomState(0)
    X, X_test = rng.randn(30, 2), rng.randn(10, 2)
    Y, Y_test = (np.sin(inputs @ rng.randn(2, 2)) + 0.1 * rng.randn(len(inputs), 2) for inputs in (X, X_test))
    model = EVGPRegressor(n_inducing=5, max_iter=0, random_state=0).fit(X, Y)
    exact = against_gpr.counterpart(model, *(against_gpr.Rows(a, b, b) for a, b in ((X, Y), (X_test, Y_test))))

    value, mean, std = 0.0, np.empty((10, 2)), np.empty((10, 2))
    for o, (kernel, noise) in enumerate(zip(model.kernel_, model.noise_variance_, strict=True)):
        K, k = kernel(X) + noise * np.eye(30), kernel(X_test, X)
        value += multivariate_normal(np.zeros(30), K).logpdf(Y[:, o])
        mean[:, o] = k @ np.linalg.solve(K, Y[:, o])
        std[:, o] = np.sqrt(noise + kernel.diag(X_test) - (k * np.linalg.solve(K, k.T).T).sum(axis=1))
    assert exact["counterpart_log_likelihood"] == pytest.approx(value, rel=1e-9)
    assert exact["counterpart_error"] == pytest.approx(prediction_error(Y_test, mean), rel=1e-9)
    assert exact["counterpart_nlpd"] == pytest.approx(negative_log_predictive_density(Y_test, mean, std), rel=1e-9)
    assert value > model.lower_bound_


def test_log_likelihoods_are_in_the_units_of_y():
    from peers.against_gpr import log_likelihood

    rng = np.random.RandomState(0)
    X, Y = rng.randn(20, 2), rng.randn(20, 3) * [1e-3, 1.0, 50.0] + 2.0
    gpr = GaussianProcessRegressor(RBF(1.5), alpha=0.1, optimizer=None, normalize_y=True).fit(X, Y)
    K = RBF(1.5)(X) + 0.1 * np.eye(20)
    densities = [multivariate_normal(np.full(20, y.mean()), y.var() * K) for y in Y.T]
    expected = sum(density.logpdf(y) for density, y in zip(densities, Y.T, strict=True))
    assert log_likelihood(gpr, Y) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("system", "model"), [("smooth", "EVGP"), ("pendulum", "GPR")])
def test_rows_of_a_smaller_n_are_among_those_of_a_larger_one(system, model):
    from peers.against_gpr import Cell, data

    (small, test), (large, same_test) = (data(Cell(system, model, n, 0)) for n in (30, 50))
    for few, many in zip(small, large, strict=True):
        assert len(few) == 30
        np.testing.assert_array_equal(few, many[:30])
    np.testing.assert_array_equal(test.X, same_test.X)
    assert len(test.X) == 4800
    noise = test.y - test.truth
    np.testing.assert_allclose(noise.std(), 0.1 if system == "smooth" else 0.0, rtol=0.05)


def test_exponents_and_crossings_of_power_laws():
    from peers.against_gpr_report import crossing, exponent

    def line(power, factor):
        return {n: [{"fit_seconds": factor * n**power}] for n in (100, 200, 400, 800, 1600)}

    cubic, linear = line(3, 1e-6), line(1, 0.09)
    assert exponent(cubic, "fit_seconds") == pytest.approx(3.0)
    assert crossing(cubic, linear, "fit_seconds") == "from about 300 rows on"
    assert crossing(cubic, line(1, 1e-6), "fit_seconds") == "at all of these sizes"
    assert crossing(linear, line(1, 0.1), "fit_seconds") == "not at 1600 rows"
