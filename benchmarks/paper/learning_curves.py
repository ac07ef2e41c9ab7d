"""The paper's Figure 6, learning curves: the Error on a fixed test set as trajectories are added to the training set.

Writes one row per fit to a CSV as soon as it is done (what is there already is not fitted again), and from the CSV a
page and a picture beside it. Run s learns from the first trajectories of the data of random state s, and more and more
of them; all runs of a system are tested on the data of random state 1000.

    python benchmarks/paper/learning_curves.py                       # everything, four runs: many hours of one core
    python benchmarks/paper/learning_curves.py --quick               # two sizes, few iterations, one run: a few minutes
    python benchmarks/paper/learning_curves.py --systems pendulum --settings paper skevgp-angles
    python benchmarks/paper/learning_curves.py --systems iiwa14 --max-iter 60  # of each GP, as the page then tells
    python benchmarks/paper/learning_curves.py --limited --max-iter 5000  # what a limit ended, to its end

The settings are those of results_table.py. Of "skevgp-nominal" there is EVGP-IFG on iiwa14.

In skevgp's settings a run takes 20 seconds of one core for the pendulum, 3 minutes for the cartpole, 12 for the acrobot
and 3 hours for iiwa14.
"""

from __future__ import annotations

import itertools
import sys
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

from sklearn.utils import Bunch

import harness
from paper import learning_curves_report
from paper.models import MODELS, QUICK_TRAJECTORIES, SETTINGS, SYSTEMS, Fit, fitted_row, has
from paper.results_table_report import limited
from skevgp.datasets import make_dynamics

# Numbers of trajectories, up to the paper's.
N_TRAJECTORIES = {
    "pendulum": (3, 6, 12, 24, 48),
    "cartpole": (3, 6, 12, 24, 48),
    "acrobot": (6, 12, 24, 48, 93),
    "iiwa14": (20, 60, 150, 465),
}
QUICK_N_TRAJECTORIES = (4, QUICK_TRAJECTORIES)
TEST_STATE = 1000


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes
    ----------
    system, model, setting : str
    n_trajectories : int
        To learn from.
    seed : int
        Of the training data and of the fit.
    size : {"full", "quick"}
    max_iter : int or None
        Of an EVGP.
    """

    system: str
    model: str
    setting: str
    n_trajectories: int
    seed: int
    size: str
    max_iter: int | None = field(compare=False)


@lru_cache(maxsize=2)
def data(system: str, random_state: int, size: str) -> Bunch:
    """Of one run with all its trajectories, or for the tests of all runs."""
    return make_dynamics(system, QUICK_TRAJECTORIES if size == "quick" else None, random_state=random_state)


def run(cell: Cell) -> dict[str, Any]:
    """Fit one model on the first trajectories of a run, and look at it on the test set."""
    whole, test = (data(cell.system, state, cell.size) for state in (cell.seed, TEST_STATE))
    rows = whole.groups < cell.n_trajectories
    train = Bunch(data=whole.data[rows], target=whole.target[rows], groups=whole.groups[rows])
    fit = Fit(cell.system, cell.model, cell.setting, cell.seed, cell.size, cell.max_iter)
    return fitted_row(fit, train, test, n_trajectories=cell.n_trajectories, n_rows=len(train.data))


def say(row: dict[str, Any]) -> str:
    return f"Error {row['error_mean']:.6f} from {row['n_rows']} rows, {row['fit_seconds']:.1f} s"


def wanted(system: str, model: str, setting: str) -> bool:
    """The nominal model is shown once, with the better prior."""
    return has(system, model, setting) and (setting != "skevgp-nominal" or model == "EVGP-IFG")


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="4 and 12 trajectories, few iterations and one run",
        seeds="runs: seeds 0, 1, ...; default: 4, of a quick run 1",
        systems=SYSTEMS,
    )
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS), help="default: all")
    parser.add_argument(
        "--settings",
        nargs="+",
        choices=SETTINGS,
        default=["skevgp", "skevgp-nominal"],
        help="default: skevgp and skevgp-nominal",
    )
    parser.add_argument(
        "--max-iter",
        type=int,
        help="the most iterations of each fit of an EVGP, which the page then tells; what is in the CSV stays "
        "(default: the regressor's)",
    )
    parser.add_argument("--limited", action="store_true", help="fit again what a limit of iterations ended")
    options = parser.parse_args()
    size = "quick" if options.quick else "full"
    output = harness.output_path(options, "learning_curves")
    n_seeds = (1 if options.quick else 4) if options.seeds is None else options.seeds
    cells = [
        Cell(system, model, setting, n_trajectories, seed, size, options.max_iter)
        for system in options.systems
        for seed, n_trajectories, model, setting in itertools.product(
            range(n_seeds),
            QUICK_N_TRAJECTORIES if options.quick else N_TRAJECTORIES[system],
            options.models,
            options.settings,
        )
        if wanted(system, model, setting)
    ]
    again = limited if options.limited else None
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since, again=again)

    # Everything the file has of this size, not only what was asked for now.
    rows = [row for row in harness.read(output) if row["size"] == size]
    if rows:
        learning_curves_report.plot(rows, output.with_suffix(".png"))
    harness.write_report(learning_curves_report.paragraphs(rows) if rows else [], output, n_failures)


if __name__ == "__main__":
    main()
