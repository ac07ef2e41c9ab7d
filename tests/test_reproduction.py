"""REPRODUCTION.md says what the results say."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
pytestmark = pytest.mark.skipif(not RESULTS.exists(), reason="the benchmarks are not part of the installed package")


@pytest.fixture(scope="module")
def page():
    return (ROOT / "REPRODUCTION.md").read_text()


def test_the_errors_are_those_of_table_3(page):
    section = page[page.index("## Table 3: test results") : page.index("## Table 3: calibration")]
    rows = re.findall(r"^\| (?:pendulum|cartpole|acrobot|iiwa14) \|.*$", section, re.MULTILINE)
    assert len(rows) == 20
    assert set(rows) <= set((RESULTS / "table3.md").read_text().splitlines())


def test_what_it_names_is_there(page):
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", page)
    scripts = re.findall(r"python (benchmarks/\w+\.py)", page)
    assert len(links) > 20
    assert len(scripts) > 5
    assert [path for path in (*links, *scripts) if not (ROOT / path).exists()] == []
