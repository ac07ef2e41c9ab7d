"""The results of the paper's Table 4: every system and model in its setting and in skevgp's, beside its numbers.

Writes one row per fit to a CSV as soon as it is done (what is there already is not fitted again), and from the CSV a
Markdown table and a picture beside it. Models of seed s learn from data of random state s and are tested on 1000 + s.

    python benchmarks/paper/results_table.py               # everything, four seeds: days of one core
    python benchmarks/paper/results_table.py --quick       # fewer rows and iterations, one seed: a few minutes
    python benchmarks/paper/results_table.py --systems iiwa14 --settings paper --max-iter 1000  # half an hour per fit
    python benchmarks/paper/results_table.py --systems pendulum --settings skevgp --seeds 10
    python benchmarks/paper/results_table.py --noise 0.01  # on training and test targets; in another file
    python benchmarks/paper/results_table.py --angles wrapped --systems pendulum cartpole acrobot --settings paper

Of the cartpole there are two: with damping of both joints, which Drake's had in Python when the paper was written, and
without. Angles are as they come, or wrapped: in [-pi, pi) in the data, the target of a row moved with them.

Settings: "paper" (Adam, diagonal posterior, inducing points per output), "author" and "author-100" (the same from
where the author's library starts, with its solver and a prior scale of 1 or 100), "skevgp" (its defaults),
"skevgp-angles" (the kernel sees sines and cosines of angles) and, for iiwa14's EVGP, "skevgp-nominal" (a model of the
arm whose masses, centres of mass and inertias are wrong by up to 20 % as further features). RES-DBNN has a standard
normal prior on its weights in the paper's setting, and one that shrinks with the width of a layer in the others.

In the settings of Adam a fit of a GP takes up to 5 minutes of one core for the pendulum and the cartpole, 2 to 16 for
the acrobot, and 2 (EVGP) to 3 hours (VGP) for iiwa14; in the others seconds to minutes, and for iiwa14 up to an hour.
A network takes seconds, for iiwa14 minutes.
"""

from __future__ import annotations

import itertools
import sys
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
from sklearn.utils import Bunch

import harness
from paper import results_table_plots, results_table_report
from paper.models import MODELS, QUICK_TRAJECTORIES, SETTINGS, SYSTEMS, Fit, fitted_row, has
from skevgp.datasets import make_dynamics

ANGLES = ("raw", "wrapped")


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes
    ----------
    system, model, setting : str
    seed : int
    angles : {"raw", "wrapped"}
        As they come, or in [-pi, pi).
    noise : float
        Of both data sets, as a share of each training target's standard deviation.
    size : {"full", "quick"}
    max_iter : int or None
        Of an EVGP.
    """

    system: str
    model: str
    setting: str
    seed: int
    angles: str
    noise: float
    size: str
    max_iter: int | None = field(compare=False)


@lru_cache(maxsize=1)
def data(system: str, seed: int, noise: float, size: str, angles: str = "raw") -> tuple[Bunch, Bunch]:
    """A training and a test set, measured with the same noise; the models that learn from it come one after another."""
    n_trajectories = QUICK_TRAJECTORIES if size == "quick" else None
    wrap = angles == "wrapped"
    train = make_dynamics(system, n_trajectories, noise=noise, wrap_angles=wrap, random_state=seed)
    test = make_dynamics(system, n_trajectories, wrap_angles=wrap, random_state=1000 + seed)
    states = train.trajectories[:, 1:].reshape(train.target.shape)
    test.target += noise * states.std(axis=0) * np.random.RandomState(2000 + seed).standard_normal(test.target.shape)
    return train, test


def run(cell: Cell) -> dict[str, Any]:
    """Fit one model on one training set, and look at it on one test set."""
    train, test = data(cell.system, cell.seed, cell.noise, cell.size, cell.angles)
    fit = Fit(cell.system, cell.model, cell.setting, cell.seed, cell.size, cell.max_iter)
    return fitted_row(fit, train, test, angles=cell.angles, noise=cell.noise)


def say(row: dict[str, Any]) -> str:
    paper = results_table_report.PAPER[row["system"]][row["model"]].error
    return f"Error {row['error_mean']:.6f} (paper {paper:g}), {row['fit_seconds']:.1f} s"


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="12 trajectories, few iterations and one seed",
        seeds="seeds 0, 1, ...; default: 4, of a quick run 1",
        systems=SYSTEMS,
    )
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS), help="default: all")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=SETTINGS, help="default: all")
    parser.add_argument("--angles", nargs="+", choices=ANGLES, default=["raw"], help="default: raw")
    parser.add_argument("--noise", type=float, default=0.0, help="as a share of each training target's std; default: 0")
    parser.add_argument(
        "--max-iter",
        type=int,
        help="the most iterations of each fit of an EVGP, which the tables then tell; what is in the CSV stays "
        "(default: the regressor's)",
    )
    parser.add_argument("--limited", action="store_true", help="fit again what a limit of iterations ended")
    options = parser.parse_args()
    size, noise = "quick" if options.quick else "full", options.noise
    output = harness.output_path(options, f"results_table{f'_noise{noise:g}' if noise else ''}")
    n_seeds = (1 if options.quick else 4) if options.seeds is None else options.seeds
    cells = [
        Cell(system, model, setting, seed, angles, noise, size, options.max_iter)
        for system, seed, angles, model, setting in itertools.product(
            options.systems, range(n_seeds), options.angles, options.models, options.settings
        )
        if has(system, model, setting, angles)
    ]
    again = results_table_report.limited if options.limited else None
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since, again=again)

    # Everything the file has of this size and noise, not only what was asked for now.
    rows = [row for row in harness.read(output) if (row["size"], row["noise"]) == (size, str(noise))]
    if rows:
        results_table_plots.plot(rows, output.with_suffix(".png"))
    harness.write_report(results_table_report.paragraphs(rows) if rows else [], output, n_failures)


if __name__ == "__main__":
    main()
