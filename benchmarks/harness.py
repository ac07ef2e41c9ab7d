"""Shared parts of the benchmarks: options, cells that run in processes, a CSV of finished cells, and a page.

A benchmark measures cells. Each finished cell is added to the CSV, so a long run can be interrupted and continued. A
deleted row is measured again. Tables and pictures are made from the CSV. The text of the page next to it is edited by
hand. `write_page` replaces only the tables below its ``<!-- table: NAME -->`` lines.
"""

from __future__ import annotations

import argparse
import platform
import re
import signal
import threading
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pandas as pd
import scipy
import sklearn
from threadpoolctl import threadpool_limits

import skevgp
from skevgp import EVGPRegressor
from skevgp.solvers import LBFGS
from skevgp.solvers.base import Minimum

RESULTS = Path(__file__).parent / "results"
WIDTH = 8.0  # inches of a picture
# Okabe & Ito's colours, which colour-blind readers can tell apart, without black and yellow.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")

Tables = dict[str, pd.DataFrame]  # of a page, by name


# --- options -------------------------------------------------------------------------------------------------------


def argument_parser(
    description: str | None,
    *,
    quick: str,
    seeds: int = 0,
    systems: Collection[str] = (),
    default_systems: Collection[str] = (),
    in_processes: bool = True,
) -> argparse.ArgumentParser:
    """Return a parser with the options that benchmarks have, for `parse`.

    ``seeds`` is the default of --seeds, of which a quick run has one. Without ``seeds`` or ``systems`` there is no such
    option. A benchmark of wall time is not ``in_processes``: it runs one cell at a time.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=quick)
    if seeds:
        parser.add_argument("--seeds", type=int, help=f"number of seeds; default: {seeds}, quick 1")
        parser.set_defaults(n_seeds=seeds)
    if systems:
        default = list(default_systems or systems)
        said = f"default: {' '.join(default)}"
        parser.add_argument("--systems", nargs="+", choices=list(systems), default=default, help=said)
    if in_processes:
        said = "number of processes, each on one core; default: %(default)s"
        parser.add_argument("--jobs", type=int, default=joblib.cpu_count(), help=said)
    parser.add_argument("--output", type=Path, help="the CSV; default: in benchmarks/results")
    return parser


def parse(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Return the options, with ``size`` ("quick" or "full") and a range of ``seeds``."""
    options = parser.parse_args()
    options.size = "quick" if options.quick else "full"
    if "seeds" in options:
        options.seeds = range(options.seeds or (1 if options.quick else options.n_seeds))
    if options.output and options.output.suffix != ".csv":  # or the page would overwrite it
        parser.error("--output must end in .csv")
    return options


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


def frame(path: Path, **where: Any) -> pd.DataFrame:
    """Return the rows with some values; empty if there is no file."""
    rows = pd.read_csv(path) if path.exists() else pd.DataFrame(columns=list(where))
    for name, value in where.items():
        rows = rows[rows[name] == value]
    return rows


def finished(path: Path, names: Sequence[str]) -> set[tuple[str, ...]]:
    """Return what the rows have in some columns, as text."""
    if not path.exists():
        return set()
    rows = pd.read_csv(path, dtype=str, keep_default_na=False)
    if not set(names) <= set(rows):
        raise SystemExit(f"{path} has no columns {sorted(set(names) - set(rows))}: give another --output.")
    return set(rows[list(names)].itertuples(index=False, name=None))


def append(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Add rows. A new file gets their keys as header. An interrupted call adds all of them or none."""
    old, new = path.read_text() if path.exists() else "", pd.DataFrame(rows)
    columns = old.partition("\n")[0].split(",") if old else list(new)
    if set(columns) | {"date"} != set(new) | {"date"}:  # which some files do not have
        raise SystemExit(f"{path} has other columns, of another version: give another --output, or move it away.")
    whole = path.with_suffix(".new")
    whole.write_text(old + new[columns].to_csv(index=False, header=not old, na_rep="nan"))
    whole.replace(path)


def run_missing(
    cells: Sequence[Any], run: Callable[[Any], Any], output: Path, jobs: int = 1, fresh: bool = False
) -> int:
    """Run the cells that have no row in the CSV, and write each result as it arrives; return the number of failures.

    ``cells`` are named tuples, whose fields are columns of the CSV. ``run``, a function at the top level of a module,
    returns the other columns of a cell's row, or a list of them for several rows. Cells run in so many processes; a
    ``fresh`` one for each cell is for measurements of memory.
    """
    pyplot()  # fail before the fits if matplotlib is missing
    cells = list(dict.fromkeys(cells))
    done = finished(output, cells[0]._fields) if cells else set()
    missing = [cell for cell in cells if tuple(map(str, cell)) not in done]
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
                cell = pending[future]
                said = f"[{count}/{len(missing)}] {' '.join(map(str, cell))}"
                try:
                    result = future.result()
                except Exception as problem:  # the other cells go on
                    n_failures += 1
                    said += f": failed: {type(problem).__name__}: {problem}"
                else:
                    found = result if isinstance(result, list) else [result]
                    append([{**cell._asdict(), **row, **provenance()} for row in found], output)
                print(f"{said}; {time.perf_counter() - start:.0f} s so far", flush=True)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
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


def text(values: pd.Series, digits: int) -> pd.Series:
    """Write numbers with so many decimals; nothing for NaN."""
    return values.map(f"{{:.{digits}f}}".format).where(values.notna(), "")


def best(values: pd.Series) -> pd.Series:
    """Write numbers, the least of them in bold."""
    return values.map(figure_of).where(values != values.min(), values.map(lambda value: f"**{figure_of(value)}**"))


def ordered(names: Collection[str], found: Collection[Any]) -> list[str]:
    """Return the names that are found, in their own order."""
    there = set(found)
    return [name for name in names if name in there]


def table(data: pd.DataFrame) -> str:
    """Write a data frame in Markdown, without its index."""
    columns = [data.iloc[:, i].tolist() for i in range(data.shape[1])]  # each of its own type
    rows = [data.columns, ["---"] * data.shape[1], *(map(figure_of, row) for row in zip(*columns, strict=True))]
    return "".join(f"| {' | '.join(map(str, row))} |\n" for row in rows)


def filled(page: str, tables: Tables) -> str:
    """Replace the tables below their lines ``<!-- table: NAME -->``."""
    for name, data in tables.items():
        pattern = rf"(<!-- table: {re.escape(name)} -->\n)(?:\n?(?:\|.*\n)+)?"
        page = re.sub(pattern, lambda found, data=data: f"{found[1]}\n{table(data)}", page)
    return page


def write_page(title: str, tables: Tables, output: Path, n_failures: int = 0) -> None:
    """Fill the tables of the page beside the CSV, or write a new page; exit with an error if cells failed."""
    page = output.with_suffix(".md")
    text = page.read_text() if page.exists() else f"# {title}\n"
    text += "".join(f"\n<!-- table: {name} -->\n" for name in tables if f"<!-- table: {name} -->" not in text)
    page.write_text(filled(text, tables))
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
    axis.set_major_formatter(lambda value, _: f"{value:,g}" if value < 1e7 else f"{value:g}")
    axis.set_minor_formatter(ticker.NullFormatter())


def legend(figure: Any, **options: Any) -> None:
    """Add one legend for all panels above them."""
    pairs = (pair for axes in figure.axes for pair in zip(*axes.get_legend_handles_labels(), strict=True))
    handles = {label: handle for handle, label in pairs}
    figure.legend(handles.values(), handles, loc="outside upper center", **options)


def save_picture(figure: Any, path: Path) -> None:
    """Write a figure as a PNG of at most 128 colours, which halves its size, and close it."""
    from PIL import Image

    figure.set_dpi(pyplot().rcParams["savefig.dpi"])
    figure.canvas.draw()
    image = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    image.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)
    pyplot().close(figure)


# --- measuring -----------------------------------------------------------------------------------------------------


@contextmanager
def one_thread() -> Iterator[None]:
    """Give linear algebra one thread, and ignore warnings."""
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def timed(call: Callable[[], object]) -> tuple[float, list[warnings.WarningMessage]]:
    """Return processor seconds of a call on one thread, and its warnings."""
    with threadpool_limits(1), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        start = time.process_time()
        call()
        return time.process_time() - start, caught


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


def evaluation_seconds(
    X: np.ndarray, Y: np.ndarray, m: int, *, wall: bool = False, bound: str = "titsias", **options: Any
) -> list[float]:
    """Return seconds of evaluations of the bound and its gradient in all parameters, on all rows."""
    solver = Stopwatch(bound=bound)
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
