"""The benchmark of the cost of an evaluation in short mode."""

import pytest

from ..conftest import read


@pytest.mark.long
def test_a_ratio_is_that_of_the_medians(run_script, tmp_path):
    output = tmp_path / "cost.csv"
    run_script("speed/evaluation_cost.py", "--quick", "--repeats", "3", "--cores", "1", "2", "--output", output)
    rows = read(output)
    assert [row["sweep"] for row in rows] == ["data", "data", "rows", "rows", "points", "points"]
    for row in rows:
        assert float(row["ratio"]) == pytest.approx(float(row["evaluation_ms"]) / float(row["floor_ms"]))
        assert 0.0 < float(row["evaluation_fastest_ms"]) <= float(row["evaluation_ms"])
    assert output.with_suffix(".png").stat().st_size > 10_000
