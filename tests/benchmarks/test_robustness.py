"""The benchmark of robustness on a handful of data sets: runs, resumes, and reports what fails."""

import csv

import numpy as np
import pytest


@pytest.fixture
def robustness(benchmarks):
    import robustness

    return robustness


def test_it_runs_and_resumes(robustness, tmp_path, capsys):
    output = tmp_path / "robustness.csv"
    arguments = ["--quick", "--parts", "seeds", "--cases", "1d", "--output", str(output)]
    robustness.main(arguments)
    rows = list(csv.DictReader(output.read_text().splitlines()))
    assert {row["part"] for row in rows} == {"seeds"}
    assert all(row["outcome"] == "ok" for row in rows)
    assert "0 failures" in capsys.readouterr().out
    robustness.main(arguments)
    assert list(csv.DictReader(output.read_text().splitlines())) == rows


def test_every_fixed_jitter_is_tried(robustness, tmp_path, capsys):
    output = tmp_path / "robustness.csv"
    robustness.main(["--quick", "--parts", "nasty", "jitter", "--cases", "n60", "--output", str(output)])
    variants = [row["variant"] for row in csv.DictReader(output.read_text().splitlines()) if row["part"] == "jitter"]
    assert set(variants) == {"default", *(f"jitter={jitter:g}" for jitter in robustness.FIXED_JITTERS)}
    assert "sets above 1.1, of 1" in capsys.readouterr().out


def test_it_reports_what_fails(robustness, monkeypatch):
    data = robustness.nasty(0)
    assert robustness.fit(data, 0, max_iter=1)["outcome"] == "ok"
    assert "InvalidParameterError" in robustness.fit(data, 0, n_inducing=-1)["outcome"]
    one = robustness.EVGPRegressor.predict

    def broken(self, X, return_std=False):
        mean, std = one(self, X, return_std=True)
        return mean, 0.0 * std

    monkeypatch.setattr(robustness.EVGPRegressor, "predict", broken)
    assert robustness.fit(data, 0, max_iter=1)["outcome"] == "std of 0"


def test_a_fixed_jitter_is_another_model(robustness):
    data = robustness.nasty(7)
    coarse = robustness.fixed_jitter(data, 0, 1e-4, max_iter=0)
    assert coarse["bound_per_row"] != robustness.fit(data, 0, max_iter=0)["bound_per_row"]


def test_nasty_data_are_nasty(robustness):
    """Each ingredient turns up, and noise-free targets are functions of the inputs as they were rounded."""
    sets = [robustness.nasty(seed) for seed in range(200)]
    for ingredient in ("heavy-tails", "integers", "constant-column", "copied-rows", "X-offset", "Y-scales", "outliers"):
        assert any(ingredient in data.case for data in sets)
    noise_free = [data for data in sets if data.noise_free]
    assert 30 < len(noise_free) < 170
    for data in noise_free:
        _, first, inverse = np.unique(data.X, axis=0, return_index=True, return_inverse=True)
        np.testing.assert_array_equal(data.Y, data.Y[first][np.ravel(inverse)])
