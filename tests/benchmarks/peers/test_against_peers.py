"""The comparison with other libraries in short mode, with what is installed for the tests."""

import numpy as np
import pytest

from ..conftest import read


@pytest.mark.slow
def test_against_peers(run_script, tmp_path):
    output = tmp_path / "peers.csv"
    arguments = ("--quick", "--models", "RES-VGP", "--sharing", "none", "--output", output)
    said = run_script("peers/against_peers.py", *arguments, "--peers", "skevgp", "scikit-learn BayesianRidge")
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
    assert "..." not in run_script("peers/against_peers.py", *arguments, "--peers", "skevgp")
    said = run_script("peers/against_peers.py", *arguments, "--peers", "skevgp", "--redo", "--time-limit", 0)
    assert said.count("...") == 1
    _, redone = read(output)
    assert redone["stop"] == "time"
    assert np.isfinite(float(redone["error_mean"]))


def test_a_peer_that_fails_is_a_row_and_one_that_is_missing_is_left_out(run_script, tmp_path, monkeypatch):
    from peers import models

    fails = models.Peer(("sklearn.linear_model",), models.fit_linear)
    missing = models.Peer(("no_such_package",), models.fit_linear)
    # The process that fits knows no such peers.
    monkeypatch.setattr(models, "PEERS", {"fails": fails, "missing": missing})
    output = tmp_path / "peers.csv"
    said = run_script(
        "peers/against_peers.py", "--quick", "--models", "VGP", "--output", output, "--peers", "fails", "missing"
    )
    assert "missing: no_such_package is not installed" in said
    (row,) = read(output)
    assert row["stop"].startswith("failed: error: unknown peer 'fails'")
    assert row["seconds"] == row["error_mean"] == ""
