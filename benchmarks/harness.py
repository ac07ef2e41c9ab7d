"""What the benchmarks share: options, cells that run in processes, a CSV that keeps what is finished, and a page.

A benchmark measures cells. Each finished cell is appended to the CSV, so a long run can be interrupted and continued.
Tables and pictures are made from the CSV. The page beside the CSV is text edited by hand; `write_page` replaces only
the tables below its ``<!-- table: NAME -->`` lines.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import io
import platform
import re
import signal
import threading
import time
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from datetime import UTC, date, datetime
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pandas as pd
import scipy
import sklearn

import skevgp
from skevgp import EVGPRegressor
from skevgp.solvers import LBFGS
from skevgp.solvers.base import Minimum

RESULTS = Path(__file__).parent / "results"
WIDTH = 8.0  # inches of a picture
# Okabe & Ito's colours, which colour-blind readers can tell apart, without black and yellow.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")

Row = dict[str, str]  # of a CSV


# --- options -------------------------------------------------------------------------------------------------------


def positive(text: str) -> int:
    """Parse a positive integer."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} must be a positive integer")
    return int(text)


def day(text: str) -> str:
    """Parse a day in the format of `provenance`."""
    try:
        return date.fromisoformat(text).isoformat()
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} must be a day like 2026-11-23") from None


def csv_path(text: str) -> Path:
    """Parse the name of a CSV. With another suffix the page or the picture would overwrite it."""
    if Path(text).suffix != ".csv":
        raise argparse.ArgumentTypeError(f"{text!r} must be a file that ends in .csv")
    return Path(text)


def argument_parser(
    description: str | None,
    *,
    quick: str,
    seeds: str | None = None,
    systems: Collection[str] = (),
    default_systems: Collection[str] = (),
    in_processes: bool = True,
) -> argparse.ArgumentParser:
    """Return a parser with the options that all benchmarks have.

    Parameters
    ----------
    description : str
        Docstring of the script.
    quick, seeds : str
        Help of --quick and --seeds. If ``seeds`` is None, there is no such option.
    systems, default_systems : collection of str
        Choices and default of --systems. If ``systems`` is empty, there is no such option.
    in_processes : bool, default=True
        Whether there is --jobs. A benchmark that measures wall time runs one cell at a time.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=quick)
    if seeds:
        parser.add_argument("--seeds", type=positive, help=seeds)
    if systems:
        default = list(default_systems or systems)
        said = f"default: {' '.join(default)}"
        parser.add_argument("--systems", nargs="+", choices=list(systems), default=default, help=said)
    if in_processes:
        said = "number of processes, each on one core; default: %(default)s"
        parser.add_argument("--jobs", type=positive, default=joblib.cpu_count(), help=said)
    parser.add_argument("--since", type=day, help="measure again what was measured before this day, 2026-11-23")
    parser.add_argument("--output", type=csv_path, help="the CSV; default: in benchmarks/results")
    return parser


def output_path(options: argparse.Namespace, name: str) -> Path:
    """Return ``--output``, or ``name``.csv in the folder of results, with "_quick" for a quick run."""
    path = options.output or RESULTS / f"{name}{'_quick' if options.quick else ''}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


# --- the CSV -------------------------------------------------------------------------------------------------------


def provenance() -> dict[str, str]:
    """Return columns that tell when, with what and where a row was measured."""
    try:
        machine = Path("/proc/cpuinfo").read_text().split("model name")[1].split("\n")[0].strip("\t :")
    except (OSError, IndexError):
        machine = platform.processor() or platform.machine()
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "versions": " ".join(f"{package.__name__} {package.__version__}" for package in (skevgp, np, scipy, sklearn)),
        "machine": machine,
    }


def whole_lines(path: Path) -> str:
    """Return the text of a CSV without an incomplete last line of an interrupted write."""
    text = path.read_bytes().decode() if path.exists() else ""
    return text[: text.rfind("\n") + 1]


def read(path: Path) -> list[Row]:
    """Return the rows as text."""
    return list(csv.DictReader(io.StringIO(whole_lines(path), newline="")))


def frame(path: Path, **where: Any) -> pd.DataFrame:
    """Return the rows with some values as a data frame; empty if there is no file."""
    text = whole_lines(path)
    rows = pd.read_csv(io.StringIO(text)) if text else pd.DataFrame(columns=list(where))
    return rows[np.logical_and.reduce([rows[name] == value for name, value in where.items()])] if where else rows


def append(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Add rows. A new file gets their keys as header. An interrupted call adds all of them or none."""
    old = whole_lines(path)
    columns = next(csv.reader([old.partition("\n")[0]])) if old else list(rows[0])
    if set(columns) != set(rows[0]):
        raise SystemExit(f"{path} has other columns, of another version: give another --output, or move it away.")
    new = io.StringIO(newline="")
    writer = csv.DictWriter(new, columns)
    if not old:
        writer.writeheader()
    writer.writerows(rows)
    with path.open("ab", buffering=0) as file:
        if file.tell() > len(old.encode()):
            file.truncate(len(old.encode()))
        file.write(new.getvalue().encode())


def write(rows: Iterable[Mapping[str, Any]], columns: Sequence[str], path: Path) -> None:
    """Write a whole CSV. An interrupted call leaves the old file."""
    new = path.with_suffix(".new")
    with new.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
    new.replace(path)


def make_way(cell: tuple[str, ...], names: Sequence[str], columns: Sequence[str], path: Path) -> None:
    """Remove the rows of a cell, and give the others the columns of new ones, with "nan" for unknown values."""
    rows = read(path)
    others = [row for row in rows if tuple(row[name] for name in names) != cell]
    if len(others) < len(rows) or (rows and set(columns) != rows[0].keys()):
        write(({name: row.get(name, "nan") for name in columns} for row in others), columns, path)


def key(cell: Any) -> tuple[str, ...]:
    """Return the fields by which cells are compared, as the CSV has them."""
    return tuple(str(getattr(cell, field.name)) for field in dataclasses.fields(cell) if field.compare)


def run_missing(
    cells: Sequence[Any],
    run: Callable[[Any], Any],
    output: Path,
    jobs: int = 1,
    fresh: bool = False,
    since: str | None = None,
    again: Callable[[Row], bool] | None = None,
) -> int:
    """Run the cells that have no row in the CSV, in processes, and write each result as it arrives.

    Parameters
    ----------
    cells : sequence of dataclass
        Fields that are compared are columns of the CSV.
    run : callable
        Function cell -> row, or a list of rows; at the top level of a module.
    output : Path
        The CSV.
    jobs : int, default=1
        Number of processes.
    fresh : bool, default=False
        Whether each cell has a process of its own, for measurements of memory.
    since : str, default=None
        Rows that were measured before this day are replaced.
    again : callable, default=None
        Function row -> whether the row is replaced.

    Returns
    -------
    n_failures : int
        Number of cells that raised an error.
    """
    pyplot()  # fail before the fits if matplotlib is missing
    cells = list(dict.fromkeys(cells))
    names = [field.name for field in dataclasses.fields(cells[0]) if field.compare] if cells else []
    rows = read(output)
    if rows and not set(names) <= rows[0].keys():
        raise SystemExit(f"{output} has no columns {sorted(set(names) - rows[0].keys())}: give another --output.")
    stay = (row for row in rows if not (since and row["date"] < since) and not (again and again(row)))
    done = {tuple(row[name] for name in names) for row in stay}
    missing = [cell for cell in cells if key(cell) not in done]
    print(f"{len(cells) - len(missing)} of {len(cells)} cells are in {output}", flush=True)
    if not missing:
        return 0
    start, n_failures = time.perf_counter(), 0
    # Not a fork, which could copy locks of threads. Ctrl-C ends the processes, as a fit would end only its iterations.
    context = get_context("forkserver" if fresh else "spawn")
    if fresh:
        context.set_forkserver_preload(["skevgp", "skevgp.datasets", "sklearn.gaussian_process", "pinocchio"])
    ignored = signal.signal, (signal.SIGINT, signal.SIG_DFL)
    with ProcessPoolExecutor(jobs, context, *ignored, max_tasks_per_child=1 if fresh else None) as pool:
        pending = {pool.submit(run, cell): cell for cell in missing}
        try:
            for count, future in enumerate(as_completed(pending), start=1):
                said = f"[{count}/{len(missing)}] {' '.join(key(pending[future]))}"
                try:
                    result = future.result()
                except Exception as problem:  # the other cells go on
                    n_failures += 1
                    said += f": failed: {type(problem).__name__}: {problem}"
                else:
                    new = result if isinstance(result, list) else [result]
                    if since or again:
                        make_way(key(pending[future]), names, list(new[0]), output)
                    append(new, output)
                print(f"{said}; {time.perf_counter() - start:.0f} s so far", flush=True)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in active_children():
                process.terminate()
            raise SystemExit(f"Interrupted. What is finished is in {output}; run again to go on.") from None
    return n_failures


# --- the page ------------------------------------------------------------------------------------------------------


def figure_of(value: Any) -> str:
    """Write a number with three digits; nothing for NaN, and text as it is."""
    if isinstance(value, str) or value is None:
        return value or ""
    if isinstance(value, (int, np.integer)):
        return str(value)
    return f"{value:#.3g}".rstrip(".") if np.isfinite(value) else ""


def table(data: pd.DataFrame) -> str:
    """Write a data frame in Markdown, without its index."""
    rows = [list(map(str, data.columns)), ["---"] * data.shape[1]]
    columns = [data.iloc[:, i].tolist() for i in range(data.shape[1])]
    rows += [[figure_of(cell) for cell in row] for row in zip(*columns, strict=True)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def filled(page: str, tables: Mapping[str, pd.DataFrame]) -> str:
    """Replace the tables below their lines ``<!-- table: NAME -->``."""
    for name, data in tables.items():
        pattern = rf"(<!-- table: {re.escape(name)} -->\n)(?:\n?(?:\|.*\n)+)?"
        page = re.sub(pattern, lambda found, data=data: f"{found[1]}\n{table(data)}", page)
    return page


def write_page(title: str, tables: Mapping[str, pd.DataFrame], output: Path, n_failures: int = 0) -> None:
    """Fill the tables of the page beside the CSV, or write a new page; exit with an error if cells failed."""
    page = output.with_suffix(".md")
    text = page.read_text() if page.exists() else f"# {title}\n"
    text += "".join(f"\n<!-- table: {name} -->\n" for name in tables if f"<!-- table: {name} -->" not in text)
    text = filled(text, tables)
    page.write_text(text)
    for name, data in tables.items():
        print(f"\n{name}\n{table(data)}", end="")
    print(f"\n{page}")
    if n_failures:
        raise SystemExit(f"{n_failures} cells failed; run again to try only these.")


def pyplot() -> Any:
    """Return matplotlib.pyplot, which draws into files in the style of all pictures."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    pyplot.style.use("skevgp.plotting.page")
    return pyplot


def logarithmic(axes: Any, which: str = "y") -> None:
    """Give an axis, "x" or "y", a logarithmic scale with plain numbers."""
    from matplotlib import ticker

    axes.set(**{f"{which}scale": "log"})
    axis = axes.xaxis if which == "x" else axes.yaxis
    low, high = np.log10(axis.get_view_interval())
    axis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5) if high - low < (2.0 if which == "x" else 3.0) else (1,)))
    if low > -5.0 and high < 6.5:
        axis.set_major_formatter(lambda value, _: f"{value:,g}")
    axis.set_minor_formatter(ticker.NullFormatter())


def legend(figure: Any, where: str = "upper", **options: Any) -> Any:
    """Add one legend for all panels above ("upper") or below ("lower") them."""
    pairs = (pair for axes in figure.axes for pair in zip(*axes.get_legend_handles_labels(), strict=True))
    handles = {label: handle for handle, label in pairs}
    return figure.legend(handles.values(), handles, loc=f"outside {where} center", **options)


def save_picture(figure: Any, path: Path) -> None:
    """Write a figure as a PNG of at most 256 colours, which halves its size, and close it."""
    from PIL import Image

    figure.set_dpi(pyplot().rcParams["savefig.dpi"])
    figure.canvas.draw()
    image = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    image.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    pyplot().close(figure)


# --- measuring -----------------------------------------------------------------------------------------------------


class Stopwatch(LBFGS):
    """A solver that evaluates the objective at the start only, and keeps the seconds of each evaluation."""

    repeats, clock = 5, staticmethod(time.process_time)

    def minimise(self, objective: Any, start: np.ndarray, *others: Any, **options: Any) -> Minimum:
        """Evaluate the objective a few times."""
        self.seconds_: list[list[float]] = getattr(self, "seconds_", [])
        loss, seconds = objective(start)[0], []
        for _ in range(self.repeats):
            begin = self.clock()
            objective(start)
            seconds.append(self.clock() - begin)
        self.seconds_.append(seconds)
        return Minimum(start, loss, [loss], converged=True)


def evaluation_seconds(X: np.ndarray, Y: np.ndarray, m: int, *, wall: bool = False, **options: Any) -> list[float]:
    """Return seconds of evaluations of the bound and its gradient in all parameters, on all rows."""
    solver = Stopwatch()
    if wall:
        solver.clock = time.perf_counter
    points = np.random.RandomState(1).randn(m, X.shape[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        EVGPRegressor(inducing_init=points, solver=solver, noise_cv=None, random_state=0, **options).fit(X, Y)
    return max(solver.seconds_, key=min)  # a fit begins on samples of the rows, which are faster


def anonymous_memory() -> float:
    """Return MB of this process, without mapped files where the system tells them apart."""
    try:
        return float(Path("/proc/self/status").read_text().split("RssAnon:")[1].split()[0]) / 1024
    except (OSError, IndexError):
        import resource  # not on Windows

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@contextmanager
def peak_memory() -> Iterator[Callable[[], float]]:
    """Give a function that tells how far memory rose inside the ``with``, in MB."""
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
    """Yield pieces (X, y, y without noise) of a smooth function of columns in [-2, 2], with noise of std 0.1."""
    directions = rng.randn(n_columns, 3) / np.sqrt(n_columns)
    while True:
        X = rng.uniform(-2.0, 2.0, (n_rows, n_columns))
        truth = np.sin(X @ directions).sum(axis=1)
        yield X, truth + 0.1 * rng.randn(n_rows), truth
