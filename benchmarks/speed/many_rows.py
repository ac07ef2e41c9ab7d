"""A fit of a million rows to its end: how near it comes to a thousand iterations on all of them, and mini-batches.

8 columns, a smooth function plus noise, in memory-mapped files (those of `scaling.py`); 100 inducing points, two
threads, each fit in a fresh process, with the noise where the bound is highest. "gained" is what the bound gains over
noise alone, as a share of what the thousand iterations gain. Writes one row per fit to a CSV (what is there already is
not fitted again), and once there is the reference a page.

    python benchmarks/speed/many_rows.py                   # L-BFGS and Adam: some minutes of two cores
    python benchmarks/speed/many_rows.py --fits reference  # a thousand iterations: much longer
    python benchmarks/speed/many_rows.py --quick           # 10,000 rows, 30 iterations
"""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np

import harness
import internals
from harness import Row
from skevgp import EVGPRegressor
from skevgp.metrics import negative_log_predictive_density
from skevgp.solvers import LBFGS, Adam
from speed.scaling import N_INDUCING, make_files

# Of Adam: how often it sees all rows.
EPOCHS = {"adam 10": 10, "adam 40": 40, "adam 120": 120}
FITS = ("default", *EPOCHS, "reference")
N_TEST, BATCH_SIZE = 10_000, 2000


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes
    ----------
    n_rows : int
    fit : {"default", "adam 10", "adam 40", "reference"}
        L-BFGS with its defaults, natural gradients on mini-batches for so many epochs, or L-BFGS with as many
        iterations as are allowed, all of them on all rows.
    max_iter : int
        Of the last.
    folder : Path
        Of the data.
    """

    n_rows: int
    fit: str
    max_iter: int = field(compare=False)
    folder: Path = field(compare=False)


def run(cell: Cell) -> dict[str, Any]:
    """One fit, in this process."""
    rows = [np.load(path, mmap_mode="r") for path in make_files(cell.folder, cell.n_rows + N_TEST)]
    (X, X_test), (y, y_test) = (np.split(array, [cell.n_rows]) for array in rows)
    model = EVGPRegressor(n_inducing=N_INDUCING, noise_cv=None, n_jobs=2, random_state=0)
    if cell.fit in EPOCHS:
        steps = EPOCHS[cell.fit] * cell.n_rows // BATCH_SIZE
        model.set_params(solver=Adam(batch_size=BATCH_SIZE, natural_gradient=True), max_iter=steps)
    elif cell.fit == "reference":
        model.set_params(solver=LBFGS(tol=0.0), max_iter=cell.max_iter)
    begin = internals.rules(sample=None) if cell.fit == "reference" else nullcontext()
    with warnings.catch_warnings(record=True) as caught, harness.peak_memory() as memory, begin:
        warnings.simplefilter("always")
        start, cpu_start = time.perf_counter(), time.process_time()
        model.fit(X, y)
        seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
    noise = float(np.mean(np.square(y)))
    mean, std = model.predict(X_test, return_std=True)
    return {
        "n_rows": cell.n_rows,
        "fit": cell.fit,
        "n_iter": model.n_iter_,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "memory_mb": memory(),
        "bound_per_row": model.lower_bound_ / cell.n_rows,
        "noise_alone_per_row": -0.5 * (np.log(2.0 * np.pi * noise) + 1.0),
        "nlpd": negative_log_predictive_density(y_test, mean, std),
        "warned": bool(caught),
        **harness.provenance(),
    }


def say(row: dict[str, Any]) -> str:
    return f"{row['n_iter']} iterations, {row['seconds']:.0f} s, bound {row['bound_per_row']:.4f} per row"


def paragraphs(rows: Sequence[Row]) -> list[str]:
    """The page: nothing as long as there is no reference."""
    gained = {row["fit"]: float(row["bound_per_row"]) - float(row["noise_alone_per_row"]) for row in rows}
    if "reference" not in gained:
        return []
    lines = [
        [
            row["fit"],
            row["n_iter"],
            *(f"{float(row[name]):.0f}" for name in ("seconds", "cpu_seconds", "memory_mb")),
            f"{float(row['bound_per_row']):.4f}",
            f"{100.0 * gained[row['fit']] / gained['reference']:.2f} %",
            f"{float(row['nlpd']):.4f}",
        ]
        for row in rows
    ]
    header = ["fit", "iterations", "s", "CPU s", "MB above the data", "bound per row", "gained", "NLPD"]
    return [
        f"# {int(rows[0]['n_rows']):,} rows",
        harness.table(header, lines),
        f"{harness.provenance_text(rows)}",
    ]


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="10,000 rows, 30 iterations", in_processes=False)
    parser.add_argument("--fits", nargs="+", choices=FITS, help="default: all but the reference, of a quick run all")
    options = parser.parse_args()
    output = harness.output_path(options, "many_rows")
    n_rows, max_iter = (10_000, 30) if options.quick else (1_000_000, 1000)
    fits = options.fits or (FITS if options.quick else FITS[:-1])
    with tempfile.TemporaryDirectory() as name:
        cells = [Cell(n_rows, fit, max_iter, Path(name)) for fit in fits]
        n_failures = harness.run_missing(cells, run, output, 1, say, fresh=True)
    rows = [row for row in harness.read(output) if int(row["n_rows"]) == n_rows]
    harness.write_report(paragraphs(rows) if rows else [], output, n_failures)


if __name__ == "__main__":
    main()
