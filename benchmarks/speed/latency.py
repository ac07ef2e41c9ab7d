"""What a control loop waits for: one row, and a horizon of 50, mean, std and Jacobian, beside other libraries.

100 inducing points, 6 columns, 4 outputs that share them (skevgp also in groups of one, and the cartpole with its
features); one thread; medians. GPflow's posterior is cached and compiled; scikit-learn's and GPyTorch's are exact
models of 100 rows, GPyTorch's of one output. Rounds of all libraries follow each other, and a row of the CSV is one
call in one round.

    python benchmarks/speed/latency.py                            # skevgp and scikit-learn: a minute
    python benchmarks/speed/latency.py --peer-python ../peers/bin/python  # GPflow and GPyTorch as well, if it has them
    python benchmarks/speed/latency.py --quick                    # few inducing points, seconds
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np

import harness
from harness import Row

OWN, PEERS = ("skevgp", "scikit-learn"), ("GPflow", "GPyTorch")
JOB = Path(__file__).with_name("latency_job.py")
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
ONE_THREAD |= {f"TF_NUM_{name}_THREADS": "1" for name in ("INTEROP", "INTRAOP")}


@dataclass(frozen=True)
class Cell:
    """A library in a round."""

    library: str
    round: int
    size: str
    python: str = field(compare=False)


def run(cell: Cell) -> list[dict[str, Any]]:
    """One row per call."""
    quick = cell.size == "quick"
    job = {"library": cell.library, "n_inducing": 10 if quick else 100, "seconds": 0.0 if quick else 0.5}
    ended = subprocess.run(
        [cell.python, str(JOB), json.dumps(job)],
        env={**os.environ, **ONE_THREAD},
        capture_output=True,
        text=True,
        check=False,
    )
    if ended.returncode:
        raise RuntimeError(ended.stderr.strip().splitlines()[-1] if ended.stderr.strip() else "it said nothing")
    found = json.loads(ended.stdout.splitlines()[-1])
    same = {"library": cell.library, "round": cell.round, "size": cell.size}
    return [{**same, "call": name, "microseconds": value, **harness.provenance()} for name, value in found.items()]


def say(rows: list[dict[str, Any]]) -> str:
    return ", ".join(f"{row['call']} {row['microseconds']:.0f} µs" for row in rows[:3])


def paragraphs(rows: Sequence[Row]) -> list[str]:
    """The page."""
    calls = list(dict.fromkeys((row["library"], row["call"]) for row in rows))
    lines = []
    for library, call in calls:
        each = [float(row["microseconds"]) for row in rows if (row["library"], row["call"]) == (library, call)]
        lines.append([library, call, f"{np.median(each):.0f}", f"{min(each):.0f}", str(len(each))])
    return [
        "# What a control loop waits for",
        "Microseconds, medians of half a second each; of several rounds the median and the least.",
        harness.table(["library", "call", "median", "least round", "rounds"], lines),
        harness.provenance_text(rows),
    ]


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="few inducing points, seconds", in_processes=False)
    parser.add_argument("--peer-python", default=None, help="a Python that has GPflow and GPyTorch; default: none")
    parser.add_argument("--rounds", type=harness.positive, default=3, help="default: %(default)s")
    options = parser.parse_args()
    output = harness.output_path(options, "latency")
    pythons = dict.fromkeys(OWN, sys.executable)
    pythons |= {} if options.peer_python is None else dict.fromkeys(PEERS, options.peer_python)
    size, rounds = ("quick", 1) if options.quick else ("full", options.rounds)
    cells = [Cell(library, turn, size, python) for turn in range(rounds) for library, python in pythons.items()]
    n_failures = harness.run_missing(cells, run, output, 1, say, fresh=True)
    rows = [row for row in harness.read(output) if row["size"] == size]
    harness.write_report(paragraphs(rows) if rows else [], output, n_failures)


if __name__ == "__main__":
    main()
