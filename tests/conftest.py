"""One BLAS thread per worker, since tests run in as many processes as there are cores; and benchmarks as scripts."""

import csv
import os
import runpy
import signal
import sys
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import pytest

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
# A shell that starts the tests in the background lets them ignore Ctrl-C; those that send it would wait for ever.
signal.signal(signal.SIGINT, signal.default_int_handler)

# scikit-learn 1.6 takes no rows of a pyarrow table.
_SKLEARN = tuple(int(part) for part in version("scikit-learn").split(".")[:2])
_FRAMES = ["pandas.DataFrame", "polars.DataFrame", *(["pyarrow.table"] if _SKLEARN >= (1, 7) else [])]


@pytest.fixture(params=_FRAMES)
def frame_of(request):
    """Make a data frame of named columns; of each package in turn."""
    package, name = request.param.split(".")
    return getattr(import_module(package), name)


@pytest.fixture
def benchmarks(monkeypatch):
    """The folder of scripts, which find the modules beside them and draw into files."""
    folder = Path(__file__).parents[1] / "benchmarks"
    if not folder.exists():
        pytest.skip("the benchmarks are not part of the installed package")
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("MPLBACKEND", "Agg")
    return folder


@pytest.fixture
def run_script(benchmarks, monkeypatch, capsys):
    """Run a benchmark with options; gives what it printed."""

    def run(script, *options):
        monkeypatch.setattr(sys, "argv", [script, *map(str, options)])
        runpy.run_path(str(benchmarks / script), run_name="__main__")
        return capsys.readouterr().out

    return run


def read(path):
    """The rows of a CSV."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
