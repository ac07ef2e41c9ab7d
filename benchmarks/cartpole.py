"""The cartpole's Error in the paper's setting: what was tried to bring it down to the paper's.

Fits EVGP with the paper's features, inputs and number of inducing points, but other choices where the paper leaves one,
and writes one row per fit to a CSV (what is there already is not fitted again); from the CSV come a Markdown table and
a picture of Error against bound. Data and columns are those of table3.py.

    python benchmarks/cartpole.py                                     # all, two data sets: an hour of one core
    python benchmarks/cartpole.py --quick                             # few rows and iterations: two minutes
    python benchmarks/cartpole.py --variants "L-BFGS" --seeds 4       # one line on more data sets: four minutes
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import harness
import table3
from harness import Row, column, figure_of, pyplot, save_picture
from paper_models import Fit, fitted_row
from table3_report import PAPER

MODELS = ("EVGP-IFG", "EVGP-IF")
ADAM, LBFGS = "Adam", "L-BFGS"
# What differs from the paper's setting (Adam, diagonal posterior, inducing points per output).
VARIANTS: dict[str, dict[str, Any]] = {
    ADAM: {},
    f"{ADAM}, 40,000 steps": {"max_iter": 40_000},
    f"{ADAM}, first step 0.03": {"learning_rate": 0.03},
    f"{ADAM}, first step 0.3": {"learning_rate": 0.3},
    f"{ADAM}, batches of 128": {"batch_size": 128},
    f"{ADAM}, batches of 2048": {"batch_size": 2048},
    f"{ADAM}, greedy inducing points": {"inducing_init": "greedy"},
    f"{ADAM}, first noise 1e-6": {"noise_variance": 1e-6},
    LBFGS: {"solver": "lbfgs"},
    f"{LBFGS}, 3000 iterations": {"solver": "lbfgs", "max_iter": 3000},
    f"{LBFGS}, full posterior": {"solver": "lbfgs", "posterior": "full"},
    f"{LBFGS}, a kernel per output": {"solver": "lbfgs", "sharing": "none"},
    f"{LBFGS}, full posterior, a kernel per output": {"solver": "lbfgs", "posterior": "full", "sharing": "none"},
    "skevgp's defaults": {"solver": "lbfgs", "posterior": "full", "sharing": "all"},
}
QUICK_ITERATIONS = 50


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes
    ----------
    variant, model : str
    seed : int
        Of data and fit.
    size : {"full", "quick"}
    """

    variant: str
    model: str
    seed: int
    size: str


def run(cell: Cell) -> dict[str, Any]:
    """Fit one model, and look at it on the test set."""
    changes = dict(VARIANTS[cell.variant])
    if cell.size == "quick":
        changes["max_iter"] = QUICK_ITERATIONS
    fit = Fit("cartpole", cell.model, "paper", cell.seed, cell.size, None)
    train, test = table3.data("cartpole", cell.seed, 0.0, cell.size)
    return {"variant": cell.variant, **fitted_row(fit, train, test, changes)}


def groups(rows: list[Row]) -> Iterator[tuple[str, str, list[Row]]]:
    """Model, variant and its rows."""
    for model, variant in itertools.product(MODELS, VARIANTS):
        own = [row for row in rows if (row["model"], row["variant"]) == (model, variant)]
        if own:
            yield model, variant, own


def paragraphs(rows: list[Row]) -> list[str]:
    """A page: a line per variant, in means over data sets, and what the lowest Errors are.

    Parameters
    ----------
    rows : list of dict
        Of the CSV, of one size.

    Returns
    -------
    parts : list of str
    """
    parts = [
        "# The cartpole in the paper's setting",
        "Written by `benchmarks/cartpole.py`. Paper's features, inputs (the raw angle) and 60 inducing points; unless "
        "the name says otherwise Adam, diagonal posterior, inducing points per output. Means over data sets, which "
        "are those of Table 3; the Error of each data set in brackets, seed 0 first. Bound per row in nats. "
        f"{harness.provenance_text(rows)}",
    ]
    if rows[0]["size"] == "quick":
        parts.append("**A quick run**: few rows and iterations, not to be compared with the paper.")
    for model in dict.fromkeys(model for model, _, _ in groups(rows)):
        lines = []
        for own_model, variant, own in groups(rows):
            if own_model == model:
                own = sorted(own, key=lambda row: int(row["seed"]))
                errors = column(own, "error_mean")
                lines.append(
                    [
                        variant,
                        f"{figure_of(errors.mean())} ({', '.join(map(figure_of, errors))})",
                        *(figure_of(column(own, name).mean()) for name in ("error_median", "error_p99")),
                        f"{column(own, 'cr2').mean():.3f}",
                        f"{column(own, 'bound_per_row').mean():.2f}",
                        f"{column(own, 'fit_seconds').mean():.0f}",
                    ]
                )
        header = ["", "Error", "median row", "99 % of rows", "CR-2", "bound", "seconds"]
        parts += [
            f"## {model}",
            harness.table(header, lines),
            f"In the paper: {PAPER['cartpole'][model].error:.3f}.",
        ]
    return parts


def plot(rows: list[Row], path: Path) -> None:
    """A panel per model: the Error of each fit against its bound, from which the paper's is a line.

    Parameters
    ----------
    rows : list of dict
        Of the CSV, of one size.
    path : Path
        Of the PNG.
    """
    models = list(dict.fromkeys(model for model, _, _ in groups(rows)))
    figure, grid = pyplot().subplots(
        1, len(models), figsize=(1 + 4.2 * len(models), 3.6), squeeze=False, sharey=True, layout="constrained"
    )
    styles = {ADAM: ("#E69F00", "s"), LBFGS: ("#0072B2", "o"), "skevgp's defaults": ("#009E73", "^")}
    for axes, model in zip(grid[0], models, strict=True):
        for name, (colour, marker) in styles.items():
            own = [row for row in rows if row["model"] == model and row["variant"].startswith(name)]
            label = name if name not in (ADAM, LBFGS) else f"{name}, all variants"
            axes.plot(column(own, "bound_per_row"), column(own, "error_mean"), marker, color=colour, label=label)
        axes.axhline(PAPER["cartpole"][model].error, color="black", linewidth=1.2, label="in the paper")
        axes.set_yscale("log")
        ticks = [0.01, 0.02, 0.05, 0.1]
        axes.set_yticks(ticks, map(str, ticks))
        axes.set_yticks([], minor=True)
        axes.set_title(model, fontsize=11)
        axes.set_xlabel("bound per row, nats")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    grid[0, 0].set_ylabel("test Error")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    save_picture(figure, path)


def say(row: dict[str, Any]) -> str:
    return f"Error {row['error_mean']:.4f}, bound {row['bound_per_row']:.2f}, {row['fit_seconds']:.0f} s"


def main() -> None:
    parser = harness.argument_parser(
        __doc__, quick="12 trajectories, few iterations and one seed", seeds="seeds 0, 1, ...; default: 2, quick 1"
    )
    parser.add_argument("--models", nargs="+", choices=MODELS, default=MODELS, help="default: both")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS), help="default: all")
    options = parser.parse_args()
    size = "quick" if options.quick else "full"
    output = harness.output_path(options, "cartpole")
    n_seeds = options.seeds or (1 if options.quick else 2)
    cells = [
        Cell(variant, model, seed, size)
        for seed, model, variant in itertools.product(range(n_seeds), options.models, options.variants)
    ]
    n_failures = harness.run_missing(cells, run, output, options.jobs, say)

    rows = [row for row in harness.read(output) if row["size"] == size]
    if rows:
        plot(rows, output.with_suffix(".png"))
    harness.write_report(paragraphs(rows) if rows else [], output, n_failures)


if __name__ == "__main__":
    main()
