"""Is this checkout faster or more accurate than another one, for example of an older commit? The same fits, in pairs.

Each fit has a process of its own, with this checkout on its PYTHONPATH or the other one, in turns. Writes a row per run
to a CSV, anew each time, and prints a line per job: medians of the times, the median over pairs of their ratio (below 1
where this checkout is faster), and means over runs of the rest.

    python benchmarks/speed/against_checkout.py ../older                             # four data sets of each: an hour
    python benchmarks/speed/against_checkout.py ../older --systems pendulum cost --repeats 5
    python benchmarks/speed/against_checkout.py ../older --seeds 1 --max-iter acrobot=100 iiwa14=10
    python benchmarks/speed/against_checkout.py ../older --quick                     # few rows and iterations, seconds

Jobs: EVGPRegressor(InertiaForceGravity(system)) with its defaults and the paper's number of inducing points, on iiwa14
with 30 iterations and two threads; "cost", the seconds of an iteration of 20 on random rows of 8 columns; and "import",
"row" and "compiled row", the seconds of an import and the median of 2,000 predictions of one row with its std.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np

import harness
from harness import Row, figure_of
from paper.models import MODELS
from paper.models import SYSTEMS as PAPER_SYSTEMS

CALLS = ("import", "row", "compiled row")
SYSTEMS = (*PAPER_SYSTEMS, "cost", *CALLS)
COSTS, QUICK_COSTS, COST_ITERATIONS = ((4800, 100), (9300, 150)), ((1000, 20),), 20
MAX_ITER = {"iiwa14": 30}
N_JOBS = {"iiwa14": 2}
QUICK_TRAJECTORIES, QUICK_ITERATIONS = 3, 5
# What is measured, and how it is written.
MEASURES = {
    "seconds": figure_of,
    "cpu_seconds": figure_of,
    "n_iter": "{:g}".format,
    "bound": "{:.1f}".format,
    "error": figure_of,
    "nlpd": "{:.3f}".format,
}
COLUMNS = ("job", "checkout", "commit", "seed", "repeat", *MEASURES, "date", "versions", "machine")
CHECKOUTS = ("this", "other")

Job = dict[str, Any]


def checkout(text: str) -> Path:
    """Of an option."""
    path = Path(text).resolve()
    if not (path / "skevgp" / "__init__.py").is_file():
        raise argparse.ArgumentTypeError(f"{text!r} must be a folder that has skevgp/__init__.py")
    return path


def limit(text: str) -> tuple[str, int]:
    """Of an option."""
    system, _, number = text.partition("=")
    if system not in PAPER_SYSTEMS or not number.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} must be SYSTEM=N, with a system of {', '.join(PAPER_SYSTEMS)}")
    return system, int(number)


def jobs(systems: list[str], max_iter: dict[str, int], quick: bool) -> dict[str, Job]:
    """By name, what checkout_job.py is given; what is not there is skevgp's default."""
    found: dict[str, Job] = {}
    for system in dict.fromkeys(systems):
        if system == "cost":
            for n, m in QUICK_COSTS if quick else COSTS:
                found[f"cost, N={n}, m={m}"] = {"n_rows": n, "n_inducing": m, "max_iter": COST_ITERATIONS}
            continue
        if system in CALLS:
            found[system] = {"what": system}
            continue
        job: Job = {"system": system, "n_inducing": MODELS["EVGP-IFG"].sizes[PAPER_SYSTEMS.index(system)]}
        if quick:
            job |= {"n_trajectories": QUICK_TRAJECTORIES, "max_iter": QUICK_ITERATIONS}
        if system in max_iter:
            job["max_iter"] = max_iter[system]
        if system in N_JOBS:
            job["n_jobs"] = N_JOBS[system]
        found[system] = job
    return found


def run(job: Job, folder: Path) -> dict[str, Any]:
    """A job in a fresh process, with the skevgp of a checkout.

    Raises
    ------
    RuntimeError
        If it failed, with the last line of what it said, or took another skevgp.
    """
    path = os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, str(Path(__file__).with_name("checkout_job.py")), json.dumps(job)]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError((done.stderr.strip().splitlines() or ["no message"])[-1])
    result = json.loads(done.stdout.splitlines()[-1])
    if folder not in (package := Path(result.pop("package")).resolve()).parents:
        raise RuntimeError(f"it imported {package}")
    return result


def commit_of(folder: Path) -> str:
    """Its name, with "-dirty" if files differ from it; nothing where git does not know."""
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def pairs(rows: list[Row]) -> Iterator[tuple[str, list[tuple[Row, Row]]]]:
    """Of each job the runs of this checkout with those of the other of the same seed and repeat, if both succeeded."""
    for job in dict.fromkeys(row["job"] for row in rows):
        this, other = (
            {(row["seed"], row["repeat"]): row for row in rows if (row["job"], row["checkout"]) == (job, name)}
            for name in CHECKOUTS
        )
        if common := [key for key in this if key in other]:
            yield job, [(this[key], other[key]) for key in common]


def comparison(rows: list[Row]) -> str:
    """A line per job."""
    lines = []
    for job, found in pairs(rows):
        values = {
            name: [harness.column(own, name) for own in zip(*found, strict=True)]
            for name in MEASURES
            if found[0][0][name]
        }
        ratios = (np.median(this / other) for this, other in (values["seconds"], values["cpu_seconds"]))
        cells = {
            name: " / ".join(MEASURES[name]((np.median if "seconds" in name else np.mean)(own)) for own in both)
            for name, both in values.items()
        }
        lines.append(
            [
                *(job, str(len(found)), cells["seconds"], *(f"{ratio:.3f}" for ratio in ratios)),
                *(cells.get(name, "") for name in ("n_iter", "bound", "error", "nlpd")),
            ]
        )
    header = ["this / other", "pairs", "seconds", "ratio", "of CPU time", "iterations", "bound", "Error", "NLPD"]
    return harness.table(header, lines)


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="3 trajectories, few rows and iterations, one seed",
        seeds="of data: 0, 1, ...; default: 4, of a quick run 1",
        systems=SYSTEMS,
        in_processes=False,
    )
    parser.add_argument("other", type=checkout, help="the folder of the other checkout; before the options")
    parser.add_argument("--repeats", type=harness.positive, default=1, help="pairs of each data set; default: 1")
    parser.add_argument(
        *("--max-iter", "-m"),
        nargs="+",
        type=limit,
        default=[],
        metavar="SYSTEM=N",
        help="the most iterations on a system; default: skevgp's, iiwa14=30",
    )
    options = parser.parse_args()
    output = harness.output_path(options, "against_checkout")
    n_seeds = (1 if options.quick else 4) if options.seeds is None else options.seeds
    limits = ({} if options.quick else MAX_ITER) | dict(options.max_iter)
    folders = dict(zip(CHECKOUTS, (Path(__file__).resolve().parents[2], options.other), strict=True))
    commits = {name: commit_of(folder) for name, folder in folders.items()}
    rows: list[Row] = []
    n_failures = 0
    for seed in range(n_seeds):
        for name, job in jobs(options.systems, limits, options.quick).items():
            for repeat in range(options.repeats):
                for which, folder in folders.items():
                    print(f"{name}, seed {seed}, {which}:", end=" ", flush=True)
                    try:
                        result = run({**job, "seed": seed}, folder)
                    except RuntimeError as problem:  # the others are not lost with this one
                        n_failures += 1
                        print(f"failed: {problem}", flush=True)
                        continue
                    known = {"job": name, "checkout": which, "commit": commits[which], "seed": seed, "repeat": repeat}
                    values = {**harness.provenance(), **known, **result}
                    rows.append({column: str(values.get(column, "")) for column in COLUMNS})
                    harness.write(rows, COLUMNS, output)
                    print(f"{result['seconds']:.3f} s", flush=True)
    print(f"\n{comparison(rows)}")
    if n_failures:
        raise SystemExit(f"{n_failures} runs failed.")


if __name__ == "__main__":
    main()
