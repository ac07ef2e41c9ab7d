"""The benchmark of groups of outputs: all partitions, resumable, one line per system and model."""

import pytest

from .conftest import read


@pytest.fixture
def sharing(benchmarks):
    import sharing

    return sharing


def test_there_are_as_many_partitions_as_bell_counted(sharing):
    found = [list(sharing.partitions(range(n))) for n in range(1, 6)]
    assert [len(every) for every in found] == [1, 2, 5, 15, 52]
    names = [sharing.name_of(partition) for partition in found[3]]
    assert len(set(names)) == 15
    assert [sharing.groups_of(name) for name in names] == found[3]
    assert sharing.compared("pendulum") == ["0|1", "01"]
    assert sharing.compared("iiwa14") == ["0123456789abcd"]
    assert sharing.groups_of("9a|b") == [[9, 10], [11]]


def test_it_runs_resumes_and_writes_its_page(run_script, tmp_path):
    output = tmp_path / "sharing.csv"
    arguments = ("--quick", "--systems", "pendulum", "--models", "EVGP-IFG", "--max-iter", "5", "--jobs", "1")
    run_script("sharing.py", *arguments, "--output", output)
    rows = read(output)
    assert {row["sharing"]: row["groups"] for row in rows if row["sharing"] != "auto"} == {
        "kernel": "01",
        "01": "01",
        "0|1": "0|1",
    }
    (auto,) = (row for row in rows if row["sharing"] == "auto")
    (given,) = (row for row in rows if row["sharing"] == auto["groups"])
    assert auto["error_mean"] == given["error_mean"]
    assert "| pendulum EVGP-IFG | 1 |" in output.with_suffix(".md").read_text()
    assert "4 of 4 cells are in" in run_script("sharing.py", *arguments, "--output", output)


def test_the_best_partition_is_that_of_all_seeds_that_are_complete(sharing):
    errors = {"auto": (0.3, 0.1), "01": (0.4, 0.4), "0|1": (0.1, 0.3), "kernel": (0.2, 0.2)}
    rows = [
        {"seed": str(seed), "sharing": name, "groups": "0|1", "error_mean": str(error), "fit_seconds": "2.0"}
        for name, own in errors.items()
        for seed, error in enumerate(own)
    ]
    unfinished = {"seed": "2", "sharing": "auto", "groups": "01", "error_mean": "9.0", "fit_seconds": "9.0"}
    line = sharing.line_of("pendulum", "RES-VGP", [*rows, unfinished])
    expected = ["2", "0.400", "0.200", "0.200", "0.200", "0.200 (0 1)", "1.00", "1.00", "0 1 (2)"]
    assert line == ["pendulum RES-VGP", *expected]
    assert sharing.line_of("pendulum", "RES-VGP", rows[1:4]) == []
