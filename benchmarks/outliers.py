"""A few wrong rows: what they do to a fit with Gaussian noise, and to one with a Student-t's tails.

Of the training rows 5 % are shifted by 20 standard deviations of the noise, up or down for each output; test rows are
clean. Each model is fitted to the clean and to the spoiled rows, and the Gaussian one to the rows that are left without
those that are shifted. Tables (their inputs and target standardised with the
training rows) are read from --data-folder, and a seed is a split; the noise that shifts are measured in is what the
Gaussian fit to the clean rows finds. Data of the cartpole have noise of 1 % of each target's scatter, test data too;
the features are IFG.

Writes five rows per data set and seed to a CSV as soon as they are done, and a table beside it.

    python benchmarks/outliers.py --data-folder ../uci    # a quarter of an hour of one core
    python benchmarks/outliers.py --datasets cartpole
    python benchmarks/outliers.py --quick                 # cartpole, few rows and iterations: seconds
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))  # for what the scripts share

import numpy as np
from sklearn.utils import Bunch

import harness
from harness import Row
from paper.models import measures, timed
from peers.data import tabular
from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForceGravity

# Number of inducing points, and of seeds.
DATASETS = {"elevators": (100, 4), "airfoil": (100, 10), "cartpole": (60, 4)}
SHARE, SHIFT = 0.05, 20.0
# Of a set of rows.
KEPT = ("data", "target", "groups")
# Rows, and noise.
FITS = (
    ("clean", "gaussian"),
    ("clean", "student-t"),
    ("left", "gaussian"),
    ("spoiled", "gaussian"),
    ("spoiled", "student-t"),
)


NAMES = {"clean": "clean rows", "left": "rows left", "spoiled": "spoiled rows"}


@dataclass(frozen=True)
class Cell:
    """A data set.

    Attributes
    ----------
    dataset : str
    seed : int
    size : {"full", "quick"}
    folder : Path or None
        With the tables.
    """

    dataset: str
    seed: int
    size: str
    folder: Path | None = field(compare=False)


def data(cell: Cell) -> tuple[Bunch, Bunch]:
    """A training and a test set."""
    quick = cell.size == "quick"
    if cell.dataset == "cartpole":
        train, test = (
            make_dynamics("cartpole", 6 if quick else None, noise=0.01, random_state=state)
            for state in (cell.seed, 1000 + cell.seed)
        )
        return train, test
    sets = tabular(cell.dataset, cell.seed, cell.folder)
    most = 500 if quick else None
    return Bunch(data=sets.X[:most], target=sets.Y[:most]), Bunch(data=sets.X_test, target=sets.Y_test)


def model_of(cell: Cell, noise: str) -> EVGPRegressor:
    """As it comes, but for the noise; with few iterations in a quick run."""
    features = InertiaForceGravity("cartpole") if cell.dataset == "cartpole" else None
    n_inducing, max_iter = (10, 20) if cell.size == "quick" else (DATASETS[cell.dataset][0], None)
    return EVGPRegressor(features, n_inducing=n_inducing, max_iter=max_iter, noise=noise, random_state=cell.seed)


def spoiled(train: Bunch, sigma: np.ndarray, seed: int) -> tuple[Bunch, np.ndarray]:
    """The same rows, of which some are shifted; and which."""
    rng = np.random.RandomState(seed)
    bad = rng.rand(len(train.data)) < SHARE
    target = train.target.copy()
    target[bad] += SHIFT * sigma * rng.choice([-1.0, 1.0], (bad.sum(), target.shape[1]))
    return Bunch(**{**train, "target": target}), bad


def run(cell: Cell) -> list[dict[str, Any]]:
    """Fit each model to the clean and the spoiled rows; ``fit_seconds`` is processor time of one thread."""
    train, test = data(cell)
    rows, sigma = [], np.empty(0)
    for condition, noise in FITS:
        own, bad = (train, np.zeros(len(train.data), dtype=bool))
        if condition != "clean":
            own, bad = spoiled(train, sigma, cell.seed)
        if condition == "left":
            own, bad = Bunch(**{name: own[name][~bad] for name in KEPT if name in own}), bad[~bad]
        model = model_of(cell, noise)
        mean, std, seconds, _ = timed(model, own, test)
        mean, std = mean.reshape(test.target.shape), std.reshape(test.target.shape)
        if len(rows) == 0:
            sigma = np.sqrt(np.atleast_1d(model.noise_variance_))
        weights = getattr(model, "weights_", np.ones(1)).reshape(len(bad) if noise == "student-t" else 1, -1)
        doubted = np.broadcast_to((weights < 0.5).any(axis=1), len(bad))
        rows.append(
            {
                **{name: getattr(cell, name) for name in ("dataset", "seed", "size")},
                "rows": condition,
                "noise": noise,
                **measures(test.target, mean, std),
                "n_outputs": mean.shape[1],
                "found": doubted[bad].mean() if bad.any() else "",
                "doubted": doubted[~bad].mean(),
                "n_iter": model.n_iter_,
                "fit_seconds": seconds,
                **harness.provenance(),
            }
        )
    return rows


def say(rows: list[dict[str, Any]]) -> str:
    return "Error " + ", ".join(f"{row['error_mean']:.4f} ({row['rows']}, {row['noise']})" for row in rows)


def lines_of(dataset: str, rows: Sequence[Row]) -> list[list[str]]:
    """Of a table: means over seeds, beside those of the Gaussian fit to the clean rows."""
    own = [row for row in rows if row["dataset"] == dataset]
    if not own:
        return []
    means = {}
    for key in FITS:
        some = [row for row in own if (row["rows"], row["noise"]) == key]
        nlpd = harness.column(some, "nlpd") / harness.column(some, "n_outputs")
        found = [float(row["found"]) for row in some if row["found"]]
        means[key] = [
            *(harness.column(some, name).mean() for name in ("error_mean", "cr2", "doubted", "fit_seconds")),
            nlpd.mean(),
            np.mean(found) if found else np.nan,
        ]
    error, _, _, _, nlpd, _ = means["clean", "gaussian"]
    return [
        [
            f"{dataset}, {NAMES[condition]}, {noise}",
            harness.figure_of(own_error),
            f"{own_error / error:.3f}",
            f"{own_nlpd:.3f}",
            f"{own_nlpd - nlpd:+.3f}",
            f"{inside:.3f}",
            f"{found:.1%} / {doubted:.2%}" if noise != "gaussian" and condition == "spoiled" else "",
            f"{seconds:.1f}",
        ]
        for (condition, noise), (own_error, inside, doubted, seconds, own_nlpd, found) in means.items()
    ]


def paragraphs(rows: Sequence[Row]) -> list[str]:
    """The page: nothing if there are no rows."""
    if not rows:
        return []
    header = ["", "Error", "ratio", "NLPD", "more", "CR-2", "outliers / others doubted", "seconds"]
    lines = [line for dataset in DATASETS for line in lines_of(dataset, rows)]
    counts = ", ".join(
        f"{dataset} {len({row['seed'] for row in rows if row['dataset'] == dataset})}"
        for dataset in DATASETS
        if any(row["dataset"] == dataset for row in rows)
    )
    return [
        "# A few wrong rows",
        f"{SHARE:.0%} of the training rows are shifted by {SHIFT:g} standard deviations of the noise; test rows are "
        f"clean; rows left are those that are not shifted. Means over seeds ({counts}). NLPD is per output; ratio and "
        "difference are to the fit with Gaussian noise to the clean rows. Doubted are rows that count less than half.",
        harness.table(header, lines),
        harness.provenance_text(rows),
    ]


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="cartpole, 6 trajectories, 20 iterations and one seed",
        seeds="seeds 0, 1, ...; default: " + ", ".join(f"{name} {n}" for name, (_, n) in DATASETS.items()),
    )
    parser.add_argument("--datasets", nargs="+", choices=DATASETS, help="default: all that there are")
    parser.add_argument("--data-folder", type=Path, help="with the tables; default: they are left out")
    options = parser.parse_args()
    output, size = harness.output_path(options, "outliers"), "quick" if options.quick else "full"
    there = ["cartpole"] if options.quick or options.data_folder is None else list(DATASETS)
    cells = [
        Cell(dataset, seed, size, options.data_folder)
        for dataset in options.datasets or there
        for seed in range(options.seeds or (1 if options.quick else DATASETS[dataset][1]))
    ]
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since)
    harness.write_report(paragraphs([row for row in harness.read(output) if row["size"] == size]), output, n_failures)


if __name__ == "__main__":
    main()
