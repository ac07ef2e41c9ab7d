"""The two lower bounds, of Titsias (2009) and of Titsias (2025): accuracy, noise and time of the fits.

    python benchmarks/bounds.py --data-folder ../uci    # about an hour of one core
    python benchmarks/bounds.py                         # without the three tables
    python benchmarks/bounds.py --quick

The tables airfoil, elevators and kin40k are read from --data-folder: NAME/data.csv.gz with the target last, and
NAME/test_mask.csv.gz with a column per split. Of the training rows 5,000 at most are used. Dynamics have noise of 1 %,
or none, and features from physics. "120 %" is the bound of 2009 with a fifth more inducing points, which takes
about as long as the bound of 2025. Both bounds of a set, split and number of points are maximised one after the other
in one process with one thread, from the same start and to convergence, with ``noise_cv`` and without. With 256 points
there are two splits, and of dynamics four seeds.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from sklearn.preprocessing import StandardScaler
from threadpoolctl import threadpool_limits

import harness
from skevgp import EGPRegressor, EVGPRegressor
from skevgp.datasets import make_dynamics, make_toy
from skevgp.features import AngleEncoder, InertiaForceGravity
from skevgp.metrics import containing_ratios, crps, negative_log_predictive_density
from skevgp.solvers import LBFGS

TABLES = ("airfoil", "elevators", "kin40k")
SYSTEMS = ("pendulum", "cartpole", "acrobot")
ROWS, TRAJECTORIES = 5000, 20
SEEDS, LARGE_SPLITS = 4, 2  # of dynamics, and of tables with 256 points
TOY_POINTS = (2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32)


@dataclass(frozen=True)
class Cell:
    """Fits of one set or system, with and without noise_cv."""

    name: str
    seed: int
    m: int


def table(folder: Path, cell: Cell, n_rows: int) -> tuple[EVGPRegressor, tuple[np.ndarray, ...]]:
    """Return a regressor, and standardised rows of a split: X, y and those of the test."""
    data, masks = (np.loadtxt(folder / cell.name / f"{file}.csv.gz", delimiter=",") for file in ("data", "test_mask"))
    test = masks[:, cell.seed] == 1
    train = np.random.RandomState(cell.seed).permutation(np.flatnonzero(~test))[:n_rows]
    data = StandardScaler().fit(data[~test]).transform(data)
    rows = data[train, :-1], data[train, -1:], data[test, :-1], data[test, -1:]
    return EVGPRegressor(n_inducing=cell.m, random_state=cell.seed), rows


def dynamics(cell: Cell, n_trajectories: int) -> tuple[EVGPRegressor, tuple[np.ndarray, ...], np.ndarray]:
    """Return a regressor, rows of trajectories and of others, in units of the targets, and labels of trajectories."""
    system, _, noise = cell.name.partition(", noise ")
    train, test = (
        make_dynamics(system, n_trajectories, noise=0.01 * float(noise.rstrip(" %")), random_state=seed)
        for seed in (cell.seed, 1000 + cell.seed)
    )
    unit = (train.target - train.data[:, : train.target.shape[1]]).std(axis=0)
    regressor = EVGPRegressor(
        InertiaForceGravity(system), kernel_map=AngleEncoder(system), n_inducing=cell.m, random_state=cell.seed
    )
    return regressor, (train.data, train.target, test.data, test.target, unit), train.groups


def measured(bound: str, folds: int | None, regressor: EVGPRegressor, rows: Any, groups: Any) -> dict[str, Any]:
    """Fit by one bound, and return scores on the test, relative to the size of the targets."""
    X, Y, X_test, Y_test, *unit = rows
    name, points = bound, regressor.n_inducing
    if bound == "titsias, 120 %":
        name, points = "titsias", int(1.2 * points)
    regressor.set_params(solver=LBFGS(bound=name), noise_cv=folds, n_inducing=points)
    start = time.process_time()
    regressor.fit(X, Y, groups=groups)
    seconds = time.process_time() - start
    mean, std = (part.reshape(Y_test.shape) / (unit[0] if unit else 1.0) for part in regressor.predict(X_test, True))
    Y_test = Y_test / (unit[0] if unit else 1.0)
    start = time.process_time()
    return {
        "bound": bound,
        "noise_cv": "yes" if folds else "no",
        "rmse": float(np.sqrt(np.mean((Y_test - mean) ** 2))),
        "nlpd": negative_log_predictive_density(Y_test, mean, std),
        "crps": crps(Y_test, mean, std),
        "cr2": float(np.mean(containing_ratios(Y_test, mean, std, k=2))),
        "lower_bound": regressor.lower_bound_ / len(X),
        "noise_std": float(np.sqrt(np.mean(regressor.noise_variance_))),
        "iterations": regressor.n_iter_,
        "seconds": round(seconds, 2),
    }


def run(cell: Cell, folder: Path | None, n_rows: int, n_trajectories: int) -> list[dict[str, Any]]:
    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore")
        found = []
        for folds in (None, 5):
            for bound in ("titsias", "tight", "titsias, 120 %"):
                groups = None
                if cell.name in TABLES:
                    regressor, rows = table(folder or Path(), cell, n_rows)
                else:
                    regressor, rows, groups = dynamics(cell, n_trajectories)
                scores = measured(bound, folds, regressor, rows, groups)
                found.append({"name": cell.name, "seed": cell.seed, "m": cell.m, **scores, **harness.provenance()})
    return found


def tables_of(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return means over seeds, and differences between bounds with their standard errors."""
    scores = ["rmse", "nlpd", "crps"]
    keys = ["name", "noise_cv", "m"]
    means = rows.groupby([*keys, "bound"], sort=False)[[*scores, "cr2", "lower_bound", "noise_std", "seconds"]].mean()
    wide = rows.pivot_table(index=[*keys, "seed"], columns="bound", values=[*scores, "seconds"], sort=False)
    lines = []
    for key, own in wide.groupby(keys, sort=False):
        line = dict(zip(keys, key, strict=True))
        for other in ("titsias", "titsias, 120 %"):
            against = "" if other == "titsias" else ", 120 %"
            for name in scores[:2]:
                change = own[name]["tight"] - own[name][other]
                if name == "rmse":
                    change = change / own[name][other]
                said = "relative RMSE" if name == "rmse" else "NLPD"
                error = f" ± {change.sem():.4f}" if len(change) > 1 else ""
                line[f"{said}{against}"] = f"{change.mean():+.4f}{error}"
            line[f"× seconds{against}"] = (own["seconds"]["tight"] / own["seconds"][other]).median()
        lines.append(line | {"seeds": len(own)})
    return {"means": means.reset_index(), "tight less titsias": pd.DataFrame(lines)}


def draw(output: Path, n_rows: int, sizes: tuple[int, ...]) -> None:
    """Draw both bounds, the exact log likelihood and the noise over the number of inducing points of a toy set."""
    X, y = make_toy(n_rows, random_state=0, return_X_y=True)
    exact = EGPRegressor(random_state=0).fit(X, y)
    figure, (left, right) = harness.pyplot().subplots(1, 2, figsize=(9.0, 3.4), layout="constrained")
    for bound, style in (("titsias", "o-"), ("tight", "s-")):
        solver = LBFGS(bound=bound, n_restarts=4)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            models = [
                EVGPRegressor(n_inducing=m, noise_cv=None, solver=solver, random_state=0).fit(X, y) for m in sizes
            ]
        left.plot(sizes, [model.lower_bound_ for model in models], style, label=f'bound="{bound}"')
        right.plot(sizes, [np.sqrt(model.noise_variance_) for model in models], style)
    left.axhline(exact.log_marginal_likelihood_value_, color="black", linestyle="--", label="exact model")
    right.axhline(np.sqrt(exact.noise_variance_), color="black", linestyle="--")
    for axes, label in ((left, "lower bound, nats"), (right, "std of the noise")):
        harness.logarithmic(axes, "x")
        axes.set(xlabel="number of inducing points", ylabel=label)
    harness.legend(figure, ncols=3)
    harness.save_picture(figure, output.with_suffix(".png"))


def main() -> None:
    """Read the command line, fit what is missing, and write the page and the picture."""
    parser = harness.argument_parser(__doc__, quick="one small set", seeds="number of splits; default: 10")
    parser.add_argument("--data-folder", type=Path, help="with the three tables; default: they are left out")
    parser.add_argument("--sets", nargs="+", help="some of the sets; default: all")
    options = parser.parse_args()
    seeds = options.seeds or (1 if options.quick else 10)
    names = [] if options.data_folder is None else [*TABLES]
    names += [f"{system}, noise {noise} %" for noise in ("1", "0") for system in SYSTEMS]
    if options.quick:
        names = ["pendulum, noise 1 %"]
    sizes = (10,) if options.quick else (100, 256)
    cells = [
        Cell(name, seed, m)
        for seed in range(seeds)
        for m in sizes
        for name in names
        if seed < (SEEDS if name not in TABLES else seeds if m == sizes[0] else LARGE_SPLITS)
        if m == sizes[0] or name in TABLES
    ]
    cells = [cell for cell in cells if not options.sets or cell.name in options.sets]
    output = harness.output_path(options, "bounds")
    rows, trajectories = (ROWS, TRAJECTORIES) if not options.quick else (100, 3)
    job = partial(run, folder=options.data_folder, n_rows=rows, n_trajectories=trajectories)
    failures = harness.run_missing(cells, job, output, options.jobs, since=options.since)
    draw(output, *((40, (3, 6)) if options.quick else (200, TOY_POINTS)))
    harness.write_page("The two lower bounds", tables_of(harness.frame(output)), output, failures)


if __name__ == "__main__":
    main()
