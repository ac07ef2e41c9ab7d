"""Few rows: accuracy and intervals with and without the prior of kernel and noise and the average over draws of them.

    python benchmarks/few_rows.py --data ../shared/data                # five minutes of two cores
    python benchmarks/few_rows.py --sets "made 50 x 35" diabetes-100 --splits 2
    python benchmarks/few_rows.py --models peers                       # scikit-learn's GPR, and the exact model
    python benchmarks/few_rows.py --models nuts --peer-python ~/numpyro/bin/python --splits 3
    python benchmarks/few_rows.py --quick

"library" compares `EVGPRegressor` with its defaults to the same model without this prior and without an average, as in
version 0.2: "likeliest". Both are fitted one after the other in one process with one thread, so that their seconds can
be compared. "peers" are `EGPRegressor` and scikit-learn's `GaussianProcessRegressor`, which have the same kernel with
one length scale for each column and noise. "nuts" is the exact model in NumPyro (0.22) with the same prior (always of
weight 1), by 1,000 draws of its No-U-Turn sampler after 1,000 others. It needs a Python with numpyro, for example of
``python -m venv ~/numpyro; ~/numpyro/bin/pip install numpyro``.

Sets "made n x d" have n rows of d standard normal columns, of which two matter: y = sin(2 x₀) + x₁ + ε with noise of
std .1. "5 rows, 20 outputs" are waves of two columns, with ``sharing="auto"``. Other sets are n rows of a table, and up
to 1,000 other rows for the test. Columns and y are in units of their std in these n rows. Sets such as "pendulum, 2,
IFG" have the steps of 2 trajectories with 1 % of noise, and the model EVGP-IFG or RES-VGP. Their NLPD and coverage are
those of noisy targets.

Coverage is the share of test rows inside 95 % intervals.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
from collections import namedtuple
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import pandas as pd
from sklearn.base import RegressorMixin
from sklearn.datasets import load_diabetes, make_friedman1, make_friedman2, make_friedman3
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.preprocessing import StandardScaler

import harness
from skevgp import EGPRegressor, EVGPRegressor, ResidualRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForceGravity
from skevgp.fitting import rules

MADE = ((50, 35), (100, 100), (100, 300), (300, 300), (100, 1000))
OUTPUTS = "5 rows, 20 outputs"
TABLES = ("airfoil", "diabetes", "elevators", "friedman1", "friedman2", "friedman3", "kin40k")
OF_FILES = ("airfoil", "elevators", "kin40k")
ROWS = (30, 50, 100, 150, 300)
SYSTEMS = ("pendulum", "cartpole", "acrobot")
TRAJECTORIES, TEST_TRAJECTORIES, NOISE = (2, 4), 20, 0.01
N_TEST, LARGEST = 1000, 20_000
SETS = (
    *(f"made {n} x {d}" for n, d in MADE),
    OUTPUTS,
    *(f"{name}-{n}" for name in TABLES for n in ROWS),
    *(f"{name}, {n}, {kind}" for name in SYSTEMS for n in TRAJECTORIES for kind in ("IFG", "RES")),
)
MODELS = {"library": ("evgp", "likeliest"), "peers": ("egp", "gpr"), "nuts": ("nuts",)}

Cell = namedtuple("Cell", "set split models")


class Data(NamedTuple):
    """Training rows and test rows."""

    X: np.ndarray
    y: np.ndarray
    X_test: np.ndarray
    y_test: np.ndarray
    groups: np.ndarray | None = None


# --- data -------------------------------------------------------------------------------------------------------------


@cache
def table(name: str, home: Path | None) -> tuple[np.ndarray, np.ndarray]:
    """All rows of a table."""
    if name in OF_FILES:
        if home is None:
            raise SystemExit(f"{name} needs --data.")
        rows = np.loadtxt(home / "uci" / name / "data.csv.gz", delimiter=",", max_rows=LARGEST)
        return rows[:, :-1], rows[:, -1]
    if name == "diabetes":
        return load_diabetes(return_X_y=True)
    make = {"friedman1": make_friedman1, "friedman2": make_friedman2, "friedman3": make_friedman3}[name]
    X, y = make(4000, random_state=0)
    return X, y + 0.1 * y.std() * np.random.RandomState(1).standard_normal(len(y))


def data_of(name: str, split: int, home: Path | None) -> Data:
    """The rows of a set."""
    rng = np.random.RandomState(split)
    if name.startswith("made"):
        n, d = (int(part) for part in name.split()[1::2])
        X = rng.standard_normal((n + N_TEST, d))
        y = np.sin(2.0 * X[:, 0]) + X[:, 1] + 0.1 * rng.standard_normal(len(X))
        return Data(X[:n], y[:n], X[n:], y[n:])
    if name == OUTPUTS:
        X, directions = rng.standard_normal((5 + N_TEST, 2)), rng.standard_normal((2, 20))
        truth = np.sin(1.5 * X @ (directions / np.linalg.norm(directions, axis=0)) + rng.uniform(0.0, 6.0, 20))
        Y = truth + 0.1 * rng.standard_normal(truth.shape)
        return Data(X[:5], Y[:5], X[5:], Y[5:])
    if "," in name:
        system, trajectories, _ = name.split(", ")
        train = make_dynamics(system, int(trajectories), noise=NOISE, random_state=split)
        test = make_dynamics(system, TEST_TRAJECTORIES, random_state=1000 + split)
        size = NOISE * train.trajectories[:, 1:].reshape(train.target.shape).std(axis=0)
        noisy = test.target + size * rng.standard_normal(test.target.shape)
        return Data(train.data, train.target, test.data, noisy, train.groups)
    kind, _, rows = name.rpartition("-")
    X, y = table(kind, home)
    chosen, n = rng.permutation(len(X))[: int(rows) + N_TEST], int(rows)
    X, y = X[chosen], y[chosen]
    X, mean, size = StandardScaler().fit(X[:n]).transform(X), y[:n].mean(), y[:n].std()
    y = (y - mean) / size
    return Data(X[:n], y[:n], X[n:], y[n:])


# --- models -----------------------------------------------------------------------------------------------------------


def build(name: str, model: str, d: int) -> RegressorMixin:
    """Return a model with the defaults of its library."""
    if model == "egp":
        return EGPRegressor()
    if model == "gpr":
        kernel = ConstantKernel() * RBF(np.ones(d)) + WhiteKernel(0.1)
        return GaussianProcessRegressor(kernel, normalize_y=True, random_state=0)
    if name == OUTPUTS:
        return EVGPRegressor(sharing="auto", random_state=0)
    if not name.endswith(("IFG", "RES")):
        return EVGPRegressor(random_state=0)
    if name.endswith("RES"):
        return ResidualRegressor(EVGPRegressor(random_state=0))
    return EVGPRegressor(InertiaForceGravity(name.split(",")[0]), random_state=0)


@contextmanager
def without_draws(chosen: bool) -> Iterator[None]:
    """Fit as version 0.2 did."""
    with mock.patch.object(rules, "RULES", replace(rules.RULES, few_rows=0.0 if chosen else rules.RULES.few_rows)):
        yield


def scores(mean: np.ndarray, std: np.ndarray, y: np.ndarray) -> dict[str, float]:
    """Scores of predictions, in the mean over outputs. The error is relative to the std of each target."""
    mean, std, y = (part.reshape(len(part), -1) for part in (mean, std, y))
    far = (y - mean) / std
    return {
        "rmse": float(np.mean(np.sqrt(np.mean((y - mean) ** 2, axis=0)) / y.std(axis=0))),
        "nlpd": float(np.mean(0.5 * np.log(2.0 * np.pi * std**2) + 0.5 * far**2)),
        "coverage": float(np.mean(np.abs(far) < 1.959964)),
    }


def by_nuts(data: Data, python: Path) -> tuple[np.ndarray, np.ndarray]:
    """Mean and std of the exact model averaged over draws of its kernel, by another Python."""
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "given.npz", Path(folder) / "found.npz"
        np.savez(given, X=data.X, y=data.y, X_test=data.X_test)
        subprocess.run([python, Path(__file__).parent / "peers" / "nuts.py", given, found], check=True)
        with np.load(found) as arrays:
            return arrays["mean"], arrays["std"]


def run(cell: Cell, home: Path | None, python: Path | None, quick: bool = False) -> list[dict[str, Any]]:
    """Fit the models of a cell and return their scores."""
    data, rows = data_of(cell.set, cell.split, home), []
    for name in MODELS[cell.models]:
        if name == "nuts":
            if python is None:
                raise SystemExit("nuts needs --peer-python.")
            start = time.process_time()
            mean, std = by_nuts(data, python)
            seconds, predicted = time.process_time() - start, np.nan
        else:
            model = build(cell.set, name, data.X.shape[1])
            if quick and "max_iter" in model.get_params():
                model.set_params(max_iter=3)
            options = {} if data.groups is None or name not in MODELS["library"] else {"groups": data.groups}
            with without_draws(name == "likeliest"):
                seconds, _ = harness.timed(partial(model.fit, data.X, data.y, **options))
            with harness.one_thread():
                start = time.process_time()
                mean, std = model.predict(data.X_test, return_std=True)
                predicted = time.process_time() - start
        size = {"rows": len(data.X), "columns": data.X.shape[1]}
        times = {"seconds": round(seconds, 3), "us_per_prediction": round(1e6 * predicted / len(data.X_test), 2)}
        rows.append({"model": name, **size, **scores(mean, std, data.y_test), **times})
    return rows


# --- tables -----------------------------------------------------------------------------------------------------------


def tables(rows: pd.DataFrame) -> harness.Tables:
    """Return a line for each set, with all models, and a summary."""
    order = harness.ordered(SETS, rows["set"])
    wide = rows.pivot_table(index="set", columns="model", values=["rmse", "nlpd", "coverage", "seconds"]).loc[order]
    size = rows.groupby("set")["rows"].first().loc[order]
    lines = pd.DataFrame({"set": order})
    models = [name for names in MODELS.values() for name in names if name in wide["rmse"]]
    for score, digits in (("coverage", 3), ("nlpd", 2), ("rmse", 3)):
        for name in models:
            lines[f"{score}, {name}"] = harness.text(wide[score][name].reset_index(drop=True), digits)
    if not {"evgp", "likeliest"} <= set(models):
        return {"sets": lines}
    seconds = wide["seconds"]["evgp"] / wide["seconds"]["likeliest"]
    lines["× seconds"] = harness.text(seconds.reset_index(drop=True), 2)
    micros = rows.pivot_table(index="set", columns="model", values="us_per_prediction").loc[order]
    slower = micros["evgp"] / micros["likeliest"]
    ratio, gain = wide["rmse"]["evgp"] / wide["rmse"]["likeliest"], wide["nlpd"]["evgp"] - wide["nlpd"]["likeliest"]
    made, systems = wide.index.isin([*SETS[: len(MADE) + 1]]), wide.index.str.endswith(("IFG", "RES"))
    same = ((gain == 0.0) & (ratio == 1.0)).to_numpy()
    kinds = {"made sets": made, "tables": ~made & ~systems, "systems": systems}
    summary = []
    for label, chosen in (
        *((f"{name}, few rows", own & ~same) for name, own in kinds.items()),
        *((f"{name}, enough rows: the same fit", own & same) for name, own in kinds.items()),
    ):
        if not chosen.any():
            continue
        enough = chosen & (size >= 50).to_numpy()
        coverage = wide["coverage"][enough] if enough.any() else wide["coverage"][chosen]
        summary.append(
            {
                "": label,
                "sets": int(chosen.sum()),
                "least coverage, n ≥ 50": float(coverage["evgp"].min()),
                "greatest": float(coverage["evgp"].max()),
                "least of likeliest": float(coverage["likeliest"].min()),
                "NLPD is lower in": f"{int((gain[chosen] < 0.0).sum())} of {int(chosen.sum())}",
                "largest loss of NLPD": float(gain[chosen].max()),
                "RMSE, geometric mean of ratios": float(np.exp(np.log(ratio[chosen]).mean())),
                "largest ratio of RMSE": float(ratio[chosen].max()),
                "seconds, geometric mean of ratios": float(np.exp(np.log(seconds[chosen]).mean())),
                "seconds of a prediction": float(np.exp(np.log(slower[chosen]).mean())),
            }
        )
    return {"summary": pd.DataFrame(summary), "sets": lines}


def main() -> None:
    """Read the command line, run, and write the page."""
    parser = harness.argument_parser(__doc__, quick="two small sets, one split, few iterations")
    parser.add_argument("--data", type=Path, help="folder with uci/airfoil, uci/elevators and uci/kin40k")
    parser.add_argument("--sets", nargs="+", choices=SETS, help="default: all, without those of files if no --data")
    parser.add_argument("--splits", type=int, default=10, help="number of splits; default: %(default)s")
    parser.add_argument("--models", nargs="+", choices=MODELS, default=["library"], help="default: library")
    parser.add_argument("--peer-python", type=Path, help="a Python with numpyro, for --models nuts")
    options: argparse.Namespace = harness.parse(parser)
    sets = options.sets or [name for name in SETS if options.data or not name.startswith(OF_FILES)]
    splits = range(options.splits)
    if options.quick:
        sets, splits = options.sets or ["made 50 x 35", "diabetes-30"], range(1)
    output = harness.output_path(options, "few_rows")
    # Peers have no features, and nothing about groups.
    cells = [
        Cell(name, split, models)
        for models in options.models
        for split in splits
        for name in sets
        if models == "library" or not name.endswith(("IFG", "RES"))
    ]
    one: Callable[[Cell], Any] = partial(run, home=options.data, python=options.peer_python, quick=options.quick)
    n_failures = harness.run_missing(cells, one, output, options.jobs)
    harness.write_page(
        "Few rows, with and without an average over kernels", tables(harness.frame(output)), output, n_failures
    )


if __name__ == "__main__":
    main()
