"""The benchmark of the number of inducing points on two small sets: runs, resumes, and reports."""

import csv

import numpy as np
import pytest

from skevgp import EGPRegressor


@pytest.fixture
def auto_inducing(benchmarks):
    import auto_inducing

    return auto_inducing


@pytest.mark.long
def test_it_runs_and_resumes(auto_inducing, tmp_path, capsys):
    output = tmp_path / "auto.csv"
    arguments = ["--quick", "--sets", "toy-200", "--jobs", "1", "--output", str(output)]
    auto_inducing.main(arguments)
    rows = list(csv.DictReader(output.read_text().splitlines()))
    assert {row["model"] for row in rows} == set(auto_inducing.MODELS)
    assert "| toy-200 | 200 |" in output.with_suffix(".md").read_text()
    assert "covers the exact log marginal likelihood in 3 of 3 fits" in capsys.readouterr().out
    auto_inducing.main(arguments)
    assert list(csv.DictReader(output.read_text().splitlines())) == rows


def test_there_are_twenty_sets_of_rows_that_can_be_fitted(auto_inducing):
    assert len(auto_inducing.SETS) == 20
    for name in ("toy-200", "friedman2", "diabetes", "waves-6", "pendulum-ifg"):
        data = auto_inducing.SETS[name](0)
        assert len(data.X) == len(data.y) <= 3000
        assert data.X.shape[1] == data.X_test.shape[1]
        assert np.isfinite(data.y).all()
        assert (auto_inducing.SETS[name](1).y != data.y).any()


def test_the_likelihood_is_that_at_the_sparse_models_parameters(auto_inducing):
    data = auto_inducing.SETS["linear-5"](0)
    data = data._replace(X=data.X[:40], y=data.y[:40])
    regressor, row = auto_inducing.fitted(data, "40", 0)
    assert auto_inducing.likelihood_of(regressor, data) == pytest.approx(row["lower"], abs=1e-4)
    assert isinstance(auto_inducing.fitted(data, "exact", 0)[0], EGPRegressor)
