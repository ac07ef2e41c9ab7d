"""REPRODUCTION.md says what the results say."""

import re
from pathlib import Path

import numpy as np
import pytest

from .benchmarks.conftest import read

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"


@pytest.fixture(scope="module")
def page():
    return (ROOT / "REPRODUCTION.md").read_text()


def test_the_errors_are_those_of_the_results_table(page):
    section = page[page.index("## Table 4: test results") : page.index("## Table 4: calibration")]
    rows = re.findall(r"^\| (?:pendulum|cartpole|acrobot|iiwa14) \|.*$", section, re.MULTILINE)
    assert len(rows) == 20
    assert set(rows) <= set((RESULTS / "results_table.md").read_text().splitlines())


def test_what_was_tried_on_the_cartpole_is_that_of_its_page(page):
    lines = [line for line in page.splitlines() if re.match(r"\| (Adam|L-BFGS|skevgp's defaults)", line)]
    assert len(lines) > 10
    assert set(lines) <= set((RESULTS / "cartpole.md").read_text().splitlines())


def test_the_calibration_is_that_of_the_results(page):
    rows = read(RESULTS / "results_table_noise0.01.csv")
    lines = re.findall(r"^\| (\w+) (EVGP-\w+) \| ([^|]*) \|(.*)\|(.*)\|(.*)\|$", page, re.MULTILINE)
    assert len(lines) == 8
    for system, model, seeds, *cells in lines:
        counts = set()
        for setting, cell in zip(("skevgp", "skevgp-angles", "skevgp-nominal"), cells, strict=True):
            wanted = (system, model, setting)
            cr2 = [float(row["cr2"]) for row in rows if (row["system"], row["model"], row["setting"]) == wanted]
            assert cell.strip() == (f"{np.mean(cr2):.3f}" if cr2 else "")
            counts |= {len(cr2)} - {0}
        assert seeds == " to ".join(map(str, sorted(counts)))


def test_what_it_names_is_there(page):
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", page)
    scripts = re.findall(r"python (benchmarks/[\w/]+\.py)", page)
    assert len(links) > 20
    assert len(scripts) > 5
    assert [path for path in (*links, *scripts) if not (ROOT / path).exists()] == []


def test_the_readme_has_the_same_errors():
    readme = (ROOT / "README.md").read_text()
    columns = {"skevgp": 3, "skevgp-angles": 4, "skevgp-nominal": 5}
    shown = {
        cells[0].split()[0]: cells
        for line in readme.splitlines()
        if re.match(r"\| (pendulum|cartpole|acrobot|iiwa14).* \| \d+ \| 0\.\d+ \|", line)
        for cells in [[cell.strip() for cell in line.strip("|").split("|")]]
    }
    assert len(shown) == 4
    errors = {}
    for row in read(RESULTS / "results_table.csv"):
        if row["model"] == "EVGP-IFG" and row["setting"] in columns:
            errors.setdefault((row["system"], row["setting"]), []).append(float(row["error_mean"]))
    compared = 0
    for (system, setting), values in errors.items():
        text = shown[system][columns[setting]]
        if text:
            assert len(values) == 4
            assert text == f"{np.mean(values):.{len(text) - 2}f}"
            compared += 1
    assert compared == 8
