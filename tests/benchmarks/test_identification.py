"""The benchmark of identification: two simulated arms, resumable, a line per filter."""

import numpy as np
import pytest

from .conftest import read

pytest.importorskip("pinocchio")
pytestmark = pytest.mark.long


@pytest.fixture
def identification(benchmarks):
    import identification

    return identification


def test_it_runs_resumes_and_writes_its_page(run_script, tmp_path):
    output = tmp_path / "identification.csv"
    options = ("--quick", "--seeds", "1", "--jobs", "1", "--output", output)
    run_script("identification.py", *options)
    rows = read(output)
    assert [(row["cutoff"], row["seed"]) for row in rows] == [("none", "0"), ("5 Hz", "0")]
    for row in rows:
        assert 20 < int(row["n_told"]) < 84
        assert int(row["covered"]) / int(row["n_told"]) > 0.8
        assert float(row["torque_error_worst"]) < 0.02 < float(row["cad_error_worst"])
    page = output.with_suffix(".md").read_text()
    assert "| none | 1 |" in page
    assert "| 5 Hz | 1 |" in page
    assert "2 of 2 cells are in" in run_script("identification.py", *options)


def test_velocities_and_accelerations_are_those_of_the_positions(identification):
    X = identification.trajectory(np.random.default_rng(0), 2, "quick")
    q, v, a = np.split(X, 3, axis=1)
    for values, slopes in ((q, v), (v, a)):
        differences = np.gradient(values, identification.STEP, axis=0)
        np.testing.assert_allclose(differences[1:-1], slopes[1:-1], atol=1e-3 * np.abs(slopes).max())


def test_a_filter_does_not_change_slow_signals(identification):
    rng = np.random.default_rng(0)
    X = identification.trajectory(rng, 2, "quick")
    Z, torque = identification.filtered(X, X[:, :2], 5.0)
    inside = slice(40, 40 + len(Z))
    np.testing.assert_allclose(Z, X[inside], atol=1e-3 * np.abs(X).max())
    np.testing.assert_allclose(torque, X[inside, :2], atol=1e-3 * np.abs(X).max())


def test_roots_give_the_covariance_back(identification):
    A = np.random.default_rng(0).normal(size=(4, 3)) * [[1.0], [1e3], [1e-3], [1.0]]
    root, inverse = identification.root_of(A @ A.T)
    np.testing.assert_allclose(root @ root.T, A @ A.T, atol=1e-9, rtol=1e-6)
    np.testing.assert_allclose(inverse @ root, np.eye(3), atol=1e-9)
