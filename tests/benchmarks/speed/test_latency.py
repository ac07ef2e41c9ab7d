"""The benchmark of what control loops wait for, with few inducing points."""


def test_each_library_is_timed_in_a_process_of_its_own():
    import sys

    from speed import latency

    rows = [row for library in latency.OWN for row in latency.run(latency.Cell(library, 0, "quick", sys.executable))]
    assert min(row["microseconds"] for row in rows) > 0.0
    calls = {row["call"] for row in rows if row["library"] == "skevgp"}
    assert {"compiled: row, mean and std", "compiled: horizon, mean and Jacobian", "partial_fit of 10 rows"} <= calls
    _, _, table, _ = latency.paragraphs([{name: str(value) for name, value in row.items()} for row in rows])
    assert "| scikit-learn | row, mean and std |" in table


def test_what_a_library_says_when_it_fails_is_said():
    import sys

    import pytest

    from speed import latency

    with pytest.raises(RuntimeError, match="KeyError: 'none'"):
        latency.run(latency.Cell("none", 0, "quick", sys.executable))
