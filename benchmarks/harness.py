"""What the benchmarks share: their options, cells run in processes, and a CSV in which what is finished stays."""

from __future__ import annotations

import argparse
import csv
import dataclasses
import platform
import resource
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import scipy
import sklearn

import skevgp

RESULTS = Path(__file__).parent / "results"

Row = dict[str, str]  # of a CSV


def argument_parser(
    description: str | None,
    *,
    quick: str,
    seeds: str | None = None,
    systems: Collection[str] = (),
    in_processes: bool = True,
) -> argparse.ArgumentParser:
    """With the options of every benchmark.

    Parameters
    ----------
    description : str
        The script's docstring.
    quick : str
        What --quick means.
    seeds : str, default=None
        What --seeds counts and its default; None is a benchmark without seeds.
    systems : collection of str, default=()
        What --systems chooses from; empty is a benchmark of no system.
    in_processes : bool, default=True
        Whether there is --jobs; a benchmark of the time on the wall runs one cell after the other.

    Returns
    -------
    parser : ArgumentParser
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=quick)
    if seeds:
        parser.add_argument("--seeds", type=int, help=seeds)
    if systems:
        parser.add_argument("--systems", nargs="+", choices=systems, default=list(systems), help="default: %(default)s")
    if in_processes:
        parser.add_argument(
            "--jobs", type=int, default=joblib.cpu_count(), help="processes, each on one core; default: %(default)s"
        )
    parser.add_argument(
        "--output", type=Path, help="the CSV; what is drawn from it goes beside it; default: in benchmarks/results"
    )
    return parser


def output_path(options: argparse.Namespace, name: str) -> Path:
    """``--output``, or ``name``.csv in the folder of results, with "_quick" for a quick run."""
    path = options.output or RESULTS / f"{name}{'_quick' if options.quick else ''}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def provenance() -> dict[str, str]:
    """Columns that say when, with what and where a row was measured."""
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "versions": " ".join(f"{package.__name__} {package.__version__}" for package in (skevgp, np, scipy, sklearn)),
        "machine": platform.processor() or platform.machine(),
    }


def provenance_text(rows: Iterable[Row]) -> str:
    """The same of many rows, as a sentence of a report."""
    columns = ({row[name] for row in rows} for name in ("date", "versions", "machine"))
    dates, versions, machines = (sorted(values) for values in columns)
    return f"{' to '.join(dict.fromkeys((dates[0], dates[-1])))}; {'; '.join(versions)}; {', '.join(machines)}."


def read(path: Path) -> list[Row]:
    """The rows that are there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def append(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Add rows, below a header of their keys if the file is new."""
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        if file.tell() == 0:
            writer.writeheader()
        writer.writerows(rows)


def write(rows: Iterable[dict[str, Any]], columns: Sequence[str], path: Path) -> None:
    """Write rows anew; interrupted, it leaves the file as it was."""
    new = path.with_suffix(".new")
    with new.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
    new.replace(path)


def key(cell: Any) -> tuple[str, ...]:
    """What tells a cell from all others, as a CSV holds it: the fields by which it is compared."""
    return tuple(str(getattr(cell, field.name)) for field in dataclasses.fields(cell) if field.compare)


def run_missing(
    cells: Sequence[Any],
    run: Callable[[Any], Any],
    output: Path,
    jobs: int,
    say: Callable[[Any], str],
    fresh: bool = False,
) -> int:
    """Run the cells of which the CSV has no row, in processes, and write what each gives as it comes.

    Parameters
    ----------
    cells : sequence of dataclass
        Their fields that are compared are columns of the CSV.
    run : callable
        cell -> its row, or a list of its rows; a function of the top level of a module.
    output : Path
        The CSV.
    jobs : int
        Cells at a time.
    say : callable
        What ``run`` returned -> what to print of it.
    fresh : bool, default=False
        Whether each cell has a process of its own, where memory is measured.

    Returns
    -------
    n_failures : int
        Cells that raised; the others are in the CSV.
    """
    names = [field.name for field in dataclasses.fields(cells[0]) if field.compare] if cells else []
    done = {tuple(row[name] for name in names) for row in read(output)}
    missing = [cell for cell in cells if key(cell) not in done]
    print(f"{len(cells) - len(missing)} of {len(cells)} cells are in {output}", flush=True)
    if not missing:
        return 0
    start, n_failures = time.perf_counter(), 0
    # Fresh processes, since a copy of this one could hold locks of its threads. Ctrl-C ends them: a fit would take it
    # for the end of its iterations, and go on to the next.
    context = get_context("forkserver" if fresh else "spawn")
    if fresh:  # imported once; a process has no memory of another's fits
        context.set_forkserver_preload(["skevgp", "skevgp.datasets", "sklearn.gaussian_process", "pinocchio"])
    with ProcessPoolExecutor(
        *(jobs, context, signal.signal, (signal.SIGINT, signal.SIG_DFL)),
        max_tasks_per_child=1 if fresh else None,
    ) as pool:
        pending = {pool.submit(run, cell): cell for cell in missing}
        try:
            for count, future in enumerate(as_completed(pending), start=1):
                said = f"[{count}/{len(missing)}] {' '.join(key(pending[future]))}: "
                try:
                    result = future.result()
                except Exception as problem:  # hours of other cells are not lost with this one
                    n_failures += 1
                    said += f"failed: {type(problem).__name__}: {problem}"
                else:
                    append(result if isinstance(result, list) else [result], output)
                    said += say(result)
                print(f"{said}; {time.perf_counter() - start:.0f} s so far", flush=True)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            raise SystemExit(f"Interrupted. What is finished is in {output}; run again to go on.") from None
    return n_failures


def figure_of(value: float) -> str:
    """Three digits."""
    return f"{value:#.3g}".rstrip(".")


def table(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """In Markdown."""
    rows = [header, ["---"] * len(header), *lines]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in rows) + "\n"


def column(rows: Iterable[Row], name: str) -> np.ndarray:
    """Of numbers."""
    return np.array([float(row[name]) for row in rows])


def write_report(parts: Iterable[str], output: Path, n_failures: int = 0) -> None:
    """Write paragraphs to the Markdown beside the CSV and print them; say in the exit code if cells failed."""
    text = "\n\n".join(part.strip("\n") for part in parts) + "\n"
    output.with_suffix(".md").write_text(text)
    print(f"\n{text}\n{output.with_suffix('.md')}, {output.with_suffix('.png')}")
    if n_failures:
        raise SystemExit(f"{n_failures} cells failed; run again to try only these.")


def save_picture(figure: Any, path: Path) -> None:
    """Write a figure as a PNG of at most 128 colours, a third of the usual size."""
    from PIL import Image

    figure.set_dpi(110)
    figure.canvas.draw()
    image = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    image.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


def anonymous_memory() -> float:
    """Of this process, in MB; its mapped files, which are data, are not counted where the system tells them apart."""
    try:
        return float(Path("/proc/self/status").read_text().split("RssAnon:")[1].split()[0]) / 1024
    except (OSError, IndexError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@contextmanager
def peak_memory() -> Iterator[Callable[[], float]]:
    """Gives a function that tells how far memory rose inside the ``with``, in MB."""
    before = peak = anonymous_memory()
    done = threading.Event()

    def watch() -> None:
        nonlocal peak
        while not done.wait(0.005):
            peak = max(peak, anonymous_memory())

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield lambda: peak - before
    finally:
        done.set()
        thread.join()


def noisy_waves(n_rows: int, n_columns: int, rng: np.random.RandomState) -> Iterator[tuple[np.ndarray, ...]]:
    """Endless pieces (X, y, y without noise) of a smooth function of columns in [-2, 2], with noise of std 0.1."""
    directions = rng.randn(n_columns, 3) / np.sqrt(n_columns)
    while True:
        X = rng.uniform(-2.0, 2.0, (n_rows, n_columns))
        truth = np.sin(X @ directions).sum(axis=1)
        yield X, truth + 0.1 * rng.randn(n_rows), truth
