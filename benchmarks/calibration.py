"""Are standard deviations calibrated, without calibration (noise_cv=None) and with the default?

Systems are fitted with ``groups=train.groups``, and tested on new trajectories. Tables of independent rows are fitted
with their rows shuffled or sorted by a column, and tested on held-out rows.

    python benchmarks/calibration.py                 # four systems, four tables, four seeds: half an hour
    python benchmarks/calibration.py --folder ~/uci  # also the tables in there: NAME/data.csv.gz, whose last column is
                                                     # the target, and NAME/test_mask.csv.gz
    python benchmarks/calibration.py --quick         # a system and a table, small, one seed: a minute
"""

from __future__ import annotations

import itertools
from collections import namedtuple
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from sklearn import datasets

import harness
from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.exceptions import DependentRowsWarning
from skevgp.features import AngleEncoder, InertiaForceGravity
from skevgp.metrics import containing_ratios, negative_log_predictive_density, prediction_error

# Numbers of inducing points and of training trajectories.
SYSTEMS = {"pendulum": (10, 24), "cartpole": (60, 24), "acrobot": (100, 24), "iiwa14": (100, 40)}
TEST_TRAJECTORIES = 40
NOISES = ("0.0", "0.01")
TABLES = {
    "diabetes": lambda seed: datasets.load_diabetes(return_X_y=True),
    "friedman1": lambda seed: datasets.make_friedman1(1500, noise=1.0, random_state=seed),
    "friedman2": lambda seed: datasets.make_friedman2(1500, noise=30.0, random_state=seed),
    "friedman3": lambda seed: datasets.make_friedman3(1500, noise=0.1, random_state=seed),
}
# Largest number of training rows.
MOST_ROWS, ITERATIONS = 12_000, 100

# One fit. The variant of a system is "" or "angles", for an AngleEncoder; of a table the order of the rows.
Cell = namedtuple("Cell", "data variant noise seed noise_cv size")


Part = tuple[np.ndarray, np.ndarray]


def system(cell: Cell) -> tuple[Part, Part, np.ndarray]:
    """Return training and test trajectories with the same noise, and the groups of the former."""
    n = 6 if cell.size == "quick" else SYSTEMS[cell.data][1]
    whole = make_dynamics(cell.data, n + TEST_TRAJECTORIES, noise=float(cell.noise), random_state=cell.seed)
    train, test = ((whole.data[rows], whole.target[rows]) for rows in (whole.groups < n, whole.groups >= n))
    return train, test, whole.groups[whole.groups < n]


def table(cell: Cell, folder: Path | None) -> tuple[Part, Part]:
    """Return training rows in the order of the variant, and test rows; columns are standardised."""
    rng = np.random.RandomState(cell.seed)
    if cell.data in TABLES:
        rows = rng.permutation(np.column_stack(TABLES[cell.data](cell.seed)))
        test = np.arange(len(rows)) >= 2 * len(rows) // 3
    else:
        files = (f"{folder}/{cell.data}/{name}.csv.gz" for name in ("data", "test_mask"))
        rows, masks = (np.loadtxt(file, delimiter=",") for file in files)
        test = masks[:, cell.seed].astype(bool)
    train, test = rng.permutation(rows[~test])[:MOST_ROWS], rows[test]
    size = train.std(axis=0)
    train, test = ((part - train.mean(axis=0)) / np.where(size > 0.0, size, 1.0) for part in (train, test))
    if cell.variant != "shuffled":
        train = train[np.argsort(train[:, int(cell.variant.split()[-1])], kind="stable")]
    return (train[:, :-1], train[:, -1]), (test[:, :-1], test[:, -1])


def run(cell: Cell, folder: Path | None) -> dict[str, Any]:
    """Fit one model and evaluate it on the test rows. ``fit_seconds`` is processor time of one thread."""
    noise_cv = None if cell.noise_cv == "None" else int(cell.noise_cv)
    max_iter = 10 if cell.size == "quick" else ITERATIONS
    settings: dict[str, Any] = {"noise_cv": noise_cv, "max_iter": max_iter, "random_state": cell.seed}
    groups = None
    if cell.data in SYSTEMS:
        train, (X, y), groups = system(cell)
        kernel_map = AngleEncoder(cell.data) if cell.variant == "angles" else None
        features, n_inducing = InertiaForceGravity(cell.data), SYSTEMS[cell.data][0]
        model = EVGPRegressor(features, kernel_map=kernel_map, n_inducing=n_inducing, **settings)
    else:
        train, (X, y) = table(cell, folder)
        model = EVGPRegressor(n_inducing=256 if len(train[0]) > 10_000 else 100, **settings)
    seconds, caught = harness.timed(lambda: model.fit(*train, groups=groups))
    mean, std = model.predict(X, return_std=True)
    return {
        "cr2": containing_ratios(y, mean, std)[1],
        "nlpd": negative_log_predictive_density(y, mean, std) / np.size(y[0]),
        "error_mean": prediction_error(y, mean),
        "fit_seconds": seconds,
        "n_rows": len(train[0]),
        "n_iter": model.n_iter_,
        "dependent": any(own.category is DependentRowsWarning for own in caught),
    }


def table_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Return a line for each setting, of the seeds that were fitted both without noise_cv and with it."""
    setting = ["data", "variant", "noise"]
    plain, default = (
        own.set_index([*setting, "seed"]) for own in (rows[rows["noise_cv"] == ""], rows[rows["noise_cv"] != ""])
    )
    both = default.join(plain.add_suffix(" plain"), how="inner")
    lines = []
    for found, own in both.groupby(setting, sort=False):
        means = own.mean(numeric_only=True)
        data, variant, noise = found
        line = {"": " ".join(part for part in (data, variant, f"noise {noise}" * (noise != "")) if part)}
        line |= {"seeds": len(own), "CR-2": f"{means['cr2 plain']:.3f} → {means['cr2']:.3f}"}
        line["of seeds"] = f"{own['cr2'].min():.3f} to {own['cr2'].max():.3f}"
        line["NLPD per output"] = f"{means['nlpd plain']:.3f} → {means['nlpd']:.3f}"
        line["at worst"] = f"{(own['nlpd'] - own['nlpd plain']).max():+.3f}"
        line["Error, ratio"] = f"{(own['error_mean'] / own['error_mean plain']).mean():.3f}"
        line["time, ratio"] = f"{means['fit_seconds'] / means['fit_seconds plain']:.2f}"
        lines.append({**line, "warned": int(own["dependent"].sum())})
    return pd.DataFrame(lines)


def tables_of(rows: pd.DataFrame) -> harness.Tables:
    names = ["variant", "noise", "noise_cv"]
    blank = rows[names].astype(object).where(rows[names].notna(), "").replace("None", "")
    rows, systems = rows.assign(**blank), rows["data"].isin(SYSTEMS)
    return {"systems": table_of(rows[systems]), "tables": table_of(rows[~systems])}


def variants(data: str, folder: Path | None) -> list[str]:
    """Return the orders of a table's rows: shuffled, and sorted by a column and by the target."""
    if data in TABLES:
        width = np.shape(TABLES[data](0)[0])[1]
    else:
        width = np.loadtxt(f"{folder}/{data}/data.csv.gz", delimiter=",", max_rows=1).size - 1
    return ["shuffled", "sorted by 0", f"sorted by {width}"]


def main() -> None:
    parser = harness.argument_parser(
        __doc__, quick="a system and a table, few trajectories and iterations, one seed", seeds=4, systems=SYSTEMS
    )
    parser.add_argument("--folder", type=Path, help="of further tables")
    options = harness.parse(parser)
    output = harness.output_path(options, "calibration")
    further = sorted(path.parent.name for path in options.folder.glob("*/data.csv.gz")) if options.folder else []
    systems = options.systems
    tables = [*TABLES, *further]
    if options.quick:
        systems, tables = systems[:1], tables[:1]
    settings = [*itertools.product(systems, ("", "angles"), NOISES)]
    settings += [(name, variant, "") for name in tables for variant in variants(name, options.folder)]
    cells = [
        Cell(data, variant, noise, seed, noise_cv, options.size)
        for seed in options.seeds
        for data, variant, noise in settings
        for noise_cv in ("None", "5")
    ]
    n_failures = harness.run_missing(cells, partial(run, folder=options.folder), output, options.jobs)
    rows = harness.frame(output, size=options.size)
    harness.write_page("Calibrated standard deviations", tables_of(rows), output, n_failures)


if __name__ == "__main__":
    main()
