"""Benchmarks as scripts, and what they write."""

import csv
import runpy
import sys
from pathlib import Path

import pytest
from matplotlib import pyplot, rc_context

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(autouse=True)
def benchmarks(monkeypatch):
    """Their folder on the path, where a script puts it itself; pictures are drawn into files."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setenv("MPLBACKEND", "Agg")
    with rc_context():  # their style ends with them
        yield


@pytest.fixture
def drawn(monkeypatch):
    """Draw with a script's function; gives the figures that it saved."""

    def draw(plot, *arguments):
        figures = []
        with monkeypatch.context() as patch:
            patch.setattr(pyplot, "close", figures.append)
            plot(*arguments)
        return figures

    yield draw
    pyplot.close("all")


@pytest.fixture
def run_script(monkeypatch, capsys):
    """Run a benchmark with options; gives what it printed."""

    def run(script, *options):
        monkeypatch.setattr(sys, "argv", [script, *map(str, options)])
        runpy.run_path(str(BENCHMARKS / script), run_name="__main__")
        return capsys.readouterr().out

    return run


def read(path):
    """The rows of a CSV."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
