"""Time and memory as the number of rows grows: a memory-mapped file on one and two threads, and Dask on two workers.

Each cell is a fresh process: a fit of a few iterations to 8 columns with 100 inducing points, from which the median
time of an evaluation (bound and gradient) and the peak of the memory above what the process had before the fit (data
and imported packages) are taken. A cell that is in the CSV already is not run again.

    python benchmarks/scaling.py                 # up to a million rows, about 5 minutes
    python benchmarks/scaling.py --quick         # up to 10,000 rows
    python benchmarks/scaling.py --full-fit      # also one fit of a million rows to convergence
"""

from __future__ import annotations

import argparse
import csv
import json
import platform
import resource
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import scipy
import sklearn

import skevgp
from skevgp import EVGPRegressor
from skevgp.inference.objectives import BoundObjective

ENGINES = ("1 thread", "2 threads", "Dask, 2 workers")
COLUMNS = ["n_rows", "n_columns", "n_inducing", "engine", "max_iter", "evaluation_seconds", "n_evaluations"]
COLUMNS += ["fit_seconds", "memory_mb", "data_mb", "r2", "noise_sd", "converged", "versions", "machine"]
N_COLUMNS, N_INDUCING, CHUNK = 8, 100, 50_000


def make_files(folder: Path, n_rows: int) -> tuple[Path, Path]:
    """A smooth function of 8 columns plus noise of standard deviation 0.1, in .npy files, written piece by piece."""
    rng = np.random.RandomState(0)
    directions = rng.randn(N_COLUMNS, 3) / np.sqrt(N_COLUMNS)
    paths = folder / f"X{n_rows}.npy", folder / f"y{n_rows}.npy"
    if not paths[1].exists():
        X = np.lib.format.open_memmap(paths[0], "w+", np.float64, (n_rows, N_COLUMNS))
        y = np.lib.format.open_memmap(paths[1], "w+", np.float64, (n_rows,))
        for first in range(0, n_rows, CHUNK):
            rows = slice(first, min(first + CHUNK, n_rows))
            X[rows] = rng.uniform(-2.0, 2.0, (rows.stop - first, N_COLUMNS))
            y[rows] = np.sin(X[rows] @ directions).sum(axis=1) + 0.1 * rng.randn(rows.stop - first)
        X.flush()
        y.flush()
    return paths


class PeakMemory(threading.Thread):
    """The largest anonymous memory of this process (its mapped files are the data), in MB, while it runs."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.before = self.peak = self.now()
        self.done = threading.Event()

    @staticmethod
    def now() -> float:
        try:
            status = Path("/proc/self/status").read_text()
            return float(status.split("RssAnon:")[1].split()[0]) / 1024
        except (OSError, IndexError):
            return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    def run(self) -> None:
        while not self.done.wait(0.005):
            self.peak = max(self.peak, self.now())


def run(n_rows: int, engine: str, max_iter: int, folder: Path) -> dict[str, object]:
    """One cell, in this process."""
    paths = make_files(folder, n_rows)
    X, y = (np.load(path, mmap_mode="r") for path in paths)
    client = None
    if engine.startswith("Dask"):
        import dask.array as da
        import distributed

        cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
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

    seconds = []
    evaluate = BoundObjective.__call__

    def timed(self: BoundObjective, flat: np.ndarray) -> tuple[float, np.ndarray]:
        start = time.perf_counter()
        result = evaluate(self, flat)
        seconds.append(time.perf_counter() - start)
        return result

    BoundObjective.__call__ = timed  # type: ignore[method-assign]
    n_jobs = 2 if engine.startswith("2") else 1
    model = EVGPRegressor(n_inducing=N_INDUCING, max_iter=max_iter, n_jobs=n_jobs, random_state=0)
    memory = PeakMemory()
    memory.start()
    start = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.fit(X, y)
    fit_seconds = time.perf_counter() - start
    memory.done.set()
    memory.join()
    test = np.random.RandomState(1).randint(n_rows, size=min(n_rows, 5000))
    X, y = (np.load(path, mmap_mode="r")[np.sort(test)] for path in paths)
    if client is not None:
        client.close()
        cluster.close()
    versions = " ".join(f"{package.__name__} {package.__version__}" for package in (skevgp, np, scipy, sklearn))
    values = (n_rows, N_COLUMNS, N_INDUCING, engine, max_iter, np.median(seconds), len(seconds), fit_seconds)
    values += (memory.peak - memory.before, 8e-6 * n_rows * (N_COLUMNS + 1), model.score(X, y))
    values += (np.sqrt(model.noise_variance_), not caught, versions, platform.processor() or platform.machine())
    return dict(zip(COLUMNS, values, strict=True))


def plot(rows: list[dict[str, str]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for engine, colour, marker in zip(ENGINES, ("#0072B2", "#D55E00", "#009E73"), "os^", strict=True):
        of = sorted(
            (float(r["n_rows"]), float(r["evaluation_seconds"]), float(r["memory_mb"]))
            for r in rows
            if r["engine"] == engine and int(r["max_iter"]) < 1000
        )
        if not of:
            continue
        n, seconds, memory = np.array(of).T
        left.loglog(n, seconds, marker + "-", color=colour, label=engine)
        right.semilogx(
            n, memory, marker + "-", color=colour, label=engine + (": the client" if "Dask" in engine else "")
        )
    data = sorted({(float(r["n_rows"]), float(r["data_mb"])) for r in rows})
    right.semilogx(*np.array(data).T, ":", color="0.4", label="the data themselves (not counted)")
    right.axhline(300, color="0.4", linewidth=0.8)
    right.annotate("300 MB", (data[0][0], 300), (0, -11), textcoords="offset points", color="0.4")
    left.set(xlabel="rows", ylabel="seconds", title="One evaluation of bound and gradient")
    right.set(xlabel="rows", ylabel="MB", title="Peak memory of the fit above the data", ylim=(0, 320))
    left.legend(frameon=False)
    right.legend(frameon=False, loc="upper left", bbox_to_anchor=(0.0, 0.88))
    figure.suptitle(f"{N_COLUMNS} columns, {N_INDUCING} inducing points", fontsize=10)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="up to 10,000 rows")
    parser.add_argument("--full-fit", action="store_true", help="also a million rows to convergence, on two threads")
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=list(ENGINES))
    parser.add_argument("--redo", action="store_true", help="run cells again that are in the CSV")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "scaling.csv")
    parser.add_argument("--cell", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.cell:
        cell = json.loads(options.cell)
        print(json.dumps(run(cell["n_rows"], cell["engine"], cell["max_iter"], Path(cell["folder"])), default=str))
        return

    options.output.parent.mkdir(parents=True, exist_ok=True)
    sizes = (1_000, 10_000) if options.quick else (10_000, 30_000, 100_000, 300_000, 1_000_000)
    cells = [(n, engine, 8) for n in sizes for engine in options.engines]
    if options.full_fit:
        cells.append((sizes[-1], "2 threads", 1000))
    rows = list(csv.DictReader(options.output.open())) if options.output.exists() else []
    if options.redo:
        again = {(str(n), engine, str(max_iter)) for n, engine, max_iter in cells}
        rows = [row for row in rows if (row["n_rows"], row["engine"], row["max_iter"]) not in again]
    with tempfile.TemporaryDirectory() as folder:
        for n_rows, engine, max_iter in cells:
            if any(
                (row["n_rows"], row["engine"], row["max_iter"]) == (str(n_rows), engine, str(max_iter)) for row in rows
            ):
                continue
            cell = {"n_rows": n_rows, "engine": engine, "max_iter": max_iter, "folder": folder}
            command = [sys.executable, __file__, "--cell", json.dumps(cell)]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            row = {name: str(value) for name, value in json.loads(done.stdout.splitlines()[-1]).items()}
            rows.append(row)
            rows.sort(key=lambda row: (row["engine"], int(row["max_iter"]), int(row["n_rows"])))
            with options.output.open("w", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS)
                writer.writeheader()
                writer.writerows(rows)
            print(
                f"{n_rows:9,d} rows, {engine:16s}: {1000 * float(row['evaluation_seconds']):8.1f} ms per evaluation, "
                f"{float(row['memory_mb']):5.0f} MB, fit {float(row['fit_seconds']):6.1f} s",
                flush=True,
            )
    for engine in ENGINES:
        of = [
            row
            for row in rows
            if row["engine"] == engine and int(row["max_iter"]) < 1000 and int(row["n_rows"]) >= sizes[0]
        ]
        if len(of) > 1:
            n, seconds = np.array([(float(row["n_rows"]), float(row["evaluation_seconds"])) for row in of]).T
            print(f"{engine}: slope of log time over log rows {np.polyfit(np.log(n), np.log(seconds), 1)[0]:.2f}")
    plot(rows, options.output.with_suffix(".png"))


if __name__ == "__main__":
    main()
