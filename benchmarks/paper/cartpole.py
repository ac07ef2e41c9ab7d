"""The cartpole's Error: what was tried to bring it down to the paper's.

Fits EVGP with the paper's features, inputs and number of inducing points, but other choices where the paper leaves one
(of the last variant all are skevgp's defaults), and writes one row per fit to a CSV (what is there already is not
fitted again); from the CSV come a Markdown table and a picture of the Errors. Data and columns are those of
results_table.py.

    python benchmarks/paper/cartpole.py                                     # all, two data sets: an hour of one core
    python benchmarks/paper/cartpole.py --quick                             # few rows and iterations: two minutes
    python benchmarks/paper/cartpole.py --variants "L-BFGS" --seeds 4       # one line on more data sets: four minutes
    python benchmarks/paper/cartpole.py --systems cartpole_damped --variants Adam "skevgp's defaults" --seeds 4
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np

import harness
from harness import PALETTE, WIDTH, Row, column, figure_of, legend, logarithmic, pyplot, save_picture
from paper import results_table
from paper.models import Fit, fitted_row
from paper.results_table_report import PAPER, star
from skevgp import solvers
from skevgp.noise import Gaussian

MODELS = ("EVGP-IFG", "EVGP-IF")
ADAM, LBFGS, DEFAULTS = "Adam", "L-BFGS", "skevgp's defaults"
SHARED = f"{LBFGS}, full posterior, all shared"


def adam(**options: Any) -> dict[str, Any]:
    """Parameters of a regressor with a diagonal posterior whose Adam has these options."""
    return {"solver": solvers.Adam(posterior="diagonal", **options)}


# What differs from the paper's setting (Adam, diagonal posterior, inducing points per output), of the last one from
# skevgp's.
VARIANTS: dict[str, dict[str, Any]] = {
    ADAM: {},
    f"{ADAM}, 40,000 steps": {"max_iter": 40_000},
    f"{ADAM}, first step 0.03": adam(learning_rate=0.03),
    f"{ADAM}, first step 0.3": adam(learning_rate=0.3),
    f"{ADAM}, batches of 128": adam(batch_size=128),
    f"{ADAM}, batches of 2048": adam(batch_size=2048),
    f"{ADAM}, greedy inducing points": {"inducing_init": "greedy"},
    f"{ADAM}, first noise 1e-6": {"noise": Gaussian(variance=1e-6)},
    LBFGS: {"solver": solvers.LBFGS(posterior="diagonal")},
    f"{LBFGS}, full posterior": {"solver": solvers.LBFGS()},
    f"{LBFGS}, a kernel per output": {"solver": solvers.LBFGS(posterior="diagonal"), "sharing": "none"},
    f"{LBFGS}, full posterior, a kernel per output": {"solver": solvers.LBFGS(), "sharing": "none"},
    SHARED: {"solver": solvers.LBFGS(), "sharing": "all"},
    f"{SHARED}, 120 points": {"solver": solvers.LBFGS(), "sharing": "all", "n_inducing": 120},
    DEFAULTS: {},
}
SYSTEMS = ("cartpole", "cartpole_damped")
QUICK_ITERATIONS = 50


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes
    ----------
    system, variant, model : str
    seed : int
        Of data and fit.
    size : {"full", "quick"}
    """

    system: str
    variant: str
    model: str
    seed: int
    size: str


def run(cell: Cell) -> dict[str, Any]:
    """Fit one model, and look at it on the test set."""
    changes = dict(VARIANTS[cell.variant])
    if cell.size == "quick":
        changes["max_iter"] = QUICK_ITERATIONS
    setting = "skevgp" if cell.variant == DEFAULTS else "paper"
    fit = Fit(cell.system, cell.model, setting, cell.seed, cell.size, None)
    train, test = results_table.data(cell.system, cell.seed, 0.0, cell.size)
    row = {"variant": cell.variant, **fitted_row(fit, train, test, changes)}
    del row["setting"]  # the variant says it
    return row


def groups(rows: list[Row]) -> Iterator[tuple[tuple[str, str], str, list[Row]]]:
    """System and model, variant and its rows."""
    for system, model, variant in itertools.product(SYSTEMS, MODELS, VARIANTS):
        own = [row for row in rows if (row["system"], row["model"], row["variant"]) == (system, model, variant)]
        if own:
            yield (system, model), variant, own


def paragraphs(rows: list[Row]) -> list[str]:
    """A page: for each model the paper's Error and a line per variant, means over data sets and the Error of each.

    Parameters
    ----------
    rows : list of dict
        Of the CSV, of one size.

    Returns
    -------
    parts : list of str
    """
    parts = [
        "# What was tried on the cartpole",
        "Written by `benchmarks/paper/cartpole.py`. Paper's features, inputs (the raw angle) and 60 inducing points; "
        "unless the name says otherwise Adam, diagonal posterior, inducing points per output. Means over data sets, "
        "which are those of Table 4; the Error of each data set in brackets, seed 0 first. Inside: mean Error of the "
        "rows within the training rows' ranges. Bound per row in nats. An asterisk: a fit did not end by itself. "
        f"{harness.provenance_text(rows)}",
    ]
    if rows[0]["size"] == "quick":
        parts.append("**A quick run**: few rows and iterations, not to be compared with the paper.")
    for system, model in dict.fromkeys(place for place, _, _ in groups(rows)):
        parts += [f"## {system}: {model}", table_of(rows, system, model)]
        parts += [f"In the paper: {PAPER['cartpole'][model].error:.3f}."]
    return parts


def table_of(rows: list[Row], system: str, model: str) -> str:
    """A line per variant of one model; what has fewer data sets is compared with Adam on these."""
    of_model = {variant: own for place, variant, own in groups(rows) if place == (system, model)}
    adam = {row["seed"]: float(row["error_mean"]) for row in of_model.get(ADAM, [])}
    lines = []
    for variant, unordered in of_model.items():
        own = sorted(unordered, key=lambda row: int(row["seed"]))
        errors = column(own, "error_mean")
        same = [adam[row["seed"]] for row in own if row["seed"] in adam]
        lines.append(
            [
                variant + star(any(row["converged"] == "False" for row in own)),
                f"{figure_of(errors.mean())} ({', '.join(map(figure_of, errors))})",
                figure_of(inside) if np.isfinite(inside := column(own, "error_inside").mean()) else "",
                f"{errors.mean() / np.mean(same):.2f}" if len(same) == len(own) else "",
                *(figure_of(column(own, name).mean()) for name in ("error_median", "error_p99")),
                f"{column(own, 'cr2').mean():.3f}",
                f"{column(own, 'bound_per_row').mean():.2f}",
                f"{column(own, 'fit_seconds').mean():.0f}",
            ]
        )
    header = ["", "Error", "inside", "× Adam, same data sets", "median row", "99 % of rows", "CR-2", "bound", "seconds"]
    return harness.table(header, lines)


def plot(rows: list[Row], path: Path) -> None:
    """A panel per system and model, a line per variant, a symbol per data set, their median; across, the paper's Error.

    Parameters
    ----------
    rows : list of dict
        Of the CSV, of one size.
    path : Path
        Of the PNG.
    """
    places = list(dict.fromkeys(place for place, _, _ in groups(rows)))
    variants = [variant for variant in VARIANTS if any(variant == row["variant"] for row in rows)]
    size = (WIDTH, 1.3 + 0.27 * len(variants))
    figure, grid = pyplot().subplots(1, len(places), figsize=size, squeeze=False, sharex=True, sharey=True)
    seeds = sorted({int(row["seed"]) for row in rows})
    styles = dict(zip(seeds, itertools.cycle(zip(PALETTE, "os^Dv<", strict=True)), strict=False))
    for axes, (system, model) in zip(grid[0], places, strict=True):
        for where, variant, own in groups(rows):
            if where != (system, model):
                continue
            place = variants.index(variant)
            for row in own:
                colour, marker = styles[int(row["seed"])]
                face = "white" if row["converged"] == "False" else colour
                axes.plot(float(row["error_mean"]), place, marker, color=colour, markerfacecolor=face, alpha=0.9)
            if len(own) > 1:
                axes.plot(np.median(column(own, "error_mean")), place, "k|", markersize=14, markeredgewidth=2)
        axes.axvline(PAPER["cartpole"][model].error, color="0.3", linestyle="--", linewidth=1.2, label="in the paper")
        logarithmic(axes, "x")
        axes.set(title=f"{system}\n{model}", xlabel="test Error\n(SI units)")
    axes = grid[0, 0]
    axes.set_yticks(range(len(variants)), variants)
    axes.set_ylim(len(variants) - 0.5, -0.5)
    for seed, (colour, marker) in styles.items():
        axes.plot([], [], marker, color=colour, label=f"data set {seed}")
    axes.plot([], [], "k|", markersize=12, markeredgewidth=2, label="median")
    axes.plot([], [], "o", color="0.3", markerfacecolor="white", label="ended by its limit of iterations")
    legend(figure, ncols=4)
    save_picture(figure, path)


def say(row: dict[str, Any]) -> str:
    return f"Error {row['error_mean']:.4f}, bound {row['bound_per_row']:.2f}, {row['fit_seconds']:.0f} s"


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="12 trajectories, few iterations and one seed",
        seeds="seeds 0, 1, ...; default: 2, quick 1",
        systems=SYSTEMS,
        default_systems=SYSTEMS[:1],
    )
    parser.add_argument("--models", nargs="+", choices=MODELS, default=MODELS, help="default: both")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS), help="default: all")
    options = parser.parse_args()
    size = "quick" if options.quick else "full"
    output = harness.output_path(options, "cartpole")
    n_seeds = options.seeds or (1 if options.quick else 2)
    cells = [
        Cell(system, variant, model, seed, size)
        for system, seed, model, variant in itertools.product(
            options.systems, range(n_seeds), options.models, options.variants
        )
    ]
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since)

    rows = [row for row in harness.read(output) if row["size"] == size]
    if rows:
        plot(rows, output.with_suffix(".png"))
    harness.write_report(paragraphs(rows) if rows else [], output, n_failures)


if __name__ == "__main__":
    main()
