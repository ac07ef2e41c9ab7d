"""The benchmark of wrong rows: five fits per data set, resumable, a table of ratios."""

import numpy as np
import pytest
from sklearn.utils import Bunch

from .conftest import read


@pytest.fixture
def outliers(benchmarks):
    import outliers

    return outliers


def test_it_runs_resumes_and_writes_its_page(run_script, tmp_path):
    output = tmp_path / "outliers.csv"
    run_script("outliers.py", "--quick", "--jobs", "1", "--output", output)
    rows = read(output)
    assert [(row["rows"], row["noise"]) for row in rows] == [
        ("clean", "gaussian"),
        ("clean", "student-t"),
        ("left", "gaussian"),
        ("spoiled", "gaussian"),
        ("spoiled", "student-t"),
    ]
    assert float(rows[4]["found"]) > 0.5
    assert float(rows[4]["nlpd"]) < float(rows[3]["nlpd"])
    page = output.with_suffix(".md").read_text()
    assert "| cartpole, clean rows, gaussian |" in page
    assert "1 of 1 cells are in" in run_script("outliers.py", "--quick", "--jobs", "1", "--output", output)


def test_rows_are_shifted_by_so_many_standard_deviations(outliers):
    train = Bunch(data=np.zeros((2000, 1)), target=np.zeros((2000, 2)))
    wrong, bad = outliers.spoiled(train, np.array([1.0, 0.1]), 0)
    assert 0.03 < bad.mean() < 0.07
    np.testing.assert_allclose(np.abs(wrong.target[bad]), np.tile([20.0, 2.0], (bad.sum(), 1)))
    assert (wrong.target[~bad] == 0.0).all()
    assert (train.target == 0.0).all()


def test_ratios_are_to_the_gaussian_fit_to_clean_rows(outliers):
    rows = [
        {"dataset": "airfoil", "seed": str(seed), "rows": rows, "noise": noise, "error_mean": str(error + seed)}
        | {"nlpd": "2.0", "n_outputs": "2", "cr2": "0.95", "doubted": "0.0", "found": found, "fit_seconds": "1.0"}
        for seed in range(2)
        for rows, noise, error, found in [
            ("clean", "gaussian", 1.5, ""),
            ("clean", "student-t", 1.5, ""),
            ("left", "gaussian", 1.6, ""),
            ("spoiled", "gaussian", 3.5, "0.0"),
            ("spoiled", "student-t", 1.7, "0.75"),
        ]
    ]
    lines = outliers.lines_of("airfoil", rows)
    assert [line[2] for line in lines] == ["1.000", "1.000", "1.050", "2.000", "1.100"]
    assert [line[3] for line in lines] == ["1.000"] * 5
    assert lines[4][6] == "75.0% / 0.00%"
    assert outliers.lines_of("elevators", rows) == []
