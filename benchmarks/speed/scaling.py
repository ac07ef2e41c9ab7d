"""Time and memory as the number of rows grows: a memory-mapped file on one and two threads, and Dask on two workers.

Each cell is a fresh process: a fit of a few iterations to 8 columns with 100 inducing points, from which the median
time of an evaluation (bound and gradient) and the peak of the memory above what the process had before the fit (data
and imported packages) are taken. A cell that is in the CSV already is not run again.

    python benchmarks/speed/scaling.py                 # up to a million rows, about 5 minutes
    python benchmarks/speed/scaling.py --quick         # up to 10,000 rows
    python benchmarks/speed/scaling.py --full-fit      # also one fit of a million rows to convergence
"""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np

import harness
from internals import TimedLBFGS
from skevgp import EVGPRegressor

ENGINES = ("1 thread", "2 threads", "Dask, 2 workers")
N_COLUMNS, N_INDUCING, CHUNK = 8, 100, 50_000


def make_files(folder: Path, n_rows: int) -> tuple[Path, Path]:
    """A smooth function of 8 columns plus noise of standard deviation 0.1, in .npy files, written piece by piece."""
    paths = folder / f"X{n_rows}.npy", folder / f"y{n_rows}.npy"
    if not paths[1].exists():
        X = np.lib.format.open_memmap(paths[0], "w+", np.float64, (n_rows, N_COLUMNS))
        y = np.lib.format.open_memmap(paths[1], "w+", np.float64, (n_rows,))
        starts = range(0, n_rows, CHUNK)
        pieces = harness.noisy_waves(min(CHUNK, n_rows), N_COLUMNS, np.random.RandomState(0))
        for first, piece in zip(starts, pieces, strict=False):
            X[first : first + CHUNK], y[first : first + CHUNK] = (part[: n_rows - first] for part in piece[:2])
        X.flush()
        y.flush()
    return paths


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes
    ----------
    n_rows : int
    engine : str
    max_iter : int
    folder : Path
        Of the data.
    """

    n_rows: int
    engine: str
    max_iter: int
    folder: Path = field(compare=False)


def run(cell: Cell) -> dict[str, Any]:
    """One cell, in this process."""
    n_rows, engine, max_iter = cell.n_rows, cell.engine, cell.max_iter
    paths = make_files(cell.folder, n_rows)
    X, y = (np.load(path, mmap_mode="r") for path in paths)
    client = None
    if engine.startswith("Dask"):
        import dask.array as da
        import distributed

        cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0")
        client = distributed.Client(cluster)
        rows = max(min(CHUNK, n_rows // 4), 1)
        starts = range(0, n_rows, rows)

        def lazy(path: Path, shape: tuple[int, ...]) -> object:
            import dask

            def piece(first: int) -> np.ndarray:
                return np.array(np.load(path, mmap_mode="r")[first : first + rows])

            pieces = [dask.delayed(piece)(first) for first in starts]
            return da.concatenate(
                [
                    da.from_delayed(part, (min(rows, n_rows - first), *shape), dtype=np.float64)
                    for part, first in zip(pieces, starts, strict=True)
                ]
            )

        X, y = lazy(paths[0], (N_COLUMNS,)), lazy(paths[1], ())

    n_jobs = 2 if engine.startswith("2") else 1
    solver = TimedLBFGS()
    settings = {"max_iter": max_iter, "noise_cv": None, "n_jobs": n_jobs, "random_state": 0}
    model = EVGPRegressor(n_inducing=N_INDUCING, solver=solver, **settings)
    with (
        warnings.catch_warnings(record=True) as caught,
        harness.peak_memory() as memory,
    ):
        warnings.simplefilter("always")
        start = time.perf_counter()
        model.fit(X, y)
        fit_seconds = time.perf_counter() - start
    test = np.random.RandomState(1).randint(n_rows, size=min(n_rows, 5000))
    X, y = (np.load(path, mmap_mode="r")[np.sort(test)] for path in paths)
    if client is not None:
        client.close()
        cluster.close()
    where = harness.provenance()
    return {
        **{"n_rows": n_rows, "n_columns": N_COLUMNS, "n_inducing": N_INDUCING, "engine": engine, "max_iter": max_iter},
        "evaluation_seconds": np.median(solver.seconds_),
        "n_evaluations": len(solver.seconds_),
        "fit_seconds": fit_seconds,
        "memory_mb": memory(),
        "data_mb": 8e-6 * n_rows * (N_COLUMNS + 1),
        "r2": model.score(X, y),
        "noise_sd": np.sqrt(model.noise_variance_),
        "converged": not caught,
        **{name: where[name] for name in ("versions", "machine")},
    }


def say(row: dict[str, Any]) -> str:
    return (
        f"{1000 * row['evaluation_seconds']:.1f} ms per evaluation, {row['memory_mb']:.0f} MB, "
        f"fit {row['fit_seconds']:.1f} s"
    )


def plot(rows: list[dict[str, str]], path: Path) -> None:
    figure, (left, right) = harness.pyplot().subplots(1, 2, figsize=(harness.WIDTH, 3.2))
    for engine, colour, marker in zip(ENGINES, harness.PALETTE[:3], "os^", strict=True):
        of = [row for row in rows if row["engine"] == engine and int(row["max_iter"]) < 1000]
        if not of:
            continue
        of.sort(key=lambda row: int(row["n_rows"]))
        n, seconds, memory = (harness.column(of, name) for name in ("n_rows", "evaluation_seconds", "memory_mb"))
        left.plot(n, seconds, marker + "-", color=colour, label=engine)
        right.plot(n, memory, marker + "-", color=colour, label=engine + (": the client" if "Dask" in engine else ""))
    data = sorted({(float(r["n_rows"]), float(r["data_mb"])) for r in rows})
    right.plot(*np.array(data).T, ":", color="0.4", label="the data themselves (not counted)")
    right.axhline(300, color="0.4", linewidth=0.8)
    right.annotate("300 MB", (data[0][0], 300), (0, -11), textcoords="offset points", color="0.4")
    left.set(xlabel="rows", ylabel="seconds", title="One evaluation of bound and gradient")
    right.set(xlabel="rows", ylabel="MB", title="Peak memory of the fit above the data", ylim=(0, 320))
    for axes, which in ((left, "x"), (left, "y"), (right, "x")):
        harness.logarithmic(axes, which)
    left.legend()
    right.legend(loc="upper left", bbox_to_anchor=(0.0, 0.88))
    figure.suptitle(f"{N_COLUMNS} columns, {N_INDUCING} inducing points")
    harness.save_picture(figure, path)


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="up to 10,000 rows", in_processes=False)
    parser.add_argument("--full-fit", action="store_true", help="also a million rows to convergence, on two threads")
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=list(ENGINES))
    parser.add_argument("--redo", action="store_true", help="run cells again that are in the CSV")
    options = parser.parse_args()
    output = harness.output_path(options, "scaling")
    sizes = (1_000, 10_000) if options.quick else (10_000, 30_000, 100_000, 300_000, 1_000_000)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cells = [Cell(n, engine, 8, folder) for n in sizes for engine in options.engines]
        if options.full_fit:
            cells.append(Cell(sizes[-1], "2 threads", 1000, folder))
        if options.redo and (rows := harness.read(output)):
            again = set(map(harness.key, cells))
            kept = [row for row in rows if (row["n_rows"], row["engine"], row["max_iter"]) not in again]
            harness.write(kept, list(rows[0]), output)
        n_failures = harness.run_missing(cells, run, output, 1, say, fresh=True)
    rows = harness.read(output)
    for engine in ENGINES:
        of = [
            row
            for row in rows
            if row["engine"] == engine and int(row["max_iter"]) < 1000 and int(row["n_rows"]) >= sizes[0]
        ]
        if len(of) > 1:
            n, seconds = (harness.column(of, name) for name in ("n_rows", "evaluation_seconds"))
            print(f"{engine}: slope of log time over log rows {np.polyfit(np.log(n), np.log(seconds), 1)[0]:.2f}")
    if rows:
        plot(rows, output.with_suffix(".png"))
    if n_failures:
        raise SystemExit(f"{n_failures} cells failed; run again to try only these.")


if __name__ == "__main__":
    main()
