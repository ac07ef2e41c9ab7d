"""The benchmark of standard deviations: with and without calibration, resumable, one line per setting."""

import numpy as np
import pytest

from .conftest import read


@pytest.fixture
def calibration(benchmarks):
    import calibration

    return calibration


def test_it_runs_resumes_and_writes_its_page(run_script, tmp_path):
    folder = tmp_path / "tables" / "plane"
    folder.mkdir(parents=True)
    rng = np.random.RandomState(0)
    rows = rng.randn(90, 3)
    np.savetxt(folder / "data.csv.gz", rows, delimiter=",")
    np.savetxt(folder / "test_mask.csv.gz", np.arange(90)[:, np.newaxis] % 3 == [[0, 1]], delimiter=",", fmt="%d")
    output = tmp_path / "calibration.csv"
    arguments = ("--quick", "--systems", "pendulum", "--folder", folder.parent, "--jobs", "1", "--output", output)
    run_script("calibration.py", *arguments)
    rows = read(output)
    assert {(row["data"], row["noise_cv"]) for row in rows} == {
        (name, noise_cv) for name in ("pendulum", "diabetes") for noise_cv in ("None", "5")
    }
    assert {row["variant"] for row in rows if row["data"] == "pendulum"} == {"", "angles"}
    # Few rows have an order of their own.
    assert len({row["nlpd"] for row in rows if (row["data"], row["noise_cv"]) == ("diabetes", "5")}) == 1
    page = output.with_suffix(".md").read_text()
    assert "| pendulum angles noise 0.01 | 1 |" in page
    assert "| diabetes sorted by 10 | 1 |" in page
    assert "14 of 14 cells are in" in run_script("calibration.py", *arguments)


def test_tables_of_a_folder_have_their_splits(calibration, tmp_path):
    (tmp_path / "plane").mkdir()
    rows = np.arange(30.0).reshape(10, 3)
    np.savetxt(tmp_path / "plane" / "data.csv.gz", rows, delimiter=",")
    masks = np.zeros((10, 2), dtype=int)
    masks[[1, 4], 1] = 1
    np.savetxt(tmp_path / "plane" / "test_mask.csv.gz", masks, delimiter=",", fmt="%d")
    assert calibration.variants("plane", tmp_path) == ["shuffled", "sorted by 0", "sorted by 2"]
    cell = calibration.Cell("plane", "sorted by 2", "", 1, "5", "full", tmp_path)
    (X, y), (X_test, y_test) = calibration.table(cell)
    assert X.shape == (8, 2)
    assert (np.diff(y) > 0).all()
    # In the units of the rows to learn from.
    np.testing.assert_allclose([y.mean(), y.std()], [0.0, 1.0], atol=1e-12)
    kept = rows[masks[:, 1] == 0]
    np.testing.assert_allclose(X_test, ((rows[[1, 4]] - kept.mean(axis=0)) / kept.std(axis=0))[:, :2])
    assert y_test.shape == (2,)


def test_a_line_is_of_the_seeds_that_have_both(calibration):
    rows = [
        {
            "data": "cartpole",
            "variant": "",
            "noise": "0.0",
            "seed": str(seed),
            "noise_cv": noise_cv,
            "cr2": str(cr2),
            "nlpd": str(nlpd),
            "error_mean": "2.0",
            "fit_seconds": "3.0",
            "dependent": "False",
        }
        for seed, noise_cv, cr2, nlpd in [
            (0, "None", 0.8, 1.0),
            (0, "5", 0.95, 0.5),
            (1, "None", 0.6, 1.0),
            (1, "5", 0.93, 1.5),
            (2, "None", 0.1, 9.0),
        ]
    ]
    (line,) = calibration.lines(rows)
    assert line == [
        "cartpole noise 0.0",
        "2",
        "0.700 → 0.940",
        "0.930 to 0.950",
        "1.000 → 1.000",
        "+0.500",
        "1.000",
        "1.00",
        "0",
    ]
