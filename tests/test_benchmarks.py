"""The benchmarks in short mode, with what is installed for the tests."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from .conftest import read

pytestmark = pytest.mark.usefixtures("benchmarks")


@pytest.mark.slow
@pytest.mark.slow
def test_against_peers(run_script, tmp_path):
    output = tmp_path / "peers.csv"
    arguments = ("--quick", "--models", "RES-VGP", "--sharing", "none", "--output", output)
    said = run_script("against_peers.py", *arguments, "--peers", "skevgp", "scikit-learn BayesianRidge")
    assert said.count("...") == 2
    own, line = read(output)
    assert (own["peer"], line["peer"]) == ("skevgp", "scikit-learn BayesianRidge")
    assert (own["target"], own["stop"], float(own["iterations"])) == ("change", "iterations", 40.0)
    assert 0.0 < float(own["error_median"]) <= float(own["error_mean"]) < 1.0
    assert "numpy" in own["versions"]
    assert line["bound"] == "nan"

    curve = read(tmp_path / "peers_curves.csv")
    assert {row["peer"] for row in curve} == {"skevgp"}
    bounds = [float(row["bound_so_far"]) for row in curve]
    assert bounds == sorted(bounds)
    assert bounds[-1] <= float(own["bound"]) + 1e-3
    assert bounds[-1] > bounds[0]
    assert float(curve[-1]["seconds_so_far"]) <= float(own["seconds"])
    assert (tmp_path / "peers.png").stat().st_size > 10_000

    # What is there is not run again, unless asked for; a fit without time left ends with what it has.
    assert "..." not in run_script("against_peers.py", *arguments, "--peers", "skevgp")
    said = run_script("against_peers.py", *arguments, "--peers", "skevgp", "--redo", "--time-limit", 0)
    assert said.count("...") == 1
    _, redone = read(output)
    assert redone["stop"] == "time"
    assert np.isfinite(float(redone["error_mean"]))


def test_a_peer_that_fails_is_a_row_and_one_that_is_missing_is_left_out(run_script, tmp_path, monkeypatch):
    import peer_models

    fails = peer_models.Peer(("sklearn.linear_model",), peer_models.fit_linear)
    missing = peer_models.Peer(("no_such_package",), peer_models.fit_linear)
    # The process that fits knows no such peers.
    monkeypatch.setattr(peer_models, "PEERS", {"fails": fails, "missing": missing})
    output = tmp_path / "peers.csv"
    said = run_script(
        "against_peers.py", "--quick", "--models", "VGP", "--output", output, "--peers", "fails", "missing"
    )
    assert "missing: no_such_package is not installed" in said
    (row,) = read(output)
    assert row["stop"].startswith("failed: error: unknown peer 'fails'")
    assert row["seconds"] == row["error_mean"] == ""


def test_bounds_of_scaled_targets_are_in_the_users_units():
    from peer_jobs import Job, Scaled

    rng = np.random.RandomState(0)
    X, Y = rng.randn(20, 2), rng.randn(20, 3) * [1e-3, 1.0, 50.0]
    job = Job(X, Y, X, X[:4], np.ones(2), "none", 10, 1.0, 0)
    scaled = Scaled(job)
    K = np.exp(-0.5 * ((X[:, np.newaxis] - X) ** 2).sum(axis=2)) + 0.1 * np.eye(20)
    for o, columns in enumerate(scaled.models):
        inside = multivariate_normal(np.zeros(20), K).logpdf(scaled.Y[:, o])
        outside = multivariate_normal(np.zeros(20), K * scaled.unit[o] ** 2).logpdf(Y[:, o])
        assert scaled.bound(inside, columns) == pytest.approx(outside, abs=1e-9)
    assert Scaled(Job(X, Y, X, X[:4], np.ones(2), "all", 10, 1.0, 0)).models == [[0, 1, 2]]


def test_the_curve_is_the_sum_of_the_best_bounds_so_far():
    from peer_jobs import Watch

    watch = Watch(100.0, 2)
    for model, bound in ((0, -5.0), (0, -7.0), (0, -2.0), (1, -9.0), (1, -1.0)):
        watch.record(model, bound)
    seconds, cpu_seconds, bound = watch.curve()
    # Model 1 counts with its first bound, -9, before it begins.
    np.testing.assert_array_equal(bound, [-14.0, -14.0, -11.0, -11.0, -3.0])
    assert (np.diff(seconds) >= 0.0).all()
    assert (np.diff(cpu_seconds) >= 0.0).all()
    assert watch.deadline(0) == pytest.approx(50.0, abs=1.0)


@pytest.mark.slow
@pytest.mark.slow
def test_evaluation_cost(run_script, tmp_path):
    output = tmp_path / "cost.csv"
    run_script("evaluation_cost.py", "--quick", "--repeats", "3", "--cores", "1", "2", "--output", output)
    rows = read(output)
    assert [row["sweep"] for row in rows] == ["data", "data", "rows", "rows", "points", "points"]
    for row in rows:
        assert float(row["ratio"]) == pytest.approx(float(row["evaluation_ms"]) / float(row["floor_ms"]))
        assert 0.0 < float(row["evaluation_fastest_ms"]) <= float(row["evaluation_ms"])
    assert output.with_suffix(".png").stat().st_size > 10_000
