"""Pages of results have the numbers of their CSVs, and REPRODUCTION.md has the numbers of the pages."""

import importlib
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"


@pytest.fixture
def script(monkeypatch):
    """Import a benchmark, with the folder of benchmarks on the path."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    before = set(sys.modules)
    yield importlib.import_module
    for name in set(sys.modules) - before:
        if (getattr(sys.modules[name], "__file__", None) or "").startswith(str(ROOT / "benchmarks")):
            del sys.modules[name]


# page -> (script, tables of the full runs' rows)
PAGES = {
    "complexity": ("paper.table3", lambda own, rows: {"complexity": own.table_of(list(own.CURVES), rows)}),
    "results_table": ("paper.table4", lambda own, rows: own.tables_of(rows)),
    "results_table_noise0.01": ("paper.table4", lambda own, rows: own.tables_of(rows)),
    "toy": ("paper.figure5", lambda own, rows: {"snelson, models": own.table_of(rows)}),
    "learning_curves": ("paper.figure6", lambda own, rows: own.tables_of(own.named(rows))),
    "beta": ("paper.figure7", lambda own, rows: {"acrobot": own.table_of(rows)}),
    "against_gpr": ("peers.against_gpr", lambda own, rows: own.tables_of(rows)),
    "latency": ("speed", lambda own, rows: own.PARTS["latency"][3](rows)),
    "casadi_latency": ("speed", lambda own, rows: own.casadi_tables(rows)),
    "evaluation_cost": ("speed", lambda own, rows: own.PARTS["evaluation"][3](rows)),
    "scaling": ("speed", lambda own, rows: own.PARTS["rows"][3](rows)),
    "many_rows": ("speed", lambda own, rows: own.PARTS["million"][3](rows)),
    "tabular": ("tables", lambda own, rows: own.tables_of_models(rows)),
    "auto_inducing": ("tables", lambda own, rows: own.tables_of_inducing(rows)),
    "rollouts": ("control", lambda own, rows: own.rollout_tables(rows)),
    "swing_up": ("control", lambda own, rows: own.swing_up_tables(rows)),
    "tracking": ("control", lambda own, rows: own.tracking_tables(rows)),
    "identification": ("robots", lambda own, rows: own.identification_tables(rows)),
    "calibration": ("calibration", lambda own, rows: own.tables_of(rows)),
    "robustness": ("robustness", lambda own, rows: own.tables_of(rows)),
}


@pytest.mark.parametrize("page", PAGES)
def test_page_has_the_numbers_of_its_csv(script, page):
    name, tables_of = PAGES[page]
    own, text = script(name), (RESULTS / f"{page}.md").read_text()
    rows = own.harness.frame(RESULTS / f"{page}.csv")
    rows = rows[rows["size"] == "full"] if "size" in rows else rows
    tables = tables_of(own, rows)
    assert all(f"<!-- table: {table} -->" in text for table in tables)
    assert own.harness.filled(text, tables) == text


def test_pages_of_several_csvs_have_their_numbers(script):
    peers, robots, tables = (script(name) for name in ("peers.against_peers", "robots", "tables"))
    frame, filled = peers.harness.frame, peers.harness.filled
    rows, curves = (frame(RESULTS / f"against_peers{end}.csv") for end in ("", "_curves"))
    found = {"against_peers": peers.tables_of(rows, curves)}
    found["splits"] = peers.tables_of(frame(RESULTS / "splits.csv"), curves[:0])
    arms = (frame(RESULTS / f"real_arms{end}.csv", size="full") for end in ("", "_parameters"))
    found["real_arms"] = robots.real_tables(*arms)
    for page, own in found.items():
        text = (RESULTS / f"{page}.md").read_text()
        assert filled(text, own) == text, page
    guide = tables.PAGE.read_text()
    assert tables.guide(guide, frame(RESULTS / "tabular.csv")) == guide


def test_tables_of_reproduction_are_those_of_the_pages():
    known = {line.strip() for page in RESULTS.glob("*.md") for line in page.read_text().splitlines()}
    starts = tuple(
        f"| {name}"
        for name in ("pendulum", "cartpole", "acrobot |", "iiwa14", "VGP |", "RES-VGP |", "RES-DBNN |", "Adam")
    )
    lines = [line.strip() for line in (ROOT / "REPRODUCTION.md").read_text().splitlines() if line.startswith(starts)]
    assert len(lines) > 100
    assert not [line for line in lines if line not in known]
