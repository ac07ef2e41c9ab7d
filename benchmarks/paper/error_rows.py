"""Which test rows make the Error of EVGP-IFG: those beyond the training range, those that turned, the farthest ones.

Fits it in skevgp's setting to the data of results_table.py, writes one row per fit and kind of test row to a CSV (what
is there already is not fitted again), and a page beside it.

    python benchmarks/paper/error_rows.py              # four systems, four seeds: three minutes of one core
    python benchmarks/paper/error_rows.py --noise 0.01  # on training and test targets; in the same file
    python benchmarks/paper/error_rows.py --quick      # fewer rows and iterations, one seed
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
from sklearn.neighbors import NearestNeighbors
from sklearn.preprocessing import StandardScaler
from sklearn.utils import Bunch

import harness
from harness import Row, column, figure_of
from paper import results_table
from paper.models import SYSTEMS, Fit, beyond_range, build, timed
from skevgp.metrics import containing_ratios
from skevgp.robots import layout_of

# The first three are all rows, told apart; the last two are some of these once more.
BEYOND, TURNED, OTHERS = "beyond a training column's range", "within, an angle beyond ±π", "within, no angle beyond ±π"
WORST, LONELY = "the worst hundredth", "the tenth that is farthest from all training rows"
KINDS = (BEYOND, TURNED, OTHERS, WORST, LONELY)
PLANAR = tuple(system for system in SYSTEMS if system != "iiwa14")


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes
    ----------
    system : str
    seed : int
        Of data and fit.
    noise : float
        Of both data sets, as a share of each training target's standard deviation.
    size : {"full", "quick"}
    """

    system: str
    seed: int
    noise: float
    size: str


def kinds_of(system: str, train: np.ndarray, test: np.ndarray, errors: np.ndarray) -> dict[str, np.ndarray]:
    """Which test rows are of each kind.

    Parameters
    ----------
    system : str
    train, test : ndarray of shape (n, n_columns)
    errors : ndarray of shape (n_test,)
        Their norms.

    Returns
    -------
    masks : dict
        Kind -> ndarray of bool of shape (n_test,).
    """
    beyond = beyond_range(train, test).any(axis=1)
    angles = test[:, np.flatnonzero(layout_of(system).revolute)]  # positions come first
    turned = (np.abs(angles) > np.pi).any(axis=1)
    scaler = StandardScaler().fit(train)
    nearest = NearestNeighbors(n_neighbors=1).fit(scaler.transform(train))
    distances = nearest.kneighbors(scaler.transform(test))[0][:, 0]
    return {
        BEYOND: beyond,
        TURNED: ~beyond & turned,
        OTHERS: ~beyond & ~turned,
        WORST: largest(errors, 0.01),
        LONELY: largest(distances, 0.1),
    }


def largest(values: np.ndarray, share: float) -> np.ndarray:
    """Which are the largest of all, so many of them."""
    mask = np.zeros(len(values), dtype=bool)
    mask[np.argsort(values)[len(values) - round(share * len(values)) :]] = True
    return mask


def run(cell: Cell) -> list[dict[str, Any]]:
    """Fit the model, and look at each kind of test row."""
    train, test = results_table.data(cell.system, cell.seed, cell.noise, cell.size)
    fit = Fit(cell.system, "EVGP-IFG", "skevgp", cell.seed, cell.size, None)
    mean, std, _, _ = timed(build(fit), train, test)
    return described(cell, train, test, mean, std)


def described(cell: Cell, train: Bunch, test: Bunch, mean: np.ndarray, std: np.ndarray) -> list[dict[str, Any]]:
    """A row of the CSV for each kind of test row, of a prediction."""
    errors = np.linalg.norm(test.target - mean, axis=1)
    return [
        {
            **{name: getattr(cell, name) for name in ("system", "seed", "noise", "size")},
            "kind": kind,
            "of_rows": mask.mean(),
            "of_error": errors[mask].sum() / errors.sum(),
            "error": errors[mask].mean() if mask.any() else np.nan,
            **{f"cr{k}": ratio for k, ratio in zip((1, 2, 3), ratios(test.target, mean, std, mask), strict=True)},
            **harness.provenance(),
        }
        for kind, mask in kinds_of(cell.system, train.data, test.data, errors).items()
    ]


def ratios(target: np.ndarray, mean: np.ndarray, std: np.ndarray, mask: np.ndarray) -> tuple[float, ...]:
    """CR-1 to 3 of some rows; NaN of none."""
    return tuple(containing_ratios(target[mask], mean[mask], std[mask])) if mask.any() else (np.nan,) * 3


def say(rows: list[dict[str, Any]]) -> str:
    return ", ".join(f"{row['kind']} {row['of_error']:.0%}" for row in rows)


def table_of(rows: Sequence[Row], noise: str) -> str:
    """A line per system and kind of row: means over data sets, and of the shares of the Error each."""
    lines = []
    for system, kind in itertools.product(SYSTEMS, KINDS):
        own = [row for row in rows if (row["system"], row["kind"], row["noise"]) == (system, kind, noise)]
        if own:
            own.sort(key=lambda row: int(row["seed"]))
            known = [row for row in own if row["error"] != "nan"]  # no row may be of a kind
            lines.append(
                [
                    *(system, kind, f"{column(own, 'of_rows').mean():.1%}"),
                    ", ".join(f"{share:.0%}" for share in column(own, "of_error")),
                    figure_of(column(known, "error").mean()) if known else "",
                    # Rows chosen by their error are outside of any bands.
                    *(f"{column(known, f'cr{k}').mean():.3f}" if known and kind != WORST else "" for k in (1, 2, 3)),
                ]
            )
    header = ["system", "test rows", "of all", "of the Error, each data set", "their Error", "CR-1", "CR-2", "CR-3"]
    return harness.table(header, lines)


def paragraphs(rows: Sequence[Row]) -> list[str]:
    """The page: a table without noise, and one with it."""
    parts = [
        "# Which test rows make an Error",
        "Written by `benchmarks/paper/error_rows.py`: EVGP-IFG in skevgp's setting, on the data of Table 4. The first "
        "three kinds of rows are all rows; the worst hundredth, by error, and the tenth that is farthest from all "
        "training rows (columns in units of their standard deviation) are some of these once more. Shares of the Error "
        "are of each data set, seed 0 first, all else is means over data sets. CR-1 to 3 of a normal distribution: "
        f"0.683, 0.954, 0.997. With noise Errors contain that of the test targets. {harness.provenance_text(rows)}",
    ]
    if rows[0]["size"] == "quick":
        parts.append("**A quick run**: few rows and iterations.")
    for noise in sorted({row["noise"] for row in rows}, key=float):
        name = f"With noise of {float(noise):.0%} of each target's std" if float(noise) else "Without noise"
        parts += [f"## {name}", table_of(rows, noise)]
    return parts


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="12 trajectories, few iterations and one seed",
        seeds="seeds 0, 1, ...; default: 4, quick 1",
        systems=SYSTEMS,
        default_systems=PLANAR,
    )
    parser.add_argument("--noise", type=float, default=0.0, help="as a share of each training target's std; default: 0")
    options = parser.parse_args()
    output, size = harness.output_path(options, "error_rows"), "quick" if options.quick else "full"
    n_seeds = (1 if options.quick else 4) if options.seeds is None else options.seeds
    cells = [
        Cell(system, seed, options.noise, size) for system, seed in itertools.product(options.systems, range(n_seeds))
    ]
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since)
    rows = [row for row in harness.read(output) if row["size"] == size]
    harness.write_report(paragraphs(rows) if rows else [], output, n_failures)


if __name__ == "__main__":
    main()
