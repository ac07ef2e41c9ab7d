"""What the benchmarks share: their options, cells run in processes, and a CSV in which what is finished stays."""

from __future__ import annotations

import argparse
import csv
import dataclasses
import io
import platform
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from datetime import UTC, date, datetime
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import scipy
import sklearn

import skevgp

RESULTS = Path(__file__).parent / "results"
# Inches, of a picture in a column of a web page.
WIDTH = 8.0
# Okabe & Ito's colours, safe for colour-blind readers; without black and yellow.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")

Row = dict[str, str]  # of a CSV


def positive(text: str) -> int:
    """Of an option."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} must be a positive integer")
    return int(text)


def day(text: str) -> str:
    """Of an option, as `provenance` writes it."""
    try:
        return date.fromisoformat(text).isoformat()
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} must be a day like 2026-11-23") from None


def csv_path(text: str) -> Path:
    """Of an option; another suffix could be that of the page or the picture, which would overwrite the CSV."""
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
    default_systems : collection of str, default=()
        Empty: all.
    in_processes : bool, default=True
        Whether there is --jobs; a benchmark of the time on the wall runs one cell after the other.

    Returns
    -------
    parser : ArgumentParser
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=quick)
    if seeds:
        parser.add_argument("--seeds", type=positive, help=seeds)
    if systems:
        default = list(default_systems or systems)
        parser.add_argument(
            "--systems", nargs="+", choices=systems, default=default, help=f"default: {' '.join(default)}"
        )
    if in_processes:
        said = "processes, each on one core; default: %(default)s"
        parser.add_argument("--jobs", type=positive, default=joblib.cpu_count(), help=said)
        said = "a day, 2026-11-23: what was measured before is measured again; default: what is there stays"
        parser.add_argument("--since", type=day, help=said)
    parser.add_argument(
        "--output", type=csv_path, help="the CSV; what is drawn from it goes beside it; default: in benchmarks/results"
    )
    return parser


def output_path(options: argparse.Namespace, name: str) -> Path:
    """``--output``, or ``name``.csv in the folder of results, with "_quick" for a quick run."""
    path = options.output or RESULTS / f"{name}{'_quick' if options.quick else ''}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def processor() -> str:
    """Its name, where the system tells it."""
    try:
        return Path("/proc/cpuinfo").read_text().split("model name")[1].split("\n")[0].strip("\t :")
    except (OSError, IndexError):
        return platform.processor() or platform.machine()


def provenance() -> dict[str, str]:
    """Columns that say when, with what and where a row was measured."""
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "versions": " ".join(f"{package.__name__} {package.__version__}" for package in (skevgp, np, scipy, sklearn)),
        "machine": processor(),
    }


def provenance_text(rows: Iterable[Row]) -> str:
    """The same of many rows, as a sentence of a report."""
    columns = ({row[name] for row in rows} for name in ("date", "versions", "machine"))
    dates, versions, machines = (sorted(values) for values in columns)
    return f"{' to '.join(dict.fromkeys((dates[0], dates[-1])))}; {'; '.join(versions)}; {', '.join(machines)}."


def whole_lines(path: Path) -> str:
    """Of a CSV, without what an interrupted write may have left of a last one."""
    if not path.exists():
        return ""
    text = path.read_bytes().decode()
    return text[: text.rfind("\n") + 1]


def read(path: Path) -> list[Row]:
    """The rows that are there."""
    return list(csv.DictReader(io.StringIO(whole_lines(path), newline="")))


def append(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Add rows, below a header of their keys if the file is new; all of them or, interrupted, none.

    Raises
    ------
    SystemExit
        If the file has other columns.
    """
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


def write(rows: Iterable[dict[str, Any]], columns: Sequence[str], path: Path) -> None:
    """Write rows anew; interrupted, it leaves the file as it was."""
    new = path.with_suffix(".new")
    with new.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
    new.replace(path)


def make_way(cell: tuple[str, ...], names: Sequence[str], columns: Sequence[str], path: Path) -> None:
    """Take the rows of a cell out of a CSV, and give the others the columns of new ones."""
    rows = read(path)
    others = [row for row in rows if tuple(row[name] for name in names) != cell]
    if len(others) < len(rows) or (rows and set(columns) != rows[0].keys()):
        write(({name: row.get(name, "nan") for name in columns} for row in others), columns, path)


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
    since: str | None = None,
    again: Callable[[Row], bool] | None = None,
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
    since : str, default=None
        A day: rows that were measured before are as if they were not there, until a new one replaces them. (What they
        do not know, because the benchmark measured less then, is "nan".)
    again : callable, default=None
        row -> whether it, too, is as if it were not there.

    Returns
    -------
    n_failures : int
        Cells that raised; the others are in the CSV.

    Raises
    ------
    SystemExit
        If matplotlib is missing, or the CSV is of another benchmark or version.
    """
    try:
        pyplot()  # before the fits, not after them
    except ImportError as problem:
        raise SystemExit(f"No picture could be drawn ({problem}): pip install matplotlib") from problem
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
                    new = result if isinstance(result, list) else [result]
                    if since or again:
                        make_way(key(pending[future]), names, list(new[0]), output)
                    append(new, output)
                    said += say(result)
                print(f"{said}; {time.perf_counter() - start:.0f} s so far", flush=True)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in active_children():  # if it was for this process only: hours are not waited for
                process.terminate()
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
    """Write paragraphs, if any, to the Markdown beside the CSV and print them; say in the exit code if cells failed."""
    text = "\n\n".join(part.strip("\n") for part in parts) + "\n"
    if text.strip():
        output.with_suffix(".md").write_text(text)
        print(f"\n{text}\n{output.with_suffix('.md')}, and pictures beside it")
    else:
        print(f"{output} has nothing of what was asked for: no page is written.")
    if n_failures:
        raise SystemExit(f"{n_failures} cells failed; run again to try only these.")


def pyplot() -> Any:
    """matplotlib's, which draws into files, in the style of all pictures."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    pyplot.style.use("skevgp.plotting.page")
    return pyplot


def logarithmic(axes: Any, which: str = "y") -> None:
    """Give an axis, "x" or "y", a logarithmic scale, with plain numbers, for 1, 2 and 5 where there is room."""
    from matplotlib import ticker

    axes.set(**{f"{which}scale": "log"})
    axis = axes.xaxis if which == "x" else axes.yaxis
    low, high = np.log10(axis.get_view_interval())
    axis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5) if high - low < (2.0 if which == "x" else 3.0) else (1,)))
    if low > -5.0 and high < 6.5:
        axis.set_major_formatter(lambda value, _: f"{value:,g}")
    axis.set_minor_formatter(ticker.NullFormatter())


def legend(figure: Any, where: str = "upper", **options: Any) -> Any:
    """One for all panels, outside of them, above ("upper") or below ("lower"): each label once."""
    pairs = (pair for axes in figure.axes for pair in zip(*axes.get_legend_handles_labels(), strict=True))
    handles = {label: handle for handle, label in pairs}
    return figure.legend(handles.values(), handles, loc=f"outside {where} center", **options)


def save_picture(figure: Any, path: Path) -> None:
    """Write a figure as a PNG of at most 256 colours, half of the usual size, and close it."""
    from PIL import Image

    figure.set_dpi(pyplot().rcParams["savefig.dpi"])
    figure.canvas.draw()
    image = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    image.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    pyplot().close(figure)


def anonymous_memory() -> float:
    """Of this process, in MB; its mapped files, which are data, are not counted where the system tells them apart."""
    try:
        return float(Path("/proc/self/status").read_text().split("RssAnon:")[1].split()[0]) / 1024
    except (OSError, IndexError):
        import resource  # not on Windows

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
