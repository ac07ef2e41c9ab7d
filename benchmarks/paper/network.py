"""How long RES-DBNN must learn, and what holds its Error up: epochs and options, judged on trajectories held back.

A quarter of the training trajectories of results_table.py is held back; the network learns from the others and is
looked at on both. Writes one row per fit to a CSV as soon as it is done (what is there already is not fitted again),
and a page beside it. What has the lowest Error on what was held back (with as many units as the paper) is then fitted
to all training trajectories, as early stopping, that of results_table.py, is, and looked at on its test sets.

    python benchmarks/paper/network.py --systems cartpole cartpole_damped --seeds 4  # half an hour of one core
    python benchmarks/paper/network.py                             # the planar systems, two seeds: an hour
    python benchmarks/paper/network.py --systems iiwa14 --seeds 1  # an hour
    python benchmarks/paper/network.py --quick                     # one system, few epochs: half a minute
"""

from __future__ import annotations

import itertools
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.model_selection import GroupShuffleSplit
from sklearn.utils import Bunch
from threadpoolctl import threadpool_limits

import harness
from harness import Row, column, figure_of
from paper import results_table
from paper.models import QUICK_TRAJECTORIES, SYSTEMS, UNTIL_FLAT, Fit, build
from paper.results_table_report import PAPER
from skevgp import ResidualRegressor
from skevgp.datasets import make_dynamics
from skevgp.metrics import negative_log_predictive_density, prediction_error

WIDE, EARLY = "twice as wide", "early stopping"
HELD, TEST = "trajectories held back", "test set"
# What differs from the network of the setting "paper" or, without a prior of its own, "skevgp".
VARIANTS: dict[str, dict[str, Any]] = {
    "": {},
    "prior of 1": {"prior_scale": 1.0},
    "first step 0.003": {"learning_rate_init": 0.003},
    "batches of 50": {"batch_size": 50},
    WIDE: {},
    EARLY: UNTIL_FLAT,
}
# Each alone; the variants with the third.
N_EPOCHS = (100, 300, 1000, 3000)
VARIED = 1000
HELD_BACK = 0.25
# A number of epochs is enough if three times as many leave more than this of the Error held back.
ENOUGH = 0.95


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes
    ----------
    system, variant : str
    epochs, seed : int
    tested_on : {"trajectories held back", "test set"}
        Of the latter what is learned from are all training trajectories.
    size : {"full", "quick"}
    """

    system: str
    variant: str
    epochs: int
    seed: int
    tested_on: str
    size: str


@lru_cache(maxsize=1)
def data(system: str, seed: int, size: str, tested_on: str = HELD) -> tuple[Bunch, Bunch]:
    """Trajectories to learn from, and others: of the same training set, or a test set."""
    if tested_on == TEST:
        return results_table.data(system, seed, 0.0, size)
    whole = make_dynamics(system, QUICK_TRAJECTORIES if size == "quick" else None, random_state=seed)
    split = GroupShuffleSplit(1, test_size=HELD_BACK, random_state=seed)
    ((learned, held_back),) = split.split(whole.data, groups=whole.groups)
    return tuple(Bunch(data=whole.data[rows], target=whole.target[rows]) for rows in (learned, held_back))


def regressor_of(cell: Cell) -> ResidualRegressor:
    """The unfitted one."""
    regressor = build(Fit(cell.system, "RES-DBNN", "skevgp", cell.seed, "full", None))
    network = regressor.regressor.set_params(
        **{"early_stopping": False, "max_iter": cell.epochs, **VARIANTS[cell.variant]}
    )
    if cell.variant == WIDE:
        network.set_params(hidden_layer_sizes=tuple(2 * units for units in network.hidden_layer_sizes))
    return regressor


def run(cell: Cell) -> dict[str, Any]:
    """Fit one network, and look at it on what it learned from and on other trajectories."""
    learned, others = data(cell.system, cell.seed, cell.size, cell.tested_on)
    regressor = regressor_of(cell)
    with threadpool_limits(1), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ConvergenceWarning)
        start = time.process_time()
        regressor.fit(learned.data, learned.target)
        seconds = time.process_time() - start
    mean, std = regressor.predict(others.data, return_std=True)
    return {
        **{name: getattr(cell, name) for name in ("system", "variant", "epochs", "seed", "tested_on", "size")},
        "error_learned": prediction_error(learned.target, regressor.predict(learned.data)),
        "error_tested": prediction_error(others.target, mean),
        "nlpd_tested": negative_log_predictive_density(others.target, mean, std),
        "loss": regressor.regressor_.loss_curve_[-1],
        "n_iter": regressor.regressor_.n_iter_,
        "converged": not caught,
        "fit_seconds": seconds,
        **harness.provenance(),
    }


def say(row: dict[str, Any]) -> str:
    return (
        f"Error on the {row['tested_on']} {row['error_tested']:.5f}, learned {row['error_learned']:.5f}, "
        f"{row['fit_seconds']:.0f} s"
    )


def means(rows: Sequence[Row], name: str) -> dict[tuple[str, int], float]:
    """Of one system: over seeds, by variant and epochs."""
    keys = dict.fromkeys((row["variant"], int(row["epochs"])) for row in rows)
    return {
        key: float(column([row for row in rows if (row["variant"], int(row["epochs"])) == key], name).mean())
        for key in keys
    }


def enough(errors: dict[tuple[str, int], float]) -> int | None:
    """The fewest epochs after which no larger number leaves less than `ENOUGH` of the Error held back; None if no such.

    The largest number that was tried has no larger one to say so.
    """
    plain = sorted((epochs, error) for (variant, epochs), error in errors.items() if not variant)
    return next(
        (
            epochs
            for i, (epochs, error) in enumerate(plain[:-1])
            if all(later >= ENOUGH * error for _, later in plain[i:])
        ),
        None,
    )


def best(rows: Sequence[Row]) -> tuple[str, int]:
    """Of one system: variant and epochs of the lowest mean Error held back, with the paper's number of units."""
    errors = means([row for row in rows if row["tested_on"] == HELD], "error_tested")
    return min((key for key in errors if key[0] != WIDE), key=errors.__getitem__)


def compared(rows: Sequence[Row]) -> list[tuple[str, int]]:
    """Of one system: what is fitted to all trajectories, the best first, early stopping last; nothing without it."""
    early = [key for key in means(rows, "loss") if key[0] == EARLY]
    return list(dict.fromkeys([best(rows), *early])) if early else []


def lines_of(rows: Sequence[Row]) -> Iterator[list[str]]:
    """Of one system's table."""
    values = {
        name: means(rows, name)
        for name in ("error_tested", "error_learned", "nlpd_tested", "loss", "n_iter", "fit_seconds")
    }
    for variant, epochs in sorted(values["loss"], key=lambda key: (list(VARIANTS).index(key[0]), key[1])):
        own = {name: value[variant, epochs] for name, value in values.items()}
        warned = sum(
            row["converged"] == "False" for row in rows if (row["variant"], row["epochs"]) == (variant, str(epochs))
        )
        yield [
            variant or "standard",
            f"{values['n_iter'][variant, epochs]:.0f}",
            figure_of(own["error_tested"]),
            figure_of(own["error_learned"]),
            f"{own['nlpd_tested']:.2f}",
            f"{own['loss']:.2f}",
            str(warned),
            f"{own['fit_seconds']:.0f}",
        ]


def paragraphs(rows: Sequence[Row]) -> list[str]:
    """The page."""
    parts = [
        "# RES-DBNN: how long it learns",
        f"Written by `benchmarks/paper/network.py`. {HELD_BACK:.0%} of the training trajectories are held back; means "
        "over seeds. *Early stopping*, that of results_table.py, ends when a tenth of the rows learned from, held back "
        "too, gained nothing for 30 epochs. Loss: minus the bound per row of the last epoch, nats. "
        f"{harness.provenance_text(rows)}",
    ]
    for system in (system for system in SYSTEMS if any(row["system"] == system for row in rows)):
        of_system = [row for row in rows if row["system"] == system]
        own = [row for row in of_system if row["tested_on"] == HELD]
        header = ["", "epochs", "Error held back", "Error learned", "NLPD held back", "loss", "warned", "seconds"]
        found = enough(means(own, "error_tested"))
        seeds = len({row["seed"] for row in own})
        parts += [
            f"## {system}, {seeds} seed{'s' if seeds > 1 else ''}",
            harness.table(header, lines_of(own)),
            f"Enough, since more leave at least {ENOUGH:.0%} of the Error held back: "
            f"{f'{found} epochs' if found else 'none of those that were tried'}.",
        ]
        if len(of_system) > len(own):
            parts += [
                "Fitted to all training trajectories, on the test sets of results_table.py; in the paper "
                f"{PAPER[system]['RES-DBNN'].error:.3f}. First what has the lowest Error held back, with the paper's "
                "number of units.",
                harness.table(["", "epochs", "Error", "median", "of each data set"], tested_lines(of_system)),
            ]
    return parts


def tested_lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    """Of one system's test sets."""
    tested = [row for row in rows if row["tested_on"] == TEST]
    for variant, epochs in compared(rows):
        own = [row for row in tested if (row["variant"], int(row["epochs"])) == (variant, epochs)]
        if own:
            errors = column(sorted(own, key=lambda row: int(row["seed"])), "error_tested")
            n_iter = f"{column(own, 'n_iter').mean():.0f}"
            middle = map(figure_of, (errors.mean(), np.median(errors)))
            yield [variant or "standard", n_iter, *middle, ", ".join(map(figure_of, errors))]


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="12 trajectories, few epochs and one seed",
        seeds="seeds 0, 1, ...; default: 2, of a quick run 1",
        systems=SYSTEMS,
        default_systems=[system for system in SYSTEMS if system != "iiwa14"],
    )
    parser.add_argument(
        "--epochs", nargs="+", type=harness.positive, default=list(N_EPOCHS), help="default: %(default)s"
    )
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS), help="default: all")
    options = parser.parse_args()
    output, size = harness.output_path(options, "network"), "quick" if options.quick else "full"
    n_seeds = (1 if options.quick else 2) if options.seeds is None else options.seeds
    systems = options.systems[:1] if options.quick else options.systems
    epochs = (5, 10) if options.quick else options.epochs
    cells = [
        Cell(system, variant, n, seed, HELD, size)
        for system, seed, variant, n in itertools.product(systems, range(n_seeds), options.variants, epochs)
        if not variant or n == (epochs[-1] if options.quick else VARIED)
    ]
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since)
    for system in systems:
        rows = [row for row in harness.read(output) if (row["size"], row["system"]) == (size, system)]
        cells = [Cell(system, *how, seed, TEST, size) for how in compared(rows) for seed in range(n_seeds)]
        n_failures += harness.run_missing(cells, run, output, options.jobs, say, since=options.since)
    rows = [row for row in harness.read(output) if row["size"] == size]
    harness.write_report(paragraphs(rows) if rows else [], output, n_failures)


if __name__ == "__main__":
    main()
