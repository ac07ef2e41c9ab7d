"""Time and space against inducing points, rows, outputs and units, beside the paper's Table 3.

Measures evaluations of the bound with its gradient, steps of Adam in the paper's setting, steps of the network, and the
size of fitted models; writes one row per measurement to a CSV, and from the CSV exponents of power laws: a Markdown
page and a picture.

    python benchmarks/paper/complexity.py                    # two minutes of an idle core
    python benchmarks/paper/complexity.py --quick            # few sizes, seconds
    python benchmarks/paper/complexity.py --systems network  # without the GPs; the page then has what the file has

Times are processor time of one thread, the fastest of several repeats, on random rows of 5 columns. With --jobs above 1
cells share caches, and times are less even.
"""

from __future__ import annotations

import pickle
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from threadpoolctl import threadpool_limits

import harness
import internals
from paper import complexity_report
from paper.complexity_report import BATCH, CURVES, NETWORK_BATCH, QUICK
from paper.models import PAPER
from skevgp import BayesianMLPRegressor, EVGPRegressor

N_COLUMNS = 5
# Of a cell the seconds, and the number of repeats, that are enough; and repeats in any case.
PATIENCE, MOST, FEWEST = 1.0, 30, 3
SYSTEMS = ("gp", "network")


@dataclass(frozen=True)
class Cell:
    """One measurement; the sizes that a model does not have are 0.

    Attributes
    ----------
    what : {"bound", "adam step", "network step", "model", "network"}
        What is timed, or (the last two) weighed.
    setting : str
        Of a bound what the outputs share, of a model "paper" or "skevgp"; else empty.
    n_rows, n_inducing, n_outputs, n_layers, n_units : int
    repeats : int, default=3
        Of a time, at least.
    """

    what: str
    setting: str
    n_rows: int
    n_inducing: int
    n_outputs: int
    n_layers: int
    n_units: int
    repeats: int = field(default=FEWEST, compare=False)


def data(cell: Cell) -> tuple[np.ndarray, np.ndarray]:
    """Rows and targets."""
    rng = np.random.RandomState(0)
    X = rng.randn(cell.n_rows, N_COLUMNS)
    return X, np.sin(X @ rng.randn(N_COLUMNS, cell.n_outputs)) + 0.01 * rng.randn(cell.n_rows, cell.n_outputs)


@contextmanager
def bound(cell: Cell) -> Iterator[Callable[[], object]]:
    """() -> bound and gradient of all outputs; those that share nothing are models of one output, one after another."""
    alone = cell.setting == "none"
    n_models, n_outputs = (cell.n_outputs, 1) if alone else (1, cell.n_outputs)
    with ExitStack() as stack:
        size = (cell.n_rows, cell.n_inducing, N_COLUMNS, n_outputs)
        models = [
            stack.enter_context(internals.evaluation(*size, cores=1, sharing="all" if alone else cell.setting))
            for _ in range(n_models)
        ]
        yield lambda: [evaluate() for evaluate in models]


@contextmanager
def adam_step(cell: Cell) -> Iterator[Callable[[], object]]:
    """() -> one step in the paper's setting, over all parameters."""
    size = (cell.n_rows, cell.n_inducing, N_COLUMNS, cell.n_outputs)
    yield internals.adam_step(*size, BATCH)


@contextmanager
def network_step(cell: Cell) -> Iterator[Callable[[], object]]:
    """() -> a fit of as many steps as there are batches."""
    X, Y = data(cell)
    layers = (cell.n_units,) * cell.n_layers
    network = BayesianMLPRegressor(layers, batch_size=NETWORK_BATCH, max_iter=1, n_samples=1, random_state=0)
    yield lambda: network.fit(X, Y)


TIMED = {"bound": bound, "adam step": adam_step, "network step": network_step}


def timed(cell: Cell) -> dict[str, Any]:
    """Seconds of each repeat, after a first that does not count."""
    seconds: list[float] = []
    with TIMED[cell.what](cell) as work:
        work()
        while len(seconds) < cell.repeats or (sum(seconds) < PATIENCE and len(seconds) < MOST):
            start = time.process_time()
            work()
            seconds.append(time.process_time() - start)
    n_steps = -(-cell.n_rows // NETWORK_BATCH) if cell.what == "network step" else 1
    return {"seconds": min(seconds) / n_steps, "seconds_median": np.median(seconds) / n_steps, "repeats": len(seconds)}


def weighed(cell: Cell) -> dict[str, Any]:
    """Parameters of a fitted model, and its bytes in a file."""
    X, Y = data(cell)
    if cell.what == "network":
        regressor = BayesianMLPRegressor((cell.n_units,) * cell.n_layers, max_iter=1, random_state=0)
    else:
        points = np.random.RandomState(1).randn(cell.n_inducing, N_COLUMNS)
        setting = PAPER if cell.setting == "paper" else {}
        regressor = EVGPRegressor(inducing_init=points, max_iter=0, random_state=0, **setting)
    regressor.fit(X, Y)
    # The starting places are an argument, not part of what was learned.
    fitted = len(pickle.dumps(regressor)) - (0 if cell.what == "network" else len(pickle.dumps(points)))
    return {"n_parameters": regressor.n_parameters_, "n_bytes": fitted}


def run(cell: Cell) -> dict[str, Any]:
    """Time or weigh."""
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        measured = timed(cell) if cell.what in TIMED else weighed(cell)
    names = ("seconds", "seconds_median", "repeats", "n_parameters", "n_bytes")
    sizes = {own.name: getattr(cell, own.name) for own in fields(cell) if own.compare}
    return {**sizes, **{name: measured.get(name, "") for name in names}, **harness.provenance()}


def say(row: dict[str, Any]) -> str:
    return f"{1e3 * row['seconds']:.2f} ms" if row["seconds"] else f"{row['n_bytes'] / 1e6:.3f} MB"


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="few sizes",
        seeds="repeats of a time, at least, of the same random rows; what is in the CSV stays; default: 3",
        systems=SYSTEMS,
    )
    parser.set_defaults(jobs=1)
    options = parser.parse_args()
    output = harness.output_path(options, "complexity")
    curves = QUICK if options.quick else CURVES
    repeats = FEWEST if options.seeds is None else options.seeds
    cells = [
        Cell(**sizes, repeats=repeats)
        for curve in curves
        if ("network" if "network" in curve.what else "gp") in options.systems
        for sizes in curve.cells()
    ]
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since)

    # Everything the file has of these sizes, not only what was asked for now.
    rows = harness.read(output)
    curves = tuple(curve for curve in curves if curve.is_in(rows))
    if curves:
        complexity_report.plot(curves, rows, output.with_suffix(".png"))
    parts = complexity_report.paragraphs(curves, rows, options.quick) if curves else []
    harness.write_report(parts, output, n_failures)


if __name__ == "__main__":
    main()
