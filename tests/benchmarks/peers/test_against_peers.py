"""The comparison with other libraries in short mode, with what is installed for the tests."""

import gzip

import numpy as np
import pytest

from ..conftest import read


@pytest.mark.long
def test_against_peers(run_script, tmp_path):
    output = tmp_path / "peers.csv"
    arguments = ("--quick", "--datasets", "pendulum", "--sharing", "none", "--output", output)
    said = run_script("peers/against_peers.py", *arguments, "--peers", "skevgp", "scikit-learn BayesianRidge")
    assert "skevgp agrees with dense matrices" in said
    assert said.count("...") == 2
    own, line = read(output)
    assert (own["peer"], line["peer"]) == ("skevgp", "scikit-learn BayesianRidge")
    assert (own["stop"], float(own["iterations"])) == ("iterations", 40.0)
    assert 0.0 < float(own["error_median"]) <= float(own["error_mean"]) <= float(own["rmse"]) < 1.0
    assert "numpy" in own["versions"]
    assert line["bound"] == "nan"

    # Looked at up to three times, and at the end; the straight line at its end only.
    curve = read(tmp_path / "peers_curves.csv")
    # (A look that the machine held up beyond the fit's end is left out.)
    assert [row["peer"] for row in curve] == ["skevgp"] * (len(curve) - 1) + ["scikit-learn BayesianRidge"]
    assert 2 <= len(curve) <= 5
    bounds = [float(row["bound_so_far"]) for row in curve[:-1]]
    # (The last is calibrated: its bound is not the highest.)
    assert bounds[-1] == pytest.approx(float(own["bound"]), abs=1e-3)
    assert float(curve[-2]["seconds_so_far"]) == pytest.approx(float(own["seconds"]), abs=1e-3)
    assert float(curve[-2]["nlpd_so_far"]) == pytest.approx(float(own["nlpd"]), abs=1e-5)
    assert (tmp_path / "peers.png").stat().st_size > 5_000
    assert "## pendulum, seed 0" in (tmp_path / "peers.md").read_text()

    # What is there is not run again, unless asked for; a fit without time left ends with what it has.
    assert "..." not in run_script("peers/against_peers.py", *arguments, "--peers", "skevgp")
    said = run_script("peers/against_peers.py", *arguments, "--peers", "skevgp", "--redo", "--time-limit", 0)
    assert said.count("...") == 1
    _, redone = read(output)
    assert redone["stop"] == "time"
    assert np.isfinite(float(redone["error_mean"]))


@pytest.mark.long
def test_all_splits_of_a_table(run_script, tmp_path):
    rng = np.random.RandomState(0)
    X = 100.0 + rng.randn(120, 2)
    y = 1e3 * (X[:, 0] - X[:, 1]) + rng.randn(120)
    (tmp_path / "airfoil").mkdir()
    for name, table in (("data", np.column_stack([X, y])), ("test_mask", np.arange(120)[:, np.newaxis] % 3 == [0, 1])):
        with gzip.open(tmp_path / "airfoil" / f"{name}.csv.gz", "wt") as file:
            np.savetxt(file, table, delimiter=",")
    arguments = ("--all-splits", "--datasets", "airfoil", "--data-folder", tmp_path, "--seeds", 2)
    output = tmp_path / "splits.csv"
    peers = ("scikit-learn HistGradientBoosting", "scikit-learn BayesianRidge")
    said = run_script("peers/against_peers.py", *arguments, "--output", output, "--peers", *peers)
    assert "All splits of airfoil" in said
    rows = read(output)
    assert [(row["peer"], row["seed"]) for row in rows] == [(peer, seed) for seed in "01" for peer in peers]
    trees, line = ([row for row in rows if row["peer"] == peer] for peer in peers)
    # In units of the target's standard deviation: the line leaves what is noise, 1 / 1,400.
    assert all(5e-4 < float(row["rmse"]) < 1e-3 for row in line)
    for row in trees:
        rmse, nlpd = float(row["rmse"]), float(row["nlpd"])
        assert rmse < 1.0
        # The constant deviation is about as large as errors are.
        assert nlpd == pytest.approx(0.5 * np.log(2.0 * np.pi * rmse**2) + 0.5, abs=0.3)
    mean = np.mean([float(row["rmse"]) for row in line])
    error = np.std([float(row["rmse"]) for row in line])  # of two: their distance / 2
    assert f"{mean:.4f} ± {error:.4f}" in (tmp_path / "splits.md").read_text()


def test_a_table_that_is_not_there_or_lacks_a_split_is_an_error(tmp_path):
    from peers.data import tabular

    with pytest.raises(SystemExit, match="give --data-folder"):
        tabular("airfoil", 0, None)
    with pytest.raises(SystemExit, match=r"--data-folder .* does not have kin40k"):
        tabular("kin40k", 0, tmp_path)
    (tmp_path / "kin40k").mkdir()
    for name in ("data", "test_mask"):
        with gzip.open(tmp_path / "kin40k" / f"{name}.csv.gz", "wt") as file:
            np.savetxt(file, np.eye(4), delimiter=",")
    with pytest.raises(SystemExit, match="splits 0 to 3; got 4"):
        tabular("kin40k", 4, tmp_path)
    X, Y, X_test, Y_test = tabular("kin40k", 3, tmp_path)
    assert (X.shape, Y.shape, X_test.shape, Y_test.shape) == ((3, 3), (3, 1), (1, 3), (1, 1))
    np.testing.assert_allclose(X.mean(axis=0), 0.0, atol=1e-15)
    np.testing.assert_allclose(X.std(axis=0), 1.0)
    # A constant target stays one; that of the test row is as far from it as it was.
    assert (Y == 0.0).all()
    assert Y_test == 1.0


def test_a_peer_that_fails_is_a_row_and_one_that_is_missing_is_left_out(run_script, tmp_path, monkeypatch):
    from peers import models
    from peers.libraries import with_sklearn

    fails = models.Peer(("sklearn.linear_model",), with_sklearn.fit_linear)
    missing = models.Peer(("no_such_package",), with_sklearn.fit_linear)
    # The process that fits knows no such peers.
    monkeypatch.setattr(models, "PEERS", {"fails": fails, "missing": missing})
    output = tmp_path / "peers.csv"
    said = run_script(
        "peers/against_peers.py", "--quick", "--datasets", "smooth", "--output", output, "--peers", "fails", "missing"
    )
    assert "missing: no_such_package is not installed" in said
    (row,) = read(output)
    assert row["stop"].startswith("failed: error: unknown peer 'fails'")
    assert row["seconds"] == row["error_mean"] == ""
    assert "unknown peer 'fails'" in (tmp_path / "peers.md").read_text()


def test_a_look_that_was_held_up_beyond_the_end_is_left_out(monkeypatch):
    from peers import models
    from peers.jobs import Checkpoint, Fitted, Job

    def predict(X):
        return (np.zeros((len(X), 1)), np.ones((len(X), 1)))

    looks = iter([Checkpoint(1e9, 1.0, -9.0, predict), Checkpoint(0.0, 0.0, -8.0, predict)])
    peer = models.Peer(("numpy",), lambda job, watch: Fitted(predict, [-1.0], "converged", at=lambda _: next(looks)))
    monkeypatch.setattr(models, "PEERS", {"own": peer})
    X = np.ones((4, 1))
    result = models.run("own", Job(X, X, X, X, np.ones(1), 0.1, "none", 1, 1.0, 0, n_checkpoints=2))
    np.testing.assert_array_equal(result.bound, [-1.0, -8.0])


def curve_row(seconds, bound, nlpd, peer="skevgp"):
    return {
        **{"peer": peer, "dataset": "kin40k", "sharing": "none", "m": "9", "n_train": "50", "seed": "0"},
        **{"seconds_so_far": str(seconds), "cpu_seconds_so_far": str(2 * seconds)},
        **{"bound_so_far": str(bound), "nlpd_so_far": str(nlpd)},
    }


def test_the_time_to_a_bound_is_found_between_two_looks():
    from peers.against_peers_report import time_to_reach

    curve = [curve_row(1.0, -20.0, 0.5), curve_row(2.0, -12.0, ""), curve_row(4.0, -10.0, 0.1)]
    assert time_to_reach(curve, "bound", -20.0, "seconds") == 1.0
    assert time_to_reach(curve, "bound", -30.0, "seconds") == 1.0
    assert time_to_reach(curve, "bound", -11.0, "seconds") == pytest.approx(np.sqrt(8.0))
    assert time_to_reach(curve, "bound", -11.0, "cpu_seconds") == pytest.approx(2.0 * np.sqrt(8.0))
    assert np.isnan(time_to_reach(curve, "bound", -9.0, "seconds"))
    assert time_to_reach(curve, "nlpd", 0.3, "seconds") == pytest.approx(2.0)
    assert time_to_reach(curve, "nlpd", 0.1, "seconds") == pytest.approx(4.0)
    assert np.isnan(time_to_reach(curve, "nlpd", 0.0, "seconds"))


def test_a_fit_is_timed_against_the_last_bound_and_nlpd_of_the_reference():
    from peers.against_peers_report import REFERENCE, against_reference

    def row(peer, seconds, **values):
        key = {"peer": peer, "dataset": "kin40k", "sharing": "none", "m": "9", "n_train": "50", "seed": "0"}
        return {**key, "seconds": str(seconds), "cpu_seconds": str(2 * seconds), **values}

    reference = row(REFERENCE[0], 40.0, bound="-11.0", nlpd="0.3")
    own = row("skevgp", 4.0, bound="-10.0", nlpd="0.1")
    curves = [curve_row(1.0, -20.0, 0.5), curve_row(4.0, -10.0, 0.1), curve_row(0.1, -5.0, 0.0, REFERENCE[0])]
    to = against_reference(own, [reference, own], curves)
    # A hundredth of a nat is rounding.
    assert to["to_bound"] == pytest.approx(np.exp(np.interp(8.99 / 10.0, [0.0, 1.0], [0.0, np.log(4.0)])))
    assert to["faster"] == pytest.approx(40.0 / to["to_bound"])
    assert to["net"] == pytest.approx(39.9 / to["to_bound"])
    assert to["faster_cpu"] == pytest.approx(to["faster"])
    assert to["to_nlpd"] == pytest.approx(2.0, rel=1e-4)
    assert np.isnan(list(against_reference(own, [own], curves).values())).all()


def test_each_data_set_has_a_line_of_panels_in_which_fits_end_as_they_did(drawn, tmp_path):
    from peers.against_peers_report import draw

    def fit(peer, dataset, stop):
        key = {"peer": peer, "dataset": dataset, "sharing": "none", "m": "9", "n_train": "5000", "seed": "0"}
        return {**key, "seconds": "4.0", "stop": stop}

    rows = [fit("skevgp", "kin40k", "converged"), fit("GPflow SGPR", "kin40k", "iterations")]
    rows.append(fit("skevgp", "acrobot", "converged"))
    curves = [
        {**curve_row(seconds, bound, nlpd, row["peer"]), "dataset": row["dataset"], "n_train": "5000"}
        for row in rows
        for seconds, bound, nlpd in ((1.0, -20.0, 0.5), (4.0, -10.0, 0.1))
    ]
    (figure,) = drawn(draw, rows, curves, tmp_path / "peers.png")
    titles = [
        f"{name}, 5,000 rows, 9 points: {what}" for name in ("kin40k", "acrobot") for what in ("bound", "test NLPD")
    ]
    assert [axes.get_title() for axes in figure.axes] == titles
    assert {axes.get_ylabel() for axes in figure.axes} == {"nats per row"}
    assert [axes.get_xlabel() for axes in figure.axes[2:]] == ["seconds of the processor, all threads"] * 2
    ends = [line for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert [line.get_markerfacecolor() == "white" for line in ends] == [False, True]  # GPflow's hit its limit
    assert ends[0].get_ydata()[0] == -10.0 / 5000
    assert ends[0].get_xdata()[0] == 8.0  # of the processor
    labels = {text.get_text() for text in figure.legends[0].get_texts()}
    assert labels == {"skevgp", "GPflow SGPR", "converged", "ended by a limit of iterations"}


def test_a_fit_of_one_look_is_a_diamond_and_what_was_fitted_twice_is_drawn_once(drawn, tmp_path):
    from peers.against_peers_report import draw

    keys = (("skevgp", "none"), ("skevgp", "default"), ("scikit-learn GPR", "none"))
    key = {"dataset": "kin40k", "m": "9", "n_train": "50", "seed": "0", "seconds": "4.0", "stop": "steps"}
    rows = [{**key, "peer": peer, "sharing": sharing} for peer, sharing in keys]
    curves = [
        {**curve_row(seconds, -10.0, 0.1, row["peer"]), "sharing": row["sharing"]}
        for row in rows
        for seconds in ((4.0,) if row["peer"] == "scikit-learn GPR" else (1.0, 4.0))
    ]
    (figure,) = drawn(draw, rows, curves, tmp_path / "peers.png")
    _, nlpd = figure.axes
    assert [line.get_marker() for line in nlpd.lines] == ["o", "None", "D"] + ["o"] * 2  # and those of the legend
    assert all(line.get_markerfacecolor() == "white" for line in nlpd.lines[:3:2])  # a limit of steps is a limit
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts[:2] == ["skevgp", "scikit-learn GPR, up to 1,500 rows"]
