"""Which outputs should share a kernel: the groups that sharing="auto" finds against all partitions there are.

Writes one row per fit to a CSV as soon as it is done (what is there already is not fitted again), and a table beside
it: per system and model the mean Error and time of "all", "none", "kernel", "auto" and the best partition. Models of
seed s learn from data of random state s and are tested on 1000 + s.

    python benchmarks/sharing.py                              # three systems, two models, four seeds: many hours
    python benchmarks/sharing.py --systems pendulum cartpole --seeds 1 --max-iter 100  # an hour of one core
    python benchmarks/sharing.py --systems iiwa14 --seeds 1 --max-iter 100    # "auto" beside "all": ten minutes
    python benchmarks/sharing.py --quick                      # fewer rows and iterations, one seed: minutes
"""

from __future__ import annotations

import itertools
import string
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))  # for what the scripts share

from sklearn.utils import Bunch

import harness
from harness import Row
from paper.models import QUICK_TRAJECTORIES, Fit, build, fitted_part, measures, timed
from skevgp.datasets import make_dynamics

N_OUTPUTS = {"pendulum": 2, "cartpole": 4, "acrobot": 4, "iiwa14": 14}
DIGITS = string.digits + string.ascii_lowercase
# Of more outputs there are too many partitions: "auto" beside "all" alone.
MOST_OUTPUTS = 4
MODELS = ("EVGP-IFG", "RES-VGP")
Partition = list[list[int]]


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes
    ----------
    system, model : str
    seed : int
    sharing : str
        "auto", "kernel", or a partition as of `name_of`.
    size : {"full", "quick"}
    max_iter : int or None
        None is the regressor's, or that of a quick run.
    """

    system: str
    model: str
    seed: int
    sharing: str
    size: str
    max_iter: int | None = field(compare=False)


def partitions(outputs: Sequence[int]) -> Iterator[Partition]:
    """All of some outputs, with their groups in order."""
    if not outputs:
        yield []
        return
    first, *others = outputs
    for rest in partitions(others):
        yield [[first], *rest]
        for i, group in enumerate(rest):
            yield sorted([[first, *group], *rest[:i], *rest[i + 1 :]])


def compared(system: str) -> list[str]:
    """The names of the partitions of a system's outputs that "auto" is compared with."""
    everything = list(range(N_OUTPUTS[system]))
    return [name_of([everything])] if len(everything) > MOST_OUTPUTS else list(map(name_of, partitions(everything)))


def name_of(partition: Partition) -> str:
    """As a word: 01|23; letters after 9."""
    return "|".join("".join(DIGITS[output] for output in group) for group in partition)


def groups_of(name: str) -> Partition:
    """The partition of such a word."""
    return [[int(output, 36) for output in group] for group in name.split("|")]


@lru_cache(maxsize=1)
def data(system: str, seed: int, size: str) -> tuple[Bunch, Bunch]:
    """A training and a test set."""
    n_trajectories = QUICK_TRAJECTORIES if size == "quick" else None
    train, test = (make_dynamics(system, n_trajectories, random_state=state) for state in (seed, 1000 + seed))
    return train, test


def run(cell: Cell) -> dict[str, Any]:
    """Fit one model, and look at it on one test set; ``fit_seconds`` is processor time of one thread."""
    train, test = data(cell.system, cell.seed, cell.size)
    regressor = build(Fit(cell.system, cell.model, "skevgp", cell.seed, cell.size, cell.max_iter))
    sharing = cell.sharing if cell.sharing in ("auto", "kernel") else groups_of(cell.sharing)
    regressor.set_params(**{"regressor__sharing" if cell.model == "RES-VGP" else "sharing": sharing})
    mean, std, seconds, _ = timed(regressor, train, test)
    fitted = fitted_part(regressor)
    return {
        **{name: getattr(cell, name) for name in ("system", "model", "seed", "sharing", "size")},
        "groups": name_of(fitted.sharing_),
        **measures(test.target, mean, std),
        "fit_seconds": seconds,
        "max_iter": "" if cell.max_iter is None else cell.max_iter,
        "n_iter": fitted.n_iter_,
        "bound_per_row": fitted.lower_bound_ / len(train.data),
        **harness.provenance(),
    }


def say(row: dict[str, Any]) -> str:
    return f"{row['groups']}, Error {row['error_mean']:.6f}, {row['fit_seconds']:.1f} s"


def line_of(system: str, model: str, rows: Sequence[Row]) -> list[str]:
    """Of a table: means over the seeds that all have; the best partition is that with the lowest mean Error."""
    everything, every = list(range(N_OUTPUTS[system])), compared(system)
    together, single = name_of([everything]), name_of([[output] for output in everything])
    seeds = set.intersection(*({row["seed"] for row in rows if row["sharing"] == name} for name in ("auto", *every)))
    if not seeds:
        return []
    common = [row for row in rows if row["seed"] in seeds]
    own = {name: [row for row in common if row["sharing"] == name] for name in ("auto", "kernel", *every)}
    error = {name: float(harness.column(of, "error_mean").mean()) for name, of in own.items() if of}
    seconds = {name: float(harness.column(of, "fit_seconds").mean()) for name, of in own.items() if of}
    best = min(every, key=error.__getitem__)
    found = Counter(row["groups"] for row in own["auto"])
    return [
        f"{system} {model}",
        str(len(seeds)),
        *(harness.figure_of(error[name]) if name in error else "" for name in (together, single, "kernel", "auto")),
        f"{harness.figure_of(error[best])} ({best.replace('|', ' ')})",
        f"{error['auto'] / error[best]:.2f}",
        f"{seconds['auto'] / seconds[together]:.2f}",
        ", ".join(f"{name.replace('|', ' ')} ({count})" for name, count in found.most_common()),
    ]


def paragraphs(rows: Sequence[Row]) -> list[str]:
    """The page: nothing if no system and model is complete."""
    lines = [
        line_of(system, model, own)
        for system, model in itertools.product(N_OUTPUTS, MODELS)
        if (own := [row for row in rows if (row["system"], row["model"]) == (system, model)])
    ]
    lines = [line for line in lines if line]
    if not lines:
        return []
    header = [
        "",
        "seeds",
        "all",
        "none",
        "kernel",
        "auto",
        "best partition",
        "auto / best",
        "time: auto / all",
        "found",
    ]
    iterations = ", ".join(sorted({row["max_iter"] or "default" for row in rows}))
    return [
        "# Which outputs share a kernel",
        "Errors, means over seeds; groups by the outputs' numbers, found ones with the number of seeds.",
        harness.table(header, lines),
        f"max_iter: {iterations}. {harness.provenance_text(rows)}",
    ]


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="12 trajectories, few iterations and one seed",
        seeds="seeds 0, 1, ...; default: 4, of a quick run 1",
        systems=N_OUTPUTS,
        default_systems=[system for system, n in N_OUTPUTS.items() if n <= MOST_OUTPUTS],
    )
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS), help="default: all")
    parser.add_argument("--max-iter", type=int, help="of each fit; what is in the CSV stays (default: the regressor's)")
    options = parser.parse_args()
    output, size = harness.output_path(options, "sharing"), "quick" if options.quick else "full"
    n_seeds = (1 if options.quick else 4) if options.seeds is None else options.seeds
    cells = [
        Cell(system, model, seed, sharing, size, options.max_iter)
        for system, seed, model in itertools.product(options.systems, range(n_seeds), options.models)
        for sharing in ("auto", "kernel", *compared(system))
        if sharing != "kernel" or N_OUTPUTS[system] <= MOST_OUTPUTS
    ]
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since)
    harness.write_report(paragraphs([row for row in harness.read(output) if row["size"] == size]), output, n_failures)


if __name__ == "__main__":
    main()
