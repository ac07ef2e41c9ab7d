"""What the weights of the physics features have learned: the paper's Figure 7, of the acrobot's b.

Fits EVGP-IF and EVGP-IFG and writes one row per weight to a CSV: prior and posterior, beside what least squares says of
the same weight. From the CSV come a Markdown page, which looks for the paper's observation (without features of gravity
the weights of positions on velocities turn negative to imitate it), and a picture for each system.

    python benchmarks/paper/beta.py                                     # the acrobot, four seeds: hours of one core
    python benchmarks/paper/beta.py --quick                             # few rows and iterations: a minute
    python benchmarks/paper/beta.py --systems pendulum cartpole iiwa14  # into the same file
    python benchmarks/paper/beta.py --settings paper --max-iter 2000    # Adam's steps in place of 16000

Settings as in results_table.py: "paper" (Adam, diagonal posterior, inducing points per output), "author" and
"author-100" (from where the author's library starts) and "skevgp" (its defaults). A fit of the acrobot takes 2 to 6
minutes of one core in settings of Adam, half a minute in skevgp's.
"""

from __future__ import annotations

import itertools
import sys
import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from threadpoolctl import threadpool_limits

import harness
from paper import beta_report
from paper.models import QUICK_TRAJECTORIES, SYSTEMS, Fit, build
from skevgp.datasets import make_dynamics

SETTINGS = ("paper", "author", "author-100", "skevgp")
MODELS = ("EVGP-IF", "EVGP-IFG")


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes
    ----------
    system, model, setting : str
    seed : int
        Of data and fit.
    size : {"full", "quick"}
    max_iter : int or None
    """

    system: str
    model: str
    setting: str
    seed: int
    size: str
    max_iter: int | None = field(compare=False)


def least_squares(H: np.ndarray, Y: np.ndarray) -> np.ndarray:
    """The weights (o, p) of features H (n, p) that come closest to Y (n, o)."""
    return np.linalg.lstsq(H, Y)[0].T


def run(cell: Cell) -> list[dict[str, Any]]:
    """Fit, and read off the weights."""
    n_trajectories = QUICK_TRAJECTORIES if cell.size == "quick" else None
    train = make_dynamics(cell.system, n_trajectories, random_state=cell.seed)
    regressor = build(Fit(cell.system, cell.model, cell.setting, cell.seed, cell.size, cell.max_iter))
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        start = time.process_time()
        regressor.fit(train.data, train.target, groups=train.groups)
        seconds = time.process_time() - start
        mean = regressor.predict(train.data)
    H = regressor.feature_map_.transform(train.data)
    tables = {
        "prior_mean": regressor.coef_prior_mean_,
        "prior_std": regressor.coef_prior_scale_,
        "mean": regressor.coef_,
        "std": regressor.coef_std_,
        "least_squares": least_squares(H, train.target),
        "least_squares_of_gp": least_squares(H, mean - H @ regressor.coef_.T),
    }
    return [
        {
            **{name: getattr(cell, name) for name in ("system", "model", "setting", "seed", "size")},
            "output": output,
            "feature": feature,
            **{name: values[o, j] for name, values in tables.items()},
            "max_iter": "" if regressor.max_iter is None else regressor.max_iter,
            "n_iter": regressor.n_iter_,
            "fit_seconds": seconds,
            **harness.provenance(),
        }
        for o, output in enumerate(train.target_names)
        for j, feature in enumerate(regressor.feature_map_.get_feature_names_out())
    ]


def say(rows: list[dict[str, Any]]) -> str:
    return f"{len(rows)} weights, {rows[0]['n_iter']} iterations, {rows[0]['fit_seconds']:.1f} s"


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="12 trajectories, few iterations and one seed",
        seeds="seeds 0, 1, ...; default: 4, of a quick run 1",
        systems=SYSTEMS,
        default_systems=["acrobot"],
    )
    parser.add_argument("--models", nargs="+", choices=MODELS, default=MODELS, help="default: both")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=SETTINGS, help="default: all")
    parser.add_argument(
        "--max-iter", type=int, help="the most iterations of each fit; what is in the CSV stays (default: regressor's)"
    )
    options = parser.parse_args()
    size = "quick" if options.quick else "full"
    output = harness.output_path(options, "beta")
    n_seeds = (1 if options.quick else 4) if options.seeds is None else options.seeds
    cells = [
        Cell(system, model, setting, seed, size, options.max_iter)
        for system, seed, setting, model in itertools.product(
            options.systems, range(n_seeds), options.settings, options.models
        )
    ]
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since)

    rows = [row for row in harness.read(output) if row["size"] == size]
    for system in dict.fromkeys(row["system"] for row in rows):
        own = [row for row in rows if row["system"] == system]
        beta_report.plot(own, beta_report.picture_of(output, system))
    harness.write_report(beta_report.paragraphs(rows, output) if rows else [], output, n_failures)


if __name__ == "__main__":
    main()
