"""The two lower bounds, of Titsias (2009) and of Titsias (2025): accuracy, noise and time of the fits.

    python benchmarks/bounds.py --data-folder ../uci    # about an hour of one core
    python benchmarks/bounds.py                         # without the three tables
    python benchmarks/bounds.py --quick

The tables airfoil, elevators and kin40k are read from --data-folder: NAME/data.csv.gz with the target last, and
NAME/test_mask.csv.gz with a column per split. A fit uses at most 5,000 training rows. Dynamics have noise of 1 %,
or none, and features from physics. "120 %" is the bound of 2009 with a fifth more inducing points, which takes
about as long as the bound of 2025.

Both bounds of a set, split and number of points are maximised one after the other in one process with one thread. They
start from the same parameters and run to convergence, with ``noise_cv`` and without. With 256 points there are two
splits. Dynamics have four seeds.
"""

from __future__ import annotations

from collections import namedtuple
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from sklearn.preprocessing import StandardScaler

import harness
from skevgp import EGPRegressor, EVGPRegressor
from skevgp.datasets import make_dynamics, make_toy
from skevgp.features import AngleEncoder, InertiaForceGravity
from skevgp.metrics import containing_ratios, crps, negative_log_predictive_density
from skevgp.solvers import LBFGS

TABLES = ("airfoil", "elevators", "kin40k")
SYSTEMS = ("pendulum", "cartpole", "acrobot")
BOUNDS = ("titsias", "tight", "titsias, 120 %")
ROWS, TRAJECTORIES = 5000, 20
SEEDS, LARGE_SPLITS = 4, 2  # of dynamics, and of tables with 256 points
TOY_POINTS = (2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32)
# Rows, inducing points and outputs of the evaluations that are timed.
SIZES = ((4000, 100, 1), (4000, 256, 1), (8000, 100, 4), (20_000, 100, 1))

# Fits of one set or system by each bound, with and without noise_cv.
Cell = namedtuple("Cell", "name seed m")
# Evaluations of each bound.
Cost = namedtuple("Cost", "rows m outputs")


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
    share = 1.2 if bound.endswith("120 %") else 1.0
    regressor.set_params(
        solver=LBFGS(bound=bound.partition(",")[0]), noise_cv=folds, n_inducing=int(share * regressor.n_inducing)
    )
    seconds, _ = harness.timed(lambda: regressor.fit(X, Y, groups=groups))
    size = unit[0] if unit else 1.0
    mean, std = (part.reshape(Y_test.shape) / size for part in regressor.predict(X_test, True))
    Y_test = Y_test / size
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


def run(cell: Cell, folder: Path, n_rows: int, n_trajectories: int) -> list[dict[str, Any]]:
    found = []
    for folds in (None, 5):
        for bound in BOUNDS:
            groups = None
            if cell.name in TABLES:
                regressor, rows = table(folder, cell, n_rows)
            else:
                regressor, rows, groups = dynamics(cell, n_trajectories)
            found.append(measured(bound, folds, regressor, rows, groups))
    return found


def run_cost(cell: Cost) -> dict[str, float]:
    rng = np.random.RandomState(0)
    X = rng.randn(cell.rows, 8)
    Y = np.sin(X @ rng.randn(8, cell.outputs)) + 0.1 * rng.randn(cell.rows, cell.outputs)
    with harness.one_thread():
        return {
            bound: min(harness.evaluation_seconds(X, Y, cell.m, bound=bound, sharing="all")) for bound in BOUNDS[:2]
        }


def tables_of(rows: pd.DataFrame, times: pd.DataFrame) -> harness.Tables:
    """Return means over seeds, differences between bounds with their standard errors, and seconds of evaluations."""
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
    cost = times[["rows", "m", "outputs", *BOUNDS[:2]]].assign(ratio=times["tight"] / times["titsias"])
    return {"means": means.reset_index(), "tight less titsias": pd.DataFrame(lines), "evaluation": cost}


def draw(output: Path, n_rows: int, sizes: tuple[int, ...]) -> None:
    """Draw both bounds, the exact log likelihood and the noise over the number of inducing points of a toy set."""
    X, y = make_toy(n_rows, random_state=0, return_X_y=True)
    exact = EGPRegressor(random_state=0).fit(X, y)
    figure, (left, right) = harness.pyplot().subplots(1, 2, figsize=(harness.WIDTH, 3.4), layout="constrained")
    for bound, style in (("titsias", "o-"), ("tight", "s-")):
        solver = LBFGS(bound=bound, n_restarts=4)
        with harness.one_thread():
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
    parser = harness.argument_parser(__doc__, quick="one small set", seeds=10)
    parser.add_argument("--data-folder", type=Path, help="with the three tables; default: they are left out")
    parser.add_argument("--sets", nargs="+", help="some of the sets; default: all")
    options = harness.parse(parser)
    output = harness.output_path(options, "bounds")
    names = [] if options.data_folder is None else [*TABLES]
    names += [f"{system}, noise {noise} %" for noise in (1, 0) for system in SYSTEMS]
    sizes = (10,) if options.quick else (100, 256)
    cells = [
        Cell(name, seed, m)
        for seed in options.seeds
        for m in sizes
        for name in (options.sets or (names[:1] if options.quick else names))
        if seed < (SEEDS if name not in TABLES else len(options.seeds) if m == sizes[0] else LARGE_SPLITS)
        if m == sizes[0] or name in TABLES
    ]
    rows, trajectories = (100, 3) if options.quick else (ROWS, TRAJECTORIES)
    job = partial(run, folder=options.data_folder, n_rows=rows, n_trajectories=trajectories)
    n_failures = harness.run_missing(cells, job, output, options.jobs)
    costs = [Cost(200, 10, 1)] if options.quick else [Cost(*size) for size in SIZES]
    times = output.with_name(f"{output.stem}_cost.csv")
    n_failures += harness.run_missing(costs, run_cost, times)
    draw(output, *((40, (3, 6)) if options.quick else (200, TOY_POINTS)))
    tables = tables_of(harness.frame(output), harness.frame(times))
    harness.write_page("The two lower bounds", tables, output, n_failures)


if __name__ == "__main__":
    main()
